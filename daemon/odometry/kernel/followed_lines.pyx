# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The functions of reference.py that compare lines and pictures over frames, compiled; see views.pyx."""

import numpy as np

from ceilvo.daemon.odometry.kernel.arguments import check_length

from libc.math cimport INFINITY, fabs, hypot, rint, sqrt
from libc.stdint cimport int64_t, uint8_t


cdef enum:
    SUMS = 6  # of the measurements of a line


cdef struct Noise:
    double least, sigma_m, sigma_ratio, independent


cdef Noise noise_of(noise):
    return Noise(noise.step_m * noise.step_m, noise.sigma_m, noise.sigma_ratio, noise.independent)


cdef inline void ratio_of(const double *sums, const Noise *noise, double *ratio, double *sigma, double *bent) noexcept nogil:
    cdef double n = max(sums[0], 1.0), s = sums[1], a = sums[2], spread, safe, error, left
    spread = sums[3] - s * s / n
    cdef bint known = spread > noise.least
    safe = spread if known else 1.0
    ratio[0] = -(sums[4] - s * a / n) / safe if known else 1.0
    left = sums[5] - a * a / n - ratio[0] * ratio[0] * spread
    bent[0] = max(left, 0.0) / max(n - 2.0, 1.0)
    error = max(noise.sigma_m, sqrt(bent[0])) / sqrt(safe * min(noise.independent / n, 1.0))
    sigma[0] = hypot(error, noise.sigma_ratio) if known else INFINITY


def line_ratios(const double[:, ::1] sums not None, noise):
    cdef Py_ssize_t count = sums.shape[0], k
    cdef Noise of = noise_of(noise)
    check_length("sums of a line", sums.shape[1], SUMS)
    ratio_out, sigma_out, bent_out = np.empty((3, count))
    cdef double[::1] ratio = ratio_out, sigma = sigma_out, bent = bent_out
    with nogil:
        for k in range(count):
            ratio_of(&sums[k, 0], &of, &ratio[k], &sigma[k], &bent[k])
    return ratio_out, sigma_out, bent_out


cdef Py_ssize_t group(
    const double *value, const int64_t *kind, Py_ssize_t n, double same, int64_t *order, int64_t *number, int64_t *first
) noexcept nogil:
    """How many groups; number: of each value's, first: the first value of each. order: room for n."""
    cdef Py_ssize_t i, k, a, groups = 0
    for i in range(n):  # few, and mostly in order already
        k = i
        while k > 0 and (
            kind[i] < kind[order[k - 1]] or (kind[i] == kind[order[k - 1]] and value[i] < value[order[k - 1]])
        ):
            order[k] = order[k - 1]
            k -= 1
        order[k] = i
    for i in range(n):
        a = order[i]
        if i == 0 or kind[a] != kind[order[i - 1]] or value[a] - value[order[i - 1]] > same:
            first[groups] = a
            groups += 1
        number[a] = groups - 1
    return groups


def lines_seen(const double[:, :] from_camera not None, const int64_t[:] crossing_type not None, long quarters, double same):
    cdef Py_ssize_t n = from_camera.shape[0], i, own, groups, lines = 0
    cdef int64_t sign, turned
    check_length("a place", from_camera.shape[1], 2)
    check_length("crossing_type", crossing_type.shape[0], n)
    whole, real, of_out = np.empty((6, 2 * n), np.int64), np.empty((2, 2 * n)), np.empty((n, 2), np.int64)
    cdef int64_t[:, ::1] w = whole, of_crossing = of_out  # axis, kind; a crossing's kind, order, number, first
    cdef double[:, ::1] r = real  # apparent; a crossing's place
    if n == 0:
        return whole[0], whole[1], real[0], of_out
    with nogil:
        for own in range(2):
            for i in range(n):
                w[2, i] = crossing_type[i] % 3 if own else crossing_type[i] // 3
                r[1, i] = from_camera[i, own]
            groups = group(&r[1, 0], &w[2, 0], n, same, &w[3, 0], &w[4, 0], &w[5, 0])
            turned = (own + quarters) % 4
            turned = turned + 4 if turned < 0 else turned
            sign = 1 if turned < 2 else -1
            for i in range(n):
                of_crossing[i, own] = lines + w[4, i]
            for i in range(groups):
                w[0, lines + i], w[1, lines + i] = turned % 2, sign * (w[2, w[5, i]] - 1)
                r[0, lines + i] = <double>sign * r[1, w[5, i]]
            lines += groups
    return whole[0, :lines], whole[1, :lines], real[0, :lines], of_out


