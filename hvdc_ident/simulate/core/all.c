/* The library: the whole core in one unit, so that the compiler sees all of it at once, and what a caller in another language asks. */

#include "core.c"

/* Doubles of workspace that a run takes. r: with the sizes of the largest equations that it may use. */
integer hvdc_ident_room(const run *r)
{
    run copy = *r;
    return (integer)arrange(&copy, NULL);
}

/* Integrate from r->start to r->end and write the outputs and their rows into r->out (n_out, no (1 + width)). Returns a status;
   r->t is the instant reached.

   r: with zeros but for the sizes of the largest equations it may use, heads (switches + 1: of the slide on each switch, zeros
   where there are none yet, then those without a slide), the instants, tolerances, max_steps, slides, and the caller's vectors:
   p, constants (delay times, sampling periods and compute times with their rows), breaks (2, n_breaks: instants at which a step
   ends, and whether delays bring them back), pointer, times and values of the inputs' pieces, t_out, out, scale of each
   parameter. work: zeros, as many doubles as `hvdc_ident_room` says. y: the flat start vector, consistent to solver tolerance;
   w: what comes from outside there, with rows. */
int hvdc_ident_integrate(run *r, double *work, const double *y, const double *w)
{
    arrange(r, work);
    use(r, r->ns);
    begin_run(r, y, w);
    enum status status = run_segments(r);
    if (status == CONVERGED && !make_rooms(r))
        status = OUT_OF_MEMORY;
    if (status == CONVERGED && !begin_segment(r))
        status = INCONSISTENT;
    free(r->history);
    free(r->echo);
    r->history = r->echo = NULL;
    return status;
}

/* Fields of a run's record, by which a caller sees that it was built with the same header. */
integer hvdc_ident_fields(void)
{
    return (integer)(sizeof(run) / sizeof(integer));
}

/* Call a generated function so many times, to measure what it costs. */
void hvdc_ident_repeat(function code, const double *y, const double *w, const double *p, const double *m, double *out, integer count)
{
    for (integer k = 0; k < count; k++)
        code(y, y, w, w, p, m, out);
}
