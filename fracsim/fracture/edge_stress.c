/* What fracture.edge_stress does to cells. A cell has d + 1 corners of d coordinates, PAIRS edges in DOLFINx's order, the
   broken ones of which are bits of its pattern, and as many components of a stress s, one cell's after the other or
   `stride` apart. Sums are taken in the order of arrays, to the last digit. */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>

#define INLINE static inline __attribute__((always_inline)) /* in each of two dimensions */

static const int64_t EDGES[2][6][2] = {{{1, 2}, {0, 2}, {0, 1}}, {{2, 3}, {1, 3}, {1, 2}, {0, 3}, {0, 2}, {0, 1}}};
static const int64_t COMPONENTS[2][6][2] = {{{0, 0}, {1, 1}, {0, 1}}, {{0, 0}, {1, 1}, {2, 2}, {0, 1}, {0, 2}, {1, 2}}};

#define PAIRS(d) ((d) * ((d) + 1) / 2)

typedef struct {
    int64_t count;
    const int32_t *nodes;        /* (cells, d + 1) */
    const double *rest, *moved;  /* (nodes, d), and by how much they have; NULL: not at all */
} Simplices;

typedef struct {
    const int32_t *edges;                     /* (cells, PAIRS) */
    const double *integrity;                  /* (edges,) */
    const uint8_t *pattern, *damaged, *split; /* (cells,) */
} Graph;

INLINE void corners_of(int d, const Simplices *all, int64_t cell, double *corners)
{
    for (int i = 0; i <= d; i++)
        for (int p = 0; p < d; p++) {
            int64_t at = (int64_t)d * all->nodes[(d + 1) * cell + i] + p;
            corners[d * i + p] = all->moved ? all->rest[at] + all->moved[at] : all->rest[at];
        }
}

/* a . b as np.einsum has it. */
INLINE double dot(int d, const double *a, const double *b)
{
    return d == 2 ? a[0] * b[0] + a[1] * b[1] : a[0] * b[0] + a[2] * b[2] + a[1] * b[1];
}

/* v . s . v and v . v of the vector of edge k. */
INLINE double form(int d, const double *s, const double *corners, int k, double *square)
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
INLINE double normal_along(int d, const double *s, const double *corners, int k)
{
    double square, sum = form(d, s, corners, k, &square);
    return square > 0 ? sum / square : 0.0;
}

INLINE void normal_of(
    int d, int64_t count, const int64_t *cells, const Simplices *all, const double *s, double *along)
{
    for (int64_t n = 0; n < count; n++, s += PAIRS(d)) {
        double corners[12];
        corners_of(d, all, cells[n], corners);
        for (int k = 0; k < PAIRS(d); k++) *along++ = normal_along(d, s, corners, k);
    }
}

/* s, along: (count, PAIRS). */
void normal(
    int64_t d, int64_t count, const int64_t *cells, const Simplices *all, const double *s, double *along)
{
    if (d == 2) normal_of(2, count, cells, all, s, along);
    else normal_of(3, count, cells, all, s, along);
}

/* What intact edges carry of the normal stress along all of them. */
INLINE double share_of(int d, const double *s, const double *corners, const int32_t *edges, const double *integrity)
{
    double whole = 0, kept = 0;
    for (int k = 0; k < PAIRS(d); k++) {
        double load = fabs(normal_along(d, s, corners, k));
        whole += load;
        kept += load * integrity[edges[k]];
    }
    return whole > 0 ? kept / whole : 1.0;
}

INLINE int64_t lower_of(
    int d, const Simplices *all, const Graph *graph, int64_t stride, const double *s, double *chi, int64_t *found,
    double *lost)
{
    int64_t many = 0;
    for (int64_t cell = 0; cell < all->count; cell++) {
        if (!graph->damaged[cell] || !(chi[cell] > 0)) continue;
        double corners[12], share = 0;
        if (!graph->split[cell]) {
            corners_of(d, all, cell, corners);
            share = share_of(d, s + stride * cell, corners, graph->edges + PAIRS(d) * cell, graph->integrity);
        }
        if (!(chi[cell] - share > 0)) continue;
        lost[many] = chi[cell] - share;
        chi[cell] = graph->split[cell] ? 0.0 : chi[cell] - lost[many];
        found[many++] = cell;
    }
    return many;
}

