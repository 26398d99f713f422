/* Accelerated projected gradients for Coulomb's law at many contacts (rigid.contact_solver).

   Vectors of a contact are along its axes, the normal first. There are n bodies; number n stands for all obstacles, which
   have no inverse mass. A level has six numbers for each body: impulse and moment, or velocity and spin. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

/* Iterations between tests of convergence; iterations after which contacts are selected again for the first time; and
   squarings of a matrix, whose 64th power has a trace that gives its largest eigenvalue within 3 %. */
enum { CHECK_INTERVAL = 10, FIRST_SELECTION = 15, SQUARINGS = 6 };

typedef struct {
    double axes[9], arms[6], free[3], friction; /* rows of axes; from the centres of the bodies; u_0 with r / dt */
} Contact;

typedef struct {
    int64_t count, bodies;
    const Contact *contact;
    const int64_t *pairs;  /* (count, 2) */
    const double *mass;    /* (bodies,) inverse, 1 / kg */
    const double *inertia; /* (bodies, 9) inverse, in the axes of space */
} System;

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* Add an impulse p of a contact to the levels of its bodies. */
static void add_impulse(const Contact *at, const double *p, double *first, double *second)
{
    double f[3], m[3];
    for (int j = 0; j < 3; j++) f[j] = at->axes[j] * p[0] + at->axes[3 + j] * p[1] + at->axes[6 + j] * p[2];
    cross(at->arms, f, m);
    for (int j = 0; j < 3; j++) { first[j] -= f[j]; first[3 + j] -= m[j]; }
    cross(at->arms + 3, f, m);
    for (int j = 0; j < 3; j++) { second[j] += f[j]; second[3 + j] += m[j]; }
}

/* Turn impulses and moments of bodies into velocities and spins. */
static void to_velocities(const System *system, int64_t first, int64_t last, double *level)
{
    for (int64_t n = first; n < last; n++) {
        const double *inverse = system->inertia + 9 * n;
        double *v = level + 6 * n, m[3] = {v[3], v[4], v[5]};
        for (int j = 0; j < 3; j++) { v[j] *= system->mass[n]; v[3 + j] = dot(inverse + 3 * j, m); }
    }
}

/* Changes of velocity and spin (bodies + 1, 6) by impulses (count, 3). */
void velocity_changes(const System *system, const double *p, double *level)
{
    memset(level, 0, 6 * (system->bodies + 1) * sizeof(double));
    for (int64_t k = 0; k < system->count; k++)
        if (p[3 * k] > 0)
            add_impulse(system->contact + k, p + 3 * k, level + 6 * system->pairs[2 * k], level + 6 * system->pairs[2 * k + 1]);
    to_velocities(system, 0, system->bodies, level);
    memset(level + 6 * system->bodies, 0, 6 * sizeof(double));
}

/* Velocity u of the second body relative to the first. */
static void relative_velocity(const Contact *at, const double *first, const double *second, double *u)
{
    double a[3], b[3];
    cross(first + 3, at->arms, a);
    cross(second + 3, at->arms + 3, b);
    for (int j = 0; j < 3; j++) a[j] = second[j] + b[j] - first[j] - a[j];
    for (int j = 0; j < 3; j++) u[j] = dot(at->axes + 3 * j, a) + at->free[j];
}

/* Move p to the closest point of the cone |p_t| <= mu p_n. */
static void project(double *p, double mu)
{
    double along = sqrt(p[1] * p[1] + p[2] * p[2]);
    if (along <= mu * p[0]) return;
    double normal = fmax((p[0] + mu * along) / (1 + mu * mu), 0), share = along > 0 ? mu * normal / along : 0;
    p[0] = normal;
    p[1] *= share;
    p[2] *= share;
}

void project_on_cones(int64_t count, double *p, const double *mu)
{
    for (int64_t k = 0; k < count; k++) project(p + 3 * k, mu[k]);
}

