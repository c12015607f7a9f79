/* What the files of this FMU share. The model's sizes and functions are in model.h, which is generated. */
#ifndef HVDC_INTERNAL_H
#define HVDC_INTERNAL_H

#include <math.h>
#include <stddef.h>
#include <stdlib.h>
#include <string.h>

#include "model.h"

#define SOME(n) ((n) > 0 ? (n) : 1) /* C has no arrays of length 0 */
#define NY (NX + NZ)                /* states and algebraic unknowns */
#define NW (1 + NU + ND + NQ)       /* time, inputs, delayed signals, sampled values */
#define NV (NX + NZ + ND + NQ)      /* unknowns of the steady start */
#define FIRST_DELAY (1 + NU)
#define FIRST_SAMPLED (1 + NU + ND)
#define NODES 5                     /* a delayed signal is kept as a quartic in each step */
#define HISTORY_ROW (2 + NODES * ND)

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

typedef enum { GOOD, STEP_LIMIT, NOT_FINITE, CHATTER, INCONSISTENT, NO_START, BAD_TIMING, NO_MEMORY } Outcome;

/* Everything that a copy of the FMU's state has to hold, but for the two tables of variable length. */
typedef struct {
    int phase;
    double t, start, span, rtol, atol;
    double y[SOME(NY)], yd[SOME(NY)], w[NW], wd[NW], p[SOME(NP)], m[SOME(NS)];
    double given[SOME(NX)];                  /* where the search for the steady start begins */
    double u0[SOME(NU)], slope[SOME(NU)], t_input[SOME(NU)]; /* inputs are u0 + slope (t - t_input) */
    int slope_given[SOME(NU)];               /* whether the slope was set for the step to come */
    double timing[SOME(ND + 2 * NQ)];        /* delay times, sampling periods, compute times */
    double top[SOME(NS)], slack[SOME(NS)];   /* largest value of each switch; how far it may pass 0 */
    double tick[SOME(NQ)], publish[SOME(NQ)], ticks[SOME(NQ)], pending[SOME(NQ)];
    double before[SOME(ND)], left[SOME(ND)]; /* delayed signals before the start; sources at the segment's end */
    double from, until;                      /* the segment between instants at which a delayed signal may jump */
    double limit;                            /* model exchange: how far a step may go without an event */
    double h, last_event;
    double t_kept, y_kept[SOME(NY)], u_kept[SOME(NU)]; /* model exchange: where the history ends */
    int last_switch, chatter, forced;
    int stale;     /* the algebraic unknowns do not belong to the present values yet */
    int disturbed; /* something was set from outside since the last step */
    int begun;     /* the start has been followed by a first event update */
    size_t steps, echoes;                    /* rows of the two tables */
} State;

typedef struct {
    State s;
    double *history; /* steps rows of [t, h, ND quartics], for delayed signals */
    double *echo;    /* echoes rows of [t, order]: jumps and corners that come back through a delay */
    size_t history_room, echo_room;
    int cosimulation;
    void *environment;
    void (*logger)(void); /* of the type that the version of the standard says */
    int logging;
    char *name;
    char message[400];
} Instance;

/* linear.c */
int factorise(double *a, int *pivots, int n);
void back_substitute(const double *a, const int *pivots, double *b, int n);

/* equations.c */
void arguments(const Instance *i, Args *a);
void outside(Instance *i, double t);
Outcome consistent(Instance *i, int live);
Outcome refresh(Instance *i);
Outcome rates(Instance *i);
Outcome take_timing(Instance *i);
int violation(const Instance *i, const double *values);
void note_switches(Instance *i, const double *values);

/* start.c */
Outcome find_start(Instance *i);

/* history.c */
Outcome keep_quartic(Instance *i, double t, double h, double values[NODES][SOME(ND)]);
Outcome keep_step(Instance *i);
Outcome keep_echo(Instance *i, double t, double order);
double next_stop(const Instance *i, double end);
Outcome event_update(Instance *i, double order);
double due_order(Instance *i, double t);

/* integrate.c */
Outcome integrate(Instance *i, double end);

/* tangent.c */
int directional(Instance *i, const double *dy, const double *du, const double *dp, double *rates_out,
                double *outputs, double *indicators, double *states);

/* instance.c */
Instance *make(const char *name, const char *token, int cosimulation);
void discard(Instance *i);
void reset(Instance *i);
void begin(Instance *i, double start, int has_stop, double stop, int has_tolerance, double tolerance);
int finish_start(Instance *i);
int get_values(Instance *i, const unsigned int *refs, size_t n, double *values);
int set_values(Instance *i, const unsigned int *refs, size_t n, const double *values);
int get_rates(Instance *i, double *values);
int get_indicators(Instance *i, double *values);
int directional_by_reference(Instance *i, const unsigned int *unknown, size_t nu, const unsigned int *known, size_t nk,
                             const double *seed, double *result);
int update_events(Instance *i, int *has_next, double *next);
int do_step(Instance *i, double t, double h);
int set_time(Instance *i, double t);
int set_states(Instance *i, const double *values);
int set_slope(Instance *i, unsigned int ref, double slope);
int leave_event_mode(Instance *i);
int complete_step(Instance *i);
int explain(Instance *i, Outcome outcome);
void say(Instance *i, const char *format, ...);

/* snapshot.c */
void *snapshot(const Instance *i);
int restore(Instance *i, const void *copy);
size_t snapshot_size(const void *copy);
size_t snapshot_write(const void *copy, char *bytes, size_t room);
void *snapshot_read(const char *bytes, size_t size);

#endif
