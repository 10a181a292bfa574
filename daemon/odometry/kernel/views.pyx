# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The functions of reference.py, compiled; see daemon/vision/kernel/points.pyx."""

import math

import numpy as np

from ceilvo.daemon.odometry.kernel import arguments
from ceilvo.daemon.odometry.kernel.arguments import check_length
from ceilvo.robust import MAD_TO_SIGMA

from libc.math cimport INFINITY, atan2, cos, fabs, hypot, sin, sqrt
from libc.stdint cimport int64_t, uint8_t

include "../../vision/kernel/solve.pxi"

cdef double CORNER_SIGMA_M = arguments.CORNER_SIGMA_M, GATE_MEDIANS = arguments.GATE_MEDIANS
cdef double MAD = MAD_TO_SIGMA
cdef int MAX_ROUNDS = arguments.MAX_ROUNDS, FREEDOM = arguments.DEGREES_OF_FREEDOM


cdef check_pairs(const double[:, ::1] a, const double[:, ::1] b):
    if a.shape[0] != b.shape[0] or a.shape[1] != 2 or b.shape[1] != 2:
        arguments.check_pairs((a.shape[0], a.shape[1]), (b.shape[0], b.shape[1]))


cdef void sort(double *v, Py_ssize_t n) noexcept nogil:
    """Shell's, with gaps of Ciura (2001): the arrays are short."""
    cdef Py_ssize_t[8] gaps = [701, 301, 132, 57, 23, 10, 4, 1]
    cdef Py_ssize_t g, gap, i, k
    cdef double x
    for g in range(8):
        gap = gaps[g]
        for i in range(gap, n):
            x, k = v[i], i
            while k >= gap and v[k - gap] > x:
                v[k] = v[k - gap]
                k -= gap
            v[k] = x


def mutual_nearest(
    const double[:, ::1] a not None, const int64_t[::1] kind_a not None, const double[:, ::1] b not None,
    const int64_t[::1] kind_b not None, double radius
):
    cdef Py_ssize_t n = a.shape[0], m = b.shape[0], i, j, near, found = 0
    cdef double least, x, y, d2
    check_length("a point", a.shape[1], 2)
    check_length("a point", b.shape[1], 2)
    check_length("kind_a", kind_a.shape[0], n)
    check_length("kind_b", kind_b.shape[0], m)
    i_out, j_out = np.empty(n, np.int64), np.empty(n, np.int64)
    cdef int64_t[::1] seen = i_out, which = j_out, nearest_to_b = np.full(m, -1, np.int64)
    cdef double[::1] to_b = np.full(m, np.inf)
    with nogil:
        for i in range(n):
            near, least = -1, INFINITY
            for j in range(m):
                if kind_a[i] != kind_b[j]:
                    continue
                x, y = a[i, 0] - b[j, 0], a[i, 1] - b[j, 1]
                d2 = x * x + y * y
                if d2 < least:
                    near, least = j, d2
                if d2 < to_b[j]:
                    nearest_to_b[j], to_b[j] = i, d2
            which[i] = near if least < radius * radius else -1
        for i in range(n):
            j = which[i]
            if j >= 0 and nearest_to_b[j] == i:
                seen[found], which[found] = i, j
                found += 1
    return i_out[:found], j_out[:found]


