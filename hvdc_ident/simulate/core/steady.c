/* Ways to a steady state: Newton's method with sensitivities, a path of values, following the model.

   All take the equations as a record whose fields the caller fills in this order, and scratch memory of their own. */

#include "core.h"

/* Generated functions of the steady-state equations, and the vectors that these take; every field takes eight bytes. */
typedef struct steady {
    function modes, rest, rest_jac, rest_p;
    integer nx, inner, first, n, width; /* states, elements of y, of w before the unknowns in it, unknowns, width of a row */
    integer ns, np, nw;                 /* switches, parameters, elements of w that are values */
    double *y, *w, *wd, *p, *m;
} steady;

static const double NEAR_LIMIT = 0.1; /* radians, or of a value above 1: the longest step across a limit; a sine is its tangent there */
static const double SAME = 1e-6;      /* of a value: places nearer than this are one steady state, reached by different arithmetic */

/* Vectors of a solver, one after the other in memory that is freed with the first. */
typedef struct scratch {
    double *memory;
    size_t used;
} scratch;

static bool begin_scratch(scratch *s, integer n, integer vectors, integer matrices)
{
    size_t each = (size_t)(n > 0 ? n : 1);
    s->memory = calloc(each * (size_t)vectors + each * each * (size_t)matrices, sizeof(double));
    s->used = 0;
    return s->memory != NULL;
}

static double *of_scratch(scratch *s, integer count)
{
    double *found = s->memory + s->used;
    s->used += (size_t)count;
    return found;
}

static void copy(double *to, const double *from, integer count)
{
    for (integer i = 0; i < count; i++)
        to[i] = from[i];
}

/* Write the residual at the unknowns v into r, (n,), with modes from the values; unknowns beyond y live in w. */
static void residual(const steady *e, const double *v, double *r)
{
    copy(e->y, v, e->inner);
    copy(e->w + e->first, v + e->inner, e->n - e->inner);
    e->modes(e->y, e->y, e->w, e->wd, e->p, e->m, e->m);
    e->rest(e->y, e->y, e->w, e->wd, e->p, e->m, r);
}

/* Write the Jacobian where the residual was taken last into jac (n, n), zeros where it has none. */
static void jacobian(const steady *e, double *jac)
{
    e->rest_jac(e->y, e->y, e->w, e->wd, e->p, e->m, jac);
}

/* Write what each equation's residual is measured by, size (n,) being the most that an unknown counts for. */
static void measures(const double *jac, const double *v, const double *size, double *weight, integer n)
{
    for (integer i = 0; i < n; i++) {
        double total = 0.0;
        for (integer j = 0; j < n; j++)
            total += fabs(jac[i * n + j]) * fmin(fmax(fabs(v[j]), TINY), size[j]);
        weight[i] = total > 0.0 ? total : 1.0;
    }
}

/* Norm of the residual, each equation by its own measure. */
static double norm(const double *r, const double *weight, integer n)
{
    double total = 0.0;
    for (integer i = 0; i < n; i++)
        total += (r[i] / weight[i]) * (r[i] / weight[i]);
    return sqrt(total);
}

/* Largest element of r against its weight; not a number where that is none. */
static double largest(const double *r, const double *weight, integer n)
{
    double found = 0.0;
    for (integer i = 0; i < n; i++) {
        double share = fabs(r[i]) / weight[i];
        if (share > found || share != share)
            found = share;
    }
    return found;
}

/* --- Newton's method --- */

/* Write the rows over the parameters of the steady state in y and w; false where the Jacobian is singular. */
static bool write_rows_at_rest(const steady *e, double *jac, integer *pivots)
{
    integer inner = e->inner, n = e->n, width = e->width;
    if (width == 0)
        return true;
    jacobian(e, jac);
    if (!lu(jac, pivots, n))
        return false;
    double *rows = calloc((size_t)(n * width + 1), sizeof(double));
    if (rows == NULL)
        return false;
    e->rest_p(e->y, e->y, e->w, e->wd, e->p, e->m, rows);
    solve_rows(jac, pivots, rows, n, width);
    double *of_y = e->y + inner, *of_w = e->w + e->first + n - inner;
    for (integer q = 0; q < inner * width; q++)
        of_y[q] = -rows[q];
    for (integer q = 0; q < (n - inner) * width; q++)
        of_w[q] = -rows[inner * width + q];
    free(rows);
    return true;
}

