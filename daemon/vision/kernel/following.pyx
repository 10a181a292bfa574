# cython: language_level=3, boundscheck=False, wraparound=False, cdivision=True, initializedcheck=False
"""follow of in_picture.py, compiled; see points.pyx."""

import numpy as np

from libc.math cimport NAN, ceil, fabsf, isfinite, sqrtf
from libc.stdint cimport UINT32_MAX, int16_t, int32_t, int64_t, uint8_t, uint32_t

include "picture.pxi"

cdef enum:
    FAR = 1000000  # as MOST_PLACES; also px, beyond any picture: what is less may be made an integer

if FAR != arguments.MOST_PLACES:
    raise ImportError("built with another constant")

cdef double SEGMENT_PX = arguments.SEGMENT_PX


cdef struct RawOfLevel:
    const float *table
    Py_ssize_t rows, columns
    float x, y, scale, about_x, about_y, per_cell


cdef struct Search:
    double stride
    float per_focal, reach, gate2
    uint32_t least
    bint strongest


cdef struct Segment:
    float[2] begin, by
    float ux, uy, slope, narrow  # brightness should rise along (ux, uy)
    bint horizontal
    Py_ssize_t most_major, most, beside, onward


cdef struct Found:
    float *x
    float *y
    int32_t *line
    Py_ssize_t count, room


cdef Picture framed_picture(const uint8_t[:, ::1] framed, const float[:, :, ::1] lookup, const float[:, ::1] rows) except *:
    cdef Picture p
    p.height, p.width, p.columns = framed.shape[0] - 2, framed.shape[1] - 2, lookup.shape[1]
    arguments.check_length("a cell of the look-up", lookup.shape[2], 2)
    check_rows(rows, p.height)
    p.stride = framed.shape[1]
    p.framed = &framed[0, 0] + p.stride + 1
    p.lookup, p.rows = &lookup[0, 0, 0], NULL if rows is None else &rows[0, 0]
    return p


cdef inline void raw_at(const RawOfLevel *t, float gx, float gy, float *raw) noexcept nogil:
    """Raw pixel at a cell of the look-up; nan outside."""
    cdef float one = 1
    raw[0] = raw[1] = NAN
    if not (gx >= 0 and gy >= 0 and gx < <float>(t.columns - 1) and gy < <float>(t.rows - 1)):
        return
    cdef Py_ssize_t i = <Py_ssize_t>gx, j = <Py_ssize_t>gy
    cdef float fx = gx - <float>i, fy = gy - <float>j, right, right_up
    cdef const float *low = t.table + 2 * (j * t.columns + i)
    cdef const float *up = low + 2 * t.columns
    cdef int k
    for k in range(2):
        right, right_up = low[k + 2] - low[k], up[k + 2] - up[k]
        raw[k] = (one - fy) * (low[k] + fx * right) + fy * (up[k] + fx * right_up)


cdef inline void to_raw(const RawOfLevel *t, const Picture *p, float x, float y, float *raw) noexcept nogil:
    """Raw pixel of a ray as a level robot would see it; nan outside. A row's own time hardly changes the row."""
    cdef Py_ssize_t at
    cdef float one = 1, z = t.scale / (one - t.about_x * y + t.about_y * x), u, v
    cdef float gx = (x - t.about_y) * z, gy = (y + t.about_x) * z
    raw_at(t, gx - t.x, gy - t.y, raw)
    if p.rows != NULL and raw[1] >= 0 and raw[1] < <float>p.height:
        at = 4 * <Py_ssize_t>raw[1]
        u, v = gx - p.rows[at + 2] * t.per_cell, gy - p.rows[at + 3] * t.per_cell
        raw_at(t, p.rows[at] * u + p.rows[at + 1] * v - t.x, p.rows[at] * v - p.rows[at + 1] * u - t.y, raw)


cdef inline bint straight(
    const Picture *p, const Search *s, const float *begin, const float *end, float places, Segment *g
) noexcept nogil:
    """The segment from begin to end; False where the look-up does not reach."""
    g.begin[0], g.begin[1] = begin[0], begin[1]
    g.by[0], g.by[1] = (end[0] - begin[0]) / places, (end[1] - begin[1]) / places
    g.ux, g.uy = g.by[1], -g.by[0]
    if not isfinite(g.ux) or not isfinite(g.uy):
        return False
    g.horizontal = fabsf(g.ux) >= fabsf(g.uy)
    g.slope = g.uy / g.ux if g.horizontal else g.ux / g.uy
    g.narrow = s.gate2 * (g.ux * g.ux + g.uy * g.uy)
    g.most_major = (p.height if g.horizontal else p.width) - 2
    g.most = (p.width if g.horizontal else p.height) - 2
    g.beside, g.onward = (1 if g.horizontal else p.stride), (p.stride if g.horizontal else 1)
    return True


