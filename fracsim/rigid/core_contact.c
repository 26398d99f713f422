/* Nodes of fragments in the cores of other fragments (rigid.core_contact). */

#include <math.h>
#include <stdint.h>
#include <string.h>

typedef struct {
    double side;
    const int64_t *boxes, *first, *of; /* (7,) of each fragment: its lowest box, how many, where they begin; their faces */
    const double *corners;             /* (9,) of each face */
    const int64_t *crack;              /* whether it is beside a crack */
} Grid;

typedef struct { double square, at[3], high; int64_t face; } Nearest; /* at[3]: where; high: above that face's plane */

typedef struct { double turn[9], shift[3]; } Map;

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

static void minus(const double *a, const double *b, double *c) { for (int i = 0; i < 3; i++) c[i] = a[i] - b[i]; }

/* The shares v, w of the corners b and c in the point of a triangle that is nearest to p (C. Ericson, Real-time collision
   detection, 2005, sec. 5.1.5). */
static void nearest_in(const double *p, const double *a, const double *b, const double *c, double *v, double *w)
{
    double ab[3], ac[3], ap[3], bp[3], cp[3];
    minus(b, a, ab), minus(c, a, ac), minus(p, a, ap), minus(p, b, bp), minus(p, c, cp);
    double d1 = dot(ab, ap), d2 = dot(ac, ap), d3 = dot(ab, bp), d4 = dot(ac, bp), d5 = dot(ab, cp), d6 = dot(ac, cp);
    double va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
    if (d1 <= 0 && d2 <= 0) *v = *w = 0;
    else if (d3 >= 0 && d4 <= d3) *v = 1, *w = 0;
    else if (vc <= 0 && d1 >= 0 && d3 <= 0) *v = d1 / (d1 - d3), *w = 0;
    else if (d6 >= 0 && d5 <= d6) *v = 0, *w = 1;
    else if (vb <= 0 && d2 >= 0 && d6 <= 0) *v = 0, *w = d2 / (d2 - d6);
    else if (va <= 0 && d4 >= d3 && d5 >= d6) *w = (d4 - d3) / (d4 - d3 + d5 - d6), *v = 1 - *w;
    else *v = vb / (va + vb + vc), *w = vc / (va + vb + vc);
}

/* Whether a face is nearer to p than what was found so far, of all or of those beside cracks. Of faces as near, which
   meet at a side or a corner, the one whose plane is farthest from p tells on which side of the fragment that is. */
static void look(const Grid *grid, int64_t face, const double *p, Nearest *any, Nearest *crack)
{
    const double *a = grid->corners + 9 * face, *b = a + 3, *c = a + 6, close = 1e-12 * grid->side * grid->side;
    double v, w, off[3], ab[3], ac[3];
    Nearest this = {.face = face};
    nearest_in(p, a, b, c, &v, &w);
    for (int i = 0; i < 3; i++) this.at[i] = a[i] + v * (b[i] - a[i]) + w * (c[i] - a[i]);
    minus(p, this.at, off);
    this.square = dot(off, off);
    int first = this.square < crack->square || (this.square == crack->square && face < crack->face);
    if (grid->crack[face] && first) *crack = this; /* whatever comes first, the same */
    if (this.square > any->square + close) return;
    minus(b, a, ab), minus(c, a, ac);
    double n[3] = {ab[1] * ac[2] - ab[2] * ac[1], ab[2] * ac[0] - ab[0] * ac[2], ab[0] * ac[1] - ab[1] * ac[0]};
    this.high = dot(n, off) / sqrt(dot(n, n));
    if (this.square < any->square - close || fabs(this.high) > fabs(any->high)) *any = this;
}

/* Faces of a fragment closest to p, closer than `reach`, of all and of those beside cracks, of which `known` is one that
   is not far, or -1. */
static void nearest(const Grid *grid, int64_t fragment, const double *p, double reach, int64_t known, Nearest *any,
                    Nearest *crack)
{
    *any = *crack = (Nearest){reach * reach, {0, 0, 0}, 0, known};
    if (known >= 0) look(grid, known, p, any, crack);
    reach = sqrt(crack->square) + 1e-6 * grid->side;
    const int64_t *mine = grid->boxes + 7 * fragment, *many = mine + 3;
    int64_t low[3], high[3];
    for (int i = 0; i < 3; i++) {
        low[i] = (int64_t)floor((p[i] - reach) / grid->side) - mine[i];
        high[i] = (int64_t)floor((p[i] + reach) / grid->side) - mine[i];
        if (low[i] < 0) low[i] = 0;
        if (high[i] >= many[i]) high[i] = many[i] - 1;
    }
    for (int64_t i = low[0]; i <= high[0]; i++)
        for (int64_t j = low[1]; j <= high[1]; j++)
            for (int64_t k = low[2]; k <= high[2]; k++) {
                const int64_t *box = grid->first + mine[6] + (i * many[1] + j) * many[2] + k;
                for (int64_t face = box[0]; face < box[1]; face++) look(grid, grid->of[face], p, any, crack);
            }
}

/* Lower bound of the distance of p from the boxes of a fragment. */
static double outside(const Grid *grid, int64_t fragment, const double *p)
{
    const int64_t *mine = grid->boxes + 7 * fragment;
    double square = 0;
    for (int i = 0; i < 3; i++) {
        double below = mine[i] * grid->side - p[i], above = p[i] - (mine[i] + mine[3 + i]) * grid->side;
        double off = fmax(fmax(below, above), 0);
        square += off * off;
    }
    return sqrt(square);
}

