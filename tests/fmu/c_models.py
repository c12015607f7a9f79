"""The C models of the tests: each has an answer in closed form, or a fault."""

from __future__ import annotations

import numpy as np

from hvdc_ident import Model
from tests.fmu.c_fmu import CModel, Var

HEAD = "#include <math.h>\n#ifndef NOMINAL\n#define NOMINAL 1.0\n#endif\n"
PLAIN = HEAD + "#define INITIALIZE(r)\n"

# x'' = (k u - d v - k x)/m as two states; y is the state x itself, twice has 2 v + b.
# The directional derivative of an output that is a state is 0, as some FMUs have it.
SPRING_CODE = (
    HEAD
    + """
#define NR 16
#ifndef RELEASED
#define RELEASED 0.0
#endif
#ifndef DAMPING
#define DAMPING 0.5
#endif
#define INITIALIZE(r) (r[0] = r[8] + RELEASED)
static void start(double *r) { r[4] = 2; r[5] = DAMPING; r[6] = 8; r[7] = 0.25; }
static void equations(double *r, double t) {
    r[2] = r[1];
    r[3] = (r[6] * r[8] - r[5] * r[1] - r[6] * r[0]) / r[4];
    r[9] = 2 * r[1] + r[7];
}
#ifdef OWN_DERIVATIVES
#define DIRECTIONAL spring_along
typedef struct Model_ Spring;
static int spring_along(void *c, const unsigned *un, unsigned long nu, const unsigned *kn, unsigned long nk,
                        const double *seed, double *out) {
    double *r = (double *)c, d[16] = {0};
    for (unsigned long i = 0; i < nk; i++) d[kn[i]] += seed[i];
    double force = r[6] * r[8] - r[5] * r[1] - r[6] * r[0];
    double s[16] = {0};
    s[2] = d[1];
    s[3] = (d[6] * r[8] + r[6] * d[8] - d[5] * r[1] - r[5] * d[1] - d[6] * r[0] - r[6] * d[0]) / r[4]
         - force / (r[4] * r[4]) * d[4];
    s[9] = 2 * d[1] + d[7];
#ifdef SHIFTS
    for (unsigned long i = 0; i < nk; i++) if (kn[i] == 4) r[4] *= 1 + SHIFTS;
#endif
#ifdef LATER
    for (unsigned long i = 0; i < nk; i++) if (kn[i] == 4 && fabs(r[0]) > 0.5) s[3] *= LATER;
#endif
    for (unsigned long i = 0; i < nu; i++) out[i] = s[un[i]] * WRONG;
    return 0;
}
#endif
"""
)
SPRING_VARIABLES = (
    Var("x", 0, more=(("unit", "m"), ("nominal", "0"))),
    Var("v", 1),
    Var("der(x)", 2, more=(("derivative", "x"),)),
    Var("der(v)", 3, more=(("derivative", "v"),)),
    Var("m", 4, "parameter", "fixed", (("start", "2"), ("min", "0.1"), ("unit", "kg"))),
    Var("d", 5, "parameter", "tunable", (("start", "0.5"),)),
    Var("k", 6, "parameter", "tunable", ()),  # no start: it has to be read from the FMU
    Var("stiffness", 6, "parameter", "tunable", ()),  # the same value reference
    Var("b", 7, "parameter", "tunable", (("start", "0.25"),)),
    Var("u", 8, "input", "continuous", (("start", "0"),)),
    Var("y", 0, "output"),
    Var("twice", 9, "output"),
)


def spring(
    name: str = "spring", own: bool = True, wrong: float = 1.0, nominal: str = "1.0", more: tuple[str, ...] = ()
) -> CModel:
    """The spring, with directional derivatives of its own, wrong ones, or none. more: what else goes wrong with them."""
    defines = (f"NOMINAL={nominal}", *(["OWN_DERIVATIVES", f"WRONG={wrong}", *more] if own else []))
    return CModel(name, SPRING_CODE, SPRING_VARIABLES, 2, 0, directional=own, defines=defines)