/* Find the steady state from y and w's unknowns on; write it there, with its rows over the parameters. 1: found, 0: not, -1: no
   memory.

   rule (2,): by how much at most each correction may shrink to the next, and the sign that the Jacobian's determinant has to have
   at the solution (0: any); with inf instead of the first, steps are halved until the residual falls. On return rule[1] is the
   sign found. Where undamped corrections at least halve, Kantorovich's condition holds (h <= 1/2 gives h / (2 (1 - h)) <= 1/2,
   Deuflhard 2004, Newton Methods, 2.1): the solution is the one that the start is connected with, no fold lies between. */
INTERFACE int hvdc_ident_newton(const steady *e, double *rule)
{
    integer n = e->n, inner = e->inner, small = 0;
    scratch s;
    if (!begin_scratch(&s, n, 9, 2))
        return -1;
    double *v = of_scratch(&s, n), *trial = of_scratch(&s, n), *r = of_scratch(&s, n), *ahead = of_scratch(&s, n);
    double *delta = of_scratch(&s, n), *weight = of_scratch(&s, n), *extent = of_scratch(&s, n), *size = of_scratch(&s, n);
    integer *pivots = (integer *)of_scratch(&s, n);
    double *jac = of_scratch(&s, n * n), *matrix = of_scratch(&s, n * n);
    bool guarded = rule[0] < INFINITY, failed = false;
    double wanted = rule[1], moved = INFINITY;
    for (integer i = 0; i < n; i++) {
        v[i] = i < inner ? e->y[i] : e->w[e->first + i - inner];
        extent[i] = fmax(fabs(v[i]), TINY);
    }
    residual(e, v, r);
    for (integer iteration = 0; iteration < 80 && small < 2; iteration++) {
        jacobian(e, jac);
        for (integer i = 0; i < n; i++) {
            weight[i] = 0.0;
            size[i] = fabs(v[i]) + 1e-3;
            for (integer j = 0; j < n; j++)
                weight[i] = fmax(weight[i], fabs(jac[i * n + j]) * fmax(fabs(v[j]), TINY));
            weight[i] = weight[i] > 0.0 ? weight[i] : 1.0;
        }
        double before = largest(r, weight, n);
        copy(matrix, jac, n * n);
        copy(delta, r, n);
        failed = !(before < INFINITY) || !lu(matrix, pivots, n);
        if (failed)
            break;
        solve(matrix, pivots, delta, n);
        double change = largest(delta, size, n), previous = moved;
        moved = largest(delta, extent, n);
        failed = !(change < 1e12) || (guarded && moved > 1e-9 && moved > rule[0] * previous);
        if (failed)
            break;
        double damping = 1.0;
        for (integer halving = 0; halving < 12; halving++) {
            for (integer i = 0; i < n; i++)
                trial[i] = v[i] - damping * delta[i];
            residual(e, trial, ahead);
            double after = largest(ahead, weight, n);
            if (guarded || after < before || after < 1e-13 || (change < 1e-9 && after < INFINITY))
                break;
            damping *= 0.5;
        }
        copy(v, trial, n);
        copy(r, ahead, n);
        if (change < 1e-10 && damping == 1.0)
            small += change < 1e-13 ? 2 : 1;
    }
    int found = 0;
    if (!failed) {
        rule[1] = orientation(matrix, pivots, n);
        found = small >= 2 && wanted * rule[1] >= 0.0 && write_rows_at_rest(e, jac, pivots);
    }
    free(s.memory);
    return found;
}

/* --- along a path of values --- */

