/* Co-simulation: steps under error control, with switches located, from the present time to a communication point.

   RODAS5P in the transformed form: stage i at y + sum a_ij k_j, right-hand side f + M sum c_ij k_j / h + h d_i f_t, with the
   exact Jacobian. The coefficients and their source are in tableau.h, which is generated. */
#include "internal.h"
#include "tableau.h"

#define STAGES 8

typedef struct {
    double k[STAGES][SOME(NY)], u[SOME(NY)], y_next[SOME(NY)], dense[4][SOME(NY)], ft[SOME(NY)], sum[SOME(NY)];
    double jac[SOME(NY * NY)], matrix[SOME(NY * NY)], factors[SOME(FACTORS)];
    int pivots[SOME(NY)], generated;
} Work;

/* Factors M/(h gamma) - J: by the generated elimination where its pivots are large enough, else with partial pivoting. */
static int factor_matrix(Work *x, double h) {
    double shift = 1.0 / (h * RODAS_GAMMA);
#if FACTORS
    int trusted = 1;
    model_factorise(x->jac, shift, x->factors);
    for (int r = 0; r < NY && trusted; r++) {
        double largest = r < NX ? shift : 0.0;
        for (int c = 0; c < NY; c++) largest = fmax(largest, fabs(x->jac[r * NY + c]));
        trusted = fabs(x->factors[r]) * largest < 1e7;
    }
    x->generated = trusted;
    if (trusted) return 1;
#else
    x->generated = 0;
#endif
    for (int e = 0; e < NY * NY; e++) x->matrix[e] = -x->jac[e];
    for (int r = 0; r < NX; r++) x->matrix[r * NY + r] += shift;
    return factorise(x->matrix, x->pivots, NY);
}

static void solve(Work *x, double *b) {
#if FACTORS
    if (x->generated) {
        model_solve(x->factors, b);
        return;
    }
#endif
    back_substitute(x->matrix, x->pivots, b, NY);
}

/* One step of length h to `end` from y into y_next; the error stands in the last stage. */
static void step(Instance *i, Work *x, const double *y, double t, double h, double end) {
    Args a;
    arguments(i, &a);
    a.y = x->u;
    for (int stage = 0; stage < STAGES; stage++) {
        double share = RODAS_TIME[stage];
        if (stage < 6) outside(i, share == 1.0 ? end : t + share * h);
        if (stage < 6) {
            for (int q = 0; q < NY; q++) {
                double value = y[q];
                for (int j = 0; j < stage; j++) value += RODAS_A[stage][j] * x->k[j][q];
                x->u[q] = value;
            }
        } else {
            for (int q = 0; q < NY; q++) x->u[q] += x->k[stage - 1][q];
        }
        double *row = x->k[stage];
        model_f(&a, row);
        for (int q = 0; q < NX; q++) {
            double sum = 0.0;
            for (int j = 0; j < stage; j++) sum += RODAS_C[stage][j] * x->k[j][q];
            row[q] += sum / h;
        }
        if (RODAS_D[stage] != 0.0)
            for (int q = 0; q < NY; q++) row[q] += h * RODAS_D[stage] * x->ft[q];
        solve(x, row);
    }
    for (int q = 0; q < NY; q++) x->y_next[q] = x->u[q] + x->k[STAGES - 1][q];
}

/* The step's quartic: y + x (d0 + x (d1 + x (d2 + x d3))). */
static void make_dense(Work *x, const double *y) {
    for (int q = 0; q < NY; q++) {
        double a = 0.0, b = 0.0, c = 0.0;
        for (int s = 0; s < STAGES; s++) {
            a += RODAS_H[0][s] * x->k[s][q];
            b += RODAS_H[1][s] * x->k[s][q];
            c += RODAS_H[2][s] * x->k[s][q];
        }
        x->dense[0][q] = x->y_next[q] - y[q] + a;
        x->dense[1][q] = b - a;
        x->dense[2][q] = c - b;
        x->dense[3][q] = -c;
    }
}

static void interpolate(const Work *x, const double *y, double share, double *u) {
    for (int q = 0; q < NY; q++)
        u[q] = y[q] + share * (x->dense[0][q] + share * (x->dense[1][q] + share * (x->dense[2][q] + share * x->dense[3][q])));
}

static double error_norm(const Instance *i, const Work *x, int rows) {
    double total = 0.0;
    for (int q = 0; q < rows; q++) {
        double size = fmax(fabs(i->s.y[q]), fabs(x->y_next[q]));
        double share = x->k[STAGES - 1][q] / (i->s.atol + i->s.rtol * size);
        total += share * share;
    }
    return rows ? sqrt(total / rows) : 0.0;
}