/* Whether p is inside the closed surface of faces `first` to `end`: they are seen from there under an angle of 4 pi (A. Van
   Oosterom, J. Strackee 1983). What is nearest, a corner, need not tell. */
static int enclosed(const double *corners, int64_t first, int64_t end, const double *p)
{
    double angle = 0;
    for (const double *face = corners + 9 * first; face < corners + 9 * end; face += 9) {
        double a[3], b[3], c[3];
        minus(face, p, a), minus(face + 3, p, b), minus(face + 6, p, c);
        double la = sqrt(dot(a, a)), lb = sqrt(dot(b, b)), lc = sqrt(dot(c, c));
        double n[3] = {b[1] * c[2] - b[2] * c[1], b[2] * c[0] - b[0] * c[2], b[0] * c[1] - b[1] * c[0]};
        angle += atan2(dot(a, n), la * lb * lc + dot(a, b) * lc + dot(b, c) * la + dot(c, a) * lb);
    }
    return angle > acos(-1.0); /* half of each was summed */
}

/* Where the mesh has a point of the second body, as the first one sees it: `turn` (n, 3, 3) from the axes of the mesh
   to those of space, `place` (n, 3) and `centre` (n, 3) of bodies in space and in the mesh. */
static Map seen(int64_t a, int64_t b, const double *turn, const double *place, const double *centre)
{
    Map map;
    double between[3];
    minus(place + 3 * b, place + 3 * a, between);
    for (int i = 0; i < 3; i++) {
        map.shift[i] = centre[3 * a + i];
        for (int k = 0; k < 3; k++) map.shift[i] += turn[9 * a + 3 * k + i] * between[k];
        for (int j = 0; j < 3; j++) {
            double *each = map.turn + 3 * i + j;
            *each = 0;
            for (int k = 0; k < 3; k++) *each += turn[9 * a + 3 * k + i] * turn[9 * b + 3 * k + j];
            map.shift[i] -= *each * centre[3 * b + j];
        }
    }
    return map;
}

/* Put a node q among the deepest so far, of `most` of a pair; how many there are then. */
static int64_t put(int64_t count, int64_t most, int64_t q, double depth, const double *normal, int64_t *node,
                   double *deep, double *normals)
{
    int64_t place = count < most ? count : most - 1;
    if (count == most && deep[place] >= depth) return count;
    for (; place > 0 && deep[place - 1] < depth; place--) {
        node[place] = node[place - 1], deep[place] = deep[place - 1];
        memcpy(normals + 3 * place, normals + 3 * place - 3, 3 * sizeof(double));
    }
    node[place] = q, deep[place] = depth;
    memcpy(normals + 3 * place, normal, 3 * sizeof(double));
    return count < most ? count + 1 : count;
}

/* Of chosen (k,) pairs (first, second) of bodies: the `most` nodes of the second that are deepest in the core of the
   first, by more than `least`, how deep, and normals out of it, as the mesh has it. `begin`, `faces` (n + 1,): where
   nodes and faces of each body begin. `last` (4,) of each node of each pair, from `where` (pairs,) on: where it was when it was looked at
   last, and how far from there it may be deeper than that; `near`: the face that was the nearest, or -1. `reach`: m,
   what is farther from faces is not looked for. `found` (k,): how many. */
void find_deepest(int64_t k, const int64_t *chosen, const int64_t *pairs, const double *turn, const double *place,
            const double *centre, const int64_t *begin, const double *points, const int64_t *boxes,
            const int64_t *first, const int64_t *of, const double *corners, const int64_t *at_crack, const int64_t *faces,
            double side, double least, double reach, int64_t most, double *last, int64_t *near, const int64_t *where,
            int64_t *found, int64_t *node, double *depth, double *normal)
{
    Grid grid = {side, boxes, first, of, corners, at_crack};
    for (int64_t row = 0; row < k; row++) {
        int64_t pair = chosen[row], a = pairs[2 * pair], b = pairs[2 * pair + 1], e = where[pair];
        Map map = seen(a, b, turn, place, centre);
        for (int64_t q = begin[b]; q < begin[b + 1]; q++, e++) {
            double p[3], way[3], out[3], *then = last + 4 * e;
            for (int i = 0; i < 3; i++) p[i] = dot(map.turn + 3 * i, points + 3 * q) + map.shift[i];
            minus(p, then, way);
            if (dot(way, way) < then[3] * then[3]) continue;
            memcpy(then, p, sizeof p);
            if ((then[3] = outside(&grid, a, p)) > reach) continue;
            Nearest any, crack;
            nearest(&grid, a, p, reach, near[e], &any, &crack);
            double d = sqrt(crack.square);
            int inside = any.high < 0, deep = inside && d > least && d < reach; /* a crack face was found */
            if (deep && !enclosed(corners, faces[a], faces[a + 1], p)) inside = deep = 0;
            near[e] = crack.face;
            then[3] = deep ? 0 : inside ? fmax(least - d, 0) : sqrt(any.square);
            if (!deep) continue;
            for (int i = 0; i < 3; i++) out[i] = (crack.at[i] - p[i]) / d;
            found[row] = put(found[row], most, q, d, out, node + most * row, depth + most * row, normal + 3 * most * row);
        }
    }
}
