/* The steady start: every derivative 0 for the inputs and parameters given, but for states with a start of their own. */
#include "internal.h"

/* The steady-state equations, with a run's own vectors and the parameters p. */
static steady at_rest(Instance *i, double *p)
{
    run *r = &i->r;
    steady e = {.modes = model_modes, .rest = model_rest, .rest_jac = model_rest_jac, .nx = NX, .inner = NY, .first = FIRST_DELAY,
                .n = NV, .ns = NS, .np = NP, .nw = FIRST_DELAY, .y = r->y, .w = r->w, .wd = r->wd, .p = p, .m = r->m};
    return e;
}

/* Newton's method from v; true where it finds a steady state, which then stands in the run's y and w. sign: of the determinant. */
static bool newton_from(const steady *e, const double *v, double *sign)
{
    double rule[2] = {INFINITY, 0.0};
    copy(e->y, v, NY);
    copy(e->w + FIRST_DELAY, v + NY, ND + NQ);
    bool found = hvdc_ident_newton(e, rule) > 0;
    *sign = rule[1];
    return found;
}

/* Follow the steady state from the exported model's own values, where it is known, to what is asked. */
static bool follow(Instance *i, double *v, double *sign)
{
    double p[SOME(2 * NP)], w[2 * FIRST_DELAY], own[SOME(NP)], way[2];
    steady e = at_rest(i, own);
    for (int k = 0; k < NP; k++) {
        p[k] = own[k] = model_parameter_values[k];
        p[NP + k] = i->s.p[k];
    }
    for (int k = 0; k < FIRST_DELAY; k++) {
        w[k] = k ? model_input_values[k - 1] : i->r.w[0];
        w[FIRST_DELAY + k] = i->r.w[k];
    }
    copy(e.w, w, FIRST_DELAY);
    if (newton_from(&e, model_rest_values, sign)) {
        copy(v, e.y, NY);
        copy(v + NY, e.w + FIRST_DELAY, ND + NQ);
        way[0] = *sign;
        hvdc_ident_continuation(&e, p, w, v, way);
    }
    copy(e.w, w + FIRST_DELAY, FIRST_DELAY);
    e.p = i->s.p;
    return newton_from(&e, v, sign);
}

/* Say which equation is furthest from rest at v. */
static void say_furthest(Instance *i, const steady *e, const double *size, const double *v)
{
    double *jac = calloc(SOME(NV * NV), sizeof(double)), r[SOME(NV)], weight[SOME(NV)], worst = 0.0;
    int which = 0;
    if (jac)
        hvdc_ident_judge(e, size, v, r, jac, weight);
    for (int k = 0; jac && k < NV; k++)
        if (!(fabs(r[k]) / weight[k] <= worst)) {
            worst = fabs(r[k]) / weight[k];
            which = k;
        }
    free(jac);
    say(i, "no steady state was found: %s is furthest from rest; check input levels, limits and parameters",
        model_rest_names[which]);
}

/* Find a steady state: from where the states are said to be, by following the model, and from the model's own one. */
static int find_rest(Instance *i)
{
    double v[SOME(NV)], size[SOME(NV)], sign;
    steady e = at_rest(i, i->s.p);
    for (int k = 0; k < NV; k++) {
        v[k] = k < NX ? i->s.given[k] : model_rest_values[k];
        size[k] = INFINITY;
    }
    if (NV == 0 || newton_from(&e, v, &sign))
        return 1;
    copy(v, model_guesses, NV);
    if (hvdc_ident_pseudo_transient(&e, size, v) > 0 && newton_from(&e, v, &sign))
        return 1;
    if (follow(i, v, &sign))
        return 1;
    copy(v, model_guesses, NV);
    if (hvdc_ident_implicit_euler(&e, size, v) > 0 && newton_from(&e, v, &sign))
        return 1;
    say_furthest(i, &e, size, v);
    return 0;
}

/* Compute delay times, sampling periods and compute times from the parameters. */
static int take_timing(Instance *i)
{
    run *r = &i->r;
    double *timing = i->s.timing;
    evaluate(r, model_const, r->y, timing);
    for (int k = 0; k < ND + NQ; k++)
        if (!(timing[k] > 0.0 && timing[k] < INFINITY)) {
            say(i, "%s '%s' is %g s; it has to be above 0", k < ND ? "the delay" : "the sampling period of",
                model_memory_names[k], timing[k]);
            return 0;
        }
    for (int k = 0; k < NQ; k++) {
        double compute = timing[ND + NQ + k];
        if (!(compute >= 0.0 && compute <= timing[ND + k])) {
            say(i, "the compute time of '%s' is %g s; it has to lie between 0 and its period, %g s",
                model_memory_names[ND + k], compute, timing[ND + k]);
            return 0;
        }
    }
    return 1;
}

/* Find the start, and begin the run there. */
static int find_start(Instance *i)
{
    State *s = &i->s;
    run *r = &i->r;
    double span = r->span;
    if (!take_timing(i))
        return 0;
    r->w[0] = r->t = r->start;
    for (int k = 0; k < NU; k++)
        r->w[1 + k] = s->u0[k];
    for (int k = 0; k < NW; k++)
        r->wd[k] = 0.0;
    if (!find_rest(i))
        return 0;
    if (!consistent(r, true))
        return explain(i, INCONSISTENT);
    r->h = 0.0;
    r->kept = r->echoes = r->chatter = 0;
    r->echo_now = r->disturbed = r->published = 0;
    for (int k = 0; k < NQ; k++)
        r->ticks[k] = r->pending[k] = 0.0;
    begin_run(r, r->y, r->w);
    r->span = span;
    s->from = r->start;
    end_history(i);
    for (int k = 0; k < NS; k++)
        r->top[k] = 0.0;
    evaluate(r, model_sw, r->y, r->sv);
    widen(r);
    s->stale = 0;
    s->disturbed = 1;
    return 1;
}

static int finish_start(Instance *i)
{
    if (!current(i))
        return 0;
    i->s.phase = i->cosimulation ? STEP : EVENT;
    return 1;
}
