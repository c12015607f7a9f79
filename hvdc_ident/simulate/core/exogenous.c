/* What comes from outside at an instant: time, inputs, delayed signals, held samples. */

#include "core.h"

/* Write the inputs and their slopes at t into w and wd: at r->tb, the segment's end, the values before a jump. */
static void write_inputs(run *r, double t)
{
    for (integer i = 0; i < r->nu; i++) {
        integer begin = r->pointer[i], end = r->pointer[i + 1], k = r->at[i];
        const double *times = r->times, *values = r->values;
        while (k + 1 < end && (times[k + 1] < t || (times[k + 1] == t && t < r->tb)))
            k++;
        while (k > begin && (times[k] > t || (times[k] == t && t >= r->tb)))
            k--;
        r->at[i] = k; /* where the next instant is looked for: a record may have thousands of rows */
        double slope = 0.0;
        if (k + 1 < end && t >= times[k] && times[k + 1] > times[k])
            slope = (values[k + 1] - values[k]) / (times[k + 1] - times[k]);
        r->w[1 + i] = slope != 0.0 ? values[k] + slope * (t - times[k]) : values[k];
        r->wd[1 + i] = slope;
    }
}

/* The step of the history in which an instant lies. A row: instant, length, then polynomials (delay, NODES, 1 + width). */
static integer step_of_history(const run *r, double s, integer line)
{
    integer low = 0, high = r->kept - 1;
    while (low < high) {
        integer middle = (low + high + 1) / 2;
        if (r->history[middle * line] <= s)
            low = middle;
        else
            high = middle - 1;
    }
    return low;
}

/* Write the delayed signals, their rates and their rows over the parameters at t into w and wd.

   Before the start the signals are constant. Instants are kept just inside the segment from ta to r->tb, so that a jump at its
   ends is seen from the inside. */
static void write_delayed(run *r, double t, double ta)
{
    integer width = r->width, rows = 1 + width, line = 2 + r->nd * NODES * rows;
    double inside = 1e-13 * fmax(1.0, fabs(r->tb));
    for (integer i = 0; i < r->nd; i++) {
        double s = fmin(fmax(t, ta + inside), r->tb - inside) - r->lag[i];
        double *value = r->w + 1 + r->nu + i, *rate = r->wd + 1 + r->nu + i;
        double *row = r->w + r->nw + i * width, *row_rate = r->wd + r->nw + i * width;
        if (s <= r->start || r->kept == 0) {
            *value = r->before[i * rows];
            *rate = 0.0;
            for (integer c = 0; c < width; c++) {
                row[c] = r->before[i * rows + 1 + c];
                row_rate[c] = 0.0;
            }
            continue;
        }
        const double *step = r->history + step_of_history(r, s, line) * line;
        const double *c0 = step + 2 + i * NODES * rows, *c1 = c0 + rows, *c2 = c1 + rows, *c3 = c2 + rows, *c4 = c3 + rows;
        double scale = 1.0 / step[1], x = (s - step[0]) / step[1];
        double bend = scale * scale * (2 * c2[0] + x * (6 * c3[0] + x * 12 * c4[0]));
        *value = c0[0] + x * (c1[0] + x * (c2[0] + x * (c3[0] + x * c4[0])));
        *rate = scale * (c1[0] + x * (2 * c2[0] + x * (3 * c3[0] + x * 4 * c4[0])));
        for (integer c = 0; c < width; c++) { /* the delay itself may depend on the parameter */
            integer j = 1 + c;
            double own = c0[j] + x * (c1[j] + x * (c2[j] + x * (c3[j] + x * c4[j])));
            double slope = scale * (c1[j] + x * (2 * c2[j] + x * (3 * c3[j] + x * 4 * c4[j])));
            row[c] = own - *rate * r->lag_p[i * width + c];
            row_rate[c] = slope - bend * r->lag_p[i * width + c];
        }
    }
}

/* Write all that comes from outside at t, within the segment from ta to r->tb, into w and wd. */
static void outside(run *r, double t, double ta)
{
    r->w[0] = t;
    if (r->quiet)
        return;
    if (!r->still)
        write_inputs(r, t);
    if (r->nd)
        write_delayed(r, t, ta);
}

/* Move every input's place to the piece right of r->t; true where that piece reaches to r->tb for all of them. */
static bool enter_segment(run *r)
{
    bool whole = true;
    for (integer i = 0; i < r->nu; i++) {
        integer begin = r->pointer[i], end = r->pointer[i + 1], k = r->at[i];
        const double *times = r->times;
        while (k + 1 < end && times[k + 1] <= r->t)
            k++;
        while (k > begin && times[k] > r->t)
            k--;
        r->at[i] = k;
        double until = k + 1 < end ? times[k + 1] : INFINITY;
        if (times[k] > r->t) /* before the first point */
            until = times[k];
        whole = whole && until >= r->tb;
    }
    return whole;
}

/* Write into c (5, count) the power coefficients of the quartics through v (5, count) at 0, 1/4, 1/2, 3/4, 1. */
static void quartics(const double *restrict v, double *restrict c, integer count)
{
    EACH(j, count) {
        double v0 = v[j], v1 = v[count + j], v2 = v[2 * count + j], v3 = v[3 * count + j], v4 = v[4 * count + j];
        c[j] = v0;
        c[count + j] = (-25 * v0 + 48 * v1 - 36 * v2 + 16 * v3 - 3 * v4) / 3;
        c[2 * count + j] = (70 * v0 - 208 * v1 + 228 * v2 - 112 * v3 + 22 * v4) / 3;
        c[3 * count + j] = (-80 * v0 + 288 * v1 - 384 * v2 + 224 * v3 - 48 * v4) / 3;
        c[4 * count + j] = (32 * v0 - 128 * v1 + 192 * v2 - 128 * v3 + 32 * v4) / 3;
    }
}
