/* What the model remembers: delayed signals, sampled values, and the instants at which they act. */
#include "internal.h"

static int grow(double **table, size_t *room, size_t needed, size_t row) {
    if (needed <= *room) return 1;
    size_t larger = *room ? 2 * *room : 64;
    if (larger < needed) larger = needed;
    double *moved = realloc(*table, larger * row * sizeof(double));
    if (!moved) return 0;
    *table = moved;
    *room = larger;
    return 1;
}

/* Drops what no delay reaches any more, where that is at least half of the history. */
static void prune(Instance *i, double t) {
    State *s = &i->s;
    double longest = 0.0;
    size_t old = 0;
    for (int k = 0; k < ND; k++) longest = fmax(longest, s->timing[k]);
    while (old < s->steps && i->history[old * HISTORY_ROW] + i->history[old * HISTORY_ROW + 1] < t - 1.001 * longest) old++;
    if (2 * old < s->steps) return;
    memmove(i->history, i->history + old * HISTORY_ROW, (s->steps - old) * HISTORY_ROW * sizeof(double));
    s->steps -= old;
}

/* Appends a step of length h from t: each source as the quartic through its values at 0, 1/4, 1/2, 3/4 and 1 of the step. */
Outcome keep_quartic(Instance *i, double t, double h, double values[NODES][SOME(ND)]) {
    State *s = &i->s;
    if (s->steps == i->history_room && s->steps) prune(i, t);
    if (!grow(&i->history, &i->history_room, s->steps + 1, HISTORY_ROW)) return NO_MEMORY;
    double *row = i->history + s->steps * HISTORY_ROW;
    row[0] = t;
    row[1] = h;
    for (int k = 0; k < ND; k++) {
        double a = values[0][k], b = values[1][k], d = values[2][k], e = values[3][k], f = values[4][k];
        double *c = row + 2 + NODES * k;
        c[0] = a;
        c[1] = (-25 * a + 48 * b - 36 * d + 16 * e - 3 * f) / 3;
        c[2] = (70 * a - 208 * b + 228 * d - 112 * e + 22 * f) / 3;
        c[3] = (-80 * a + 288 * b - 384 * d + 224 * e - 48 * f) / 3;
        c[4] = (32 * a - 128 * b + 192 * d - 128 * e + 32 * f) / 3;
    }
    s->steps++;
    return GOOD;
}

/* Model exchange: appends the step from where the history ends to the present values, as cubics through values and slopes. */
Outcome keep_step(Instance *i) {
#if ND
    State *s = &i->s;
    double h = s->t - s->t_kept;
    if (!(h > 0.0)) return GOOD;
    Args a;
    arguments(i, &a);
    double end[ND + NQ], end_rate[ND + NQ], start[ND + NQ], start_rate[ND + NQ], y[SOME(NY)], values[NODES][ND];
    Outcome outcome = refresh(i);
    if (outcome != GOOD) return outcome;
    for (int k = 0; k < NU; k++) s->wd[1 + k] = (s->w[1 + k] - s->u_kept[k]) / h;
    if ((outcome = rates(i)) != GOOD) return outcome;
    model_sources(&a, end);
    model_source_rates(&a, end_rate);
    memcpy(y, s->y, sizeof y);
    memcpy(s->y, s->y_kept, sizeof y);
    outside(i, s->t_kept);
    for (int k = 0; k < NU; k++) {
        s->w[1 + k] = s->u_kept[k];
        s->wd[1 + k] = (s->u0[k] - s->u_kept[k]) / h;
    }
    outcome = rates(i);
    model_sources(&a, start);
    model_source_rates(&a, start_rate);
    memcpy(s->y, y, sizeof y);
    outside(i, s->t);
    if (outcome != GOOD) return outcome;
    for (int n = 0; n < NODES; n++) {
        double x = n / (NODES - 1.0), r = 1.0 - x;
        for (int k = 0; k < ND; k++)
            values[n][k] = r * r * (1 + 2 * x) * start[k] + x * x * (3 - 2 * x) * end[k] +
                           h * x * r * (r * start_rate[k] - x * end_rate[k]);
    }
    for (int k = 0; k < ND; k++) s->left[k] = end[k];
    outcome = keep_quartic(i, s->t_kept, h, values);
    s->t_kept = s->t;
    memcpy(s->y_kept, s->y, sizeof y);
    for (int k = 0; k < NU; k++) s->u_kept[k] = s->w[1 + k];
    return outcome;
#else
    (void)i;
    return GOOD;
#endif
}

