"""State of a run, as one record that compiled code reads and writes.

Every kernel of the integrators takes this record instead of some forty arguments: sizes, addresses of the generated
functions (`do_...`), addresses of the vectors in the workspace, tolerances, and where the run stands. The compiler's
time grows with the arguments of a call, and so does the run's.
"""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.codegen import NAMES
from hvdc_ident.simulate.simulation import STATUSES

CONVERGED, STEP_LIMIT, NOT_FINITE, CHATTER, INCONSISTENT, STIFF, SLIDING, TWO_SLIDES = range(len(STATUSES))

NODES = 5  # a delayed signal is kept as a quartic in each step, through five equidistant values

SIZES = (
    "nx", "nz", "nu", "nd", "nq", "ns", "no", "np", "width",  # as in structure.Sizes
    "n",  # unknowns of the step: states and algebraic unknowns
    "size",  # the flat vector: the n unknowns, then their rows over the parameters
    "stride",  # the same, rounded up for loops by four
    "nw",  # elements of w before its rows
    "hessians",  # second derivatives
    "factors",  # factors of the generated elimination; 0: dense pivoting alone
    "timed",  # whether an equation uses time itself
    "rosenbrock",  # the method
    "sliding", "twin",  # the switch on whose surface the run slides, and its twin there; -1: none
)  # fmt: skip
VECTORS = (
    "y", "yn", "u",  # flat: at the step's start, at its end, at a stage
    "k", "e", "dense",  # stages, error, the four rows of the step's quartic
    "add", "mass", "ft",  # what a stage adds to the right-hand side, where it has a derivative, the derivative in time
    "f_before", "f_after",  # right-hand sides at both sides of a switch or jump
    "yd", "w", "wd", "p", "m",  # arguments of the generated functions
    "jac", "matrix", "small", "hessian", "factor", "shift", "pivots", "small_pivots",  # linear algebra
    "floors", "totals", "scale",  # error weights and sums of each parameter
    "z_before", "z_from", "z_step", "side",  # unknowns before a solve, a step of it, the modes where that begins
    "sv", "top", "slack", "sws",  # switches: values, largest so far, tolerance, rows
    "src", "src_rate", "src_left",  # sources of delays and samples; the delays' before the present segment
    "lag", "lag_p", "before",  # delays, their rows, the delayed signals before the start
    "nodes", "history", "echo",  # history of delayed signals; instants at which jumps come back
    "tick", "publish", "ticks", "pending", "pending_p", "publish_p",  # samples
    "jump_p",  # derivative of the present jump's instant by the parameters
    "constants", "breaks", "at", "pointer", "times", "values",  # timing constants; inputs
    "surface", "heads", "here",  # of a slide; heads of this record without a slide and for each one; the record itself
    "t_out", "out", "instants", "block",  # outputs; four instants and their flat vectors
)  # fmt: skip
COUNTS = (
    "accepted", "rejected", "events", "evaluations", "segments", "forced_steps", "steps", "max_steps",
    "n_out", "i_out", "n_breaks", "i_break", "echoes", "kept", "stiff", "chatter", "last_switch", "aim",
)  # fmt: skip
COUNTED = ("accepted", "rejected", "events", "evaluations", "segments", "forced_steps")  # what a run reports
FLAGS = (
    "slides",  # whether the run may slide along the surface of a switch
    "still",  # no input has a slope in this segment
    "quiet",  # nothing comes from outside in this segment but time
    "forced",  # the right-hand side may change with time alone
    "first",  # the first segment
    "fresh",  # k[0] holds the derivative at (t, y)
    "again",  # the step before was rejected: what was computed at (t, y) stands
    "last",  # this step ends at the segment's end
    "echo_now", "disturbed", "published",  # what happened at the present break
)  # fmt: skip
INSTANTS = (
    "start", "end", "t", "tb",  # tb: the present segment's end
    "h", "hs", "step_end",  # the step wanted, the step taken, its end
    "rtol", "atol", "order", "shortest", "last_event", "error", "stiffness",
    "surface_top",  # largest value of the sliding switch so far
)  # fmt: skip

# Every field takes eight bytes: a run's record is made, copied and read as one vector of integers, which is quick.
FUNCTIONS = (*(f"do_{n}" for n in NAMES), "do_rhs", "do_observe", "do_sources")
HEAD_FIELDS = (*SIZES, *FUNCTIONS, "hess_row", "hess_column")  # what one set of equations brings; first in the record
HEAD = len(HEAD_FIELDS)
RUN = np.dtype(
    [(f, np.int64) for f in (*HEAD_FIELDS, *VECTORS)]
    + [(f, np.int64) for f in (*COUNTS, *FLAGS)]
    + [(f, np.float64) for f in INSTANTS]
    + [("free", np.int64)]  # where the workspace goes on
)


def place(field: str) -> int:
    """Position of a field in the vector of integers."""
    names = RUN.names
    assert names is not None
    return names.index(field)
