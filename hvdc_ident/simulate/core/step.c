/* One step over states and sensitivities as one flat vector: its error, its dense output. */

#include "core.h"

/* The sums over the unknowns of the squared errors of a block of columns, each over its tolerance: (rows, width) at e, y and yn. */
static void column_sums(const run *r, const double *restrict e, const double *restrict y, const double *restrict yn, integer rows)
{
    integer width = r->width;
    const double *restrict floors = r->floors;
    double *restrict totals = r->totals, rtol = r->rtol;
    for (integer c = 0; c < width; c += LANES) {
        double sum[LANES] = {0.0};
        for (integer i = 0; i < rows; i++) {
            const double *restrict own = e + i * width + c, *restrict a = y + i * width + c, *restrict b = yn + i * width + c;
            EACH(q, LANES) {
                double before = fabs(a[q]), after = fabs(b[q]);
                double share = own[q] / (floors[c + q] + rtol * (before > after ? before : after));
                sum[q] += share * share;
            }
        }
        for (integer q = 0; q < LANES; q++)
            totals[c + q] = sum[q];
    }
}

/* The largest weighted RMS of the error e over the first `rows` unknowns and each parameter's rows of these.

   More than 1 is a rejection; infinite where something is no number. */
static double error_norm(run *r, const double *e, integer rows)
{
    if (rows == 0)
        return 0.0;
    double worst = 0.0;
    for (integer i = 0; i < rows; i++) {
        double before = fabs(r->y[i]), after = fabs(r->yn[i]);
        double share = e[i] / (r->atol + r->rtol * (before > after ? before : after));
        worst += share * share;
    }
    if (r->width) {
        column_sums(r, e + r->n, r->y + r->n, r->yn + r->n, rows);
        double check = worst;
        for (integer c = 0; c < r->np; c++) {
            check += r->totals[c];
            worst = r->totals[c] > worst ? r->totals[c] : worst;
        }
        if (!(check < INFINITY))
            return INFINITY;
    }
    return worst < INFINITY ? sqrt(worst / (double)rows) : INFINITY;
}

/* Write the first `count` elements (and up to three more) of the step's quartic at x in 0..1 to `out`. */
static void interpolate(const run *r, double x, integer count, double *out)
{
    const double *restrict y = r->y, *restrict a = r->dense, *restrict b = a + r->stride, *restrict c = b + r->stride;
    const double *restrict d = c + r->stride;
    double *restrict u = out;
    integer whole = (count + LANES - 1) / LANES * LANES;
    EACH(i, whole)
        u[i] = y[i] + x * (a[i] + x * (b[i] + x * (c[i] + x * d[i])));
}
