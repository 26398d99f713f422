/* Form over cells, LANES of them at a time (mechanics.simd_kernels, which inserts FFCx's kernel below).

   RANK: 2 for a matrix, 1 for a vector, 0 for a functional or an expression.    NODES, D: nodes of a cell, dofs of a node;
   for an expression its components, and 1.    CORNERS: geometry nodes of a cell. */

#include <math.h>
#include <stdbool.h>
#include <stdint.h>
#include <string.h>

enum { DOFS = NODES * D, SIZE = RANK == 2 ? DOFS * DOFS : DOFS };
typedef double real __attribute__((vector_size(8 * LANES), may_alias));
static const real zero = {0};
// functions
static inline void kernel(real* restrict A, const real* restrict w, const real* restrict c,
    const real* restrict coordinate_dofs)
// kernel

/* Field: dofs (cells, nodes), and the values at each of them. */
typedef struct {
  const int32_t* dofs;
  const double* values;
} Field;

/* Cells and coefficients of a form: `width` values of its fields in a cell, and `size` constants. */
typedef struct {
  int64_t count, width, size;
  const int32_t *cells, *dofs, *corners;
  const double *x, *c;
  const Field* fields;
} Form;

/* Copy the values of a field in a cell into one lane. */
static inline double* copy_values(const Field* field, int nodes, int size, int64_t cell, double* lane)
{
  for (int node = 0; node < nodes; ++node)
    for (int i = 0; i < size; ++i, lane += LANES)
      *lane = field->values[size * (int64_t)field->dofs[nodes * cell + node] + i];
  return lane;
}

#define TAKE(number, nodes, size) lane = copy_values(form->fields + number, nodes, size, cell, lane);
static inline void look_up(const Form* form, int64_t cell, double* lane) { FIELDS }

/* Results A of the kernel for LANES cells from `first` on; beyond the last cell `first` is repeated. Returns the number
   of cells that are not. */
static inline int values(const Form* form, int64_t first, const real* constants, real* numbers, real* A)
{
  const int left = form->count - first < LANES ? (int)(form->count - first) : LANES;
  real points[3 * CORNERS];
  for (int lane = 0; lane < LANES; ++lane)
  {
    const int64_t at = first + (lane < left ? lane : 0);
    look_up(form, form->cells[at], (double*)numbers + lane);
    const int32_t* cell = form->corners + (int64_t)CORNERS * form->cells[at];
    for (int i = 0; i < CORNERS; ++i)
      for (int axis = 0; axis < 3; ++axis) points[3 * i + axis][lane] = form->x[3 * (int64_t)cell[i] + axis];
  }
  memset(A, 0, SIZE * sizeof(real));
  kernel(A, numbers, constants, points);
  return left;
}

#if RANK == 0
/* Values of the expression, or of the integral, in each cell, b: (count, SIZE). */
void fill(const Form* form, double* b)
{
  real constants[form->size + 1], numbers[form->width + 1], A[SIZE];
  for (int i = 0; i < form->size; ++i) constants[i] = zero + form->c[i];
  for (int64_t first = 0; first < form->count; first += LANES)
  {
    const int left = values(form, first, constants, numbers, A);
    for (int lane = 0; lane < left; ++lane)
      for (int i = 0; i < SIZE; ++i) b[SIZE * (first + lane) + i] = A[i][lane];
  }
}
#elif RANK == 1
/* Add the integral over the cells to b (dofs,). */
void add(const Form* form, double* b)
{
  real constants[form->size + 1], numbers[form->width + 1], A[SIZE];
  for (int i = 0; i < form->size; ++i) constants[i] = zero + form->c[i];
  for (int64_t first = 0; first < form->count; first += LANES)
  {
    const int left = values(form, first, constants, numbers, A);
    for (int lane = 0; lane < left; ++lane)
    {
      const int32_t* nodes = form->dofs + (int64_t)NODES * form->cells[first + lane];
      for (int i = 0; i < DOFS; ++i) b[D * (int64_t)nodes[i / D] + i % D] += A[i][lane];
    }
  }
}
#else
/* Set rows and columns of prescribed dofs to zero; held: a bit for each prescribed axis of a node. */
static inline void empty(double* A, const int32_t* nodes, const uint8_t* held)
{
  for (int i = 0; i < DOFS; ++i)
    if (held[nodes[i / D]] >> i % D & 1)
      for (int j = 0; j < DOFS; ++j) A[LANES * (DOFS * i + j)] = A[LANES * (DOFS * j + i)] = 0.0;
}

/* Prefetch the entries that will be added to next. */
static inline void fetch(const int32_t* places, const double* sum)
{
  for (int i = 0; i < NODES * NODES; ++i)
  {
    __builtin_prefetch(sum + places[i], 1);
    __builtin_prefetch(sum + places[i] + D * D - 1, 1);
  }
}

/* Add the blocks of one cell; A: one lane of DOFS^2 vectors. */
static inline void insert(const double* A, const int32_t* nodes, const int32_t* places, const int32_t* strides,
    double* sum)
{
  for (int a = 0; a < NODES; ++a)
    for (int b = 0; b < NODES; ++b)
    {
      double* to = sum + places[NODES * a + b];
      const int64_t stride = strides[nodes[a]];
      const double* from = A + LANES * D * (DOFS * a + b);
#pragma GCC unroll 3
      for (int r = 0; r < D; ++r)
#pragma GCC unroll 3
        for (int s = 0; s < D; ++s) to[stride * r + s] += from[LANES * (DOFS * r + s)];
    }
}

/* Add the blocks of all cells; rows are as far apart as the stride of their node. Returns 0, or 1 + the number of a cell
   that has no position in the matrix. */
int64_t add_blocks(const Form* form, const int32_t* places, const int32_t* strides, const uint8_t* held, double* sum)
{
  real constants[form->size + 1], numbers[form->width + 1], A[SIZE];
  for (int i = 0; i < form->size; ++i) constants[i] = zero + form->c[i];
  for (int64_t first = 0; first < form->count; first += LANES)
  {
    const int left = values(form, first, constants, numbers, A);
    for (int lane = 0; lane < left; ++lane)
    {
      const int64_t cell = form->cells[first + lane], next = first + LANES + lane;
      const int32_t* nodes = form->dofs + NODES * cell;
      bool any = false;
      for (int a = 0; a < NODES; ++a) any |= held[nodes[a]] != 0;
      if (any) empty((double*)A + lane, nodes, held);
      if (places[NODES * NODES * cell] < 0) return cell + 1;
      if (next < form->count) fetch(places + NODES * NODES * (int64_t)form->cells[next], sum);
      insert((const double*)A + lane, nodes, places + NODES * NODES * cell, strides, sum);
    }
  }
  return 0;
}

/* Position of the first entry of each block of each cell; -1 in the first if a block has none. columns: of blocks one
   after another (apart = 1), or of entries by rows (apart = D). */
void find(int64_t count, const int32_t* dofs, int64_t apart, const int64_t* starts, const int32_t* columns,
    int32_t* places)
{
  for (int64_t cell = 0; cell < count; ++cell, places += NODES * NODES)
  {
    const int32_t* nodes = dofs + NODES * cell;
    bool has = true;
    for (int a = 0; a < NODES; ++a)
      for (int b = 0; b < NODES; ++b)
      {
        int64_t at = starts[apart * nodes[a]], end = starts[apart * nodes[a] + 1];
        while (at < end && columns[at] != apart * nodes[b]) at += apart;
        places[NODES * a + b] = (int32_t)(apart == 1 ? D * D * at : at);
        has &= at < end;
      }
    if (!has) places[0] = -1;
  }
}
#endif
