# What the loops over points in four groups share.


cdef unpack(tuple ends, Py_ssize_t points, Py_ssize_t *e):
    """The bounds of the four groups, which must rise from 0 to no more than there are points."""
    e[0], e[1], e[2], e[3], e[4] = ends
    if not (0 == e[0] <= e[1] <= e[2] <= e[3] <= e[4] <= points):
        raise ValueError(f"groups bounded by {ends}, expected rising bounds from 0 to {points} at most")
