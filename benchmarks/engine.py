"""The engine against its floor and against CasADi (cvodes, idas), in one run.

    python benchmarks/engine.py            (needs the extra `bench`)

The link, 8 gains as parameters, 1.5 s, three steps, 3001 points. "stiff": the link as it is (index-1 DAE, a mode near
-41 000 1/s). "smooth": lags on all currents, measurements and the dc line, no fast mode. Times are CPU time, the minimum
of several runs; compare only ratios within one run.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import time
from itertools import pairwise

import numpy as np
import sympy as sp

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.effects import apply_effects
from hvdc_ident.models import load_model
from hvdc_ident.simulate import NAMES, Tolerance, engine_of, simulate
from hvdc_ident.simulate.core import repeat

GAINS = ("KPVDC", "KIVDC", "KPP", "KIP", "KPQ", "KIQ", "KPQ2", "KIQ2")
STEPS = {"Vdcref1": (0.1, 1.0, 1.019), "Pref2": (0.5, 0.4, 0.5), "Qref1": (0.9, 0.0, 0.1)}
CASE = experiment("steps", np.linspace(0.0, 1.5, 3001), {n: InputSignal.step(*s) for n, s in STEPS.items()})


def best(function, repeat=15, warm=2):
    """Return the shortest of several runs, s."""
    for _ in range(warm):
        function()
    return min(_timed(function) for _ in range(repeat))


def _timed(function):
    start = time.process_time()  # on a machine that others use too, the clock on the wall times them as well
    function()
    return time.process_time() - start


def cost(code, name):
    """Return the time of one call of a generated function, s."""
    s = code.structure.sizes
    address = code._address[NAMES.index(name)]
    p = np.array(list(code.structure.model.values.values()))
    u = np.array([i.value for i in code.structure.model.inputs.values()])
    y, w = code.start(p, u)
    out, m = np.zeros(100_000), np.zeros(max(s.ns, 1))
    if name in ("lu", "solve"):  # these take the Jacobian in y, the shift in w, the factors in p
        y, w, p = np.full(10_000, 1e-3), np.full(w.size, 1e3), np.full(10_000, 1e-3)
    return best(lambda: repeat(address, y, w, p, m, out, 20_000), 9) / 20_000


def floor(model, sensitivities, statistics):
    """Return two floors, s: accepted steps x right-hand sides (and Jacobians), and the same with the method's generated solves.

    A generated solve is the stage's whole linear system: sums, second derivatives and substitution.
    """
    code = engine_of(model, sensitivities)
    rhs = cost(code, "fs" if sensitivities else "f")
    if statistics.method == "explicit":
        return (statistics.accepted * 6 * rhs,) * 2
    once = cost(code, "jac") + (cost(code, "hess") if sensitivities else 0.0)
    solves = cost(code, "lu") + 8 * cost(code, "solve")
    return statistics.accepted * (8 * rhs + once), statistics.accepted * (8 * rhs + once + solves)


def smooth(link):
    """Return the link with lags that remove the fast modes: 16 states, no algebraic unknowns."""
    lags = [(["Ir1", "Ii1", "Ir2", "Ii2"], 1.6e-3), (["Vdc1_m", "P2_m", "Q1_m", "Q2_m"], 1.5e-3), (["Idc"], 3e-3)]
    return apply_effects(link, [{"effect": "lag", "at": at, "parameters": {"T": T}} for at, T in lags])


def casadi_run(model, sensitivities, rtol):
    """Return a function that runs CasADi's cvodes or idas on the same equations from the same start, and its last output."""
    import casadi as ca

    code = engine_of(model, ())
    s = code.structure
    values = {n: ca.SX.sym(n) for n in (*s.states, *s.unknowns, *model.parameters, *model.inputs)}
    rules = {
        "clip": lambda x, a, b: ca.fmin(ca.fmax(x, a), b),
        "Max": lambda *a: _fold(ca.fmax, a),
        "Min": lambda *a: _fold(ca.fmin, a),
        "sqrt": ca.sqrt,
    }
    from hvdc_ident.model import dependency_order

    definitions = {n: g.value for n, g in model.signals.items()} | {
        n: model.algebraic[n].equation for n in model.algebraic if n not in s.unknowns
    }
    for name in dependency_order(model, definitions):
        values[name] = _casadi(definitions[name], values, rules)
    ode = ca.vertcat(*(_casadi(x.derivative, values, rules) for x in model.states.values()))
    x, p = ca.vertcat(*(values[n] for n in s.states)), ca.vertcat(*(values[n] for n in model.parameters))
    u = ca.vertcat(*(values[n] for n in model.inputs))
    dae = {"x": x, "ode": ode, "p": ca.vertcat(p, u)}
    if s.unknowns:
        dae |= {
            "z": ca.vertcat(*(values[n] for n in s.unknowns)),
            "alg": ca.vertcat(*(_casadi(model.algebraic[n].equation, values, rules) - values[n] for n in s.unknowns)),
        }
    options = {"reltol": rtol, "abstol": rtol / 100, "max_num_steps": 200_000} | (
        {"calc_ic": True} if s.unknowns else {"linear_multistep_method": "bdf"}
    )
    p0 = np.array(list(model.values.values()))
    u0 = np.array([i.value for i in model.inputs.values()])
    y, _ = code.start(p0, u0)
    columns = [list(model.parameters).index(n) for n in sensitivities]
    stops = [0.0, *(t for t, _, _ in STEPS.values()), 1.5]
    plugin = "idas" if s.unknowns else "cvodes"
    parts = []
    for a, b in pairwise(stops):
        grid = CASE.time[(CASE.time > a) & (CASE.time <= b + 1e-12)]
        whole = ca.integrator("f", plugin, dae, a, list(grid), options)
        parts.append(
            (
                whole.factory(
                    "s",
                    ["x0", "z0", "p", *(["fwd:x0", "fwd:p", "fwd:z0"] if columns else [])],
                    ["xf", *(["fwd:xf"] if columns else [])],
                    {},
                    {},
                )
                if not columns
                else whole.forward(len(columns)),
                whole,
                grid.size,
            )
        )
    start_rows = engine_of(model, sensitivities).start(p0, u0)[0] if columns else None

    def run():
        x0, level = y[: len(s.states)], u0.copy()
        z0 = y[len(s.states) :]
        n, width = (
            len(s.states) + len(s.unknowns),
            engine_of(model, sensitivities).structure.sizes.width if columns else 0,
        )
        fx = start_rows[n:].reshape(n, width)[: len(s.states), : len(columns)] if columns else None
        fp = np.zeros((len(p0) + len(u0), len(columns)))
        for k, c in enumerate(columns):
            fp[c, k] = 1.0
        for (forward, whole, count), begin in zip(parts, stops, strict=False):
            for name, (t, _, after) in STEPS.items():
                if t <= begin:
                    level[list(model.inputs).index(name)] = after
            pu = np.concatenate([p0, level])
            r = whole(x0=x0, z0=z0, p=pu)
            if columns:
                # CasADi lays out the directions side by side, each with all its grid columns.
                q = forward(x0=x0, z0=z0, p=pu, out_xf=r["xf"], out_qf=r["qf"], out_zf=r["zf"], fwd_x0=fx, fwd_p=fp)
                fx = np.asarray(q["fwd_xf"]).reshape(len(s.states), len(columns), count)[:, :, -1]
            x0, z0 = np.asarray(r["xf"])[:, -1], np.asarray(r["zf"])[:, -1] if s.unknowns else z0
        return x0, fx

    return run