def lines_followed(
    const int64_t[:] seen_axis not None, const int64_t[:] seen_kind not None, const double[:] seen_m not None,
    const int64_t[:] axis not None, const int64_t[:] kind not None, const double[:] expected_m not None, double gate_m
):
    cdef Py_ssize_t n = seen_m.shape[0], m = expected_m.shape[0], i, j, near
    cdef double least, off
    for name, items, expected in (
        ("seen_axis", seen_axis.shape[0], n), ("seen_kind", seen_kind.shape[0], n), ("axis", axis.shape[0], m),
        ("kind", kind.shape[0], m),
    ):
        check_length(name, items, expected)
    out, to_out, best = np.full(n, -1, np.int64), np.full(m, -1, np.int64), np.full(m, np.inf)
    cdef int64_t[::1] found = out, nearest = to_out
    cdef double[::1] to = best
    with nogil:
        for i in range(n):
            near, least = -1, INFINITY
            for j in range(m):
                if seen_axis[i] != axis[j] or seen_kind[i] != kind[j]:
                    continue
                off = (seen_m[i] - expected_m[j]) * (seen_m[i] - expected_m[j])
                if off < least:
                    near, least = j, off
                if off < to[j]:
                    nearest[j], to[j] = i, off
            found[i] = near if least < gate_m * gate_m else -1
        for i in range(n):
            if found[i] >= 0 and nearest[found[i]] != i:
                found[i] = -1
    return out


def lines_measured(
    const int64_t[:] row not None, const double[:] camera_m not None, const double[:] apparent_m not None,
    double[::1] measured_m not None, double[:, ::1] sums not None, int64_t[::1] strange not None, noise, limits
):
    cdef Py_ssize_t n = row.shape[0], lines = measured_m.shape[0], i, k, count = 0
    cdef Noise of = noise_of(noise)
    cdef double step = noise.step_m, sigmas = limits.outlier_sigmas, least = limits.outlier_m, s, a, m, ahead, ratio, sigma
    cdef double bent
    cdef int64_t fewest = limits.fewest, most = limits.strange
    for name, items in (
        ("camera_m", camera_m.shape[0]), ("apparent_m", apparent_m.shape[0]), ("sums", sums.shape[0]),
        ("strange", strange.shape[0]),
    ):
        check_length(name, items, lines)
    check_length("sums of a line", sums.shape[1], SUMS)
    for i in range(n):
        if not 0 <= row[i] < lines:
            raise ValueError(f"line {row[i]} of {lines}")
    out = np.empty(n, np.int64)
    cdef int64_t[::1] anew = out
    with nogil:
        for i in range(n):
            k = row[i]
            s, a = camera_m[k], apparent_m[k]
            if fabs(s - measured_m[k]) < step:
                continue
            m = max(sums[k, 0], 1.0)
            ratio_of(&sums[k, 0], &of, &ratio, &sigma, &bent)
            ahead = s - sums[k, 1] / m
            measured_m[k] = s
            if m < <double>fewest or (
                fabs(a - sums[k, 2] / m + ratio * ahead) < least + sigmas * min(sigma, 1.0) * fabs(ahead)
            ):
                strange[k] = 0
                sums[k, 0] += 1.0
                sums[k, 1] += s
                sums[k, 2] += a
                sums[k, 3] += s * s
                sums[k, 4] += s * a
                sums[k, 5] += a * a
                continue
            strange[k] += 1
            if strange[k] >= most:
                anew[count] = k
                count += 1
    return out[:count]


def alike(const uint8_t[::1] new not None, const uint8_t[:, ::1] before not None, double most, int black, int glare):
    cdef Py_ssize_t k, i
    cdef int a, b
    cdef int64_t near
    check_length("before", before.shape[1], new.shape[0])
    out = np.zeros(before.shape[0], np.int64)
    cdef int64_t[::1] count = out
    cdef int within = <int>min(max(most, -1.0), 255.0) if most >= 0.0 else -1
    with nogil:
        for k in range(before.shape[0]):
            near = 0
            for i in range(new.shape[0]):
                a, b = new[i], before[k, i]
                near += (a - b <= within) & (b - a <= within) | (a <= black) | (a >= glare) | (b <= black) | (b >= glare)
            count[k] = near
    return out


def calm_difference(const uint8_t[::1] a not None, const uint8_t[::1] b not None, double share, int black, int glare):
    cdef Py_ssize_t i, n = 0, calm, left
    cdef int64_t[256] of  # samples of each difference
    cdef int64_t total = 0
    check_length("b", b.shape[0], a.shape[0])
    with nogil:
        for i in range(256):
            of[i] = 0
        for i in range(a.shape[0]):
            if a[i] > black and a[i] < glare and b[i] > black and b[i] < glare:
                of[a[i] - b[i] if a[i] > b[i] else b[i] - a[i]] += 1
                n += 1
        calm = left = <Py_ssize_t>rint(share * <double>n)
        for i in range(256):
            total += i * min(left, of[i])
            left -= min(left, of[i])
    return n, <double>total / <double>calm if calm else 0.0
