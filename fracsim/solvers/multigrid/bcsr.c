/* Block CSR matrix in single precision (solvers.multigrid.bcsr).
   R: rows of a square block, which is stored by columns, with eight numbers of padding after the last block;
   LANES: 2, 4 or 8, at least R. starts: of rows; columns: of blocks.
   B: one symmetric block of R x R for each row, with the same padding. */

#include <math.h>
#include <stdint.h>

typedef float lanes __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef double wide __attribute__((vector_size(8 * LANES)));

/* R numbers of A x; the other lanes are not used. Separate sums for the columns do not wait for each other. */
static inline lanes product(int64_t from, int64_t to, const int32_t* columns, const float* blocks, const float* x)
{
  lanes sums[R] = {0}, sum = {0};
  for (int64_t at = from; at < to; ++at)
  {
    const float *A = blocks + R * R * at, *in = x + R * (int64_t)columns[at];
#pragma GCC unroll 6
    for (int s = 0; s < R; ++s) sums[s] += *(const lanes*)(A + R * s) * in[s];
  }
#pragma GCC unroll 6
  for (int s = 0; s < R; ++s) sum += sums[s];
  return sum;
}

/* r = b - A x */
void residual(int64_t rows, const int64_t* starts, const int32_t* columns, const float* blocks, const float* b,
    const float* x, float* result)
{
  for (int64_t row = 0; row < rows; ++row)
  {
    const lanes sum = product(starts[row], starts[row + 1], columns, blocks, x);
    for (int r = 0; r < R; ++r) result[R * row + r] = b[R * row + r] - sum[r];
  }
}

/* R numbers of B x; the other lanes are not used. */
static inline lanes block_product(const float* B, const float* x)
{
  lanes sum = {0};
#pragma GCC unroll 6
  for (int s = 0; s < R; ++s) sum += *(const lanes*)(B + R * s) * x[s];
  return sum;
}

/* d = x = take B b */
void first_step(int64_t rows, const float* B, float take, const float* b, float* d, float* x)
{
  for (int64_t row = 0; row < rows; ++row)
  {
    const lanes first = take * block_product(B + R * R * row, b + R * row);
    for (int r = 0; r < R; ++r) d[R * row + r] = x[R * row + r] = first[r];
  }
}

/* d = keep d + take B (b - A x),  to = x + d */
void smoothing_step(int64_t rows, const int64_t* starts, const int32_t* columns, const float* blocks, const float* B,
    float keep, float take, const float* b, const float* x, float* d, float* to)
{
  for (int64_t row = 0; row < rows; ++row)
  {
    const lanes sum = product(starts[row], starts[row + 1], columns, blocks, x);
    float residual[R];
    for (int r = 0; r < R; ++r) residual[r] = b[R * row + r] - sum[r];
    const lanes step = block_product(B + R * R * row, residual);
    for (int r = 0; r < R; ++r)
    {
      const int64_t i = R * row + r;
      d[i] = keep * d[i] + take * step[r];
      to[i] = x[i] + d[i];
    }
  }
}

/* y += A x */
void add(int64_t rows, const int64_t* starts, const int32_t* columns, const float* blocks, const float* x, float* y)
{
  for (int64_t row = 0; row < rows; ++row)
  {
    const lanes sum = product(starts[row], starts[row + 1], columns, blocks, x);
    for (int r = 0; r < R; ++r) y[R * row + r] += sum[r];
  }
}

/* to = left A right, left and right diagonal; A in double precision, its blocks stored by rows. */
void scale(int64_t rows, const int64_t* starts, const int32_t* columns, const double* blocks, const double* left,
    const double* right, float* to)
{
  for (int64_t row = 0; row < rows; ++row)
    for (int64_t at = starts[row]; at < starts[row + 1]; ++at)
    {
      const double *A = blocks + R * R * at, *l = left + R * row, *r = right + R * (int64_t)columns[at];
      float* B = to + R * R * at;
#pragma GCC unroll 6
      for (int s = 0; s < R; ++s)
#pragma GCC unroll 6
        for (int t = 0; t < R; ++t) B[R * s + t] = (float)(l[t] * A[R * t + s] * r[s]);
    }
}

