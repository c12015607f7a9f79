/* The steady start: every derivative 0 for the inputs and parameters given, but for states with a start of their own. */
#include "internal.h"

/* The residual at v, with modes from the values; v is written to y and w. */
static void residual(Instance *i, const double *v, double *r) {
    Args a;
    arguments(i, &a);
    State *s = &i->s;
    for (int k = 0; k < NY; k++) s->y[k] = v[k];
    for (int k = 0; k < ND + NQ; k++) s->w[FIRST_DELAY + k] = v[NY + k];
    model_modes(&a, s->m);
    model_rest(&a, r);
}

static void jacobian(Instance *i, double *jac) {
    Args a;
    arguments(i, &a);
    memset(jac, 0, sizeof(double) * NV * NV);
    model_rest_jac(&a, jac);
}

static void weights(const double *jac, const double *v, double *weight) {
    for (int k = 0; k < NV; k++) {
        weight[k] = 0.0;
        for (int j = 0; j < NV; j++) weight[k] = fmax(weight[k], fabs(jac[k * NV + j]) * fmax(fabs(v[j]), 1e-3));
        if (!(weight[k] > 0.0)) weight[k] = 1.0;
    }
}

/* The largest scaled residual; which: its index. */
static double worst(const double *r, const double *weight, int *which) {
    double largest = 0.0;
    for (int k = 0; k < NV; k++) {
        double share = fabs(r[k]) / weight[k];
        if (!(share <= largest)) {
            largest = share;
            if (which) *which = k;
        }
    }
    return largest;
}

/* Newton's method from v; 1 where it converged. work: 2 NV NV + 4 NV doubles. */
static int newton(Instance *i, double *v, double *work) {
    double *jac = work, *matrix = jac + NV * NV, *r = matrix + NV * NV, *trial = r + NV, *delta = trial + NV;
    double *weight = delta + NV;
    int pivots[SOME(NV)], small = 0;
    residual(i, v, r);
    for (int iteration = 0; iteration < 80; iteration++) {
        jacobian(i, jac);
        weights(jac, v, weight);
        double norm = worst(r, weight, NULL), change = 0.0, damping = 1.0;
        if (!(norm < INFINITY)) return 0;
        memcpy(matrix, jac, sizeof(double) * NV * NV);
        memcpy(delta, r, sizeof(double) * NV);
        if (!factorise(matrix, pivots, NV)) return 0;
        back_substitute(matrix, pivots, delta, NV);
        for (int k = 0; k < NV; k++) {
            double share = fabs(delta[k]) / (fabs(v[k]) + 1e-3);
            if (!(share <= change)) change = share;
        }
        if (!(change < 1e12)) return 0;
        for (int half = 0; half < 12; half++) {
            for (int k = 0; k < NV; k++) trial[k] = v[k] - damping * delta[k];
            residual(i, trial, r);
            double after = worst(r, weight, NULL);
            if (after < norm || after < 1e-13 || (change < 1e-9 && after < INFINITY)) break;
            damping *= 0.5;
        }
        memcpy(v, trial, sizeof(double) * NV);
        if (damping == 1.0) small += change < 1e-13 ? 2 : change < 1e-10 ? 1 : 0;
        if (small >= 2) return 1;
    }
    return 0;
}

/* Implicit Euler steps whose length grows as the residual falls: follows the model to its rest; 1 where it is reached. */
static int pseudo_transient(Instance *i, double *v, double *work, int *which) {
    double *jac = work, *matrix = jac + NV * NV, *r = matrix + NV * NV, *trial = r + NV, *delta = trial + NV;
    double *weight = delta + NV;
    int pivots[SOME(NV)];
    double h = 1e-4, before;
    residual(i, v, r);
    jacobian(i, jac);
    weights(jac, v, weight);
    before = worst(r, weight, which);
    for (int step = 0; step < 400 && !(before < 1e-13); step++) {
        for (int k = 0; k < NV * NV; k++) matrix[k] = -jac[k];
        for (int k = 0; k < NX; k++) matrix[k * NV + k] += 1.0 / h;
        memcpy(delta, r, sizeof(double) * NV);
        if (!factorise(matrix, pivots, NV)) {
            h *= 0.3;
            continue;
        }
        back_substitute(matrix, pivots, delta, NV);
        for (int k = 0; k < NV; k++) trial[k] = v[k] + delta[k];
        residual(i, trial, r);
        double after = worst(r, weight, NULL);
        if (after < INFINITY && (after < 1.5 * before || h < 1e-9)) {
            memcpy(v, trial, sizeof(double) * NV);
            h = fmin(h * fmax(1.5, before / fmax(after, 1e-300)), 1e9);
        } else {
            h *= 0.2;
            if (h < 1e-12) break;
            residual(i, v, r);
        }
        jacobian(i, jac);
        weights(jac, v, weight);
        before = worst(r, weight, which);
    }
    residual(i, v, r);
    return worst(r, weight, which) < 1e-10;
}

