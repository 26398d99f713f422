/* Rotation of rigid bodies in a step (rigid.bodies). Matrices are stored by rows. */

#include <math.h>
#include <stdint.h>

/* Matrix product c = a b. */
static void multiply(const double *a, const double *b, double *c)
{
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) c[3 * i + j] = a[3 * i] * b[j] + a[3 * i + 1] * b[3 + j] + a[3 * i + 2] * b[6 + j];
}

/* Rotation matrix of a rotation vector: 1 + s W + c W^2, s = sin t / t, c = (1 - cos t) / t^2 = 2 sin^2(t / 2) / t^2. */
static void rotation_matrix(const double *vector, double *r)
{
    double x = vector[0], y = vector[1], z = vector[2], square = x * x + y * y + z * z, t = sqrt(square);
    double half = t > 0 ? sin(t / 2) / (t / 2) : 1, s = t > 0 ? sin(t) / t : 1, c = half * half / 2;
    double matrix[9] = {1 - c * (y * y + z * z), c * x * y - s * z, c * x * z + s * y,
                      c * x * y + s * z, 1 - c * (x * x + z * z), c * y * z - s * x,
                      c * x * z - s * y, c * y * z + s * x, 1 - c * (x * x + y * y)};
    for (int i = 0; i < 9; i++) r[i] = matrix[i];
}

/* R T R^T v. */
static void transform(const double *r, const double *t, const double *v, double *result)
{
    double a[3], b[3];
    for (int j = 0; j < 3; j++) a[j] = r[j] * v[0] + r[3 + j] * v[1] + r[6 + j] * v[2];
    for (int i = 0; i < 3; i++) b[i] = t[3 * i] * a[0] + t[3 * i + 1] * a[1] + t[3 * i + 2] * a[2];
    for (int i = 0; i < 3; i++) result[i] = r[3 * i] * b[0] + r[3 * i + 1] * b[1] + r[3 * i + 2] * b[2];
}

/* One Newton step to an orthogonal matrix, R (3 - R^T R) / 2, which removes round-off. */
static void orthonormalise(const double *r, double *result)
{
    double gram[9], correction[9];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) gram[3 * i + j] = r[i] * r[j] + r[3 + i] * r[3 + j] + r[6 + i] * r[6 + j];
    multiply(r, gram, correction);
    for (int i = 0; i < 9; i++) result[i] = 1.5 * r[i] - correction[i] / 2;
}

/* Rotation after a time by the implicit midpoint rule, by fixed points until the change is below a tolerance, rad. */
static void midpoint_step(const double *turn, const double *inverse, const double *momentum, double time,
                          int64_t iterations, double tolerance, double *after)
{
    double angle[3], spin[3], r[9], halfway[9], change = tolerance;
    transform(turn, inverse, momentum, spin);
    for (int j = 0; j < 3; j++) angle[j] = time * spin[j];
    for (int64_t round = 0; round < iterations && change >= tolerance; round++) {
        double half[3] = {angle[0] / 2, angle[1] / 2, angle[2] / 2};
        rotation_matrix(half, r);
        multiply(r, turn, halfway);
        transform(halfway, inverse, momentum, spin);
        change = 0;
        for (int j = 0; j < 3; j++) {
            change = fmax(change, fabs(time * spin[j] - angle[j]));
            angle[j] = time * spin[j];
        }
    }
    rotation_matrix(angle, r);
    multiply(r, turn, halfway);
    orthonormalise(halfway, after);
}

/* Rotations (n, 9) of n bodies after times (n,), in equal substeps of at most `substep_angle`, rad. Returns 1, without
   results, if one rotates by more than `limit`, rad, or is not finite; else 0. */
int64_t rotate_freely(int64_t n, const double *turn, const double *inverse, const double *momentum, const double *time,
                int64_t iterations, double tolerance, double substep_angle, double limit, double *after)
{
    for (int64_t body = 0; body < n; body++, turn += 9, inverse += 9, momentum += 3, time++, after += 9) {
        double spin[3];
        transform(turn, inverse, momentum, spin);
        double angle = fabs(*time) * sqrt(spin[0] * spin[0] + spin[1] * spin[1] + spin[2] * spin[2]);
        if (!(angle <= limit)) return 1;
        int64_t parts = angle > substep_angle ? (int64_t)ceil(angle / substep_angle) : 1;
        midpoint_step(turn, inverse, momentum, *time / parts, iterations, tolerance, after);
        for (int64_t part = 1; part < parts; part++)
            midpoint_step(after, inverse, momentum, *time / parts, iterations, tolerance, after);
    }
    return 0;
}

/* R T R^T v of n bodies. */
void apply_tensor(int64_t n, const double *turn, const double *tensor, const double *vector, double *result)
{
    for (int64_t i = 0; i < n; i++) transform(turn + 9 * i, tensor + 9 * i, vector + 3 * i, result + 3 * i);
}

/* Velocities and spins (n, 6), in `motion`, of n bodies after a time under gravity and under forces and moments (n, 6),
   the moments in the axes of the bodies. No moment brings a body to a spin above `max_spin`, rad/s. */
void accelerate(int64_t n, const double *turn, const double *inertia, const double *inverse, const double *mass,
            const double *velocity, const double *spin, const double *force, const double *gravity, double time,
            double max_spin, double *motion)
{
    for (int64_t body = 0; body < n; body++, turn += 9, velocity += 3, spin += 3, force += 6, motion += 6) {
        const double *moment = force + 3;
        double momentum[3], size = 0, before = 0;
        int acts = 0;
        for (int i = 0; i < 6; i++) acts |= force[i] != 0;
        transform(turn, inertia + 9 * body, spin, momentum);
        for (int i = 0; i < 3; i++) {
            motion[i] = velocity[i] + time * (gravity[i] + force[i] / mass[body]);
            momentum[i] += time * (turn[3 * i] * moment[0] + turn[3 * i + 1] * moment[1] + turn[3 * i + 2] * moment[2]);
        }
        transform(turn, inverse + 9 * body, momentum, motion + 3);
        for (int i = 0; i < 3; i++) size += motion[3 + i] * motion[3 + i], before += spin[i] * spin[i];
        double allowed = fmax(max_spin, sqrt(before));
        if (acts && sqrt(size) > allowed)
            for (int i = 3; i < 6; i++) motion[i] *= allowed / sqrt(size);
    }
}

/* Quaternions (n, 4) of n rotations, the scalar first, computed from the largest component. */
void quaternions(int64_t n, const double *turn, double *quat)
{
    for (int64_t body = 0; body < n; body++, turn += 9, quat += 4) {
        int i = 0;
        for (int k = 1; k < 3; k++)
            if (turn[4 * k] > turn[4 * i]) i = k;
        int j = (i + 1) % 3, k = (i + 2) % 3;
        double trace = turn[0] + turn[4] + turn[8], q[4] = {1 + trace}; /* times four times the largest component */
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
