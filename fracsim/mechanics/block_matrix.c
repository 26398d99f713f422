/* Products with rows of blocks (mechanics.block_matrix), one block of D x D numbers after another.    D: 2 or 3. */

#include <stdint.h>

/* y = A x. starts: (rows + 1,) first block of each row; columns: of the blocks, whose entries are stored by rows. */
void multiply(int64_t rows, const int64_t* restrict starts, const int32_t* restrict columns,
    const double* restrict blocks, const double* restrict x, double* restrict y)
{
  for (int64_t row = 0; row < rows; ++row, y += D)
  {
    double sum[D] = {0};
    for (int64_t at = starts[row]; at < starts[row + 1]; ++at)
    {
      const double *A = blocks + D * D * at, *from = x + D * (int64_t)columns[at];
#pragma GCC unroll 3
      for (int r = 0; r < D; ++r)
#pragma GCC unroll 3
        for (int s = 0; s < D; ++s) sum[r] += A[D * r + s] * from[s];
    }
    for (int r = 0; r < D; ++r) y[r] = sum[r];
  }
}
