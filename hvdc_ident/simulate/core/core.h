/* The integrators and the steady-state solvers: C99, no dependencies, no globals, reentrant.

   A model comes as functions of one signature (`function`), by address, with the sizes of its vectors. Everything else that a
   run knows stands in one record, `run`, which is the caller's. The record's fields are listed once, by macros, so that
   a caller in another language can read their order from this file. Every field takes eight bytes.

   `all.c` makes a library of the core; an exported FMU includes the same files. */

#ifndef HVDC_IDENT_CORE_H
#define HVDC_IDENT_CORE_H

#include <math.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>
#include <stdlib.h>

typedef int64_t integer;

/* A generated function of a model: what it computes of the flat vector y, its rates, what comes from outside and the rates of that,
   the parameters and the modes of the switches, it writes to `out`. */
typedef void (*function)(const double *y, const double *yd, const double *w, const double *wd, const double *p, const double *m,
                         double *out);

/* How a run ends. SLIDING asks for the equations of the slide on `last_switch`, which the caller has not given yet. */
enum status { CONVERGED, STEP_LIMIT, NOT_FINITE, CHATTER, INCONSISTENT, STIFF, SLIDING, TWO_SLIDES, OUT_OF_MEMORY };

enum {
    NONE = -1,   /* no switch */
    AGAIN = -2,  /* the step is to be taken once more */
    NODES = 5,   /* a delayed signal is kept as a quartic in each step, through five equidistant values */
    PIECES = 16  /* or in as many pieces of a step at most */
};

/* --- numbers that the caller reads from here too --- */

#define LANES 4         /* instants that a generated function over several of them takes at once; elements of a loop over a vector */
#define ACCURACY 1e-10  /* largest scaled residual that counts as a steady state */
#define SHORTEST 0x1p-16 /* of a path of values: a step that has to be shorter means that the path ends */
#define SHARES 5        /* of a step at which the switches are looked at: its ends, its middle, and its quarters where one may act in between */
#define TINY 1e-3       /* the least that an unknown counts for, where it tells by what an equation's residual is measured */

/* What tells the compiler that the turns of a loop do not depend on each other; the build of the library defines it. */
#ifndef INDEPENDENT
#define INDEPENDENT
#endif

/* Such a loop over elements of vectors that do not overlap, or are the same. */
#define EACH(i, count) INDEPENDENT for (integer i = 0; i < (count); i++)

/* How the functions that a caller uses are linked: in an exported FMU they are its own alone. */
#ifndef INTERFACE
#define INTERFACE
#endif

/* --- one set of equations: of the model, or of a slide on the surface of a switch --- */

#define SIZES(INT)                                                                                                             \
    INT(nx) INT(nz) INT(nu) INT(nd) INT(nq) INT(ns) INT(no) INT(np) /* states, unknowns, inputs, delays, samples, switches, ... */ \
    INT(width)      /* of a row over the parameters: np, rounded up for loops by four */                                       \
    INT(n)          /* unknowns of the step: states and algebraic unknowns */                                                  \
    INT(size)       /* the flat vector: the n unknowns, then their rows over the parameters */                                 \
    INT(stride)     /* the same, rounded up for loops by four */                                                               \
    INT(nw)         /* elements of w before its rows */                                                                        \
    INT(hessians)   /* second derivatives */                                                                                   \
    INT(factors)    /* factors of the generated elimination; 0: dense pivoting alone */                                        \
    INT(timed)      /* whether an equation uses time itself */                                                                 \
    INT(rosenbrock) /* the method */                                                                                           \
    INT(sliding) INT(twin) /* the switch on whose surface the run slides, and its twin there; NONE */

#define FUNCTIONS(CODE)                                                                                                        \
    CODE(do_f) CODE(do_fs) CODE(do_jac) CODE(do_hess) CODE(do_ft) CODE(do_sw) CODE(do_sws) CODE(do_swd) CODE(do_modes)         \
    CODE(do_out) CODE(do_outs) CODE(do_rows) CODE(do_src) CODE(do_srcs) CODE(do_srcd) CODE(do_rest) CODE(do_rest_jac)          \
    CODE(do_rest_p) CODE(do_const) CODE(do_lu) CODE(do_solve) CODE(do_surface)                                                 \
    CODE(do_rhs) CODE(do_observe) CODE(do_sources) /* with rows over the parameters where there are any */

#define SECOND_DERIVATIVES(INDEX) INDEX(hess_row) INDEX(hess_column)

/* --- what the caller states of a run --- */

#define GIVEN(VECTOR, INDEX, INT)                                                                                              \
    VECTOR(p) VECTOR(constants) VECTOR(scale)  /* parameters; timing constants with their rows; size of each parameter */      \
    VECTOR(t_out) VECTOR(out)                  /* instants of the outputs, and the outputs with their rows */                  \
    VECTOR(breaks) INDEX(pointer) VECTOR(times) VECTOR(values) /* of the inputs: stops, first points of each, points */        \
    INT(n_breaks) INT(n_out) INT(max_steps)                                                                                    \
    INT(slides)                                /* whether the run may slide along the surface of a switch */

#define GIVEN_INSTANTS(REAL) REAL(start) REAL(end) REAL(rtol) REAL(atol)

/* --- the vectors of a run, in its workspace --- */