/* Notes that a jump (order 0), corner (1) or finer edge of every delayed signal's source comes back after its delay. */
Outcome keep_echo(Instance *i, double t, double order) {
    State *s = &i->s;
    if (!grow(&i->echo, &i->echo_room, s->echoes + 1, 2)) return NO_MEMORY;
    i->echo[2 * s->echoes] = t;
    i->echo[2 * s->echoes + 1] = order;
    s->echoes++;
    return GOOD;
}

/* The next instant after the present one at which a step has to end. */
double next_stop(const Instance *i, double end) {
    const State *s = &i->s;
    double stop = end;
    for (size_t k = 0; k < s->echoes; k++)
        if (i->echo[2 * k] > s->t) stop = fmin(stop, i->echo[2 * k]);
    for (int k = 0; k < NQ; k++) {
        if (s->tick[k] > s->t) stop = fmin(stop, s->tick[k]);
        if (s->publish[k] > s->t) stop = fmin(stop, s->publish[k]);
    }
    return stop;
}

/* The order of the edge that comes back at t, or -1; what is past is forgotten. */
double due_order(Instance *i, double t) {
    State *s = &i->s;
    size_t kept = 0;
    double order = -1.0;
    for (size_t k = 0; k < s->echoes; k++) {
        if (i->echo[2 * k] <= t) {
            order = fmax(order, i->echo[2 * k + 1]);
        } else {
            i->echo[2 * kept] = i->echo[2 * k];
            i->echo[2 * kept + 1] = i->echo[2 * k + 1];
            kept++;
        }
    }
    s->echoes = kept;
    return order;
}

/* At an instant of change: modes from the values, samples taken and published, edges noted for the delays.
   order: of the edge that the change makes in the sources if they do not jump, less 1; under 0 for no edge. */
Outcome event_update(Instance *i, double order) {
    State *s = &i->s;
    Args a;
    arguments(i, &a);
    s->from = s->t;
    s->until = INFINITY;
    outside(i, s->t);
    Outcome outcome = consistent(i, 1);
    if (outcome != GOOD) return outcome;
    double source[SOME(ND + NQ)];
    double held[SOME(NQ)]; /* a sample of the period before that is due now gives way to none taken now */
    int published = 0, due[SOME(NQ)];
    double now = s->t + 1e-13 * fmax(1.0, fabs(s->t));
    for (int k = 0; k < NQ; k++) {
        due[k] = s->publish[k] <= now;
        held[k] = s->pending[k];
    }
    for (int k = 0; k < NQ; k++)
        if (s->tick[k] <= now) {
            model_sources(&a, source);
            s->pending[k] = source[ND + k];
            s->publish[k] = s->t + s->timing[ND + NQ + k];
            s->ticks[k] += 1.0;
            s->tick[k] = s->start + s->ticks[k] * s->timing[ND + k];
        }
    for (int k = 0; k < NQ; k++)
        if (s->publish[k] <= now || due[k]) {
            s->w[FIRST_SAMPLED + k] = due[k] ? held[k] : s->pending[k];
            if (s->publish[k] <= now) s->publish[k] = INFINITY;
            published = 1;
        }
    if (published && (outcome = consistent(i, 1)) != GOOD) return outcome;
#if ND
    if (!s->begun || published || order >= 0.0) {
        model_sources(&a, source);
        for (int k = 0; k < ND; k++) {
            double earlier = s->begun ? s->left[k] : s->before[k];
            double following = fabs(source[k] - earlier) > 1e-12 * (1.0 + fabs(source[k])) ? 0.0 : fmax(order, 0.0) + 1.0;
            if (following <= 4.0 && (outcome = keep_echo(i, s->t + s->timing[k], following)) != GOOD) return outcome;
            s->left[k] = source[k];
        }
    }
#else
    (void)order;
#endif
    double values[SOME(NS)];
    model_switches(&a, values);
    note_switches(i, values);
    s->begun = 1;
    s->stale = s->disturbed = 0;
    s->until = next_stop(i, INFINITY);
    return GOOD;
}
