# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""Functions of reference.py that weigh a view at places, compiled; see daemon/vision/kernel/points.pyx."""

import numpy as np

from ceilvo.daemon.relocalisation.kernel import arguments
from ceilvo.daemon.relocalisation.kernel.arguments import check_length

from libc.math cimport cos, floor, sin
from libc.stdint cimport int64_t, uint8_t, uint16_t

cdef enum:
    SIDE = 32  # COVERAGE_SIDE

if SIDE != arguments.COVERAGE_SIDE:
    raise ImportError("built with another constant")

cdef int64_t OFFSET = arguments.COVERAGE_OFFSET
cdef double LINE_FEATURES = arguments.LINE_FEATURES
cdef int64_t NO_BLOCK = -(1 << 62)  # no block has this number
cdef double FAR = 1e9  # no cell is further out: what is less may be made an integer, and multiplied


cdef inline int64_t cell_of(double at) noexcept nogil:
    return <int64_t>floor(at) if -FAR < at < FAR else <int64_t>FAR


def stamped(
    uint16_t[:, ::1] cells not None, const int64_t[:, :] place not None, const uint16_t[::1] bits not None,
    const uint8_t[:, ::1] disc not None
):
    cdef Py_ssize_t n = place.shape[0], i, u, v, x, y, half = disc.shape[0] // 2
    check_length("a place", place.shape[1], 2)
    check_length("bits", bits.shape[0], n)
    check_length("disc", disc.shape[1], disc.shape[0])
    check_length("disc", disc.shape[0] % 2, 1)
    with nogil:
        for i in range(n):
            for v in range(disc.shape[0]):
                y = place[i, 1] + v - half
                if y < 0 or y >= cells.shape[0]:
                    continue
                for u in range(disc.shape[1]):
                    x = place[i, 0] + u - half
                    if disc[v, u] and 0 <= x < cells.shape[1]:
                        cells[y, x] |= bits[i]


cdef inline uint16_t bits_at(
    const uint16_t[:, ::1] cells, int64_t low_x, int64_t low_y, double per_m, double x, double y
) noexcept nogil:
    cdef int64_t column = cell_of(x * per_m) - low_x, row = cell_of(y * per_m) - low_y
    if column < 0 or row < 0 or column >= cells.shape[1] or row >= cells.shape[0]:
        return 0
    return cells[row, column]


def looked_up(raster, const double[:, :] xy not None):
    cdef const int64_t[::1] low = raster.low
    cdef const uint16_t[:, ::1] cells = raster.cells
    cdef double per_m = 1.0 / raster.cell_m
    cdef Py_ssize_t n = xy.shape[0], i
    check_length("a point", xy.shape[1], 2)
    check_length("low", low.shape[0], 2)
    out = np.empty(n, np.uint16)
    cdef uint16_t[::1] bits = out
    with nogil:
        for i in range(n):
            bits[i] = bits_at(cells, low[0], low[1], per_m, xy[i, 0], xy[i, 1])
    return out


cdef inline int64_t row_of(const int64_t[::1] block, int64_t number) noexcept nogil:
    """Where a number stands among the rising ones, -1 where it does not."""
    cdef Py_ssize_t low = 0, high = block.shape[0], middle
    while low < high:
        middle = (low + high) // 2
        if block[middle] < number:
            low = middle + 1
        else:
            high = middle
    return low if low < block.shape[0] and block[low] == number else -1


cdef inline int64_t views_at(
    const int64_t[::1] block, const uint8_t[:, :, ::1] shown, double cell_m, double at_x, double at_y, int64_t *last,
    int64_t *row
) noexcept nogil:
    """Of a cell; the block that was asked last and its row are kept, for neighbours are mostly in one block."""
    cdef int64_t x = cell_of(at_x / cell_m), y = cell_of(at_y / cell_m)
    cdef int64_t number = ((x >> 5) + OFFSET) * (2 * OFFSET) + ((y >> 5) + OFFSET)
    if number != last[0]:
        last[0], row[0] = number, row_of(block, number)
    return shown[row[0], x & (SIDE - 1), y & (SIDE - 1)] if row[0] >= 0 else 0


