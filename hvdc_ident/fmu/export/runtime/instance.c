/* An instance: what it is made of, and its equations at an instant. Functions return 1 or, with a message in the instance, 0. */
#include "internal.h"

static void say(Instance *i, const char *format, ...)
{
    va_list list;
    va_start(list, format);
    vsnprintf(i->message, sizeof i->message, format, list);
    va_end(list);
}

/* 1 for a run that goes on; else 0, with the reason as the instance's message.

   A slide that is not among the model's equations, and one on two surfaces, end a run as chattering does. */
static int explain(Instance *i, enum status status)
{
    static const char chatters[] = "a limit switches on and off without end";
    static const char *const reasons[] = {
        [STEP_LIMIT] = "too many steps: loosen the tolerance or look for a very fast part of the model",
        [NOT_FINITE] = "a value grew without bound or left a function's domain",
        [CHATTER] = chatters, [SLIDING] = chatters, [TWO_SLIDES] = chatters,
        [INCONSISTENT] = "the algebraic loop has no solution there",
        [OUT_OF_MEMORY] = "not enough memory"};
    if (status == CONVERGED)
        return 1;
    say(i, "t = %.9g s: %s", i->r.t, reasons[status]);
    return 0;
}

/* Give every vector of a run its place in the workspace, with room for the largest equations; returns how many doubles they take. */
static size_t place(run *r, double *work)
{
#define LARGEST(name) r->name = 0; for (int k = 0; k <= NS; k++) if (model_heads[k].name > r->name) r->name = model_heads[k].name;
    SIZES(LARGEST)
#undef LARGEST
    return arrange(r, work);
}

/* Give the run its equations (a row of model_heads), the instance's own vectors and places in the workspace. */
static void bind(Instance *i, integer row)
{
    run *r = &i->r;
    State *s = &i->s;
    place(r, i->work);
    r->heads = (integer *)model_heads;
    use(r, row);
    r->p = s->p;
    r->constants = s->timing;
    r->times = s->times;
    r->values = s->values;
    r->pointer = s->pointer;
}

/* Bring an instance to what it is before its initialisation: the model's own values, nothing remembered. */
static void reset(Instance *i)
{
    State *s = &i->s;
    run *r = &i->r, kept = i->r;
    memset(s, 0, sizeof *s);
    memset(r, 0, sizeof *r);
    memset(i->work, 0, i->doubles * sizeof(double));
    r->history = kept.history;
    r->history_room = kept.history_room;
    r->echo = kept.echo;
    r->echo_room = kept.echo_room;
    bind(i, NS);
    r->slides = i->cosimulation;
    r->rtol = DEFAULT_TOLERANCE;
    r->atol = 0.01 * r->rtol;
    r->span = 1.0;
    r->max_steps = 200000;
    for (int k = 0; k < NP; k++)
        s->p[k] = model_parameter_values[k];
    for (int k = 0; k < NU; k++) {
        s->u0[k] = r->w[1 + k] = model_input_values[k];
        s->pointer[k] = 2 * k;
    }
    s->pointer[NU] = 2 * NU;
    for (int k = 0; k < NX; k++)
        s->given[k] = model_rest_values[k];
    s->limit = INFINITY;
    s->stale = 1;
}

static void discard(Instance *i)
{
    if (!i)
        return;
    free(i->r.history);
    free(i->r.echo);
    free(i->work);
    free(i->name);
    free(i);
}

static Instance *make(const char *name, const char *token, int cosimulation)
{
    if (!token || strcmp(token, MODEL_TOKEN))
        return NULL;
    Instance *i = calloc(1, sizeof *i);
    if (!i)
        return NULL;
    i->doubles = place(&i->r, NULL);
    i->work = malloc(i->doubles * sizeof(double));
    i->name = calloc(strlen(name ? name : "") + 1, 1);
    if (!i->work || !i->name) {
        discard(i);
        return NULL;
    }
    if (name)
        strcpy(i->name, name);
    i->cosimulation = cosimulation;
    reset(i);
    return i;
}

static void begin(Instance *i, double start, int has_stop, double stop, int has_tolerance, double tolerance)
{
    run *r = &i->r;
    r->start = r->t = start;
    for (int k = 0; k < NU; k++)
        i->s.t_input[k] = start;
    r->span = has_stop && stop > start ? stop - start : 1.0;
    if (has_tolerance && tolerance > 0.0) {
        r->rtol = fmax(tolerance, 1e-13);
        r->atol = 0.01 * r->rtol;
    }
}

/* --- the equations at an instant --- */

static double input_now(const State *s, int k, double t)
{
    return s->u0[k] + s->slope[k] * (t - s->t_input[k]);
}

/* Tell the core the inputs up to an instant. */
static void tell_inputs(Instance *i, double until)
{
    State *s = &i->s;
    for (int k = 0; k < NU; k++) {
        s->times[2 * k] = s->t_input[k];
        s->times[2 * k + 1] = fmax(until, nextafter(s->t_input[k], INFINITY));
        s->values[2 * k] = s->u0[k];
        s->values[2 * k + 1] = input_now(s, k, s->times[2 * k + 1]);
    }
}

/* How far the run may go before a delay shorter than that could act. */
static double horizon(const Instance *i)
{
    double limit = INFINITY;
    for (int k = 0; k < ND; k++)
        limit = fmin(limit, i->r.t + i->s.timing[k]);
    return limit;
}

/* Write what comes from outside at the present instant. */
static void take_inputs(Instance *i)
{
    run *r = &i->r;
    tell_inputs(i, r->t + 1.0);
    r->still = r->quiet = 0;
    outside(r, r->t, i->s.from);
}

/* Note the present values as those at which the history of model exchange ends. */
static void end_history(Instance *i)
{
    i->s.t_kept = i->r.t;
    copy(i->s.y_kept, i->r.y, NY);
    copy(i->s.u_kept, i->r.w + 1, NU);
}

/* Bring the unknowns up to what was set since; modes are free to change only where an event may happen. */
static int refresh(Instance *i)
{
    if (!i->s.stale)
        return 1;
    take_inputs(i);
    if (!(i->s.phase == CONTINUOUS ? consistent(&i->r, false) : settle(&i->r)))
        return explain(i, INCONSISTENT);
    i->s.stale = 0;
    return 1;
}

static int find_start(Instance *i);

/* Bring everything up to date with what was set: the start during initialisation, the unknowns later. */
static int current(Instance *i)
{
    return !i->s.stale || (i->s.phase == INITIALIZATION ? find_start(i) : refresh(i));
}
