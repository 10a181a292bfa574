# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""level_points of in_picture.py, compiled; see points.pyx."""

import cv2
import numpy as np

from libc.math cimport fabsf, sqrtf
from libc.stdint cimport UINT16_MAX, int16_t, int32_t, uint8_t, uint16_t, uint64_t
from libc.string cimport memcpy

include "picture.pxi"

cdef enum:
    BLOCK = 64  # points that are computed together; chosen: 6 kB, which stays near


cdef struct Points:
    float *uv  # where the next ones go
    float *phi
    Py_ssize_t count


cdef check_pixels(str name, Py_ssize_t height, Py_ssize_t width, const Picture *p):
    if height != p.height or width != p.width:
        raise ValueError(f"{name} of {height} x {width} pixels, expected {p.height} x {p.width} as dx")


cdef Picture picture_of(
    const int16_t[:, ::1] dx, const int16_t[:, ::1] dy, const float[:, :, ::1] lookup, const float[:, ::1] rows
) except *:
    cdef Picture p
    p.height, p.width, p.columns = dx.shape[0], dx.shape[1], lookup.shape[1]
    check_pixels("dy", dy.shape[0], dy.shape[1], &p)
    arguments.check_length("a cell of the look-up", lookup.shape[2], 2)
    check_rows(rows, p.height)
    p.dx, p.dy, p.lookup, p.rows = &dx[0, 0], &dy[0, 0], &lookup[0, 0, 0], NULL if rows is None else &rows[0, 0]
    return p


cdef inline float degrees(float y, float x) noexcept nogil:
    """Angle of (x, y), [0, 360); minimax polynomial of the arc tangent, within 0.001 degrees."""
    cdef float ax = fabsf(x), ay = fabsf(y), two = 2, turn = 360
    cdef float low = ax if ax < ay else ay, high = ax if ax > ay else ay
    cdef float t = low / high if high > 0 else <float>0, q = t * t
    cdef float a = t * (<float>0.99997726 + q * (<float>-0.33262347 + q * (<float>0.19354346 + q * (
        <float>-0.11643287 + q * (<float>0.05265332 + q * <float>-0.01172120)))))
    a *= <float>57.29577951
    # edges point anywhere: a branch would be guessed wrong half of the time
    a += <float>(ay > ax) * (<float>90 - two * a)
    a += <float>(x < 0) * (<float>180 - two * a)
    a += <float>(y < 0) * (turn - two * a)
    return a - <float>(a >= turn) * turn


cdef inline float square(const Picture *p, Py_ssize_t at) noexcept nogil:
    cdef float x = p.dx[at], y = p.dy[at]
    return x * x + y * y


cdef struct Block:
    # Points, each kind of figure of them in a row: loops over rows need no branch, so that four are computed at once.
    Py_ssize_t count
    int32_t[BLOCK] y
    float[BLOCK] gx, gy, by_x, before, here, after, fx, fy
    float[BLOCK] low_u, right_u, up_u, both_u, low_v, right_v, up_v, both_v
    float[BLOCK] u, u_by_x, u_by_y, v, v_by_x, v_by_y, phi


cdef inline void gather(const Picture *p, Py_ssize_t x, Py_ssize_t y, Block *b) noexcept nogil:
    """Add what has to be read of a pixel."""
    cdef Py_ssize_t at = y * p.width + x, i = b.count, beside
    cdef float gx = p.dx[at], gy = p.dy[at]
    cdef bint horizontal = fabsf(gx) >= fabsf(gy)
    cdef const float *low = corners_of(p, x, y)
    cdef const float *up = low + 2 * p.columns
    beside = p.width + horizontal * (1 - p.width)
    b.y[i], b.gx[i], b.gy[i], b.by_x[i] = <int32_t>y, gx, gy, <float>horizontal
    b.before[i], b.here[i], b.after[i] = square(p, at - beside), square(p, at), square(p, at + beside)
    b.fx[i], b.fy[i] = within_cell(x), within_cell(y)
    b.low_u[i], b.low_v[i], b.right_u[i], b.right_v[i] = low[0], low[1], low[2], low[3]
    b.up_u[i], b.up_v[i], b.both_u[i], b.both_v[i] = up[0], up[1], up[2], up[3]
    b.count = i + 1


