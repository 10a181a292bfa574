# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""How far apart things are: functions of reference.py, compiled; see points.pyx."""

import numpy as np

from ceilvo.daemon.vision.kernel.arguments import check_length

from libc.math cimport fabs
from libc.stdint cimport int32_t, int64_t, uint8_t


cdef double chosen(double *v, Py_ssize_t n, Py_ssize_t rank) noexcept nogil:
    """The item that would stand at rank were v sorted (Hoare 1961); v is put out of order."""
    cdef Py_ssize_t low = 0, high = n - 1, i, j
    cdef double pivot, x
    while low < high:
        pivot, i, j = v[(low + high) // 2], low, high
        while i <= j:
            while v[i] < pivot:
                i += 1
            while v[j] > pivot:
                j -= 1
            if i <= j:
                x = v[i]
                v[i] = v[j]
                v[j] = x
                i, j = i + 1, j - 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return v[rank]


def spread(
    const float[::1] rho not None, const int32_t[::1] line not None, const double[::1] offset_px not None, double focal_px,
    Py_ssize_t stride
):
    cdef Py_ssize_t i, k = 0, n = line.shape[0], lines = offset_px.shape[0], room
    cdef float focal = <float>focal_px
    cdef double middle = 0
    check_length("rho", rho.shape[0], n)
    if stride < 1:
        raise ValueError(f"every {stride}th point; expected 1 at least")
    room = (n + stride - 1) // stride
    if room == 0:
        return 0.0
    cdef double[::1] off = np.empty(room)
    with nogil:
        while k < room:
            i = k * stride
            if line[i] < 0 or line[i] >= lines:
                break
            off[k] = fabs(<double>(rho[i] * focal) - offset_px[line[i]])
            k += 1
        if k == room:
            middle = chosen(&off[0], room, room // 2)
    if k < room:
        raise ValueError(f"point {k * stride}: line {line[k * stride]} of {lines}")
    return middle


def crowd(const float[:, ::1] xy not None, double within):
    cdef Py_ssize_t n = xy.shape[0], i, j
    cdef float most = <float>(within * within), x, y
    check_length("a point", xy.shape[1], 2)
    order = np.argsort(xy[:, 0])  # from left to right: only a strip to the left of each can be near
    cdef const float[:, ::1] at = np.asarray(xy)[order]
    sorted_near = np.zeros(n, np.int64)
    cdef int64_t[::1] near = sorted_near
    with nogil:
        for i in range(n):
            for j in range(i - 1, -1, -1):
                x, y = at[i, 0] - at[j, 0], at[i, 1] - at[j, 1]
                if x * x >= most:
                    break
                if x * x + y * y < most:
                    near[i] += 1
                    near[j] += 1
    out = np.empty(n, np.int64)
    out[order] = sorted_near
    return out


def slope_quartiles(const uint8_t[:, ::1] framed not None, const int64_t[::1] samples not None):
    cdef Py_ssize_t n = samples.shape[0], i = 0, width = framed.shape[1] - 2, height = framed.shape[0] - 2, x, y
    cdef double lower = 0, middle = 0
    if n == 0:
        return 0.0, 0.0
    cdef double[::1] size = np.empty(n)
    with nogil:
        while i < n and width > 0 and height > 0 and 0 <= samples[i] < width * height:
            y, x = samples[i] // width, samples[i] % width  # of the frame's corner above and to the left
            size[i] = fabs(
                <double>(framed[y, x + 2] - framed[y, x]) + 2.0 * <double>(framed[y + 1, x + 2] - framed[y + 1, x])
                + <double>(framed[y + 2, x + 2] - framed[y + 2, x])
            )
            i += 1
        if i == n:
            middle, lower = chosen(&size[0], n, n // 2), chosen(&size[0], n, n // 4)
    if i < n:
        raise ValueError(f"sample {i}: pixel {samples[i]} of {max(width, 0) * max(height, 0)}")
    return lower, middle
