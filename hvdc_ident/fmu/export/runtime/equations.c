/* The equations at an instant: what comes from outside, the algebraic unknowns, the rates, the switches. */
#include "internal.h"

void arguments(const Instance *i, Args *a) {
    const State *s = &i->s;
    a->y = s->y;
    a->yd = s->yd;
    a->w = s->w;
    a->wd = s->wd;
    a->p = s->p;
    a->dp = s->p;
    a->m = s->m;
}

#if ND
static void delayed(Instance *i, double t) {
    State *s = &i->s;
    double inside = 1e-13 * fmax(1.0, fabs(s->until < INFINITY ? s->until : t));
    double at = fmin(fmax(t, s->from + inside), s->until - inside);
    for (int k = 0; k < ND; k++) {
        double when = at - s->timing[k];
        if (s->steps == 0 || when <= s->start) {
            s->w[FIRST_DELAY + k] = s->before[k];
            s->wd[FIRST_DELAY + k] = 0.0;
            continue;
        }
        size_t low = 0, high = s->steps - 1;
        while (low < high) {
            size_t middle = (low + high + 1) / 2;
            if (i->history[middle * HISTORY_ROW] <= when)
                low = middle;
            else
                high = middle - 1;
        }
        const double *row = i->history + low * HISTORY_ROW, *c = row + 2 + NODES * k;
        double x = (when - row[0]) / row[1];
        s->w[FIRST_DELAY + k] = c[0] + x * (c[1] + x * (c[2] + x * (c[3] + x * c[4])));
        s->wd[FIRST_DELAY + k] = (c[1] + x * (2 * c[2] + x * (3 * c[3] + x * 4 * c[4]))) / row[1];
    }
}
#endif

/* Writes time, inputs and delayed signals at t, with their slopes. */
void outside(Instance *i, double t) {
    State *s = &i->s;
    s->w[0] = t;
    s->wd[0] = 1.0;
    for (int k = 0; k < NU; k++) {
        s->w[1 + k] = s->u0[k] + s->slope[k] * (t - s->t_input[k]);
        s->wd[1 + k] = s->slope[k];
    }
#if ND
    delayed(i, t);
#endif
}

/* Solves the unknowns for the present states by Newton's method; live: modes follow the values. */
Outcome consistent(Instance *i, int live) {
    Args a;
    arguments(i, &a);
    State *s = &i->s;
    if (live) model_modes(&a, s->m);
#if NZ
    double r[NY], jac[NY * NY], small[NZ * NZ];
    int pivots[NZ], converged = 0;
    double largest = INFINITY;
    memset(jac, 0, sizeof jac);
    for (int iteration = 0; iteration < 60; iteration++) {
        model_f(&a, r);
        model_jac(&a, jac);
        for (int k = 0; k < NZ; k++)
            for (int j = 0; j < NZ; j++) small[k * NZ + j] = jac[(NX + k) * NY + NX + j];
        if (!factorise(small, pivots, NZ)) return INCONSISTENT;
        back_substitute(small, pivots, r + NX, NZ);
        double damping = iteration < 20 ? 1.0 : 0.5;
        largest = 0.0;
        for (int k = 0; k < NZ; k++) {
            s->y[NX + k] -= damping * r[NX + k];
            double share = fabs(r[NX + k]) / (1.0 + fabs(s->y[NX + k]));
            if (!(share <= largest)) largest = share;
        }
        if (!(largest < INFINITY)) return INCONSISTENT;
        if (live) model_modes(&a, s->m);
        if (largest < 1e-14 || (converged && largest < 1e-12)) break;
        converged = largest < 1e-12;
    }
    if (!(largest < 1e-10)) return INCONSISTENT;
#endif
    return GOOD;
}

/* Brings the unknowns up to what was set since; modes are free to change only where an event may happen. */
Outcome refresh(Instance *i) {
    State *s = &i->s;
    if (!s->stale) return GOOD;
    outside(i, s->t);
    Outcome outcome = consistent(i, s->phase != CONTINUOUS);
    if (outcome == GOOD) s->stale = 0;
    return outcome;
}

/* Writes the rates of states and unknowns into yd, for values that are consistent. */
Outcome rates(Instance *i) {
    Args a;
    arguments(i, &a);
    State *s = &i->s;
    double r[SOME(NY)];
    model_f(&a, r);
    for (int k = 0; k < NX; k++) s->yd[k] = r[k];
#if NZ
    double jac[NY * NY], small[NZ * NZ];
    int pivots[NZ];
    memset(jac, 0, sizeof jac);
    model_jac(&a, jac);
    model_ft(&a, r);
    for (int k = 0; k < NZ; k++) {
        double total = -r[NX + k];
        for (int j = 0; j < NX; j++) total -= jac[(NX + k) * NY + j] * s->yd[j];
        r[NX + k] = total;
        for (int j = 0; j < NZ; j++) small[k * NZ + j] = jac[(NX + k) * NY + NX + j];
    }
    if (!factorise(small, pivots, NZ)) return INCONSISTENT;
    back_substitute(small, pivots, r + NX, NZ);
    for (int k = 0; k < NZ; k++) s->yd[NX + k] = r[NX + k];
#endif
    return GOOD;
}

/* Computes delay times, sampling periods and compute times from the parameters. */
Outcome take_timing(Instance *i) {
#if ND + NQ
    Args a;
    arguments(i, &a);
    State *s = &i->s;
    model_timing(&a, s->timing);
    for (int k = 0; k < ND + NQ; k++)
        if (!(s->timing[k] > 0.0 && s->timing[k] < INFINITY)) {
            say(i, "%s '%s' is %g s; it has to be above 0", k < ND ? "the delay" : "the sampling period of",
                model_memory_names[k], s->timing[k]);
            return BAD_TIMING;
        }
    for (int k = 0; k < NQ; k++) {
        double compute = s->timing[ND + NQ + k];
        if (!(compute >= 0.0 && compute <= s->timing[ND + k])) {
            say(i, "the compute time of '%s' is %g s; it has to lie between 0 and its period, %g s",
                model_memory_names[ND + k], compute, s->timing[ND + k]);
            return BAD_TIMING;
        }
    }
#else
    (void)i;
#endif
    return GOOD;
}

/* The switch that is furthest beyond its mode, or -1. */
int violation(const Instance *i, const double *values) {
    double worst = 0.0;
    int which = -1;
    for (int k = 0; k < NS; k++) {
        double over = (i->s.m[k] > 0.5 ? values[k] : -values[k]) - i->s.slack[k];
        if (over > worst) {
            worst = over;
            which = k;
        }
    }
    return which;
}

/* Takes each switch's size into account for how far it may pass 0 before it counts. */
void note_switches(Instance *i, const double *values) {
    State *s = &i->s;
    double share = i->cosimulation ? 0.01 * s->rtol : 1e-10;
    for (int k = 0; k < NS; k++) {
        if (fabs(values[k]) < INFINITY && fabs(values[k]) > s->top[k]) s->top[k] = fabs(values[k]);
        s->slack[k] = share * s->top[k] + 1e-14;
    }
}
