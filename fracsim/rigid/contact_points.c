/* How fast things come together in contacts, and part (rigid.contact_points).

   Of k contacts of `things` (k, 2), with `axes` (k, 3, 3), first the normal, and `arms` (k, 2, 3); things have
   velocities and spins (things, 3). */

#include <stdint.h>

/* Velocity of the second thing beside the first. */
static inline void apart(const int64_t *n, const double *arms, const double *velocity, const double *spin, double *v)
{
    const double *a = arms, *b = arms + 3, *p = spin + 3 * n[0], *q = spin + 3 * n[1];
    const double *first = velocity + 3 * n[0], *second = velocity + 3 * n[1];
    v[0] = second[0] - first[0] + (q[1] * b[2] - q[2] * b[1]) - (p[1] * a[2] - p[2] * a[1]);
    v[1] = second[1] - first[1] + (q[2] * b[0] - q[0] * b[2]) - (p[2] * a[0] - p[0] * a[2]);
    v[2] = second[2] - first[2] + (q[0] * b[1] - q[1] * b[0]) - (p[0] * a[1] - p[1] * a[0]);
}

void closing(int64_t k, const int64_t *things, const double *axes, const double *arms, const double *velocity,
             const double *spin, double *speed)
{
    for (int64_t i = 0; i < k; i++) {
        const double *n = axes + 9 * i;
        double v[3];
        apart(things + 2 * i, arms + 6 * i, velocity, spin, v);
        speed[i] = -(v[0] * n[0] + v[1] * n[1] + v[2] * n[2]);
    }
}

void parting(int64_t k, const int64_t *things, const double *axes, const double *arms, const double *velocity,
             const double *spin, double *speed)
{
    for (int64_t i = 0; i < k; i++) {
        double v[3];
        apart(things + 2 * i, arms + 6 * i, velocity, spin, v);
        for (int64_t j = 0; j < 3; j++) {
            const double *n = axes + 9 * i + 3 * j;
            speed[3 * i + j] = v[0] * n[0] + v[1] * n[1] + v[2] * n[2];
        }
    }
}