cdef inline Py_ssize_t peak(
    const Picture *p, const Search *s, const Segment *g, Py_ssize_t major, float centre, Py_ssize_t begin, Py_ssize_t end,
    uint32_t *about
) noexcept nogil:
    """Where in [begin, end] across the edge the gradient has its best local maximum, -1 without any.

    The gradient is Sobel's, of a framed picture: its pixels are few enough to stay near, where those of two gradients
    are not. Of the three rows or columns that it needs each is read once, and their sums move along.

    Args:
        about: square of the gradient before, at and after that place.
    """
    cdef Py_ssize_t b = g.beside, o = g.onward, best = -1, i
    cdef const uint8_t *at = p.framed + major * o + (begin - 2) * b
    cdef int32_t low, high, total_0, total_1, total_2, total_3, change_1, change_2, change_3, across, along
    cdef int32_t next_across, next_along
    cdef uint32_t before, here, after
    cdef float one = 1, best_score = 0, score, rise
    low, high = at[-o], at[o]
    total_0, change_1 = low + 2 * at[0] + high, high - low
    at += b
    low, high = at[-o], at[o]
    total_1, change_2 = low + 2 * at[0] + high, high - low
    at += b
    low, high = at[-o], at[o]
    total_2, change_3 = low + 2 * at[0] + high, high - low
    across, along = total_2 - total_0, change_1 + 2 * change_2 + change_3
    here = <uint32_t>(across * across) + <uint32_t>(along * along)
    at += b
    change_1, change_2 = change_2, change_3
    low, high = at[-o], at[o]
    total_3, change_3 = low + 2 * at[0] + high, high - low
    next_across, next_along = total_3 - total_1, change_1 + 2 * change_2 + change_3
    after = <uint32_t>(next_across * next_across) + <uint32_t>(next_along * next_along)
    total_1, total_2 = total_2, total_3
    for i in range(begin, end + 1):
        before, here, across, along = here, after, next_across, next_along
        at += b
        change_1, change_2 = change_2, change_3
        low, high = at[-o], at[o]
        total_3, change_3 = low + 2 * at[0] + high, high - low
        next_across, next_along = total_3 - total_1, change_1 + 2 * change_2 + change_3
        after = <uint32_t>(next_across * next_across) + <uint32_t>(next_along * next_along)
        total_1, total_2 = total_2, total_3
        rise = <float>across * (g.ux if g.horizontal else g.uy) + <float>along * (g.uy if g.horizontal else g.ux)
        # all at once: of noise each alone would be guessed wrong every other time
        if (here < s.least) | (here < before) | (here <= after) | (rise <= 0) | (rise * rise < g.narrow * <float>here):
            continue
        score = <float>here if s.strongest else s.reach + one - fabsf(<float>i - centre)
        if score > best_score:
            best, best_score = i, score
            about[0], about[1], about[2] = before, here, after
    return best


cdef inline Py_ssize_t follow_segment(
    const Picture *p, const Search *s, const Segment *g, Py_ssize_t places, Py_ssize_t *last, int32_t line, Found *found
) noexcept nogil:
    """Add the points along a segment; at how many places it was looked for."""
    cdef Py_ssize_t looked = 0, k, major, begin, end, best
    cdef float fixed, free, centre, half = 0.5
    cdef uint32_t[3] about
    cdef Place place
    for k in range(places):
        fixed = g.begin[g.horizontal] + <float>k * g.by[g.horizontal]
        free = g.begin[not g.horizontal] + <float>k * g.by[not g.horizontal]
        if not (fixed > 0 and fixed < FAR):
            continue
        major = <Py_ssize_t>(fixed + half)
        centre = free - (<float>major - fixed) * g.slope
        if not (centre > s.reach and centre < FAR):
            continue
        begin, end = <Py_ssize_t>(centre - s.reach), <Py_ssize_t>(centre + s.reach)
        begin += <float>begin < centre - s.reach  # rounded up; both are above 0
        if major < 1 or major > g.most_major or begin < 1 or end > g.most:
            continue
        if 2 * major + g.horizontal == last[0]:
            continue  # one point of a row or column is enough
        last[0] = 2 * major + g.horizontal
        looked += 1
        best = peak(p, s, g, major, centre, begin, end, about)
        if best < 0:
            continue
        locate(
            p, best if g.horizontal else major, major if g.horizontal else best, g.horizontal,
            sqrtf(<float>about[0]), sqrtf(<float>about[1]), sqrtf(<float>about[2]), &place,
        )
        if isfinite(place.uv[0]) and isfinite(place.uv[1]) and found.count < found.room:
            found.x[found.count], found.y[found.count] = place.uv[0] * s.per_focal, place.uv[1] * s.per_focal
            found.line[found.count] = line
            found.count += 1
    return looked


