/* Values by reference: what an importer reads, sets and asks the derivatives of. Functions return 1 or, with a message, 0. */
#include "internal.h"

static int get_rates(Instance *i, double *values)
{
    run *r = &i->r;
    if (!current(i))
        return 0;
    evaluate(r, r->do_f, r->y, r->e);
    for (int k = 0; k < NX; k++) {
        if (!isfinite(r->e[k])) {
            say(i, "t = %.9g s: the derivative of '%s' is not finite", r->t, model_rest_names[k]);
            return 0;
        }
        values[k] = r->e[k];
    }
    return 1;
}

/* Switch values moved away from 0 by their slack, so that a located crossing is not found again at once. */
static int get_indicators(Instance *i, double *values)
{
    run *r = &i->r;
    if (!current(i))
        return 0;
    evaluate(r, r->do_sw, r->y, values);
    for (int k = 0; k < NS; k++)
        values[k] += r->m[k] > 0.5 ? -r->slack[k] : r->slack[k];
    return 1;
}

static int read_values(Instance *i, const unsigned int *refs, size_t n, double *values)
{
    const State *s = &i->s;
    run *r = &i->r;
    double rate[SOME(NX)], output[SOME(NO)], indicator[SOME(NS)];
    int has_rates = 0, has_outputs = 0, has_indicators = 0;
    for (size_t k = 0; k < n; k++) {
        unsigned int ref = refs[k];
        if (ref >= REF_END) {
            say(i, "no variable has the value reference %u", ref);
            return 0;
        }
        if (ref >= REF_PARAMETER && ref < REF_INDICATOR) {
            values[k] = s->p[ref - REF_PARAMETER];
        } else if (ref == REF_TIME) {
            values[k] = r->t;
        } else if (s->phase == INSTANTIATED && ref >= REF_STATE) {
            if (ref >= REF_RATE) {
                say(i, "value reference %u is not known before initialisation", ref);
                return 0;
            }
            values[k] = s->given[ref - REF_STATE];
        } else if (ref < REF_STATE) {
            values[k] = input_now(s, (int)ref - REF_INPUT, r->t);
        } else if (!current(i)) {
            return 0;
        } else if (ref < REF_RATE) {
            values[k] = r->y[ref - REF_STATE];
        } else if (ref < REF_OUTPUT) {
            if (!has_rates && !(has_rates = get_rates(i, rate)))
                return 0;
            values[k] = rate[ref - REF_RATE];
        } else if (ref < REF_PARAMETER) {
            if (!has_outputs)
                evaluate(r, r->do_out, r->y, output);
            has_outputs = 1;
            values[k] = output[ref - REF_OUTPUT];
        } else {
            if (!has_indicators && !(has_indicators = get_indicators(i, indicator)))
                return 0;
            values[k] = indicator[ref - REF_INDICATOR];
        }
    }
    return 1;
}

/* Outputs at a communication point are those after what happens there. It is done for the reader alone and undone: the next
   step does it, for inputs may still be set before. Tables only grow in an event, so all else is all there is to undo. */
static int get_by_reference(Instance *i, const unsigned int *refs, size_t n, double *values)
{
    if (i->s.phase != STEP || !is_due(i))
        return read_values(i, refs, n, values);
    double *kept = malloc(i->doubles * sizeof(double));
    if (!kept || !make_rooms(&i->r)) {
        free(kept);
        return explain(i, OUT_OF_MEMORY);
    }
    State s = i->s;
    run r = i->r;
    memcpy(kept, i->work, i->doubles * sizeof(double));
    int good = pass_event(i) && read_values(i, refs, n, values);
    i->s = s;
    i->r = r;
    memcpy(i->work, kept, i->doubles * sizeof(double));
    free(kept);
    return good;
}

static int set_input(Instance *i, int k, double value)
{
    State *s = &i->s;
    double change = fabs(value - input_now(s, k, i->r.t));
    if (change <= (s->slope[k] != 0.0 ? rounding(value) : 0.0))
        return 1;
    s->u0[k] = value;
    s->t_input[k] = i->r.t;
    s->stale = 1;
    if (s->phase != CONTINUOUS)
        s->disturbed = 1;
    return 1;
}

static int set_parameter(Instance *i, int k, double value)
{
    State *s = &i->s;
    if (s->p[k] == value)
        return 1;
    if (model_parameter_fixed[k] && s->phase > INITIALIZATION) {
        say(i, "the parameter with value reference %d is fixed after initialisation", REF_PARAMETER + k);
        return 0;
    }
    if (s->phase == CONTINUOUS) {
        say(i, "a parameter cannot change in continuous-time mode; enter event mode first");
        return 0;
    }
    s->p[k] = value;
    s->stale = s->disturbed = 1;
    return 1;
}

static int set_by_reference(Instance *i, const unsigned int *refs, size_t n, const double *values)
{
    State *s = &i->s;
    for (size_t k = 0; k < n; k++) {
        unsigned int ref = refs[k];
        if (!isfinite(values[k])) {
            say(i, "the value for value reference %u is not finite", ref);
            return 0;
        }
        if (ref >= REF_INPUT && ref < REF_STATE) {
            if (!set_input(i, (int)ref - REF_INPUT, values[k]))
                return 0;
        } else if (ref >= REF_PARAMETER && ref < REF_INDICATOR) {
            if (!set_parameter(i, (int)ref - REF_PARAMETER, values[k]))
                return 0;
        } else if (ref >= REF_STATE && ref < REF_RATE && s->phase <= INITIALIZATION && model_state_searched[ref - REF_STATE]) {
            s->given[ref - REF_STATE] = values[k];
            s->stale = 1;
        } else {
            say(i, "the variable with value reference %u cannot be set now", ref);
            return 0;
        }
    }
    return 1;
}

