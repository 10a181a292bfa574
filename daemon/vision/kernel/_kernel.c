/* Loops over single edge points, called by kernel_compiled.py, which allocates every array.
 *
 * kernel_numpy.py says what each function computes; tests hold the two together. All arrays are C-contiguous; lengths
 * and indices are checked here, so that a wrong call raises ValueError and never reads outside an array.
 */
#define PY_SSIZE_T_CLEAN
#include <Python.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

#define MOST_ARRAYS 9

typedef struct {
    Py_buffer buffers[MOST_ARRAYS];
    int count;
} Arrays;

static void release(Arrays *a) {
    while (a->count > 0) PyBuffer_Release(&a->buffers[--a->count]);
}

/* The items of the next array, which must hold at least `least`; NULL with an exception set otherwise. */
static void *items(Arrays *a, PyObject *o, int writable, Py_ssize_t size, Py_ssize_t least, Py_ssize_t *count) {
    Py_buffer *b = &a->buffers[a->count];
    if (PyObject_GetBuffer(o, b, writable ? PyBUF_C_CONTIGUOUS | PyBUF_WRITABLE : PyBUF_C_CONTIGUOUS) < 0) return NULL;
    a->count++;
    if (b->itemsize != size || b->len / size < least) {
        PyErr_Format(PyExc_ValueError, "array %d: %zd items of %zd bytes, expected at least %zd of %zd", a->count,
                     b->len / b->itemsize, b->itemsize, least, size);
        return NULL;
    }
    if (count) *count = b->len / size;
    return b->buf;
}

static int is_line(int32_t line, Py_ssize_t lines, Py_ssize_t point) {
    if (line >= 0 && line < lines) return 1;
    PyErr_Format(PyExc_ValueError, "point %zd: line %d of %zd", point, (int)line, lines);
    return 0;
}

/* Angle of (x, y) in degrees, [0, 360); minimax polynomial of the arc tangent, within 0.001 degrees. */
static inline float degrees(float y, float x) {
    float ax = fabsf(x), ay = fabsf(y);
    float low = ax < ay ? ax : ay, high = ax < ay ? ay : ax;
    float t = high > 0.0f ? low / high : 0.0f, q = t * t;
    float a = t * (0.99997726f + q * (-0.33262347f + q * (0.19354346f + q * (-0.11643287f
                + q * (0.05265332f + q * -0.01172120f)))));
    a *= 57.29577951f;
    /* edges point anywhere: a branch would be guessed wrong half of the time */
    a += (float)(ay > ax) * (90.0f - 2.0f * a);
    a += (float)(x < 0.0f) * (180.0f - 2.0f * a);
    a += (float)(y < 0.0f) * (360.0f - 2.0f * a);
    return a - (float)(a >= 360.0f) * 360.0f;
}

static inline float magnitude(const int16_t *dx, const int16_t *dy, Py_ssize_t at) {
    float x = dx[at], y = dy[at];
    return sqrtf(x * x + y * y);
}

#define SEGMENT_PX 16.0 /* as in kernel_numpy.py */
enum { STEP = 2 }; /* LOOKUP_STEP_PX; fixed, because division is slow */

/* Level pixel of the peak of the gradient at (x, y) along x or y, and how it changes along either. */
static inline void place(const int16_t *dx, const int16_t *dy, Py_ssize_t width, const float *lookup, Py_ssize_t columns,
                         Py_ssize_t x, Py_ssize_t y, int horizontal, float *uv, float *along_x, float *along_y) {
    const float per_step = 1.0f / (float)STEP;
    Py_ssize_t at = y * width + x, beside = width + horizontal * (1 - width);
    float by_x = (float)horizontal, by_y = 1.0f - by_x;
    float here = magnitude(dx, dy, at), before = magnitude(dx, dy, at - beside);
    float after = magnitude(dx, dy, at + beside), bend = 2.0f * here - before - after;
    float shift = 0.5f * (after - before) / (bend > 1e-3f ? bend : 1e-3f);
    shift = shift < -0.5f ? -0.5f : shift > 0.5f ? 0.5f : shift;
    const float *low = lookup + 2 * ((y / STEP) * columns + x / STEP), *up = low + 2 * columns;
    float fx = (float)(x & (STEP - 1)) * per_step, fy = (float)(y & (STEP - 1)) * per_step;
    for (int k = 0; k < 2; k++) {
        float right = low[k + 2] - low[k], right_up = up[k + 2] - up[k];
        along_x[k] = ((1.0f - fy) * right + fy * right_up) * per_step;
        along_y[k] = ((1.0f - fx) * (up[k] - low[k]) + fx * (up[k + 2] - low[k + 2])) * per_step;
        float level = (1.0f - fy) * (low[k] + fx * right) + fy * (up[k] + fx * right_up);
        uv[k] = level + shift * (by_x * along_x[k] + by_y * along_y[k]);
    }
}

