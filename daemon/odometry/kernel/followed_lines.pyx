# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The functions of reference.py that compare lines and pictures over frames, compiled; see views.pyx."""

import numpy as np

from ceilvo.daemon.odometry.kernel.arguments import check_length

from libc.math cimport INFINITY, hypot, rint, sqrt
from libc.stdint cimport int64_t, uint8_t


def line_ratios(const double[:, ::1] sums not None, noise):
    cdef Py_ssize_t count = sums.shape[0], k
    cdef double least = noise.step_m * noise.step_m, sigma_m = noise.sigma_m, sigma_ratio = noise.sigma_ratio
    cdef double independent = noise.independent, n, s, a, spread, safe, error, left
    cdef bint known
    check_length("sums of a line", sums.shape[1], 6)
    ratio_out, sigma_out, bent_out = np.empty((3, count))
    cdef double[::1] ratio = ratio_out, sigma = sigma_out, bent = bent_out
    with nogil:
        for k in range(count):
            n, s, a = max(sums[k, 0], 1.0), sums[k, 1], sums[k, 2]
            spread = sums[k, 3] - s * s / n
            known = spread > least
            safe = spread if known else 1.0
            ratio[k] = -(sums[k, 4] - s * a / n) / safe if known else 1.0
            left = sums[k, 5] - a * a / n - ratio[k] * ratio[k] * spread
            bent[k] = max(left, 0.0) / max(n - 2.0, 1.0)
            error = max(sigma_m, sqrt(bent[k])) / sqrt(safe * min(independent / n, 1.0))
            sigma[k] = hypot(error, sigma_ratio) if known else INFINITY
    return ratio_out, sigma_out, bent_out


def grouped(const double[::1] value not None, const int64_t[::1] kind not None, double same):
    cdef Py_ssize_t n = value.shape[0], i, k, a, groups = 0
    check_length("kind", kind.shape[0], n)
    number_out, first_out = np.empty(n, np.int64), np.empty(n, np.int64)
    cdef int64_t[::1] number = number_out, first = first_out, order = np.empty(n, np.int64)
    with nogil:
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
    return number_out, first_out[:groups]


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