/* Cholesky factor L of D, with the reciprocals of its diagonal; returns 0 if D is not positive in single precision. */
static int factor(const float* D, double L[R][R])
{
  for (int i = 0; i < R; ++i)
    for (int j = 0; j <= i; ++j)
    {
      double remaining = (D[R * i + j] + (double)D[R * j + i]) / 2;
      for (int k = 0; k < j; ++k) remaining -= L[i][k] * L[j][k];
      if (i == j && !(remaining > 1e-5 * D[R * i + i])) return 0;
      L[i][j] = i == j ? 1 / sqrt(remaining) : remaining * L[j][j];
    }
  return 1;
}

/* B = D^-1; for D that is not positive the inverse of the absolute values of its diagonal, 1 for 0. */
void invert(int64_t rows, const float* D, float* B)
{
  for (int64_t row = 0; row < rows; ++row, D += R * R, B += R * R)
  {
    double L[R][R], x[R];
    const int positive = factor(D, L);
    for (int s = 0; s < R; ++s)
    {
      for (int i = 0; i < R; ++i) x[i] = i == s && !positive ? (D[R * i + i] ? 1 / fabs(D[R * i + i]) : 1) : i == s;
      for (int i = 0; i < R && positive; ++i)
      {
        for (int k = 0; k < i; ++k) x[i] -= L[i][k] * x[k];
        x[i] *= L[i][i];
      }
      for (int i = R - 1; i >= 0 && positive; --i)
      {
        for (int k = i + 1; k < R; ++k) x[i] -= L[k][i] * x[k];
        x[i] *= L[i][i];
      }
      for (int i = 0; i < R; ++i) B[R * s + i] = (float)x[i];
    }
  }
}

/* Rounding loss of each row of A in B = left^-1 A right^-1: the symmetric part of the sum of A_ij - left_i B_ij right_j
   over j. A is stored by rows, B by columns. */
void rounding_loss(int64_t rows, const int64_t* starts, const int32_t* columns, const float* B, const double* A,
    const double* left, const double* right, float* lost)
{
  for (int64_t row = 0; row < rows; ++row, lost += R * R)
  {
    double sum[R][R] = {0};
    const double* l = left + R * row;
    for (int64_t at = starts[row]; at < starts[row + 1]; ++at)
    {
      const double *exact = A + R * R * at, *r = right + R * (int64_t)columns[at];
      const float* rounded = B + R * R * at;
      for (int t = 0; t < R; ++t)
        for (int s = 0; s < R; ++s) sum[t][s] += exact[R * t + s] - l[t] * rounded[R * s + t] * r[s];
    }
    for (int t = 0; t < R; ++t)
      for (int s = 0; s < R; ++s) lost[R * t + s] = (float)((sum[t][s] + sum[s][t]) / 2);
  }
}

/* LANES numbers in double precision. (GCC 14 splits __builtin_convertvector into two halves.) */
static inline wide widened(const float* from)
{
  const lanes single = *(const lanes*)from;
  wide to;
#pragma GCC unroll 8
  for (int i = 0; i < LANES; ++i) to[i] = single[i];
  return to;
}

/* y = left A z + lost x, z = right x with ghosts; in double precision, but for A and lost. */
void multiply(int64_t rows, const int64_t* starts, const int32_t* columns, const float* blocks, const float* lost,
    const double* left, const double* z, const double* x, double* restrict y)
{
  for (int64_t row = 0; row < rows; ++row, lost += R * R, left += R, x += R, y += R)
  {
    wide sums[R] = {0}, sum = {0};
    for (int64_t at = starts[row]; at < starts[row + 1]; ++at)
    {
      const float* A = blocks + R * R * at;
      const double* in = z + R * (int64_t)columns[at];
#pragma GCC unroll 6
      for (int s = 0; s < R; ++s) sums[s] += widened(A + R * s) * in[s];
    }
#pragma GCC unroll 6
    for (int s = 0; s < R; ++s) sum += sums[s];
    for (int r = 0; r < R; ++r)
    {
      double value = left[r] * sum[r];
      for (int s = 0; s < R; ++s) value += lost[R * s + r] * x[s];
      y[r] = value;
    }
  }
}