static PyObject *level_points(PyObject *self, PyObject *args) {
    PyObject *o[7];
    Py_ssize_t width, height, columns, limit, room, out = 0;
    if (!PyArg_ParseTuple(args, "OOOOOnnnnOO", &o[0], &o[1], &o[2], &o[3], &o[4], &width, &height, &columns, &limit,
                          &o[5], &o[6]))
        return NULL;
    if (width < 1 || height < 1 || columns <= (width - 1) / STEP) {
        PyErr_SetString(PyExc_ValueError, "sizes below 1, or a look-up narrower than the picture");
        return NULL;
    }
    Arrays a = {.count = 0};
    Py_ssize_t n = width * height, cells = ((height - 2) / STEP + 2) * columns;
    const uint8_t *mask = items(&a, o[0], 0, 1, n, NULL);
    const int16_t *dx = mask ? items(&a, o[1], 0, 2, n, NULL) : NULL;
    const int16_t *dy = dx ? items(&a, o[2], 0, 2, n, NULL) : NULL;
    const float *lookup = dy ? items(&a, o[3], 0, 4, 2 * cells, NULL) : NULL;
    const uint16_t *rank = lookup ? items(&a, o[4], 0, 2, n, NULL) : NULL;
    float *phi = rank ? items(&a, o[6], 1, 4, 0, &room) : NULL;
    float *uv = phi ? items(&a, o[5], 1, 4, 2 * room, NULL) : NULL;
    if (!uv) {
        release(&a);
        return NULL;
    }
    for (Py_ssize_t y = 1; y < height - 1; y++) { /* a neighbour on every side */
        for (Py_ssize_t x = 1; x < width - 1; x++) {
            Py_ssize_t at = y * width + x;
            if (!mask[at]) {
                uint64_t eight;
                while (x + 8 < width - 1 && (memcpy(&eight, mask + at, 8), !eight)) x += 8, at += 8;
                if (!mask[at]) continue;
            }
            if (limit < UINT16_MAX && rank[at] >= limit) continue;
            if (out == room) goto done;
            float gx = dx[at], gy = dy[at], along_x[2], along_y[2];
            int horizontal = fabsf(gx) >= fabsf(gy);
            place(dx, dy, width, lookup, columns, x, y, horizontal, uv + 2 * out, along_x, along_y);
            phi[out++] = degrees(along_x[0] * gy - along_y[0] * gx, along_y[1] * gx - along_x[1] * gy);
        }
    }
done:
    release(&a);
    return PyLong_FromSsize_t(out);
}

typedef struct {
    const float *table;
    Py_ssize_t rows, columns;
    float x, y, scale, about_x, about_y;
} RawOfLevel;

/* Raw pixel of a ray as a level robot would see it; nan outside. */
static inline void to_raw(const RawOfLevel *t, float px, float py, float *raw) {
    float z = t->scale / (1.0f - t->about_x * py + t->about_y * px);
    float gx = (px - t->about_y) * z - t->x, gy = (py + t->about_x) * z - t->y;
    raw[0] = raw[1] = NAN;
    if (!(gx >= 0.0f && gy >= 0.0f && gx < (float)(t->columns - 1) && gy < (float)(t->rows - 1))) return;
    int i = (int)gx, j = (int)gy;
    float fx = gx - (float)i, fy = gy - (float)j;
    const float *low = t->table + 2 * (j * t->columns + i), *up = low + 2 * t->columns;
    for (int k = 0; k < 2; k++) {
        float right = low[k + 2] - low[k], right_up = up[k + 2] - up[k];
        raw[k] = (1.0f - fy) * (low[k] + fx * right) + fy * (up[k] + fx * right_up);
    }
}

