/* Rows of a sparse matrix times columns, term after term as they are stored. */

#include <stdint.h>

typedef struct {
    const int32_t *start, *place; /* (rows + 1,), (weights,) */
    const double *weight;
} Rows;

/* Mark all places in the rows of those of the cells (count,) that are `chosen`. */
void mark(const Rows *rows, int64_t count, const int64_t *cells, const uint8_t *chosen, uint8_t *marks)
{
    for (int64_t n = 0; n < count; n++)
        if (chosen[cells[n]])
            for (int32_t j = rows->start[n]; j < rows->start[n + 1]; j++) marks[rows->place[j]] = 1;
}

/* found (width,): a row times x (places, width). */
static inline void row_times(const Rows *rows, int64_t row, int64_t width, const double *x, double *found)
{
    int32_t first = rows->start[row], last = rows->start[row + 1];
    if (width == 1) {
        double sum = 0;
        for (int32_t j = first; j < last; j++) sum += rows->weight[j] * x[rows->place[j]];
        found[0] = sum;
        return;
    }
    for (int64_t k = 0; k < width; k++) found[k] = 0;
    for (int32_t j = first; j < last; j++)
        for (int64_t k = 0; k < width; k++) found[k] += rows->weight[j] * x[width * rows->place[j] + k];
}

/* The chosen ones of the rows, found: (count, width). */
void times(
    const Rows *rows, int64_t count, const int64_t *chosen, int64_t width, const double *restrict x,
    double *restrict found)
{
    for (int64_t n = 0; n < count; n++) row_times(rows, chosen[n], width, x, found + width * n);
}

/* Cells of rows (count,), of those that `may` (cells,), whose row times x reaches `bound` times `whole` (rows,), where
   that is not 0: the first ones of `found`. Of these `averages` (found, width) are the row times values (places, width)
   over `whole`. Returns how many. */
int64_t reaching(
    const Rows *rows, int64_t count, const int64_t *cells, const uint8_t *may, const double *x, const double *whole,
    double bound, int64_t width, const double *values, int64_t *found, double *averages)
{
    int64_t many = 0;
    for (int64_t row = 0; row < count; row++) {
        double sum;
        if (!may[cells[row]] || !(whole[row] > 0)) continue;
        row_times(rows, row, 1, x, &sum);
        if (!(sum >= bound * whole[row])) continue;
        row_times(rows, row, width, values, averages + width * many);
        for (int64_t k = 0; k < width; k++) averages[width * many + k] /= whole[row];
        found[many++] = cells[row];
    }
    return many;
}
