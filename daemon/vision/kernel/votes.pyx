# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""What points vote for, of reference.py, compiled; see points.pyx."""

import math

import numpy as np

from ceilvo.daemon.vision.kernel.arguments import check_length

from libc.math cimport fabsf
from libc.stdint cimport int64_t

include "groups.pxi"


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


cdef Py_ssize_t local_maxima(
    const int64_t[:, ::1] votes, double need, Py_ssize_t *ends, double *at, int64_t *strength
) noexcept nogil:
    cdef Py_ssize_t g, k, n = 0, bins = votes.shape[1]
    cdef int64_t before, here, after
    cdef double moment
    for g in range(votes.shape[0]):
        before, here = 0, votes[g, 0] + votes[g, 1] + votes[g, 2]  # sums of three bins; those at either end have none
        for k in range(1, bins - 1):
            after = votes[g, k] + votes[g, k + 1] + votes[g, k + 2] if k < bins - 2 else 0
            if here >= need and here > before and here >= after:
                strength[n] = here
                moment = <double>(votes[g, k + 1] - votes[g, k - 1]) / <double>here
                at[n] = <double>(k - bins // 2) + 0.5 + moment
                n += 1
            before, here = here, after
        ends[g + 1] = n
    return n


def peaks(const int64_t[:, ::1] votes not None, double need):
    cdef Py_ssize_t n, bins = votes.shape[1]
    cdef Py_ssize_t[5] e = [0, 0, 0, 0, 0]
    check_length("votes", votes.shape[0], 4)
    if bins < 3 or not need > 0:
        raise ValueError(f"{bins} bins, {need} votes needed; expected 3 at least, and more than 0")
    at_out, strength_out = np.empty(4 * bins), np.empty(4 * bins, np.int64)
    cdef double[::1] at = at_out
    cdef int64_t[::1] strength = strength_out
    with nogil:
        n = local_maxima(votes, need, e, &at[0], &strength[0])
    return at_out[:n], strength_out[:n], (e[0], e[1], e[2], e[3], e[4])


cdef inline float modulo_90(float deg) noexcept nogil:
    cdef float large = 12582912, turns = deg * (<float>1 / <float>90), whole  # 1.5 * 2^23 has no fraction
    whole = (turns + large) - large
    whole -= <float>(whole > turns)
    return deg - <float>90 * whole


cdef double near_peak(const float *phi, Py_ssize_t stride, float *folded, Py_ssize_t n, float reach) noexcept nogil:
    cdef int64_t[90] votes
    cdef int64_t three, most = -1
    cdef Py_ssize_t i, k, best = 0, near = 0
    cdef float off, from_peak, half = 45
    cdef double total = 0
    for k in range(90):
        votes[k] = 0
    for i in range(n):
        folded[i] = modulo_90(phi[i * stride])
    for i in range(n):
        k = <Py_ssize_t>folded[i]
        votes[0 if k < 0 else 89 if k > 89 else k] += 1  # rounding may reach 90, or fall below 0
    for k in range(90):
        three = votes[(k + 89) % 90] + votes[k] + votes[(k + 1) % 90]
        if three > most:
            best, most = k, three
    from_peak = <float>best + <float>0.5 - half
    for i in range(n):
        off = modulo_90(folded[i] - from_peak) - half
        if fabsf(off) < reach:
            total += off
            near += 1
    return <double>best + 0.5 + total / <double>near


def direction(const float[::1] phi not None, double reach_deg, Py_ssize_t stride):
    cdef Py_ssize_t n = (phi.shape[0] + stride - 1) // stride if stride > 0 else 0
    if n < 1 or not reach_deg > 1:
        raise ValueError(f"every {stride}th of {phi.shape[0]} points, {reach_deg} deg; expected points, and 1 at least")
    cdef float[::1] folded = np.empty(n, np.float32)
    cdef double found
    with nogil:
        found = near_peak(&phi[0], stride, &folded[0], n, <float>reach_deg)
    return found
