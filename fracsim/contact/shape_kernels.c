// Distances to analytic shapes at a pose with their derivatives, closest points of facets, and the energy of facets.
// The plain counterparts are shapes, closest_point and facet_contact. In 2D the third components are zero.

#include <float.h>
#include <math.h>
#include <stdint.h>
#include <string.h>

enum { HALF_SPACE, SWEPT_SPHERE, BOX, CYLINDER };

// As packed by shape_kernels.pack.
typedef struct {
  double kind, sign, growth;  // sign: -1 for the space outside; growth: by which distances are smaller, m
  double centre[3], rotation[9], origin[3];  // pose, and where the shape is in its own frame
  double min_radius;
  double axis[3], across[3];  // unit vectors; that of a half space is its normal
  double half[3], radius, fillet;  // of the core: of a box all three half sizes, of others the first
} Obstacle;

static inline double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Signed distance to the quadrant q <= 0, with its gradient n and Hessian H (k x k) (shape_base.QuadrantDistance).
static double quadrant(int k, const double *q, double *n, double *H) {
  double outside[3], square = 0.0;
  int nearest = 0;
  for (int i = 0; i < k; ++i) {
    outside[i] = fmax(q[i], 0.0);
    square += outside[i] * outside[i];
    if (q[i] > q[nearest]) nearest = i;
  }
  const double length = sqrt(square);
  const int inside = length < DBL_MIN;
  for (int i = 0; i < k; ++i) n[i] = inside ? i == nearest : outside[i] / length;
  if (H)
    for (int i = 0; i < k; ++i)
      for (int j = 0; j < k; ++j) H[k * i + j] = inside ? 0.0 : ((i == j && q[i] >= 0.0) - n[i] * n[j]) / length;
  return inside ? q[nearest] : length;
}

static double swept_sphere(const Obstacle *o, const double *x, double *n, double *H) {
  const double height = dot(x, o->axis), t = fmin(fmax(height, -o->half[0]), o->half[0]);
  double away[3];
  for (int i = 0; i < 3; ++i) away[i] = x[i] - t * o->axis[i];
  const double length = sqrt(dot(away, away));
  const int on_core = length < DBL_MIN, beside = o->half[0] > 0.0 && fabs(height) < o->half[0];
  for (int i = 0; i < 3; ++i) n[i] = on_core ? o->across[i] : away[i] / length;
  if (H)
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        H[3 * i + j] = on_core ? 0.0 : ((i == j) - beside * o->axis[i] * o->axis[j] - n[i] * n[j]) / length;
  return length - o->fillet;
}

static double box(const Obstacle *o, const double *x, double *n, double *H) {
  double q[3], sign[3];
  for (int i = 0; i < 3; ++i) {
    q[i] = fabs(x[i]) - o->half[i];
    sign[i] = x[i] < 0.0 ? -1.0 : 1.0;
  }
  const double value = quadrant(3, q, n, H);
  for (int i = 0; i < 3; ++i) n[i] *= sign[i];
  if (H)
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) H[3 * i + j] *= sign[i] * sign[j];
  return value - o->fillet;
}

static double cylinder(const Obstacle *o, const double *x, double *n, double *H) {
  const double height = dot(x, o->axis);
  double away[3], up[3], gradient[2], hessian[4];
  for (int i = 0; i < 3; ++i) away[i] = x[i] - height * o->axis[i];
  const double rho = sqrt(dot(away, away));
  const int on_axis = rho < DBL_MIN;
  for (int i = 0; i < 3; ++i) {
    away[i] = on_axis ? o->across[i] : away[i] / rho;
    up[i] = height < 0.0 ? -o->axis[i] : o->axis[i];
  }
  const double q[2] = {rho - o->radius, fabs(height) - o->half[0]};
  const double value = quadrant(2, q, gradient, H ? hessian : NULL);
  for (int i = 0; i < 3; ++i) n[i] = gradient[0] * away[i] + gradient[1] * up[i];
  if (H) {
    const double hoop = on_axis ? 0.0 : gradient[0] / rho;
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        H[3 * i + j] = hessian[0] * away[i] * away[j] + hessian[3] * up[i] * up[j] +
                       hessian[1] * (away[i] * up[j] + up[i] * away[j]) +
                       hoop * ((i == j) - away[i] * away[j] - up[i] * up[j]);
  }
  return value - o->fillet;
}