/* The switches at a share of the step; the one furthest beyond its mode, or -1. */
static int beyond(Instance *i, Work *x, const double *y, double t, double h, double share, double end, double *values) {
    Args a;
    arguments(i, &a);
    if (share == 1.0)
        memcpy(x->u, x->y_next, sizeof x->u);
    else
        interpolate(x, y, share, x->u);
    a.y = x->u;
    outside(i, share == 1.0 ? end : t + share * h);
    model_switches(&a, values);
    return violation(i, values);
}

/* The first step's length, from the size of values and rates. */
static double first_step(Instance *i, double h) {
    State *s = &i->s;
    Args a;
    arguments(i, &a);
    double f[SOME(NY)], d0 = 0.0, d1 = 0.0;
    model_f(&a, f);
    for (int q = 0; q < NX; q++) {
        double weight = s->atol + s->rtol * fabs(s->y[q]);
        d0 += (s->y[q] / weight) * (s->y[q] / weight);
        d1 += (f[q] / weight) * (f[q] / weight);
    }
    double guess = d0 > 0.0 && d1 > 0.0 ? 0.01 * sqrt(d0 / d1) : 0.1 * s->span;
    if (h == 0.0 || guess < h) return fmin(fmax(guess, 1e-9 * s->span), 0.1 * s->span);
    return h;
}

/* Keeps the sources over the step just taken, of which the part up to s->t is valid. */
static Outcome remember(Instance *i, Work *x, const double *y, double t, double h, double end) {
#if ND
    Args a;
    arguments(i, &a);
    double values[NODES][ND], source[ND + NQ];
    a.y = x->u;
    for (int n = 0; n < NODES; n++) {
        double share = n / (NODES - 1.0) * (end - t) / h;
        interpolate(x, y, share, x->u);
        outside(i, fmin(t + share * h, end));
        model_sources(&a, source);
        for (int k = 0; k < ND; k++) values[n][k] = source[k];
    }
    return keep_quartic(i, t, end - t, values);
#else
    (void)i, (void)x, (void)y, (void)t, (void)h, (void)end;
    return GOOD;
#endif
}

/* Crosses a switch: its mode and those that follow from it change, the unknowns are solved anew. */
static Outcome cross(Instance *i, int event) {
    State *s = &i->s;
    Args a;
    double values[SOME(NS)];
    arguments(i, &a);
    if (event == s->last_switch && s->t - s->last_event < 1e-9 * s->span) {
        if (++s->chatter > 40) return CHATTER;
    } else {
        s->chatter = 0;
    }
    s->last_event = s->t;
    s->last_switch = event;
    outside(i, s->t);
    Outcome outcome = consistent(i, 0);
    if (outcome != GOOD) return outcome;
    s->m[event] = 1.0 - s->m[event];
    for (int n = 0; n < NS; n++) {
        if ((outcome = consistent(i, 0)) != GOOD) return outcome;
        model_switches(&a, values);
        int also = violation(i, values);
        if (also < 0 || also == event) break;
        s->m[also] = 1.0 - s->m[also];
    }
    for (int k = 0; k < ND; k++)
        if ((outcome = keep_echo(i, s->t + s->timing[k], 1.0)) != GOOD) return outcome;
    return GOOD;
}

/* Where within the step the switch `event` passes, first seen at `bad` and not yet at `good`: a share of the step. */
static double locate(Instance *i, Work *x, const double *y, double t, double h, double end, double good, double bad,
                     int *event, double *values) {
    for (int n = 0; n < 60; n++) {
        double middle = 0.5 * (good + bad);
        int which = beyond(i, x, y, t, h, middle, end, values);
        if (which >= 0) {
            bad = middle;
            *event = which;
            if (fabs(values[which]) <= 2.0 * i->s.slack[which]) break;
        } else {
            good = middle;
        }
        if ((bad - good) * h <= 1e-15 * fmax(1.0, fabs(t))) break;
    }
    return bad;
}

