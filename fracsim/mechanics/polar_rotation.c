// Polar rotations of d x d matrices F = R U (mechanics.polar_rotation), LANES matrices at a time. D: dimension.

#include <math.h>
#include <stdint.h>

typedef double real __attribute__((vector_size(8 * LANES)));

enum { MAX_ITERATIONS = 20 };
// convergence is quadratic: after a smaller change the next one is at round-off
static const double LAST_CHANGE = 1e-8;
// det F / |F|^D, below which the iteration may converge to a reflection, or not at all
static const double MIN_DETERMINANT = 1e-6;

static inline double largest_size(real x) {
  double value = 0.0;
  for (int i = 0; i < LANES; ++i) value = fmax(value, fabs(x[i]));
  return value;
}

// cofactors C of A, and det A
static inline real cofactors(real A[D][D], real C[D][D]) {
#if D == 2
  C[0][0] = A[1][1], C[0][1] = -A[1][0], C[1][0] = -A[0][1], C[1][1] = A[0][0];
  return A[0][0] * C[0][0] + A[0][1] * C[0][1];
#else
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const int p = (i + 1) % 3, q = (i + 2) % 3, k = (j + 1) % 3, m = (j + 2) % 3;
      C[i][j] = A[p][k] * A[q][m] - A[p][m] * A[q][k];
    }
  return A[0][0] * C[0][0] + A[0][1] * C[0][1] + A[0][2] * C[0][2];
#endif
}

// R <- (R + R^-T) / 2 until it is a rotation; R starts from matrices with positive determinants
static void iterate(real R[D][D]) {
  real C[D][D];
  for (int iteration = 0; iteration < MAX_ITERATIONS; ++iteration) {
    const real scale = 0.5 / cofactors(R, C);
    double change = 0.0;
    for (int i = 0; i < D; ++i)
      for (int j = 0; j < D; ++j) {
        const real half = scale * C[i][j] - 0.5 * R[i][j];
        R[i][j] += half;
        change = fmax(change, 2.0 * largest_size(half));
      }
    if (change < LAST_CHANGE) return;
  }
}

// R (count, D, D): rotations of F (count, D, D); returns how many F are inverted, nearly flat or not finite. The numbers
// of those are written to `irregular` (count,), and their R is the identity.
int64_t rotations(int64_t count, const double *F, double *R, int64_t *irregular) {
  int64_t found = 0;
  for (int64_t first = 0; first < count; first += LANES) {
    const int lanes = first + LANES <= count ? LANES : (int)(count - first);
    real A[D][D], C[D][D], squares = {0};
    for (int i = 0; i < D; ++i)
      for (int j = 0; j < D; ++j) {
        for (int lane = 0; lane < LANES; ++lane)
          A[i][j][lane] = lane < lanes ? F[((first + lane) * D + i) * D + j] : (double)(i == j);
        squares += A[i][j] * A[i][j];
      }
    const real determinant = cofactors(A, C);
    for (int lane = 0; lane < lanes; ++lane) {
      const double size = D == 2 ? squares[lane] : squares[lane] * sqrt(squares[lane]);
      if (determinant[lane] > MIN_DETERMINANT * size) continue; // not where it is not finite
      irregular[found++] = first + lane;
      for (int i = 0; i < D; ++i)
        for (int j = 0; j < D; ++j) A[i][j][lane] = (double)(i == j);
    }
    iterate(A);
    for (int lane = 0; lane < lanes; ++lane)
      for (int i = 0; i < D; ++i)
        for (int j = 0; j < D; ++j) R[((first + lane) * D + i) * D + j] = A[i][j][lane];
  }
  return found;
}
