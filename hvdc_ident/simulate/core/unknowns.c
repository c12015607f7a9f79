/* The algebraic unknowns: solved for the present states and modes, with their sensitivities and their rates. */

#include "core.h"

/* Call a generated function at the flat vector y, with what comes from outside as it stands. */
static void evaluate(const run *r, function code, const double *y, double *out)
{
    code(y, r->yd, r->w, r->wd, r->p, r->m, out);
}

/* Factor the Jacobian of the unknowns' equations by the unknowns; r->jac has to be up to date. */
static bool factor_loop(run *r)
{
    integer nx = r->nx, nz = r->nz, n = r->n;
    for (integer i = 0; i < nz; i++)
        for (integer j = 0; j < nz; j++)
            r->small[i * nz + j] = r->jac[(nx + i) * n + nx + j];
    return lu(r->small, r->small_pivots, nz);
}

/* Newton's method on the unknowns; leaves the Jacobian's factors. Returns whether it converged. */
static bool solve_unknowns(run *r, bool live)
{
    integer nx = r->nx, n = r->n;
    bool converged = false;
    double largest = INFINITY;
    for (integer iteration = 0; iteration < (live && r->ns ? 20 : 60); iteration++) {
        double damping = iteration < 20 ? 1.0 : 0.5;
        evaluate(r, r->do_f, r->y, r->e);
        evaluate(r, r->do_jac, r->y, r->jac);
        if (!factor_loop(r))
            return false;
        solve(r->small, r->small_pivots, r->e + nx, r->nz);
        largest = 0.0;
        for (integer i = nx; i < n; i++) {
            r->y[i] -= damping * r->e[i];
            double share = fabs(r->e[i]) / (1.0 + fabs(r->y[i]));
            if (!(share <= largest)) /* also where it is no number */
                largest = share;
        }
        if (!(largest < INFINITY))
            return false;
        if (live)
            evaluate(r, r->do_modes, r->y, r->m);
        if (largest < 1e-14 || (converged && largest < 1e-12))
            return true;
        converged = largest < 1e-12;
    }
    return largest < 1e-10;
}

/* The largest residual of the unknowns' equations against their size, left in r->e, with modes from the values. */
static double loop_residual(run *r)
{
    double largest = 0.0;
    evaluate(r, r->do_modes, r->y, r->m);
    evaluate(r, r->do_f, r->y, r->e);
    for (integer i = r->nx; i < r->n; i++) {
        double size = fabs(r->e[i]) / (1.0 + fabs(r->y[i]));
        if (!(size <= largest))
            largest = size;
    }
    return largest;
}

/* Go that share of the step from its origin; returns the residual there. */
static double move_unknowns(run *r, double share)
{
    for (integer i = 0; i < r->nz; i++)
        r->y[r->nx + i] = r->z_from[i] - share * r->z_step[i];
    return loop_residual(r);
}

/* True where a mode differs from those at the step's origin. */
static bool is_other_side(const run *r)
{
    bool changed = false;
    for (integer k = 0; k < r->ns; k++)
        changed |= r->m[k] != r->side[k];
    return changed;
}

/* Newton's direction from limit to limit (Katzenelson 1965), for equations in pieces. Returns whether it arrived.

   A step ends where the residual has fallen enough; else just beyond the next limit, with the modes of its other side. From side to
   side the residual falls along one line, so that the way cannot cycle unless the loop's determinant changes its sign at a
   limit. */
static bool solve_from_limit_to_limit(run *r)
{
    integer nx = r->nx, nz = r->nz;
    for (integer round = 0; round < 200; round++) {
        double before = loop_residual(r);
        if (before < 1e-13)
            return true;
        evaluate(r, r->do_jac, r->y, r->jac);
        if (!(before < INFINITY) || !factor_loop(r))
            return false;
        solve(r->small, r->small_pivots, r->e + nx, nz);
        for (integer i = 0; i < nz; i++) {
            r->z_step[i] = r->e[nx + i];
            r->z_from[i] = r->y[nx + i];
        }
        for (integer k = 0; k < r->ns; k++)
            r->side[k] = r->m[k];
        double share = 1.0, beyond = 0.0;
        bool accepted = false, other = false;
        for (integer halving = 0; halving < 50; halving++) {
            double after = move_unknowns(r, share);
            other = is_other_side(r);
            accepted = after <= (1.0 - 0.1 * share) * before;
            if (accepted)
                break;
            if (other)
                beyond = share;
            share *= 0.5;
        }
        if (beyond > 0.0 && !(accepted && other)) {
            double good = accepted ? share : 0.0;
            while (beyond - good > 1e-13 && beyond - good > 1e-3 * beyond) {
                double middle = 0.5 * (good + beyond);
                move_unknowns(r, middle);
                if (is_other_side(r))
                    beyond = middle;
                else
                    good = middle;
            }
            move_unknowns(r, beyond);
        } else if (!accepted) {
            return before < 1e-12;
        }
    }
    return false;
}

/* Solve the unknowns (and their sensitivities) for the present states, with modes found from the values where `live`.

   Returns whether a solution was found. Where Newton's method cycles between the sides of a limit, the way is followed from limit to
   limit, from the values before. Uses r->e as scratch. */
static bool consistent(run *r, bool live)
{
    integer nx = r->nx, nz = r->nz, n = r->n, width = r->width;
    if (live)
        evaluate(r, r->do_modes, r->y, r->m);
    if (nz == 0)
        return true;
    for (integer i = 0; i < nz; i++)
        r->z_before[i] = r->y[nx + i];
    if (!solve_unknowns(r, live)) {
        if (!(live && r->ns))
            return false;
        for (integer i = 0; i < nz; i++)
            r->y[nx + i] = r->z_before[i];
        if (!solve_from_limit_to_limit(r) || !solve_unknowns(r, true))
            return false;
    }
    if (width) {
        double *rows = r->e + n + nx * width, *own = r->y + n + nx * width;
        for (integer q = 0; q < nz * width; q++)
            own[q] = 0.0;
        evaluate(r, r->do_fs, r->y, r->e);
        solve_rows(r->small, r->small_pivots, rows, nz, width);
        for (integer q = 0; q < nz * width; q++)
            own[q] = -rows[q];
    }
    return true;
}

/* Write the rates of states and unknowns into r->yd; needs modes and values that are consistent. Uses r->e as scratch. */
static bool rates(run *r)
{
    integer nx = r->nx, n = r->n;
    evaluate(r, r->do_f, r->y, r->e);
    for (integer i = 0; i < nx; i++)
        r->yd[i] = r->e[i];
    if (r->nz == 0)
        return true;
    evaluate(r, r->do_jac, r->y, r->jac);
    evaluate(r, r->do_ft, r->y, r->e);
    for (integer i = nx; i < n; i++) {
        double total = -r->e[i];
        for (integer j = 0; j < nx; j++)
            total -= r->jac[i * n + j] * r->yd[j];
        r->e[i] = total;
    }
    if (!factor_loop(r))
        return false;
    solve(r->small, r->small_pivots, r->e + nx, r->nz);
    for (integer i = nx; i < n; i++)
        r->yd[i] = r->e[i];
    return true;
}
