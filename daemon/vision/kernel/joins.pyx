# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""From edges to lines and where they reach: functions of of_lines.py, compiled; see points.pyx."""

import math

import numpy as np

from ceilvo.daemon.vision.kernel.arguments import check_length

from libc.math cimport hypot
from libc.stdint cimport int32_t, int64_t, uint8_t


# -- edges that are one line


cdef inline bint before(const double[::1] offset, const int64_t[::1] group, Py_ssize_t a, Py_ssize_t b) noexcept nogil:
    return group[a] // 2 < group[b] // 2 or (group[a] // 2 == group[b] // 2 and offset[a] < offset[b])


cdef Py_ssize_t sorted_edges(
    const double[::1] offset, const int64_t[::1] group, const int64_t[::1] support, double least, int64_t *order
) noexcept nogil:
    """How many edges have enough points; order: these by axis and offset."""
    cdef Py_ssize_t i, k, n = 0
    for i in range(offset.shape[0]):
        if <double>support[i] >= least:
            k = n
            while k > 0 and before(offset, group, i, order[k - 1]):
                order[k] = order[k - 1]
                k -= 1
            order[k] = i
            n += 1
    return n


cdef Py_ssize_t distinct(
    const double[::1] offset, const int64_t[::1] group, const int64_t[::1] support, double same, int64_t *order,
    uint8_t *drop, Py_ssize_t n
) noexcept nogil:
    """How many edges are left without those close to a stronger one of their group; order: only these."""
    cdef Py_ssize_t i, last, kept = 0
    cdef int g
    for i in range(n):
        drop[i] = False
    for g in range(4):
        last = -1
        for i in range(n):
            if group[order[i]] != g:
                continue
            if last >= 0 and offset[order[i]] - offset[order[last]] < same:
                drop[last if support[order[last]] < support[order[i]] else i] = True
            last = i
    for i in range(n):
        if not drop[i]:
            order[kept] = order[i]
            kept += 1
    return kept


cdef inline bint beside(const double[::1] start, const double[::1] end, Py_ssize_t a, Py_ssize_t b) noexcept nogil:
    """Whether a part of one edge lies beside a part of the other."""
    return min(end[a], end[b]) > max(start[a], start[b])


cdef void pair(
    const double[::1] offset, const int64_t[::1] group, const int64_t[::1] support, const double[::1] start,
    const double[::1] end, double groove, double narrow, const int64_t *order, Py_ssize_t n,
    int64_t *partner, int64_t *ranked, double *score
) noexcept nogil:
    """partner: of every edge in order, or -1. ranked, score: room for n each."""
    cdef Py_ssize_t i, k, a, b, found = 0
    cdef double gap
    for i in range(n):
        partner[i] = -1
    for i in range(n - 1):
        a, b = order[i], order[i + 1]
        gap = offset[b] - offset[a]
        if group[a] // 2 != group[b] // 2 or group[a] == group[b] or not (gap < groove and beside(start, end, a, b)):
            continue
        score[i] = <double>min(support[a], support[b]) / (gap if gap > narrow else narrow)
        k = found
        while k > 0 and score[i] > score[ranked[k - 1]]:
            ranked[k] = ranked[k - 1]
            k -= 1
        ranked[k] = i
        found += 1
    for k in range(found):
        i = ranked[k]
        if partner[i] < 0 and partner[i + 1] < 0:
            partner[i], partner[i + 1] = i + 1, i


def join(
    const double[::1] offset_px not None, const double[::1] sigma_px not None, const int64_t[::1] group not None,
    const int64_t[::1] support not None, const double[::1] start_px not None, const double[::1] end_px not None,
    double least, widths
):
    cdef double same = widths.same_px, groove = widths.groove_px, narrow = widths.narrow_px
    cdef Py_ssize_t n = offset_px.shape[0], i, a, b, m, lines = 0
    for name, items in (
        ("sigma_px", sigma_px.shape[0]), ("group", group.shape[0]), ("support", support.shape[0]),
        ("start_px", start_px.shape[0]), ("end_px", end_px.shape[0]),
    ):
        check_length(name, items, n)
    order_out, new_out, whole, real = (
        np.empty(n, np.int64), np.full(n, -1, np.int64), np.empty((5, n), np.int64), np.empty((3, n))
    )
    cdef int64_t[::1] order = order_out, new_of_old = new_out
    cdef int64_t[:, ::1] w = whole  # axis, kind, support; partner, rank
    cdef double[:, ::1] r = real  # offset, sigma; score
    cdef uint8_t[::1] drop = np.empty(n, np.uint8)
    if n == 0:
        return order_out, new_out, whole[0], real[0], real[1], whole[1], whole[2]
    with nogil:
        m = sorted_edges(offset_px, group, support, least, &order[0])
        m = distinct(offset_px, group, support, same, &order[0], &drop[0], m) if m >= 2 else 0
        pair(
            offset_px, group, support, start_px, end_px, groove, narrow, &order[0], m, &w[3, 0], &w[4, 0], &r[2, 0]
        )
        for i in range(m):
            a = order[i]
            if w[3, i] >= 0 and w[3, i] < i:
                new_of_old[a] = new_of_old[order[w[3, i]]]
                continue
            new_of_old[a] = lines
            w[0, lines] = group[a] // 2
            if w[3, i] >= 0:
                b = order[w[3, i]]
                w[1, lines], w[2, lines] = 0, support[a] + support[b]
                r[0, lines], r[1, lines] = 0.5 * (offset_px[a] + offset_px[b]), 0.5 * hypot(sigma_px[a], sigma_px[b])
            else:
                w[1, lines], w[2, lines] = 2 * (group[a] % 2) - 1, support[a]
                r[0, lines], r[1, lines] = offset_px[a], sigma_px[a]
            lines += 1
    axis, kind, points = whole[:3, :lines]
    return order_out[:m], new_out, axis, real[0, :lines], real[1, :lines], kind, points


