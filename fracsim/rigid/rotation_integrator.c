/* How each body turns in a step (rigid.bodies). Matrices are by rows. */

#include <math.h>
#include <stdint.h>

/* c = a b. */
static void product(const double *a, const double *b, double *c)
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) c[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}

/* exp of the rotation by a vector: 1 + s W + c W^2, s = sin t / t, c = (1 - cos t) / t^2 = 2 sin^2(t / 2) / t^2. */
static void rotation(const double *vector, double *r)
{
    double x = vector[0], y = vector[1], z = vector[2], square = x * x + y * y + z * z, t = sqrt(square);
    double half = t > 0 ? sin(t / 2) / (t / 2) : 1, s = t > 0 ? sin(t) / t : 1, c = half * half / 2;
    double made[9] = {1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
                      c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
                      c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)};
    for (int i = 0; i < 9; i++) r[i] = made[i];
}

/* R T R^T v. */
static void rotated(const double *r, const double *t, const double *v, double *result)
{
    double a[3], b[3];
    for (int j = 0; j < 3; j++) a[j] = r[j] * v[0] + r[3 + j] * v[1] + r[6 + j] * v[2];
    for (int i = 0; i < 3; i++) b[i] = t[3 * i] * a[0] + t[3 * i + 1] * a[1] + t[3 * i + 2] * a[2];
    for (int i = 0; i < 3; i++) result[i] = r[3 * i] * b[0] + r[3 * i + 1] * b[1] + r[3 * i + 2] * b[2];
}

/* R (3 - R^T R) / 2: what a product has lost of right angles is gone but for its square. */
static void squared(const double *r, double *result)
{
    double across[9], more[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) across[3 * i + j] = r[i] * r[j] + r[3 + i] * r[3 + j] + r[6 + i] * r[6 + j];
    product(r, across, more);
    for (int i = 0; i < 9; i++) result[i] = 1.5 * r[i] - more[i] / 2;
}

/* The turn after a time from one before it; `same`: rad, a change of the turn that is none. */
static void turned(const double *turn, const double *inverse, const double *momentum, double time, int64_t rounds,
                   double same, double *after)
{
    double angle[3], found[3], r[9], halfway[9], change = same;
    rotated(turn, inverse, momentum, found);
    for (int j = 0; j < 3; j++) angle[j] = time * found[j];
    for (int64_t round = 0; round < rounds && change >= same; round++) {
        double half[3] = {angle[0] / 2, angle[1] / 2, angle[2] / 2};
        rotation(half, r);
        product(r, turn, halfway);
        rotated(halfway, inverse, momentum, found);
        change = 0;
        for (int j = 0; j < 3; j++) {
            change = fmax(change, fabs(time * found[j] - angle[j]));
            angle[j] = time * found[j];
        }
    }
    rotation(angle, r);
    product(r, turn, halfway);
    squared(halfway, after);
}

/* The turns (n, 9) of n bodies after times (n,), each in as many parts as it turns by `most` in, rad. Returns 1 where
   one turns by more than `limit`, rad, or by no number: nothing is found then; else 0. */
int64_t tumbled(int64_t n, const double *turn, const double *inverse, const double *momentum, const double *time,
                int64_t rounds, double same, double most, double limit, double *after)
{
    for (int64_t each = 0; each < n; each++, turn += 9, inverse += 9, momentum += 3, time++, after += 9) {
        double spin[3];
        rotated(turn, inverse, momentum, spin);
        double angle = fabs(*time) * sqrt(spin[0] * spin[0] + spin[1] * spin[1] + spin[2] * spin[2]);
        if (!(angle <= limit)) return 1;
        int64_t parts = angle > most ? (int64_t)ceil(angle / most) : 1;
        turned(turn, inverse, momentum, *time / parts, rounds, same, after);
        for (int64_t part = 1; part < parts; part++)
            turned(after, inverse, momentum, *time / parts, rounds, same, after);
    }
    return 0;
}

/* R T R^T v of n bodies. */
void rotations(int64_t n, const double *turn, const double *tensor, const double *vector, double *result)
{
    for (int64_t i = 0; i < n; i++) rotated(turn + 9 * i, tensor + 9 * i, vector + 3 * i, result + 3 * i);
}

/* Velocities and spins (n, 3) of n bodies, (n, 6) in `motion`, after a time in which `gravity` and forces and moments
   (n, 6), these in their own axes, act on them where they are. These set none spinning by more than `most`, rad/s. */
void driven(int64_t n, const double *turn, const double *inertia, const double *inverse, const double *mass,
            const double *velocity, const double *spin, const double *force, const double *gravity, double time,
            double most, double *motion)
{
    for (int64_t each = 0; each < n; each++, turn += 9, velocity += 3, spin += 3, force += 6, motion += 6) {
        const double *moment = force + 3;
        double momentum[3], size = 0, before = 0;
        int acts = 0;
        for (int i = 0; i < 6; i++) acts |= force[i] != 0;
        rotated(turn, inertia + 9 * each, spin, momentum);
        for (int i = 0; i < 3; i++) {
            motion[i] = velocity[i] + time * (gravity[i] + force[i] / mass[each]);
            momentum[i] += time * (turn[3 * i] * moment[0] + turn[3 * i + 1] * moment[1] + turn[3 * i + 2] * moment[2]);
        }
        rotated(turn, inverse + 9 * each, momentum, motion + 3);
        for (int i = 0; i < 3; i++) size += motion[3 + i] * motion[3 + i], before += spin[i] * spin[i];
        double allowed = fmax(most, sqrt(before));
        if (acts && sqrt(size) > allowed)
            for (int i = 3; i < 6; i++) motion[i] *= allowed / sqrt(size);
    }
}

/* Quaternions (n, 4) of n rotations, the scalar first: from the largest of its parts, of which none is lost. */
void orientations(int64_t n, const double *turn, double *quat)
{
    for (int64_t each = 0; each < n; each++, turn += 9, quat += 4) {
        int i = 0;
        for (int k = 1; k < 3; k++)
            if (turn[4 * k] > turn[4 * i]) i = k;
        int j = (i + 1) % 3, k = (i + 2) % 3;
        double trace = turn[0] + turn[4] + turn[8], q[4] = {1 + trace}; /* all of them times four times the largest */
        if (trace > turn[4 * i]) {
            q[1] = turn[7] - turn[5], q[2] = turn[2] - turn[6], q[3] = turn[3] - turn[1];
        } else {
            q[0] = turn[3 * k + j] - turn[3 * j + k];
            q[1 + i] = 1 + 2 * turn[4 * i] - trace;
            q[1 + j] = turn[3 * j + i] + turn[3 * i + j];
            q[1 + k] = turn[3 * k + i] + turn[3 * i + k];
        }
        double size = sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3]);
        for (int a = 0; a < 4; a++) quat[a] = q[a] / size;
    }
}
