"""One step of each integrator over states and sensitivities as one flat vector, with its error and its dense output.

RODAS5P: G. Steinebach, Construction of Rosenbrock-Wanner method Rodas5P and numerical benchmarks within the Julia
Differential Equations package, BIT 63 (2023): order 5, stiffly accurate, L-stable, for index-1 DAEs, dense output of
order 4. In the transformed form: stage i at y + sum a_ij k_j, right-hand side f + M sum c_ij k_j / h + h d_i f_t.

DOPRI5: Dormand and Prince 1980 with the dense output of Hairer, Norsett and Wanner, Solving ODEs I, II.6.
"""

from __future__ import annotations

import numpy as np

from hvdc_ident.simulate.exogenous import outside
from hvdc_ident.simulate.native import call, indices, kernel, lu, solve, solve_rows, table, vector
from hvdc_ident.simulate.simd import column_sums, elementwise, weighted

RODAS_GAMMA = 0.21193756319429014
RODAS_A = np.zeros((8, 8))
RODAS_A[1, :1] = 3.0
RODAS_A[2, :2] = 2.849394379747939, 0.45842242204463923
RODAS_A[3, :3] = -6.954028509809101, 2.489845061869568, -10.358996098473584
RODAS_A[4, :4] = 2.8029986275628964, 0.5072464736228206, -0.3988312541770524, -0.04721187230404641
RODAS_A[5, :5] = -7.502846399306121, 2.561846144803919, -11.627539656261098, -0.18268767659942256, 0.030198172008377946
RODAS_A[6, :6] = *RODAS_A[5, :5], 1.0
RODAS_A[7, :7] = *RODAS_A[5, :5], 1.0, 1.0
RODAS_C = np.zeros((8, 8))
RODAS_C[1, :1] = -14.155112264123755
RODAS_C[2, :2] = -17.97296035885952, -2.859693295451294
RODAS_C[3, :3] = 147.12150275711716, -1.41221402718213, 71.68940251302358
RODAS_C[4, :4] = 165.43517024871676, -0.4592823456491126, 42.90938336958603, -5.961986721573306
RODAS_C[5, :5] = 24.854864614690072, -3.0009227002832186, 47.4931110020768, 5.5814197821558125, -0.6610691825249471
RODAS_C[6, :6] = (
    30.91273214028599,
    -3.1208243349937974,
    77.79954646070892,
    34.28646028294783,
    -19.097331116725623,
    -28.087943162872662,
)
RODAS_C[7, :7] = (
    37.80277123390563,
    -3.2571969029072276,
    112.26918849496327,
    66.9347231244047,
    -40.06618937091002,
    -54.66780262877968,
    -9.48861652309627,
)
RODAS_TIME = np.array(
    [0.0, 0.6358126895828704, 0.4095798393397535, 0.9769306725060716, 0.4288403609558664, 1.0, 1.0, 1.0]
)
RODAS_D = np.array(
    [
        0.21193756319429014,
        -0.42387512638858027,
        -0.3384627126235924,
        1.8046452872882734,
        2.325825639765069,
        0.0,
        0.0,
        0.0,
    ]
)
RODAS_H = np.array(
    [
        [
            25.948786856663858,
            -2.5579724845846235,
            10.433815404888879,
            -2.3679251022685204,
            0.524948541321073,
            1.1241088310450404,
            0.4272876194431874,
            -0.17202221070155493,
        ],
        [
            -9.91568850695171,
            -0.9689944594115154,
            3.0438037242978453,
            -24.495224566215796,
            20.176138334709044,
            15.98066361424651,
            -6.789040303419874,
            -6.710236069923372,
        ],
        [
            11.419903575922262,
            2.8879645146136994,
            72.92137995996029,
            80.12511834622643,
            -52.072871366152654,
            -59.78993625266729,
            -0.15582684282751913,
            4.883087185713722,
        ],
    ]
)