/* Return w = tr J M^-1 J^T of one side of a contact, and add J^T J / w to the (6, 6) matrix of its body. */
static double add_square(const Contact *at, const double *arm, double mass, const double *inverse, double *square)
{
    double rows[3][6], w = 0;
    for (int a = 0; a < 3; a++) {
        double *angular = rows[a] + 3;
        memcpy(rows[a], at->axes + 3 * a, 3 * sizeof(double));
        cross(arm, rows[a], angular);
        w += mass;
        for (int j = 0; j < 3; j++) w += angular[j] * dot(inverse + 3 * j, angular);
    }
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++)
            square[6 * i + j] += (rows[0][i] * rows[0][j] + rows[1][i] * rows[1][j] + rows[2][i] * rows[2][j]) / w;
    return w;
}

/* Upper bound of the largest eigenvalue of M^-1 S, S (6, 6): the trace of (M^-1 S)^m to the power 1 / m, m = 2^SQUARINGS. */
static double bound_eigenvalue(const double *square, double mass, const double *inverse)
{
    double b[6][6], trace = 0, power;
    for (int j = 0; j < 6; j++)
        for (int i = 0; i < 3; i++) {
            const double *row = inverse + 3 * i;
            b[i][j] = mass * square[6 * i + j];
            b[3 + i][j] = row[0] * square[18 + j] + row[1] * square[24 + j] + row[2] * square[30 + j];
        }
    for (int i = 0; i < 6; i++) trace += b[i][i];
    if (trace <= 0) return 0;
    for (int i = 0; i < 36; i++) b[i / 6][i % 6] /= trace;
    for (int round = 0; round < SQUARINGS; round++) {
        double c[6][6] = {{0}};
        for (int i = 0; i < 6; i++)
            for (int l = 0; l < 6; l++)
                for (int j = 0; j < 6; j++) c[i][j] += b[i][l] * b[l][j];
        memcpy(b, c, sizeof b);
    }
    power = 0;
    for (int i = 0; i < 6; i++) power += b[i][i];
    return trace * pow(power, 1.0 / (1 << SQUARINGS));
}

/* A selected contact; these are consecutive in memory. */
typedef struct {
    Contact at;
    double d, p[3], change[3], q[3]; /* D; impulses, their last change, and the extrapolated ones */
    int64_t number, age;             /* number among all contacts; iterations since p reversed */
    int32_t first, second;
} Row;

/* State of the iterations. Sums over contacts are formed in two halves. Another order of summation would change results
   in the last digit, and with them the course of a heap. */
typedef struct {
    const System *system;
    double *p, *change;         /* (count, 3) of all contacts */
    double *d, *w;              /* (count,), (count, 2) */
    int64_t *age, *rows;        /* (count,) of all contacts; numbers of the selected ones */
    double *level[2], *back[2]; /* of each half: (bodies + 1, 6), and (bodies + 1,) by how much p reversed */
    double *square[2], *lambda; /* of each half: (bodies + 1, 36) sums of J^T J / w; (bodies + 1,) bounds of eigenvalues */
    double *beta;               /* Nesterov's factor by age */
    double worst[2], tolerance; /* of each half: square of the largest error, m/s; accepted error, m/s */
    double error;               /* of the velocities, m/s; 0 within the tolerance */
    Row *row;                   /* selected contacts */
    int64_t selected, limit;    /* number of these; largest number of iterations */
    int missed;                 /* whether a contact without impulse closes */
} State;

typedef void (*Work)(State *, int);

static void in_halves(State *state, Work work)
{
    work(state, 0);
    work(state, 1);
}

/* Where a half of `count` items begins. */
static int64_t begins(int64_t count, int half) { return half * count / 2; }

/* Select the contacts that have an impulse, or that close by more than the tolerance allows. */
static void select_contacts(State *state)
{
    const System *system = state->system;
    double *level = state->level[0];
    state->missed = 0, state->selected = 0;
    velocity_changes(system, state->p, level);
    for (int64_t k = 0; k < system->count; k++) {
        const int64_t *n = system->pairs + 2 * k;
        double u[3];
        relative_velocity(system->contact + k, level + 6 * n[0], level + 6 * n[1], u);
        state->missed |= u[0] < -state->tolerance && state->p[3 * k] == 0;
        if (u[0] < state->tolerance || state->p[3 * k] > 0) state->rows[state->selected++] = k;
    }
}

