/* Segments between breaks: inputs jump, samples are taken, delayed jumps come back; rows of outputs and the history in between. */

#include "core.h"

/* --- rows of outputs and the history of delayed signals --- */

static integer columns(const run *r)
{
    integer count = r->no * (1 + r->width);
    return count > 1 ? count : 1;
}

/* Write the next row of outputs from the flat vector y, with what comes from outside as it stands. */
static void write_row(run *r, const double *y)
{
    evaluate(r, r->do_observe, y, r->out + r->i_out * columns(r));
    r->i_out++;
}

/* Write the step's quartic at four instants to the rows of r->block. */
static void interpolate_four(run *r, const double *instants)
{
    double scale = 1.0 / r->hs;
    for (integer k = 0; k < LANES; k++)
        interpolate(r, (instants[k] - r->t) * scale, r->size, r->block + k * r->stride);
}

/* Write the next `count` rows in one go; the rows up to the fourth get the last one's values, until their turn comes. */
static void write_four(run *r, integer count)
{
    for (integer k = 0; k < LANES; k++)
        r->instants[k] = r->t_out[r->i_out + (k < count ? k : count - 1)];
    interpolate_four(r, r->instants);
    if (r->do_rows) {
        r->do_rows(r->block, r->instants, r->w, r->wd, r->p, r->m, r->out + r->i_out * columns(r));
        r->i_out += count;
    } else {
        for (integer k = 0; k < count; k++) {
            outside(r, r->instants[k], r->t);
            write_row(r, r->block + r->stride * k);
        }
    }
}

/* Write the rows of outputs within the present step, from its dense output. */
static void write_rows(run *r)
{
    for (;;) {
        integer count = 0;
        while (count < LANES && r->i_out + count < r->n_out) {
            double at = r->t_out[r->i_out + count];
            if (!(at < r->step_end || (at == r->step_end && r->step_end < r->tb)))
                break;
            count++;
        }
        if (count == 0)
            return;
        if (r->quiet && count > 2 && r->i_out + LANES <= r->n_out) { /* four at once cost about as much as two alone */
            write_four(r, count);
            continue;
        }
        for (integer k = 0; k < count; k++) {
            double at = r->t_out[r->i_out];
            interpolate(r, (at - r->t) / r->hs, r->size, r->u);
            outside(r, at, r->t);
            write_row(r, r->u);
        }
    }
}

/* Add a step of length h from t to the history of delayed signals; r->nodes holds each source at 0, 1/4, 1/2, 3/4 and 1 of it. */
static void keep_step(run *r, double t, double h)
{
    integer rows = 1 + r->width;
    double *step = r->history + (2 + r->nd * NODES * rows) * r->kept;
    step[0] = t;
    step[1] = h;
    for (integer i = 0; i < r->nd; i++)
        quartics(r->nodes + i * NODES * rows, step + 2 + i * NODES * rows, rows);
    r->kept++;
}

/* Write the sources of the delays, each with its rows, `apart` doubles from one to the next, at a share of the present step. */
static void write_sources(run *r, double share, double *out, integer apart)
{
    integer nd = r->nd, width = r->width;
    interpolate(r, share, r->size, r->u);
    outside(r, fmin(r->t + share * r->hs, r->step_end), r->t);
    evaluate(r, r->do_sources, r->u, r->src);
    for (integer i = 0; i < nd; i++) {
        out[i * apart] = r->src[i];
        for (integer c = 0; c < width; c++)
            out[i * apart + 1 + c] = r->src[nd + r->nq + i * width + c];
    }
}

/* The largest difference of the sources in r->nodes from their polynomials at x in 0..1 of a step of the history, over the tolerance.

   Where a parameter moves the delay its row has the quartic's rate, which is off by 27 times the value's error at x = 0.1. */