// Distance of a point x (3), m, its gradient n (3), and, unless H is NULL, its Hessian H (3 x 3), 1/m.
static double evaluate(const Obstacle *o, const double *x, double *n, double *H) {
  double y[3], local[3], local_H[9], value;
  const double *R = o->rotation;
  for (int i = 0; i < 3; ++i) {
    y[i] = -o->origin[i];
    for (int j = 0; j < 3; ++j) y[i] += R[3 * j + i] * (x[j] - o->centre[j]);
  }
  double *curvature = H ? local_H : NULL;
  switch ((int)o->kind) {
    case SWEPT_SPHERE: value = swept_sphere(o, y, local, curvature); break;
    case BOX: value = box(o, y, local, curvature); break;
    case CYLINDER: value = cylinder(o, y, local, curvature); break;
    default:
      value = dot(y, o->axis);
      memcpy(local, o->axis, sizeof local);
      memset(local_H, 0, sizeof local_H);
  }
  for (int i = 0; i < 3; ++i) n[i] = o->sign * dot(R + 3 * i, local);
  if (H) {
    double turned[9];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j)
        turned[3 * i + j] = R[3 * i] * local_H[j] + R[3 * i + 1] * local_H[3 + j] + R[3 * i + 2] * local_H[6 + j];
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) H[3 * i + j] = o->sign * dot(turned + 3 * i, R + 3 * j);
  }
  return o->sign * value - o->growth;
}

// Distances (n), normals (n, d) and curvatures (n, d, d) at points x (n, d); results that are NULL are not wanted.
void evaluate_shape(int64_t n, int64_t d, const double *obstacle, const double *x, double *distance, double *normal,
                    double *curvature) {
  const Obstacle *o = (const Obstacle *)obstacle;
  for (int64_t k = 0; k < n; ++k) {
    double point[3] = {0.0}, gradient[3], H[9];
    for (int i = 0; i < d; ++i) point[i] = x[d * k + i];
    const double value = evaluate(o, point, gradient, curvature ? H : NULL);
    if (distance) distance[k] = value;
    for (int i = 0; i < d; ++i) {
      if (normal) normal[d * k + i] = gradient[i];
      if (curvature)
        for (int j = 0; j < d; ++j) curvature[d * (d * k + i) + j] = H[3 * i + j];
    }
  }
}

// --- closest points of facets ---

typedef struct {
  int c;  // corners
  double x[3][3], smoothing;
} Facet;

static Facet load_facet(int64_t c, int64_t d, const double *x, double smoothing) {
  Facet facet = {.c = (int)c, .smoothing = smoothing};
  for (int a = 0; a < c; ++a)
    for (int i = 0; i < d; ++i) facet.x[a][i] = x[d * a + i];
  return facet;
}

static void position(const Facet *f, const double *l, double *y) {
  for (int i = 0; i < 3; ++i) {
    y[i] = 0.0;
    for (int a = 0; a < f->c; ++a) y[i] += l[a] * f->x[a][i];
  }
}

static double between(const Facet *f, const double *a, const double *b) {
  double sum = 0.0;
  for (int i = 0; i < f->c; ++i) sum += a[i] * b[i];
  return sum;
}

