# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""level_points of in_picture.py, compiled; see points.pyx."""

import cv2
import numpy as np

from libc.math cimport fabsf, sqrtf
from libc.stdint cimport UINT16_MAX, int16_t, int32_t, uint8_t, uint16_t, uint64_t
from libc.string cimport memcpy

include "picture.pxi"


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


cdef inline float magnitude(const Picture *p, Py_ssize_t at) noexcept nogil:
    cdef float x = p.dx[at], y = p.dy[at]
    return sqrtf(x * x + y * y)


cdef Py_ssize_t points_of(
    const Picture *p, const uint8_t *mask, const uint16_t *rank, Py_ssize_t limit, float *uv, float *phi, Py_ssize_t room
) noexcept nogil:
    cdef Py_ssize_t x, y, at, out = 0, beside
    cdef uint64_t eight
    cdef float gx, gy
    cdef bint horizontal
    cdef Place place
    for y in range(1, p.height - 1):  # a neighbour on every side
        x = 0
        while x < p.width - 2 and out < room:
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
            gx, gy = p.dx[at], p.dy[at]
            horizontal = fabsf(gx) >= fabsf(gy)
            beside = p.width + horizontal * (1 - p.width)
            locate(
                p, x, y, horizontal, magnitude(p, at - beside), magnitude(p, at), magnitude(p, at + beside), &place
            )
            uv[2 * out], uv[2 * out + 1] = place.uv[0], place.uv[1]
            phi[out] = degrees(
                place.along_x[0] * gy - place.along_y[0] * gx, place.along_y[1] * gx - place.along_x[1] * gy
            )
            out += 1
    return out


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
        n = points_of(&p, &mask[0, 0], &rank[0, 0], limit, &uv[0, 0], &phi[0], room)
    return uv_px[:n], phi_deg[:n]
