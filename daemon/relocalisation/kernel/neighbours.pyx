# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""pairs and nearest of reference.py, compiled; see daemon/vision/kernel/points.pyx."""

import numpy as np

from ceilvo.daemon.relocalisation.kernel.arguments import check_length

from libc.math cimport INFINITY, hypot
from libc.stdint cimport int8_t, int32_t, int64_t, uint16_t


cdef struct Blocks:
    const int32_t *number
    const int32_t *head
    const int32_t *chain
    const int32_t *xy
    const int8_t *kind
    int64_t x, y, columns, rows, blocks, slots
    int shift


cdef Blocks blocks_of(
    chains, const int64_t[::1] origin, const int32_t[:, ::1] number, const int32_t[::1] head, const int32_t[::1] chain,
    const int32_t[:, ::1] xy, const int8_t[::1] kind
) except *:
    cdef Blocks b
    check_length("origin", origin.shape[0], 2)
    check_length("xy", xy.shape[0], chain.shape[0])
    check_length("a landmark's place", xy.shape[1], 2)
    check_length("crossing_type", kind.shape[0], chain.shape[0])
    b.number, b.head = &number[0, 0], &head[0]
    b.chain, b.xy, b.kind = &chain[0], &xy[0, 0], &kind[0]
    b.x, b.y, b.columns, b.rows = origin[0], origin[1], number.shape[0], number.shape[1]
    b.blocks, b.slots, b.shift = head.shape[0], chain.shape[0], chains.shift
    return b


cdef inline int64_t number_at(const Blocks *b, int64_t column, int64_t row) noexcept nogil:
    """Of the block in a column and row; 0, where nothing is, for one that there is not."""
    column, row = column - b.x, row - b.y
    if column < 0 or row < 0 or column >= b.columns or row >= b.rows:
        return 0
    cdef int64_t number = b.number[column * b.rows + row]
    return number if 0 <= number < b.blocks else 0


cdef inline int64_t apart(int64_t a, int64_t b) noexcept nogil:
    return a - b if a > b else b - a


cdef int64_t near_point(
    const Blocks *b, int64_t x, int64_t y, int64_t reach, int64_t point, int64_t *which, int32_t *slots
) noexcept nogil:
    """How many landmarks are within reach; put down where which is not NULL. -1 where a chain leads nowhere."""
    cdef int64_t column, row, number, found = 0, steps
    cdef int32_t slot
    for column in range((x - reach) >> b.shift, ((x + reach) >> b.shift) + 1):
        for row in range((y - reach) >> b.shift, ((y + reach) >> b.shift) + 1):
            number = number_at(b, column, row)
            if not number:
                continue
            slot, steps = b.head[number], 0
            while slot >= 0:
                if slot >= b.slots or steps > b.slots:
                    return -1
                if apart(b.xy[2 * slot], x) <= reach and apart(b.xy[2 * slot + 1], y) <= reach:
                    if which != NULL:
                        which[found], slots[found] = point, slot
                    found += 1
                slot, steps = b.chain[slot], steps + 1
    return found


def pairs(chains, const int32_t[:, :] points not None, int64_t reach):
    cdef const int64_t[::1] origin = chains.origin
    cdef const int32_t[:, ::1] number = chains.number, xy = chains.xy
    cdef const int32_t[::1] head = chains.head, chain = chains.chain
    cdef const int8_t[::1] kind = chains.crossing_type
    cdef int64_t n = points.shape[0], i, total = 0, found = 0
    check_length("a point", points.shape[1], 2)
    if n == 0 or chain.shape[0] == 0:
        return np.empty(0, np.int64), np.empty(0, np.int32)
    cdef Blocks b = blocks_of(chains, origin, number, head, chain, xy, kind)
    with nogil:
        for i in range(n):
            found = near_point(&b, points[i, 0], points[i, 1], reach, i, NULL, NULL)
            if found < 0:
                break
            total += found
    if found < 0:
        raise ValueError(f"point {i}: a chain of landmarks leads nowhere")
    which_out, slot_out = np.empty(total, np.int64), np.empty(total, np.int32)
    cdef int64_t[::1] which = which_out
    cdef int32_t[::1] slot = slot_out
    if total == 0:
        return which_out, slot_out
    total = 0
    with nogil:
        for i in range(n):
            total += near_point(&b, points[i, 0], points[i, 1], reach, i, &which[0] + total, &slot[0] + total)
    return which_out, slot_out


cdef bint nearest_to(
    const Blocks *b, int64_t x, int64_t y, int64_t reach, uint16_t wanted, int32_t *slot_out, double *best
) noexcept nogil:
    """False where a chain leads nowhere."""
    cdef int64_t[4] number
    cdef int64_t steps
    cdef int k, i
    cdef int32_t slot
    cdef double off
    best[0], slot_out[0] = INFINITY, -1
    number[0] = number_at(b, (x - reach) >> b.shift, (y - reach) >> b.shift)
    number[1] = number_at(b, (x - reach) >> b.shift, (y + reach) >> b.shift)
    number[2] = number_at(b, (x + reach) >> b.shift, (y - reach) >> b.shift)
    number[3] = number_at(b, (x + reach) >> b.shift, (y + reach) >> b.shift)
    for k in range(4):
        for i in range(k):
            if number[i] == number[k]:
                number[k] = 0
        if not number[k]:
            continue
        slot, steps = b.head[number[k]], 0
        while slot >= 0:
            if slot >= b.slots or steps > b.slots:
                return False
            if b.kind[slot] >= 0 and (wanted >> b.kind[slot]) & 1:
                off = hypot(<double>(b.xy[2 * slot] - x), <double>(b.xy[2 * slot + 1] - y))
                if off < best[0]:
                    best[0], slot_out[0] = off, slot
            slot, steps = b.chain[slot], steps + 1
    if best[0] > <double>reach:
        slot_out[0] = -1
    return True


def nearest(chains, const int32_t[:, :] points not None, const uint16_t[:] wanted not None, int64_t reach):
    cdef const int64_t[::1] origin = chains.origin
    cdef const int32_t[:, ::1] number = chains.number, xy = chains.xy
    cdef const int32_t[::1] head = chains.head, chain = chains.chain
    cdef const int8_t[::1] kind = chains.crossing_type
    cdef int64_t n = points.shape[0], i
    cdef bint good = True
    check_length("a point", points.shape[1], 2)
    check_length("wanted", wanted.shape[0], n)
    slot_out, best_out = np.full(n, -1, np.int32), np.full(n, np.inf)
    if n == 0 or chain.shape[0] == 0:
        return slot_out, best_out
    cdef Blocks b = blocks_of(chains, origin, number, head, chain, xy, kind)
    cdef int32_t[::1] slot = slot_out
    cdef double[::1] best = best_out
    with nogil:
        for i in range(n):
            good = nearest_to(&b, points[i, 0], points[i, 1], reach, wanted[i], &slot[i], &best[i])
            if not good:
                break
    if not good:
        raise ValueError(f"point {i}: a chain of landmarks leads nowhere")
    return slot_out, best_out