/* s: (cells, PAIRS). chi (cells,) of damaged cells falls to what they carry, where that is less; returns how many it
   has, the first ones of `found`, and how much they `lost`. */
int64_t lower(
    int64_t d, const Simplices *all, const Graph *graph, int64_t stride, const double *s, double *chi, int64_t *found,
    double *lost)
{
    if (d == 2) return lower_of(2, all, graph, stride, s, chi, found, lost);
    return lower_of(3, all, graph, stride, s, chi, found, lost);
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

/* Whether gradients are safe: the volume is not lost in the round-off of the edges. */
INLINE bool regular(int d, const double *corners, double det)
{
    double longest = 0;
    for (int i = 1; i <= d; i++) {
        double square = 0;
        for (int p = 0; p < d; p++) square += (corners[d * i + p] - corners[p]) * (corners[d * i + p] - corners[p]);
        longest = fmax(longest, square);
    }
    return fabs(det) > 1e-12 * (d == 2 ? longest : longest * sqrt(longest));
}

/* The part of s that intact edges carry; zero in flat cells. */
INLINE void carried_by(int d, const double *s, const double *corners, int pattern, double *found)
{
    double rows[3][3], g[4][3] = {{0}}, det = cofactors(d, corners, rows), square;
    if (!regular(d, corners, det)) return;
    for (int p = 0; p < d; p++) {
        for (int i = 0; i < d; i++) { g[i + 1][p] = rows[i][p] / det; g[0][p] += g[i + 1][p]; }
        g[0][p] = -g[0][p];
    }
    for (int k = 0; k < PAIRS(d); k++) {
        if (pattern >> k & 1) continue;
        const double *a = g[EDGES[d - 2][k][0]], *b = g[EDGES[d - 2][k][1]], sum = form(d, s, corners, k, &square);
        for (int c = 0; c < PAIRS(d); c++) {
            int64_t p = COMPONENTS[d - 2][c][0], q = COMPONENTS[d - 2][c][1];
            found[c] -= sum * (a[p] * b[q] + a[q] * b[p]) / 2;
        }
    }
}

INLINE void carried_of(
    int d, const Simplices *all, const Graph *graph, int64_t stride, const double *s, double *found)
{
    for (int64_t cell = 0; cell < all->count; cell++, s += stride, found += PAIRS(d)) {
        bool damaged = graph->damaged[cell];
        for (int c = 0; c < PAIRS(d); c++) found[c] = damaged ? 0.0 : s[c];
        if (!damaged || graph->split[cell]) continue;
        double corners[12];
        corners_of(d, all, cell, corners);
        carried_by(d, s, corners, graph->pattern[cell], found);
    }
}

/* s, found: (cells, PAIRS), the latter what is left of s where broken edges and cells that have come apart carry none. */
void carried(
    int64_t d, const Simplices *all, const Graph *graph, int64_t stride, const double *s, double *found)
{
    if (d == 2) carried_of(2, all, graph, stride, s, found);
    else carried_of(3, all, graph, stride, s, found);
}

INLINE void pull_of(int d, int64_t count, const double *s, double *found)
{
    for (int64_t n = 0; n < count; n++, s += PAIRS(d)) {
        double mean = 0, square = 0;
        for (int c = 0; c < d; c++) mean += s[c];
        mean /= d;
        for (int c = 0; c < PAIRS(d); c++) square += c < d ? (s[c] - mean) * (s[c] - mean) : 2 * (s[c] * s[c]);
        double most = mean + sqrt((1 - 1.0 / d) * square);
        found[n] = most > 0 ? most : 0.0;
    }
}

/* s: (count, PAIRS). */
void pull(int64_t d, int64_t count, const double *s, double *found)
{
    if (d == 2) pull_of(2, count, s, found);
    else pull_of(3, count, s, found);
}