// Minimiser m of slope . (m - l) + (m - l) . Q (m - l) / 2 over the simplex (closest_point.minimise_on_simplex).
static void minimise_on_simplex(int c, double Q[3][3], const double *slope, const double *l, double *m) {
  double b[3], linear[3], quadratic[3], best = INFINITY;
  for (int a = 0; a < c; ++a) {
    b[a] = slope[a];
    for (int e = 0; e < c; ++e) b[a] -= Q[a][e] * l[e];
  }
  for (int a = 0; a < (c == 3 ? 3 : 1); ++a) {
    const int e = (a + 1) % c;
    linear[a] = Q[a][e] - Q[a][a] + b[e] - b[a];
    quadratic[a] = Q[a][a] + Q[e][e] - 2.0 * Q[a][e];
    const double t = quadratic[a] > 0.0 ? fmin(fmax(-linear[a] / quadratic[a], 0.0), 1.0) : 0.0;
    const double value = Q[a][a] / 2.0 + b[a] + t * (linear[a] + t * quadratic[a] / 2.0);
    if (value < best) {
      best = value;
      for (int i = 0; i < c; ++i) m[i] = i == a ? 1.0 - t : i == e ? t : 0.0;
    }
  }
  if (c == 2) return;
  const double mixed = Q[0][0] - Q[0][1] - Q[2][0] + Q[1][2], back = Q[2][0] - Q[0][0] + b[2] - b[0];
  const double det = quadratic[0] * quadratic[2] - mixed * mixed;
  const double m1 = (mixed * back - quadratic[2] * linear[0]) / det;
  const double m2 = (mixed * linear[0] - quadratic[0] * back) / det;
  if (1.0 - m1 - m2 > 0.0 && m1 > 0.0 && m2 > 0.0) m[0] = 1.0 - m1 - m2, m[1] = m1, m[2] = m2;
}

// Derivative of L by l up to parts common to all corners, made a rise from l towards each corner in `rise`.
static void slope_at(const Obstacle *o, const Facet *f, const double *l, double *slope, double *rise) {
  double y[3], n[3], arm[3];
  position(f, l, y);
  evaluate(o, y, n, NULL);
  for (int a = 0; a < f->c; ++a) {
    for (int i = 0; i < 3; ++i) arm[i] = f->x[a][i] - f->x[0][i];
    slope[a] = dot(arm, n) + f->smoothing * (l[a] - 1.0 / f->c);
  }
  const double mean = between(f, slope, l);
  for (int a = 0; a < f->c; ++a) rise[a] = slope[a] - mean;
}

// Q_ab = arm_a . H arm_b + smoothing, arms from y
static void second_derivative(const Facet *f, const double *y, const double *H, double smoothing, double Q[3][3]) {
  for (int a = 0; a < f->c; ++a) {
    double H_arm[3], arm[3];
    for (int i = 0; i < 3; ++i) arm[i] = f->x[a][i] - y[i];
    for (int i = 0; i < 3; ++i) H_arm[i] = dot(H + 3 * i, arm);
    for (int e = 0; e < f->c; ++e) {
      for (int i = 0; i < 3; ++i) arm[i] = f->x[e][i] - y[i];
      Q[a][e] = dot(arm, H_arm) + (a == e) * smoothing;
    }
  }
}

static void initial_barycentric(const Obstacle *o, const Facet *f, double flat_distance, double *l) {
  static const double identity[9] = {1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0};
  double even[3], y[3], n[3], slope[3], Q[3][3], square = 0.0;
  for (int a = 0; a < f->c; ++a) even[a] = 1.0 / f->c;
  position(f, even, y);
  const double distance = evaluate(o, y, n, NULL);
  for (int a = 0; a < f->c; ++a) {
    double arm[3];
    for (int i = 0; i < 3; ++i) arm[i] = f->x[a][i] - y[i];
    square = fmax(square, dot(arm, arm));
    slope[a] = dot(arm, n);
  }
  const double radius = fmin(distance + o->min_radius, flat_distance * sqrt(square));
  for (int a = 0; a < f->c; ++a) slope[a] *= radius;
  second_derivative(f, y, identity, f->smoothing * (fabs(radius) + f->smoothing), Q);
  minimise_on_simplex(f->c, Q, slope, even, l);
}

// Tuned numbers, as packed from closest_point.SEARCH.
typedef struct {
  double max_iterations, max_trials, slope_reduction, flat_distance, min_change, round_off;
} Search;