cdef inline Py_ssize_t places_along(const double *line, double stride) noexcept nogil:
    cdef double length = (line[4] - line[3]) / stride
    return <Py_ssize_t>length if length > 0 and length < FAR else 0


cdef inline Py_ssize_t follow_line(
    const Picture *p, const RawOfLevel *t, const Search *s, const double *l, int32_t line, Found *found
) noexcept nogil:
    """Add the points near a predicted edge; at how many places it was looked for."""
    cdef Py_ssize_t count = places_along(l, s.stride), looked = 0, last = -1, k = 0
    cdef Py_ssize_t per = <Py_ssize_t>(SEGMENT_PX / s.stride) if s.stride < SEGMENT_PX else 1
    cdef float c = <float>l[0], s_ = <float>l[1], offset = <float>l[2] * s.per_focal, along
    cdef float first = <float>(l[3] + 0.5 * s.stride) * s.per_focal, step = <float>s.stride * s.per_focal
    cdef float[2] begin, end
    cdef Segment g
    to_raw(t, p, offset * c - first * s_, offset * s_ + first * c, end)
    while k < count:
        begin[0], begin[1], along = end[0], end[1], first + step * <float>(k + per)
        to_raw(t, p, offset * c - along * s_, offset * s_ + along * c, end)
        if straight(p, s, begin, end, <float>per, &g):
            looked += follow_segment(p, s, &g, min(count - k, per), &last, line, found)
        k += per
    return looked


def follow(
    const uint8_t[:, ::1] framed not None, grids, const double[:, ::1] lines not None, const double[:] tilt_rad not None,
    double focal_px, look, const float[:, ::1] rows=None
):
    cdef const float[:, :, ::1] lookup = grids.lookup, table = grids.raw_of_level
    if lookup is None or table is None:
        raise TypeError("a look-up is None, expected an array")
    cdef Picture p = framed_picture(framed, lookup, rows)
    arguments.check_search(grids, look, (p.height, p.width))
    for name, size, expected in (("a cell of raw_of_level", table.shape[2], 2), ("a row of lines", lines.shape[1], 5)):
        arguments.check_length(name, size, expected)
    arguments.check_length("tilt_rad", tilt_rad.shape[0], 2)
    cdef double cell = grids.cell_px, low_x = grids.low_px[0], low_y = grids.low_px[1]
    cdef RawOfLevel t = RawOfLevel(
        &table[0, 0, 0], table.shape[0], table.shape[1], <float>(low_x / cell), <float>(low_y / cell),
        <float>(focal_px / cell), <float>tilt_rad[0], <float>tilt_rad[1], <float>(1.0 / cell),
    )
    cdef double gate = look.gate, least = ceil(look.floor * look.floor)
    cdef Search s = Search(
        look.stride_px, <float>(1.0 / focal_px), look.reach_px, <float>(gate * gate),
        <uint32_t>least if least < UINT32_MAX else UINT32_MAX, look.strongest,
    )
    cdef Py_ssize_t n = lines.shape[0], k, room = 0
    for k in range(n):
        room += places_along(&lines[k, 0], s.stride)
    xy, line_out, looked_out = np.empty((2, room), np.float32), np.empty(room, np.int32), np.empty(n, np.int64)
    cdef float[:, ::1] places = xy
    cdef int32_t[::1] line = line_out
    cdef int64_t[::1] looked = looked_out
    cdef Found found = Found(&places[0, 0], &places[1, 0], &line[0], 0, room)
    with nogil:
        for k in range(n):
            looked[k] = follow_line(&p, &t, &s, &lines[k, 0], <int32_t>k, &found)
    return xy[0, : found.count], xy[1, : found.count], line_out[: found.count], looked_out
