/* Switches: where a step crosses one, and what changes there. */

#include "core.h"

/* The switch that is furthest beyond its mode at y, or NONE; leaves the switches' values in r->sv. */
static integer violation(run *r, const double *y)
{
    evaluate(r, r->do_sw, y, r->sv);
    integer beyond = 0;
    for (integer k = 0; k < r->ns; k++) /* without a branch: nearly always there is none */
        beyond += (2.0 * r->m[k] - 1.0) * r->sv[k] > r->slack[k];
    if (beyond == 0)
        return NONE;
    double worst = 0.0;
    integer which = NONE;
    for (integer k = 0; k < r->ns; k++) {
        double over = (2.0 * r->m[k] - 1.0) * r->sv[k] - r->slack[k];
        if (over > worst) {
            worst = over;
            which = k;
        }
    }
    return which;
}

/* Keep the largest value of every switch so far, which its tolerance is relative to. */
static void widen(run *r)
{
    for (integer i = 0; i < r->ns; i++) {
        double size = fabs(r->sv[i]);
        double largest = size > r->top[i] && size < INFINITY ? size : r->top[i];
        r->top[i] = largest;
        r->slack[i] = 0.01 * r->rtol * largest + 1e-14;
    }
}

/* The switch that is furthest beyond its mode at a share of the present step, or NONE.

   Where a switch is near 0 the point of the dense output is corrected by its defect, and looked at again: while a play is pulled, the
   switch that lets it go is 1e-7 of a speed, and what is pulled is no quartic. exact: the corrected point alone decides; else what
   either says. The correction is that of an implicit step of gamma h: before gamma it would reach back behind the step's start, where
   the point is exact. */
static integer violation_at(run *r, double share, bool exact)
{
    interpolate(r, share, r->n, r->u);
    outside(r, r->t + share * r->hs, r->t);
    integer which = violation(r, r->u);
    bool near = exact;
    for (integer k = 0; k < r->ns; k++)
        near = near || fabs(r->sv[k]) < 0.1 * r->top[k];
    if (!r->rosenbrock || share < RODAS_GAMMA || !near || (which != NONE && !exact))
        return which;
    rodas_defect(r, share);
    EACH(i, r->n)
        r->u[i] += r->e[i];
    return violation(r, r->u);
}

/* Bisection on "some switch is beyond its mode", on the dense output: the share of the step, and the switch in `event`. */
static double bisect(run *r, double bad, integer *event)
{
    double good = bad == 0.5 ? 0.0 : 0.5;
    for (integer k = 0; k < 60; k++) {
        double middle = 0.5 * (good + bad);
        integer which = violation_at(r, middle, true);
        if (which >= 0) {
            bad = middle;
            *event = which;
            if (fabs(r->sv[which]) <= 2.0 * r->slack[which])
                break;
        } else {
            good = middle;
        }
        if ((bad - good) * r->hs <= 1e-15 * fmax(1.0, fabs(r->t)))
            break;
    }
    return bad;
}

/* The switch that ends the present step, whose end it may move; NONE, or AGAIN where the step is to be redone with r->h. */
static integer find_switch(run *r)
{
    double bad = 0.5;
    integer event = violation_at(r, 0.5, false);
    if (event == NONE) {
        bad = 1.0;
        outside(r, r->step_end, r->t);
        event = violation(r, r->yn);
    }
    integer aim = r->aim;
    r->aim = NONE;
    if (event == NONE) {
        bool met = aim >= 0 && fabs(r->sv[aim]) <= NEAR_SURFACE * r->slack[aim];
        return met ? aim : NONE; /* the step aimed at this switch and met it */
    }
    bad = bisect(r, bad, &event);
    if (bad < 0.98 && bad * r->hs > 1e-12 * r->span) {
        /* Step again up to the switch itself: the dense output is less exact than the step. */
        r->h = bad * r->hs;
        r->aim = event;
        r->fresh = r->again = 1;
        r->rejected++;
        return AGAIN;
    }
    if (bad < 1.0) {
        /* Near the step's end or its start: cut on the dense output. */
        interpolate(r, bad, r->size, r->yn);
        r->step_end = r->t + bad * r->hs;
        r->last = 0;
    }
    return event;
}