/* What a path of values is followed by: the two ends, and scratch. */
typedef struct path {
    const steady *e;
    const double *ends_p, *ends_w; /* (2, np) and (2, nw) */
    double *extent, *off, *back, *r, *modes, *matrix;
    integer *pivots;
} path;

static void set_values(const path *a, double share)
{
    integer np = a->e->np, nw = a->e->nw;
    for (integer i = 0; i < np; i++)
        a->e->p[i] = a->ends_p[i] + share * (a->ends_p[np + i] - a->ends_p[i]);
    for (integer i = 0; i < nw; i++)
        a->e->w[i] = a->ends_w[i] + share * (a->ends_w[nw + i] - a->ends_w[i]);
}

/* How Newton's corrections went: whether they converged, the size of the first, and whether a limit was crossed. */
typedef struct corrected {
    bool converged, across;
    double first;
} corrected;

/* Correct x (n,) by undamped Newton steps, each at most half of the one before; leave the last Jacobian's factors.

   crossing: whether a step across a limit may be longer. */
static corrected correct(const path *a, double *x, bool crossing)
{
    const steady *e = a->e;
    integer n = e->n;
    double before = INFINITY;
    corrected found = {false, false, 0.0};
    for (integer k = 0; k < 12; k++) {
        copy(a->modes, e->m, e->ns);
        residual(e, x, a->r);
        for (integer q = 0; q < n * n; q++)
            a->matrix[q] = 0.0;
        jacobian(e, a->matrix);
        if (!lu(a->matrix, a->pivots, n))
            break;
        solve(a->matrix, a->pivots, a->r, n);
        double size = largest(a->r, a->extent, n);
        if (!(size < 1e12))
            break;
        if (k == 0)
            found.first = size;
        if (size < 1e-11 || (size < 1e-8 && size > 0.5 * before)) {
            found.converged = true;
            break;
        }
        bool cornered = false;
        for (integer i = 0; i < e->ns; i++)
            cornered = cornered || (crossing && k > 0 && a->modes[i] != e->m[i]);
        found.across = found.across || cornered;
        if (k > 0 && size > 0.5 * before && !cornered)
            break;
        for (integer i = 0; i < n; i++)
            x[i] -= a->r[i];
        before = size;
    }
    return found;
}

static double largest_change(const double *one, const double *other, const double *extent, integer n)
{
    double found = 0.0;
    for (integer i = 0; i < n; i++) {
        double share = fabs(one[i] - other[i]) / extent[i];
        if (share > found || share != share)
            found = share;
    }
    return found;
}

/* Write the steady state at the share `ahead` of the way into x; true where it is on the branch of v, the one at `share`. */
static bool advance(const path *a, double share, double ahead, const double *v, double *x, double sign)
{
    integer n = a->e->n;
    for (integer i = 0; i < n; i++)
        a->extent[i] = fmax(fabs(v[i]), TINY);
    set_values(a, ahead);
    copy(x, v, n);
    corrected there = correct(a, x, true);
    if (!there.converged || orientation(a->matrix, a->pivots, n) != sign)
        return false;
    set_values(a, share);
    residual(a->e, x, a->off);
    solve(a->matrix, a->pivots, a->off, n);
    if (!(largest_change(x, v, a->extent, n) <= there.first + largest(a->off, a->extent, n) + 1e-8))
        return false;
    if (there.across) {
        bool near = true;
        for (integer i = 0; i < n; i++)
            near = near && fabs(x[i] - v[i]) <= NEAR_LIMIT * fmax(fabs(v[i]), 1.0);
        return near;
    }
    copy(a->back, x, n);
    return correct(a, a->back, false).converged && largest_change(a->back, v, a->extent, n) < SAME;
}

