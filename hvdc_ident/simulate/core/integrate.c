/* The integration: segments between breaks, steps under error control. */

#include "core.h"

/* The next `count` doubles of the workspace, rounded up for loops by four; only their number where there is no workspace yet. */
static double *take(double *work, size_t *used, integer count)
{
    double *found = work ? work + *used : NULL;
    *used += (size_t)((count + LANES - 1) / LANES * LANES + LANES);
    return found;
}

/* Give every vector of the workspace its place; returns how many doubles they take. work: NULL where only that is asked for. */
static size_t arrange(run *r, double *work)
{
    integer rows = 1 + r->width, sources = r->nd + r->nq;
    size_t used = 0;
#define TAKE(name, count) r->name = (void *)take(work, &used, count);
    TAKE(y, r->size) TAKE(yn, r->size) TAKE(u, r->size)
    TAKE(k, 8 * r->stride) TAKE(e, r->size) TAKE(dense, 4 * r->stride)
    TAKE(add, r->size) TAKE(mass, r->size) TAKE(ft, r->size) TAKE(f_before, r->size) TAKE(f_after, r->size)
    TAKE(yd, r->n) TAKE(m, r->ns) TAKE(w, r->nw + sources * r->width) TAKE(wd, r->nw + sources * r->width)
    TAKE(jac, r->n * r->n) TAKE(matrix, r->n * r->n) TAKE(small, r->nz * r->nz)
    TAKE(hessian, r->hessians * r->width) TAKE(factor, r->factors + 1) TAKE(shift, 1)
    TAKE(pivots, r->n) TAKE(small_pivots, r->nz) TAKE(floors, r->width) TAKE(totals, r->width)
    TAKE(z_before, r->nz) TAKE(z_from, r->nz) TAKE(z_step, r->nz) TAKE(side, r->ns)
    TAKE(sv, r->ns) TAKE(top, r->ns) TAKE(slack, r->ns) TAKE(sws, r->ns * rows)
    TAKE(along, SHARES * r->ns) TAKE(beside, r->ns) TAKE(mover, r->ns)
    TAKE(src, sources * rows) TAKE(src_rate, sources) TAKE(src_left, sources)
    TAKE(lag, r->nd) TAKE(lag_p, r->nd * r->width) TAKE(before, r->nd * rows) TAKE(nodes, NODES * r->nd * rows)
    TAKE(tick, r->nq) TAKE(publish, r->nq) TAKE(ticks, r->nq) TAKE(pending, r->nq)
    TAKE(pending_p, r->nq * r->width) TAKE(publish_p, r->nq * r->width) TAKE(jump_p, r->width) TAKE(at, r->nu)
    TAKE(surface, 3 + r->nx + r->width) TAKE(instants, LANES) TAKE(block, LANES * r->stride)
#undef TAKE
    return used;
}

/* Make room for `more` rows beyond those there are. False: no memory. */
static bool make_room(double **table, integer *room, integer there, integer more, integer columns)
{
    if (there + more <= *room)
        return true;
    integer rows = 2 * *room + more;
    double *larger = realloc(*table, sizeof(double) * (size_t)rows * (size_t)columns);
    if (larger == NULL)
        return false;
    *table = larger;
    *room = rows;
    return true;
}

/* Fill the workspace for a run from the flat start vector y and what comes from outside, w. */
static void begin_run(run *r, const double *y, const double *w)
{
    integer nd = r->nd, width = r->width, rows = 1 + width;
    for (integer i = 0; i < r->size; i++)
        r->y[i] = y[i];
    for (integer i = 0; i < r->nw + (nd + r->nq) * width; i++)
        r->w[i] = w[i];
    for (integer c = 0; c < width; c++)
        r->floors[c] = c < r->np ? r->atol / r->scale[c] : INFINITY;
    r->shortest = INFINITY;
    for (integer i = 0; i < nd; i++) {
        r->lag[i] = r->constants[i];
        r->shortest = fmin(r->shortest, r->lag[i]);
        r->before[i * rows] = w[1 + r->nu + i];
        for (integer c = 0; c < width; c++) {
            r->lag_p[i * width + c] = r->constants[nd + 2 * r->nq + i * width + c];
            r->before[i * rows + 1 + c] = w[r->nw + i * width + c];
        }
    }
    for (integer i = 0; i < r->nq; i++) {
        r->tick[i] = r->start;
        r->publish[i] = INFINITY;
    }
    while (r->i_break < r->n_breaks && r->breaks[r->i_break] <= r->start)
        r->i_break++;
    for (integer i = 0; i < r->nu; i++)
        r->at[i] = r->pointer[i];
    r->t = r->start;
    r->span = r->end - r->start;
    r->first = 1;
    r->last_event = -INFINITY;
    r->last_switch = r->aim = NONE;
}

