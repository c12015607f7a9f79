/* One instance of the model: what an importer does to it, whatever the version of the standard. Functions return 1 or, with
   a message in the instance, 0. */
#include <stdarg.h>
#include <stdio.h>

#include "internal.h"

void say(Instance *i, const char *format, ...) {
    va_list list;
    va_start(list, format);
    vsnprintf(i->message, sizeof i->message, format, list);
    va_end(list);
}

/* 1 for a good outcome; else 0, with the reason as the instance's message. */
int explain(Instance *i, Outcome outcome) {
    static const char *reasons[] = {
        "", "too many steps: loosen the tolerance or look for a very fast part of the model",
        "a value grew without bound or left a function's domain", "a limit switches on and off without end",
        "the algebraic loop has no solution there"};
    if (outcome == GOOD) return 1;
    if (outcome == NO_MEMORY) say(i, "not enough memory");
    if (outcome <= INCONSISTENT) say(i, "t = %.9g s: %s", i->s.t, reasons[outcome]);
    return 0;
}

void reset(Instance *i) {
    State *s = &i->s;
    memset(s, 0, sizeof *s);
    s->phase = INSTANTIATED;
    s->span = 1.0;
    s->rtol = DEFAULT_TOLERANCE;
    s->atol = 0.01 * s->rtol;
    for (int k = 0; k < NP; k++) s->p[k] = model_parameter_values[k];
    for (int k = 0; k < NU; k++) s->u0[k] = s->w[1 + k] = model_input_values[k];
    for (int k = 0; k < NX; k++) s->given[k] = s->y[k] = model_rest_values[k];
    s->until = s->limit = INFINITY;
    s->stale = 1;
}

Instance *make(const char *name, const char *token, int cosimulation) {
    if (!token || strcmp(token, MODEL_TOKEN)) return NULL;
    Instance *i = calloc(1, sizeof *i);
    if (!i) return NULL;
    i->name = calloc(strlen(name ? name : "") + 1, 1);
    if (!i->name) {
        free(i);
        return NULL;
    }
    if (name) strcpy(i->name, name);
    i->cosimulation = cosimulation;
    reset(i);
    return i;
}

void discard(Instance *i) {
    if (!i) return;
    free(i->history);
    free(i->echo);
    free(i->name);
    free(i);
}

void begin(Instance *i, double start, int has_stop, double stop, int has_tolerance, double tolerance) {
    State *s = &i->s;
    s->start = s->t = start;
    for (int k = 0; k < NU; k++) s->t_input[k] = start;
    s->span = has_stop && stop > start ? stop - start : 1.0;
    if (has_tolerance && tolerance > 0.0) {
        s->rtol = fmax(tolerance, 1e-13);
        s->atol = 0.01 * s->rtol;
    }
}

/* Brings everything up to date with what was set: the start during initialisation, the unknowns later. */
static int current(Instance *i) {
    State *s = &i->s;
    if (!s->stale) return 1;
    return explain(i, s->phase == INITIALIZATION ? find_start(i) : refresh(i));
}

int finish_start(Instance *i) {
    if (!current(i)) return 0;
    i->s.phase = i->cosimulation ? STEP : EVENT;
    return 1;
}

int get_rates(Instance *i, double *values) {
    Args a;
    double r[SOME(NY)];
    if (!current(i)) return 0;
    arguments(i, &a);
    model_f(&a, r);
    for (int k = 0; k < NX; k++) {
        if (!isfinite(r[k])) {
            say(i, "t = %.9g s: the derivative of '%s' is not finite", i->s.t, model_rest_names[k]);
            return 0;
        }
        values[k] = r[k];
    }
    return 1;
}

/* Switch values moved away from 0 by their slack, so that a located crossing is not found again at once. */
int get_indicators(Instance *i, double *values) {
    Args a;
    if (!current(i)) return 0;
    arguments(i, &a);
    model_switches(&a, values);
    for (int k = 0; k < NS; k++) values[k] += i->s.m[k] > 0.5 ? -i->s.slack[k] : i->s.slack[k];
    return 1;
}