// Fraction of a step after which the convex L is no longer steep along it; slope and rise are those there at the end.
static double line_search(const Obstacle *o, const Facet *f, const Search *search, const double *l, const double *step,
                          double *slope, double *rise) {
  double trial[3], fraction = 1.0, low = 0.0, high = 1.0, rate_low = between(f, rise, step);
  const double steep = -search->slope_reduction * rate_low;
  if (!(rate_low < 0.0)) return 0.0;  // on a middle line of the obstacle, where its distance is not smooth
  for (int a = 0; a < f->c; ++a) trial[a] = l[a] + step[a];
  slope_at(o, f, trial, slope, rise);
  double rate_high = between(f, rise, step);
  if (!(rate_high > steep)) return fraction;
  for (int k = 0; k < search->max_trials; ++k) {
    fraction = k % 3 == 2 ? (low + high) / 2.0 : low - rate_low * (high - low) / (rate_high - rate_low);
    for (int a = 0; a < f->c; ++a) trial[a] = l[a] + fraction * step[a];
    slope_at(o, f, trial, slope, rise);
    const double rate = between(f, rise, step);
    if (rate < 0.0) low = fraction, rate_low = rate;
    else high = fraction, rate_high = rate;
    if (!(fabs(rate) > steep) || !(high - low > search->min_change)) break;
  }
  return fraction;
}

static void find_closest_point(const Obstacle *o, const Facet *f, const Search *search, double tolerance, double *l) {
  double slope[3], rise[3], y[3], n[3], H[9], Q[3][3], step[3], largest = 0.0;
  for (int a = 0; a < f->c; ++a)
    for (int i = 0; i < 3; ++i) largest = fmax(largest, fabs(f->x[a][i]));
  const double max_residual = fmax(tolerance * f->smoothing, search->round_off * largest);
  if (isnan(l[0])) initial_barycentric(o, f, search->flat_distance, l);
  slope_at(o, f, l, slope, rise);
  for (int k = 0; k < search->max_iterations; ++k) {
    double residual = -INFINITY, change = 0.0;
    for (int a = 0; a < f->c; ++a) residual = fmax(residual, l[a] > 0.0 ? fabs(rise[a]) : -rise[a]);
    if (!(residual > max_residual)) return;
    position(f, l, y);
    evaluate(o, y, n, H);
    second_derivative(f, y, H, f->smoothing, Q);
    minimise_on_simplex(f->c, Q, slope, l, step);
    for (int a = 0; a < f->c; ++a) {
      step[a] -= l[a];
      change = fmax(change, fabs(step[a]));
    }
    const double fraction = line_search(o, f, search, l, step, slope, rise);
    for (int a = 0; a < f->c; ++a) l[a] += fraction * step[a];
    const double mean = between(f, slope, l);
    for (int a = 0; a < f->c; ++a) rise[a] = slope[a] - mean;
    if (!(fraction * change > search->min_change)) return;
  }
}

// Barycentric coordinates l (k, c) of the closest points of facets x (k, c, d), searched from l; from a guess where nan.
void find_closest_points(int64_t k, int64_t c, int64_t d, const double *obstacle, const double *x, double smoothing,
                         double tolerance, const double *search, double *l) {
  for (int64_t facet = 0; facet < k; ++facet) {
    const Facet f = load_facet(c, d, x + c * d * facet, smoothing);
    find_closest_point((const Obstacle *)obstacle, &f, (const Search *)search, tolerance, l + c * facet);
  }
}

// --- energy of facets ---

// Barrier of a gap, or its mean over a step with the weight `early` of the gap after a third of it (laws).
typedef struct {
  double stiffness, width, early, closed_value;
} Law;

typedef struct {
  double energy, slope, curvature;
} Potential;

static Potential barrier(const Law *law, double gap) {
  if (!(gap > 0.0)) return (Potential){INFINITY, -law->closed_value, law->closed_value};
  if (gap >= law->width) return (Potential){0.0, 0.0, 0.0};
  const double s = gap / law->width, t = s - 1.0, logarithm = log(s), k = law->stiffness;
  return (Potential){-k * law->width * t * t * logarithm, -k * t * (2.0 * logarithm + t / s),
                     -k / law->width * (2.0 * log1p(t) + t * (3.0 * s + 1.0) / (s * s))};
}

