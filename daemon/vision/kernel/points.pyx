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

from libc.math cimport INFINITY, fabs, fabsf
from libc.stdint cimport int8_t, int16_t, int32_t, int64_t

cdef int8_t[5] GROUP_OF_QUARTER = [1, 3, 0, 2, 4]


include "groups.pxi"

cdef enum:
    CELLS = 256  # in which a line is looked up; chosen: most hold no boundary between two lines


cdef check_lines(Py_ssize_t bad, const int32_t[::1] line, Py_ssize_t lines):
    if bad < line.shape[0]:
        raise ValueError(f"point {bad}: line {line[bad]} of {lines}")


cdef void group(
    const float[:, ::1] uv, const float[::1] phi, float turn, float gate, float scale, float[:, ::1] xy, int8_t[::1] quarters,
    Py_ssize_t *ends
) noexcept nogil:
    """Args: turn: deg. gate: quarter turns. Points of no group stand after the others."""
    if phi.shape[0] == 0:
        return
    cdef float t, nearest, per_quarter = <float>1 / <float>90
    cdef float large = 12582912  # 1.5 * 2^23: a float of this size has no fraction
    cdef const float *u = &uv[0, 0]
    cdef const float *angle = &phi[0]
    cdef float *x = &xy[0, 0]
    cdef float *y = &xy[1, 0]
    cdef int8_t *quarter = &quarters[0]
    cdef Py_ssize_t[5] at
    cdef Py_ssize_t i, k, n = phi.shape[0]
    cdef int32_t found
    cdef int g
    for i in range(n):
        t = (angle[i] - turn) * per_quarter
        nearest = (t + large) - large  # rintf of a small one; a loop without calls computes four at once
        quarter[i] = <int8_t>(<int>nearest & 3) if fabsf(t - nearest) < gate else 4
    for g in range(4):
        found = 0  # in a loop of its own each: one counter after the other in memory would be waited for
        for i in range(n):
            found += quarter[i] == g
        ends[GROUP_OF_QUARTER[g] + 1] = found
    for g in range(5):
        at[g] = ends[g]
        ends[g + 1] += ends[g]
    for i in range(n):
        g = GROUP_OF_QUARTER[quarter[i]]
        k = at[g]
        x[k], y[k] = u[2 * i] * scale, u[2 * i + 1] * scale
        at[g] = k + 1


def split(const float[:, ::1] uv not None, const float[::1] phi not None, double psi_deg, double gate_deg, double scale):
    cdef Py_ssize_t n = phi.shape[0]
    check_length("uv", uv.shape[0], n)
    check_length("a point", uv.shape[1], 2)
    out = np.empty((2, n), np.float32)
    cdef float[:, ::1] xy = out
    cdef int8_t[::1] quarters = np.empty(n, np.int8)
    cdef Py_ssize_t[6] e = [0, 0, 0, 0, 0, 0]
    with nogil:
        group(uv, phi, <float>psi_deg, <float>(gate_deg / 90.0), <float>scale, xy, quarters, e)
    return out[0, : e[4]], out[1, : e[4]], (e[0], e[1], e[2], e[3], e[4])


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


cdef void guesses(const double *offset, Py_ssize_t begin, Py_ssize_t end, double low, double per_cell, int16_t *guess) noexcept nogil:
    """For each of CELLS even cells of offsets from `low` on, the line that is nearest at its lower end."""
    cdef Py_ssize_t cell, k = begin
    for cell in range(CELLS):
        while k + 1 < end and low + <double>cell * per_cell > 0.5 * (offset[k] + offset[k + 1]):
            k += 1
        guess[cell] = <int16_t>k


