/* The whole core in one unit, so that the compiler sees all of it at once. */

#include "linear.c"
#include "exogenous.c"
#include "unknowns.c"
#include "step.c"
#include "rodas5p.c"
#include "dopri5.c"
#include "method.c"
#include "sliding.c"
#include "events.c"
#include "segments.c"
#include "integrate.c"
#include "steady.c"