static double history_error(const run *r, const double *step, double x)
{
    integer rows = 1 + r->width;
    double worst = 0.0;
    for (integer i = 0; i < r->nd; i++) {
        const double *c0 = step + 2 + i * NODES * rows, *c1 = c0 + rows, *c2 = c1 + rows, *c3 = c2 + rows, *c4 = c3 + rows;
        double rate = (c1[0] + x * (2 * c2[0] + x * (3 * c3[0] + x * 4 * c4[0]))) / step[1], rate_error = 0.0;
        for (integer j = 0; j < 1 + r->np; j++) {
            double value = r->nodes[i * rows + j], floor = j ? r->floors[j - 1] : r->atol;
            double kept = c0[j] + x * (c1[j] + x * (c2[j] + x * (c3[j] + x * c4[j])));
            worst = fmax(worst, fabs(kept - value) / (floor + r->rtol * fabs(value)));
            if (j == 0)
                rate_error = 27.0 / step[1] * fabs(kept - value);
            else
                worst = fmax(worst, rate_error / (floor / fabs(r->lag_p[i * r->width + j - 1]) + r->rtol * fabs(rate)));
        }
    }
    return worst;
}

/* Add the present step from one share to another to the history of delayed signals; returns its error, of the tolerance. */
static double remember_piece(run *r, double from, double to)
{
    integer rows = 1 + r->width;
    const double *step = r->history + (2 + r->nd * NODES * rows) * r->kept;
    double worst = 0.0;
    for (integer j = 0; j < NODES; j++)
        write_sources(r, from + (to - from) * (double)j / (NODES - 1), r->nodes + j * rows, NODES * rows);
    keep_step(r, r->t + from * r->hs, (to - from) * r->hs); /* not before: a source may look back too */
    for (double x = 0.1; x < 1.0; x += 0.8) {
        write_sources(r, from + (to - from) * x, r->nodes, rows);
        worst = fmax(worst, history_error(r, step, x));
    }
    return worst;
}

/* Add the present step to the history of delayed signals, in as many pieces as its sources ask for.

   States are quartics over a step; a source is a function of them and of inputs, about which the step's length says nothing. Where it
   is the corners of an input that are lost, the error falls with the length alone: more pieces would not help. */
static void remember(run *r)
{
    integer before = r->kept;
    double end = (r->step_end - r->t) / r->hs, coarser[2] = {INFINITY, INFINITY};
    for (integer pieces = 1; pieces <= PIECES; pieces *= 2) {
        double part = end / (double)pieces, worst = 0.0;
        r->kept = before;
        for (integer j = 0; j < pieces; j++)
            worst = fmax(worst, remember_piece(r, part * (double)j, part * (double)(j + 1)));
        if (worst <= 1.0 || worst > 0.2 * coarser[1])
            return;
        coarser[1] = coarser[0];
        coarser[0] = worst;
    }
}

/* --- the beginning of a segment --- */

/* The next instant at which a step has to end: a break of an input, a returning jump, a sample, the end. */
static double next_stop(const run *r)
{
    double stop = r->end;
    if (r->i_break < r->n_breaks)
        stop = fmin(stop, r->breaks[r->i_break]);
    for (integer i = 0; i < r->echoes; i++)
        if (r->echo[i * (2 + r->width)] > r->t)
            stop = fmin(stop, r->echo[i * (2 + r->width)]);
    for (integer i = 0; i < r->nq; i++) {
        if (r->tick[i] > r->t)
            stop = fmin(stop, r->tick[i]);
        if (r->publish[i] > r->t)
            stop = fmin(stop, r->publish[i]);
    }
    return stop;
}

