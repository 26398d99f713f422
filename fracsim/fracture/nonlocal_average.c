/* Weighted averages over the points within a radius (fracture.nonlocal_average).

   Points lie in cubic bins, sorted by bin and within a bin by number. All centres of a group see the same points in the
   same order, and a point beyond the radius adds 0. So a sum is the same to the last bit in any group. */

#include <math.h>
#include <stdint.h>

/* numbers in a vector register: GCC takes fifteen times as long for longer vectors */
#if defined(__AVX512F__)
#define LANES 8
#elif defined(__AVX__)
#define LANES 4
#else
#define LANES 2
#endif
enum { COARSE_LANES = 2 * LANES, MAX_WIDTH = 7 };
enum { LINEAR, CONSTANT, GAUSSIAN };

typedef struct {
    const double *origin;        /* (3,) corner of the first bin */
    const int64_t *bins;         /* (3,) numbers of bins */
    const int64_t *start;        /* (bins + 1,) first point of each bin, x fastest */
    const double *x, *y, *z;     /* (points,) */
    const float *coarse;         /* (3, points) coordinates over the radius, relative to the origin, rounded */
    double size, radius;         /* edge of a bin; radius */
    double slack, margin;        /* rounding may move a point so far into another bin; rounding error of coarse distances
                                    over the radius */
    int64_t points, kernel;
} Points;

/* Bins that may have points within the radius of a box. */
typedef struct {
    double low[3], high[3], inverse_size;
    int64_t first[3], last[3], y, z;
} Search;

static int64_t clip(double place, int64_t count)
{
    return place < 0 ? 0 : place > (double)(count - 1) ? count - 1 : (int64_t)place;
}

static void begin_search(const Points *p, Search *s)
{
    s->inverse_size = 1 / p->size;
    for (int i = 0; i < 3; i++) {
        s->low[i] -= p->origin[i] + p->slack, s->high[i] += p->slack - p->origin[i];
        s->first[i] = clip((s->low[i] - p->radius) * s->inverse_size, p->bins[i]);
        s->last[i] = clip((s->high[i] + p->radius) * s->inverse_size, p->bins[i]);
    }
    s->y = s->first[1] - 1, s->z = s->first[2];
}

/* Distance of the box from the i-th layer of bins along an axis. */
static double layer_distance(const Points *p, const Search *s, int axis, int64_t i)
{
    const double begin = (double)i * p->size, gap = begin - s->high[axis], other = s->low[axis] - begin - p->size;
    return gap > 0 ? gap : other > 0 ? other : 0;
}

/* Find the next points [begin, end) in a row of bins along x; 0 after the last row. */
static int next_run(const Points *p, Search *s, int64_t *begin, int64_t *end)
{
    for (;;) {
        if (++s->y > s->last[1]) s->y = s->first[1], s->z++;
        if (s->z > s->last[2]) return 0;
        const double dy = layer_distance(p, s, 1, s->y), dz = layer_distance(p, s, 2, s->z);
        const double rest = p->radius * p->radius - dy * dy - dz * dz;
        if (rest < 0) continue;
        const double reach = sqrt(rest);
        const int64_t row = (s->z * p->bins[1] + s->y) * p->bins[0];
        *begin = p->start[row + clip((s->low[0] - reach) * s->inverse_size, p->bins[0])];
        *end = p->start[row + clip((s->high[0] + reach) * s->inverse_size, p->bins[0]) + 1];
        if (*begin < *end) return 1;
    }
}

#define INLINE static inline __attribute__((always_inline))

/* one number a centre, at a time */
typedef double wide __attribute__((vector_size(8 * LANES)));
typedef int64_t mask __attribute__((vector_size(8 * LANES)));
typedef float coarse __attribute__((vector_size(4 * COARSE_LANES)));
typedef int32_t coarse_mask __attribute__((vector_size(4 * COARSE_LANES)));

INLINE wide roots(wide x)
{
    for (int l = 0; l < LANES; l++) x[l] = sqrt(x[l]);
    return x;
}
INLINE coarse coarse_roots(coarse x)
{
    for (int l = 0; l < COARSE_LANES; l++) x[l] = sqrtf(x[l]);
    return x;
}
INLINE wide where(mask m, wide x) { return (wide)(m & (mask)x); }
INLINE coarse coarse_where(coarse_mask m, coarse x) { return (coarse)(m & (coarse_mask)x); }

/* exp(-4.5 x), 0 <= x <= 1, to 1e-14: Taylor polynomial of the 16th root. */
INLINE wide exponential(wide x)
{
    wide e = x * 0 + 1;
    for (int n = 11; n > 0; n--) e = 1 - e * x * (4.5 / 16 / n);
    e *= e, e *= e, e *= e;
    return e * e;
}
INLINE coarse coarse_exponential(coarse x)
{
    coarse e = x * 0 + 1;
    for (int n = 5; n > 0; n--) e = 1 - e * x * (4.5f / 16 / n);
    e *= e, e *= e, e *= e;
    return e * e;
}

/* Sums over the points around the centres: of weights, and of weights times values (points, width). Points without
   volume are left out. */
