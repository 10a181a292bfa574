# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The loops of reference.py over points, compiled. Tests hold the two together.

Cython rather than nanobind: setuptools builds it without CMake and without NumPy's headers, and typed memoryviews
refuse a wrong type, number of axes or layout before anything is read. Each function checks the shapes and computes
without the GIL; in there nothing checks an index but what is written. A literal is a double in C: where floats must
stay floats it is cast, or held by a float variable.
"""

import math

import numpy as np

from ceilvo.daemon.vision.kernel.arguments import check_length

from libc.math cimport INFINITY, fabs, fabsf, rintf
from libc.stdint cimport int8_t, int32_t, int64_t

cdef int8_t[4] GROUP_OF_QUARTER = [1, 3, 0, 2]


cdef unpack(tuple ends, Py_ssize_t points, Py_ssize_t *e):
    """The bounds of the four groups, which must rise from 0 to no more than there are points."""
    e[0], e[1], e[2], e[3], e[4] = ends
    if not (0 == e[0] <= e[1] <= e[2] <= e[3] <= e[4] <= points):
        raise ValueError(f"groups bounded by {ends}, expected rising bounds from 0 to {points} at most")


cdef check_lines(Py_ssize_t bad, const int32_t[::1] line, Py_ssize_t lines):
    if bad < line.shape[0]:
        raise ValueError(f"point {bad}: line {line[bad]} of {lines}")


cdef void group(
    const float[:, ::1] uv, const float[::1] phi, float turn, float gate, float scale, float[:, ::1] xy, int8_t[::1] groups,
    Py_ssize_t *ends
) noexcept nogil:
    """Args: turn: deg. gate: quarter turns."""
    cdef float t, nearest, per_quarter = <float>1 / <float>90
    cdef Py_ssize_t[4] at
    cdef Py_ssize_t i, n = phi.shape[0]
    cdef int g
    for i in range(n):
        t = (phi[i] - turn) * per_quarter
        nearest = rintf(t)
        g = GROUP_OF_QUARTER[<int>nearest & 3] if fabsf(t - nearest) < gate else 4
        groups[i] = <int8_t>g
        if g < 4:
            ends[g + 1] += 1
    for g in range(4):
        at[g] = ends[g]
        ends[g + 1] += ends[g]
    for i in range(n):
        g = groups[i]
        if g < 4:
            xy[0, at[g]], xy[1, at[g]] = uv[i, 0] * scale, uv[i, 1] * scale
            at[g] += 1


def split(const float[:, ::1] uv not None, const float[::1] phi not None, double psi_deg, double gate_deg, double scale):
    cdef Py_ssize_t n = phi.shape[0]
    check_length("uv", uv.shape[0], n)
    check_length("a point", uv.shape[1], 2)
    out = np.empty((2, n), np.float32)
    cdef float[:, ::1] xy = out
    cdef int8_t[::1] groups = np.empty(n, np.int8)
    cdef Py_ssize_t[5] e = [0, 0, 0, 0, 0]
    with nogil:
        group(uv, phi, <float>psi_deg, <float>(gate_deg / 90.0), <float>scale, xy, groups, e)
    return out[0, : e[4]], out[1, : e[4]], (e[0], e[1], e[2], e[3], e[4])


cdef void count_votes(
    const float *x, const float *y, const Py_ssize_t *e, const float *normal, Py_ssize_t stride, int64_t[:, ::1] votes
) noexcept nogil:
    cdef Py_ssize_t bins = votes.shape[1], i
    cdef float middle = <float>(bins // 2), most = <float>bins, c, s, cell
    cdef int64_t *mine
    cdef int g
    for g in range(4):
        c, s, mine, i = normal[g // 2 * 2], normal[g // 2 * 2 + 1], &votes[g, 0], e[g]
        while i < e[g + 1]:
            cell = c * x[i] + s * y[i] + middle
            if cell >= 0 and cell < most:
                mine[<Py_ssize_t>cell] += 1
            i += stride


def vote(
    const float[::1] x not None,
    const float[::1] y not None,
    tuple ends not None,
    tuple angles_rad not None,
    double scale,
    Py_ssize_t half,
    Py_ssize_t stride=1,
):
    cdef Py_ssize_t[5] e
    check_length("y", y.shape[0], x.shape[0])
    unpack(ends, x.shape[0], e)
    if half < 1 or stride < 1:
        raise ValueError(f"{half} bins to a side, every {stride}th point; expected 1 at least")
    cdef float[4] normal
    for i, angle in enumerate(angles_rad[:2]):
        normal[2 * i], normal[2 * i + 1] = scale * math.cos(angle), scale * math.sin(angle)
    out = np.zeros((4, 2 * half), np.int64)
    cdef int64_t[:, ::1] votes = out
    with nogil:
        count_votes(&x[0], &y[0], e, normal, stride, votes)
    return out


cdef void turn_back(
    const float *seen_x, const float *seen_y, Py_ssize_t begin, Py_ssize_t end, const float *turn, bint axis, float *rho,
    float *tangent
) noexcept nogil:
    cdef float c = turn[0], s = turn[1], a = turn[2], b = turn[3], one = 1, scale, x, y, first, second
    cdef Py_ssize_t i
    for i in range(begin, end):
        scale = one / (one + a * seen_y[i] - b * seen_x[i])
        x, y = (seen_x[i] + b) * scale, (seen_y[i] - a) * scale
        first, second = c * x + s * y, c * y - s * x
        rho[i] = second if axis else first
        tangent[i] = -first if axis else second


def project(
    const float[::1] x not None, const float[::1] y not None, Py_ssize_t half, double psi_rad, const double[:] tilt_rad not None
):
    cdef Py_ssize_t n = x.shape[0]
    check_length("y", y.shape[0], n)
    check_length("tilt_rad", tilt_rad.shape[0], 2)
    if not 0 <= half <= n:
        raise ValueError(f"{half} of {n} points belong to axis 0")
    out = np.empty((2, n), np.float32)
    cdef float[:, ::1] v = out
    cdef float[4] turn = [math.cos(psi_rad), math.sin(psi_rad), tilt_rad[0], tilt_rad[1]]
    with nogil:
        turn_back(&x[0], &y[0], 0, half, turn, False, &v[0, 0], &v[1, 0])
        turn_back(&x[0], &y[0], half, n, turn, True, &v[0, 0], &v[1, 0])
    return out[0], out[1]


cdef struct Points:
    const float *x
    const float *y
    const float *rho
    const float *tangent


cdef void give(
    const Points *points, const Py_ssize_t *e, const double *offset, const Py_ssize_t *first, double gate,
    float[:, ::1] out, int32_t *line, Py_ssize_t *kept
) noexcept nogil:
    """Points near a line of their group, and that line; kept: the groups' new bounds."""
    cdef float *x = &out[0, 0]
    cdef float *y = &out[1, 0]
    cdef float *rho = &out[2, 0]
    cdef float *tangent = &out[3, 0]
    cdef Py_ssize_t i, k, last, n = 0
    cdef float r
    cdef int g
    for g in range(4):
        k, last = first[g], first[g + 1] - 1
        for i in range(e[g], e[g + 1]):
            if k > last:
                break  # no lines in this group
            r = points.rho[i]
            # neighbours in the picture are mostly on the same line: walk from the last one
            while k < last and r - offset[k] > offset[k + 1] - r:
                k += 1
            while k > first[g] and offset[k] - r >= r - offset[k - 1]:
                k -= 1
            # written in any case: a branch would be guessed wrong as often as points are left out
            x[n], y[n], rho[n], tangent[n] = points.x[i], points.y[i], r, points.tangent[i]
            line[n] = <int32_t>k
            n += fabs(r - offset[k]) < gate
        kept[g + 1] = n


