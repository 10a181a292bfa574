# What level_points and follow share: a picture, and where its edge points are in the level view.

from ceilvo.daemon.vision.kernel import arguments

cdef enum:
    STEP = 2  # LOOKUP_STEP_PX; fixed, because division is slow

if STEP != arguments.LOOKUP_STEP_PX:
    raise ImportError("built with another constant")


cdef struct Picture:
    Py_ssize_t height, width, columns  # columns of the look-up
    const int16_t *dx
    const int16_t *dy
    const float *lookup
    const float *rows  # NULL where all are of one instant
    const uint8_t *framed  # the first pixel of a picture with a frame of one pixel
    Py_ssize_t stride  # of framed


cdef struct Place:
    float[2] uv, along_x, along_y


cdef check_rows(const float[:, ::1] rows, Py_ssize_t height):
    arguments.check_rows(None if rows is None else (rows.shape[0], rows.shape[1]), height)


cdef inline void to_one_instant(const float *row, float shift_y, Place *to) noexcept nogil:
    """Move a point, shift_y off its row, and its changes per raw pixel, from the row's time to the picture's."""
    cdef float c = row[0], s = row[1], u = to.uv[0], v = to.uv[1]
    cdef float along = (row[4] - c) * u - (row[5] - s) * v + row[6] - row[2]
    cdef float across = (row[5] - s) * u + (row[4] - c) * v + row[7] - row[3]
    to.uv[0], to.uv[1] = c * u - s * v + row[2] + shift_y * along, s * u + c * v + row[3] + shift_y * across
    u, v = to.along_x[0], to.along_x[1]
    to.along_x[0], to.along_x[1] = c * u - s * v, s * u + c * v
    u, v = to.along_y[0], to.along_y[1]
    to.along_y[0], to.along_y[1] = c * u - s * v + along, s * u + c * v + across


cdef inline const float *corners_of(const Picture *p, Py_ssize_t x, Py_ssize_t y) noexcept nogil:
    """Where the cell of the look-up that a pixel is in begins."""
    return p.lookup + 2 * ((y // STEP) * p.columns + x // STEP)


cdef inline float within_cell(Py_ssize_t at) noexcept nogil:
    """How far into its cell a column or row is, in cells."""
    cdef float one = 1
    return <float>(at & (STEP - 1)) * (one / <float>STEP)


cdef inline float peak_shift(float before, float here, float after) noexcept nogil:
    """Where between pixels a parabola through three magnitudes of the gradient has its peak."""
    cdef float half = 0.5, two = 2, bend = two * here - before - after, least = <float>1e-3
    cdef float shift = half * (after - before) / (bend if bend > least else least)
    return -half if shift < -half else half if shift > half else shift


cdef inline void interpolate(
    float low, float right, float up, float both, float fx, float fy, float shift_x, float shift_y, float *to
) noexcept nogil:
    """One coordinate: of the level pixel, and its changes per raw pixel along x and y; corners of a cell are known."""
    cdef float one = 1, per_step = one / <float>STEP, level
    to[1] = ((one - fy) * (right - low) + fy * (both - up)) * per_step
    to[2] = ((one - fx) * (up - low) + fx * (both - right)) * per_step
    level = (one - fy) * (low + fx * (right - low)) + fy * (up + fx * (both - up))
    to[0] = level + (shift_x * to[1] + shift_y * to[2])


cdef inline void locate(
    const Picture *p, Py_ssize_t x, Py_ssize_t y, bint horizontal, float before, float here, float after, Place *to
) noexcept nogil:
    """Level pixel of the peak of the gradient at (x, y) along x or y, and how it changes along either.

    Args:
        before, here, after: the gradient's magnitude there and beside along that.
    """
    cdef float by_x = <float>horizontal, by_y = <float>(not horizontal), shift = peak_shift(before, here, after)
    cdef const float *low = corners_of(p, x, y)
    cdef const float *up = low + 2 * p.columns
    cdef float[3] of
    cdef int k
    for k in range(2):
        interpolate(
            low[k], low[k + 2], up[k], up[k + 2], within_cell(x), within_cell(y), shift * by_x, shift * by_y, of
        )
        to.uv[k], to.along_x[k], to.along_y[k] = of[0], of[1], of[2]
    if p.rows != NULL:
        to_one_instant(p.rows + 4 * y, shift * by_y, to)
