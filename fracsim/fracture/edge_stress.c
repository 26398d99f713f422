/* Stress along the edges of cells (fracture.edge_stress). A cell has d + 1 corners of d coordinates and PAIRS edges in
   DOLFINx's order; broken edges are bits of its pattern. Its stress s has PAIRS components, cell after cell, or
   `stride` apart. Sums have the order of array code, so that results are the same to the last digit. */

#include <float.h>
#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#define INLINE static inline __attribute__((always_inline)) /* compiled for each of two dimensions */

static const int64_t EDGES[2][6][2] = {{{1, 2}, {0, 2}, {0, 1}}, {{2, 3}, {1, 3}, {1, 2}, {0, 3}, {0, 2}, {0, 1}}};
static const int64_t COMPONENTS[2][6][2] = {{{0, 0}, {1, 1}, {0, 1}}, {{0, 0}, {1, 1}, {2, 2}, {0, 1}, {0, 2}, {1, 2}}};

#define ROUND_OFF 1e-12 /* of a bound, relative to the norm of the stress */
#define PAIRS(d) ((d) * ((d) + 1) / 2)

typedef struct {
    int64_t count;
    const int32_t *nodes;        /* (cells, d + 1) */
    const double *rest, *moved;  /* (nodes, d) at rest, and displacement; NULL: none */
} Simplices;

typedef struct {
    const int32_t *edges;                     /* (cells, PAIRS) */
    const double *integrity;                  /* (edges,) */
    const uint8_t *pattern, *damaged, *split; /* (cells,) */
} Graph;

INLINE void corners_of(int d, const Simplices *simplices, int64_t cell, double *corners)
{
    for (int i = 0; i <= d; i++)
        for (int p = 0; p < d; p++) {
            int64_t index = (int64_t)d * simplices->nodes[(d + 1) * cell + i] + p;
            corners[d * i + p] = simplices->rest[index];
            if (simplices->moved) corners[d * i + p] = simplices->rest[index] + simplices->moved[index];
        }
}

/* a . b in the order of np.einsum. */
INLINE double dot(int d, const double *a, const double *b)
{
    return d == 2 ? a[0] * b[0] + a[1] * b[1] : a[0] * b[0] + a[2] * b[2] + a[1] * b[1];
}

/* v . s . v and v . v, v the vector of edge k. */
INLINE double quadratic_form(int d, const double *s, const double *corners, int k, double *square)
{
    double v[3], sum = 0;
    for (int p = 0; p < d; p++) v[p] = corners[d * EDGES[d - 2][k][1] + p] - corners[d * EDGES[d - 2][k][0] + p];
    *square = dot(d, v, v);
    for (int c = 0; c < PAIRS(d); c++) {
        int64_t p = COMPONENTS[d - 2][c][0], q = COMPONENTS[d - 2][c][1];
        sum += (p == q ? 1.0 : 2.0) * s[c] * v[p] * v[q];
    }
    return sum;
}

/* Normal stress along edge k. */
INLINE double edge_normal_stress(int d, const double *s, const double *corners, int k)
{
    double square, sum = quadratic_form(d, s, corners, k, &square);
    return square > 0 ? sum / square : 0.0;
}

INLINE void normal_stress_in(
    int d, int64_t count, const int64_t *cells, const Simplices *simplices, const double *s, double *result)
{
    for (int64_t n = 0; n < count; n++, s += PAIRS(d)) {
        double corners[12];
        corners_of(d, simplices, cells[n], corners);
        for (int k = 0; k < PAIRS(d); k++) *result++ = edge_normal_stress(d, s, corners, k);
    }
}

/* Normal stress along all edges of cells (count,); s, result: (count, PAIRS). */
void normal_stress(
    int64_t d, int64_t count, const int64_t *cells, const Simplices *simplices, const double *s, double *result)
{
    if (d == 2) normal_stress_in(2, count, cells, simplices, s, result);
    else normal_stress_in(3, count, cells, simplices, s, result);
}

/* Share of the intact edges in the sum of the absolute normal stresses along all edges. */
INLINE double intact_share(int d, const double *s, const double *corners, const int32_t *edges, const double *integrity)
{
    double total = 0, intact = 0;
    for (int k = 0; k < PAIRS(d); k++) {
        double load = fabs(edge_normal_stress(d, s, corners, k));
        total += load;
        intact += load * integrity[edges[k]];
    }
    return total > 0 ? intact / total : 1.0;
}

INLINE int64_t lower_chi_in(
    int d, const Simplices *simplices, const Graph *graph, int64_t stride, const double *s, double *chi,
    int64_t *changed, double *loss)
{
    int64_t count = 0;
    for (int64_t cell = 0; cell < simplices->count; cell++) {
        if (!graph->damaged[cell] || !(chi[cell] > 0)) continue;
        double corners[12], share = 0;
        if (!graph->split[cell]) {
            corners_of(d, simplices, cell, corners);
            share = intact_share(d, s + stride * cell, corners, graph->edges + PAIRS(d) * cell, graph->integrity);
        }
        if (!(chi[cell] - share > 0)) continue;
        loss[count] = chi[cell] - share;
        chi[cell] = graph->split[cell] ? 0.0 : chi[cell] - loss[count];
        changed[count++] = cell;
    }
    return count;
}

/* Lower chi (cells,) of damaged cells to the intact share of s (cells, PAIRS), where it is less. Returns the number of
   changed cells; `changed` has their numbers, `loss` the decrease of chi. */
int64_t lower_chi(
    int64_t d, const Simplices *simplices, const Graph *graph, int64_t stride, const double *s, double *chi,
    int64_t *changed, double *loss)
{
    if (d == 2) return lower_chi_in(2, simplices, graph, stride, s, chi, changed, loss);
    return lower_chi_in(3, simplices, graph, stride, s, chi, changed, loss);
}