cdef check_ground(ground):
    check_length("shown", ground.shown.shape[0], ground.block.shape[0])
    check_length("side of a block", ground.shown.shape[1], SIDE)
    check_length("side of a block", ground.shown.shape[2], SIDE)


def views(ground, const double[:, :] xy not None):
    cdef const int64_t[::1] block = ground.block
    cdef const uint8_t[:, :, ::1] shown = ground.shown
    cdef double cell_m = ground.cell_m
    cdef Py_ssize_t n = xy.shape[0], i
    cdef int64_t last = NO_BLOCK, row = -1
    check_length("a point", xy.shape[1], 2)
    check_ground(ground)
    out = np.zeros(n, np.int64)
    cdef int64_t[::1] seen = out
    with nogil:
        for i in range(n):
            seen[i] = views_at(block, shown, cell_m, xy[i, 0], xy[i, 1], &last, &row)
    return out


def alike(
    raster, ground, int known_views, const double[:, :] xy not None, const int64_t[::1] kind not None,
    const double[:, :] shifts not None, int types, int rare
):
    cdef const int64_t[::1] low = raster.low, block = ground.block
    cdef const uint16_t[:, ::1] cells = raster.cells
    cdef const uint8_t[:, :, ::1] shown = ground.shown
    cdef double per_m = 1.0 / raster.cell_m, cell_m = ground.cell_m, x, y
    cdef Py_ssize_t n = xy.shape[0], m = shifts.shape[0], i, j
    cdef int64_t last = NO_BLOCK, row = -1
    cdef uint16_t bits
    check_length("a landmark", xy.shape[1], 2)
    check_length("a shift", shifts.shape[1], 2)
    check_length("types", kind.shape[0], n)
    check_length("low", low.shape[0], 2)
    check_ground(ground)
    for i in range(n):
        if not 0 <= kind[i] < min(types, 16):
            raise ValueError(f"landmark {i}: type {kind[i]}, expected 0 to {min(types, 16) - 1}")
    out = np.zeros((3, m, types))
    cdef double[:, :, ::1] count = out
    with nogil:
        for i in range(n):
            for j in range(m):
                x, y = xy[i, 0] + shifts[j, 0], xy[i, 1] + shifts[j, 1]
                if views_at(block, shown, cell_m, x, y, &last, &row) < known_views:
                    continue
                bits = bits_at(cells, low[0], low[1], per_m, x, y)
                count[0, j, kind[i]] += 1.0
                if bits >> kind[i] & 1:
                    count[1, j, kind[i]] += 1.0
                if bits & (rare | 1 << kind[i]):
                    count[2, j, kind[i]] += 1.0
    return out


cdef inline double share_of(const int64_t[:, :] lines, const int64_t[:, ::1] count, Py_ssize_t k) noexcept nogil:
    """What an event at a crossing of two lines is worth beside the others along them."""
    cdef int64_t most = count[0, lines[k, 0]]
    if count[1, lines[k, 1]] > most:
        most = count[1, lines[k, 1]]
    return LINE_FEATURES / <double>most if <double>most > LINE_FEATURES else 1.0


cdef check_lines(const int64_t[:, :] lines, Py_ssize_t n):
    """How many numbers the lines have at most."""
    cdef Py_ssize_t i
    cdef int64_t most = 0
    check_length("lines", lines.shape[0], n)
    check_length("lines of a crossing", lines.shape[1], 2)
    for i in range(n):
        if lines[i, 0] < 0 or lines[i, 1] < 0:
            raise ValueError(f"crossing {i}: lines {lines[i, 0]} and {lines[i, 1]}, expected numbers from 0 on")
        most = max(most, lines[i, 0] + 1, lines[i, 1] + 1)
    return most