/* Publish the samples that are due. False: the unknowns have no solution with them. */
static bool publish_samples(run *r)
{
    integer nd = r->nd, width = r->width;
    for (integer i = 0; i < r->nq; i++) {
        if (r->publish[i] != r->t)
            continue;
        if (width)
            evaluate(r, r->do_f, r->y, r->f_before);
        r->w[1 + r->nu + nd + i] = r->pending[i];
        for (integer c = 0; c < width; c++)
            r->w[r->nw + (nd + i) * width + c] = r->pending_p[i * width + c];
        if (!settle(r))
            return false;
        if (width) {
            evaluate(r, r->do_f, r->y, r->f_after);
            shift_rows(r, r->f_before, r->f_after, r->publish_p + i * width);
            for (integer c = 0; c < width; c++)
                r->jump_p[c] = r->publish_p[i * width + c]; /* for what a delay brings back of it */
        }
        r->publish[i] = INFINITY;
        r->published = 1;
    }
    return !r->published || consistent(r, false);
}

/* Take the samples that are due: value and rows, at the instant's own dependence on the parameters.

   A sample whose compute time is the whole period is published first, but all are taken from the signals before that. False: the
   unknowns have no solution with what is published. */
static bool take_samples(run *r)
{
    integer nd = r->nd, nq = r->nq, width = r->width;
    const double *rows = r->constants + nd + 2 * nq;
    bool due = false, whole = false;
    for (integer i = 0; i < nq; i++)
        if (r->tick[i] == r->t) {
            due = true;
            whole = whole || r->publish[i] == r->t;
        }
    if (!due)
        return true;
    evaluate(r, r->do_sources, r->y, r->src);
    rates(r);
    evaluate(r, r->do_srcd, r->y, r->src_rate);
    if (whole && !publish_samples(r))
        return false;
    for (integer i = 0; i < nq; i++) {
        if (r->tick[i] != r->t)
            continue;
        r->pending[i] = r->src[nd + i];
        for (integer c = 0; c < width; c++) {
            double own = r->ticks[i] * rows[(nd + i) * width + c];
            r->pending_p[i * width + c] = r->src[nd + nq + (nd + i) * width + c] + r->src_rate[nd + i] * own;
            r->publish_p[i * width + c] = own + rows[(nd + nq + i) * width + c];
        }
        r->publish[i] = r->t + r->constants[nd + nq + i];
        r->ticks[i] += 1.0;
        r->tick[i] = r->start + r->ticks[i] * r->constants[nd + i];
        if (fabs(r->publish[i] - r->tick[i]) <= 1e-13 * fmax(1.0, fabs(r->t)))
            r->publish[i] = r->tick[i]; /* one instant, so that rounding does not decide which comes first */
    }
    return true;
}

/* Jumps and corners of a delayed signal's source come back after the delay. */
static void echo_sources(run *r)
{
    evaluate(r, r->do_src, r->y, r->src);
    for (integer i = 0; i < r->nd; i++) {
        double was = r->first ? r->before[i * (1 + r->width)] : r->src_left[i];
        bool jumped = fabs(r->src[i] - was) > 1e-12 * (1.0 + fabs(r->src[i]));
        double order = jumped ? 0.0 : r->order + 1.0;
        if (order <= 4.0)
            add_echo(r, i, order);
    }
}

/* Begin a segment at r->t: inputs jump, samples are taken and published, outputs are written. False: no solution there. */
static bool begin_segment(run *r)
{
    bool final = !(r->t < r->end);
    r->tb = final ? r->t + 1.0 : next_stop(r);
    enter_segment(r);
    r->wd[0] = 1.0;
    r->still = r->quiet = 0;
    outside(r, r->t, r->t); /* what comes from outside is seen after its jump */
    if (!settle(r))
        return false;
    if (!r->first && r->width && r->echo_now) {
        evaluate(r, r->do_fs, r->y, r->f_after);
        shift_rows(r, r->f_before, r->f_after, r->jump_p);
        consistent(r, false);
    }
    r->echo_now = r->published = 0;
    if (r->nq && !final) {
        if (!take_samples(r) || !publish_samples(r))
            return false;
        r->tb = next_stop(r);
    }
    if (r->nd && (r->first || r->published || r->disturbed))
        echo_sources(r);
    for (integer c = 0; c < r->width; c++)
        r->jump_p[c] = 0.0;
    while (r->i_out < r->n_out && r->t_out[r->i_out] <= r->t)
        write_row(r, r->y);
    return true;
}

