/* Pairs of simplices that may come near each other in a motion (contact.pair_search). Coordinates are 3D. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define MAX_CELLS_PER_BOX 8
/* levels of sizes, each half of the one before; the last has all that is smaller */
#define LEVELS 12

typedef struct {
    double low[3], high[3];
} Box;

static void subtract(double *r, const double *a, const double *b)
{
    for (int k = 0; k < 3; k++) r[k] = a[k] - b[k];
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static double clip(double t) { return t < 0 ? 0 : t > 1 ? 1 : t; }

static double ratio(double a, double b) { return b > 0 ? a / b : 0; }

/* Squared distance of a point from a segment (2, 3). */
static double point_segment(const double *p, const double *x)
{
    double side[3], arm[3];
    subtract(side, x + 3, x);
    subtract(arm, p, x);
    double t = clip(ratio(dot(arm, side), dot(side, side)));
    for (int k = 0; k < 3; k++) arm[k] -= t * side[k];
    return dot(arm, arm);
}

/* Squared distance of a point from a triangle (3, 3): from its plane, or from its sides. */
static double point_triangle(const double *p, const double *x)
{
    double a[3], b[3], arm[3];
    subtract(a, x + 3, x);
    subtract(b, x + 6, x);
    subtract(arm, p, x);
    double aa = dot(a, a), ab = dot(a, b), bb = dot(b, b), pa = dot(arm, a), pb = dot(arm, b);
    double determinant = aa * bb - ab * ab, s = bb * pa - ab * pb, t = aa * pb - ab * pa;
    if (s >= 0 && t >= 0 && s + t <= determinant && determinant > 0) {
        for (int k = 0; k < 3; k++) arm[k] -= (s * a[k] + t * b[k]) / determinant;
        return dot(arm, arm);
    }
    double closing[6];
    memcpy(closing, x + 6, 3 * sizeof(double));
    memcpy(closing + 3, x, 3 * sizeof(double));
    return fmin(point_segment(p, x), fmin(point_segment(p, x + 3), point_segment(p, closing)));
}

/* Squared distance of two segments (2, 3): of their lines, or of an end from the other segment. */
static double segment_segment(const double *x, const double *y)
{
    double a[3], b[3], r[3];
    subtract(a, x + 3, x);
    subtract(b, y + 3, y);
    subtract(r, x, y);
    double aa = dot(a, a), ab = dot(a, b), bb = dot(b, b), ra = dot(r, a), rb = dot(r, b);
    double determinant = aa * bb - ab * ab, s = ab * rb - bb * ra, t = aa * rb - ab * ra;
    if (determinant > 1e-12 * aa * bb && s >= 0 && s <= determinant && t >= 0 && t <= determinant) {
        for (int k = 0; k < 3; k++) r[k] += (s * a[k] - t * b[k]) / determinant;
        return dot(r, r);
    }
    return fmin(fmin(point_segment(x, y), point_segment(x + 3, y)), fmin(point_segment(y, x), point_segment(y + 3, x)));
}

static double distance(int a, const double *x, int b, const double *y)
{
    return sqrt(a == 2 ? segment_segment(x, y) : b == 2 ? point_segment(x, y) : point_triangle(x, y));
}

/* Positions (n, 3) of a simplex of `corners` vertices, or of its centroid; the number n of these points. */
static int gather(const double *x, const int32_t *vertices, int corners, int centroid, double *points)
{
    if (!centroid) {
        for (int c = 0; c < corners; c++) memcpy(points + 3 * c, x + 3 * vertices[c], 3 * sizeof(double));
        return corners;
    }
    for (int k = 0; k < 3; k++) {
        points[k] = 0;
        for (int c = 0; c < corners; c++) points[k] += x[3 * vertices[c] + k] / corners;
    }
    return 1;
}

/* Box around the motion of n points (n, 3), grown by `reach`. */
static Box box_of(int n, const double *start, const double *end, double reach)
{
    Box box;
    for (int k = 0; k < 3; k++) {
        double low = INFINITY, high = -INFINITY;
        for (int c = 0; c < n; c++) {
            low = fmin(low, fmin(start[3 * c + k], end[3 * c + k]));
            high = fmax(high, fmax(start[3 * c + k], end[3 * c + k]));
        }
        box.low[k] = low - reach, box.high[k] = high + reach;
    }
    return box;
}

/* Lower bound of the distance of two simplices that move straight from `start` to `end`, with the same clock. */
static double least_distance(int a, const double *xs, const double *xe, int b, const double *ys, const double *ye,
                             double reach)
{
    double relative = 0;
    for (int i = 0; i < 3 * a; i += 3)
        for (int j = 0; j < 3 * b; j += 3) {
            double m[3];
            for (int k = 0; k < 3; k++) m[k] = (xe[i + k] - xs[i + k]) - (ye[j + k] - ys[j + k]);
            relative = fmax(relative, dot(m, m));
        }
    relative = sqrt(relative);
    double first = distance(a, xs, b, ys);
    if (relative == 0 || first - relative > reach || first <= reach) return first - relative;
    return (first + distance(a, xe, b, ye) - relative) / 2;
}

static int share_vertex(int a, const int32_t *x, int b, const int32_t *y)
{
    for (int i = 0; i < a; i++)
        for (int j = 0; j < b; j++)
            if (x[i] == y[j]) return 1;
    return 0;
}

/* Boxes of similar size in a grid of cubes, each in the cube of its low corner. */
typedef struct {
    double low[3], scale, size[3]; /* corner of the grid, 1 / side of a cube, largest sides of a box */
    int count[3];
    int64_t boxes, *begin; /* (cubes + 1,) first of the numbers of each cube */
    int32_t *numbers;
    Box *sorted; /* boxes in the order of their numbers here */
} Grid;

static void cell_of(const Grid *grid, const double *x, int *cell)
{
    for (int k = 0; k < 3; k++) {
        double c = (x[k] - grid->low[k]) * grid->scale, most = grid->count[k] - 1;
        /* positions that are no numbers are in the first cube */
        cell[k] = (int)(c > 0 ? c < most ? c : most : 0);
    }
}

static int64_t number_of(const Grid *grid, const int *cell)
{
    return ((int64_t)cell[0] * grid->count[1] + cell[1]) * grid->count[2] + cell[2];
}

/* Size of a box: the largest side. */
static double size_of(const Box *box)
{
    double size = 0;
    for (int k = 0; k < 3; k++) size = fmax(size, box->high[k] - box->low[k]);
    return size;
}

/* Grid of the boxes (n,) of a level. Returns 0 without memory. */
static int make_grid(Grid *grid, int level, int64_t n, const Box *boxes, const int8_t *levels)
{
    double high[3];
    grid->boxes = 0, grid->begin = NULL, grid->numbers = NULL, grid->sorted = NULL;
    for (int k = 0; k < 3; k++) grid->low[k] = INFINITY, high[k] = -INFINITY, grid->size[k] = 0;
    for (int64_t j = 0; j < n; j++) {
        if (levels[j] != level) continue;
        grid->boxes++;
        for (int k = 0; k < 3; k++) {
            grid->low[k] = fmin(grid->low[k], boxes[j].low[k]), high[k] = fmax(high[k], boxes[j].low[k]);
            grid->size[k] = fmax(grid->size[k], boxes[j].high[k] - boxes[j].low[k]);
        }
    }
    if (!grid->boxes) return 1;
    double side = fmax(grid->size[0], fmax(grid->size[1], grid->size[2])) / 2;
    for (double cells = INFINITY; cells > MAX_CELLS_PER_BOX * (double)grid->boxes + 64; side *= 1.25) {
        cells = 1, grid->scale = side > 0 ? 1 / side : 0;
        for (int k = 0; k < 3; k++) {
            double c = floor((high[k] - grid->low[k]) * grid->scale) + 1;
            cells *= c, grid->count[k] = c >= 1 && c < 1e9 ? (int)c : 1;
        }
    }
    int64_t cells = (int64_t)grid->count[0] * grid->count[1] * grid->count[2];
    grid->begin = calloc(cells + 2, sizeof(int64_t)), grid->numbers = malloc(grid->boxes * sizeof(int32_t));
    grid->sorted = malloc(grid->boxes * sizeof(Box));
    if (!grid->begin || !grid->numbers || !grid->sorted) return 0;
    /* counts, then sums, then numbers, as in a counting sort */
    for (int round = 0; round < 2; round++) {
        for (int64_t j = 0; j < n; j++) {
            if (levels[j] != level) continue;
            int cell[3];
            cell_of(grid, boxes[j].low, cell);
            int64_t number = number_of(grid, cell);
            if (round) grid->sorted[grid->begin[number + 1]] = boxes[j], grid->numbers[grid->begin[number + 1]++] = (int32_t)j;
            else grid->begin[number + 2]++;
        }
        for (int64_t cell = 0; !round && cell < cells; cell++) grid->begin[cell + 2] += grid->begin[cell + 1];
    }
    return 1;
}

/* Pairs of a simplex of `first` (m, a) and one of `second` (n, b), without common vertices, that may come as near as
   `reach` while the vertices (count, 3) move from `start` to `end`. Of `first`, the centroids count if `centroids`.
   With `same` both are one set, and each pair is found once. Pairs have different patches, unless those are negative,
   and one of them is marked as `own`. Up to `capacity` pairs (k, 2) are written; returns k, or -1 without memory. */
int64_t find_near_pairs(const double *start, const double *end, int64_t m, int a, const int32_t *first, int64_t n, int b,
                        const int32_t *second, int centroids, int same, const int32_t *patches, const uint8_t *own,
                        double reach, int64_t capacity, int32_t *pairs)
{
    if (m == 0 || n == 0) return 0;
    double xs[9], xe[9], ys[9], ye[9];
    Box *boxes = malloc(n * sizeof(Box));
    int8_t *levels = malloc(n);
    Grid grids[LEVELS] = {0};
    int complete = boxes && levels;
    double largest = 0;
    for (int64_t j = 0; complete && j < n; j++) {
        gather(start, second + b * j, b, 0, ys);
        gather(end, second + b * j, b, 0, ye);
        boxes[j] = box_of(b, ys, ye, reach);
        largest = fmax(largest, size_of(&boxes[j]));
    }
    for (int64_t j = 0; complete && j < n; j++) {
        levels[j] = 0;
        for (double size = 2 * size_of(&boxes[j]); size <= largest && levels[j] < LEVELS - 1; size *= 2) levels[j]++;
    }
    for (int level = 0; complete && level < LEVELS; level++)
        complete = make_grid(&grids[level], level, n, boxes, levels);
    int64_t found = complete ? 0 : -1;
    for (int64_t i = 0; complete && i < m; i++) {
        const int32_t *x = first + a * i;
        int points = gather(start, x, a, centroids, xs);
        gather(end, x, a, centroids, xe);
        const Box box = box_of(points, xs, xe, 0);
        for (const Grid *grid = grids; grid < grids + LEVELS; grid++) {
            if (!grid->boxes) continue;
            double low[3];
            int from[3], to[3], cell[3];
            for (int k = 0; k < 3; k++) low[k] = box.low[k] - grid->size[k];
            cell_of(grid, low, from), cell_of(grid, box.high, to);
            for (cell[0] = from[0]; cell[0] <= to[0]; cell[0]++)
                for (cell[1] = from[1]; cell[1] <= to[1]; cell[1]++) {
                    /* the cubes of a column follow one another */
                    cell[2] = from[2];
                    int64_t number = number_of(grid, cell);
                    for (int64_t k = grid->begin[number]; k < grid->begin[number + to[2] - from[2] + 1]; k++) {
                        const Box *other = &grid->sorted[k];
                        /* no branches: most boxes of neighbouring cubes are apart in one of the axes */
                        int apart = 0;
                        for (int axis = 0; axis < 3; axis++)
                            apart |= (box.low[axis] > other->high[axis]) | (box.high[axis] < other->low[axis]);
                        if (apart) continue;
                        int64_t j = grid->numbers[k];
                        const int32_t *y = second + b * j;
                        if (same && j <= i) continue;
                        if (patches[x[0]] == patches[y[0]] && patches[x[0]] >= 0) continue;
                        if (share_vertex(a, x, b, y)) continue;
                        int is_own = 0;
                        for (int c = 0; c < a; c++) is_own |= own[x[c]];
                        for (int c = 0; c < b; c++) is_own |= own[y[c]];
                        if (!is_own) continue;
                        gather(start, y, b, 0, ys);
                        gather(end, y, b, 0, ye);
                        if (least_distance(points, xs, xe, b, ys, ye, reach) > reach) continue;
                        if (found < capacity) pairs[2 * found] = (int32_t)i, pairs[2 * found + 1] = (int32_t)j;
                        found++;
                    }
                }
        }
    }
    for (int level = 0; level < LEVELS; level++) free(grids[level].begin), free(grids[level].numbers), free(grids[level].sorted);
    free(boxes), free(levels);
    return found;
}
