/* What elements of closed surfaces sum up to (mesh.split_surface.polyhedron_moments). */

#include <stdint.h>

/* Signed volume of the cone from the origin over an element with corners x (d, d). */
static double cone(int64_t d, const double *x)
{
    if (d == 2) return (x[0] * x[3] - x[1] * x[2]) / 2;
    return (x[0] * (x[4] * x[8] - x[5] * x[7]) + x[1] * (x[5] * x[6] - x[3] * x[8]) + x[2] * (x[3] * x[7] - x[4] * x[6]))
           / 6;
}

/* Of `count` bodies, whose sums are 0 so far: `near` (count, d) the mean of the corners of all elements (m, d) of each,
   and from there `volume` (count,), `first` (count, d): sum V s, and `second` (count, d, d): sum V (sum x x^T + s s^T). */
void sums(int64_t m, int64_t d, int64_t count, const double *points, const int64_t *elements, const int64_t *body,
          int64_t *many, double *near, double *volume, double *first, double *second)
{
    for (int64_t e = 0; e < m; e++) {
        many[body[e]] += d;
        for (int64_t k = 0; k < d; k++)
            for (int64_t i = 0; i < d; i++) near[d * body[e] + i] += points[d * elements[d * e + k] + i];
    }
    for (int64_t n = 0; n < count; n++)
        for (int64_t i = 0; i < d; i++) near[d * n + i] /= many[n] ? many[n] : 1;
    for (int64_t e = 0; e < m; e++) {
        int64_t n = body[e];
        double x[9], s[3] = {0, 0, 0}, both[9];
        for (int64_t k = 0; k < d; k++)
            for (int64_t i = 0; i < d; i++) s[i] += x[d * k + i] = points[d * elements[d * e + k] + i] - near[d * n + i];
        for (int64_t i = 0; i < d; i++)
            for (int64_t j = 0; j < d; j++) {
                both[d * i + j] = s[i] * s[j];
                for (int64_t k = 0; k < d; k++) both[d * i + j] += x[d * k + i] * x[d * k + j];
            }
        double v = cone(d, x);
        volume[n] += v;
        for (int64_t i = 0; i < d; i++) first[d * n + i] += v * s[i];
        for (int64_t i = 0; i < d * d; i++) second[d * d * n + i] += v * both[i];
    }
}
