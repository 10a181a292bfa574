from libc.math cimport fabs as solve_fabs


cdef bint solve(double *a, double *b, Py_ssize_t n, Py_ssize_t columns) noexcept nogil:
    """Put the solution of a x = b into b, a (n, n) and b (n, columns) row by row; False where a is singular.

    Gauss-Jordan with row pivots; a is spoilt.
    """
    cdef Py_ssize_t i, j, k, p
    cdef double v
    for k in range(n):
        p = k
        for i in range(k + 1, n):
            if solve_fabs(a[i * n + k]) > solve_fabs(a[p * n + k]):
                p = i
        if a[p * n + k] == 0.0:
            return False
        if p != k:
            for j in range(n):
                v = a[p * n + j]
                a[p * n + j] = a[k * n + j]
                a[k * n + j] = v
            for j in range(columns):
                v = b[p * columns + j]
                b[p * columns + j] = b[k * columns + j]
                b[k * columns + j] = v
        for i in range(n):
            if i != k:
                v = a[i * n + k] / a[k * n + k]
                if v != 0.0:
                    for j in range(k + 1, n):
                        a[i * n + j] -= v * a[k * n + j]
                    for j in range(columns):
                        b[i * columns + j] -= v * b[k * columns + j]
    for i in range(n):
        for j in range(columns):
            b[i * columns + j] /= a[i * n + i]
    return True