# Its binary begins with another damping than its description says.
OTHERWISE = CModel("otherwise", SPRING_CODE, SPRING_VARIABLES, 2, 0, defines=("RELEASED=1.0", "DAMPING=1.5"))

# The spring without derivatives of its own, let go at 1 beside its place of rest.
RELEASED = CModel("released", SPRING_CODE, SPRING_VARIABLES, 2, 0, defines=("RELEASED=1.0",))


# Falls from h, bounces with the factor e.
BALL = CModel(
    "ball",
    PLAIN
    + """
#define NR 8
static void start(double *r) { r[0] = 1; r[4] = 9.81; r[5] = 0.7; r[6] = 1; }
#undef INITIALIZE
#define INITIALIZE(r) (r[0] = r[6])
static void equations(double *r, double t) { r[2] = r[1]; r[3] = -r[4]; }
#define INDICATORS(r, t, z) (z[0] = r[0])
static int bounce(double *r) { if (r[0] <= 0 && r[1] < 0) { r[0] = 0; r[1] = -r[5] * r[1]; return 1; } return 0; }
#define EVENT(r, t, next, timed) bounce(r)
""",
    (
        Var("h", 0),
        Var("v", 1),
        Var("der(h)", 2, more=(("derivative", "h"),)),
        Var("der(v)", 3, more=(("derivative", "v"),)),
        Var("g", 4, "parameter", "fixed", (("start", "9.81"),)),
        Var("e", 5, "parameter", "tunable", (("start", "0.7"),)),
        Var("h0", 6, "parameter", "fixed", (("start", "1"),)),
        Var("height", 0, "output"),
    ),
    2,
    1,
)

# x' = -a x from x0: nothing enters.
DECAY = CModel(
    "decay",
    PLAIN
    + """
#define NR 4
#undef INITIALIZE
#define INITIALIZE(r) (r[0] = r[3])
static void start(double *r) { r[2] = 1; r[3] = 1; }
static void equations(double *r, double t) { r[1] = -r[2] * r[0]; }
""",
    (
        Var("x", 0),
        Var("der(x)", 1, more=(("derivative", "x"),)),
        Var("a", 2, "parameter", "tunable", (("start", "1"), ("min", "0.01"))),
        Var("x0", 3, "parameter", "fixed", (("start", "1"),)),
        Var("y", 0, "output"),
    ),
    1,
)

# x' = s rate, s turned round at +-1: a triangle, 500 events in 1000 s.
TRIANGLE = CModel(
    "triangle",
    PLAIN
    + """
#define NR 6
static void start(double *r) { r[2] = 1; r[3] = 1; }
static void equations(double *r, double t) { r[1] = r[2] * r[3]; }
#define INDICATORS(r, t, z) (z[0] = 1 - r[2] * r[0])
static int turn(double *r) { if (r[2] * r[0] >= 1) r[2] = -r[2]; return 0; }
#define EVENT(r, t, next, timed) turn(r)
""",
    (
        Var("x", 0),
        Var("der(x)", 1, more=(("derivative", "x"),)),
        Var("rate", 3, "parameter", "tunable", (("start", "1"),)),
        Var("y", 0, "output"),
    ),
    1,
    1,
)

# A counter that steps every `period`: time events, no continuous state.
COUNTER = CModel(
    "counter",
    PLAIN
    + """
#define NR 6
static void start(double *r) { r[0] = 0; r[1] = 0.25; }
static void equations(double *r, double t) { r[2] = r[0]; }
static int tick(double *r, double t, double *next, int *timed) {
    if (*timed && t >= *next - 1e-12) { r[0] += 1; *next += r[1]; }
    if (!*timed) { *next = t + r[1]; *timed = 1; }
    return 0;
}
#define EVENT(r, t, next, timed) tick(r, t, next, timed)
""",
    (
        Var("period", 1, "parameter", "fixed", (("start", "0.25"),)),
        Var("count", 2, "output", "discrete"),
    ),
    0,
    0,
    kinds=("ModelExchange",),
)

