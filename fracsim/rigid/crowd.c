/* What rigid.crowd does to each contact in every iteration.

   Vectors of a contact are along its axes, first the normal. Things are n bodies and, as the last one, all that stands:
   it has no inverse mass. What bodies are given is six numbers each, impulse and moment, or velocity and spin. */

#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { CHECK = 10, LOOK = 15, SQUARINGS = 6 };

typedef struct {
    double axes[9], arms[6], given[3], friction; /* rows of axes; arms from what first and second turn about */
} Contact;

typedef struct {
    int64_t count, bodies;
    const Contact *contact;
    const int64_t *things; /* (count, 2) */
    const double *mass;    /* (bodies,) 1 / kg, inverse */
    const double *inertia; /* (bodies, 9) inverse */
} Crowd;

static void cross(const double *a, const double *b, double *c)
{
    c[0] = a[1] * b[2] - a[2] * b[1];
    c[1] = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0];
}

static double dot(const double *a, const double *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

/* Add to what bodies are given what an impulse p of a contact does. */
static void push(const Contact *at, const double *p, double *first, double *second)
{
    double f[3], m[3];
    for (int j = 0; j < 3; j++) f[j] = at->axes[j] * p[0] + at->axes[3 + j] * p[1] + at->axes[6 + j] * p[2];
    cross(at->arms, f, m);
    for (int j = 0; j < 3; j++) { first[j] -= f[j]; first[3 + j] -= m[j]; }
    cross(at->arms + 3, f, m);
    for (int j = 0; j < 3; j++) { second[j] += f[j]; second[3 + j] += m[j]; }
}

/* Velocities and spins, from impulses and moments. */
static void move(const Crowd *crowd, double *level)
{
    for (int64_t n = 0; n < crowd->bodies; n++) {
        const double *inverse = crowd->inertia + 9 * n;
        double *v = level + 6 * n, m[3] = {v[3], v[4], v[5]};
        for (int j = 0; j < 3; j++) { v[j] *= crowd->mass[n]; v[3 + j] = dot(inverse + 3 * j, m); }
    }
    memset(level + 6 * crowd->bodies, 0, 6 * sizeof(double));
}

/* What impulses (count, 3) give. */
void gained(const Crowd *crowd, const double *p, double *level)
{
    memset(level, 0, 6 * (crowd->bodies + 1) * sizeof(double));
    for (int64_t k = 0; k < crowd->count; k++)
        if (p[3 * k] > 0)
            push(crowd->contact + k, p + 3 * k, level + 6 * crowd->things[2 * k], level + 6 * crowd->things[2 * k + 1]);
    move(crowd, level);
}

/* Velocity u of the second thing beside the first. */
static void part(const Contact *at, const double *first, const double *second, double *u)
{
    double a[3], b[3];
    cross(first + 3, at->arms, a);
    cross(second + 3, at->arms + 3, b);
    for (int j = 0; j < 3; j++) a[j] = second[j] + b[j] - first[j] - a[j];
    for (int j = 0; j < 3; j++) u[j] = dot(at->axes + 3 * j, a) + at->given[j];
}

/* The nearest of the cone |p_t| <= mu p_n. */
static void project(double *p, double mu)
{
    double along = sqrt(p[1] * p[1] + p[2] * p[2]);
    if (along <= mu * p[0]) return;
    double normal = fmax((p[0] + mu * along) / (1 + mu * mu), 0), share = along > 0 ? mu * normal / along : 0;
    p[0] = normal;
    p[1] *= share;
    p[2] *= share;
}

void projected(int64_t count, double *p, const double *mu)
{
    for (int64_t k = 0; k < count; k++) project(p + 3 * k, mu[k]);
}

/* w = tr J M^-1 J^T of one side of a contact, and J^T J / w added to the (6, 6) of its body. */
static double weigh(const Contact *at, const double *arm, double mass, const double *inverse, double *square)
{
    double rows[3][6], w = 0;
    for (int a = 0; a < 3; a++) {
        double *turning = rows[a] + 3;
        memcpy(rows[a], at->axes + 3 * a, 3 * sizeof(double));
        cross(arm, rows[a], turning);
        w += mass;
        for (int j = 0; j < 3; j++) w += turning[j] * dot(inverse + 3 * j, turning);
    }
    for (int i = 0; i < 6; i++)
        for (int j = 0; j < 6; j++)
            square[6 * i + j] += (rows[0][i] * rows[0][j] + rows[1][i] * rows[1][j] + rows[2][i] * rows[2][j]) / w;
    return w;
}

/* The largest eigenvalue of M^-1 S, S (6, 6), or a little more: tr (M^-1 S)^m to the power of 1 / m, m = 2^SQUARINGS. */
static double largest(const double *square, double mass, const double *inverse)
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

/* D (count,) of some contacts (rows); `square`: room for 36 (bodies + 1), `most`: (bodies + 1), `w`: (count, 2). */
void bound(
    const Crowd *crowd, const int64_t *rows, int64_t some, double *d, double *square, double *most, double *w)
{
    memset(square, 0, 36 * (crowd->bodies + 1) * sizeof(double));
    for (int64_t r = 0; r < some; r++)
        for (int side = 0; side < 2; side++) {
            int64_t k = rows[r], n = crowd->things[2 * k + side];
            w[2 * k + side] = n == crowd->bodies ? 0 : weigh(crowd->contact + k, crowd->contact[k].arms + 3 * side,
                crowd->mass[n], crowd->inertia + 9 * n, square + 36 * n);
        }
    for (int64_t n = 0; n < crowd->bodies; n++)
        most[n] = largest(square + 36 * n, crowd->mass[n], crowd->inertia + 9 * n);
    most[crowd->bodies] = 0;
    for (int64_t r = 0; r < some; r++) {
        const int64_t k = rows[r], *n = crowd->things + 2 * k;
        d[k] = fmax(most[n[0]] * w[2 * k] + most[n[1]] * w[2 * k + 1], 1e-300);
    }
}

/* A contact that is solved for, one after the other in memory. */
typedef struct {
    Contact at;
    double d, p[3], change[3], q[3]; /* impulses, how they last changed, and where they are looked at */
    int64_t number, age;             /* of all contacts; iterations since p turned back */
    int32_t first, second;
} Row;

typedef struct {
    double *p, *change; /* (count, 3) of all contacts */
    double *d;          /* (count,) */
    int64_t *age;       /* (count,) */
    double *level;      /* (bodies + 1, 6) what is given to bodies */
    double *back;       /* (bodies + 1,) how far p turned back in the last iteration */
    double *beta;       /* (most,) by age */
    Row *row;           /* some of count */
    int64_t some;
} State;

/* q = p + beta change, and what bodies are given by it. */
static void ahead(const Crowd *crowd, State *now)
{
    memset(now->level, 0, 6 * (crowd->bodies + 1) * sizeof(double));
    now->back[crowd->bodies] = 0;
    for (Row *row = now->row; row < now->row + now->some; row++) {
        if (now->back[row->first] > 0 || now->back[row->second] > 0) row->age = 0;
        double beta = now->beta[row->age++];
        for (int j = 0; j < 3; j++) row->q[j] = row->p[j] + beta * row->change[j];
        push(&row->at, row->q, now->level + 6 * row->first, now->level + 6 * row->second);
    }
    memset(now->back, 0, (crowd->bodies + 1) * sizeof(double));
    move(crowd, now->level);
}

/* An iteration; the square of the most, in m/s, that any contact was off by. */
static double iterated(const Crowd *crowd, State *now)
{
    double worst = 0;
    ahead(crowd, now);
    for (Row *row = now->row; row < now->row + now->some; row++) {
        double u[3], left[3], mu = row->at.friction, step = 1 / row->d;
        part(&row->at, now->level + 6 * row->first, now->level + 6 * row->second, u);
        u[0] += mu * sqrt(u[1] * u[1] + u[2] * u[2]);
        for (int j = 0; j < 3; j++) { row->change[j] = row->p[j]; row->p[j] = row->q[j] - step * u[j]; }
        project(row->p, mu);
        for (int j = 0; j < 3; j++) { left[j] = row->q[j] - row->p[j]; row->change[j] = row->p[j] - row->change[j]; }
        double back = row->d * dot(left, row->change);
        now->back[row->first] += back;
        now->back[row->second] += back;
        worst = fmax(worst, row->d * row->d * dot(left, left));
    }
    return worst;
}

/* Which contacts press, or would let things through by `enough`; whether any would that gives nothing. */
static int looked(const Crowd *crowd, State *now, double enough, int64_t *rows)
{
    int missed = 0;
    gained(crowd, now->p, now->level);
    now->some = 0;
    for (int64_t k = 0; k < crowd->count; k++) {
        const int64_t *n = crowd->things + 2 * k;
        double u[3];
        part(crowd->contact + k, now->level + 6 * n[0], now->level + 6 * n[1], u);
        missed |= u[0] < -enough && now->p[3 * k] == 0;
        if (u[0] < enough || now->p[3 * k] > 0) rows[now->some++] = k;
    }
    return missed;
}

static void taken(const Crowd *crowd, State *now, const int64_t *rows)
{
    for (int64_t r = 0; r < now->some; r++) {
        int64_t k = rows[r];
        Row row = {.at = crowd->contact[k], .d = now->d[k], .number = k, .age = now->age[k],
                   .first = (int32_t)crowd->things[2 * k], .second = (int32_t)crowd->things[2 * k + 1]};
        memcpy(row.p, now->p + 3 * k, sizeof row.p);
        memcpy(row.change, now->change + 3 * k, sizeof row.change);
        now->row[r] = row;
    }
}

static void handed(State *now)
{
    for (const Row *row = now->row; row < now->row + now->some; row++) {
        now->age[row->number] = row->age;
        memcpy(now->p + 3 * row->number, row->p, sizeof row->p);
        memcpy(now->change + 3 * row->number, row->change, sizeof row->change);
    }
}

/* Iterations, at most so many; how many it took. `square`: room for 37 (bodies + 1), `w`: (count, 2), `rows`: (count,). */
static int64_t solved(const Crowd *crowd, State *now, double enough, int64_t most, double *square, double *w, int64_t *rows)
{
    int64_t spent = 0;
    for (int done = 0; spent < most;) {
        int64_t until = spent + (spent > LOOK ? spent : LOOK);
        if (!looked(crowd, now, enough, rows) && done) break;
        bound(crowd, rows, now->some, now->d, square, square + 36 * (crowd->bodies + 1), w);
        taken(crowd, now, rows);
        for (done = 0; !done && spent < until && spent < most; spent++)
            done = iterated(crowd, now) < enough * enough && (spent + 1) % CHECK == 0;
        handed(now);
    }
    return spent;
}

/* Nesterov's (pace - 1) / pace', pace' = (1 + sqrt(1 + 4 pace^2)) / 2 from pace = 1 on. */
static void betas(double *beta, int64_t most)
{
    double pace = 1;
    for (int64_t age = 0; age < most; age++) {
        double faster = (1 + sqrt(1 + 4 * pace * pace)) / 2;
        beta[age] = (pace - 1) / faster;
        pace = faster;
    }
}

/* The same from impulses p (count, 3) on, which it changes; -1 where there is no memory for it. */
int64_t impulses(const Crowd *crowd, double enough, int64_t most, double *p)
{
    int64_t k = crowd->count, n = crowd->bodies + 1, spent = -1, *rows = calloc(2 * k + 1, sizeof(int64_t));
    double *room = calloc(6 * k + 44 * n + most, sizeof(double)), *d = room + 3 * k, *w = d + k;
    double *level = w + 2 * k, *back = level + 6 * n, *square = back + n, *beta = square + 37 * n;
    State now = {p, room, d, rows + k, level, back, beta, malloc((k + 1) * sizeof(Row)), 0};
    if (room && rows && now.row) {
        betas(beta, most);
        spent = solved(crowd, &now, enough, most, square, w, rows);
    }
    free(now.row);
    free(room);
    free(rows);
    return spent;
}
