/* Rows of blocks in single precision (stepping.rows).    R, C: rows and columns of a block, whose numbers come column by
   column, eight more behind the last block; LANES: 2, 4 or 8, at least R. starts: of rows; columns: of blocks. */

#include <stdint.h>

typedef float lanes __attribute__((vector_size(4 * LANES), aligned(4), may_alias));

/* R numbers of A x, and whatever comes behind them; a sum of its own for each column, or each would wait for the last. */
static inline lanes product(int64_t from, int64_t to, const int32_t* columns, const float* blocks, const float* x)
{
  lanes sums[C] = {0}, sum = {0};
  for (int64_t at = from; at < to; ++at)
  {
    const float *A = blocks + R * C * at, *in = x + C * (int64_t)columns[at];
#pragma GCC unroll 6
    for (int s = 0; s < C; ++s) sums[s] += *(const lanes*)(A + R * s) * in[s];
  }
#pragma GCC unroll 6
  for (int s = 0; s < C; ++s) sum += sums[s];
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

/* d = keep d + take (b - A x),  to = x + d */
void smooth(int64_t rows, const int64_t* starts, const int32_t* columns, const float* blocks, float keep, float take,
    const float* b, const float* x, float* d, float* to)
{
  for (int64_t row = 0; row < rows; ++row)
  {
    const lanes sum = product(starts[row], starts[row + 1], columns, blocks, x);
    for (int r = 0; r < R; ++r)
    {
      const int64_t i = R * row + r;
      d[i] = keep * d[i] + take * (b[i] - sum[r]);
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

/* y += A^T x */
void add_transposed(int64_t rows, const int64_t* starts, const int32_t* columns, const float* blocks, const float* x,
    float* y)
{
  for (int64_t row = 0; row < rows; ++row, x += R)
    for (int64_t at = starts[row]; at < starts[row + 1]; ++at)
    {
      const float* A = blocks + R * C * at;
      float* to = y + C * (int64_t)columns[at];
#pragma GCC unroll 6
      for (int s = 0; s < C; ++s)
#pragma GCC unroll 6
        for (int r = 0; r < R; ++r) to[s] += A[R * s + r] * x[r];
    }
}

/* to = left A right, left and right diagonal; A in double precision, the numbers of its blocks row by row. */
void scale(int64_t rows, const int64_t* starts, const int32_t* columns, const double* blocks, const double* left,
    const double* right, float* to)
{
  for (int64_t row = 0; row < rows; ++row)
    for (int64_t at = starts[row]; at < starts[row + 1]; ++at)
    {
      const double *A = blocks + R * C * at, *l = left + R * row, *r = right + C * (int64_t)columns[at];
      float* B = to + R * C * at;
#pragma GCC unroll 6
      for (int s = 0; s < C; ++s)
#pragma GCC unroll 6
        for (int t = 0; t < R; ++t) B[R * s + t] = (float)(l[t] * A[C * t + s] * r[s]);
    }
}