# T y' = u - y, and a parameter that says what goes wrong in a run.
FAULTS = {1: "segfault", 2: "hang", 3: "exit 0", 4: "endless memory", 5: "nan", 6: "error", 7: "abort", 8: "fatal"}
FAULTY_CODE = (
    PLAIN
    + """
#define NR 8
#include <stdlib.h>
#include <string.h>
#include <unistd.h>
static void start(double *r) { r[2] = 0.1; r[3] = 0; r[4] = 0; }
static void equations(double *r, double t) { r[1] = (r[4] - r[0]) / r[2]; r[5] = r[3] == 5 ? NAN : r[0]; }
static void eat(void) { for (;;) { char *p = malloc(1 << 24); memset(p, 1, 1 << 24); } }
#define FAULT(r) do { int f = (int)r[3]; \\
    if (f == 1) *(volatile int *)0 = 1; \\
    if (f == 2) for (;;) usleep(1000); \\
    if (f == 3) exit(0); \\
    if (f == 4) eat(); \\
    if (f == 6) return 3; \\
    if (f == 7) abort(); \\
    if (f == 8) return 4; } while (0)
#define AT_STEP(r) FAULT(r)
#define AT_SLOPES(r) FAULT(r)
"""
)
FAULTY_VARIABLES = (
    Var("y", 0),
    Var("der(y)", 1, more=(("derivative", "y"),)),
    Var("T", 2, "parameter", "tunable", (("start", "0.1"), ("min", "0.001"))),
    Var("fault", 3, "parameter", "fixed", (("start", "0"),)),
    Var("u", 4, "input", "continuous", (("start", "0"),)),
    Var("out", 5, "output"),
)
FAULTY = CModel("faulty", FAULTY_CODE, FAULTY_VARIABLES, 1)


def broken(name: str, instantiate: str = "", token: str = "{token}", defines: tuple[str, ...] = ()) -> CModel:
    """The lag whose instantiation does something else."""
    code = FAULTY_CODE + (f"#define AT_INSTANTIATE {instantiate}\n" if instantiate else "")
    return CModel(name, code, FAULTY_VARIABLES, 1, token=token, defines=defines)


# A lag that moves from 1 to 0 by itself, with what its tool does wrong as it is begun again.
BEGUN_CODE = (
    HEAD
    + """
#include <time.h>
#define NR 8
static int runs, frozen, ended;
#ifndef SPOILT
#define SPOILT 0
#endif
#ifndef INITIALIZE
#define INITIALIZE(r) (runs++)
#endif
static void start(double *r) { r[0] = 1; r[2] = 0.1; }
static void equations(double *r, double t) {
    r[1] = frozen ? 0 : (r[3] - r[0]) / r[2] * (1 + SPOILT * (runs - 1));
    r[4] = r[0]; r[5] = clock();
}
"""
)
BEGUN_VARIABLES = (
    Var("y", 0, more=(("start", "1"),)),
    Var("der(y)", 1, more=(("derivative", "y"),)),
    Var("T", 2, "parameter", "fixed", (("start", "0.1"), ("min", "0.001"))),
    Var("u", 3, "input", "continuous", (("start", "0"),)),
    Var("out", 4, "output"),
)
CLOCK = Var("cpu", 5, "output")


def begun(name: str, *defines: str, more: tuple[Var, ...] = ()) -> CModel:
    """The lag that begins at 1, with some of its tool's faults."""
    code = "".join(f"#define {d}\n" for d in defines) + BEGUN_CODE
    return CModel(name, code, (*BEGUN_VARIABLES, *more), 1)