/* Steps to `stop`, an instant up to which nothing comes from outside but time. */
static Outcome advance(Instance *i, Work *x, double stop, int *budget) {
    State *s = &i->s;
    Args a;
    arguments(i, &a);
    int rejected = 0, aim = -1, fresh = 1;
    double shortest = INFINITY, values[SOME(NS)];
    for (int k = 0; k < ND; k++) shortest = fmin(shortest, s->timing[k]);
    while (s->t < stop) {
        if (--*budget < 0) return STEP_LIMIT;
        double t = s->t;
        s->h = fmin(s->h, shortest);
        int last = t + 1.000001 * s->h >= stop, event = -1;
        double end = last ? stop : t + s->h, h = end - t;
        if (last && !(h > 1e-15 * fmax(fabs(t), s->span))) {
            s->t = stop;
            break;
        }
        if (!(h > 4e-16 * fmax(fabs(t), s->span)) || s->h < 1e-14 * s->span) return NOT_FINITE;
        if (fresh) {
            outside(i, t);
            model_jac(&a, x->jac);
            model_ft(&a, x->ft);
            fresh = 0;
        }
        /* An unknown may have an infinite slope for an instant; very short steps are judged by the states alone. */
        int rows = h > 1e-6 * s->span || NX == 0 ? NY : NX;
        double error = INFINITY;
        if (factor_matrix(x, h)) {
            step(i, x, s->y, t, h, end);
            error = error_norm(i, x, rows);
        }
        if (error > 1.0 && h <= 1e-10 * s->span && error < INFINITY && s->forced < 50) {
            s->forced++;
            error = 0.05;
        }
        if (!(error <= 1.0)) {
            s->h = h * (error < INFINITY ? fmax(0.2, 0.9 * pow(error, -0.2)) : 0.2);
            rejected = 1;
            continue;
        }
        double factor = error > 1e-10 ? 0.9 * pow(error, -0.2) : 8.0;
        factor = fmin(fmax(factor, 0.2), rejected ? 1.0 : 8.0);
        rejected = 0;
        if (NS || ND) make_dense(x, s->y);
        if (NS) {
            double bad = 0.5, good = 0.0;
            event = beyond(i, x, s->y, t, h, 0.5, end, values);
            if (event < 0) {
                bad = 1.0;
                good = 0.5;
                event = beyond(i, x, s->y, t, h, 1.0, end, values);
            }
            if (event >= 0) {
                bad = locate(i, x, s->y, t, h, end, good, bad, &event, values);
                if (bad < 0.98 && bad * h > 1e-12 * s->span) {
                    /* Step again up to the switch itself: the dense output is less exact than the step. */
                    s->h = bad * h;
                    aim = event;
                    rejected = 1;
                    continue;
                }
                if (bad < 1.0) {
                    interpolate(x, s->y, bad, x->y_next);
                    end = t + bad * h;
                    last = 0;
                }
            } else if (aim >= 0 && fabs(values[aim]) <= 100.0 * s->slack[aim]) {
                event = aim; /* the step aimed at this switch and met it */
            }
            aim = -1;
        }
        Outcome outcome = remember(i, x, s->y, t, h, end);
        if (outcome != GOOD) return outcome;
        s->t = end;
        memcpy(s->y, x->y_next, sizeof s->y);
        fresh = 1;
        s->h = last && factor >= 1.0 ? fmax(s->h, h * factor) : h * factor;
        if (NS) note_switches(i, values);
        if (event < 0) continue;
        if ((outcome = cross(i, event)) != GOOD) return outcome;
        stop = fmin(stop, next_stop(i, stop));
        s->h = fmin(s->h, h);
    }
    return GOOD;
}

/* Brings the model to `end`; on failure s->t says where it stopped. */
Outcome integrate(Instance *i, double end) {
    State *s = &i->s;
    int budget = 200000;
    Outcome outcome = GOOD;
    Work *x = calloc(1, sizeof *x);
    if (!x) return NO_MEMORY;
    s->forced = 0;
    while (outcome == GOOD && s->t < end) {
        double echo = due_order(i, s->t), now = s->t + 1e-13 * fmax(1.0, fabs(s->t));
        int due = s->disturbed || !s->begun || echo >= 0.0;
        for (int k = 0; k < NQ; k++) due = due || s->tick[k] <= now || s->publish[k] <= now;
        if (due) {
            if ((outcome = event_update(i, s->disturbed ? 0.0 : echo)) != GOOD) break;
            s->h = first_step(i, s->h);
        }
        double stop = next_stop(i, end);
        s->from = s->t;
        s->until = next_stop(i, INFINITY);
        outcome = advance(i, x, stop, &budget);
        if (outcome != GOOD) break;
        /* The end of the segment, seen from before its jump. */
        outside(i, s->t);
#if ND
        Args a;
        double source[ND + NQ];
        arguments(i, &a);
        model_sources(&a, source);
        for (int k = 0; k < ND; k++) s->left[k] = source[k];
#endif
    }
    s->stale = 0;
    free(x);
    return outcome;
}