def assign(
    const float[::1] x not None,
    const float[::1] y not None,
    const float[::1] rho not None,
    const float[::1] tangent not None,
    tuple ends not None,
    const double[::1] offset not None,
    const int64_t[::1] counts not None,
    double gate,
):
    cdef Py_ssize_t n = x.shape[0], g
    cdef Py_ssize_t[5] e, first = [0, 0, 0, 0, 0], kept = [0, 0, 0, 0, 0]
    for name, items in (("y", y.shape[0]), ("rho", rho.shape[0]), ("tangent", tangent.shape[0])):
        check_length(name, items, n)
    check_length("counts", counts.shape[0], 4)
    unpack(ends, n, e)
    for g in range(4):
        if not 0 <= counts[g] <= offset.shape[0] - first[g]:
            raise ValueError(f"{list(counts)} lines a group, expected {offset.shape[0]} in all")
        first[g + 1] = first[g] + counts[g]
    out, line_out = np.empty((4, n), np.float32), np.empty(n, np.int32)
    cdef float[:, ::1] v = out
    cdef int32_t[::1] line = line_out
    cdef Points points = Points(&x[0], &y[0], &rho[0], &tangent[0])
    with nogil:
        give(&points, e, &offset[0], first, gate, v, &line[0], kept)
    x_out, y_out, rho_out, tangent_out = out[:, : kept[4]]
    return x_out, y_out, rho_out, tangent_out, line_out[: kept[4]], (0, kept[1], kept[2], kept[3], kept[4])


