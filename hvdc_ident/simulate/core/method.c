/* The two integrators behind one step. */

#include "core.h"

/* One step of length r->hs from (r->t, r->y) into r->yn; r->error says how good it is. */
static void attempt(run *r)
{
    /* An unknown may have an infinite slope for an instant, as sqrt(1.1^2 - i^2) where i meets its limit. The states pass it; very
       short steps are judged by them alone. */
    integer rows = r->hs > 1e-6 * r->span || r->nx == 0 ? r->n : r->nx;
    r->error = r->rosenbrock ? rodas_step(r, rows) : dopri_step(r, rows);
}

/* Write the quartic of the step that ended in r->yn into r->dense. */
static void make_dense(run *r)
{
    if (r->rosenbrock)
        rodas_dense(r);
    else
        dopri_dense(r);
}