static inline uint32_t square(const int16_t *dx, const int16_t *dy, Py_ssize_t at) {
    int32_t x = dx[at], y = dy[at];
    return (uint32_t)(x * x) + (uint32_t)(y * y);
}

static PyObject *follow(PyObject *self, PyObject *args) {
    PyObject *o[9];
    Py_ssize_t width, height, columns, raw_columns, raw_rows, n_lines, room, out = 0;
    double low_x, low_y, cell, tilt_a, tilt_b, focal, stride, reach, floor_, gate;
    int strongest;
    if (!PyArg_ParseTuple(args, "OOOOOnnnnnddddddddddpOOOO", &o[0], &o[1], &o[2], &o[3], &o[4], &width, &height, &columns,
                          &raw_columns, &raw_rows, &low_x, &low_y, &cell, &tilt_a, &tilt_b, &focal, &stride, &reach,
                          &floor_, &gate, &strongest, &o[5], &o[6], &o[7], &o[8]))
        return NULL;
    if (width < 3 || height < 3 || columns <= (width - 1) / STEP || raw_columns < 2 || raw_rows < 2 || !(stride > 0.0)) {
        PyErr_SetString(PyExc_ValueError, "picture, look-ups or stride too small");
        return NULL;
    }
    Arrays a = {.count = 0};
    Py_ssize_t pixels = width * height, cells = ((height - 2) / STEP + 2) * columns;
    const int16_t *dx = items(&a, o[0], 0, 2, pixels, NULL);
    const int16_t *dy = dx ? items(&a, o[1], 0, 2, pixels, NULL) : NULL;
    const float *lookup = dy ? items(&a, o[2], 0, 4, 2 * cells, NULL) : NULL;
    const float *table = lookup ? items(&a, o[3], 0, 4, 2 * raw_columns * raw_rows, NULL) : NULL;
    int64_t *looked = table ? items(&a, o[8], 1, 8, 0, &n_lines) : NULL;
    const double *lines = looked ? items(&a, o[4], 0, 8, 5 * n_lines, NULL) : NULL;
    float *x = lines ? items(&a, o[5], 1, 4, 0, &room) : NULL;
    float *y = x ? items(&a, o[6], 1, 4, room, NULL) : NULL;
    int32_t *line = y ? items(&a, o[7], 1, 4, room, NULL) : NULL;
    if (!line) {
        release(&a);
        return NULL;
    }
    const float per_focal = (float)(1.0 / focal), gate2 = (float)(gate * gate), far = (float)reach;
    const RawOfLevel level = {table, raw_rows, raw_columns, (float)(low_x / cell), (float)(low_y / cell),
                              (float)(focal / cell), (float)tilt_a, (float)tilt_b};
    const double floor2 = ceil(floor_ * floor_);
    const uint32_t least = floor2 < 4e9 ? (uint32_t)floor2 : UINT32_MAX;
    const Py_ssize_t per = stride < SEGMENT_PX ? (Py_ssize_t)(SEGMENT_PX / stride) : 1;
    for (Py_ssize_t e = 0; e < n_lines; e++) {
        const double *l = lines + 5 * e, length = (l[4] - l[3]) / stride;
        if (!(length > 0.0 && length < 1e6)) continue;
        const float c = (float)l[0], s = (float)l[1], offset = (float)l[2] * per_focal;
        const float first = (float)(l[3] + 0.5 * stride) * per_focal, step = (float)stride * per_focal;
        Py_ssize_t last = -1, count = (Py_ssize_t)length;
        float next[2];
        to_raw(&level, offset * c - first * s, offset * s + first * c, next);
        for (Py_ssize_t k0 = 0; k0 < count; k0 += per) { /* the lens bends a line by nothing along so little of it */
            float begin[2] = {next[0], next[1]}, along = first + step * (float)(k0 + per);
            to_raw(&level, offset * c - along * s, offset * s + along * c, next);
            float by[2] = {(next[0] - begin[0]) / (float)per, (next[1] - begin[1]) / (float)per};
            float ux = by[1], uy = -by[0]; /* brightness should rise this way */
            if (!isfinite(ux) || !isfinite(uy)) continue;
            int horizontal = fabsf(ux) >= fabsf(uy);
            float slope = horizontal ? uy / ux : ux / uy, narrow = gate2 * (ux * ux + uy * uy);
            Py_ssize_t most_major = horizontal ? height - 2 : width - 2, most = horizontal ? width - 2 : height - 2;
            Py_ssize_t beside = horizontal ? 1 : width, onward = horizontal ? width : 1;
            Py_ssize_t end = count - k0 < per ? count - k0 : per;
            for (Py_ssize_t k = 0; k < end; k++) {
                float fixed = begin[horizontal] + (float)k * by[horizontal];
                float free = begin[!horizontal] + (float)k * by[!horizontal];
                if (!(fixed > 0.0f && fixed < 1e6f)) continue;
                Py_ssize_t major = (Py_ssize_t)(fixed + 0.5f), key = 2 * major + horizontal;
                float centre = free - ((float)major - fixed) * slope;
                if (!(centre > far && centre < 1e6f)) continue;
                Py_ssize_t from = (Py_ssize_t)ceilf(centre - far), to = (Py_ssize_t)(centre + far);
                if (major < 1 || major > most_major || from < 1 || to > most) continue;
                if (key == last) continue; /* one point of a row or column is enough */
                last = key;
                looked[e]++;
                Py_ssize_t at = major * onward + from * beside, best = -1;
                float best_score = 0.0f;
                uint32_t before = square(dx, dy, at - beside), here = square(dx, dy, at);
                for (Py_ssize_t p = from; p <= to; p++, at += beside) {
                    uint32_t after = square(dx, dy, at + beside);
                    if (here >= least && here >= before && here > after) {
                        float rise = (float)dx[at] * ux + (float)dy[at] * uy;
                        float score = strongest ? (float)here : far + 1.0f - fabsf((float)p - centre);
                        if (rise > 0.0f && rise * rise >= narrow * (float)here && score > best_score)
                            best = p, best_score = score;
                    }
                    before = here, here = after;
                }
                if (best < 0) continue;
                float uv[2], along_x[2], along_y[2];
                place(dx, dy, width, lookup, columns, horizontal ? best : major, horizontal ? major : best, horizontal,
                      uv, along_x, along_y);
                if (!isfinite(uv[0]) || !isfinite(uv[1])) continue;
                if (out == room) goto full;
                x[out] = uv[0] * per_focal, y[out] = uv[1] * per_focal, line[out++] = (int32_t)e;
            }
        }
    }
full:
    release(&a);
    return PyLong_FromSsize_t(out);
}

