/* Relative velocities at contact points (rigid.contact_points).

   There are k contacts of `pairs` (k, 2) of bodies, with `axes` (k, 3, 3), the normal first, and `arms` (k, 2, 3) from the
   centres of the two bodies. Bodies and obstacles have velocities and spins (n, 3). */

#include <stdint.h>

/* Velocity of the second body relative to the first at a contact point. */
static inline void relative(const int64_t *n, const double *arms, const double *velocity, const double *spin, double *v)
{
    const double *a = arms, *b = arms + 3, *p = spin + 3 * n[0], *q = spin + 3 * n[1];
    const double *first = velocity + 3 * n[0], *second = velocity + 3 * n[1];
    v[0] = second[0] - first[0] + (q[1] * b[2] - q[2] * b[1]) - (p[1] * a[2] - p[2] * a[1]);
    v[1] = second[1] - first[1] + (q[2] * b[0] - q[0] * b[2]) - (p[2] * a[0] - p[0] * a[2]);
    v[2] = second[2] - first[2] + (q[0] * b[1] - q[1] * b[0]) - (p[0] * a[1] - p[1] * a[0]);
}

/* Normal speeds of approach (k,). */
void approach_speeds(int64_t k, const int64_t *pairs, const double *axes, const double *arms, const double *velocity,
                     const double *spin, double *speed)
{
    for (int64_t i = 0; i < k; i++) {
        const double *n = axes + 9 * i;
        double v[3];
        relative(pairs + 2 * i, arms + 6 * i, velocity, spin, v);
        speed[i] = -(v[0] * n[0] + v[1] * n[1] + v[2] * n[2]);
    }
}

/* Relative velocities (k, 3) along the axes. */
void relative_velocities(int64_t k, const int64_t *pairs, const double *axes, const double *arms, const double *velocity,
                         const double *spin, double *speed)
{
    for (int64_t i = 0; i < k; i++) {
        double v[3];
        relative(pairs + 2 * i, arms + 6 * i, velocity, spin, v);
        for (int64_t j = 0; j < 3; j++) {
            const double *n = axes + 9 * i + 3 * j;
            speed[3 * i + j] = v[0] * n[0] + v[1] * n[1] + v[2] * n[2];
        }
    }
}