/* Move v (n,), a steady state at the first of two sets of values, along the straight line between them. 1, or -1: no memory.

   ends_p (2, np), ends_w (2, nw): values of the parameters, and of time and inputs. way (2,): on entry the sign of the determinant
   at the start, on return the share reached, at which the values stand.

   A step counts where undamped Newton corrections at least halve (`hvdc_ident_newton` says why), the determinant keeps its sign,
   which a fold changes, the way is no longer than the two slopes at its ends allow: a jump to another branch is; and Newton's
   method leads back to where the step began, which from another branch it does not. (Corrections that halve on the way there
   show the condition in their own direction only.) Else it is halved. Across a limit, where the equations have a corner, no such
   ratio holds, and a long step may end anywhere: there it has to be short, within which the pieces are as good as straight. */
INTERFACE int hvdc_ident_continuation(const steady *e, const double *ends_p, const double *ends_w, double *v, double *way)
{
    integer n = e->n, most = n > e->ns ? n : e->ns;
    scratch s;
    if (!begin_scratch(&s, most, 7, 1))
        return -1;
    path a = {.e = e, .ends_p = ends_p, .ends_w = ends_w, .extent = of_scratch(&s, most), .off = of_scratch(&s, most),
              .back = of_scratch(&s, most), .r = of_scratch(&s, most), .modes = of_scratch(&s, most),
              .matrix = of_scratch(&s, n * n), .pivots = (integer *)of_scratch(&s, most)};
    double *x = of_scratch(&s, most), sign = way[0], share = 0.0, h = 1.0;
    while (share < 1.0 && h > SHORTEST) {
        h = fmin(h, 1.0 - share);
        double ahead = h < 1.0 - share ? share + h : 1.0;
        if (advance(&a, share, ahead, v, x, sign)) {
            copy(v, x, n);
            share = ahead;
            h *= 2.0;
        } else {
            h *= 0.5;
        }
    }
    set_values(&a, share);
    way[0] = share;
    free(s.memory);
    return 1;
}

/* --- slower ways --- */

/* Write the Jacobian (n, n) of an implicit Euler step of length h, jac being that of the residual; it may be matrix. */
static void euler_matrix(const double *jac, double h, integer nx, double *matrix, integer n)
{
    for (integer q = 0; q < n * n; q++)
        matrix[q] = -jac[q];
    for (integer i = 0; i < nx; i++)
        matrix[i * n + i] += 1.0 / h;
}

/* Write into off (n,) what an implicit Euler step of length h from v to x leaves, r being the residual at x. */
static void euler_residual(const double *r, const double *x, const double *v, double h, integer nx, double *off, integer n)
{
    for (integer i = 0; i < n; i++)
        off[i] = i < nx ? -r[i] + (x[i] - v[i]) / h : -r[i];
}

/* Vectors and a matrix of the slower ways. */
typedef struct slow {
    scratch s;
    double *r, *off, *ahead, *trial, *weight, *end, *jac, *other, *matrix;
    integer *pivots;
} slow;

static bool begin_slow(slow *a, integer n)
{
    if (!begin_scratch(&a->s, n, 7, 3))
        return false;
    double **vectors[] = {&a->r, &a->off, &a->ahead, &a->trial, &a->weight, &a->end};
    for (size_t k = 0; k < sizeof vectors / sizeof *vectors; k++)
        *vectors[k] = of_scratch(&a->s, n);
    a->pivots = (integer *)of_scratch(&a->s, n);
    a->jac = of_scratch(&a->s, n * n);
    a->other = of_scratch(&a->s, n * n);
    a->matrix = of_scratch(&a->s, n * n);
    return true;
}

/* Write the end of an implicit Euler step of length h from v into a->end; true where it was found.

   Newton's method; a change that leads past a jump is halved until it leads nearer, so that it ends within the edge. */
