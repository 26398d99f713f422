/* How much crack advances around places make (fracture.energy.crack_front). */

#include <math.h>
#include <stdint.h>

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

/* int q ds over the side from a by s, by Gauss's rule of three points: q of a place and a radius, m. */
static double along(const double *a, const double *s, const double *place, double radius)
{
    static const double share[3] = {0.1127016653792583, 0.5, 0.8872983346207417}, weight[3] = {5. / 18, 8. / 18, 5. / 18};
    double sum = 0;
    for (int g = 0; g < 3; g++) {
        double square = 0;
        for (int i = 0; i < 3; i++) {
            double apart = a[i] + share[g] * s[i] - place[i];
            square += apart * apart;
        }
        sum += weight[g] * fmin(fmax(2 * (1 - sqrt(square) / radius), 0), 1);
    }
    return sum;
}

/* Add to made (places, 3) int q nu ds round polygons (.., 16), one of each pair. */
void advance(
    int64_t pairs, const double *polygons, const int64_t *polygon, const int64_t *place, const double *places,
    const double *radius, double *made)
{
    for (int64_t n = 0; n < pairs; n++) {
        const double *corners = polygons + 16 * polygon[n], *counts = corners + 12, *at = places + 3 * place[n];
        double first[3], second[3], normal[3], out[3] = {0, 0, 0};
        for (int i = 0; i < 3; i++) {
            first[i] = corners[6 + i] - corners[i];
            second[i] = corners[9 + i] - corners[3 + i];
        }
        cross(first, second, normal); /* twice the area */
        double size = sqrt(normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2]);
        if (!(size > 0)) continue;
        for (int k = 0; k < 4; k++) {
            const double *a = corners + 3 * k, *b = corners + 3 * ((k + 1) % 4);
            if (!(counts[k] > 0)) continue;
            double side[3] = {b[0] - a[0], b[1] - a[1], b[2] - a[2]}, across[3];
            double q = along(a, side, at, radius[place[n]]);
            cross(side, normal, across);
            for (int i = 0; i < 3; i++) out[i] += q * across[i] / size;
        }
        for (int i = 0; i < 3; i++) made[3 * place[n] + i] += out[i];
    }
}