static int read_values(Instance *i, const unsigned int *refs, size_t n, double *values) {
    State *s = &i->s;
    Args a;
    double rate[SOME(NX)], output[SOME(NO)], indicator[SOME(NS)];
    int has_rates = 0, has_outputs = 0, has_indicators = 0;
    arguments(i, &a);
    for (size_t k = 0; k < n; k++) {
        unsigned int r = refs[k];
        if (r >= REF_END) {
            say(i, "no variable has the value reference %u", r);
            return 0;
        }
        if (r >= REF_PARAMETER && r < REF_INDICATOR) {
            values[k] = s->p[r - REF_PARAMETER];
        } else if (r == REF_TIME) {
            values[k] = s->t;
        } else if (s->phase == INSTANTIATED && r >= REF_STATE) {
            if (r >= REF_RATE) {
                say(i, "value reference %u is not known before initialisation", r);
                return 0;
            }
            values[k] = s->given[r - REF_STATE];
        } else if (r < REF_STATE) {
            int q = (int)r - REF_INPUT;
            values[k] = s->u0[q] + s->slope[q] * (s->t - s->t_input[q]);
        } else if (!current(i)) {
            return 0;
        } else if (r < REF_RATE) {
            values[k] = s->y[r - REF_STATE];
        } else if (r < REF_OUTPUT) {
            if (!has_rates && !(has_rates = get_rates(i, rate))) return 0;
            values[k] = rate[r - REF_RATE];
        } else if (r < REF_PARAMETER) {
            if (!has_outputs) model_outputs(&a, output);
            has_outputs = 1;
            values[k] = output[r - REF_OUTPUT];
        } else {
            if (!has_indicators && !(has_indicators = get_indicators(i, indicator))) return 0;
            values[k] = indicator[r - REF_INDICATOR];
        }
    }
    return 1;
}

/* Whether a delayed jump arrives, or a sample is taken or published, at this communication point. */
static int something_due(const Instance *i) {
    const State *s = &i->s;
    double now = s->t + 1e-13 * fmax(1.0, fabs(s->t)); /* rounding alone may keep a point off it */
    for (size_t k = 0; k < s->echoes; k++)
        if (i->echo[2 * k] <= now) return 1;
    for (int k = 0; k < NQ; k++)
        if (s->tick[k] <= now || s->publish[k] <= now) return 1;
    return 0;
}

/* Outputs at a communication point are those after what happens there. It is done for the reader alone and undone: the next
   step does it, for inputs may still be set before. Tables only grow in an event, so the state holds all there is to undo. */
int get_values(Instance *i, const unsigned int *refs, size_t n, double *values) {
    if (i->s.phase != STEP || !something_due(i)) return read_values(i, refs, n, values);
    State *kept = malloc(sizeof *kept);
    if (!kept) return explain(i, NO_MEMORY);
    *kept = i->s;
    int good = explain(i, event_update(i, 0.0)) && read_values(i, refs, n, values);
    i->s = *kept;
    free(kept);
    return good;
}

static int set_input(Instance *i, int k, double value) {
    State *s = &i->s;
    double now = s->u0[k] + s->slope[k] * (s->t - s->t_input[k]);
    if (fabs(value - now) <= (s->slope[k] != 0.0 ? 1e-13 * fmax(1.0, fabs(value)) : 0.0)) return 1;
    s->u0[k] = value;
    s->t_input[k] = s->t;
    s->stale = 1;
    if (s->phase != CONTINUOUS) s->disturbed = 1;
    return 1;
}