cdef void give(
    const Points *points, const Py_ssize_t *e, const double *offset, const Py_ssize_t *first, double gate,
    float[:, ::1] out, int32_t *line, Py_ssize_t *kept
) noexcept nogil:
    """Points near a line of their group, and that line; kept: the groups' new bounds."""
    cdef float *x = &out[0, 0]
    cdef float *y = &out[1, 0]
    cdef float *rho = &out[2, 0]
    cdef float *tangent = &out[3, 0]
    cdef int16_t[CELLS] guess
    cdef Py_ssize_t i, k, last, n = 0
    cdef float r, cell, low, cells_per_ray, most = CELLS - 1
    cdef double width
    cdef int g
    for g in range(4):
        kept[g + 1] = n
        last = first[g + 1] - 1
        if last < first[g]:
            continue  # no lines in this group
        low = <float>offset[first[g]]
        width = (offset[last] - low) / <double>CELLS
        guesses(offset, first[g], first[g + 1], low, width, guess)
        cells_per_ray = <float>(1.0 / width) if width > 0 else <float>0
        for i in range(e[g], e[g + 1]):
            r = points.rho[i]
            # looked up: walking from the last point's line takes steps that the processor guesses wrong
            cell = (r - low) * cells_per_ray
            cell = cell if cell > 0 else <float>0
            k = guess[<Py_ssize_t>(cell if cell < most else most)]
            while k < last and r - offset[k] > offset[k + 1] - r:
                k += 1
            while k > first[g] and offset[k] - r >= r - offset[k - 1]:
                k -= 1
            # written in any case: a branch would be guessed wrong as often as points are left out
            x[n], y[n], rho[n], tangent[n] = points.x[i], points.y[i], r, points.tangent[i]
            line[n] = <int32_t>k
            n += fabs(r - offset[k]) < gate
        kept[g + 1] = n


cdef bint sort_lines(
    const double *offset, const int64_t *group, Py_ssize_t lines, Py_ssize_t *first, double *rising, int32_t *order
) noexcept nogil:
    """Lines group after group, rising within each; first: the groups' bounds. False where a group is none."""
    cdef Py_ssize_t i, k
    cdef int g
    for i in range(lines):
        if not 0 <= group[i] < 4:
            return False
        first[group[i] + 1] += 1
    for g in range(4):
        first[g + 1] += first[g]
    for i in range(lines):  # they mostly are in order: one is put in behind the others by a step or none
        k = i
        while k > 0 and (
            group[order[k - 1]] > group[i] or (group[order[k - 1]] == group[i] and offset[order[k - 1]] > offset[i])
        ):
            order[k] = order[k - 1]
            k -= 1
        order[k] = <int32_t>i
    for i in range(lines):
        rising[i] = offset[order[i]]
    return True


def assign(
    const float[::1] x not None,
    const float[::1] y not None,
    const float[::1] rho not None,
    const float[::1] tangent not None,
    tuple ends not None,
    const double[::1] offset not None,
    const int64_t[::1] group not None,
    double gate,
):
    cdef Py_ssize_t n = x.shape[0], lines = offset.shape[0], i
    cdef Py_ssize_t[5] e, first = [0, 0, 0, 0, 0], kept = [0, 0, 0, 0, 0]
    for name, items in (("y", y.shape[0]), ("rho", rho.shape[0]), ("tangent", tangent.shape[0])):
        check_length(name, items, n)
    check_length("group", group.shape[0], lines)
    if lines > 32767:  # int16
        raise ValueError(f"{lines} lines, expected 32767 at most")
    unpack(ends, n, e)
    out, line_out = np.empty((4, n), np.float32), np.empty(n, np.int32)
    cdef float[:, ::1] v = out
    cdef int32_t[::1] line = line_out, order = np.empty(lines, np.int32)
    cdef double[::1] rising = np.empty(lines)
    cdef Points points = Points(&x[0], &y[0], &rho[0], &tangent[0])
    cdef bint sorted_
    with nogil:
        sorted_ = sort_lines(&offset[0], &group[0], lines, first, &rising[0], &order[0])
        if sorted_:
            give(&points, e, &rising[0], first, gate, v, &line[0], kept)
            for i in range(kept[4]):
                line[i] = order[line[i]]
    if not sorted_:
        raise ValueError(f"lines of groups {sorted(set(np.asarray(group).tolist()))}, expected 0 to 3")
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