DOPRI_A = np.zeros((7, 7))
DOPRI_A[1, :1] = 1 / 5
DOPRI_A[2, :2] = 3 / 40, 9 / 40
DOPRI_A[3, :3] = 44 / 45, -56 / 15, 32 / 9
DOPRI_A[4, :4] = 19372 / 6561, -25360 / 2187, 64448 / 6561, -212 / 729
DOPRI_A[5, :5] = 9017 / 3168, -355 / 33, 46732 / 5247, 49 / 176, -5103 / 18656
DOPRI_A[6, :6] = 35 / 384, 0, 500 / 1113, 125 / 192, -2187 / 6784, 11 / 84
DOPRI_TIME = np.array([0, 1 / 5, 3 / 10, 4 / 5, 8 / 9, 1.0, 1.0])
DOPRI_E = np.array([71 / 57600, 0, -71 / 16695, 71 / 1920, -17253 / 339200, 22 / 525, -1 / 40])
DOPRI_DENSE = np.array(
    [
        -12715105075 / 11282082432,
        0,
        87487479700 / 32700410799,
        -10690763975 / 1880347072,
        701980252875 / 199316789632,
        -1453857185 / 822651844,
        69997945 / 29380423,
    ]
)

# --- both methods ---


@kernel()
def evaluate(r, function, y, out):  # type: ignore[no-untyped-def]
    """Call a generated function at the flat vector y; all are addresses."""
    call(function, y, r.yd, r.w, r.wd, r.p, r.m, out)


@elementwise
def _horner(y, a, b, c, d, x):  # type: ignore[no-untyped-def]
    return (y + x * (a + x * (b + x * (c + x * d))),)