/* Sum J^T J / w by bodies. */
static void sum_squares(State *state, int half)
{
    const System *system = state->system;
    memset(state->square[half], 0, 36 * (system->bodies + 1) * sizeof(double));
    for (int64_t r = begins(state->selected, half); r < begins(state->selected, half + 1); r++)
        for (int side = 0; side < 2; side++) {
            int64_t k = state->rows[r], n = system->pairs[2 * k + side];
            state->w[2 * k + side] = n == system->bodies ? 0 : add_square(system->contact + k,
                system->contact[k].arms + 3 * side, system->mass[n], system->inertia + 9 * n,
                state->square[half] + 36 * n);
        }
}

/* Bound the eigenvalues of bodies. */
static void bound_bodies(State *state, int half)
{
    const System *system = state->system;
    for (int64_t n = begins(system->bodies, half); n < begins(system->bodies, half + 1); n++) {
        double *square = state->square[0] + 36 * n;
        for (int i = 0; i < 36; i++) square[i] += state->square[1][36 * n + i];
        state->lambda[n] = bound_eigenvalue(square, system->mass[n], system->inertia + 9 * n);
    }
}

/* D of selected contacts. */
static void bound_contacts(State *state, int half)
{
    const double *lambda = state->lambda;
    for (int64_t r = begins(state->selected, half); r < begins(state->selected, half + 1); r++) {
        const int64_t k = state->rows[r], *n = state->system->pairs + 2 * k;
        state->d[k] = fmax(lambda[n[0]] * state->w[2 * k] + lambda[n[1]] * state->w[2 * k + 1], 1e-300);
    }
}

/* Copy selected contacts into rows. */
static void load_rows(State *state, int half)
{
    const System *system = state->system;
    for (int64_t r = begins(state->selected, half); r < begins(state->selected, half + 1); r++) {
        int64_t k = state->rows[r];
        Row row = {.at = system->contact[k], .d = state->d[k], .number = k, .age = state->age[k],
                   .first = (int32_t)system->pairs[2 * k], .second = (int32_t)system->pairs[2 * k + 1]};
        memcpy(row.p, state->p + 3 * k, sizeof row.p);
        memcpy(row.change, state->change + 3 * k, sizeof row.change);
        state->row[r] = row;
    }
}

/* Copy the results of rows back. */
static void store_rows(State *state, int half)
{
    for (int64_t r = begins(state->selected, half); r < begins(state->selected, half + 1); r++) {
        const Row *row = state->row + r;
        state->age[row->number] = row->age;
        memcpy(state->p + 3 * row->number, row->p, sizeof row->p);
        memcpy(state->change + 3 * row->number, row->change, sizeof row->change);
    }
}

/* Extrapolate, q = p + beta change, and sum the impulses q by bodies. */
static void extrapolate(State *state, int half)
{
    double *level = state->level[half], *back = state->back[0], *more = state->back[1];
    Row *end = state->row + begins(state->selected, half + 1);
    memset(level, 0, 6 * (state->system->bodies + 1) * sizeof(double));
    for (Row *row = state->row + begins(state->selected, half); row < end; row++) {
        if (back[row->first] + more[row->first] > 0 || back[row->second] + more[row->second] > 0) row->age = 0;
        double beta = state->beta[row->age++];
        for (int j = 0; j < 3; j++) row->q[j] = row->p[j] + beta * row->change[j];
        add_impulse(&row->at, row->q, level + 6 * row->first, level + 6 * row->second);
    }
}

/* Add the levels of both halves, and turn them into velocities. */
static void update_velocities(State *state, int half)
{
    const System *system = state->system;
    int64_t first = begins(system->bodies, half), last = begins(system->bodies, half + 1);
    double *level = state->level[0], *more = state->level[1];
    for (int64_t i = 6 * first; i < 6 * last; i++) level[i] += more[i];
    to_velocities(system, first, last, level);
    if (half) memset(level + 6 * system->bodies, 0, 6 * sizeof(double));
    memset(state->back[half], 0, (system->bodies + 1) * sizeof(double));
}

