// What makes symmetric matrices positive, LANES of them at a time: a lane a matrix (mechanics.positive). N: their size.

#include <math.h>
#include <stdint.h>
#include <string.h>

typedef double real __attribute__((vector_size(8 * LANES)));

enum { SWEEPS = 20 };
static const double ENOUGH = 1e-25; // of squares, off the diagonal: eigenvalues are to round-off long before

static inline real roots(real x) { for (int i = 0; i < LANES; ++i) x[i] = sqrt(x[i]); return x; }

static inline real sizes(real x) { for (int i = 0; i < LANES; ++i) x[i] = fabs(x[i]); return x; }

static inline real signs(real x) { for (int i = 0; i < LANES; ++i) x[i] = copysign(1.0, x[i]); return x; }

static inline double most(real x) {
  double found = 0.0;
  for (int i = 0; i < LANES; ++i) found = fmax(found, x[i]);
  return found;
}

static void take(const double *A, const int64_t *cells, real a[N][N]) {
  for (int lane = 0; lane < LANES; ++lane)
    for (int k = 0; k < N * N; ++k) (&a[0][0])[k][lane] = A[cells[lane] * N * N + k];
}

// the least pivot of A + small mean(A): negative where that is not positive (Sylvester's law of inertia)
static real least_pivots(real a[N][N], double small) {
  real mean = {0};
  for (int i = 0; i < N; ++i) mean += a[i][i];
  mean *= small / N;
  for (int i = 0; i < N; ++i) a[i][i] += mean;
  real least = a[0][0];
  for (int k = 0; k < N - 1; ++k)
    for (int i = k + 1; i < N; ++i) {
      const real share = a[k][i] / a[k][k];
      for (int j = i; j < N; ++j) a[i][j] -= share * a[k][j];
      if (i == k + 1)
        for (int lane = 0; lane < LANES; ++lane) least[lane] = fmin(least[lane], a[i][i][lane]);
    }
  return least;
}

static inline void turn(real *x, real *y, real c, real s) {
  const real was = *x;
  *x = c * was - s * *y;
  *y = s * was + c * *y;
}

// eigenvalues onto the diagonal, eigenvectors into the rows of v: Jacobi's rotations, sweep by sweep, of the upper half
static void diagonalise(real a[N][N], real v[N][N]) {
  real all = {0};
  for (int i = 0; i < N; ++i)
    for (int j = 0; j < N; ++j) {
      v[i][j] = (real){0} + (i == j);
      all += a[i][j] * a[i][j];
    }
  for (int sweep = 0; sweep < SWEEPS; ++sweep) {
    real off = {0};
    for (int p = 0; p < N; ++p)
      for (int q = p + 1; q < N; ++q) off += a[p][q] * a[p][q];
    if (most(off - ENOUGH * all) <= 0.0) return;
    for (int p = 0; p < N; ++p)
      for (int q = p + 1; q < N; ++q) {
        const real half = 0.5 * (a[q][q] - a[p][p]), e = a[p][q];
        const real t = signs(half) * e / (sizes(half) + roots(half * half + e * e) + 1e-300);
        const real c = 1.0 / roots(1.0 + t * t), s = t * c;
        a[p][p] -= t * e;
        a[q][q] += t * e;
        a[p][q] = (real){0};
        for (int k = 0; k < p; ++k) turn(&a[k][p], &a[k][q], c, s);
        for (int k = p + 1; k < q; ++k) turn(&a[p][k], &a[k][q], c, s);
        for (int k = q + 1; k < N; ++k) turn(&a[p][k], &a[q][k], c, s);
        for (int k = 0; k < N; ++k) turn(&v[p][k], &v[q][k], c, s);
      }
  }
}

// C of LANES matrices; those beyond `count` are copies of others
static void lift(const double *A, const int64_t *cells, int count, double *C) {
  real a[N][N], v[N][N];
  take(A, cells, a);
  diagonalise(a, v);
  for (int k = 0; k < N; ++k)
    for (int i = 0; i < N; ++i)
      for (int j = 0; j < N; ++j)
        for (int lane = 0; lane < count; ++lane)
          if (a[k][k][lane] < 0.0) C[(cells[lane] * N + i) * N + j] -= a[k][k][lane] * v[k][i][lane] * v[k][j][lane];
}

// C (count, N, N) = - sum of negative eigenvalues times their projectors, of those A that have one below - small of
// their mean; 0 for all others. A matrix of nothing has none. filled: (count,) which of C are not 0.
void positive(int64_t count, double small, const double *A, double *C, uint8_t *filled) {
  int64_t found[2 * LANES], cells[LANES];
  int waiting = 0;
  for (int64_t first = 0; first < count; first += LANES) {
    real a[N][N];
    for (int lane = 0; lane < LANES; ++lane) cells[lane] = first + lane < count ? first + lane : count - 1;
    take(A, cells, a);
    const real least = least_pivots(a, small);
    for (int lane = 0; lane < LANES && first + lane < count; ++lane) {
      const int64_t cell = cells[lane];
      if (filled[cell]) memset(C + cell * N * N, 0, N * N * sizeof(double));
      if ((filled[cell] = least[lane] < 0.0)) found[waiting++] = cell;
    }
    if (waiting >= LANES) {
      lift(A, found, LANES, C);
      waiting -= LANES;
      for (int k = 0; k < waiting; ++k) found[k] = found[LANES + k];
    }
  }
  if (waiting) {
    for (int k = waiting; k < LANES; ++k) found[k] = found[0];
    lift(A, found, waiting, C);
  }
}
