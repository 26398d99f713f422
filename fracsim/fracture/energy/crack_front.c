/* Area that an advance of the crack front makes around points (fracture.energy.crack_front). */

#include <math.h>
#include <stdint.h>

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* int q ds over the side from a to a + s, by Gauss's rule of three points; q of a point and a radius, m. */
static double side_integral(const double *a, const double *s, const double *point, double radius)
{
    static const double share[3] = {0.1127016653792583, 0.5, 0.8872983346207417}, weight[3] = {5. / 18, 8. / 18, 5. / 18};
    double sum = 0;
    for (int g = 0; g < 3; g++) {
        double square = 0;
        for (int i = 0; i < 3; i++) {
            double difference = a[i] + share[g] * s[i] - point[i];
            square += difference * difference;
        }
        sum += weight[g] * fmin(fmax(2 * (1 - sqrt(square) / radius), 0), 1);
    }
    return sum;
}

/* Add int q nu ds around polygons (.., 16) to result (points, 3), for pairs of a point and a polygon. */
void advance_vectors(
    int64_t pairs, const double *polygons, const int64_t *polygon, const int64_t *point, const double *points,
    const double *radius, double *result)
{
    for (int64_t n = 0; n < pairs; n++) {
        const double *corners = polygons + 16 * polygon[n], *is_inside = corners + 12, *centre = points + 3 * point[n];
        double first[3], second[3], normal[3], sum_of_sides[3] = {0, 0, 0};
        for (int i = 0; i < 3; i++) {
            first[i] = corners[6 + i] - corners[i];
            second[i] = corners[9 + i] - corners[3 + i];
        }
        cross(first, second, normal); /* twice the area vector */
        double size = sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]);
        if (!(size > 0)) continue;
        for (int k = 0; k < 4; k++) {
            const double *a = corners + 3 * k, *b = corners + 3 * ((k + 1) % 4);
            if (!(is_inside[k] > 0)) continue;
            double side[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]}, across[3];
            double q = side_integral(a, side, centre, radius[point[n]]);
            cross(side, normal, across);
            for (int i = 0; i < 3; i++) sum_of_sides[i] += q * across[i] / size;
        }
        for (int i = 0; i < 3; i++) result[3 * point[n] + i] += sum_of_sides[i];
    }
}