// `start`: gap at the start of the step; NULL: without a mean.
static Potential averaged(const Law *law, const double *start, double gap) {
  const Potential end = barrier(law, gap);
  if (!start) return end;
  const Potential third = barrier(law, gap > 0.0 ? (2.0 * *start + gap) / 3.0 : gap);
  const double early = law->early, late = 1.0 - law->early;
  return (Potential){3.0 * early * third.energy + late * end.energy, early * third.slope + late * end.slope,
                     early / 3.0 * third.curvature + late * end.curvature};
}

// Inverse S (c x c) of Q over changes of the coordinates above zero that sum to 0.
static void free_inverse(int c, double Q[3][3], const double *l, double S[3][3]) {
  int free[3], count = 0;
  memset(S, 0, 9 * sizeof(double));
  for (int a = 0; a < c; ++a)
    if (l[a] > 0.0) free[count++] = a;
  if (count < 2) return;
  // in changes from the first free corner to the others
  double A[2][2], inverse[2][2];
  for (int i = 0; i < count - 1; ++i)
    for (int j = 0; j < count - 1; ++j)
      A[i][j] = Q[free[i + 1]][free[j + 1]] - Q[free[0]][free[j + 1]] - Q[free[i + 1]][free[0]] + Q[free[0]][free[0]];
  if (count == 2) inverse[0][0] = 1.0 / A[0][0];
  else {
    const double det = A[0][0] * A[1][1] - A[0][1] * A[1][0];
    inverse[0][0] = A[1][1] / det, inverse[1][1] = A[0][0] / det;
    inverse[0][1] = -A[0][1] / det, inverse[1][0] = -A[1][0] / det;
  }
  for (int i = 0; i < count - 1; ++i)
    for (int j = 0; j < count - 1; ++j) {
      const double value = inverse[i][j];
      S[free[i + 1]][free[j + 1]] += value;
      S[free[0]][free[j + 1]] -= value;
      S[free[i + 1]][free[0]] -= value;
      S[free[0]][free[0]] += value;
    }
}

// Second derivative of the gap of the closest point y by the corners, times `slope`, and slope' times the gradient's
// square (closest_point.FacetClosestPoints), into K (3 c x 3 c).
static void add_closest_hessian(const Facet *f, const double *l, const double *y, const double *n, const double *H,
                                double slope, double curvature, double K[9][9]) {
  double Q[3][3], S[3][3], H_arm[3][3], mixed[9][3];
  second_derivative(f, y, H, f->smoothing, Q);
  free_inverse(f->c, Q, l, S);
  for (int e = 0; e < f->c; ++e) {
    double arm[3];
    for (int i = 0; i < 3; ++i) arm[i] = f->x[e][i] - y[i];
    for (int i = 0; i < 3; ++i) H_arm[e][i] = dot(H + 3 * i, arm);
  }
  for (int a = 0; a < f->c; ++a)
    for (int i = 0; i < 3; ++i)
      for (int e = 0; e < f->c; ++e) mixed[3 * a + i][e] = l[a] * H_arm[e][i] + (a == e) * n[i];
  for (int r = 0; r < 3 * f->c; ++r) {
    double mixed_S[3] = {0.0};
    for (int e = 0; e < f->c; ++e)
      for (int g = 0; g < f->c; ++g) mixed_S[g] += mixed[r][e] * S[e][g];
    for (int s = 0; s < 3 * f->c; ++s) {
      const double weight = l[r / 3] * l[s / 3];
      K[r][s] += weight * (curvature * n[r % 3] * n[s % 3] + slope * H[3 * (r % 3) + s % 3]) -
                 slope * between(f, mixed_S, mixed[s]);
    }
  }
}

// Subtract the second derivative of b of the smoothed minimum of the nodal gaps (closest_point.SoftMinGap) from K.
static void subtract_plane_hessian(const Facet *f, const double *l, double n[3][3], double H[3][9], double slope,
                                   double curvature, double K[9][9]) {
  int count = 0;
  for (int a = 0; a < f->c; ++a) count += l[a] > 0.0;
  for (int r = 0; r < 3 * f->c; ++r)
    for (int s = 0; s < 3 * f->c; ++s) {
      const int a = r / 3, e = s / 3;
      double by_gaps = curvature * l[a] * l[e];
      if (l[a] > 0.0 && l[e] > 0.0) by_gaps += slope * (1.0 / count - (a == e)) / f->smoothing;
      K[r][s] -= by_gaps * n[a][r % 3] * n[e][s % 3];
      if (a == e) K[r][s] -= slope * l[a] * H[a][3 * (r % 3) + s % 3];
    }
}