/* Sensitivities of the states at a jump of the right-hand side: + (f before - f after) d(instant)/dp. */
static void shift_rows(run *r, const double *before, const double *after, const double *slope)
{
    for (integer i = 0; i < r->nx; i++)
        for (integer c = 0; c < r->width; c++)
            r->y[r->n + i * r->width + c] += (before[i] - after[i]) * slope[c];
}

/* Note that a jump (order 0) or a corner of delay i's source comes back after the delay; the caller has made room. */
static void add_echo(run *r, integer i, double order)
{
    integer width = r->width;
    double at = r->t + r->lag[i];
    double *echo = r->echo + r->echoes * (2 + width);
    echo[0] = at;
    echo[1] = order;
    for (integer c = 0; c < width; c++)
        echo[2 + c] = r->jump_p[c] + r->lag_p[i * width + c];
    r->echoes++;
    r->tb = fmin(r->tb, at);
}

/* The jump condition: r->jump_p, and where the right-hand side jumps at all the sensitivities, the unknowns' too.

   What jumps may be the source of a delay alone, whose jump comes back later with the same r->jump_p. */
static void jump_rows(run *r, integer event, double speed, bool jumped)
{
    const double *row = r->sws + r->ns + event * r->width;
    for (integer c = 0; c < r->width; c++)
        r->jump_p[c] = -row[c] / speed;
    if (jumped) {
        shift_rows(r, r->f_before, r->f_after, r->jump_p);
        consistent(r, false);
    }
}

/* Change a switch and those that follow from it; where the new side leads back, slide on it. */
static enum status cross(run *r, integer event)
{
    double speed = 0.0;
    if (r->width) {
        rates(r);
        evaluate(r, r->do_sws, r->y, r->sws);
        evaluate(r, r->do_swd, r->y, r->sv);
        speed = r->sv[event];
    }
    evaluate(r, r->do_f, r->y, r->f_before);
    evaluate(r, r->do_sw, r->y, r->sv);
    double value = r->sv[event];
    r->m[event] = 1.0 - r->m[event];
    for (integer k = 0; k < r->ns; k++) {
        if (!consistent(r, false))
            return INCONSISTENT;
        if (r->sliding != NONE && !slides_on(r) && !end_slide(r))
            return INCONSISTENT;
        integer also = violation(r, r->y);
        if (also < 0 || also == event)
            break;
        r->m[also] = 1.0 - r->m[also];
    }
    evaluate(r, r->do_f, r->y, r->f_after);
    double biggest = 0.0;
    for (integer i = 0; i < r->nx; i++) {
        double one = r->f_before[i], other = r->f_after[i];
        biggest = fmax(biggest, fabs(one - other) / (1e-9 + fabs(one) + fabs(other)));
    }
    if (r->width && speed != 0.0)
        jump_rows(r, event, speed, biggest > 1e-7);
    if (r->slides && biggest > 1e-7 && leads_back(r, event, value))
        return begin_slide(r, event);
    return CONVERGED;
}

/* At a switch: sensitivities jump by (f- - f+) times d(instant)/dp, unknowns are solved anew. */
static enum status pass_switch(run *r, integer event)
{
    r->events++;
    if (event == r->last_switch && r->t - r->last_event < 1e-9 * r->span) {
        if (++r->chatter > 40)
            return CHATTER;
    } else {
        r->chatter = 0;
    }
    r->last_event = r->t;
    r->last_switch = event;
    outside(r, r->t, r->t);
    consistent(r, false);
    if (event == r->sliding) { /* the field is continuous there: nothing jumps */
        to_surface(r);
        if (!end_slide(r))
            return INCONSISTENT;
    } else {
        enum status status = cross(r, event);
        if (status != CONVERGED)
            return status;
    }
    for (integer i = 0; i < r->nd; i++)
        add_echo(r, i, 1.0);
    for (integer c = 0; c < r->width; c++)
        r->jump_p[c] = 0.0;
    evaluate(r, r->do_rhs, r->y, r->k);
    r->fresh = 1;
    r->h = fmin(r->h, r->hs);
    return CONVERGED;
}