INLINE void sum_around(
    const Points *p, const wide c[3], const double *volume, int width, const double *values, int64_t kernel,
    wide *weights, wide sums[MAX_WIDTH])
{
    Search s;
    const double radius2 = p->radius * p->radius, inverse = 1 / p->radius;
    for (int i = 0; i < 3; i++) {
        s.low[i] = s.high[i] = c[i][0];
        for (int l = 1; l < LANES; l++) s.low[i] = fmin(s.low[i], c[i][l]), s.high[i] = fmax(s.high[i], c[i][l]);
    }
    const wide cx = c[0], cy = c[1], cz = c[2];
    wide total = {0}, own[MAX_WIDTH] = {{0}};
    int64_t begin, end;
    for (begin_search(p, &s); next_run(p, &s, &begin, &end);)
        for (int64_t k = begin; k < end; k++) {
            if (!(volume[k] > 0)) continue;
            const wide dx = cx - p->x[k], dy = cy - p->y[k], dz = cz - p->z[k], d2 = dx * dx + dy * dy + dz * dz;
            wide w = d2 * 0 + 1;
            if (kernel == LINEAR) w = 1 - roots(d2) * inverse, w = where(w > 0, w);
            if (kernel == GAUSSIAN) w = exponential(d2 * (inverse * inverse));
            w = where(d2 <= radius2, w * volume[k]);
            total += w;
            for (int n = 0; n < width; n++) own[n] += w * values[width * k + n];
        }
    *weights = total;
    for (int n = 0; n < width; n++) sums[n] = own[n];
}

/* Averages (count, width) of values (points, width) around some of the centres (centres, 3), 0 without volume nearby.
   `volume` (points,) is 0 where a point does not enter. */
void averages_around(
    const void *arrays, int64_t count, const int64_t *chosen, const double *centres, const double *volume,
    int64_t width, const double *values, double *result)
{
    const Points *p = arrays;
    for (int64_t first = 0; first < count; first += LANES) {
        wide c[3] = {{0}}, weights, sums[MAX_WIDTH];
        for (int l = 0; l < LANES; l++)
            for (int i = 0; i < 3; i++) c[i][l] = centres[3 * chosen[first + l < count ? first + l : first] + i];
#define SUM(columns, kernel) sum_around(p, c, volume, columns, values, kernel, &weights, sums)
#define SUM_OF(columns) \
    p->kernel == LINEAR ? SUM(columns, LINEAR) : p->kernel == CONSTANT ? SUM(columns, CONSTANT) : SUM(columns, GAUSSIAN)
        if (width == 7) SUM_OF(7);
        else if (width == 4) SUM_OF(4);
        else SUM_OF((int)width);
        for (int l = 0; l < LANES && first + l < count; l++)
            for (int64_t n = 0; n < width; n++)
                result[width * (first + l) + n] = weights[l] > 0 ? sums[n][l] / weights[l] : 0;
    }
}

/* Upper bounds: sums around the centres of loads, at least, and of volumes, at most, by rounded distances. */
INLINE void bound_around(
    const Points *p, Search s, const coarse c[3], const float *volume, const float *load, int64_t kernel,
    coarse *volumes, coarse *loads)
{
    const float *x = p->coarse, *y = x + p->points, *z = y + p->points;
    const float far = 1 + (float)p->margin, near = 1 - (float)p->margin;
    const coarse cx = c[0], cy = c[1], cz = c[2];
    coarse v = {0}, f = {0};
    int64_t begin, end;
    for (begin_search(p, &s); next_run(p, &s, &begin, &end);)
        for (int64_t k = begin; k < end; k++) {
            const coarse dx = cx - x[k], dy = cy - y[k], dz = cz - z[k], d2 = dx * dx + dy * dy + dz * dz;
            const coarse q = coarse_roots(d2), shape = kernel == GAUSSIAN ? coarse_exponential(d2) : d2 * 0 + 1;
            const coarse most = kernel == LINEAR ? far - q : shape, least = kernel == LINEAR ? near - q : shape;
            f += coarse_where(q <= far, most) * load[k], v += coarse_where(q <= near, least) * volume[k];
        }
    *volumes = v, *loads = f;
}

/* Find the centres (count, 3) whose average of a load may reach 1, in single precision.

   `volume` (points,) is over a mean volume, `load` (points,) a volume times the load. `share` is 1 less the rounding
   error of sums. Of the centres (count,) in `order` those that lie close together are in sequence. Returns their
   number, and their numbers in `result`. */
int64_t find_centres(
    const void *arrays, int64_t count, const int64_t *order, const double *centres, const float *volume,
    const float *load, double share, int64_t *result)
{
    const Points *p = arrays;
    int64_t found = 0;
    for (int64_t first = 0; first < count; first += COARSE_LANES) {
        const int64_t *group = order + first;
        const int size = count - first < COARSE_LANES ? (int)(count - first) : COARSE_LANES;
        coarse c[3] = {{0}}, volumes, loads;
        Search s;
        for (int i = 0; i < 3; i++) {
            s.low[i] = s.high[i] = centres[3 * group[0] + i];
            for (int l = 0; l < COARSE_LANES; l++) {
                const double x = centres[3 * group[l < size ? l : 0] + i];
                s.low[i] = fmin(s.low[i], x), s.high[i] = fmax(s.high[i], x);
                c[i][l] = (float)((x - p->origin[i]) / p->radius);
            }
        }
#define BOUND(kernel) bound_around(p, s, c, volume, load, kernel, &volumes, &loads)
        p->kernel == LINEAR ? BOUND(LINEAR) : p->kernel == CONSTANT ? BOUND(CONSTANT) : BOUND(GAUSSIAN);
        for (int l = 0; l < size; l++)
            if (loads[l] >= (float)share * volumes[l]) result[found++] = group[l];
    }
    return found;
}