/* Accept a step and set the next one's length to `factor` times its own. */
static enum status accept(run *r, double factor)
{
    if (r->nd || r->ns || (r->i_out < r->n_out && r->t_out[r->i_out] <= r->step_end))
        make_dense(r);
    integer event = r->ns ? find_switch(r) : NONE;
    if (event == AGAIN)
        return CONVERGED;
    write_rows(r);
    if (r->nd)
        remember(r);
    r->accepted++;
    r->t = r->step_end;
    double *y = r->y;
    r->y = r->yn;
    r->yn = y;
    r->fresh = 0;
    r->h = r->last && factor >= 1.0 ? fmax(r->h, r->hs * factor) : r->hs * factor;
    if (r->ns)
        widen(r);
    if (event != NONE)
        return pass_switch(r, event);
    if (r->sliding != NONE)
        stay_on_surface(r);
    return CONVERGED;
}

/* Try one step, and what follows if it is good: outputs, history, a switch at its end. */
static enum status take_step(run *r)
{
    if (++r->steps > r->max_steps)
        return STEP_LIMIT;
    if (r->nd)
        r->h = fmin(r->h, r->shortest);
    double span = r->span, largest = fmax(fabs(r->t), fabs(r->end));
    r->last = r->t + 1.000001 * r->h >= r->tb;
    r->step_end = r->last ? r->tb : r->t + r->h;
    r->hs = r->step_end - r->t;
    if (r->last && !(r->hs > 1e-15 * largest)) {
        r->t = r->tb; /* two breaks that differ by rounding alone */
        return CONVERGED;
    }
    if (!(r->hs > 4e-16 * largest) || r->h < 1e-14 * span)
        return NOT_FINITE;
    attempt(r);
    if (r->error > 1.0 && r->hs <= 1e-10 * span && r->error < INFINITY && r->forced_steps < 50) {
        /* A slope that is infinite for an instant cannot be followed to tolerance: pass it, and count it. */
        r->forced_steps++;
        r->error = 0.05;
    }
    /* Steps at the edge of stability are accepted and rejected by turns: a third of them beyond it is enough. */
    if (!r->rosenbrock && r->stiffness > 3.25 * 3.25) {
        r->stiff += 2;
        if (r->stiff > 50)
            return STIFF;
    } else if (r->stiff > 0) {
        r->stiff--;
    }
    if (!(r->error <= 1.0)) {
        r->rejected++;
        r->h = r->hs * (r->error < INFINITY ? fmax(0.2, 0.9 * pow(r->error, -0.2)) : 0.2);
        r->fresh = r->again = 1; /* the derivatives at (t, y) stand */
        return CONVERGED;
    }
    double factor = r->error > 1e-10 ? 0.9 * pow(r->error, -0.2) : 8.0;
    factor = fmin(fmax(factor, 0.2), r->again ? 1.0 : 8.0);
    r->again = 0;
    return accept(r, factor);
}

/* Forget the steps that no delay reaches any more, where that is at least half of them. */
static void forget(run *r)
{
    integer line = 2 + r->nd * NODES * (1 + r->width), old = 0;
    double longest = 0.0;
    for (integer i = 0; i < r->nd; i++)
        longest = fmax(longest, r->lag[i]);
    while (old < r->kept && r->history[old * line] + r->history[old * line + 1] < r->t - 1.001 * longest)
        old++;
    if (2 * old < r->kept)
        return;
    r->kept -= old;
    for (integer q = 0; q < r->kept * line; q++)
        r->history[q] = r->history[old * line + q];
}

/* Make room for what a step or the beginning of a segment may add: jumps that come back, and pieces of a step to look back to.
   False: no memory. */
static bool make_rooms(run *r)
{
    integer line = 2 + r->width, of_history = 2 + r->nd * NODES * (1 + r->width);
    if (r->nd == 0)
        return true;
    if (r->kept + PIECES > r->history_room)
        forget(r);
    return make_room(&r->history, &r->history_room, r->kept, PIECES, of_history) &&
           make_room(&r->echo, &r->echo_room, r->echoes, r->nd + 1, line);
}

/* Run from segment to segment until r->end, where nothing has happened yet. */
static enum status run_segments(run *r)
{
    while (r->t < r->end) {
        if (!make_rooms(r))
            return OUT_OF_MEMORY;
        if (r->continued)
            r->tb = next_stop(r);
        else if (!begin_segment(r))
            return INCONSISTENT;
        describe_segment(r);
        if (!r->continued)
            prepare_segment(r);
        r->continued = 0;
        while (r->t < r->tb) {
            if (!make_rooms(r))
                return OUT_OF_MEMORY;
            enum status status = take_step(r);
            if (status != CONVERGED)
                return status;
        }
        end_segment(r);
    }
    return CONVERGED;
}