static PyObject *split(PyObject *self, PyObject *args) {
    PyObject *o[5];
    double psi, gate, scale;
    Py_ssize_t n;
    if (!PyArg_ParseTuple(args, "OOdddOOO", &o[0], &o[1], &psi, &gate, &scale, &o[2], &o[3], &o[4])) return NULL;
    Arrays a = {.count = 0};
    const float *phi = items(&a, o[1], 0, 4, 0, &n);
    const float *uv = phi ? items(&a, o[0], 0, 4, 2 * n, NULL) : NULL;
    float *x = uv ? items(&a, o[2], 1, 4, n, NULL) : NULL;
    float *y = x ? items(&a, o[3], 1, 4, n, NULL) : NULL;
    int8_t *group = y ? items(&a, o[4], 1, 1, n, NULL) : NULL;
    if (!group) {
        release(&a);
        return NULL;
    }
    static const int8_t group_of_quarter[4] = {1, 3, 0, 2};
    float turn = (float)psi, within = (float)(gate / 90.0), f = (float)scale;
    Py_ssize_t ends[5] = {0, 0, 0, 0, 0}, at[4];
    for (Py_ssize_t i = 0; i < n; i++) {
        float t = (phi[i] - turn) * (1.0f / 90.0f), nearest = rintf(t);
        int g = fabsf(t - nearest) < within ? group_of_quarter[(int)nearest & 3] : 4;
        group[i] = (int8_t)g;
        if (g < 4) ends[g + 1]++;
    }
    for (int g = 0; g < 4; g++) at[g] = ends[g], ends[g + 1] += ends[g];
    for (Py_ssize_t i = 0; i < n; i++) {
        int g = group[i];
        if (g == 4) continue;
        x[at[g]] = uv[2 * i] * f;
        y[at[g]++] = uv[2 * i + 1] * f;
    }
    release(&a);
    return Py_BuildValue("(nnnnn)", ends[0], ends[1], ends[2], ends[3], ends[4]);
}

