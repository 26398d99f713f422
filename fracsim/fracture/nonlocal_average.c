/* Products of rows of a sparse matrix with columns, summed in the order of storage (fracture.nonlocal_average). */

#include <stdint.h>

enum { PREFETCH_ROWS = 4 };

typedef struct {
    const int32_t *start, *column; /* (rows + 1,), (weights,) */
    const double *weight;
} Rows;

/* Mark all columns of the rows of those of the cells (count,) that are `chosen`. */
void mark_columns(const Rows *rows, int64_t count, const int64_t *cells, const uint8_t *chosen, uint8_t *marks)
{
    for (int64_t n = 0; n < count; n++)
        if (chosen[cells[n]])
            for (int32_t j = rows->start[n]; j < rows->start[n + 1]; j++) marks[rows->column[j]] = 1;
}

/* result (width,) = a row times x (columns, width). */
static inline __attribute__((always_inline)) void row_product(
    const Rows *rows, int64_t row, int width, const double *x, double *result)
{
    double sums[6] = {0}; /* in registers: in memory each sum would wait for the one before */
    for (int32_t j = rows->start[row]; j < rows->start[row + 1]; j++)
        for (int k = 0; k < width; k++) sums[k] += rows->weight[j] * x[(int64_t)width * rows->column[j] + k];
    for (int k = 0; k < width; k++) result[k] = sums[k];
}

static inline void multiply_row(const Rows *rows, int64_t row, int64_t width, const double *x, double *result)
{
    switch (width) { /* a norm, stress in 2D and in 3D */
    case 1: row_product(rows, row, 1, x, result); return;
    case 3: row_product(rows, row, 3, x, result); return;
    case 6: row_product(rows, row, 6, x, result); return;
    }
    for (int64_t k = 0; k < width; k++) result[k] = 0;
    for (int32_t j = rows->start[row]; j < rows->start[row + 1]; j++)
        for (int64_t k = 0; k < width; k++) result[k] += rows->weight[j] * x[width * rows->column[j] + k];
}

/* result (count, width) = the chosen rows times x. */
void multiply_rows(
    const Rows *rows, int64_t count, const int64_t *chosen, int64_t width, const double *restrict x,
    double *restrict result)
{
    for (int64_t n = 0; n < count; n++) multiply_row(rows, chosen[n], width, x, result + width * n);
}

/* Load a row into the cache. */
static inline void prefetch_row(const Rows *rows, int64_t row)
{
    for (int32_t j = rows->start[row]; j < rows->start[row + 1]; j += 8) {
        __builtin_prefetch(rows->weight + j);
        if (j % 16 < 8) __builtin_prefetch(rows->column + j);
    }
}

/* Averages that reach a bound: of cells (count,) that are a `candidate` (cells,), those whose row times x is at least
   `bound` times the sum of the row. `result` has their numbers, `averages` (result, width) the row times values
   (columns, width) over the sum of the row. Returns their number. */
int64_t averages_above(
    const Rows *rows, int64_t count, const int64_t *cells, const uint8_t *candidate, const double *x,
    const double *row_sums, double bound, int64_t width, const double *values, int64_t *result, double *averages)
{
    int64_t selected = 0;
    for (int64_t row = 0; row < count; row++) {
        double sum;
        const int64_t ahead = row + PREFETCH_ROWS;
        if (ahead < count && candidate[cells[ahead]]) prefetch_row(rows, ahead);
        if (!candidate[cells[row]] || !(row_sums[row] > 0)) continue;
        multiply_row(rows, row, 1, x, &sum);
        if (!(sum >= bound * row_sums[row])) continue;
        multiply_row(rows, row, width, values, averages + width * selected);
        for (int64_t k = 0; k < width; k++) averages[width * selected + k] /= row_sums[row];
        result[selected++] = cells[row];
    }
    return selected;
}
