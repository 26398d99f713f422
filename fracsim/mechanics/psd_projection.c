// Corrections that make symmetric matrices positive semi-definite (mechanics.psd_projection), LANES matrices at a time.
// N: number of rows.

#include <math.h>
#include <stdint.h>
#include <string.h>

typedef double real __attribute__((vector_size(8 * LANES)));

enum { MAX_SWEEPS = 20 };
// bound of the squares off the diagonal, relative to all: eigenvalues are exact to round-off long before
static const double OFF_DIAGONAL_TOLERANCE = 1e-25;

static inline real roots(real x) { for (int i = 0; i < LANES; ++i) x[i] = sqrt(x[i]); return x; }

static inline real sizes(real x) { for (int i = 0; i < LANES; ++i) x[i] = fabs(x[i]); return x; }

static inline real signs(real x) { for (int i = 0; i < LANES; ++i) x[i] = copysign(1.0, x[i]); return x; }

static inline double largest(real x) {
  double value = 0.0;
  for (int i = 0; i < LANES; ++i) value = fmax(value, x[i]);
  return value;
}

// matrices of LANES cells, one a lane
static void load(const double *A, const int64_t *cells, real a[N][N]) {
  for (int lane = 0; lane < LANES; ++lane)
    for (int k = 0; k < N * N; ++k) (&a[0][0])[k][lane] = A[cells[lane] * N * N + k];
}

// smallest pivot of A + tolerance mean(A): negative if that matrix is not positive (Sylvester's law of inertia)
static real smallest_pivots(real a[N][N], double tolerance) {
  real mean = {0};
  for (int i = 0; i < N; ++i) mean += a[i][i];
  mean *= tolerance / N;
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

static inline void rotate(real *x, real *y, real c, real s) {
  const real old = *x;
  *x = c * old - s * *y;
  *y = s * old + c * *y;
}

// eigenvalues onto the diagonal, eigenvectors into the rows of v: cyclic Jacobi method on the upper half
static void diagonalise(real a[N][N], real v[N][N]) {
  real all = {0};
  for (int i = 0; i < N; ++i)
    for (int j = 0; j < N; ++j) {
      v[i][j] = (real){0} + (i == j);
      all += a[i][j] * a[i][j];
    }
  for (int sweep = 0; sweep < MAX_SWEEPS; ++sweep) {
    real off = {0};
    for (int p = 0; p < N; ++p)
      for (int q = p + 1; q < N; ++q) off += a[p][q] * a[p][q];
    if (largest(off - OFF_DIAGONAL_TOLERANCE * all) <= 0.0) return;
    for (int p = 0; p < N; ++p)
      for (int q = p + 1; q < N; ++q) {
        const real half = 0.5 * (a[q][q] - a[p][p]), e = a[p][q];
        const real t = signs(half) * e / (sizes(half) + roots(half * half + e * e) + 1e-300);
        const real c = 1.0 / roots(1.0 + t * t), s = t * c;
        a[p][p] -= t * e;
        a[q][q] += t * e;
        a[p][q] = (real){0};
        for (int k = 0; k < p; ++k) rotate(&a[k][p], &a[k][q], c, s);
        for (int k = p + 1; k < q; ++k) rotate(&a[p][k], &a[k][q], c, s);
        for (int k = q + 1; k < N; ++k) rotate(&a[p][k], &a[q][k], c, s);
        for (int k = 0; k < N; ++k) rotate(&v[p][k], &v[q][k], c, s);
      }
  }
}

// corrections C of LANES matrices, of which those beyond `count` are copies of others
static void correct(const double *A, const int64_t *cells, int count, double factor, double *C) {
  real a[N][N], v[N][N];
  load(A, cells, a);
  diagonalise(a, v);
  for (int k = 0; k < N; ++k)
    for (int i = 0; i < N; ++i)
      for (int j = 0; j < N; ++j)
        for (int lane = 0; lane < count; ++lane)
          if (a[k][k][lane] < 0.0)
            C[(cells[lane] * N + i) * N + j] -= factor * a[k][k][lane] * v[k][i][lane] * v[k][j][lane];
}

// C (count, N, N) = - factor sum of negative eigenvalues times their projectors, for matrices A with an eigenvalue below
// - tolerance of their mean; 0 for all others, and for zero matrices. filled: (count,) flags of C that are not 0.
void positive(int64_t count, double tolerance, double factor, const double *A, double *C, uint8_t *filled) {
  int64_t queue[2 * LANES], cells[LANES];
  int queued = 0;
  for (int64_t first = 0; first < count; first += LANES) {
    real a[N][N];
    for (int lane = 0; lane < LANES; ++lane) cells[lane] = first + lane < count ? first + lane : count - 1;
    load(A, cells, a);
    const real least = smallest_pivots(a, tolerance);
    for (int lane = 0; lane < LANES && first + lane < count; ++lane) {
      const int64_t cell = cells[lane];
      if (filled[cell]) memset(C + cell * N * N, 0, N * N * sizeof(double));
      if ((filled[cell] = least[lane] < 0.0)) queue[queued++] = cell;
    }
    if (queued >= LANES) {
      correct(A, queue, LANES, factor, C);
      queued -= LANES;
      for (int k = 0; k < queued; ++k) queue[k] = queue[LANES + k];
    }
  }
  if (queued) {
    for (int k = queued; k < LANES; ++k) queue[k] = queue[0];
    correct(A, queue, queued, factor, C);
  }
}