static PyObject *vote(PyObject *self, PyObject *args) {
    PyObject *o[3];
    double c[2], s[2], first;
    Py_ssize_t n, bins, stride, e[5];
    if (!PyArg_ParseTuple(args, "OO(nnnnn)dddddnnO", &o[0], &o[1], &e[0], &e[1], &e[2], &e[3], &e[4], &c[0], &s[0], &c[1],
                          &s[1], &first, &bins, &stride, &o[2]))
        return NULL;
    Arrays a = {.count = 0};
    const float *x = items(&a, o[0], 0, 4, 0, &n);
    const float *y = x ? items(&a, o[1], 0, 4, n, NULL) : NULL;
    int64_t *votes = y && bins >= 0 ? items(&a, o[2], 1, 8, 4 * bins, NULL) : NULL;
    if (!votes || stride < 1) goto failed;
    for (int g = 0; g < 4; g++) {
        if (e[g] < 0 || e[g] > e[g + 1] || e[g + 1] > n) goto failed;
        float cf = (float)c[g / 2], sf = (float)s[g / 2], origin = (float)first;
        int64_t *mine = votes + g * bins;
        for (Py_ssize_t i = e[g]; i < e[g + 1]; i += stride) {
            float cell = cf * x[i] + sf * y[i] - origin;
            if (cell >= 0.0f && cell < (float)bins) mine[(Py_ssize_t)cell]++;
        }
    }
    release(&a);
    Py_RETURN_NONE;
failed:
    release(&a);
    if (!PyErr_Occurred()) PyErr_SetString(PyExc_ValueError, "bounds of the groups, bins or stride do not fit");
    return NULL;
}

static PyObject *project(PyObject *self, PyObject *args) {
    PyObject *o[4];
    double c, s, about_x, about_y;
    Py_ssize_t n, half;
    if (!PyArg_ParseTuple(args, "OOnddddOO", &o[0], &o[1], &half, &c, &s, &about_x, &about_y, &o[2], &o[3])) return NULL;
    Arrays arrays = {.count = 0};
    const float *seen_x = items(&arrays, o[0], 0, 4, 0, &n);
    const float *seen_y = seen_x ? items(&arrays, o[1], 0, 4, n, NULL) : NULL;
    float *rho = seen_y ? items(&arrays, o[2], 1, 4, n, NULL) : NULL;
    float *tangent = rho ? items(&arrays, o[3], 1, 4, n, NULL) : NULL;
    if (!tangent || half < 0 || half > n) {
        release(&arrays);
        if (!PyErr_Occurred()) PyErr_SetString(PyExc_ValueError, "half outside the points");
        return NULL;
    }
    float cf = (float)c, sf = (float)s, a = (float)about_x, b = (float)about_y;
    for (int axis = 0; axis < 2; axis++) {
        Py_ssize_t from = axis ? half : 0, to = axis ? n : half;
        for (Py_ssize_t i = from; i < to; i++) {
            float scale = 1.0f / (1.0f + a * seen_y[i] - b * seen_x[i]);
            float x = (seen_x[i] + b) * scale, y = (seen_y[i] - a) * scale;
            float first = cf * x + sf * y, second = cf * y - sf * x;
            rho[i] = axis ? second : first;
            tangent[i] = axis ? -first : second;
        }
    }
    release(&arrays);
    Py_RETURN_NONE;
}

