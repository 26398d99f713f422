/* Pairs of simplices that may come near each other in a motion (contact.pair_search). Coordinates are 3D. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#define MAX_CELLS_PER_SIMPLEX 4
#define ROUND_OFF 1e-10 /* of the height of a point above a plane, in the sizes of triangle and edge */

typedef struct {
    double low[3], high[3];
} Box;

/* the smaller and the larger of two numbers, `a` if `b` is no number: fmin and fmax would be calls */
static double lower(double a, double b) { return b < a ? b : a; }

static double higher(double a, double b) { return b > a ? b : a; }

static void subtract(double *r, const double *a, const double *b)
{
    for (int k = 0; k < 3; k++) r[k] = a[k] - b[k];
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static double clip(double t) { return t < 0 ? 0 : t > 1 ? 1 : t; }

static double ratio(double a, double b) { return b > 0 ? a / b : 0; }

/* Shortest vector `r` from a segment (2, 3) to a point; returns its square. */
static double from_segment(const double *x, const double *p, double *r)
{
    double side[3];
    subtract(side, x + 3, x);
    subtract(r, p, x);
    double t = clip(ratio(dot(r, side), dot(side, side)));
    for (int k = 0; k < 3; k++) r[k] -= t * side[k];
    return dot(r, r);
}

/* Replace `r` by another vector, times `sign`, if that is shorter; returns the square of the shorter one. */
static double shorter(double square, double *r, double other_square, const double *other, double sign)
{
    if (other_square >= square) return square;
    for (int k = 0; k < 3; k++) r[k] = sign * other[k];
    return other_square;
}

/* Shortest vector `r` from a triangle (3, 3) to a point: from its plane, or from its sides; returns its square. */
static double from_triangle(const double *x, const double *p, double *r)
{
    double a[3], b[3], other[3];
    subtract(a, x + 3, x);
    subtract(b, x + 6, x);
    subtract(r, p, x);
    double aa = dot(a, a), ab = dot(a, b), bb = dot(b, b), pa = dot(r, a), pb = dot(r, b);
    double determinant = aa * bb - ab * ab, s = bb * pa - ab * pb, t = aa * pb - ab * pa;
    if (s >= 0 && t >= 0 && s + t <= determinant && determinant > 0) {
        for (int k = 0; k < 3; k++) r[k] -= (s * a[k] + t * b[k]) / determinant;
        return dot(r, r);
    }
    double closing[6];
    memcpy(closing, x + 6, 3 * sizeof(double));
    memcpy(closing + 3, x, 3 * sizeof(double));
    double square = from_segment(x, p, r);
    square = shorter(square, r, from_segment(x + 3, p, other), other, 1);
    return shorter(square, r, from_segment(closing, p, other), other, 1);
}

/* Shortest vector `r` from segment y to segment x (2, 3): of their lines, or at an end; returns its square. */
static double from_segment_to_segment(const double *y, const double *x, double *r)
{
    double a[3], b[3], other[3];
    subtract(a, x + 3, x);
    subtract(b, y + 3, y);
    subtract(r, x, y);
    double aa = dot(a, a), ab = dot(a, b), bb = dot(b, b), ra = dot(r, a), rb = dot(r, b);
    double determinant = aa * bb - ab * ab, s = ab * rb - bb * ra, t = aa * rb - ab * ra;
    if (determinant > 1e-12 * aa * bb && s >= 0 && s <= determinant && t >= 0 && t <= determinant) {
        for (int k = 0; k < 3; k++) r[k] += (s * a[k] - t * b[k]) / determinant;
        return dot(r, r);
    }
    double square = from_segment(y, x, r);
    square = shorter(square, r, from_segment(y, x + 3, other), other, 1);
    square = shorter(square, r, from_segment(x, y, other), other, -1);
    return shorter(square, r, from_segment(x, y + 3, other), other, -1);
}

/* Shortest vector `r` from simplex y, of b vertices, to simplex x, of a vertices; returns its length. */
static double shortest_vector(int a, const double *x, int b, const double *y, double *r)
{
    return sqrt(a == 2 ? from_segment_to_segment(y, x, r) : b == 2 ? from_segment(y, x, r) : from_triangle(y, x, r));
}

static double distance(int a, const double *x, int b, const double *y)
{
    double r[3];
    return shortest_vector(a, x, b, y, r);
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

/* Box around the motion of n points (n, 3), grown by `reach`; positions that are no numbers do not count. */
static Box box_of(int n, const double *start, const double *end, double reach)
{
    Box box;
    for (int k = 0; k < 3; k++) {
        double low = INFINITY, high = -INFINITY;
        for (int c = 0; c < n; c++) {
            double a = start[3 * c + k], b = end[3 * c + k];
            low = lower(lower(low, a), b), high = higher(higher(high, a), b);
        }
        box.low[k] = low - reach, box.high[k] = high + reach;
    }
    return box;
}

static int boxes_meet(const Box *a, const Box *b)
{
    return !(a->low[0] > b->high[0] || a->high[0] < b->low[0] || a->low[1] > b->high[1] || a->high[1] < b->low[1]
             || a->low[2] > b->high[2] || a->high[2] < b->low[2]);
}

/* Largest length of the relative motion of two vertices of simplices that move straight from `start` to `end`. */
static double relative_motion(int a, const double *xs, const double *xe, int b, const double *ys, const double *ye)
{
    double square = 0;
    for (int i = 0; i < 3 * a; i += 3)
        for (int j = 0; j < 3 * b; j += 3) {
            double m[3];
            for (int k = 0; k < 3; k++) m[k] = (xe[i + k] - xs[i + k]) - (ye[j + k] - ys[j + k]);
            square = higher(square, dot(m, m));
        }
    return sqrt(square);
}

/* Lower bound of the distance of two simplices that move straight from `start` to `end`, with the same clock. */
static double least_distance(int a, const double *xs, const double *xe, int b, const double *ys, const double *ye,
                             double reach)
{
    double relative = relative_motion(a, xs, xe, b, ys, ye), first = distance(a, xs, b, ys);
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

/* Grid of cubes over `low` to `high`. */
typedef struct {
    double low[3], scale;
    int count[3];
} Grid;

static void cells_of(const Grid *grid, const Box *box, int *first, int *last)
{
    for (int k = 0; k < 3; k++) {
        double a = (box->low[k] - grid->low[k]) * grid->scale, b = (box->high[k] - grid->low[k]) * grid->scale;
        double most = grid->count[k] - 1;
        /* positions that are no numbers are in the first cell */
        first[k] = (int)(a > 0 ? a < most ? a : most : 0);
        last[k] = (int)(b > 0 ? b < most ? b : most : 0);
    }
}

static Grid grid_of(int64_t n, const Box *boxes)
{
    Grid grid;
    double high[3], size = 0;
    for (int k = 0; k < 3; k++) grid.low[k] = INFINITY, high[k] = -INFINITY;
    for (int64_t i = 0; i < n; i++) {
        double largest = 0;
        for (int k = 0; k < 3; k++) {
            grid.low[k] = lower(grid.low[k], boxes[i].low[k]), high[k] = higher(high[k], boxes[i].high[k]);
            largest = higher(largest, boxes[i].high[k] - boxes[i].low[k]);
        }
        size += largest / n;
    }
    for (double cells = INFINITY; cells > MAX_CELLS_PER_SIMPLEX * (double)n + 64; size *= 1.25) {
        cells = 1, grid.scale = size > 0 ? 1 / size : 0;
        for (int k = 0; k < 3; k++) cells *= floor((high[k] - grid.low[k]) * grid.scale) + 1;
    }
    for (int k = 0; k < 3; k++) {
        double cells = (high[k] - grid.low[k]) * grid.scale + 1;
        grid.count[k] = cells >= 1 && cells < 1e9 ? (int)cells : 1;
    }
    return grid;
}

/* Whether an edge passes through a triangle (3, 3): its ends are on both sides of the plane, and it turns in the same
   sense about all three sides. An end in the plane, but for round-off, has to lie in the triangle: the direction of the
   edge says nothing there. An edge in the plane does not pass through the triangle. */
static int pierces(const double *start, const double *end, const double *corners)
{
    double a[3], b[3], normal[3], arm[3], direction[3], heights[2];
    subtract(a, corners + 3, corners), subtract(b, corners + 6, corners), subtract(direction, end, start);
    for (int k = 0; k < 3; k++) normal[k] = a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3];
    subtract(arm, start, corners), heights[0] = dot(arm, normal);
    subtract(arm, end, corners), heights[1] = dot(arm, normal);
    double size = ROUND_OFF * sqrt(dot(normal, normal) * (dot(a, a) + dot(b, b) + dot(direction, direction)));
    for (int k = 0; k < 2; k++) heights[k] = fabs(heights[k]) > size ? heights[k] : 0;
    if (heights[0] * heights[1] > 0 || heights[0] == heights[1]) return 0;
    const double *point = heights[1] == 0 ? end : start;
    if (heights[0] * heights[1] == 0)
        for (int k = 0; k < 3; k++) direction[k] = normal[k];
    int positive = 1, negative = 1;
    for (int c = 0; c < 3; c++) {
        subtract(a, corners + 3 * c, point), subtract(b, corners + 3 * ((c + 1) % 3), point);
        double sense = 0;
        for (int k = 0; k < 3; k++)
            sense += direction[k] * (a[(k + 1) % 3] * b[(k + 2) % 3] - a[(k + 2) % 3] * b[(k + 1) % 3]);
        positive &= sense >= 0, negative &= sense <= 0;
    }
    return positive || negative;
}

/* Whether an edge of a triangle at x passes through one at y, with none of its vertices. */
static int edge_pierces(const int32_t *first, const double *x, const int32_t *second, const double *y)
{
    for (int c = 0; c < 3; c++) {
        int32_t edge[2] = {first[c], first[(c + 1) % 3]};
        if (!share_vertex(2, edge, 3, second) && pierces(x + 3 * c, x + 3 * ((c + 1) % 3), y)) return 1;
    }
    return 0;
}

/* Whether the line through a segment (2, 3) in the plane separates the ends of another. */
static int separates(const double *x, const double *y)
{
    double side[2], dx = x[3] - x[0], dy = x[4] - x[1];
    for (int c = 0; c < 2; c++) side[c] = dx * (y[3 * c + 1] - x[1]) - dy * (y[3 * c] - x[0]);
    return side[0] * side[1] <= 0;
}

/* Whether two segments in the plane, or two triangles, intersect elsewhere than at a common vertex. */
static int intersect(int corners, const int32_t *first, const double *x, const int32_t *second, const double *y)
{
    if (corners == 3) return edge_pierces(first, x, second, y) || edge_pierces(second, y, first, x);
    return !share_vertex(2, first, 2, second) && separates(x, y) && separates(y, x);
}

enum { OWN = 1, MOVED = 2 };

/* Which flags vertices of a simplex have. */
static int marks_of(int n, const int32_t *vertices, const uint8_t *own, const uint8_t *moved)
{
    int marks = 0;
    for (int c = 0; c < n; c++) marks |= (own[vertices[c]] ? OWN : 0) | (moved[vertices[c]] ? MOVED : 0);
    return marks;
}

/* Simplices in the cells of a grid, in each cell those with a vertex that has moved first: cell c has the numbers
   inside[begin[2 c]] and on, the others from inside[begin[2 c + 1]] on. */
typedef struct {
    Box *boxes, of_moved;
    uint8_t *marks;
    Grid grid;
    int64_t *begin;
    int32_t *inside;
} Bins;

static void free_bins(Bins *bins) { free(bins->boxes), free(bins->marks), free(bins->begin), free(bins->inside); }

/* Fill the bins with n simplices of b vertices that move from `start` to `end`; 0 without memory. */
static int fill_bins(Bins *bins, int64_t n, int b, const int32_t *simplices, const double *start, const double *end,
                     const uint8_t *own, const uint8_t *moved, double reach)
{
    double ys[9], ye[9];
    Box *boxes = bins->boxes = malloc(n * sizeof(Box)), *all = &bins->of_moved;
    bins->marks = malloc(n), bins->begin = NULL, bins->inside = NULL;
    if (!boxes || !bins->marks) return 0;
    for (int k = 0; k < 3; k++) all->low[k] = INFINITY, all->high[k] = -INFINITY;
    for (int64_t j = 0; j < n; j++) {
        gather(start, simplices + b * j, b, 0, ys);
        gather(end, simplices + b * j, b, 0, ye);
        boxes[j] = box_of(b, ys, ye, reach);
        bins->marks[j] = (uint8_t)marks_of(b, simplices + b * j, own, moved);
        for (int k = 0; bins->marks[j] & MOVED && k < 3; k++)
            all->low[k] = lower(all->low[k], boxes[j].low[k]), all->high[k] = higher(all->high[k], boxes[j].high[k]);
    }
    bins->grid = grid_of(n, boxes);
    const int *count = bins->grid.count;
    const int64_t slots = 2 * (int64_t)count[0] * count[1] * count[2];
    int64_t *begin = bins->begin = calloc(slots + 2, sizeof(int64_t));
    if (!begin) return 0;
    /* counts, then sums, then numbers, as in a counting sort */
    for (int round = 0; round < 2; round++) {
        for (int64_t j = 0; j < n; j++) {
            int low[3], high[3];
            cells_of(&bins->grid, &boxes[j], low, high);
            for (int u = low[0]; u <= high[0]; u++)
                for (int v = low[1]; v <= high[1]; v++)
                    for (int w = low[2]; w <= high[2]; w++) {
                        int64_t slot = 2 * (((int64_t)u * count[1] + v) * count[2] + w) + !(bins->marks[j] & MOVED);
                        if (round) bins->inside[begin[slot + 1]++] = (int32_t)j;
                        else begin[slot + 2]++;
                    }
        }
        if (round) break;
        for (int64_t slot = 0; slot < slots; slot++) begin[slot + 2] += begin[slot + 1];
        bins->inside = malloc((begin[slots + 1] + 1) * sizeof(int32_t));
        if (!bins->inside) return 0;
    }
    return 1;
}

/* Pairs of a simplex of `first` (m, a) and one of `second` (n, b) that may come as near as `reach` while the vertices
   (count, 3) move from `start` to `end`, without common vertices; or, if `crossing`, that intersect at the start. Of
   `first`, the centroids count if `centroids`. With `same` both are one set, and each pair is found once. Pairs have
   different patches, unless those are negative, a vertex that is marked as `own`, and one that is marked as `moved`. Up
   to `capacity` pairs (k, 2) are written; returns k, or -1 without memory. */
int64_t find_pairs(const double *start, const double *end, int64_t m, int a, const int32_t *first, int64_t n, int b,
                   const int32_t *second, int centroids, int same, int crossing, const int32_t *patches,
                   const uint8_t *own, const uint8_t *moved, double reach, int64_t capacity, int32_t *pairs)
{
    if (m == 0 || n == 0) return 0;
    double xs[9], xe[9], ys[9], ye[9];
    int64_t found = 0;
    Bins bins;
    if (!fill_bins(&bins, n, b, second, start, end, own, moved, reach)) {
        free_bins(&bins);
        return -1;
    }
    const Grid grid = bins.grid;
    for (int64_t i = 0; i < m; i++) {
        const int32_t *x = first + a * i;
        int points = gather(start, x, a, centroids, xs), low[3], high[3], marks = marks_of(a, x, own, moved);
        gather(end, x, a, centroids, xe);
        Box box = box_of(points, xs, xe, 0);
        if (!(marks & MOVED) && !boxes_meet(&box, &bins.of_moved)) continue;
        cells_of(&grid, &box, low, high);
        for (int u = low[0]; u <= high[0]; u++)
            for (int v = low[1]; v <= high[1]; v++)
                for (int w = low[2]; w <= high[2]; w++) {
                    int64_t slot = 2 * (((int64_t)u * grid.count[1] + v) * grid.count[2] + w);
                    int64_t stop = bins.begin[slot + (marks & MOVED ? 2 : 1)];
                    for (int64_t k = bins.begin[slot]; k < stop; k++) {
                        int64_t j = bins.inside[k];
                        const int32_t *y = second + b * j;
                        const Box *other = &bins.boxes[j];
                        if (same && j <= i) continue;
                        if (!boxes_meet(&box, other) || (marks | bins.marks[j]) != (OWN | MOVED)) continue;
                        if (patches[x[0]] == patches[y[0]] && patches[x[0]] >= 0) continue;
                        if (!crossing && share_vertex(a, x, b, y)) continue;
                        /* each pair in the first of the cells that its boxes share */
                        int from[3], to[3];
                        cells_of(&grid, other, from, to);
                        if (u != (low[0] > from[0] ? low[0] : from[0]) || v != (low[1] > from[1] ? low[1] : from[1])
                            || w != (low[2] > from[2] ? low[2] : from[2]))
                            continue;
                        gather(start, y, b, 0, ys);
                        gather(end, y, b, 0, ye);
                        if (crossing ? !intersect(b, x, xs, y, ys)
                                     : least_distance(points, xs, xe, b, ys, ye, reach) > reach)
                            continue;
                        if (found < capacity) pairs[2 * found] = (int32_t)i, pairs[2 * found + 1] = (int32_t)j;
                        found++;
                    }
                }
    }
    free_bins(&bins);
    return found;
}

/* Distances (count,) of pairs (count, 2) of a simplex of `first` (m, a), or its centroid, and one of `second` (n, b). */
void pair_distances(const double *x, int a, const int32_t *first, int b, const int32_t *second, int centroids,
                    int64_t count, const int64_t *pairs, double *distances)
{
    double xs[9], ys[9];
    for (int64_t i = 0; i < count; i++) {
        int points = gather(x, first + a * pairs[2 * i], a, centroids, xs);
        gather(x, second + b * pairs[2 * i + 1], b, 0, ys);
        distances[i] = distance(points, xs, b, ys);
    }
}

/* Fraction in [0, 1] of the straight motion of two simplices that leaves the part `least` of their distance.

   Conservative advancement: convex sets whose distance is d lie on two sides of a slab of that thickness. They stay
   apart until a vertex of one and a vertex of the other have closed the slab between them along its normal, and until
   the fastest relative motion has closed d: where two edges are almost parallel, the normal is inaccurate. */
static double free_fraction(int a, const double *xs, const double *xe, int b, const double *ys, const double *ye,
                            double least, int rounds)
{
    double x[9], y[9], r[3], t = 0, stop = 0;
    const double fastest = relative_motion(a, xs, xe, b, ys, ye);
    for (int round = 0; round < rounds; round++) {
        for (int k = 0; k < 3 * a; k++) x[k] = xs[k] + t * (xe[k] - xs[k]);
        for (int k = 0; k < 3 * b; k++) y[k] = ys[k] + t * (ye[k] - ys[k]);
        double d = shortest_vector(a, x, b, y, r), advance = INFINITY;
        if (!(d > 0)) return t;
        if (round == 0) stop = least * d;
        for (int i = 0; i < 3 * a; i += 3)
            for (int j = 0; j < 3 * b; j += 3) {
                double gap = 0, closing = 0;
                for (int k = 0; k < 3; k++) {
                    gap += (x[i + k] - y[j + k]) * r[k] / d;
                    closing -= ((xe[i + k] - xs[i + k]) - (ye[j + k] - ys[j + k])) * r[k] / d;
                }
                if (closing > 0) advance = fmin(advance, fmax(gap - stop, 0) / closing);
            }
        advance = fmax(advance, fastest > 0 ? (d - stop) / fastest : INFINITY);
        if (t + advance >= 1) return 1;
        t += advance;
        if (advance <= 1e-3 * t) return t;
    }
    return t;
}

/* Fractions (count,) of the motions of pairs (count, 2) of simplices from `start` to `end` that leave `least` of their
   distances. */
void free_fractions(const double *start, const double *end, int a, const int32_t *first, int b, const int32_t *second,
                    int64_t count, const int64_t *pairs, double least, int rounds, double *fractions)
{
    double xs[9], xe[9], ys[9], ye[9];
    for (int64_t i = 0; i < count; i++) {
        const int32_t *x = first + a * pairs[2 * i], *y = second + b * pairs[2 * i + 1];
        gather(start, x, a, 0, xs), gather(end, x, a, 0, xe);
        gather(start, y, b, 0, ys), gather(end, y, b, 0, ye);
        fractions[i] = free_fraction(a, xs, xe, b, ys, ye, least, rounds);
    }
}
