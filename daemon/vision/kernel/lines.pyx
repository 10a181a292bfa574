# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The functions of of_lines.py, compiled; see points.pyx."""

import math

import numpy as np

from ceilvo.daemon.vision.kernel.arguments import check_length

from libc.math cimport cos, fabs, rint, sin, sqrt
from libc.stdint cimport int32_t, int64_t

include "solve.pxi"

cdef enum:
    UNKNOWNS = 5  # shift along either normal, turn, tilt about x and y
    SUMS = 4  # rho, tangent, what a tilt about either normal does


cdef check_points(const float[::1] rho, const float[::1] tangent, const int32_t[::1] line, Py_ssize_t half, Py_ssize_t lines):
    cdef Py_ssize_t n = line.shape[0], i
    check_length("rho", rho.shape[0], n)
    check_length("tangent", tangent.shape[0], n)
    if not 0 <= half <= n:
        raise ValueError(f"{half} of {n} points belong to axis 0")
    for i in range(n):
        if line[i] < 0 or line[i] >= lines:
            raise ValueError(f"point {i}: line {line[i]} of {lines}")


# -- a common shift, turn and tilt


cdef double likely_shift(const double *off, Py_ssize_t count, const double[::1] likelihood, int64_t[::1] votes) noexcept nogil:
    cdef Py_ssize_t bins = votes.shape[0], reach = bins // 2, i, best = 0
    cdef double score, most = -1.0
    cdef int64_t three
    if count == 0:
        return 0.0
    for i in range(bins):
        votes[i] = 0
    for i in range(count):
        votes[<Py_ssize_t>rint(off[i]) + reach if fabs(off[i]) < reach else (0 if off[i] < 0 else bins - 1)] += 1
    for i in range(bins):
        three = votes[i]
        if i > 0:
            three += votes[i - 1]
        if i < bins - 1:
            three += votes[i + 1]
        score = <double>three * likelihood[i]
        if score > most:
            best, most = i, score
    return <double>(best - reach)


cdef void normal_equations(
    const float[::1] rho, const float[::1] tangent, const double *off, const double *shift, bint again, Py_ssize_t half,
    const double *cosines, const double *sines, double focal, double gate, double *a, double *found
) noexcept nogil:
    """Of the points within the gate, added to a and put in place of found; again: found says where points should be."""
    cdef double[UNKNOWNS] last, b
    cdef double[SUMS] row
    cdef Py_ssize_t i, u, v
    cdef double r, t, x, y, nx, ny, fitted
    cdef int axis
    for u in range(UNKNOWNS):
        last[u], b[u] = found[u], 0.0
    row[0] = 1.0
    for i in range(rho.shape[0]):
        axis = i >= half
        r, t, nx, ny = rho[i], tangent[i], cosines[axis], sines[axis]
        x, y = r * nx - t * ny, r * ny + t * nx
        row[1] = -focal * t
        row[2] = -focal * (-nx * x * y - ny * (1.0 + y * y))
        row[3] = -focal * (nx * (1.0 + x * x) + ny * x * y)
        fitted = last[axis] + row[1] * last[2] + row[2] * last[3] + row[3] * last[4] if again else shift[axis]
        if not fabs(off[i] - fitted) < gate:
            continue
        a[axis * UNKNOWNS + axis] += 1.0
        b[axis] += off[i]
        for u in range(1, SUMS):
            a[axis * UNKNOWNS + u + 1] += row[u]
            b[u + 1] += row[u] * off[i]
            for v in range(u, SUMS):
                a[(u + 1) * UNKNOWNS + v + 1] += row[u] * row[v]
    for u in range(UNKNOWNS):
        found[u] = b[u]
        for v in range(u):
            a[u * UNKNOWNS + v] = a[v * UNKNOWNS + u]


