/* How an instance gets on: from one communication point to the next, and through the events of model exchange. */
#include "internal.h"

static double rounding(double t)
{
    return 1e-13 * fmax(1.0, fabs(t)); /* what rounding alone may keep an importer's instants off ours */
}

/* The next instant, the present one included, at which a delayed jump arrives or a sample is taken or published. */
static double next_due(const run *r)
{
    double due = INFINITY;
    for (integer k = 0; k < r->echoes; k++)
        due = fmin(due, r->echo[2 * k]);
    for (int k = 0; k < NQ; k++)
        due = fmin(due, fmin(r->tick[k], r->publish[k]));
    return due;
}

/* Whether something happens at the present instant. */
static bool is_due(const Instance *i)
{
    const run *r = &i->r;
    return i->s.disturbed || r->first || r->disturbed || r->echo_now || next_due(r) <= r->t;
}

/* Tell the run where something was set from outside: what delays have as their sources may jump. */
static void hand_on(Instance *i)
{
    if (i->s.disturbed) {
        i->r.disturbed = 1;
        i->r.order = 0.0;
    }
}

/* Let happen what happens at the present instant. */
static int pass_event(Instance *i)
{
    run *r = &i->r;
    State *s = &i->s;
    hand_on(i);
    s->from = r->t;
    r->end = horizon(i);
    tell_inputs(i, r->t + 1.0);
    if (!make_rooms(r))
        return explain(i, OUT_OF_MEMORY);
    if (!begin_segment(r))
        return explain(i, INCONSISTENT);
    if (NS) {
        evaluate(r, r->do_sw, r->y, r->sv);
        widen(r);
    }
    r->first = 0;
    s->stale = s->disturbed = 0;
    return 1;
}

/* --- co-simulation --- */

static int set_slope(Instance *i, unsigned int ref, double slope)
{
    State *s = &i->s;
    if (ref < REF_INPUT || ref >= REF_STATE || !isfinite(slope)) {
        say(i, "value reference %u is no input, or its slope is not finite", ref);
        return 0;
    }
    int k = (int)ref - REF_INPUT;
    s->slope_given[k] = 1;
    if (s->slope[k] == slope)
        return 1;
    s->u0[k] = input_now(s, k, i->r.t);
    s->t_input[k] = i->r.t;
    s->slope[k] = slope;
    s->disturbed = s->stale = 1;
    return 1;
}

/* From the communication point t on for h. */
static int do_step(Instance *i, double t, double h)
{
    State *s = &i->s;
    run *r = &i->r;
    if (!(h > 0.0) || !isfinite(h) || !(fabs(t - r->t) <= 1e-9 * fmax(fmax(1.0, fabs(t)), r->span))) {
        say(i, "a step from %.9g s of %g s cannot be done: the last one ended at %.9g s", t, h, r->t);
        return 0;
    }
    for (int k = 0; k < NU; k++)
        if (s->slope[k] != 0.0 && !s->slope_given[k])
            set_slope(i, REF_INPUT + (unsigned)k, 0.0);
    r->continued = !is_due(i);
    hand_on(i);
    r->steps = r->forced_steps = 0;
    r->end = t + h;
    tell_inputs(i, r->end);
    enum status status = run_segments(r);
    if (status == CONVERGED && next_due(r) <= r->end + rounding(r->end)) {
        r->end = next_due(r);
        status = run_segments(r);
    }
    for (int k = 0; k < NU; k++)
        s->slope_given[k] = 0;
    s->from = r->t;
    s->stale = s->disturbed = 0;
    return explain(i, status);
}

/* --- model exchange --- */

/* Add the step from where the history ends to the present values, as cubics through values and slopes. */
static int complete_step(Instance *i)
{
#if ND
    run *r = &i->r;
    State *s = &i->s;
    double h = r->t - s->t_kept;
    if (!(h > 0.0))
        return 1;
    double y[NY], end[ND + NQ], end_rate[ND + NQ], start[ND + NQ], start_rate[ND + NQ];
    if (!refresh(i))
        return 0;
    if (!make_rooms(r))
        return explain(i, OUT_OF_MEMORY);
    for (int k = 0; k < NU; k++)
        r->wd[1 + k] = (r->w[1 + k] - s->u_kept[k]) / h;
    bool regular = rates(r);
    evaluate(r, model_src, r->y, end);
    evaluate(r, model_srcd, r->y, end_rate);
    copy(y, r->y, NY);
    copy(r->y, s->y_kept, NY);
    outside(r, s->t_kept, s->from);
    for (int k = 0; k < NU; k++) {
        r->w[1 + k] = s->u_kept[k];
        r->wd[1 + k] = (s->u0[k] - s->u_kept[k]) / h;
    }
    regular = rates(r) && regular;
    evaluate(r, model_src, r->y, start);
    evaluate(r, model_srcd, r->y, start_rate);
    copy(r->y, y, NY);
    outside(r, r->t, s->from);
    if (!regular)
        return explain(i, INCONSISTENT);
    for (int n = 0; n < NODES; n++) {
        double x = n / (NODES - 1.0), left = 1.0 - x;
        for (int k = 0; k < ND; k++)
            r->nodes[k * NODES + n] = left * left * (1 + 2 * x) * start[k] + x * x * (3 - 2 * x) * end[k] +
                                      h * x * left * (left * start_rate[k] - x * end_rate[k]);
    }
    keep_step(r, s->t_kept, h);
    end_history(i);
#else
    (void)i;
#endif
    return 1;
}

static int enter_event_mode(Instance *i)
{
    run *r = &i->r;
    if (i->s.phase == EVENT)
        return 1;
    if (!complete_step(i))
        return 0;
    double due = next_due(r);
    if (due > r->t && due <= r->t + rounding(r->t))
        r->t = due;
    end_segment(r);
    i->s.phase = EVENT;
    i->s.stale = 1;
    return 1;
}

/* The event iteration, which always settles at once. next: the instant up to which the importer may step. */
static int update_events(Instance *i, int *has_next, double *next)
{
    run *r = &i->r;
    State *s = &i->s;
    double modes[SOME(NS)];
    bool only_limit = !is_due(i) && r->t >= s->limit;
    copy(modes, r->m, NS);
    if (!only_limit && !r->echo_now)
        s->disturbed = 1;
    if (!pass_event(i))
        return 0;
    while (r->tb <= r->t + rounding(r->t)) { /* instants that rounding alone sets apart are one for the importer */
        r->t = r->tb;
        end_segment(r);
        if (!pass_event(i))
            return 0;
    }
    if (only_limit && memcmp(modes, r->m, NS * sizeof(double))) {
        if (!make_rooms(r))
            return explain(i, OUT_OF_MEMORY);
        for (int k = 0; k < ND; k++)
            add_echo(r, k, 1.0);
    }
    s->limit = r->end;
    *next = r->tb;
    *has_next = *next < INFINITY;
    return 1;
}

static int leave_event_mode(Instance *i)
{
    if (!current(i))
        return 0;
    end_history(i);
    i->s.phase = CONTINUOUS;
    return 1;
}
