/* What rigid.contact_solver does to each contact in every iteration.

   Vectors of a contact are along its axes, first the normal. Things are n bodies and, as the last one, all that stands:
   it has no inverse mass. What bodies are given is six numbers each, impulse and moment, or velocity and spin. */

#define _POSIX_C_SOURCE 199309L
#include <math.h>
#include <sched.h>
#include <stdatomic.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

enum { CHECK = 10, LOOK = 15, SQUARINGS = 6, PATIENCE = 5000 };
enum { TAKEN = 1, DONE = 2, STAGES = 4 };

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

/* Velocities and spins of some bodies, from impulses and moments. */
static void move(const Crowd *crowd, int64_t first, int64_t last, double *level)
{
    for (int64_t n = first; n < last; n++) {
        const double *inverse = crowd->inertia + 9 * n;
        double *v = level + 6 * n, m[3] = {v[3], v[4], v[5]};
        for (int j = 0; j < 3; j++) { v[j] *= crowd->mass[n]; v[3 + j] = dot(inverse + 3 * j, m); }
    }
}

/* What impulses (count, 3) give. */
void gained(const Crowd *crowd, const double *p, double *level)
{
    memset(level, 0, 6 * (crowd->bodies + 1) * sizeof(double));
    for (int64_t k = 0; k < crowd->count; k++)
        if (p[3 * k] > 0)
            push(crowd->contact + k, p + 3 * k, level + 6 * crowd->things[2 * k], level + 6 * crowd->things[2 * k + 1]);
    move(crowd, 0, crowd->bodies, level);
    memset(level + 6 * crowd->bodies, 0, 6 * sizeof(double));
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

/* A contact that is solved for, one after the other in memory. */
typedef struct {
    Contact at;
    double d, p[3], change[3], q[3]; /* impulses, how they last changed, and where they are looked at */
    int64_t number, age;             /* of all contacts; iterations since p turned back */
    int32_t first, second;
} Row;

/* What is worked on in two halves, by one thread or by two: sums are the same to the last digit. */
typedef struct State State;
typedef void (*Work)(State *, int);
struct State {
    const Crowd *crowd;
    double *p, *change;         /* (count, 3) of all contacts */
    double *d, *w;              /* (count,), (count, 2) */
    int64_t *age, *rows;        /* (count,) by contact; some of them */
    double *level[2], *back[2]; /* of each half: (bodies + 1, 6) what is given to bodies, (bodies + 1,) how far p turned
                                   back in the last iteration */
    double *square[2], *most;   /* of each half: (bodies + 1, 36), see `squares`; (bodies + 1,) */
    double *beta;               /* (most,) by age */
    double worst[2], enough;    /* m/s that velocities are off by, its square, of each half; and may be */
    Row *row;                   /* some of count */
    int64_t some, limit;
    int missed;
    Work work;                   /* what is done to both halves, */
    atomic_int_fast64_t offer;   /* the STAGES of the second: offered, TAKEN, DONE; -1 in the end */
};

/* Look again, and after a while let others have the core. */
static void patient(int *waited)
{
    if (*waited < PATIENCE) ++*waited;
    else sched_yield();
}

/* Do something to both halves. A second thread does the second one, if it is there before the first is through with its
   own: where cores have more to do, nobody waits for a thread that does not run. */
static void share(State *now, Work work)
{
    now->work = work;
    int_fast64_t open = atomic_load(&now->offer) / STAGES * STAGES + STAGES;
    atomic_store(&now->offer, open);
    work(now, 0);
    if (atomic_compare_exchange_strong(&now->offer, &(int_fast64_t){open}, open + TAKEN)) work(now, 1);
    else for (int waited = 0; atomic_load(&now->offer) != open + DONE;) patient(&waited);
}

/* What a second thread does, until there is no more to do. */
void help(State *now)
{
    for (int waited = 0; atomic_load(&now->offer) >= 0;) {
        int_fast64_t open = atomic_load(&now->offer);
        if (open > 0 && open % STAGES == 0 && atomic_compare_exchange_strong(&now->offer, &open, open + TAKEN)) {
            now->work(now, 1);
            atomic_store(&now->offer, open + DONE);
            waited = 0;
        } else patient(&waited);
    }
}

static int64_t begins(int64_t count, int half) { return half * count / 2; }

/* Which contacts press, or would let things through by `enough`; whether any would that gives nothing. */
static void look(State *now)
{
    const Crowd *crowd = now->crowd;
    double *level = now->level[0];
    now->missed = 0, now->some = 0;
    gained(crowd, now->p, level);
    for (int64_t k = 0; k < crowd->count; k++) {
        const int64_t *n = crowd->things + 2 * k;
        double u[3];
        part(crowd->contact + k, level + 6 * n[0], level + 6 * n[1], u);
        now->missed |= u[0] < -now->enough && now->p[3 * k] == 0;
        if (u[0] < now->enough || now->p[3 * k] > 0) now->rows[now->some++] = k;
    }
}

/* J^T J / w of the contacts of a half, summed by bodies. */
static void squares(State *now, int half)
{
    const Crowd *crowd = now->crowd;
    memset(now->square[half], 0, 36 * (crowd->bodies + 1) * sizeof(double));
    for (int64_t r = begins(now->some, half); r < begins(now->some, half + 1); r++)
        for (int side = 0; side < 2; side++) {
            int64_t k = now->rows[r], n = crowd->things[2 * k + side];
            now->w[2 * k + side] = n == crowd->bodies ? 0 : weigh(crowd->contact + k,
                crowd->contact[k].arms + 3 * side, crowd->mass[n], crowd->inertia + 9 * n, now->square[half] + 36 * n);
        }
}

static void largests(State *now, int half)
{
    const Crowd *crowd = now->crowd;
    for (int64_t n = begins(crowd->bodies, half); n < begins(crowd->bodies, half + 1); n++) {
        double *square = now->square[0] + 36 * n;
        for (int i = 0; i < 36; i++) square[i] += now->square[1][36 * n + i];
        now->most[n] = largest(square, crowd->mass[n], crowd->inertia + 9 * n);
    }
}

/* D of the contacts of a half. */
static void bounds(State *now, int half)
{
    for (int64_t r = begins(now->some, half); r < begins(now->some, half + 1); r++) {
        const int64_t k = now->rows[r], *n = now->crowd->things + 2 * k;
        now->d[k] = fmax(now->most[n[0]] * now->w[2 * k] + now->most[n[1]] * now->w[2 * k + 1], 1e-300);
    }
}

static void taken(State *now, int half)
{
    for (int64_t r = begins(now->some, half); r < begins(now->some, half + 1); r++) {
        int64_t k = now->rows[r];
        Row row = {.at = now->crowd->contact[k], .d = now->d[k], .number = k, .age = now->age[k],
                   .first = (int32_t)now->crowd->things[2 * k], .second = (int32_t)now->crowd->things[2 * k + 1]};
        memcpy(row.p, now->p + 3 * k, sizeof row.p);
        memcpy(row.change, now->change + 3 * k, sizeof row.change);
        now->row[r] = row;
    }
}

static void handed(State *now, int half)
{
    for (int64_t r = begins(now->some, half); r < begins(now->some, half + 1); r++) {
        const Row *row = now->row + r;
        now->age[row->number] = row->age;
        memcpy(now->p + 3 * row->number, row->p, sizeof row->p);
        memcpy(now->change + 3 * row->number, row->change, sizeof row->change);
    }
}

/* q = p + beta change, and what bodies are given by it. */
static void ahead(State *now, int half)
{
    double *level = now->level[half], *back = now->back[0], *more = now->back[1];
    memset(level, 0, 6 * (now->crowd->bodies + 1) * sizeof(double));
    for (Row *row = now->row + begins(now->some, half); row < now->row + begins(now->some, half + 1); row++) {
        if (back[row->first] + more[row->first] > 0 || back[row->second] + more[row->second] > 0) row->age = 0;
        double beta = now->beta[row->age++];
        for (int j = 0; j < 3; j++) row->q[j] = row->p[j] + beta * row->change[j];
        push(&row->at, row->q, level + 6 * row->first, level + 6 * row->second);
    }
}

/* What bodies move with; both halves of what they are given are one. */
static void moved(State *now, int half)
{
    const Crowd *crowd = now->crowd;
    int64_t first = begins(crowd->bodies, half), last = begins(crowd->bodies, half + 1);
    double *level = now->level[0], *more = now->level[1];
    for (int64_t i = 6 * first; i < 6 * last; i++) level[i] += more[i];
    move(crowd, first, last, level);
    if (half) memset(level + 6 * crowd->bodies, 0, 6 * sizeof(double));
    memset(now->back[half], 0, (crowd->bodies + 1) * sizeof(double));
}

/* The cones; the square of the most, in m/s, that any contact was off by. */
static void iterated(State *now, int half)
{
    double worst = 0, *level = now->level[0], *back = now->back[half];
    for (Row *row = now->row + begins(now->some, half); row < now->row + begins(now->some, half + 1); row++) {
        double u[3], left[3], mu = row->at.friction, step = 1 / row->d;
        part(&row->at, level + 6 * row->first, level + 6 * row->second, u);
        u[0] += mu * sqrt(u[1] * u[1] + u[2] * u[2]);
        for (int j = 0; j < 3; j++) { row->change[j] = row->p[j]; row->p[j] = row->q[j] - step * u[j]; }
        project(row->p, mu);
        for (int j = 0; j < 3; j++) { left[j] = row->q[j] - row->p[j]; row->change[j] = row->p[j] - row->change[j]; }
        double turned = row->d * dot(left, row->change);
        back[row->first] += turned;
        back[row->second] += turned;
        worst = fmax(worst, row->d * row->d * dot(left, left));
    }
    back[now->crowd->bodies] = 0;
    now->worst[half] = worst;
}

/* Iterations, at most so many; how many it took. */
static int64_t solved(State *now)
{
    int64_t spent = 0;
    for (int done = 0; spent < now->limit;) {
        int64_t until = spent + (spent > LOOK ? spent : LOOK);
        look(now);
        if (!now->missed && done) break;
        share(now, squares);
        share(now, largests);
        share(now, bounds);
        share(now, taken);
        for (done = 0; !done && spent < until && spent < now->limit; spent++) {
            share(now, ahead);
            share(now, moved);
            share(now, iterated);
            done = fmax(now->worst[0], now->worst[1]) < now->enough * now->enough && (spent + 1) % CHECK == 0;
        }
        share(now, handed);
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

void finished(State *now)
{
    if (!now) return;
    free(now->row);
    free(now->rows);
    free(now->change);
    free(now);
}

/* What is to be solved; NULL where there is no memory for it. */
State *begun(const Crowd *crowd, double enough, int64_t most, double *p)
{
    int64_t k = crowd->count, n = crowd->bodies + 1;
    State *now = calloc(1, sizeof(State));
    if (!now) return NULL;
    double *room = now->change = calloc(6 * k + 87 * n + most, sizeof(double));
    now->rows = calloc(2 * k + 1, sizeof(int64_t)), now->row = malloc((k + 1) * sizeof(Row));
    if (!room || !now->rows || !now->row) {
        finished(now);
        return NULL;
    }
    now->crowd = crowd, now->p = p, now->enough = enough, now->limit = most;
    now->age = now->rows + k, now->d = room + 3 * k, now->w = now->d + k, room += 6 * k;
    for (int half = 0; half < 2; half++, room += 43 * n)
        now->level[half] = room, now->back[half] = room + 6 * n, now->square[half] = room + 7 * n;
    now->most = room, now->beta = room + n;
    betas(now->beta, most);
    return now;
}

/* The same from impulses p (count, 3) on, which it changes; how many iterations it took. */
int64_t impulses(State *now)
{
    int64_t spent = solved(now);
    atomic_store(&now->offer, -1);
    return spent;
}

/* D (count,) of all contacts; -1 where there is no memory for it. */
int64_t bound(const Crowd *crowd, double *d)
{
    State *now = begun(crowd, 0, 0, d);
    if (!now) return -1;
    for (now->some = 0; now->some < crowd->count; now->some++) now->rows[now->some] = now->some;
    share(now, squares);
    share(now, largests);
    share(now, bounds);
    memcpy(d, now->d, crowd->count * sizeof(double));
    finished(now);
    return 0;
}
