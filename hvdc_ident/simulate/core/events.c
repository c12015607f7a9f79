/* Switches: where a step crosses one, and what changes there. */

#include "core.h"

static const double FINEST = 1e-10; /* share of a step up to which the instant of a switch is sought: a hundredth of the usual tolerance */

/* How far a switch is beyond its mode. */
static double over(const run *r, integer k)
{
    return (2.0 * r->m[k] - 1.0) * r->sv[k];
}

/* By how much a switch moves, from its value in r->sv at y, where unknown i moves by its tolerance. */
static double moved_by(run *r, double *y, integer k, integer i)
{
    double kept = y[i];
    y[i] += r->rtol * fabs(kept) + r->atol;
    evaluate(r, r->do_sw, y, r->beside);
    y[i] = kept;
    return fabs(r->beside[k] - r->sv[k]);
}

/* True where a switch whose values at y are in r->sv is by more beyond its mode than may be an error: at most a hundredth of the
   tolerance of the largest value there was, and not more than the states' tolerances make of it; not less than rounding does.

   The first alone would take p^9 for 0 long before p is: the tolerance is one of the states, not of a function of them. One unknown
   that moves the switch as far is enough to tell that it is not: that which did the last time is asked first. */
static bool surely_beyond(run *r, double *y, integer k, double far)
{
    double usual = 0.01 * r->rtol * r->top[k], moved = 0.0;
    bool one_tells = far <= usual;
    if (one_tells && moved_by(r, y, k, r->mover[k]) >= far)
        return false;
    for (integer i = 0; i < r->n; i++) {
        double by = moved_by(r, y, k, i);
        if (one_tells && by >= far) {
            r->mover[k] = i;
            return false;
        }
        moved += by;
    }
    double rounding = 8.0 * 0x1p-52 / r->rtol * moved;
    return far > fmax(moved < usual ? moved : usual, rounding); /* `usual` too where moved is no number */
}

/* The switch that is furthest beyond its mode at y, or NONE; leaves the switches' values in r->sv. */
static integer violation(run *r, double *y)
{
    evaluate(r, r->do_sw, y, r->sv);
    integer beyond = 0;
    for (integer k = 0; k < r->ns; k++) /* without a branch: nearly always there is none */
        beyond += over(r, k) > 0.0;
    if (beyond == 0)
        return NONE;
    double worst = 0.0;
    integer which = NONE;
    for (integer k = 0; k < r->ns; k++) {
        double far = over(r, k);
        if (far > worst && (far > r->slack[k] || surely_beyond(r, y, k, far))) {
            worst = far;
            which = k;
        }
    }
    return which;
}

