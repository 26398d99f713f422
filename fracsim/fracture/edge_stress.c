/* What fracture.edge_stress does to each cell. A cell has d + 1 corners of d coordinates, PAIRS edges in DOLFINx's order
   and as many components of a stress. Sums are taken in the order of arrays, to the last digit. */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>

static const int64_t EDGES[2][6][2] = {{{1, 2}, {0, 2}, {0, 1}}, {{2, 3}, {1, 3}, {1, 2}, {0, 3}, {0, 2}, {0, 1}}};
static const int64_t COMPONENTS[2][6][2] = {{{0, 0}, {1, 1}, {0, 1}}, {{0, 0}, {1, 1}, {2, 2}, {0, 1}, {0, 2}, {1, 2}}};

#define PAIRS(d) ((d) * ((d) + 1) / 2)

/* a . b as np.einsum has it. */
static inline double dot(int d, const double *a, const double *b)
{
    return d == 2 ? a[0] * b[0] + a[1] * b[1] : a[0] * b[0] + a[2] * b[2] + a[1] * b[1];
}

/* v . s . v and v . v of the vector of edge k. */
static inline double form(int d, const double *s, const double *corners, int k, double *square)
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

static inline void normal_of(int d, int64_t count, const double *s, const double *corners, double *along)
{
    for (int64_t n = 0; n < count; n++, s += PAIRS(d), corners += d * (d + 1))
        for (int k = 0; k < PAIRS(d); k++) {
            double square, sum = form(d, s, corners, k, &square);
            *along++ = square > 0 ? sum / square : 0.0;
        }
}

void normal(int64_t d, int64_t count, const double *s, const double *corners, double *along)
{
    if (d == 2) normal_of(2, count, s, corners, along);
    else normal_of(3, count, s, corners, along);
}

static inline void share_of(
    int d, int64_t count, const double *s, const double *corners, const double *integrity, double *share)
{
    for (int64_t n = 0; n < count; n++, s += PAIRS(d), corners += d * (d + 1), integrity += PAIRS(d)) {
        double whole = 0, kept = 0, square;
        for (int k = 0; k < PAIRS(d); k++) {
            double sum = form(d, s, corners, k, &square), load = square > 0 ? fabs(sum / square) : 0.0;
            whole += load;
            kept += load * integrity[k];
        }
        share[n] = whole > 0 ? kept / whole : 1.0;
    }
}

void share(int64_t d, int64_t count, const double *s, const double *corners, const double *integrity, double *share)
{
    if (d == 2) share_of(2, count, s, corners, integrity, share);
    else share_of(3, count, s, corners, integrity, share);
}

/* Rows of the cofactors of the edges from corner 0, and their determinant. */
static inline double cofactors(int d, const double *corners, double g[3][3])
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
static inline bool regular(int d, const double *corners, double det)
{
    double longest = 0;
    for (int i = 1; i <= d; i++) {
        double square = 0;
        for (int p = 0; p < d; p++) square += (corners[d * i + p] - corners[p]) * (corners[d * i + p] - corners[p]);
        longest = fmax(longest, square);
    }
    return fabs(det) > 1e-12 * (d == 2 ? longest : longest * sqrt(longest));
}

static inline void carried_of(
    int d, int64_t count, const double *s, const double *corners, const uint8_t *intact, double *found)
{
    for (int64_t n = 0; n < count; n++, s += PAIRS(d), corners += d * (d + 1), intact += PAIRS(d), found += PAIRS(d)) {
        double rows[3][3], g[4][3] = {{0}}, det = cofactors(d, corners, rows), square;
        for (int c = 0; c < PAIRS(d); c++) found[c] = 0;
        if (!regular(d, corners, det)) continue;
        for (int p = 0; p < d; p++) {
            for (int i = 0; i < d; i++) { g[i + 1][p] = rows[i][p] / det; g[0][p] += g[i + 1][p]; }
            g[0][p] = -g[0][p];
        }
        for (int k = 0; k < PAIRS(d); k++) {
            if (!intact[k]) continue;
            const double *a = g[EDGES[d - 2][k][0]], *b = g[EDGES[d - 2][k][1]], sum = form(d, s, corners, k, &square);
            for (int c = 0; c < PAIRS(d); c++) {
                int64_t p = COMPONENTS[d - 2][c][0], q = COMPONENTS[d - 2][c][1];
                found[c] -= sum * (a[p] * b[q] + a[q] * b[p]) / 2;
            }
        }
    }
}

void carried(int64_t d, int64_t count, const double *s, const double *corners, const uint8_t *intact, double *found)
{
    if (d == 2) carried_of(2, count, s, corners, intact, found);
    else carried_of(3, count, s, corners, intact, found);
}

static inline void pull_of(int d, int64_t count, const double *s, double *found)
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

void pull(int64_t d, int64_t count, const double *s, double *found)
{
    if (d == 2) pull_of(2, count, s, found);
    else pull_of(3, count, s, found);
}