// Energy F = A [b(gap) - b(gap')] of facets x (k, c, d) and its derivatives (facet_contact.FacetForces).
// l (k, c): closest points. law: see above; start (k, c + 2): gaps at the start of the step, of the closest point, the
// smoothed minimum, and the corners; NULL: without a mean over the step. area: (k).
// Results: energy (k) and forces (k, c, d), or, where these are NULL, hessian (k, c d, c d) and second derivatives of b
// at the corners (k, c, d, d).
void evaluate_facets(int64_t k, int64_t c, int64_t d, const double *obstacle, const double *x, const double *l,
                     double smoothing, const double *law, const double *start, const double *area, double *energy,
                     double *forces, double *hessian, double *corner_hessians) {
  static const double identity[3][3] = {{1.0, 0.0, 0.0}, {0.0, 1.0, 0.0}, {0.0, 0.0, 1.0}};
  const Obstacle *o = (const Obstacle *)obstacle;
  const double error = smoothing / 2.0 * (1.0 - 1.0 / c);
  for (int64_t facet = 0; facet < k; ++facet) {
    const Facet f = load_facet(c, d, x + c * d * facet, smoothing);
    const double *lambda = l + c * facet, *before = start ? start + (c + 2) * facet : NULL;
    double y[3], n[3], H[9], corner_n[3][3], corner_H[3][9], gaps[3], even[3], plane[3], Q[3][3], K[9][9] = {{0.0}};
    position(&f, lambda, y);
    double gap = evaluate(o, y, n, hessian ? H : NULL) - error, plane_gap = -error;
    for (int a = 0; a < c; ++a) {
      even[a] = 1.0 / c;
      gaps[a] = evaluate(o, f.x[a], corner_n[a], hessian ? corner_H[a] : NULL);
      for (int e = 0; e < c; ++e) Q[a][e] = smoothing * identity[a][e];
    }
    minimise_on_simplex((int)c, Q, gaps, even, plane);
    for (int a = 0; a < c; ++a) {
      gap += smoothing / 2.0 * (lambda[a] - even[a]) * (lambda[a] - even[a]);
      plane_gap += plane[a] * gaps[a] + smoothing / 2.0 * (plane[a] - even[a]) * (plane[a] - even[a]);
    }
    const Potential b = averaged((const Law *)law, before, gap);
    const Potential flat = averaged((const Law *)law, before ? before + 1 : NULL, plane_gap);
    if (energy) {
      energy[facet] = isfinite(b.energy) ? area[facet] * (b.energy - flat.energy) : INFINITY;
      for (int a = 0; a < c; ++a)
        for (int i = 0; i < d; ++i)
          forces[d * (c * facet + a) + i] =
              -area[facet] * (b.slope * lambda[a] * n[i] - flat.slope * plane[a] * corner_n[a][i]);
      continue;
    }
    add_closest_hessian(&f, lambda, y, n, H, b.slope, b.curvature, K);
    subtract_plane_hessian(&f, plane, corner_n, corner_H, flat.slope, flat.curvature, K);
    for (int r = 0; r < c * d; ++r)
      for (int s = 0; s < c * d; ++s)
        hessian[c * d * (c * d * facet + r) + s] = area[facet] * K[3 * (r / d) + r % d][3 * (s / d) + s % d];
    for (int a = 0; a < c; ++a) {
      const Potential at = averaged((const Law *)law, before ? before + 2 + a : NULL, gaps[a]);
      for (int i = 0; i < d; ++i)
        for (int j = 0; j < d; ++j)
          corner_hessians[d * (d * (c * facet + a) + i) + j] =
              at.curvature * corner_n[a][i] * corner_n[a][j] + at.slope * corner_H[a][3 * i + j];
    }
  }
}
