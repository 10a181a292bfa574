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


cdef inline void locate(
    const Picture *p, Py_ssize_t x, Py_ssize_t y, bint horizontal, float before, float here, float after, Place *to
) noexcept nogil:
    """Level pixel of the peak of the gradient at (x, y) along x or y, and how it changes along either.

    Args:
        before, here, after: the gradient's magnitude there and beside along that.
    """
    cdef float one = 1, half = 0.5, two = 2, per_step = one / <float>STEP
    cdef float by_x = <float>horizontal, by_y = one - by_x
    cdef float bend = two * here - before - after, least = <float>1e-3
    cdef float shift = half * (after - before) / (bend if bend > least else least)
    shift = -half if shift < -half else half if shift > half else shift
    cdef const float *low = p.lookup + 2 * ((y // STEP) * p.columns + x // STEP)
    cdef const float *up = low + 2 * p.columns
    cdef float fx = <float>(x & (STEP - 1)) * per_step, fy = <float>(y & (STEP - 1)) * per_step
    cdef float right, right_up, level
    cdef int k
    for k in range(2):
        right, right_up = low[k + 2] - low[k], up[k + 2] - up[k]
        to.along_x[k] = ((one - fy) * right + fy * right_up) * per_step
        to.along_y[k] = ((one - fx) * (up[k] - low[k]) + fx * (up[k + 2] - low[k + 2])) * per_step
        level = (one - fy) * (low[k] + fx * right) + fy * (up[k] + fx * right_up)
        to.uv[k] = level + shift * (by_x * to.along_x[k] + by_y * to.along_y[k])
    if p.rows != NULL:
        to_one_instant(p.rows + 4 * y, shift * by_y, to)