cdef void place(Block *b) noexcept nogil:
    """As locate() does, all points of a block."""
    cdef Py_ssize_t i
    cdef float one = 1, shift, shift_x, shift_y
    cdef float[3] u, v
    for i in range(b.count):
        shift = peak_shift(sqrtf(b.before[i]), sqrtf(b.here[i]), sqrtf(b.after[i]))
        shift_x, shift_y = shift * b.by_x[i], shift * (one - b.by_x[i])
        interpolate(b.low_u[i], b.right_u[i], b.up_u[i], b.both_u[i], b.fx[i], b.fy[i], shift_x, shift_y, u)
        interpolate(b.low_v[i], b.right_v[i], b.up_v[i], b.both_v[i], b.fx[i], b.fy[i], shift_x, shift_y, v)
        b.u[i], b.u_by_x[i], b.u_by_y[i] = u[0], u[1], u[2]
        b.v[i], b.v_by_x[i], b.v_by_y[i] = v[0], v[1], v[2]
        b.after[i] = shift_y


cdef void bring_to_one_instant(const float *rows, Block *b) noexcept nogil:
    cdef Py_ssize_t i
    cdef Place at
    for i in range(b.count):
        at.uv[0], at.along_x[0], at.along_y[0] = b.u[i], b.u_by_x[i], b.u_by_y[i]
        at.uv[1], at.along_x[1], at.along_y[1] = b.v[i], b.v_by_x[i], b.v_by_y[i]
        to_one_instant(rows + 4 * b.y[i], b.after[i], &at)
        b.u[i], b.u_by_x[i], b.u_by_y[i] = at.uv[0], at.along_x[0], at.along_y[0]
        b.v[i], b.v_by_x[i], b.v_by_y[i] = at.uv[1], at.along_x[1], at.along_y[1]


cdef void empty(const Picture *p, Block *b, Points *to) noexcept nogil:
    """Compute a block's points and write them where the last ones end."""
    cdef Py_ssize_t i
    place(b)
    if p.rows != NULL:
        bring_to_one_instant(p.rows, b)
    for i in range(b.count):
        b.phi[i] = degrees(
            b.u_by_x[i] * b.gy[i] - b.u_by_y[i] * b.gx[i], b.v_by_y[i] * b.gx[i] - b.v_by_x[i] * b.gy[i]
        )
    for i in range(b.count):
        to.uv[2 * i], to.uv[2 * i + 1] = b.u[i], b.v[i]
    memcpy(to.phi, b.phi, b.count * sizeof(float))
    to.uv, to.phi, to.count = to.uv + 2 * b.count, to.phi + b.count, to.count + b.count
    b.count = 0


cdef Py_ssize_t points_of(
    const Picture *p, const uint8_t *mask, const uint16_t *rank, Py_ssize_t limit, Points to
) noexcept nogil:
    cdef Py_ssize_t x, y, at
    cdef uint64_t eight
    cdef Block b
    b.count = 0
    for y in range(1, p.height - 1):  # a neighbour on every side
        x = 0
        while x < p.width - 2:
            x += 1
            at = y * p.width + x
            if not mask[at]:
                while x + 8 < p.width - 1:
                    memcpy(&eight, mask + at, 8)
                    if eight:
                        break
                    x, at = x + 8, at + 8
                if not mask[at]:
                    continue
            if limit < UINT16_MAX and rank[at] >= limit:
                continue
            gather(p, x, y, &b)
            if b.count == BLOCK:
                empty(p, &b, &to)
    empty(p, &b, &to)
    return to.count


def level_points(
    const uint8_t[:, ::1] mask not None, const int16_t[:, ::1] dx not None, const int16_t[:, ::1] dy not None,
    const float[:, :, ::1] lookup not None, const uint16_t[:, ::1] rank not None, Py_ssize_t limit,
    const float[:, ::1] rows=None
):
    cdef Picture p = picture_of(dx, dy, lookup, rows)
    check_pixels("mask", mask.shape[0], mask.shape[1], &p)
    check_pixels("rank", rank.shape[0], rank.shape[1], &p)
    arguments.check_lookup((lookup.shape[0], lookup.shape[1]), (p.height, p.width))
    cdef Py_ssize_t n, room = cv2.countNonZero(np.asarray(mask))
    uv_px, phi_deg = np.empty((room, 2), np.float32), np.empty(room, np.float32)
    cdef float[:, ::1] uv = uv_px
    cdef float[::1] phi = phi_deg
    with nogil:
        n = points_of(&p, &mask[0, 0], &rank[0, 0], limit, Points(&uv[0, 0], &phi[0], 0))
    return uv_px[:n], phi_deg[:n]
