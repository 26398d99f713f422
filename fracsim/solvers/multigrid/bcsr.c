/* Rows of square blocks in single precision (solvers.multigrid.bcsr).    R: rows of a block, whose numbers come column by column,
   eight more behind the last block; LANES: 2, 4 or 8, at least R. starts: of rows; columns: of blocks.
   B: one symmetric block of R x R a row, eight more numbers behind the last one. */

#include <math.h>
#include <stdint.h>

typedef float lanes __attribute__((vector_size(4 * LANES), aligned(4), may_alias));
typedef double wide __attribute__((vector_size(8 * LANES)));

/* R numbers of A x, and whatever comes behind them; a sum of its own for each column, or each would wait for the last. */
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

/* left = b - A x */
void residual(int64_t rows, const int64_t* starts, const int32_t* columns, const float* blocks, const float* b,
    const float* x, float* left)
{
  for (int64_t row = 0; row < rows; ++row)
  {
    const lanes sum = product(starts[row], starts[row + 1], columns, blocks, x);
    for (int r = 0; r < R; ++r) left[R * row + r] = b[R * row + r] - sum[r];
  }
}

/* B left, and whatever comes behind it */
static inline lanes by_block(const float* B, const float* left)
{
  lanes sum = {0};
#pragma GCC unroll 6
  for (int s = 0; s < R; ++s) sum += *(const lanes*)(B + R * s) * left[s];
  return sum;
}

/* d = x = take B b */
void begin(int64_t rows, const float* B, float take, const float* b, float* d, float* x)
{
  for (int64_t row = 0; row < rows; ++row)
  {
    const lanes first = take * by_block(B + R * R * row, b + R * row);
    for (int r = 0; r < R; ++r) d[R * row + r] = x[R * row + r] = first[r];
  }
}

/* d = keep d + take B (b - A x),  to = x + d */
void smooth(int64_t rows, const int64_t* starts, const int32_t* columns, const float* blocks, const float* B, float keep,
    float take, const float* b, const float* x, float* d, float* to)
{
  for (int64_t row = 0; row < rows; ++row)
  {
    const lanes sum = product(starts[row], starts[row + 1], columns, blocks, x);
    float left[R];
    for (int r = 0; r < R; ++r) left[r] = b[R * row + r] - sum[r];
    const lanes step = by_block(B + R * R * row, left);
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

/* to = left A right, left and right diagonal; A in double precision, the numbers of its blocks row by row. */
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

/* The Cholesky factor L of D, the reciprocals of its diagonal in place of that; 0: D is not positive, or not as far as
   single precision tells. */
static int factor(const float* D, double L[R][R])
{
  for (int i = 0; i < R; ++i)
    for (int j = 0; j <= i; ++j)
    {
      double left = (D[R * i + j] + (double)D[R * j + i]) / 2;
      for (int k = 0; k < j; ++k) left -= L[i][k] * L[j][k];
      if (i == j && !(left > 1e-5 * D[R * i + i])) return 0;
      L[i][j] = i == j ? 1 / sqrt(left) : left * L[j][j];
    }
  return 1;
}

/* B = D^-1; where D is not positive, the inverse of its diagonal's size, 1 where that is 0. */
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

/* What rounding has taken from the rows of A, as A is without left and right, B = left A right: the symmetric parts of
   the sums of A_ij - left_i^-1 B_ij right_j^-1 over j. A row by row, B column by column. */
void lose(int64_t rows, const int64_t* starts, const int32_t* columns, const float* B, const double* A,
    const double* left, const double* right, float* lost)
{
  for (int64_t row = 0; row < rows; ++row, lost += R * R)
  {
    double sum[R][R] = {0};
    const double* l = left + R * row;
    for (int64_t at = starts[row]; at < starts[row + 1]; ++at)
    {
      const double *whole = A + R * R * at, *r = right + R * (int64_t)columns[at];
      const float* rounded = B + R * R * at;
      for (int t = 0; t < R; ++t)
        for (int s = 0; s < R; ++s) sum[t][s] += whole[R * t + s] - l[t] * rounded[R * s + t] * r[s];
    }
    for (int t = 0; t < R; ++t)
      for (int s = 0; s < R; ++s) lost[R * t + s] = (float)((sum[t][s] + sum[s][t]) / 2);
  }
}

/* Some numbers in double precision. (GCC 14 makes __builtin_convertvector of two halves.) */
static inline wide widened(const float* from)
{
  const lanes some = *(const lanes*)from;
  wide to;
#pragma GCC unroll 8
  for (int i = 0; i < LANES; ++i) to[i] = some[i];
  return to;
}

/* y = left A z + lost x, z = right x of ghosts as well: in double precision but for A and what it has lost. */
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
      double given = left[r] * sum[r];
      for (int s = 0; s < R; ++s) given += lost[R * s + r] * x[s];
      y[r] = given;
    }
  }
}
