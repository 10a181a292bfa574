# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""The homography of reference.py, compiled; see views.pyx."""

import numpy as np

from ceilvo.daemon.odometry.kernel.arguments import check_length, check_pairs

from libc.math cimport hypot, sqrt
from libc.stdint cimport uint8_t

include "../../vision/kernel/solve.pxi"

cdef enum:
    UNKNOWNS = 8

cdef double MIN_SPREAD = 1e-12


cdef void normaliser(const double[:, ::1] p, const uint8_t[::1] kept, double *out) noexcept nogil:
    """Scale and centre."""
    cdef double n = 0.0, x = 0.0, y = 0.0, spread = 0.0
    cdef Py_ssize_t i
    for i in range(p.shape[0]):
        if kept[i]:
            n, x, y = n + 1.0, x + p[i, 0], y + p[i, 1]
    x, y = x / n, y / n
    for i in range(p.shape[0]):
        if kept[i]:
            spread += hypot(p[i, 0] - x, p[i, 1] - y)
    spread = spread / n
    out[0], out[1], out[2] = sqrt(2.0) / (spread if spread > MIN_SPREAD else MIN_SPREAD), x, y


cdef bint homography(
    const double[:, ::1] xy, const double[:, ::1] uv, const uint8_t[::1] kept, const double *f, const double *t, double *m
) noexcept nogil:
    """m: (8,), m9 is 1; f, t: what normalises xy and uv."""
    cdef double[UNKNOWNS * UNKNOWNS] a
    cdef double[UNKNOWNS] row
    cdef double x, y, side
    cdef Py_ssize_t i, r, c
    cdef int own
    for r in range(UNKNOWNS):
        m[r] = 0.0
    for r in range(UNKNOWNS * UNKNOWNS):
        a[r] = 0.0
    for i in range(xy.shape[0]):
        if not kept[i]:
            continue
        x, y = (xy[i, 0] - f[1]) * f[0], (xy[i, 1] - f[2]) * f[0]
        for own in range(2):
            side = (uv[i, own] - t[1 + own]) * t[0]
            for r in range(6):
                row[r] = 0.0
            row[3 * own], row[3 * own + 1], row[3 * own + 2], row[6], row[7] = x, y, 1.0, -x * side, -y * side
            for r in range(UNKNOWNS):
                m[r] += row[r] * side
                for c in range(UNKNOWNS):
                    a[r * UNKNOWNS + c] += row[r] * row[c]
    return solve(a, m, UNKNOWNS, 1)


def homography_residuals(const double[:, ::1] xy not None, const double[:, ::1] uv not None, kept not None):
    cdef Py_ssize_t n = xy.shape[0], i
    cdef const uint8_t[::1] mask = kept.view(np.uint8)
    check_pairs((n, xy.shape[1]), (uv.shape[0], uv.shape[1]))
    check_length("kept", mask.shape[0], n)
    out = np.empty(n)
    cdef double[::1] off = out
    cdef double[3] f, t
    cdef double[UNKNOWNS] m
    cdef double x, y, w
    cdef bint good
    with nogil:
        normaliser(xy, mask, f)
        normaliser(uv, mask, t)
        good = homography(xy, uv, mask, f, t, m)
        for i in range(n):
            x, y = (xy[i, 0] - f[1]) * f[0], (xy[i, 1] - f[2]) * f[0]
            w = (m[6] * x + m[7] * y + 1.0) * t[0]
            off[i] = hypot(
                (m[0] * x + m[1] * y + m[2]) / w + t[1] - uv[i, 0], (m[3] * x + m[4] * y + m[5]) / w + t[2] - uv[i, 1]
            )
    if not good:
        raise np.linalg.LinAlgError("Singular matrix")
    return out