/* Rows of the cofactors of the edges from corner 0, and their determinant. */
INLINE double cofactors(int d, const double *corners, double g[3][3])
{
    double a[3][3];
    for (int i = 0; i < d; i++)
        for (int p = 0; p < d; p++) a[i][p] = corners[d * (i + 1) + p] - corners[p];
    if (d == 2) {
        g[0][0] = a[1][1], g[0][1] = -a[1][0], g[1][0] = -a[0][1], g[1][1] = a[0][0];
        return dot(2, a[0], g[0]);
    }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            const double *p = a[(i + 1) % 3], *q = a[(i + 2) % 3];
            int k = (j + 1) % 3, m = (j + 2) % 3;
            g[i][j] = p[k] * q[m] - p[m] * q[k];
        }
    return dot(3, a[0], g[0]);
}

/* Whether the volume is larger than the round-off of the edges, so that gradients are finite. */
INLINE bool is_regular(int d, const double *corners, double det)
{
    double longest = 0;
    for (int i = 1; i <= d; i++) {
        double square = 0;
        for (int p = 0; p < d; p++) square += (corners[d * i + p] - corners[p]) * (corners[d * i + p] - corners[p]);
        longest = fmax(longest, square);
    }
    return fabs(det) > 1e-12 * (d == 2 ? longest : longest * sqrt(longest));
}

/* Add the part of s that intact edges carry; nothing in flat cells. */
INLINE void add_intact_edge_stress(int d, const double *s, const double *corners, int pattern, double *result)
{
    double rows[3][3], g[4][3] = {{0}}, det = cofactors(d, corners, rows), square;
    if (!is_regular(d, corners, det)) return;
    for (int p = 0; p < d; p++) {
        for (int i = 0; i < d; i++) { g[i + 1][p] = rows[i][p] / det; g[0][p] += g[i + 1][p]; }
        g[0][p] = -g[0][p];
    }
    for (int k = 0; k < PAIRS(d); k++) {
        if (pattern >> k & 1) continue;
        const double *a = g[EDGES[d - 2][k][0]], *b = g[EDGES[d - 2][k][1]];
        const double sum = quadratic_form(d, s, corners, k, &square);
        for (int c = 0; c < PAIRS(d); c++) {
            int64_t p = COMPONENTS[d - 2][c][0], q = COMPONENTS[d - 2][c][1];
            result[c] -= sum * (a[p] * b[q] + a[q] * b[p]) / 2;
        }
    }
}

INLINE void intact_edge_stress_in(
    int d, const Simplices *simplices, const Graph *graph, int64_t stride, const double *s, double *result)
{
    for (int64_t cell = 0; cell < simplices->count; cell++, s += stride, result += PAIRS(d)) {
        bool damaged = graph->damaged[cell];
        for (int c = 0; c < PAIRS(d); c++) result[c] = damaged ? 0.0 : s[c];
        if (!damaged || graph->split[cell]) continue;
        double corners[12];
        corners_of(d, simplices, cell, corners);
        add_intact_edge_stress(d, s, corners, graph->pattern[cell], result);
    }
}

/* Stress of the intact edges of all cells; split cells carry none. s, result: (cells, PAIRS). */
void intact_edge_stress(
    int64_t d, const Simplices *simplices, const Graph *graph, int64_t stride, const double *s, double *result)
{
    if (d == 2) intact_edge_stress_in(2, simplices, graph, stride, s, result);
    else intact_edge_stress_in(3, simplices, graph, stride, s, result);
}

/* Upper bound of the largest eigenvalue of dev s / p, p = |dev s| / sqrt(6), where dev s / p has the determinant 2 r.

   Roots of x^3 - 3 x - 2 r lie in [-2, 2]. The largest, 2 cos(acos(r) / 3), is concave in r, so that tangents bound it.
   From there Newton's method stays above it: by less than 1e-6 for r > -0.8, by 6 % where two eigenvalues are equal. */
static inline double largest_root_bound(double r)
{
    double x = fmin(2.0, sqrt(3.0) + r / 3);
    for (int k = 0; k < 3; k++) x = (2 * (x * x * x + r)) / (3 * (x * x - 1));
    return x;
}

INLINE void normal_stress_bound_in(int d, int64_t count, const double *s, double *result)
{
    for (int64_t n = 0; n < count; n++, s += PAIRS(d)) {
        double mean = 0, square = 0, dev[3] = {0}, largest;
        for (int c = 0; c < d; c++) mean += s[c];
        mean /= d;
        for (int c = 0; c < d; c++) dev[c] = s[c] - mean;
        for (int c = 0; c < PAIRS(d); c++) square += c < d ? dev[c] * dev[c] : 2 * (s[c] * s[c]);
        if (d == 2) {
            largest = mean + sqrt(square / 2);
        } else {
            double p = sqrt(square / 6), scale = p > DBL_MIN ? 1 / p : 0.0;
            double a = dev[0] * scale, b = dev[1] * scale, c = dev[2] * scale;
            double f = s[3] * scale, g = s[4] * scale, h = s[5] * scale;
            largest = mean + p * largest_root_bound((a * (b * c - h * h) - f * (f * c - g * h) + g * (f * h - b * g)) / 2);
        }
        largest += ROUND_OFF * (fabs(mean) + sqrt(square));
        result[n] = largest > 0 ? largest : 0.0;
    }
}

/* Upper bound of the normal stress in any direction, not below 0; s: (count, PAIRS). */
void normal_stress_bound(int64_t d, int64_t count, const double *s, double *result)
{
    if (d == 2) normal_stress_bound_in(2, count, s, result);
    else normal_stress_bound_in(3, count, s, result);
}