def scored(
    ratios, const int64_t[:, :] views not None, const int64_t[:, :] types not None, matched not None, other not None,
    const double[:, :] worth not None, const int64_t[:, :] lines not None
):
    cdef const uint8_t[:, :] is_there = matched.view(np.uint8), is_other = other.view(np.uint8)
    cdef const double[:, :, ::1] gain = ratios.gain, mistaken = ratios.mistaken, loss = ratios.loss
    cdef int64_t per_step = ratios.views_per_step, known_views = ratios.known_views, step
    cdef Py_ssize_t m = views.shape[0], n = views.shape[1], r = gain.shape[2], i, k, u
    cdef double known
    cdef const double *of
    for name, rows, columns in (
        ("types", types.shape[0], types.shape[1]), ("matched", is_there.shape[0], is_there.shape[1]),
        ("other", is_other.shape[0], is_other.shape[1]),
    ):
        check_length(f"poses of {name}", rows, m)
        check_length(name, columns, n)
    check_length("worth", worth.shape[0], r)
    check_length("worth", worth.shape[1], n)
    if ratios.mistaken.shape != ratios.gain.shape or ratios.loss.shape != ratios.gain.shape:
        raise ValueError(f"tables of {ratios.gain.shape}, {ratios.mistaken.shape} and {ratios.loss.shape}")
    for i in range(m):
        for k in range(n):
            if not (0 <= views[i, k] < per_step * gain.shape[0] and 0 <= types[i, k] < gain.shape[1]):
                raise ValueError(f"feature {k} at pose {i}: {views[i, k]} views, type {types[i, k]}")
    out = np.zeros((m, r))
    cdef double[:, ::1] score = out
    cdef int64_t[:, ::1] count = np.zeros((2, check_lines(lines, n)), np.int64)
    with nogil:
        for i in range(m):
            for k in range(n):
                if not is_there[i, k] and views[i, k] >= known_views:
                    count[0, lines[k, 0]] += 1
                    count[1, lines[k, 1]] += 1
            for k in range(n):
                step = views[i, k] // per_step
                if is_there[i, k]:
                    known = <double>views[i, k] / <double>known_views if views[i, k] < known_views else 1.0
                    of = &gain[step, types[i, k], 0]
                elif views[i, k] >= known_views:
                    known = share_of(lines, count, k)
                    of = &mistaken[step, types[i, k], 0] if is_other[i, k] else &loss[step, types[i, k], 0]
                else:
                    continue
                for u in range(r):
                    score[i, u] += of[u] * known * worth[u, k]
            for k in range(n):
                count[0, lines[k, 0]] = 0
                count[1, lines[k, 1]] = 0
    return out


def missed(
    raster, const double[:, :] poses not None, const double[:, :] xy not None, const uint16_t[:, :] own not None,
    const int64_t[::1] turns not None, int visible, int rare, const double[:, :] surprise not None,
    const int64_t[:, :] lines not None
):
    cdef const int64_t[::1] low = raster.low
    cdef const uint16_t[:, ::1] cells = raster.cells
    cdef double per_m = 1.0 / raster.cell_m, c, s, x, y, share
    cdef Py_ssize_t m = poses.shape[0], n = xy.shape[0], r = surprise.shape[1], i, k, u
    cdef uint16_t bits
    check_length("a pose", poses.shape[1], 3)
    check_length("turns", turns.shape[0], m)
    check_length("a landmark", xy.shape[1], 2)
    check_length("turns of own", own.shape[0], 4)
    check_length("own", own.shape[1], n)
    check_length("surprise", surprise.shape[0], n)
    check_length("low", low.shape[0], 2)
    for i in range(m):
        if not 0 <= turns[i] < 4:
            raise ValueError(f"pose {i}: {turns[i]} quarter turns, expected 0 to 3")
    out = np.zeros((m, r))
    cdef double[:, ::1] score = out
    cdef uint8_t[::1] gone = np.zeros(n, np.uint8)
    cdef int64_t[:, ::1] count = np.zeros((2, check_lines(lines, n)), np.int64)
    with nogil:
        for i in range(m):
            c, s = cos(poses[i, 2]), sin(poses[i, 2])
            for k in range(n):
                x, y = xy[k, 0] - poses[i, 0], xy[k, 1] - poses[i, 1]
                bits = bits_at(cells, low[0], low[1], per_m, c * x + s * y, c * y - s * x)
                gone[k] = (bits & visible) and not (bits & rare) and not (bits & own[turns[i], k])
                count[0, lines[k, 0]] += gone[k]
                count[1, lines[k, 1]] += gone[k]
            for k in range(n):
                if gone[k]:
                    share = share_of(lines, count, k)
                    for u in range(r):
                        score[i, u] += share * surprise[k, u]
            for k in range(n):
                count[0, lines[k, 0]] = 0
                count[1, lines[k, 1]] = 0
    return out