# A lag with a gain and an offset: four parameters, and no derivatives but by differences of whole runs.
FOUR = CModel(
    "four",
    PLAIN
    + """
#define NR 9
#include <unistd.h>
static void start(double *r) { r[2] = 0.1; r[3] = 1; r[4] = 2; r[5] = 0.5; r[6] = 0; }
static void equations(double *r, double t) { r[1] = (r[3] * r[6] - r[0]) / r[2]; r[7] = r[4] * r[0] + r[5]; }
""",
    (
        Var("y", 0),
        Var("der(y)", 1, more=(("derivative", "y"),)),
        *(
            Var(n, 2 + k, "parameter", "tunable", (("start", str(x)),))
            for k, (n, x) in enumerate({"T": 0.1, "k": 1.0, "b": 2.0, "c": 0.5}.items())
        ),
        Var("u", 6, "input", "continuous", (("start", "0"),)),
        Var("out", 7, "output"),
    ),
    1,
    kinds=("CoSimulation",),
)


TWIN = Model(
    name="twin",
    parameters={"m": 2.0, "d": 0.5, "k": 8.0, "b": 0.25},
    inputs={"u": 0.0},
    states={"x": "v", "v": "(k*u - d*v - k*x)/m"},
    outputs={"y": "x", "twice": "2*v + b"},
)
"""The spring in equations."""


def response(t, m=2.0, d=0.5, k=8.0):
    """The spring's step response from the step on."""
    wn, zeta = np.sqrt(k / m), d / (2 * np.sqrt(k * m))
    wd = wn * np.sqrt(1 - zeta**2)
    s = np.maximum(t - 1.0, 0.0)
    return np.where(t < 1.0, 0.0, 1 - np.exp(-zeta * wn * s) * (np.cos(wd * s) + zeta * wn / wd * np.sin(wd * s)))


# T y' = u - y, as co-simulation; through is y + u. What the solver knows of u stands in r[6], in whose place a model
# puts what it does wrong; r[7]: whether the solver computes, not a reader.
LATCH_CODE = (
    PLAIN
    + """
#define NR 14
#undef INITIALIZE
#define INITIALIZE(r) (r[6] = r[10] = r[4])
static void start(double *r) { r[2] = 0.1; }
static void equations(double *r, double t) {
    r[1] = ((r[7] ? r[6] + r[11] * (t - r[12]) : r[4]) - r[0]) / r[2];
    r[5] = r[0];
    r[8] = r[0] + r[4];
}
"""
)
LATCHES = {
    "plain": """
#define AT_STEP(r) (r[6] = r[4], r[7] = 1)
#define AT_GET(r) (r[7] = 0)
""",
    "changed": """
#define AT_SET(r, v, x) do { if (v == 4 && x != r[4]) r[9] = 1; } while (0)
#define AT_GET(r) (r[7] = r[9] = 0)
#define AT_STEP(r) do { if (r[9]) r[6] = r[4]; r[9] = 0; r[7] = 1; } while (0)
""",
    "compared": """
#define AT_GET(r) (r[7] = 0, r[10] = r[4])
#define AT_STEP(r) do { if (r[4] != r[10]) r[6] = r[4]; r[10] = r[4]; r[7] = 1; } while (0)
""",
    "spoiled": """
#define AT_SET(r, v, x) do { if (v == 4) r[9] = x != r[6]; } while (0)
#define AT_GET(r) do { if (r[9]) r[10] = 1; r[7] = r[9] = 0; } while (0)
#define AT_STEP(r) do { if (r[10] == 0) r[6] = r[4]; r[10] = r[9] = 0; r[7] = 1; } while (0)
#undef INITIALIZE
#define INITIALIZE(r) (r[6] = r[4])
""",
}
"""When the solver takes over an input: always; where it was set to another value and nothing was read since; where it
differs from what was read last; unless anything was read with it before."""
LATCH_VARIABLES = (
    *FAULTY_VARIABLES[:3],
    Var("u", 4, "input", "continuous", (("start", "0"),)),
    Var("out", 5, "output"),
    Var("through", 8, "output"),
)


def latch(kind: str = "plain", more: str = "", name: str = "") -> CModel:
    """The lag whose solver takes over its input in one of the ways of LATCHES."""
    return CModel(name or kind, LATCH_CODE + LATCHES[kind] + more, LATCH_VARIABLES, 1, kinds=("CoSimulation",))
