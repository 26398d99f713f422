/* Linear form over a subset of cells (mechanics.cell_subset_assembly): FFCx's kernel, with coefficients read from the
   arrays of their fields. */

#include <stdint.h>
#include <string.h>

/* The last argument is DOLFINx 0.10's; a kernel of 0.9 does not read it. */
typedef void (*Kernel)(double *, const double *, const double *, const double *, const int *, const uint8_t *,
                       void *);

/* Field with `size` values at each of the `nodes` of a cell; dofs: (cells, nodes). */
typedef struct {
    int64_t nodes, size;
    const int32_t *dofs;
    const double *values;
} Field;

typedef struct {
    Kernel kernel;
    int64_t nodes, size, corners, fields, width; /* nodes, size: of the test function; width: values of all fields in a cell */
    const int32_t *dofs, *points;                /* (cells, nodes), (cells, corners) */
    const double *x, *constants;                 /* (points, 3) */
} Form;

/* Copy the values of a field in a cell; returns the end of the copy. */
static inline double *copy_values(const Field *field, int64_t cell, double *to)
{
    for (int64_t node = 0; node < field->nodes; node++)
        for (int64_t i = 0; i < field->size; i++)
            *to++ = field->values[field->size * field->dofs[field->nodes * cell + node] + i];
    return to;
}

/* Add the integral over cells (count,) to b (dofs,). */
void add(const Form *form, const Field *fields, int64_t count, const int64_t *cells, double *b)
{
    const int64_t rows = form->nodes * form->size;
    double A[rows], w[form->width + 1], x[3 * form->corners];
    for (int64_t n = 0; n < count; n++) {
        double *to = w;
        for (int64_t i = 0; i < form->fields; i++) to = copy_values(fields + i, cells[n], to);
        for (int64_t i = 0; i < form->corners; i++)
            memcpy(x + 3 * i, form->x + 3 * (int64_t)form->points[form->corners * cells[n] + i], 3 * sizeof(double));
        memset(A, 0, rows * sizeof(double));
        form->kernel(A, w, form->constants, x, 0, 0, 0);
        for (int64_t node = 0; node < form->nodes; node++)
            for (int64_t i = 0; i < form->size; i++)
                b[form->size * form->dofs[form->nodes * cells[n] + node] + i] += A[form->size * node + i];
    }
}
