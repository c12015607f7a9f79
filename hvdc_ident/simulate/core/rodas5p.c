/* RODAS5P: G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the Julia Differential
   Equations package, BIT 63 (2023): order 5, stiffly accurate, L-stable, for index-1 DAEs, dense output of order 4. In the
   transformed form: stage i at y + sum a_ij k_j, right-hand side f + M sum c_ij k_j / h + h d_i f_t. */

#include "core.h"
#include "tableau.h"

/* Sums over stages with weights of one row, in the loop over the elements i. */
#define SUM1(w) (w)[0] * k0[i]
#define SUM2(w) SUM1(w) + (w)[1] * k1[i]
#define SUM3(w) SUM2(w) + (w)[2] * k2[i]
#define SUM4(w) SUM3(w) + (w)[3] * k3[i]
#define SUM5(w) SUM4(w) + (w)[4] * k4[i]
#define SUM6(w) SUM5(w) + (w)[5] * k5[i]
#define SUM7(w) SUM6(w) + (w)[6] * k6[i]
#define SUM8(w) SUM7(w) + (w)[7] * k7[i]

/* Write r->u, where the stage's right-hand side is taken (r->y at stage 0), and r->add, what is added to it.

   From stage 5 on the point is that of the stage before and its k, and the right-hand side has no f_t. */
static void rodas_prepare(run *r, integer stage)
{
    integer count = r->stride;
    const double *restrict k0 = r->k, *restrict k1 = k0 + count, *restrict k2 = k1 + count, *restrict k3 = k2 + count;
    const double *restrict k4 = k3 + count, *restrict k5 = k4 + count, *restrict k6 = k5 + count;
    const double *restrict y = r->y, *restrict mass = r->mass, *restrict ft = r->ft;
    double *restrict u = r->u, *restrict add = r->add;
    double inverse = 1.0 / r->hs, push = r->hs * RODAS_D[stage];
#define STAGE(number, point, sum)                                             \
    case number:                                                              \
        EACH(i, count) {                                 \
            u[i] = point;                                                     \
            add[i] = mass[i] * (inverse * (sum(RODAS_C[number]))) + push * ft[i]; \
        }                                                                     \
        break;
    switch (stage) {
    case 0:
        EACH(i, count)
            add[i] = push * ft[i];
        break;
        STAGE(1, y[i] + SUM1(RODAS_A[1]), SUM1)
        STAGE(2, y[i] + (SUM2(RODAS_A[2])), SUM2)
        STAGE(3, y[i] + (SUM3(RODAS_A[3])), SUM3)
        STAGE(4, y[i] + (SUM4(RODAS_A[4])), SUM4)
        STAGE(5, y[i] + (SUM5(RODAS_A[5])), SUM5)
        STAGE(6, u[i] + k5[i], SUM6)
        STAGE(7, u[i] + k6[i], SUM7)
    }
#undef STAGE
}

/* Factor M/(h gamma) - J. Returns false if it is singular.

   The generated one takes its pivots as they come: it is trusted where none is small against its row. */
static bool rodas_factor(run *r)
{
    integer n = r->n;
    double shift = 1.0 / (r->hs * RODAS_GAMMA);
    r->shift[0] = shift;
    if (r->factors) {
        r->do_lu(r->jac, r->yd, r->shift, r->yd, r->yd, r->m, r->factor);
        r->factored = r->factor[r->factors] < 1e7 ? 1 : 0;
        if (r->factored)
            return true;
    }
    for (integer q = 0; q < n * n; q++)
        r->matrix[q] = -r->jac[q];
    for (integer i = 0; i < r->nx; i++)
        r->matrix[i * n + i] += shift;
    r->factored = lu(r->matrix, r->pivots, n) ? 2 : 0;
    return r->factored > 0;
}