cdef Py_ssize_t widen(const float *tangent, const int32_t[::1] line, double[:, ::1] extent) noexcept nogil:
    cdef Py_ssize_t i, k
    for k in range(extent.shape[1]):
        extent[0, k], extent[1, k] = INFINITY, -INFINITY
    for i in range(line.shape[0]):
        k = line[i]
        if k < 0 or k >= extent.shape[1]:
            return i
        if tangent[i] < extent[0, k]:
            extent[0, k] = tangent[i]
        if tangent[i] > extent[1, k]:
            extent[1, k] = tangent[i]
    return line.shape[0]


def extents(const float[::1] tangent not None, const int32_t[::1] line not None, Py_ssize_t lines):
    cdef Py_ssize_t done
    check_length("tangent", tangent.shape[0], line.shape[0])
    out = np.empty((2, lines))
    cdef double[:, ::1] extent = out
    with nogil:
        done = widen(&tangent[0], line, extent)
    check_lines(done, line, lines)
    return out[0], out[1]


cdef Py_ssize_t average(
    const float *rho, const int32_t[::1] line, double focal, const double[::1] before, int64_t[::1] count, double[::1] mean
) noexcept nogil:
    cdef Py_ssize_t i = 0, begin, k
    cdef double total
    while i < line.shape[0]:
        k, begin, total = line[i], i, 0
        if k < 0 or k >= count.shape[0]:
            return i
        while i < line.shape[0] and line[i] == k:
            total += rho[i]
            i += 1
        count[k] += i - begin
        mean[k] += total
    for k in range(count.shape[0]):
        mean[k] = mean[k] / <double>count[k] * focal if count[k] else before[k]
    return line.shape[0]


def settle(
    const float[::1] x not None, const float[::1] y not None, const int32_t[::1] line not None, Py_ssize_t half,
    double psi_rad, const double[:] tilt_rad not None, double focal_px, const double[::1] offset_px not None
):
    cdef Py_ssize_t done
    rho, tangent = project(x, y, half, psi_rad, tilt_rad)
    check_length("line", line.shape[0], x.shape[0])
    cdef const float[::1] across = rho
    offset = np.zeros(offset_px.shape[0])
    cdef int64_t[::1] count = np.zeros(offset_px.shape[0], np.int64)
    cdef double[::1] mean = offset
    with nogil:
        done = average(&across[0], line, focal_px, offset_px, count, mean)
    check_lines(done, line, offset_px.shape[0])
    return rho, tangent, offset