/* Keep the switches' values for one of the shares of the step. */
static void see(run *r, integer place)
{
    for (integer k = 0; k < r->ns; k++)
        r->along[place * r->ns + k] = r->sv[k];
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
    see(r, 0);
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

/* True where the step began on the good side of a switch, so that the first change of its sign is where it is passed. */
static bool began_within(const run *r, integer k)
{
    return (2.0 * r->m[k] - 1.0) * r->along[k] <= 0.0;
}

/* The first share found of the step at which a switch is passed, between a good one and a bad one, on the dense output; the switch is
   in `event`, and its values are known at both.

   The tolerance of a switch says whether it is passed; where that is its sign says, as far as the step can tell: time is what
   matters, and a value may say little of it. Points a hundredth beside a line's 0 by turns leave a fiftieth of the bracket between them
   where the switch is nearly a line, every third halves it. */
static double bisect(run *r, double good, double bad, integer *event)
{
    double largest = fmax(fabs(r->t), fabs(r->end)), side = 2.0 * r->m[*event] - 1.0;
    double before = side * r->along[(good > 0.0 ? 2 : 0) * r->ns + *event], after = over(r, *event);
    for (integer turn = 0; bad - good > FINEST && (bad - good) * r->hs > 1e-15 * largest; turn++) {
        double cut = 0.5;
        if (turn % 3 < 2 && before < 0.0 && after > 0.0)
            cut = fmin(fmax(before / (before - after) + (turn % 3 ? -0.01 : 0.01), 0.01), 0.99);
        double middle = good + cut * (bad - good);
        integer which = violation_at(r, middle, true);
        if (which == NONE && over(r, *event) > 0.0 && began_within(r, *event))
            which = *event;
        if (which == NONE) {
            good = middle;
            before = over(r, *event);
        } else {
            bad = middle;
            after = over(r, which);
            if (which != *event)
                before = 0.0; /* not known of this one */
            *event = which;
        }
    }
    return bad;
}

/* Where a parabola through values at -1, 0 and 1 is largest, as far as it is inside; 0 where it is nowhere larger than at 0. */
static double vertex(double left, double middle, double right)
{
    double bend = left - 2.0 * middle + right, slope = 0.5 * (right - left);
    if (!(bend < 0.0))
        return left > right ? -1.0 : right > left ? 1.0 : 0.0;
    return fmin(fmax(-slope / bend, -1.0), 1.0);
}

/* True where a switch that keeps its mode at the ends and in the middle of the step may leave it in between.

   A parabola through three values rises above them by an eighth of their range at most; a quartic may by more: half of it. */
static bool may_open(const run *r, integer k)
{
    double side = 2.0 * r->m[k] - 1.0, a = side * r->along[k], b = side * r->along[2 * r->ns + k], c = side * r->along[4 * r->ns + k];
    double top = fmax(a, fmax(b, c)), range = top - fmin(a, fmin(b, c));
    return top + 0.5 * range > 0.0 && range > r->slack[k];
}

/* Write the switches' values at a share of the step into r->sv, as the dense output has them. */
static void look(run *r, double share)
{
    interpolate(r, share, r->n, r->u);
    outside(r, r->t + share * r->hs, r->t);
    evaluate(r, r->do_sw, r->u, r->sv);
}

/* A share of the step at which switch k, which keeps its mode at five of them, is beyond it; 2 where there is none.

   Parabolas through ever nearer values lead to the largest one; what a parabola leaves of five values bounds what it may be off by. */
static double crest(run *r, integer k)
{
    double side = 2.0 * r->m[k] - 1.0, v[SHARES];
    integer best = 1;
    for (integer place = 0; place < SHARES; place++) {
        v[place] = side * r->along[place * r->ns + k];
        if (0 < place && place < SHARES - 1 && v[place] > v[best])
            best = place;
    }
    double first = v[3] - 3.0 * v[2] + 3.0 * v[1] - v[0], second = v[4] - 3.0 * v[3] + 3.0 * v[2] - v[1];
    double off = fabs(first) + fabs(second), width = 0.25, at = width * (double)best;
    double left = v[best - 1], middle = v[best], right = v[best + 1];
    for (;;) {
        double moved = vertex(left, middle, right);
        double highest = middle + 0.5 * moved * (right - left) + 0.5 * moved * moved * (left - 2.0 * middle + right);
        if (highest + off < 0.0)
            return 2.0;
        at += moved * width;
        if (!(at > 0.0 && at < 1.0)) /* it falls from the step's start, or rises to its end, which were looked at */
            return 2.0;
        if (violation_at(r, at, true) != NONE)
            return at;
        width = fmin(0.1 * width, fmin(at, 1.0 - at));
        off *= 0.001;
        if (!(width > FINEST))
            return 2.0;
        look(r, at);
        middle = over(r, k);
        look(r, at - width);
        left = over(r, k);
        look(r, at + width);
        right = over(r, k);
    }
}

/* The first share of the step that is found at which a switch is beyond its mode that is not so at the ends and in the middle; 2 where
   there is none. Leaves what comes from outside, and the switches' values, as they are at the step's end. */
static double opened(run *r)
{
    bool any = false;
    for (integer k = 0; k < r->ns; k++)
        any = any || may_open(r, k);
    if (!any)
        return 2.0;
    for (integer place = 1; place < SHARES; place += 2) {
        look(r, 0.25 * (double)place);
        see(r, place);
    }
    double first = 2.0;
    for (integer k = 0; k < r->ns; k++)
        if (may_open(r, k))
            first = fmin(first, crest(r, k));
    outside(r, r->step_end, r->t);
    for (integer k = 0; k < r->ns; k++)
        r->sv[k] = r->along[4 * r->ns + k];
    return first;
}

/* The switch that ends the present step, whose end it may move; NONE, or AGAIN where the step is to be redone with r->h. */
static integer find_switch(run *r)
{
    double good = 0.0, bad = 0.5;
    integer event = violation_at(r, 0.5, false);
    if (event == NONE) {
        see(r, 2);
        outside(r, r->step_end, r->t);
        event = violation(r, r->yn);
        see(r, 4);
        bad = opened(r);
        if (bad < 1.0) {
            event = violation_at(r, bad, true);
        } else {
            good = 0.5;
            bad = 1.0;
        }
    }
    integer aim = r->aim;
    r->aim = NONE;
    if (event == NONE) {
        bool met = aim >= 0 && fabs(r->sv[aim]) <= NEAR_SURFACE * r->slack[aim];
        return met ? aim : NONE; /* the step aimed at this switch and met it */
    }
    bad = bisect(r, good, bad, &event);
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

/* A switch beyond its mode that is as far from 0 as another one is, or NONE: the two sides of a sign pass together. */
static integer beside(const run *r, integer event)
{
    for (integer k = 0; k < r->ns; k++)
        if (k != event && over(r, k) > 0.0 && fabs(r->sv[k]) == fabs(r->sv[event]))
            return k;
    return NONE;
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
        if (also < 0)
            also = beside(r, event);
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
    evaluate(r, r->do_sw, r->y, r->sv);
    see(r, 0);
    evaluate(r, r->do_rhs, r->y, r->k);
    r->fresh = 1;
    r->h = fmin(r->h, r->hs);
    return CONVERGED;
}