cdef bint common(
    const float[::1] rho, const float[::1] tangent, const double *off, const double *shift, Py_ssize_t half, double psi,
    double focal, const double[::1] info, const double[::1] gates, double *found
) noexcept nogil:
    cdef double[UNKNOWNS * UNKNOWNS] a
    cdef double[2] cosines, sines
    cdef Py_ssize_t u, g
    cosines[0], sines[0] = cos(psi), sin(psi)
    cosines[1], sines[1] = -sines[0], cosines[0]
    for g in range(gates.shape[0]):
        for u in range(UNKNOWNS * UNKNOWNS):
            a[u] = info[u // UNKNOWNS] if u // UNKNOWNS == u % UNKNOWNS else 0.0
        normal_equations(rho, tangent, off, shift, g > 0, half, cosines, sines, focal, gates[g], a, found)
        if not solve(a, found, UNKNOWNS, 1):
            return False
    return True


def align(
    const float[::1] rho not None, const float[::1] tangent not None, const int32_t[::1] line not None, Py_ssize_t half,
    const double[::1] offset_px not None, double psi_rad, double focal_px, const double[::1] info not None,
    const double[::1] gates_px not None, const double[::1] likelihood not None
):
    cdef Py_ssize_t n = line.shape[0], i
    check_points(rho, tangent, line, half, offset_px.shape[0])
    check_length("info", info.shape[0], UNKNOWNS)
    if gates_px.shape[0] < 1 or likelihood.shape[0] % 2 == 0:
        raise ValueError(f"{gates_px.shape[0]} gates, {likelihood.shape[0]} bins; expected one at least, an odd number")
    found_out = np.zeros(UNKNOWNS)
    cdef double[::1] found = found_out, off = np.empty(n)
    cdef int64_t[::1] votes = np.zeros(likelihood.shape[0], np.int64)
    cdef double[2] shift
    cdef bint good
    with nogil:
        for i in range(n):
            off[i] = <double>rho[i] * focal_px - offset_px[line[i]]
        shift[0] = likely_shift(&off[0], half, likelihood, votes)
        shift[1] = likely_shift(&off[0] + half, n - half, likelihood, votes)
        good = common(rho, tangent, &off[0], shift, half, psi_rad, focal_px, info, gates_px, &found[0])
    if not good:
        raise np.linalg.LinAlgError("Singular matrix")
    return found_out


# -- one step of the joint least squares


cdef void scatter_about_means(
    const float[::1] rho, const float[::1] tangent, const int32_t[::1] line, Py_ssize_t half, int64_t[::1] count,
    double[:, ::1] total, double *scatter
) noexcept nogil:
    """Points of every line, their sums, and all sums of products about every line's own mean, the upper half of them.

    Neighbours are mostly on one line: sums are kept in registers until the next one.
    """
    cdef Py_ssize_t i = 0, k, u, v, begin, n = line.shape[0]
    cdef double r, t, across, own, p, q, r_sum, t_sum, p_sum, q_sum
    cdef double rr = 0, rt = 0, rp = 0, rq = 0, tt = 0, tp = 0, tq = 0, pp = 0, pq = 0, qq = 0
    while i < n:
        k, begin = line[i], i
        r_sum = t_sum = p_sum = q_sum = 0
        while i < n and line[i] == k and (i < half) == (begin < half):
            r, t = rho[i], tangent[i]
            across, own = -r * t, 1.0 + r * r
            p = across if begin < half else -own
            q = own if begin < half else across
            r_sum, t_sum, p_sum, q_sum = r_sum + r, t_sum + t, p_sum + p, q_sum + q
            rr, rt, rp, rq, tt = rr + r * r, rt + r * t, rp + r * p, rq + r * q, tt + t * t
            tp, tq, pp, pq, qq = tp + t * p, tq + t * q, pp + p * p, pq + p * q, qq + q * q
            i += 1
        count[k] += i - begin
        total[k, 0] += r_sum
        total[k, 1] += t_sum
        total[k, 2] += p_sum
        total[k, 3] += q_sum
    scatter[0], scatter[1], scatter[2], scatter[3] = rr, rt, rp, rq
    scatter[5], scatter[6], scatter[7], scatter[10], scatter[11], scatter[15] = tt, tp, tq, pp, pq, qq
    for k in range(count.shape[0]):
        if count[k]:
            for u in range(SUMS):
                for v in range(u, SUMS):
                    scatter[SUMS * u + v] -= total[k, u] * total[k, v] / <double>count[k]


def fit(
    const float[::1] rho not None, const float[::1] tangent not None, const int32_t[::1] line not None, Py_ssize_t half,
    Py_ssize_t lines, double psi_rad, const double[::1] tilt_rad not None, step
):
    cdef double focal2 = step.focal_px * step.focal_px, correlated = step.correlated, least = step.least_noise_px
    cdef double direction_info = step.direction_info, tilt_info = step.tilt_info, weight, noise, pull
    cdef bint held = step.held
    cdef Py_ssize_t n = line.shape[0], u, v, w
    check_points(rho, tangent, line, half, lines)
    check_length("tilt_rad", tilt_rad.shape[0], 2)
    count_out, total_out = np.zeros(lines, np.int64), np.zeros((lines, SUMS))
    covariance_out, step_out = np.empty((3, 3)), np.empty(3)
    cdef int64_t[::1] count = count_out
    cdef double[:, ::1] total = total_out, covariance = covariance_out
    cdef double[::1] moved = step_out
    cdef double[SUMS * SUMS] s
    cdef double[9] info, inverse, turned
    cdef double[3] gradient
    cdef double c = math.cos(psi_rad), z = math.sin(psi_rad)
    cdef double[9] to_base = [1.0, 0.0, 0.0, 0.0, c, -z, 0.0, z, c]
    cdef bint good
    with nogil:
        scatter_about_means(rho, tangent, line, half, count, total, s)
        noise = s[0] * focal2 / <double>(n if n > 0 else 1)
        noise = sqrt(noise) if noise > 0.0 else 0.0
        noise = noise if noise > least else least
        weight = 1.0 / (noise * noise * correlated)
        for u in range(3):
            gradient[u] = weight * (s[u + 1] * focal2)
            for v in range(3):
                info[3 * u + v] = weight * (s[SUMS * (min(u, v) + 1) + max(u, v) + 1] * focal2)
                inverse[3 * u + v] = u == v
        info[0] += direction_info
        info[4] += tilt_info
        info[8] += tilt_info
        if not held:
            gradient[1] += (c * tilt_rad[0] + z * tilt_rad[1]) * tilt_info
            gradient[2] += (c * tilt_rad[1] - z * tilt_rad[0]) * tilt_info
        good = solve(info, inverse, 3, 3)
        for u in range(3):  # to_base @ inverse
            for v in range(3):
                turned[3 * u + v] = 0.0
                for w in range(3):
                    turned[3 * u + v] += to_base[3 * u + w] * inverse[3 * w + v]
        for u in range(3):
            pull = 0.0
            for w in range(3):
                pull -= turned[3 * u + w] * gradient[w]
                covariance[u, w] = 0.0
                for v in range(3):
                    covariance[u, w] += turned[3 * u + v] * to_base[3 * w + v]
            moved[u] = pull
    if not good:
        raise np.linalg.LinAlgError("Singular matrix")
    return count_out, noise, step_out, covariance_out