/* From the right-hand side in k, to which comes r->add, to the stage. */
static void rodas_solve(run *r, double *k)
{
    integer n = r->n, width = r->width;
    if (r->factored == 1) {
        r->do_solve(r->add, r->hessian, r->w, r->wd, r->factor, r->m, k);
        return;
    }
    EACH(q, r->stride)
        k[q] += r->add[q];
    solve(r->matrix, r->pivots, k, n);
    if (width == 0)
        return;
    double *rows = k + n;
    for (integer q = 0; q < r->hessians; q++)
        subtract(rows + r->hess_row[q] * width, r->hessian + q * width, -k[r->hess_column[q]], width);
    solve_rows(r->matrix, r->pivots, rows, n, width);
}

/* Write the quartic of the step that ended in r->yn into r->dense. */
static void rodas_dense(run *r)
{
    integer count = r->stride;
    const double *restrict k0 = r->k, *restrict k1 = k0 + count, *restrict k2 = k1 + count, *restrict k3 = k2 + count;
    const double *restrict k4 = k3 + count, *restrict k5 = k4 + count, *restrict k6 = k5 + count, *restrict k7 = k6 + count;
    const double *restrict y = r->y, *restrict yn = r->yn;
    double *restrict d0 = r->dense, *restrict d1 = d0 + count, *restrict d2 = d1 + count, *restrict d3 = d2 + count;
    EACH(i, count) {
        double a = SUM8(RODAS_H[0]), b = SUM8(RODAS_H[1]), c = SUM8(RODAS_H[2]);
        d0[i] = (yn[i] - y[i]) + a;
        d1[i] = b - a;
        d2[i] = c - b;
        d3[i] = -c;
    }
}

/* Write into r->e by how much the step's quartic is off at x in 0..1, as its defect tells; leaves its point there in r->u.

   What follows an input at once is right at the end of a step however long that is, and in between only as far as a quartic can be.
   Needs r->dense and the step's factors. */
static void rodas_defect(run *r, double x)
{
    const double *restrict a = r->dense, *restrict b = a + r->stride, *restrict c = b + r->stride, *restrict d = c + r->stride;
    const double *restrict mass = r->mass;
    double *restrict add = r->add, inverse = 1.0 / r->hs;
    interpolate(r, x, r->size, r->u);
    EACH(i, r->stride)
        add[i] = -mass[i] * inverse * (a[i] + x * (2 * b[i] + x * (3 * c[i] + x * 4 * d[i])));
    outside(r, r->t + x * r->hs, r->t);
    evaluate(r, r->do_rhs, r->u, r->e);
    rodas_solve(r, r->e);
}

/* One step into r->yn. Returns the error over the first `rows` unknowns. */
static double rodas_step(run *r, integer rows)
{
    outside(r, r->t, r->t);
    if (!r->again) {
        evaluate(r, r->do_jac, r->y, r->jac);
        if (r->forced)
            evaluate(r, r->do_ft, r->y, r->ft);
        if (r->hessians)
            evaluate(r, r->do_hess, r->y, r->hessian);
    }
    if (!rodas_factor(r))
        return INFINITY;
    r->evaluations += 8;
    for (integer stage = 0; stage < 8; stage++) {
        if (0 < stage && stage < 6) /* the later ones are taken at the same instant as 5 */
            outside(r, stage == 5 ? r->step_end : r->t + RODAS_TIME[stage] * r->hs, r->t);
        rodas_prepare(r, stage);
        double *k = r->k + r->stride * stage;
        evaluate(r, r->do_rhs, stage ? r->u : r->y, k);
        rodas_solve(r, k);
    }
    const double *restrict error = r->k + r->stride * 7, *restrict u = r->u;
    double *restrict yn = r->yn;
    EACH(i, r->stride)
        yn[i] = u[i] + error[i];
    double size = error_norm(r, error, rows);
    if (r->fresh && size <= 1.0) {
        /* A step from rest may be much longer than a fast mode, which has still to go where it stays while an input ramps: the
           quartic begins beside that. Once there it stays there. */
        rodas_dense(r);
        rodas_defect(r, 0.1);
        size = fmax(size, error_norm(r, r->e, rows));
    }
    return size;
}