/* Newton's method along a line from the exported model's own start, where the answer is known, to what is asked. */
static int follow(Instance *i, double *v, double *work) {
    State *s = &i->s;
    double p[SOME(NP)], u[SOME(NU)], good[SOME(NV)], share = 0.0, step = 0.25;
    for (int k = 0; k < NP; k++) p[k] = s->p[k];
    for (int k = 0; k < NU; k++) u[k] = s->w[1 + k];
    for (int k = 0; k < NV; k++) v[k] = good[k] = model_rest_values[k];
    while (share < 1.0 && step > 1e-4) {
        double next = fmin(1.0, share + step);
        for (int k = 0; k < NP; k++) s->p[k] = model_parameter_values[k] + next * (p[k] - model_parameter_values[k]);
        for (int k = 0; k < NU; k++) s->w[1 + k] = model_input_values[k] + next * (u[k] - model_input_values[k]);
        if (newton(i, v, work)) {
            share = next;
            step *= 2.0;
            memcpy(good, v, sizeof good);
        } else {
            step *= 0.5;
            memcpy(v, good, sizeof good);
        }
    }
    for (int k = 0; k < NP; k++) s->p[k] = p[k];
    for (int k = 0; k < NU; k++) s->w[1 + k] = u[k];
    return share >= 1.0;
}

/* Finds the start and sets up everything that remembers. */
Outcome find_start(Instance *i) {
    State *s = &i->s;
    double v[SOME(NV)], r[SOME(NV)];
    double *work = malloc(sizeof(double) * SOME(2 * NV * NV + 4 * NV));
    int which = 0, found;
    if (!work) return NO_MEMORY;
    Outcome outcome = take_timing(i);
    if (outcome != GOOD) {
        free(work);
        return outcome;
    }
    s->w[0] = s->t;
    for (int k = 0; k < NU; k++) s->w[1 + k] = s->u0[k];
    memset(s->wd, 0, sizeof s->wd);
    for (int k = 0; k < NV; k++) v[k] = k < NX ? s->given[k] : model_rest_values[k];
    found = NV == 0 || newton(i, v, work);
    if (!found) {
        memcpy(v, model_guesses, sizeof(double) * NV);
        found = pseudo_transient(i, v, work, &which);
    }
    if (!found) found = follow(i, v, work);
    if (found && NV) residual(i, v, r);
    free(work);
    if (!found) {
        say(i, "no steady state was found: %s is furthest from rest; check input levels, limits and parameters",
            model_rest_names[which]);
        return NO_START;
    }
    Args a;
    arguments(i, &a);
    model_modes(&a, s->m);
    outcome = consistent(i, 1);
    if (outcome != GOOD) return outcome;
    for (int k = 0; k < ND; k++) s->before[k] = s->left[k] = s->w[FIRST_DELAY + k];
    for (int k = 0; k < NQ; k++) {
        s->tick[k] = s->start;
        s->publish[k] = INFINITY;
        s->ticks[k] = s->pending[k] = 0.0;
    }
    s->steps = s->echoes = 0;
    s->h = 0.0;
    s->from = s->start;
    s->until = INFINITY;
    s->last_event = -INFINITY;
    s->last_switch = -1;
    s->chatter = s->forced = 0;
    s->t_kept = s->t;
    memcpy(s->y_kept, s->y, sizeof s->y);
    for (int k = 0; k < NU; k++) s->u_kept[k] = s->w[1 + k];
    double values[SOME(NS)];
    memset(s->top, 0, sizeof s->top);
    model_switches(&a, values);
    note_switches(i, values);
    s->stale = 0;
    s->begun = 0;
    s->disturbed = 1;
    return GOOD;
}