#define VECTORS(VECTOR)                                                                                                        \
    VECTOR(y) VECTOR(yn) VECTOR(u)                 /* flat: at the step's start, at its end, at a stage */                     \
    VECTOR(k) VECTOR(e) VECTOR(dense)              /* stages, error, the four rows of the step's quartic */                    \
    VECTOR(add) VECTOR(mass) VECTOR(ft)            /* what a stage adds to the right-hand side, 1 where it has a derivative, f_t */ \
    VECTOR(f_before) VECTOR(f_after)               /* right-hand sides at both sides of a switch or jump */                    \
    VECTOR(yd) VECTOR(w) VECTOR(wd) VECTOR(m) /* arguments of the generated functions */                                       \
    VECTOR(jac) VECTOR(matrix) VECTOR(small) VECTOR(hessian) VECTOR(factor) VECTOR(shift) /* linear algebra */                 \
    VECTOR(floors) VECTOR(totals)                  /* error weights and sums of each parameter */                              \
    VECTOR(z_before) VECTOR(z_from) VECTOR(z_step) VECTOR(side) /* unknowns before a solve, a step of it, the modes there */   \
    VECTOR(sv) VECTOR(top) VECTOR(slack) VECTOR(sws) /* switches: values, largest so far, tolerance, rows */                   \
    VECTOR(along) VECTOR(beside)                   /* their values at five shares of a step, and where the states are moved */ \
    VECTOR(src) VECTOR(src_rate) VECTOR(src_left)  /* sources of delays and samples; the delays' before the segment */         \
    VECTOR(lag) VECTOR(lag_p) VECTOR(before)       /* delays, their rows, the delayed signals before the start */              \
    VECTOR(nodes) VECTOR(history) VECTOR(echo)     /* history of delayed signals; instants at which jumps come back */         \
    VECTOR(tick) VECTOR(publish) VECTOR(ticks) VECTOR(pending) VECTOR(pending_p) VECTOR(publish_p) /* samples */               \
    VECTOR(jump_p)                                 /* derivative of the present jump's instant by the parameters */            \
    VECTOR(surface)                                /* of a slide */                                                            \
    VECTOR(instants) VECTOR(block)                 /* four instants and their flat vectors */

#define INDICES(INDEX)                                                                                                         \
    INDEX(pivots) INDEX(small_pivots) /* row exchanges of the factors */                                                       \
    INDEX(at)                         /* each input's present piece */                                                         \
    INDEX(mover)                      /* of each switch the unknown that moved it as far as it was beyond its mode */          \
    INDEX(heads)                      /* heads of this record for the slide on each switch, then without one */

#define COUNTS(INT)                                                                                                            \
    INT(accepted) INT(rejected) INT(events) INT(evaluations) INT(segments) INT(forced_steps) /* what a run reports */          \
    INT(steps) INT(i_out) INT(i_break) INT(echoes) INT(kept)                                                                   \
    INT(history_room) INT(echo_room)  /* rows for which there is memory */                                                     \
    INT(stiff) INT(chatter) INT(last_switch) INT(aim)

#define FLAGS(INT)                                                                                                             \
    INT(still)     /* no input has a slope in this segment */                                                                  \
    INT(quiet)     /* nothing comes from outside in this segment but time */                                                   \
    INT(forced)    /* the right-hand side may change with time alone */                                                        \
    INT(first)     /* the first segment */                                                                                     \
    INT(fresh)     /* the first stage holds the derivative at (t, y) */                                                        \
    INT(again)     /* the step before was rejected: what was computed at (t, y) stands */                                      \
    INT(factored)  /* how the step's matrix is factored: 1 by the generated elimination, 2 by dense partial pivoting */         \
    INT(last)      /* this step ends at the segment's end */                                                                   \
    INT(continued) /* nothing happens where the next segment begins: it goes on from the one before */                         \
    INT(echo_now) INT(disturbed) INT(published) /* what happened at the present break */

#define INSTANTS(REAL)                                                                                                         \
    REAL(t) REAL(tb)     /* tb: the present segment's end */                                                                   \
    REAL(span)           /* of the whole run: what a step counts as short or long by */                                        \
    REAL(h) REAL(hs) REAL(step_end)            /* the step wanted, the step taken, its end */                                  \
    REAL(order) REAL(shortest) REAL(last_event) REAL(error) REAL(stiffness)                                                    \
    REAL(surface_top)                          /* largest value of the sliding switch so far */

#define AS_INTEGER(name) integer name;
#define AS_FUNCTION(name) function name;
#define AS_VECTOR(name) double *name;
#define AS_INDICES(name) integer *name;
#define AS_REAL(name) double name;

/* What one set of equations brings: the beginning of a run's record. */
typedef struct head {
    SIZES(AS_INTEGER) FUNCTIONS(AS_FUNCTION) SECOND_DERIVATIVES(AS_INDICES)
} head;

typedef struct run {
    SIZES(AS_INTEGER) FUNCTIONS(AS_FUNCTION) SECOND_DERIVATIVES(AS_INDICES)
    GIVEN(AS_VECTOR, AS_INDICES, AS_INTEGER) GIVEN_INSTANTS(AS_REAL)
    VECTORS(AS_VECTOR) INDICES(AS_INDICES) COUNTS(AS_INTEGER) FLAGS(AS_INTEGER) INSTANTS(AS_REAL)
} run;

#endif