/* The length that changes the states by a hundredth of themselves, in the error's weights, or the last step's if shorter. */
static void first_step(run *r)
{
    double span = r->span, d0 = 0.0, d1 = 0.0;
    for (integer i = 0; i < r->nx; i++) {
        double weight = r->atol + r->rtol * fabs(r->y[i]);
        d0 += (r->y[i] / weight) * (r->y[i] / weight);
        d1 += (r->k[i] / weight) * (r->k[i] / weight);
        for (integer c = 0; c < r->np; c++) {
            integer q = r->n + i * r->width + c;
            weight = r->floors[c] + r->rtol * fabs(r->y[q]);
            d0 += (r->y[q] / weight) * (r->y[q] / weight);
            d1 += (r->k[q] / weight) * (r->k[q] / weight);
        }
    }
    double guess = d1 > 0.0 && d0 > 0.0 ? 0.01 * sqrt(d0 / d1) : 0.1 * span;
    r->h = r->h == 0.0 || guess < r->h ? fmin(fmax(guess, 1e-9 * span), 0.1 * span) : fmin(r->h, guess);
}

/* Set what holds in the whole segment. */
static void describe_segment(run *r)
{
    r->segments++;
    bool still = enter_segment(r);
    for (integer i = 0; i < r->nu; i++)
        still = still && r->wd[1 + i] == 0.0;
    r->still = still;
    r->quiet = still && r->nd == 0;
    force(r);
}

/* Set the switches' tolerances and the first step's length. */
static void prepare_segment(run *r)
{
    if (r->ns) {
        evaluate(r, r->do_sw, r->y, r->sv);
        for (integer i = 0; i < r->ns; i++) {
            if (fabs(r->sv[i]) < INFINITY)
                r->top[i] = fmax(r->top[i], fabs(r->sv[i]));
            r->slack[i] = 0.01 * r->rtol * r->top[i] + 1e-14;
        }
        see(r, 0);
    }
    evaluate(r, r->do_rhs, r->y, r->k);
    r->evaluations++;
    first_step(r);
    r->fresh = 1;
    r->again = 0;
}

/* --- its end --- */

/* The segment's end, seen from before its jump: outputs of the left side, what comes back now, what comes next. */
static void end_segment(run *r)
{
    integer width = r->width, line = 2 + width, kept = 0;
    r->still = r->quiet = 0;
    r->tb = r->t;
    outside(r, r->t, r->start);
    if (r->nd)
        evaluate(r, r->do_src, r->y, r->src_left);
    while (r->i_out + 1 < r->n_out && r->t_out[r->i_out] == r->t && r->t_out[r->i_out + 1] == r->t)
        write_row(r, r->y);
    r->order = 0.0;
    r->disturbed = 0;
    for (integer i = 0; i < r->echoes; i++) {
        const double *echo = r->echo + i * line;
        if (echo[0] == r->t) {
            r->echo_now = r->disturbed = 1;
            r->order = fmax(r->order, echo[1]);
            for (integer c = 0; c < width; c++)
                r->jump_p[c] = echo[2 + c];
        } else if (echo[0] > r->t) {
            for (integer q = 0; q < line; q++)
                r->echo[kept * line + q] = echo[q];
            kept++;
        }
    }
    r->echoes = kept;
    if (r->echo_now && width)
        evaluate(r, r->do_f, r->y, r->f_before);
    const double *returns = r->breaks + r->n_breaks;
    while (r->i_break < r->n_breaks && r->breaks[r->i_break] <= r->t) {
        if (returns[r->i_break] > 0.0)
            r->disturbed = 1;
        r->i_break++;
    }
    r->first = 0;
}