static PyObject *assign(PyObject *self, PyObject *args) {
    PyObject *o[7];
    double gate;
    Py_ssize_t n, lines, e[5], out = 0, kept[5] = {0, 0, 0, 0, 0};
    int64_t first[5] = {0, 0, 0, 0, 0};
    if (!PyArg_ParseTuple(args, "OOOO(nnnnn)OOdO", &o[0], &o[1], &o[2], &o[3], &e[0], &e[1], &e[2], &e[3], &e[4], &o[4],
                          &o[5], &gate, &o[6]))
        return NULL;
    Arrays a = {.count = 0};
    float *x = items(&a, o[0], 1, 4, 0, &n);
    float *y = x ? items(&a, o[1], 1, 4, n, NULL) : NULL;
    float *rho = y ? items(&a, o[2], 1, 4, n, NULL) : NULL;
    float *tangent = rho ? items(&a, o[3], 1, 4, n, NULL) : NULL;
    const double *offset = tangent ? items(&a, o[4], 0, 8, 0, &lines) : NULL; /* rising within each group */
    const int64_t *counts = offset ? items(&a, o[5], 0, 8, 4, NULL) : NULL;
    int32_t *line = counts ? items(&a, o[6], 1, 4, n, NULL) : NULL;
    if (!line) goto failed;
    for (int g = 0; g < 4; g++) {
        if (counts[g] < 0 || e[g] < 0 || e[g] > e[g + 1]) goto unsorted;
        first[g + 1] = first[g] + counts[g];
    }
    if (first[4] > lines || e[0] != 0 || e[4] > n) goto unsorted;
    for (int g = 0; g < 4; g++) {
        int64_t k = first[g], last = first[g + 1] - 1;
        for (Py_ssize_t i = e[g]; i < e[g + 1] && k <= last; i++) {
            float r = rho[i];
            /* neighbours in the picture are mostly on the same line: walk from the last one */
            while (k < last && r - offset[k] > offset[k + 1] - r) k++;
            while (k > first[g] && offset[k] - r >= r - offset[k - 1]) k--;
            if (fabs(r - offset[k]) >= gate) continue;
            x[out] = x[i], y[out] = y[i], rho[out] = r, tangent[out] = tangent[i];
            line[out++] = (int32_t)k;
        }
        kept[g + 1] = out;
    }
    release(&a);
    return Py_BuildValue("(nnnnn)", kept[0], kept[1], kept[2], kept[3], kept[4]);
unsorted:
    PyErr_SetString(PyExc_ValueError, "counts of lines or points do not fit their arrays");
failed:
    release(&a);
    return NULL;
}

static PyObject *sums(PyObject *self, PyObject *args) {
    PyObject *o[6];
    Py_ssize_t n, lines, half;
    if (!PyArg_ParseTuple(args, "OOOnOOO", &o[0], &o[1], &o[2], &half, &o[3], &o[4], &o[5])) return NULL;
    Arrays a = {.count = 0};
    const float *rho = items(&a, o[0], 0, 4, 0, &n);
    const float *tangent = rho ? items(&a, o[1], 0, 4, n, NULL) : NULL;
    const int32_t *line = tangent ? items(&a, o[2], 0, 4, n, NULL) : NULL;
    int64_t *count = line ? items(&a, o[3], 1, 8, 0, &lines) : NULL;
    double *total = count ? items(&a, o[4], 1, 8, 4 * lines, NULL) : NULL;
    double *product = total ? items(&a, o[5], 1, 8, 16, NULL) : NULL;
    if (!product) goto failed;
    double p[4][4] = {{0}};
    for (Py_ssize_t i = 0; i < n; i++) {
        int32_t k = line[i];
        if (!is_line(k, lines, i)) goto failed;
        double r = rho[i], t = tangent[i], across = r * t, own = 1.0 + r * r;
        double row[4] = {r, t, i < half ? -across : -own, i < half ? own : -across};
        count[k]++;
        for (int u = 0; u < 4; u++) {
            total[4 * k + u] += row[u];
            for (int v = u; v < 4; v++) p[u][v] += row[u] * row[v];
        }
    }
    for (int u = 0; u < 4; u++)
        for (int v = 0; v < 4; v++) product[4 * u + v] = u <= v ? p[u][v] : p[v][u];
    release(&a);
    Py_RETURN_NONE;
failed:
    release(&a);
    return NULL;
}