def picture(
    const float[::1] rho not None, const float[::1] tangent not None, const int32_t[::1] line not None, Py_ssize_t half,
    double psi_rad, double focal_px, const int64_t[::1] new_of_old not None
):
    cdef Py_ssize_t n = line.shape[0], i, m = 0
    check_length("rho", rho.shape[0], n)
    check_length("tangent", tangent.shape[0], n)
    if not 0 <= half <= n:
        raise ValueError(f"{half} of {n} points belong to axis 0")
    for i in range(n):
        if line[i] < 0 or line[i] >= new_of_old.shape[0]:
            raise ValueError(f"point {i}: line {line[i]} of {new_of_old.shape[0]}")
    uv_out, line_out = np.empty((n, 2), np.float32), np.empty(n, np.int64)
    cdef float[:, ::1] uv = uv_out
    cdef int64_t[::1] of = line_out
    cdef float c = <float>math.cos(psi_rad), s = <float>math.sin(psi_rad), f = <float>focal_px, first, second
    with nogil:
        for i in range(n):
            if new_of_old[line[i]] < 0:
                continue
            first = rho[i] if i < half else -tangent[i]
            second = tangent[i] if i < half else rho[i]
            uv[m, 0], uv[m, 1], of[m] = (c * first - s * second) * f, (s * first + c * second) * f, new_of_old[line[i]]
            m += 1
    return uv_out[:m], line_out[:m]


# -- lines that reach their crossings


cdef Py_ssize_t mark(
    const float[:, ::1] points, const int64_t[::1] point_line, const int32_t[::1] row, float x, float y, float low,
    int32_t[:, ::1] total
) noexcept nogil:
    """1 behind each bin of a row with a point in it; the first point of no line, else how many there are."""
    cdef Py_ssize_t i, k, bins = total.shape[1] - 1
    cdef float along
    for i in range(point_line.shape[0]):
        if point_line[i] < 0 or point_line[i] >= row.shape[0]:
            return i
        k = row[point_line[i]]
        along = x * points[i, 0] + y * points[i, 1] - low
        if k >= 0 and along >= 0 and along < <float>bins:
            total[k, <Py_ssize_t>along + 1] = 1
    return point_line.shape[0]


def arms(
    const float[:, ::1] points not None, const int64_t[::1] point_line not None, const int32_t[::1] row not None,
    const double[::1] normal not None, const double[::1] at_px not None, arm
):
    cdef double reach = arm.reach_px, corner = arm.corner_px, bin_px = arm.bin_px, need = arm.need, low, high
    cdef Py_ssize_t rows = 0, n = at_px.shape[0], i, k, bins, done, a, b
    check_length("points", points.shape[0], point_line.shape[0])
    check_length("a point", points.shape[1], 2)
    check_length("normal", normal.shape[0], 2)
    for k in range(row.shape[0]):
        rows = max(rows, row[k] + 1)
    out = np.zeros((rows, n), np.uint8)
    if rows == 0 or n == 0:
        return out.view(np.bool_)
    low = high = at_px[0]
    for i in range(n):
        low, high = min(low, at_px[i]), max(high, at_px[i])
    low -= reach + 2.0 * bin_px
    bins = <Py_ssize_t>((high - low + (reach + 2.0 * bin_px)) / bin_px) + 2
    cdef uint8_t[:, ::1] covered = out
    cdef int32_t[:, ::1] total = np.zeros((rows, bins + 1), np.int32)
    cdef Py_ssize_t[:, ::1] cell = np.empty((n, 4), np.intp)
    cdef float x = <float>(normal[0] / bin_px), y = <float>(normal[1] / bin_px)
    with nogil:
        done = mark(points, point_line, row, x, y, <float>(low / bin_px), total)
        for i in range(n):
            cell[i, 0] = <Py_ssize_t>((at_px[i] - reach - low) / bin_px)
            cell[i, 1] = <Py_ssize_t>((at_px[i] - corner - low) / bin_px)
            cell[i, 2] = <Py_ssize_t>((at_px[i] + corner - low) / bin_px)
            cell[i, 3] = <Py_ssize_t>((at_px[i] + reach - low) / bin_px)
        for k in range(rows):
            for i in range(bins):
                total[k, i + 1] += total[k, i]
            for i in range(n):
                a = total[k, cell[i, 2] + 1] - total[k, cell[i, 0]]
                b = total[k, cell[i, 3] + 1] - total[k, cell[i, 1]]
                covered[k, i] = <double>max(a, b) >= need
    if done < point_line.shape[0]:
        raise ValueError(f"point {done}: line {point_line[done]} of {row.shape[0]}")
    return out.view(np.bool_)
