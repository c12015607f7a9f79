/* What the files of this FMU share: an instance, which holds a run of the core. Sizes are in model.h, which is generated. */
#ifndef HVDC_INTERNAL_H
#define HVDC_INTERNAL_H

#include <stdarg.h>
#include <stdio.h>
#include <string.h>

#include "core.h"
#include "model.h"

#define SOME(n) ((n) > 0 ? (n) : 1) /* C has no arrays of length 0 */
#define NY (NX + NZ)                /* states and algebraic unknowns */
#define NW (1 + NU + ND + NQ)       /* time, inputs, delayed signals, sampled values */
#define NV (NX + NZ + ND + NQ)      /* unknowns of the steady start */
#define FIRST_DELAY (1 + NU)

/* Value references, in ranges of one kind each. */
#define REF_TIME 0
#define REF_INPUT 1
#define REF_STATE (REF_INPUT + NU)
#define REF_RATE (REF_STATE + NX)
#define REF_OUTPUT (REF_RATE + NX)
#define REF_PARAMETER (REF_OUTPUT + NO)
#define REF_INDICATOR (REF_PARAMETER + NP)
#define REF_END (REF_INDICATOR + NS)

typedef enum { INSTANTIATED, INITIALIZATION, EVENT, CONTINUOUS, STEP, TERMINATED, FAILED } Phase;

/* What an instance holds beside its run. */
typedef struct {
    int phase;
    double p[SOME(NP)];
    double given[SOME(NX)];                                  /* where the search for the steady start begins */
    double u0[SOME(NU)], slope[SOME(NU)], t_input[SOME(NU)]; /* inputs are u0 + slope (t - t_input) */
    int slope_given[SOME(NU)];                               /* whether the slope was set for the step to come */
    double times[SOME(2 * NU)], values[SOME(2 * NU)];        /* the same as the core reads it: two points each */
    integer pointer[NU + 1];
    double timing[SOME(ND + 2 * NQ)];                        /* delay times, sampling periods, compute times */
    double from;                                             /* where the present segment begins */
    double limit;                                            /* model exchange: how far a step may go without an event */
    double t_kept, y_kept[SOME(NY)], u_kept[SOME(NU)];       /* model exchange: where the history ends */
    int stale;     /* the algebraic unknowns do not belong to the present values yet */
    int disturbed; /* something was set from outside since the last step */
} State;

typedef struct {
    State s;
    run r;
    double *work; /* the run's vectors */
    size_t doubles;
    int cosimulation;
    void *environment;
    void (*logger)(void); /* of the type that the version of the standard says */
    int logging;
    char *name;
    char message[400];
} Instance;

#endif