def _fold(f, a):
    r = a[0]
    for b in a[1:]:
        r = f(r, b)
    return r


def _casadi(e, values, rules):
    free = sorted(e.free_symbols, key=str)
    return sp.lambdify(free, e, modules=[rules, "math"])(*(values[v.name] for v in free))


def fresh_structure(slot):
    """Return CPU and wall time, s, from the definition of a new structure to its first trajectory with sensitivities."""
    link = load_model("vsc-hvdc-link")
    start = time.process_time(), time.perf_counter()
    model = apply_effects(
        link,
        [
            {"effect": "lag", "at": [slot], "parameters": {"T": 2e-3}},
            {"effect": "limit", "at": ["Ir2"], "parameters": {"level": 0.9}},
        ],
    )
    simulate(model, CASE, sensitivities=GAINS)
    return time.process_time() - start[0], time.perf_counter() - start[1]


FIRST_RUN = f"""
import numpy as np
from hvdc_ident import load_model, simulate
from hvdc_ident.data import InputSignal, experiment
inputs = {{n: InputSignal.step(*s) for n, s in {STEPS}.items()}}
case = experiment("steps", np.linspace(0.0, 1.5, 3001), inputs)
simulate(load_model("vsc-hvdc-link"), case, sensitivities={GAINS})
"""


