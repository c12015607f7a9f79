/* Slides along the surface of a switch: how a run begins and ends one, and stays on the surface.

   The equations of a slide come when a run first needs them (SLIDING); here the record of the run is given their functions and
   sizes, its `head`, and the vector of states and unknowns their layout. */

#include "core.h"

static const double NEAR_SURFACE = 100.0; /* slacks within which a switch that a step aimed at counts as met */

static const head *head_of(const run *r, integer row)
{
    return (const head *)r->heads + row;
}

/* Take functions and sizes from a row of r->heads: of the slide on that switch, or the last, of no slide. */
static void use(run *r, integer row)
{
    *(head *)r = *head_of(r, row);
    for (integer q = 0; q < r->stride; q++)
        r->mass[q] = 0.0;
    for (integer i = 0; i < r->nx; i++) {
        r->mass[i] = 1.0;
        for (integer c = 0; c < r->width; c++)
            r->mass[r->n + i * r->width + c] = 1.0;
    }
}

/* Note whether the right-hand side may change with time alone in this segment. */
static void force(run *r)
{
    r->forced = r->timed > 0 || r->nd > 0 || !r->still;
    if (!r->forced)
        for (integer q = 0; q < r->stride; q++)
            r->ft[q] = 0.0;
}

/* Use another row of r->heads and lay out r->y for it; each copy of the unknowns begins with the values of the first. */
static void change_equations(run *r, integer row)
{
    integer nx = r->nx, nz = r->nz, count = nx * r->width;
    for (integer q = 0; q < count; q++)
        r->f_after[q] = r->y[r->n + q];
    use(r, row);
    for (integer q = nz; q < r->nz; q++)
        r->y[nx + q] = r->y[nx + q % nz];
    for (integer q = 0; q < count; q++)
        r->y[r->n + q] = r->f_after[q];
    force(r);
}

/* The distance from 0 at which the sliding switch counts as 0. */
static double widest(const run *r)
{
    return 0.01 * r->rtol * r->surface_top + 1e-14;
}

/* Use the equations of no slide again. */
static void leave_slide(run *r)
{
    r->top[r->sliding] = r->surface_top;
    r->slack[r->sliding] = widest(r);
    change_equations(r, r->ns);
}

/* True where the side that was just entered leads back to the surface of the switch `event`.

   before: the switch's value on the other side. Where a hysteresis parts the sides there is no common surface. */
static bool leads_back(run *r, integer event, double before)
{
    evaluate(r, r->do_sw, r->y, r->sv);
    if (fabs(r->sv[event] - before) > 2.0 * r->slack[event] || !rates(r))
        return false;
    evaluate(r, r->do_swd, r->y, r->sv);
    return (2.0 * r->m[event] - 1.0) * r->sv[event] > 0.0;
}

/* True where both sides lead to the surface and the present state is on it; leaves the surface's data in r->surface. */
static bool slides_on(run *r)
{
    evaluate(r, r->do_surface, r->y, r->surface);
    double value = r->surface[0], share = r->surface[1], approach = r->surface[2];
    bool between = share * (1.0 - share) >= -r->slack[r->sliding];
    return fabs(value) <= NEAR_SURFACE * widest(r) && approach > 0.0 && between;
}

/* Bring states and sensitivities back to the surface, along the difference of the sides' fields.

   At the entry that is the jump of the sensitivities: from either side it makes the switch's own sensitivity 0. */
static void to_surface(run *r)
{
    integer nx = r->nx, n = r->n, width = r->width;
    evaluate(r, r->do_surface, r->y, r->surface);
    for (integer i = 0; i < nx; i++) {
        double back = r->surface[3 + i];
        r->y[i] -= r->surface[0] * back;
        for (integer c = 0; c < width; c++)
            r->y[n + i * width + c] -= r->surface[3 + nx + c] * back;
    }
    consistent(r, false);
}

/* After a step of a slide: return to the surface where its error has led away from it. */
static void stay_on_surface(run *r)
{
    outside(r, r->t, r->t);
    evaluate(r, r->do_surface, r->y, r->surface);
    if (fabs(r->surface[0]) > widest(r)) {
        to_surface(r);
        evaluate(r, r->do_rhs, r->y, r->k);
        r->fresh = 1;
    }
}

/* Slide on a switch from the present state on, where both sides lead to its surface. */
static enum status begin_slide(run *r, integer event)
{
    if (r->sliding != NONE)
        return TWO_SLIDES;
    if (head_of(r, event)->n == 0)
        return SLIDING;
    double side = r->m[event];
    change_equations(r, event);
    integer twin = r->twin;
    double other = twin == NONE ? 0.0 : r->m[twin];
    r->surface_top = r->top[event];
    r->top[event] = 0.25; /* of a (1 - a) */
    r->slack[event] = 0.01 * r->rtol * r->top[event] + 1e-14;
    r->m[event] = 0.0;
    if (twin != NONE)
        r->m[twin] = 0.0;
    if (consistent(r, false) && slides_on(r)) {
        to_surface(r);
        if (slides_on(r)) /* beside the surface a steep field without a jump leads to it too */
            return CONVERGED;
    }
    leave_slide(r);
    r->m[event] = side;
    if (twin != NONE)
        r->m[twin] = other;
    return consistent(r, false) ? CONVERGED : INCONSISTENT;
}

/* End the slide on the side whose share is the larger. False where the unknowns have no solution there. */
static bool end_slide(run *r)
{
    evaluate(r, r->do_surface, r->y, r->surface);
    integer event = r->sliding, twin = r->twin;
    double side = r->surface[1] > 0.5 ? 1.0 : 0.0;
    leave_slide(r);
    r->m[event] = side;
    if (twin != NONE)
        r->m[twin] = 1.0 - side;
    return consistent(r, false);
}

/* Solve the unknowns after a jump, with modes found from the values; a slide goes on where it can. False: no solution.

   In between the run has no slide: the modes that the values say are those of the sides. */
static bool settle(run *r)
{
    integer event = r->sliding;
    if (event != NONE)
        leave_slide(r);
    if (!consistent(r, true))
        return false;
    if (event == NONE)
        return true;
    evaluate(r, r->do_sw, r->y, r->sv);
    if (fabs(r->sv[event]) > NEAR_SURFACE * widest(r))
        return true;
    return begin_slide(r, event) == CONVERGED;
}
