/* Rows of a sparse matrix times columns, term after term as they are stored. */

#include <stdint.h>

enum { AHEAD = 4 }; /* rows */

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
static inline __attribute__((always_inline)) void columns(
    const Rows *rows, int64_t row, int width, const double *x, double *found)
{
    double sums[6] = {0}; /* not in memory: each would wait for the one before to be there */
    for (int32_t j = rows->start[row]; j < rows->start[row + 1]; j++)
        for (int k = 0; k < width; k++) sums[k] += rows->weight[j] * x[(int64_t)width * rows->place[j] + k];
    for (int k = 0; k < width; k++) found[k] = sums[k];
}

static inline void row_times(const Rows *rows, int64_t row, int64_t width, const double *x, double *found)
{
    switch (width) { /* a norm, stress in the plane and in space */
    case 1: columns(rows, row, 1, x, found); return;
    case 3: columns(rows, row, 3, x, found); return;
    case 6: columns(rows, row, 6, x, found); return;
    }
    for (int64_t k = 0; k < width; k++) found[k] = 0;
    for (int32_t j = rows->start[row]; j < rows->start[row + 1]; j++)
        for (int64_t k = 0; k < width; k++) found[k] += rows->weight[j] * x[width * rows->place[j] + k];
}

/* The chosen ones of the rows, found: (count, width). */
void times(
    const Rows *rows, int64_t count, const int64_t *chosen, int64_t width, const double *restrict x,
    double *restrict found)
{
    for (int64_t n = 0; n < count; n++) row_times(rows, chosen[n], width, x, found + width * n);
}

/* Tell the processor which row will be read. */
static inline void fetch(const Rows *rows, int64_t row)
{
    for (int32_t j = rows->start[row]; j < rows->start[row + 1]; j += 8) {
        __builtin_prefetch(rows->weight + j);
        if (j % 16 < 8) __builtin_prefetch(rows->place + j);
    }
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
        if (row + AHEAD < count && may[cells[row + AHEAD]]) fetch(rows, row + AHEAD);
        if (!may[cells[row]] || !(whole[row] > 0)) continue;
        row_times(rows, row, 1, x, &sum);
        if (!(sum >= bound * whole[row])) continue;
        row_times(rows, row, width, values, averages + width * many);
        for (int64_t k = 0; k < width; k++) averages[width * many + k] /= whole[row];
        found[many++] = cells[row];
    }
    return many;
}