static int set_parameter(Instance *i, int k, double value) {
    State *s = &i->s;
    if (s->p[k] == value) return 1;
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

int set_values(Instance *i, const unsigned int *refs, size_t n, const double *values) {
    State *s = &i->s;
    for (size_t k = 0; k < n; k++) {
        unsigned int r = refs[k];
        if (!isfinite(values[k])) {
            say(i, "the value for value reference %u is not finite", r);
            return 0;
        }
        if (r >= REF_INPUT && r < REF_STATE) {
            if (!set_input(i, (int)r - REF_INPUT, values[k])) return 0;
        } else if (r >= REF_PARAMETER && r < REF_INDICATOR) {
            if (!set_parameter(i, (int)r - REF_PARAMETER, values[k])) return 0;
        } else if (r >= REF_STATE && r < REF_RATE && s->phase <= INITIALIZATION && model_state_searched[r - REF_STATE]) {
            s->given[r - REF_STATE] = values[k];
            s->stale = 1;
        } else {
            say(i, "the variable with value reference %u cannot be set now", r);
            return 0;
        }
    }
    return 1;
}

int set_time(Instance *i, double t) {
    if (t != i->s.t) i->s.stale = 1;
    i->s.t = t;
    return 1;
}

int set_states(Instance *i, const double *values) {
    State *s = &i->s;
    for (int k = 0; k < NX; k++) {
        if (!isfinite(values[k])) {
            say(i, "t = %.9g s: the value for state '%s' is not finite", s->t, model_rest_names[k]);
            return 0;
        }
        if (s->y[k] != values[k]) s->stale = 1;
        s->y[k] = values[k];
    }
    return 1;
}

int set_slope(Instance *i, unsigned int ref, double slope) {
    State *s = &i->s;
    if (ref < REF_INPUT || ref >= REF_STATE || !isfinite(slope)) {
        say(i, "value reference %u is no input, or its slope is not finite", ref);
        return 0;
    }
    int k = (int)ref - REF_INPUT;
    s->slope_given[k] = 1;
    if (s->slope[k] == slope) return 1;
    s->u0[k] += s->slope[k] * (s->t - s->t_input[k]);
    s->t_input[k] = s->t;
    s->slope[k] = slope;
    s->disturbed = s->stale = 1;
    return 1;
}

int directional_by_reference(Instance *i, const unsigned int *unknown, size_t nu, const unsigned int *known, size_t nk,
                             const double *seed, double *result) {
    double dy[SOME(NX)] = {0}, du[SOME(NU)] = {0}, dp[SOME(NP)] = {0};
    double rate[SOME(NX)], output[SOME(NO)], indicator[SOME(NS)], state[SOME(NX)];
    if (!current(i)) return 0;
    for (size_t k = 0; k < nk; k++) {
        unsigned int r = known[k];
        if (r >= REF_INPUT && r < REF_STATE) {
            du[r - REF_INPUT] += seed[k];
        } else if (r >= REF_STATE && r < REF_RATE && i->s.phase != INITIALIZATION) {
            dy[r - REF_STATE] += seed[k];
        } else if (r >= REF_PARAMETER && r < REF_INDICATOR) {
            dp[r - REF_PARAMETER] += seed[k];
        } else {
            say(i, "value reference %u is no known of a derivative in this mode", r);
            return 0;
        }
    }
    if (!directional(i, dy, du, dp, rate, output, indicator, state)) {
        say(i, "t = %.9g s: the derivative does not exist, for a matrix is singular", i->s.t);
        return 0;
    }
    for (size_t k = 0; k < nu; k++) {
        unsigned int r = unknown[k];
        if (r >= REF_STATE && r < REF_RATE)
            result[k] = state[r - REF_STATE];
        else if (r >= REF_RATE && r < REF_OUTPUT)
            result[k] = rate[r - REF_RATE];
        else if (r >= REF_OUTPUT && r < REF_PARAMETER)
            result[k] = output[r - REF_OUTPUT];
        else if (r >= REF_INDICATOR && r < REF_END)
            result[k] = indicator[r - REF_INDICATOR];
        else {
            say(i, "value reference %u is no unknown of a derivative", r);
            return 0;
        }
    }
    return 1;
}

/* Model exchange: the event iteration, which always settles at once. */
int update_events(Instance *i, int *has_next, double *next) {
    State *s = &i->s;
    double modes[SOME(NS)], echo = due_order(i, s->t + 1e-13 * fmax(1.0, fabs(s->t))), order = echo;
    int only_limit = s->begun && !s->disturbed && echo < 0.0 && s->t >= s->limit;
    memcpy(modes, s->m, sizeof modes);
    if (!only_limit) order = s->disturbed ? 0.0 : fmax(echo, 0.0);
    if (!explain(i, event_update(i, order))) return 0;
    if (only_limit && memcmp(modes, s->m, sizeof modes))
        for (int k = 0; k < ND; k++)
            if (!explain(i, keep_echo(i, s->t + s->timing[k], 1.0))) return 0;
    *next = s->until;
    s->limit = INFINITY;
    for (int k = 0; k < ND; k++) s->limit = fmin(s->limit, s->t + s->timing[k]);
    *next = fmin(*next, s->limit);
    *has_next = *next < INFINITY;
    return 1;
}

int leave_event_mode(Instance *i) {
    State *s = &i->s;
    if (!current(i)) return 0;
    s->t_kept = s->t;
    memcpy(s->y_kept, s->y, sizeof s->y);
    for (int k = 0; k < NU; k++) s->u_kept[k] = s->w[1 + k];
    s->phase = CONTINUOUS;
    return 1;
}

int complete_step(Instance *i) { return explain(i, keep_step(i)); }

/* Co-simulation: from the communication point t on for h. */
int do_step(Instance *i, double t, double h) {
    State *s = &i->s;
    if (!(h > 0.0) || !isfinite(h) || !(fabs(t - s->t) <= 1e-9 * fmax(fmax(1.0, fabs(t)), s->span))) {
        say(i, "a step from %.9g s of %g s cannot be done: the last one ended at %.9g s", t, h, s->t);
        return 0;
    }
    s->t = t;
    for (int k = 0; k < NU; k++)
        if (s->slope[k] != 0.0 && !s->slope_given[k]) set_slope(i, REF_INPUT + (unsigned)k, 0.0);
    Outcome outcome = integrate(i, t + h);
    for (int k = 0; k < NU; k++) s->slope_given[k] = 0;
    return explain(i, outcome);
}
