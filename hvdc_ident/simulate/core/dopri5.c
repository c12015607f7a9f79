/* DOPRI5: Dormand and Prince 1980 with the dense output of Hairer, Norsett and Wanner, Solving ODEs I, II.6. */

#include "core.h"

static const double DOPRI_A[7][6] = {
    {0},
    {1.0 / 5},
    {3.0 / 40, 9.0 / 40},
    {44.0 / 45, -56.0 / 15, 32.0 / 9},
    {19372.0 / 6561, -25360.0 / 2187, 64448.0 / 6561, -212.0 / 729},
    {9017.0 / 3168, -355.0 / 33, 46732.0 / 5247, 49.0 / 176, -5103.0 / 18656},
    {35.0 / 384, 0.0, 500.0 / 1113, 125.0 / 192, -2187.0 / 6784, 11.0 / 84},
};
static const double DOPRI_TIME[7] = {0.0, 1.0 / 5, 3.0 / 10, 4.0 / 5, 8.0 / 9, 1.0, 1.0};
static const double DOPRI_E[7] = {71.0 / 57600, 0.0, -71.0 / 16695, 71.0 / 1920, -17253.0 / 339200, 22.0 / 525, -1.0 / 40};
static const double DOPRI_DENSE[7] = {-12715105075.0 / 11282082432.0, 0.0, 87487479700.0 / 32700410799.0,
                                      -10690763975.0 / 1880347072.0, 701980252875.0 / 199316789632.0,
                                      -1453857185.0 / 822651844.0, 69997945.0 / 29380423.0};

/* Write where the stage's right-hand side is taken into r->u, or into r->yn for the last one; returns that vector. */
static double *dopri_prepare(run *r, integer stage)
{
    integer count = r->stride;
    const double *restrict k0 = r->k, *restrict k1 = k0 + count, *restrict k2 = k1 + count, *restrict k3 = k2 + count;
    const double *restrict k4 = k3 + count, *restrict k5 = k4 + count, *restrict y = r->y;
    double *point = stage == 6 ? r->yn : r->u, *restrict u = point;
    double h = r->hs;
#define STAGE(number, sum)                              \
    case number:                                        \
        EACH(i, count)             \
            u[i] = y[i] + h * (sum(DOPRI_A[number]));   \
        break;
    switch (stage) {
        STAGE(1, SUM1)
        STAGE(2, SUM2)
        STAGE(3, SUM3)
        STAGE(4, SUM4)
        STAGE(5, SUM5)
        STAGE(6, SUM6)
    }
#undef STAGE
    return point;
}

/* The square of h times the largest mode, as the last two stages show it (Hairer and Wanner, IV.2). */
static double dopri_stiffness(const run *r)
{
    const double *before = r->k + 5 * r->stride, *after = r->k + 6 * r->stride;
    double top = 0.0, bottom = 0.0;
    for (integer i = 0; i < r->nx; i++) {
        top += (after[i] - before[i]) * (after[i] - before[i]);
        bottom += (r->yn[i] - r->u[i]) * (r->yn[i] - r->u[i]);
    }
    return bottom > 0.0 ? r->hs * r->hs * top / bottom : 0.0;
}

/* One step into r->yn. Returns the error over the first `rows` unknowns. */
static double dopri_step(run *r, integer rows)
{
    integer count = r->stride;
    if (!r->fresh)
        EACH(i, count)
            r->k[i] = r->k[6 * count + i];
    r->evaluations += 6;
    for (integer stage = 1; stage < 7; stage++) {
        outside(r, stage < 5 ? r->t + DOPRI_TIME[stage] * r->hs : r->step_end, r->t);
        evaluate(r, r->do_rhs, dopri_prepare(r, stage), r->k + count * stage);
    }
    r->stiffness = dopri_stiffness(r);
    const double *restrict k0 = r->k, *restrict k1 = k0 + count, *restrict k2 = k1 + count, *restrict k3 = k2 + count;
    const double *restrict k4 = k3 + count, *restrict k5 = k4 + count, *restrict k6 = k5 + count;
    double *restrict e = r->e, h = r->hs;
    EACH(i, count)
        e[i] = h * (SUM7(DOPRI_E));
    return error_norm(r, r->e, rows);
}

/* Write the quartic of the step that ended in r->yn into r->dense. */
static void dopri_dense(run *r)
{
    integer count = r->stride;
    const double *restrict k0 = r->k, *restrict k1 = k0 + count, *restrict k2 = k1 + count, *restrict k3 = k2 + count;
    const double *restrict k4 = k3 + count, *restrict k5 = k4 + count, *restrict k6 = k5 + count;
    const double *restrict y = r->y, *restrict yn = r->yn;
    double *restrict d0 = r->dense, *restrict d1 = d0 + count, *restrict d2 = d1 + count, *restrict d3 = d2 + count;
    double h = r->hs;
    EACH(i, count) {
        double change = yn[i] - y[i], bend = h * k0[i] - change, curl = change - h * k6[i] - bend;
        double end = h * (SUM7(DOPRI_DENSE));
        d0[i] = change + bend;
        d1[i] = curl - bend + end;
        d2[i] = -curl - 2.0 * end;
        d3[i] = end;
    }
}
