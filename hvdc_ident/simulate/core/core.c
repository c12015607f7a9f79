/* The whole core, each file after those that it uses. */

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