static bool euler_step(const steady *e, slow *a, const double *size, const double *v, double h)
{
    integer n = e->n, nx = e->nx;
    double goal = 1e-2 * ACCURACY, *x = a->end;
    copy(x, v, n);
    for (integer k = 0; k < 60; k++) {
        residual(e, x, a->r);
        jacobian(e, a->jac);
        euler_matrix(a->jac, h, nx, a->matrix, n);
        euler_residual(a->r, x, v, h, nx, a->off, n);
        measures(a->matrix, x, size, a->weight, n);
        double before = norm(a->off, a->weight, n);
        if (!(before < INFINITY))
            return false;
        if (k == 0)
            goal = fmax(goal, 1e-4 * before);
        if (before <= goal)
            return true;
        if (!lu(a->matrix, a->pivots, n))
            return false;
        solve(a->matrix, a->pivots, a->off, n);
        bool better = false;
        for (double damping = 1.0; damping > 1e-5 && !better; damping /= 2) {
            for (integer i = 0; i < n; i++)
                a->trial[i] = x[i] - damping * a->off[i];
            residual(e, a->trial, a->r);
            euler_residual(a->r, a->trial, v, h, nx, a->ahead, n);
            better = norm(a->ahead, a->weight, n) < before;
        }
        if (!better)
            return false;
        copy(x, a->trial, n);
    }
    return false;
}

/* Move v (n,) by implicit Euler steps whose length grows as the residual falls, one Newton step each: follow the model.

   size (n,): the most that each unknown counts for. 1, or -1: no memory. */
INTERFACE int hvdc_ident_pseudo_transient(const steady *e, const double *size, double *v)
{
    integer n = e->n;
    slow a;
    if (!begin_slow(&a, n))
        return -1;
    double *r = a.r, *step = a.off, *ahead = a.ahead, *trial = a.trial, h = 1e-4;
    residual(e, v, r);
    jacobian(e, a.jac);
    measures(a.jac, v, size, a.weight, n);
    double before = norm(r, a.weight, n);
    for (integer k = 0; k < 300; k++) {
        euler_matrix(a.jac, h, e->nx, a.matrix, n);
        copy(step, r, n);
        if (!lu(a.matrix, a.pivots, n)) {
            h *= 0.3;
            continue;
        }
        solve(a.matrix, a.pivots, step, n);
        for (integer i = 0; i < n; i++)
            trial[i] = v[i] + step[i];
        residual(e, trial, ahead);
        jacobian(e, a.other);
        measures(a.other, trial, size, a.weight, n);
        double after = norm(ahead, a.weight, n);
        if (after < INFINITY && (after < 1.5 * before || h < 1e-9)) {
            h = fmin(h * fmax(1.5, before / fmax(after, 1e-300)), 1e9);
            copy(v, trial, n);
            copy(r, ahead, n);
            copy(a.jac, a.other, n * n);
            before = after;
            if (after < 1e-2 * ACCURACY)
                break;
        } else {
            h *= 0.2;
            if (h < 1e-12)
                break;
        }
    }
    free(a.s.memory);
    return 1;
}

/* Move v (n,) by implicit Euler steps that are solved each: to a steady state on the edge of a jump too.

   A loop that rests there is driven to it from both sides: a step that is not solved for goes past the edge, and the next one
   back. Arguments and result as above. */
INTERFACE int hvdc_ident_implicit_euler(const steady *e, const double *size, double *v)
{
    integer n = e->n;
    slow a;
    if (!begin_slow(&a, n))
        return -1;
    double h = 1e-3;
    for (integer k = 0; k < 200; k++) {
        if (euler_step(e, &a, size, v, h)) {
            copy(v, a.end, n);
            residual(e, v, a.r);
            jacobian(e, a.jac);
            measures(a.jac, v, size, a.weight, n);
            if (norm(a.r, a.weight, n) < 1e-2 * ACCURACY)
                break;
            h = fmin(3.0 * h, 1e9);
        } else {
            h *= 0.25;
            if (h < 1e-12)
                break;
        }
    }
    free(a.s.memory);
    return 1;
}

/* Write the residual at v (n,) into r (n,), its Jacobian into jac (n, n, zeros before) and what each equation's residual is measured
   by into weights (n,). size (n,): the most that each unknown counts for. */
INTERFACE void hvdc_ident_judge(const steady *e, const double *size, const double *v, double *r, double *jac, double *weights)
{
    residual(e, v, r);
    jacobian(e, jac);
    measures(jac, v, size, weights, e->n);
}