cdef double middle(double *v, Py_ssize_t n) noexcept nogil:
    """The median, between two the mean; v is sorted."""
    sort(v, n)
    return v[n // 2] if n % 2 else 0.5 * (v[n // 2 - 1] + v[n // 2])


def median_translation(const double[:, ::1] a not None, const double[:, ::1] b not None, double theta_rad, double axis_rad):
    cdef Py_ssize_t n = a.shape[0], i
    check_pairs(a, b)
    check_length("fewest points", min(n, 1), 1)
    cdef double c = math.cos(theta_rad), s = math.sin(theta_rad), ca = math.cos(axis_rad), sa = math.sin(axis_rad), x, y
    out = np.empty(3)
    cdef double[::1] motion = out
    cdef double[:, ::1] off = np.empty((2, n))
    with nogil:
        for i in range(n):
            x = b[i, 0] - (c * a[i, 0] - s * a[i, 1])
            y = b[i, 1] - (s * a[i, 0] + c * a[i, 1])
            off[0, i], off[1, i] = ca * x + sa * y, ca * y - sa * x
        x, y = middle(&off[0, 0], n), middle(&off[1, 0], n)
        motion[0], motion[1], motion[2] = ca * x - sa * y, sa * x + ca * y, theta_rad
    return out


def median_radius(const double[:, ::1] xy not None):
    cdef Py_ssize_t n = xy.shape[0], i
    cdef double x = 0.0, y = 0.0, radius
    check_length("a point", xy.shape[1], 2)
    check_length("fewest points", min(n, 1), 1)
    cdef double[::1] off = np.empty(n)
    with nogil:
        for i in range(n):
            x, y = x + xy[i, 0], y + xy[i, 1]
        x, y = x / <double>n, y / <double>n
        for i in range(n):
            off[i] = hypot(xy[i, 0] - x, xy[i, 1] - y)
        radius = middle(&off[0], n)
    return radius


# -- a planar motion, refined


cdef struct Pairs:
    const double *a
    const double *b
    const double *own  # standard deviations, NULL where the points are alike
    Py_ssize_t n
    double sigmas, max_m, sigma_m


cdef inline double weight_of(const Pairs *p, Py_ssize_t i) noexcept nogil:
    cdef double own
    if p.own == NULL:
        return 1.0
    own = p.own[i] if p.own[i] > CORNER_SIGMA_M else CORNER_SIGMA_M
    return 1.0 / (own * own)


cdef void rigid(const Pairs *p, const uint8_t *used, double *fit) noexcept nogil:
    """used: NULL for all."""
    cdef double w, total = 0.0, ax = 0.0, ay = 0.0, bx = 0.0, by = 0.0, sine = 0.0, cosine = 0.0, x, y, u, v
    cdef Py_ssize_t i
    for i in range(p.n):
        if used == NULL or used[i]:
            w = weight_of(p, i)
            total += w
            ax += w * p.a[2 * i]
            ay += w * p.a[2 * i + 1]
            bx += w * p.b[2 * i]
            by += w * p.b[2 * i + 1]
    ax, ay, bx, by = ax / total, ay / total, bx / total, by / total
    for i in range(p.n):
        if used == NULL or used[i]:
            w = weight_of(p, i)
            x, y, u, v = w * (p.a[2 * i] - ax), w * (p.a[2 * i + 1] - ay), p.b[2 * i] - bx, p.b[2 * i + 1] - by
            sine += x * v - y * u
            cosine += x * u + y * v
    fit[2] = atan2(sine, cosine)
    x, y = cos(fit[2]), sin(fit[2])
    fit[0], fit[1] = bx - (x * ax - y * ay), by - (y * ax + x * ay)


cdef void residuals(const Pairs *p, const double *fit, double *eta) noexcept nogil:
    cdef double c = cos(fit[2]), s = sin(fit[2])
    cdef Py_ssize_t i
    for i in range(p.n):
        eta[i] = hypot(
            p.b[2 * i] - (c * p.a[2 * i] - s * p.a[2 * i + 1] + fit[0]),
            p.b[2 * i + 1] - (s * p.a[2 * i] + c * p.a[2 * i + 1] + fit[1]),
        )


cdef Py_ssize_t keep(const Pairs *p, const double *eta, double *room, uint8_t *used, bint *changed) noexcept nogil:
    """Put which residuals are kept into used, and how many they are."""
    cdef Py_ssize_t i, count = 0
    cdef double half, most, own
    cdef uint8_t good
    for i in range(p.n):
        room[i] = eta[i]
    sort(room, p.n)
    half = room[p.n // 2]
    most = MAD * half if MAD * half > p.sigma_m else p.sigma_m
    most = p.sigmas * most if p.sigmas * most < p.max_m else p.max_m
    most = most if most > GATE_MEDIANS * half else GATE_MEDIANS * half
    changed[0] = False
    for i in range(p.n):
        own = most if p.own == NULL or p.sigmas * p.own[i] < most else p.sigmas * p.own[i]
        good = eta[i] < own
        changed[0] |= good != used[i]
        used[i] = good
        count += good
    return count


cdef bint fits(const Pairs *p, const double *eta, const uint8_t *used, double *room, Py_ssize_t count) noexcept nogil:
    cdef Py_ssize_t i, k = 0
    cdef double half, own
    for i in range(p.n):
        if used[i]:
            room[k] = eta[i] if p.own == NULL else eta[i] / p.own[i]
            k += 1
    sort(room, count)
    half = room[count // 2]
    if p.own == NULL:
        return half <= p.max_m
    k = 0
    for i in range(p.n):
        if used[i]:
            room[k] = p.own[i]
            k += 1
    sort(room, count)
    own = p.max_m / room[count // 2]
    return half <= (own if own > p.sigmas else p.sigmas)


cdef void normal_matrix(const Pairs *p, const uint8_t *used, const double *fit, double *info) noexcept nogil:
    cdef double c = cos(fit[2]), s = sin(fit[2]), w, x, y, n = 0.0, sx = 0.0, sy = 0.0, square = 0.0
    cdef Py_ssize_t i
    for i in range(p.n):
        if used[i]:
            w, x, y = weight_of(p, i), c * p.a[2 * i] - s * p.a[2 * i + 1], s * p.a[2 * i] + c * p.a[2 * i + 1]
            n, sx, sy, square = n + w, sx + w * x, sy + w * y, square + w * (x * x + y * y)
    info[0], info[1], info[2] = n, 0.0, -sy
    info[3], info[4], info[5] = 0.0, n, sx
    info[6], info[7], info[8] = -sy, sx, square


def refined(
    const double[:, ::1] a not None, const double[:, ::1] b not None, const double[::1] start, gate,
    const double[::1] own_sigma_m=None
):
    cdef Py_ssize_t n = a.shape[0], i, count = 0, least = max(gate.min_points, 2)
    cdef bint changed, enough = True, anew = start is None
    cdef double square = 0.0, weighted = 0.0, weights = 0.0, w, scale, variance, freedom
    cdef Pairs p = Pairs(&a[0, 0], &b[0, 0], NULL, n, gate.sigmas, gate.max_m, gate.sigma_m)
    check_pairs(a, b)
    if own_sigma_m is not None:
        check_length("own_sigma_m", own_sigma_m.shape[0], n)
        p.own = &own_sigma_m[0]
    if start is not None:
        check_length("start", start.shape[0], 3)
    if n < 2:
        return None
    fit_out, used_out, covariance = np.empty(3), np.zeros(n, np.uint8), np.eye(3)
    cdef double[::1] fit = fit_out
    cdef double[:, ::1] inverse = covariance, room = np.empty((2, n))
    cdef double *eta = &room[0, 0]
    cdef uint8_t[::1] used = used_out
    cdef double[9] info, spoilt
    with nogil:
        if anew:
            rigid(&p, NULL, &fit[0])
        else:
            fit[0], fit[1], fit[2] = start[0], start[1], start[2]
        for i in range(MAX_ROUNDS):
            residuals(&p, &fit[0], eta)  # eq. 16
            count = keep(&p, eta, &room[1, 0], &used[0], &changed)
            enough = count >= least
            if not enough or not changed:
                break
            rigid(&p, &used[0], &fit[0])
        if enough:
            residuals(&p, &fit[0], eta)
            enough = fits(&p, eta, &used[0], &room[1, 0], count)
        if enough:
            for i in range(n):
                if used[i]:
                    w = weight_of(&p, i)
                    square, weighted, weights = square + eta[i] * eta[i], weighted + w * eta[i] * eta[i], weights + w
            normal_matrix(&p, &used[0], &fit[0], info)
            for i in range(9):
                spoilt[i] = info[i]
            changed = solve(spoilt, &inverse[0, 0], 3, 3)
    if not enough:
        return None
    freedom = <double>max(2 * count - FREEDOM, 1)
    scale = variance = square / freedom
    if own_sigma_m is not None:
        scale = max(weighted / freedom, 1.0)
        variance = scale * <double>count / weights
    if not changed:  # all points in one place: any rotation fits
        covariance = np.linalg.pinv(np.array([info[i] for i in range(9)]).reshape(3, 3))
    return fit_out, used_out.view(np.bool_), math.sqrt(square / <double>count), scale * covariance, variance