/* Take a gradient step, project on the cones, and find the largest error. */
static void project_rows(State *state, int half)
{
    double worst = 0, *level = state->level[0], *back = state->back[half];
    Row *end = state->row + begins(state->selected, half + 1);
    for (Row *row = state->row + begins(state->selected, half); row < end; row++) {
        double u[3], left[3], mu = row->at.friction, step = 1 / row->d;
        relative_velocity(&row->at, level + 6 * row->first, level + 6 * row->second, u);
        u[0] += mu * sqrt(u[1] * u[1] + u[2] * u[2]);
        for (int j = 0; j < 3; j++) { row->change[j] = row->p[j]; row->p[j] = row->q[j] - step * u[j]; }
        project(row->p, mu);
        for (int j = 0; j < 3; j++) { left[j] = row->q[j] - row->p[j]; row->change[j] = row->p[j] - row->change[j]; }
        double reversal = row->d * dot(left, row->change);
        back[row->first] += reversal;
        back[row->second] += reversal;
        worst = fmax(worst, row->d * row->d * dot(left, left));
    }
    back[state->system->bodies] = 0;
    state->worst[half] = worst;
}

/* Iterate to the tolerance or the limit. Contacts are selected again after 15, 30, 60, ... iterations. */
static void iterate(State *state)
{
    int64_t spent = 0;
    for (int done = 0; spent < state->limit;) {
        int64_t until = spent + (spent > FIRST_SELECTION ? spent : FIRST_SELECTION);
        select_contacts(state);
        if (!state->missed && done) {
            state->error = 0;
            break;
        }
        in_halves(state, sum_squares);
        in_halves(state, bound_bodies);
        in_halves(state, bound_contacts);
        in_halves(state, load_rows);
        for (done = 0; !done && spent < until && spent < state->limit; spent++) {
            in_halves(state, extrapolate);
            in_halves(state, update_velocities);
            in_halves(state, project_rows);
            double worst = fmax(state->worst[0], state->worst[1]);
            state->error = sqrt(worst);
            done = worst < state->tolerance * state->tolerance && (spent + 1) % CHECK_INTERVAL == 0;
        }
        in_halves(state, store_rows);
    }
}

/* Nesterov's (t - 1) / t', t' = (1 + sqrt(1 + 4 t^2)) / 2 from t = 1 on. */
static void nesterov_factors(double *beta, int64_t count)
{
    double t = 1;
    for (int64_t age = 0; age < count; age++) {
        double next = (1 + sqrt(1 + 4 * t * t)) / 2;
        beta[age] = (t - 1) / next;
        t = next;
    }
}

static void free_state(State *state)
{
    if (!state) return;
    free(state->row);
    free(state->rows);
    free(state->change);
    free(state);
}

/* Return a new state; NULL where there is no memory for it. */
static State *make_state(const System *system, double tolerance, int64_t limit, double *p)
{
    int64_t k = system->count, n = system->bodies + 1;
    State *state = calloc(1, sizeof(State));
    if (!state) return NULL;
    double *room = state->change = calloc(6 * k + 87 * n + limit, sizeof(double));
    state->rows = calloc(2 * k + 1, sizeof(int64_t)), state->row = malloc((k + 1) * sizeof(Row));
    if (!room || !state->rows || !state->row) {
        free_state(state);
        return NULL;
    }
    state->system = system, state->p = p, state->tolerance = tolerance, state->limit = limit;
    state->age = state->rows + k, state->d = room + 3 * k, state->w = state->d + k, room += 6 * k;
    for (int half = 0; half < 2; half++, room += 43 * n)
        state->level[half] = room, state->back[half] = room + 6 * n, state->square[half] = room + 7 * n;
    state->lambda = room, state->beta = room + n;
    nesterov_factors(state->beta, limit);
    return state;
}

/* Solve for the impulses p (count, 3), which are those to start from. Return -1 where there is no memory, 0 if the solution
   is within the tolerance, and otherwise the error of the velocities. */
double solve(const System *system, double tolerance, int64_t limit, double *p)
{
    State *state = make_state(system, tolerance, limit, p);
    if (!state) return -1;
    iterate(state);
    double error = state->error;
    free_state(state);
    return error;
}

/* D (count,) of all contacts; return -1 where there is no memory, else 0. */
int64_t diagonal_bounds(const System *system, double *d)
{
    State *state = make_state(system, 0, 0, d);
    if (!state) return -1;
    for (state->selected = 0; state->selected < system->count; state->selected++)
        state->rows[state->selected] = state->selected;
    in_halves(state, sum_squares);
    in_halves(state, bound_bodies);
    in_halves(state, bound_contacts);
    memcpy(d, state->d, system->count * sizeof(double));
    free_state(state);
    return 0;
}