static PyObject *extents(PyObject *self, PyObject *args) {
    PyObject *o[4];
    Py_ssize_t n, lines;
    if (!PyArg_ParseTuple(args, "OOOO", &o[0], &o[1], &o[2], &o[3])) return NULL;
    Arrays a = {.count = 0};
    const float *tangent = items(&a, o[0], 0, 4, 0, &n);
    const int32_t *line = tangent ? items(&a, o[1], 0, 4, n, NULL) : NULL;
    double *low = line ? items(&a, o[2], 1, 8, 0, &lines) : NULL;
    double *high = low ? items(&a, o[3], 1, 8, lines, NULL) : NULL;
    if (!high) goto failed;
    for (Py_ssize_t i = 0; i < n; i++) {
        int32_t k = line[i];
        if (!is_line(k, lines, i)) goto failed;
        if (tangent[i] < low[k]) low[k] = tangent[i];
        if (tangent[i] > high[k]) high[k] = tangent[i];
    }
    release(&a);
    Py_RETURN_NONE;
failed:
    release(&a);
    return NULL;
}

static PyObject *means(PyObject *self, PyObject *args) {
    PyObject *o[4];
    Py_ssize_t n, lines;
    if (!PyArg_ParseTuple(args, "OOOO", &o[0], &o[1], &o[2], &o[3])) return NULL;
    Arrays a = {.count = 0};
    const float *rho = items(&a, o[0], 0, 4, 0, &n);
    const int32_t *line = rho ? items(&a, o[1], 0, 4, n, NULL) : NULL;
    int64_t *count = line ? items(&a, o[2], 1, 8, 0, &lines) : NULL;
    double *total = count ? items(&a, o[3], 1, 8, lines, NULL) : NULL;
    if (!total) goto failed;
    for (Py_ssize_t i = 0; i < n; i++) {
        if (!is_line(line[i], lines, i)) goto failed;
        count[line[i]]++;
        total[line[i]] += rho[i];
    }
    release(&a);
    Py_RETURN_NONE;
failed:
    release(&a);
    return NULL;
}

static PyObject *hits(PyObject *self, PyObject *args) {
    PyObject *o[3];
    double x, y, low;
    Py_ssize_t rows, bins, n;
    if (!PyArg_ParseTuple(args, "OOdddnnO", &o[0], &o[1], &x, &y, &low, &rows, &bins, &o[2])) return NULL;
    Arrays a = {.count = 0};
    const int32_t *row = items(&a, o[1], 0, 4, 0, &n);
    const float *points = row ? items(&a, o[0], 0, 4, 2 * n, NULL) : NULL;
    uint8_t *hit = points && rows >= 0 && bins >= 0 ? items(&a, o[2], 1, 1, rows * bins, NULL) : NULL;
    if (!hit) goto failed;
    float xf = (float)x, yf = (float)y, first = (float)low;
    for (Py_ssize_t i = 0; i < n; i++) {
        if (row[i] < 0) continue;
        if (!is_line(row[i], rows, i)) goto failed;
        float along = xf * points[2 * i] + yf * points[2 * i + 1] - first;
        if (along >= 0.0f && along < (float)bins) hit[row[i] * bins + (Py_ssize_t)along] = 1;
    }
    release(&a);
    Py_RETURN_NONE;
failed:
    release(&a);
    if (!PyErr_Occurred()) PyErr_SetString(PyExc_ValueError, "rows or bins below 0");
    return NULL;
}

static PyMethodDef methods[] = {
    {"level_points", level_points, METH_VARARGS, NULL},
    {"follow", follow, METH_VARARGS, NULL},
    {"split", split, METH_VARARGS, NULL},
    {"vote", vote, METH_VARARGS, NULL},
    {"project", project, METH_VARARGS, NULL},
    {"assign", assign, METH_VARARGS, NULL},
    {"sums", sums, METH_VARARGS, NULL},
    {"means", means, METH_VARARGS, NULL},
    {"hits", hits, METH_VARARGS, NULL},
    {"extents", extents, METH_VARARGS, NULL},
    {NULL, NULL, 0, NULL},
};

static struct PyModuleDef module = {PyModuleDef_HEAD_INIT, "ceilvo.daemon._kernel", NULL, -1, methods,
                                    NULL, NULL, NULL, NULL};

PyMODINIT_FUNC PyInit__kernel(void) { return PyModule_Create(&module); }