@elementwise
def _horner_four(y, a, b, c, d, x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    return tuple(y + x * (a + x * (b + x * (c + x * d))) for x in (x0, x1, x2, x3))


@elementwise
def copy(x):  # type: ignore[no-untyped-def]
    return (x,)


@elementwise
def _difference(a, b):  # type: ignore[no-untyped-def]
    return (a - b,)


@elementwise
def _sum(a, b):  # type: ignore[no-untyped-def]
    return (a + b,)


@kernel()
def interpolate(r, x, count, out):  # type: ignore[no-untyped-def]
    """Write the first `count` elements (and up to three more) of the step's quartic at x in 0..1 to the address out."""
    line = 8 * r.stride
    d = r.dense
    _horner((count + 3) // 4 * 4, (r.y, d, d + line, d + 2 * line, d + 3 * line), (out,), (x,))


@kernel()
def interpolate_four(r, x0, x1, x2, x3):  # type: ignore[no-untyped-def]
    """Write the step's quartic at four places to the rows of r.block."""
    line = 8 * r.stride
    d, b = r.dense, r.block
    places = (b, b + line, b + 2 * line, b + 3 * line)
    _horner_four(r.stride, (r.y, d, d + line, d + 2 * line, d + 3 * line), places, (x0, x1, x2, x3))


@kernel(fastmath={"contract", "reassoc"})
def error_norm(r, e, rows):  # type: ignore[no-untyped-def]
    """The largest weighted RMS of the error e (address) over the first `rows` unknowns and each parameter's rows of these.

    More than 1 is a rejection; infinite where something is no number.
    """
    if rows == 0:
        return 0.0
    y, yn, errors = vector(r.y, rows), vector(r.yn, rows), vector(e, rows)
    rtol, atol = r.rtol, r.atol
    worst = 0.0
    for i in range(rows):
        a, b = abs(y[i]), abs(yn[i])
        share = errors[i] / (atol + rtol * (a if a > b else b))
        worst += share * share
    if r.width:
        head = 8 * r.n
        column_sums(rows, r.width, e + head, r.y + head, r.yn + head, r.floors, rtol, r.totals)
        totals = vector(r.totals, r.width)
        check = worst
        for c in range(r.np):
            check += totals[c]
            worst = max(worst, totals[c])
        if not check < np.inf:
            return np.inf
    return np.sqrt(worst / rows) if worst < np.inf else np.inf


@kernel()
def attempt(r):  # type: ignore[no-untyped-def]
    """One step of length r.hs from (r.t, r.y) into r.yn; r.error says how good it is."""
    # An unknown may have an infinite slope for an instant, as sqrt(1.1^2 - i^2) where i meets its limit. The
    # states pass it; very short steps are judged by them alone.
    rows = r.n if r.hs > 1e-6 * (r.end - r.start) or r.nx == 0 else r.nx
    r.error = _rodas(r, rows) if r.rosenbrock else _dopri(r, rows)


@kernel()
def make_dense(r):  # type: ignore[no-untyped-def]
    """Write the quartic of the step that ended in r.yn into r.dense."""
    if r.rosenbrock:
        _rodas_dense(r)
    else:
        _dopri_dense(r)


# --- RODAS5P ---


def _rodas_point(stage):  # type: ignore[no-untyped-def]
    """Return the kernel that prepares a stage's right-hand side: the point where it is taken (from stage 5 on, relative to
    the stage before) and the term added to it."""

    @elementwise
    def point(base, mass, ft, *rest):  # type: ignore[no-untyped-def]
        k, (inverse, push) = rest[:stage], rest[stage:]
        weights = RODAS_A[stage, :stage] if stage < 6 else [0.0] * (stage - 1) + [1.0]
        return base + weighted(weights, k), mass * (inverse * weighted(RODAS_C[stage, :stage], k)) + push * ft

    return point


@elementwise
def _rodas_point_0(ft, push):  # type: ignore[no-untyped-def]
    return (push * ft,)


_rodas_point_1, _rodas_point_2, _rodas_point_3, _rodas_point_4 = (_rodas_point(s) for s in (1, 2, 3, 4))
_rodas_point_5, _rodas_point_6, _rodas_point_7 = (_rodas_point(s) for s in (5, 6, 7))


@elementwise
def _rodas_quartic(y, yn, *k):  # type: ignore[no-untyped-def]
    change = yn - y
    a, b, c = (weighted(row, k) for row in RODAS_H)
    return change + a, b - a, c - b, c * -1.0


@kernel()
def _rodas_prepare(r, stage):  # type: ignore[no-untyped-def]
    """Write r.u, where the stage's right-hand side is taken (r.y at stage 0), and r.add, what is added to it."""
    n, line = r.stride, 8 * r.stride
    k0 = r.k
    k1, k2, k3, k4, k5, k6 = k0 + line, k0 + 2 * line, k0 + 3 * line, k0 + 4 * line, k0 + 5 * line, k0 + 6 * line
    push = r.hs * RODAS_D[stage]
    out, scalars = (r.u, r.add), (1.0 / r.hs, push)
    if stage == 0:
        _rodas_point_0(n, (r.ft,), (r.add,), (push,))
    elif stage == 1:
        _rodas_point_1(n, (r.y, r.mass, r.ft, k0), out, scalars)
    elif stage == 2:
        _rodas_point_2(n, (r.y, r.mass, r.ft, k0, k1), out, scalars)
    elif stage == 3:
        _rodas_point_3(n, (r.y, r.mass, r.ft, k0, k1, k2), out, scalars)
    elif stage == 4:
        _rodas_point_4(n, (r.y, r.mass, r.ft, k0, k1, k2, k3), out, scalars)
    elif stage == 5:
        _rodas_point_5(n, (r.y, r.mass, r.ft, k0, k1, k2, k3, k4), out, scalars)
    elif stage == 6:
        _rodas_point_6(n, (r.u, r.mass, r.ft, k0, k1, k2, k3, k4, k5), out, scalars)
    else:
        _rodas_point_7(n, (r.u, r.mass, r.ft, k0, k1, k2, k3, k4, k5, k6), out, scalars)


@kernel(fastmath={"contract"})
def _rodas_matrix(r):  # type: ignore[no-untyped-def]
    """Factor M/(h gamma) - J: 1 by the generated elimination, 2 by dense partial pivoting, 0 if it is singular.

    The generated one takes its pivots as they come: it is trusted where none is small against its row.
    """
    shift = 1.0 / (r.hs * RODAS_GAMMA)
    vector(r.shift, 1)[0] = shift
    if r.factors:
        call(r.do_lu, r.jac, r.yd, r.shift, r.yd, r.yd, r.m, r.factor)
        if vector(r.factor, r.factors + 1)[r.factors] < 1e7:
            return 1
    n = r.n
    jac, matrix = table(r.jac, n, n), table(r.matrix, n, n)
    for i in range(n):
        for j in range(n):
            matrix[i, j] = -jac[i, j]
    for i in range(r.nx):
        matrix[i, i] += shift
    return 2 if lu(matrix, indices(r.pivots, n)) else 0


@kernel(fastmath={"contract"})
def _rodas_solve(r, k):  # type: ignore[no-untyped-def]
    """Do the work of the generated solve by dense linear algebra: from the right-hand side at the address k to the stage."""
    n, width = r.n, r.width
    _sum(r.stride, (k, r.add), (k,), ())
    matrix, pivots, head = table(r.matrix, n, n), indices(r.pivots, n), vector(k, n)
    solve(matrix, pivots, head)
    if width:
        rows, hessian = table(k + 8 * n, n, width), table(r.hessian, r.hessians, width)
        row, column = indices(r.hess_row, r.hessians), indices(r.hess_column, r.hessians)
        for q in range(r.hessians):
            for c in range(width):
                rows[row[q], c] += hessian[q, c] * head[column[q]]
        solve_rows(matrix, pivots, rows)


@kernel()
def _rodas(r, rows):  # type: ignore[no-untyped-def]
    outside(r, r.t, r.t)
    if not r.again:
        evaluate(r, r.do_jac, r.y, r.jac)
        if r.forced:
            evaluate(r, r.do_ft, r.y, r.ft)
        if r.hessians:
            evaluate(r, r.do_hess, r.y, r.hessian)
    kind = _rodas_matrix(r)
    if kind == 0:
        return np.inf
    r.evaluations += 8
    for stage in range(8):
        if 0 < stage < 6:  # the later ones are taken at the same instant as 5
            outside(r, r.step_end if stage == 5 else r.t + RODAS_TIME[stage] * r.hs, r.t)
        _rodas_prepare(r, stage)
        k = r.k + 8 * r.stride * stage
        evaluate(r, r.do_rhs, r.u if stage else r.y, k)
        if kind == 1:
            call(r.do_solve, r.add, r.hessian, r.w, r.wd, r.factor, r.m, k)
        else:
            _rodas_solve(r, k)
    error = r.k + 8 * r.stride * 7
    _sum(r.stride, (r.u, error), (r.yn,), ())
    return error_norm(r, error, rows)


@kernel()
def _rodas_dense(r):  # type: ignore[no-untyped-def]
    s = 8 * r.stride
    k, d = r.k, r.dense
    stages = (k, k + s, k + 2 * s, k + 3 * s, k + 4 * s, k + 5 * s, k + 6 * s, k + 7 * s)
    _rodas_quartic(r.stride, (r.y, r.yn, *stages), (d, d + s, d + 2 * s, d + 3 * s), ())


# --- DOPRI5 ---


def _dopri_point(stage):  # type: ignore[no-untyped-def]
    @elementwise
    def point(y, *rest):  # type: ignore[no-untyped-def]
        return (y + rest[stage] * weighted(DOPRI_A[stage, :stage], rest[:stage]),)

    return point


_dopri_point_1, _dopri_point_2, _dopri_point_3 = (_dopri_point(s) for s in (1, 2, 3))
_dopri_point_4, _dopri_point_5, _dopri_point_6 = (_dopri_point(s) for s in (4, 5, 6))


@elementwise
def _dopri_error(*rest):  # type: ignore[no-untyped-def]
    return (rest[7] * weighted(DOPRI_E, rest[:7]),)


@elementwise
def _dopri_quartic(y, yn, *rest):  # type: ignore[no-untyped-def]
    k, h = rest[:7], rest[7]
    change = yn - y
    bend = h * k[0] - change
    curl = change - h * k[6] - bend
    last = h * weighted(DOPRI_DENSE, k)
    return change + bend, curl - bend + last, curl * -1.0 - last * 2.0, last


@kernel()
def _dopri_prepare(r, stage):  # type: ignore[no-untyped-def]
    """Write where the stage's right-hand side is taken into r.u, or into r.yn for the last one; returns that address."""
    n, line = r.stride, 8 * r.stride
    k0 = r.k
    k1, k2, k3, k4, k5 = k0 + line, k0 + 2 * line, k0 + 3 * line, k0 + 4 * line, k0 + 5 * line
    out, scalars = (r.u,), (r.hs,)
    if stage == 1:
        _dopri_point_1(n, (r.y, k0), out, scalars)
    elif stage == 2:
        _dopri_point_2(n, (r.y, k0, k1), out, scalars)
    elif stage == 3:
        _dopri_point_3(n, (r.y, k0, k1, k2), out, scalars)
    elif stage == 4:
        _dopri_point_4(n, (r.y, k0, k1, k2, k3), out, scalars)
    elif stage == 5:
        _dopri_point_5(n, (r.y, k0, k1, k2, k3, k4), out, scalars)
    else:
        _dopri_point_6(n, (r.y, k0, k1, k2, k3, k4, k5), (r.yn,), scalars)
        return r.yn
    return r.u


@kernel(fastmath={"contract", "reassoc"})
def _dopri_stiffness(r):  # type: ignore[no-untyped-def]
    """The square of h times the largest mode, as the last two stages show it (Hairer and Wanner, IV.2)."""
    nx = r.nx
    before, after = vector(r.k + 40 * r.stride, nx), vector(r.k + 48 * r.stride, nx)
    u, yn = vector(r.u, nx), vector(r.yn, nx)
    top, bottom = 0.0, 0.0
    for i in range(nx):
        top += (after[i] - before[i]) ** 2
        bottom += (yn[i] - u[i]) ** 2
    return r.hs * r.hs * top / bottom if bottom > 0.0 else 0.0


@kernel()
def _dopri(r, rows):  # type: ignore[no-untyped-def]
    line = 8 * r.stride
    if not r.fresh:
        copy(r.stride, (r.k + 6 * line,), (r.k,), ())
    r.evaluations += 6
    for stage in range(1, 7):
        outside(r, r.t + DOPRI_TIME[stage] * r.hs if stage < 5 else r.step_end, r.t)
        evaluate(r, r.do_rhs, _dopri_prepare(r, stage), r.k + line * stage)
    r.stiffness = _dopri_stiffness(r)
    k = r.k
    stages = (k, k + line, k + 2 * line, k + 3 * line, k + 4 * line, k + 5 * line, k + 6 * line)
    _dopri_error(r.stride, stages, (r.e,), (r.hs,))
    return error_norm(r, r.e, rows)


@kernel()
def _dopri_dense(r):  # type: ignore[no-untyped-def]
    s = 8 * r.stride
    k, d = r.k, r.dense
    stages = (k, k + s, k + 2 * s, k + 3 * s, k + 4 * s, k + 5 * s, k + 6 * s)
    _dopri_quartic(r.stride, (r.y, r.yn, *stages), (d, d + s, d + 2 * s, d + 3 * s), (r.hs,))