HELP = "import sys; sys.argv = ['hvdc-ident', '--help']; from hvdc_ident.cli import main; main()"


def fresh_process(*arguments):
    """Return CPU and wall time, s, of a new Python process from its start to its end."""

    def used():
        children = resource.getrusage(resource.RUSAGE_CHILDREN)
        return children.ru_utime + children.ru_stime, time.perf_counter()

    start = used()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    return tuple(after - before for before, after in zip(start, used(), strict=True))


def least(figures):
    """Return the least CPU and the least wall time of several runs, as text."""
    cpu, wall = map(min, zip(*figures, strict=True))
    return f"{cpu:.2f} s CPU, {wall:.2f} s wall"


def starts():
    """Prints what comes before the first result: of a process, of a structure, of the command."""
    simulate(load_model("vsc-hvdc-link"), CASE, sensitivities=GAINS)
    print("new process, its start to the end of the link's first run with 8 sensitivities, code on disk:", end=" ")
    print(least([fresh_process("-c", FIRST_RUN) for _ in range(10)]))
    print("new structure, definition to the end of its first run with 8 sensitivities:", end=" ")
    print(least([fresh_structure(slot) for slot in ("P2_m", "Q1_m", "Q2_m", "Vdc1_m", "Idc")]))
    print("hvdc-ident --help:", least([fresh_process("-c", HELP) for _ in range(5)]))


def main():
    link = load_model("vsc-hvdc-link")
    starts()
    for label, model, methods in (("stiff", link, ("auto",)), ("smooth", smooth(link), ("auto", "explicit"))):
        for rtol in (1e-6, 1e-8):
            for names in ((), GAINS):
                theirs = peer_time(model, names, rtol)
                for method in methods:
                    print(f"{label:6s} {line(model, names, rtol, method, theirs)}", flush=True)


def line(model, names, rtol, method, theirs):
    """Return one run's time against its floors and the peer's time, as text."""
    tolerance = Tolerance(rtol, rtol / 100)

    def run():
        return simulate(model, CASE, sensitivities=names, tolerance=tolerance, method=method)

    statistics = run().statistics
    mine = best(run, 60)
    strict, whole = floor(model, names, statistics)
    text = f"rtol {rtol:.0e} {len(names)} sensitivities: {mine * 1e3:6.3f} ms ({statistics.accepted} steps, {statistics.method})"
    text += f"; floor {strict * 1e3:5.3f} ms, {mine / strict:4.1f} x; with solves {whole * 1e3:5.3f} ms, {mine / whole:4.1f} x"
    return text + (
        f"; casadi {theirs * 1e3:7.1f} ms, {theirs / mine:5.1f} x" if theirs else "; casadi is not installed"
    )


def peer_time(model, names, rtol):
    """Return CasADi's shortest time for the same run, s, after a check of its final state; None without CasADi."""
    try:
        peer = casadi_run(model, names, rtol)
    except ImportError:
        return None
    theirs = best(peer, 3, 1)
    states = simulate(model, CASE, outputs=tuple(model.states), rtol=1e-10).trajectory.values[-1]
    apart = np.abs(np.asarray(peer()[0]).ravel() - states).max()
    assert apart < 1e-3, f"CasADi ended elsewhere: {apart}"
    return theirs


if __name__ == "__main__":
    main()
