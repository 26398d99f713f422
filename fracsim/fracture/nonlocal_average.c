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

/* Which of the chosen rows times x reach `bound` times `whole` (rows,), where that is not 0. Returns how many, the first
   ones of `found`. */
int64_t above(
    const Rows *rows, int64_t count, const int64_t *chosen, const double *x, const double *whole, double bound,
    int64_t *found)
{
    int64_t many = 0;
    for (int64_t n = 0; n < count; n++) {
        int64_t row = chosen[n];
        double sum = 0;
        for (int32_t j = rows->start[row]; j < rows->start[row + 1]; j++) sum += rows->weight[j] * x[rows->place[j]];
        if (whole[row] > 0 && sum >= bound * whole[row]) found[many++] = row;
    }
    return many;
}

/* found (count, width): the chosen ones of the rows times x (places, width). */
void times(
    const Rows *rows, int64_t count, const int64_t *chosen, int64_t width, const double *restrict x,
    double *restrict found)
{
    for (int64_t n = 0; n < count; n++, found += width) {
        int32_t first = rows->start[chosen[n]], last = rows->start[chosen[n] + 1];
        if (width == 1) {
            double sum = 0;
            for (int32_t j = first; j < last; j++) sum += rows->weight[j] * x[rows->place[j]];
            found[0] = sum;
            continue;
        }
        for (int64_t k = 0; k < width; k++) found[k] = 0;
        for (int32_t j = first; j < last; j++)
            for (int64_t k = 0; k < width; k++) found[k] += rows->weight[j] * x[width * rows->place[j] + k];
    }
}
