/* Contact points of two convex polyhedra that touch with parallel faces (rigid.face_contacts).

   Faces of all polyhedra have unit `normals`, and `corners` from first[face] to first[face + 1], which are numbers of
   `vertices`; all in the axes of the polyhedra. */

#include <math.h>
#include <stdint.h>

/* Faces whose normals n satisfy n_1 . n_2 > -PARALLEL are not parallel. */
static const double PARALLEL = 0.9999;

typedef struct { double x[2]; } Point;

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* Twice the area of a triangle. */
static double twice_area(Point a, Point b, Point c)
{
    return (b.x[0] - a.x[0]) * (c.x[1] - a.x[1]) - (b.x[1] - a.x[1]) * (c.x[0] - a.x[0]);
}

/* Face from `begin` to `end` whose normal is closest to the `direction` in the axes of the polyhedron. */
static int64_t closest_face(int64_t begin, int64_t end, const double *normals, const double *direction)
{
    int64_t best = begin;
    double highest = -2;
    for (int64_t face = begin; face < end; face++) {
        double value = dot(normals + 3 * face, direction);
        if (value > highest) highest = value, best = face;
    }
    return best;
}

/* Vector in the axes of a body with `rotation` (3, 3). */
static void into_body(const double *rotation, const double *v, double sign, double *w)
{
    for (int j = 0; j < 3; j++) w[j] = sign * (rotation[j] * v[0] + rotation[3 + j] * v[1] + rotation[6 + j] * v[2]);
}

/* Corners of a face in the plane of the contact, relative to `origin`; and the face's height above the plane,
   h = h[0] + h[1] x + h[2] y. The axes of the contact are (3, 3), the normal first. */
static void place(int64_t count, const int64_t *corners, const double *vertices, const double *normal, const double *position,
                  const double *rotation, const double *axes, const double *origin, Point *placed, double *h)
{
    double n[3], in_space[3], first = 0;
    for (int j = 0; j < 3; j++) in_space[j] = dot(rotation + 3 * j, normal);
    for (int j = 0; j < 3; j++) n[j] = dot(axes + 3 * j, in_space);
    for (int64_t i = 0; i < count; i++) {
        const double *v = vertices + 3 * corners[i];
        double x[3];
        for (int j = 0; j < 3; j++) x[j] = dot(rotation + 3 * j, v) + position[j] - origin[j];
        placed[i].x[0] = dot(axes + 3, x), placed[i].x[1] = dot(axes + 6, x);
        if (!i) first = dot(axes, x);
    }
    h[1] = -n[1] / n[0], h[2] = -n[2] / n[0];
    h[0] = first - h[1] * placed[0].x[0] - h[2] * placed[0].x[1];
}

/* Clip a convex polygon p of m corners by the line from a to b; those on its left remain, or on its right with sign -1.
   The result is in q (I. E. Sutherland, G. W. Hodgman 1974). */
static int64_t clip(int64_t m, const Point *p, Point a, Point b, double sign, Point *q)
{
    int64_t k = 0;
    for (int64_t i = 0; i < m; i++) {
        Point from = p[i], to = p[(i + 1) % m];
        double before = sign * twice_area(a, b, from), after = sign * twice_area(a, b, to);
        if ((before < 0) != (after < 0)) {
            double share = before / (before - after);
            for (int j = 0; j < 2; j++) q[k].x[j] = from.x[j] + share * (to.x[j] - from.x[j]);
            k++;
        }
        if (after >= 0) q[k++] = to;
    }
    return k;
}

/* Leave out corners of a convex polygon, that of the smallest triangle with its neighbours first, until at most `most` are
   left and all triangles are larger than `share` of the area (M. Visvalingam, J. D. Whyatt 1993). */
static int64_t simplify(int64_t m, Point *p, int64_t most, double share)
{
    double total = 0;
    for (int64_t i = 2; i < m; i++) total += fabs(twice_area(p[0], p[i - 1], p[i]));
    while (m > 3) {
        int64_t least = 0;
        double area = INFINITY;
        for (int64_t i = 0; i < m; i++) {
            double value = fabs(twice_area(p[(i + m - 1) % m], p[i], p[(i + 1) % m]));
            if (value < area) area = value, least = i;
        }
        if (m <= most && area > share * total) break;
        for (int64_t i = least; i < m - 1; i++) p[i] = p[i + 1];
        m--;
    }
    return m;
}

/* Contact points of `k` pairs of `geoms` (k, 2) with `axes` (k, 3, 3), the normal first, from the first geom to the second.

   Geoms have the faces from faces[0] to faces[1], `position` and `rotation`. The points of pair i are `count`[i] rows from
   most i on: `point` half-way between the faces, and `gap`. The count is 0 where there are no parallel faces. */
void face_contacts(int64_t k, const int64_t *geoms, const double *axes, const int64_t *faces, const double *normals,
                   const int64_t *first, const int64_t *corners, const double *vertices, const double *position,
                   const double *rotation, int64_t most, double share, int64_t *count, double *point, double *gap)
{
    for (int64_t i = 0; i < k; i++) {
        const double *frame = axes + 9 * i, *turn[2], *at[2];
        int64_t face[2], size[2];
        double normal[2][3];
        count[i] = 0;
        for (int side = 0; side < 2; side++) {
            int64_t geom = geoms[2 * i + side];
            double direction[3];
            turn[side] = rotation + 9 * geom, at[side] = position + 3 * geom;
            into_body(turn[side], frame, side ? -1 : 1, direction);
            face[side] = closest_face(faces[2 * geom], faces[2 * geom + 1], normals, direction);
            size[side] = faces[2 * geom + 1] > faces[2 * geom] ? first[face[side] + 1] - first[face[side]] : 0;
        }
        if (size[0] < 3 || size[1] < 3) continue;
        for (int side = 0; side < 2; side++)
            for (int j = 0; j < 3; j++) normal[side][j] = dot(turn[side] + 3 * j, normals + 3 * face[side]);
        if (dot(normal[0], normal[1]) > -PARALLEL) continue;

        /* a line cuts a convex polygon at two points, and rounding may add one more */
        int64_t room = 3 * (size[0] + size[1]);
        Point clipping[size[0]], buffer[2][room], *p = buffer[0], *q = buffer[1];
        double h[2][3], turning = 0;
        for (int side = 0; side < 2; side++)
            place(size[side], corners + first[face[side]], vertices, normals + 3 * face[side], at[side], turn[side], frame,
                  at[1], side ? p : clipping, h[side]);
        for (int64_t j = 2; j < size[0]; j++) turning += twice_area(clipping[0], clipping[j - 1], clipping[j]);
        int64_t m = size[1];
        for (int64_t j = 0; j < size[0] && m; j++) {
            m = clip(m, p, clipping[j], clipping[(j + 1) % size[0]], turning < 0 ? -1 : 1, q);
            Point *other = p;
            p = q, q = other;
        }
        if (m < 3) continue;
        count[i] = m = simplify(m, p, most, share);
        for (int64_t j = 0; j < m; j++) {
            const double *x = p[j].x;
            double low = h[0][0] + h[0][1] * x[0] + h[0][2] * x[1], high = h[1][0] + h[1][1] * x[0] + h[1][2] * x[1];
            gap[most * i + j] = high - low;
            for (int c = 0; c < 3; c++)
                point[3 * (most * i + j) + c] = at[1][c] + x[0] * frame[3 + c] + x[1] * frame[6 + c] + (low + high) / 2 * frame[c];
        }
    }
}