static int set_time(Instance *i, double t)
{
    if (t != i->r.t)
        i->s.stale = 1;
    i->r.t = t;
    return 1;
}

static int set_states(Instance *i, const double *values)
{
    double *y = i->r.y;
    for (int k = 0; k < NX; k++) {
        if (!isfinite(values[k])) {
            say(i, "t = %.9g s: the value for state '%s' is not finite", i->r.t, model_rest_names[k]);
            return 0;
        }
        if (y[k] != values[k])
            i->s.stale = 1;
        y[k] = values[k];
    }
    return 1;
}

/* --- directional derivatives --- */

/* Derivatives along a direction of states, inputs and parameters. */
typedef struct {
    double states[SOME(NX)], rates_outputs_switches[SOME(NY + NO + NS)];
} Derivatives;

/* Differentiate along dx: states, du: inputs, dp: parameters, through the algebraic unknowns and, during initialisation, through the
   steady start: dx is not read then, for the states follow from the others. False where a matrix is singular. */
static bool differentiate(const Instance *i, const double *dx, const double *du, const double *dp, Derivatives *found)
{
    const run *r = &i->r;
    double p[SOME(2 * NP)], y[SOME(NY)] = {0}, w[NW] = {0}, *out = found->rates_outputs_switches;
    double matrix[SOME(NV * NV)], b[SOME(NV)];
    integer pivots[SOME(NV)];
    copy(p, r->p, NP);
    copy(p + NP, dp, NP);
    copy(w + 1, du, NU);
    memset(matrix, 0, sizeof matrix);
    if (i->s.phase == INITIALIZATION) {
        model_rest_jac(r->y, y, r->w, w, p, r->m, matrix);
        model_rest_tangent(r->y, y, r->w, w, p, r->m, b);
        if (!lu(matrix, pivots, NV))
            return false;
        solve(matrix, pivots, b, NV);
        for (int k = 0; k < NY; k++)
            y[k] = -b[k];
        for (int k = 0; k < ND + NQ; k++)
            w[FIRST_DELAY + k] = -b[NY + k];
    } else {
        copy(y, dx, NX);
        model_tangent(r->y, y, r->w, w, p, r->m, out);
        for (int k = 0; k < NY * NY; k++)
            r->jac[k] = 0.0;
        model_jac(r->y, y, r->w, w, p, r->m, r->jac);
        for (int k = 0; k < NZ; k++)
            for (int j = 0; j < NZ; j++)
                matrix[k * NZ + j] = r->jac[(NX + k) * NY + NX + j];
        if (!lu(matrix, pivots, NZ))
            return false;
        solve(matrix, pivots, out + NX, NZ);
        for (int k = 0; k < NZ; k++)
            y[NX + k] = -out[NX + k];
    }
    model_tangent(r->y, y, r->w, w, p, r->m, out);
    copy(found->states, y, NX);
    return true;
}

static int directional_by_reference(Instance *i, const unsigned int *unknown, size_t nu, const unsigned int *known, size_t nk,
                                    const double *seed, double *result)
{
    double dx[SOME(NX)] = {0}, du[SOME(NU)] = {0}, dp[SOME(NP)] = {0};
    Derivatives found;
    if (!current(i))
        return 0;
    if (i->r.sliding != NONE) {
        say(i, "t = %.9g s: a model that slides along a limit has no directional derivative", i->r.t);
        return 0;
    }
    for (size_t k = 0; k < nk; k++) {
        unsigned int ref = known[k];
        if (ref >= REF_INPUT && ref < REF_STATE) {
            du[ref - REF_INPUT] += seed[k];
        } else if (ref >= REF_STATE && ref < REF_RATE && i->s.phase != INITIALIZATION) {
            dx[ref - REF_STATE] += seed[k];
        } else if (ref >= REF_PARAMETER && ref < REF_INDICATOR) {
            dp[ref - REF_PARAMETER] += seed[k];
        } else {
            say(i, "value reference %u is no known of a derivative in this mode", ref);
            return 0;
        }
    }
    if (!differentiate(i, dx, du, dp, &found)) {
        say(i, "t = %.9g s: the derivative does not exist, for a matrix is singular", i->r.t);
        return 0;
    }
    const double *of_rates = found.rates_outputs_switches;
    for (size_t k = 0; k < nu; k++) {
        unsigned int ref = unknown[k];
        if (ref >= REF_STATE && ref < REF_RATE) {
            result[k] = found.states[ref - REF_STATE];
        } else if (ref >= REF_RATE && ref < REF_OUTPUT) {
            result[k] = of_rates[ref - REF_RATE];
        } else if (ref >= REF_OUTPUT && ref < REF_PARAMETER) {
            result[k] = of_rates[NY + ref - REF_OUTPUT];
        } else if (ref >= REF_INDICATOR && ref < REF_END) {
            result[k] = of_rates[NY + NO + ref - REF_INDICATOR];
        } else {
            say(i, "value reference %u is no unknown of a derivative", ref);
            return 0;
        }
    }
    return 1;
}
