/* Prolongation between two levels (solvers.multigrid.bcsr): block CSR matrix in single precision.
   R, C: rows and columns of a block, which is stored by rows. starts: of rows; columns: of blocks. */

#include <stdint.h>

typedef float four __attribute__((vector_size(16), aligned(4), may_alias));
typedef float two __attribute__((vector_size(8), aligned(4), may_alias));

enum { IN_FOURS = C / 4 * 4, IN_TWOS = C / 2 * 2 };  // columns in groups of four and of two

/* to = left A right, left and right diagonal; A in double precision. */
void scale(int64_t rows, const int64_t* starts, const int32_t* columns, const double* blocks, const double* left,
    const double* right, float* to)
{
  for (int64_t row = 0; row < rows; ++row)
    for (int64_t at = starts[row]; at < starts[row + 1]; ++at)
      for (int r = 0; r < R; ++r)
        for (int s = 0; s < C; ++s)
        {
          const int64_t i = R * C * at + C * r + s;
          to[i] = (float)(left[R * row + r] * blocks[i] * right[C * (int64_t)columns[at] + s]);
        }
}

/* y += A x */
void add(int64_t rows, const int64_t* starts, const int32_t* columns, const float* blocks, const float* x, float* y)
{
  for (int64_t row = 0; row < rows; ++row, y += R)
  {
    four fours[R] = {0};
    two twos[R] = {0};
    float ones[R] = {0};
    for (int64_t at = starts[row]; at < starts[row + 1]; ++at)
    {
      const float *A = blocks + R * C * at, *in = x + C * (int64_t)columns[at];
#pragma GCC unroll 6
      for (int r = 0; r < R; ++r)
      {
        for (int s = 0; s < IN_FOURS; s += 4) fours[r] += *(const four*)(A + C * r + s) * *(const four*)(in + s);
        for (int s = IN_FOURS; s < IN_TWOS; s += 2) twos[r] += *(const two*)(A + C * r + s) * *(const two*)(in + s);
        for (int s = IN_TWOS; s < C; ++s) ones[r] += A[C * r + s] * in[s];
      }
    }
    for (int r = 0; r < R; ++r)
      y[r] += ((fours[r][0] + fours[r][1]) + (fours[r][2] + fours[r][3])) + (twos[r][0] + twos[r][1]) + ones[r];
  }
}

/* to += (rows of A)^T x, for the columns from s on that fit into the type. */
#define ADD(type)                                                                        \
  {                                                                                      \
    type sum = *(const type*)(to + s);                                                   \
    for (int r = 0; r < R; ++r) sum += *(const type*)(A + C * r + s) * x[r];             \
    *(type*)(to + s) = sum;                                                              \
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
      for (int s = 0; s < IN_FOURS; s += 4) ADD(four)
      for (int s = IN_FOURS; s < IN_TWOS; s += 2) ADD(two)
      for (int s = IN_TWOS; s < C; ++s) ADD(float)
    }
}
