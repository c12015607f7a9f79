"""Linearisation against python-control, on the phasor link, in one run.

    python benchmarks/linearize.py

Both get the same compiled right-hand side. Times are the minimum over many repetitions on one core; "closer" compares
each Jacobian's largest error, relative to the largest entry of its row, with derivatives by complex steps.
"""

from __future__ import annotations

import time
from collections.abc import Callable

import control
import numpy as np

from hvdc_ident.linearize import find_operating_point, linearize, root_locus
from hvdc_ident.linearize.delays import eliminate
from hvdc_ident.linearize.system import CompiledSystem, system
from hvdc_ident.models import load_model
from hvdc_ident.simulate import torn


def best(run: Callable[[], object], repetitions: int) -> float:
    """Seconds of the fastest of several runs."""
    times = []
    for _ in range(repetitions):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def reduced(s: CompiledSystem, jac: np.ndarray) -> np.ndarray:
    """[A B; C D] of a Jacobian over [x, z, u], the unknowns eliminated."""
    z = s.layout
    rows = [*range(z.nx), *range(z.n, z.main), *range(z.nx, z.n)]
    columns = [*range(z.nx), *range(z.n, z.columns), *range(z.nx, z.n)]
    return eliminate(jac[np.ix_(rows, columns)], z.nx + z.no, z.nx + z.nu).result


def as_control(s: CompiledSystem, point) -> control.NonlinearIOSystem:
    """The link for python-control: states and outputs, the algebraic unknowns solved inside by Newton's method."""
    z, p, w = s.layout, point.p, point.w.copy()
    unknown = np.array([*point.unknowns.values()])

    def values(x, u):
        w[1:] = u
        y = np.concatenate([x, unknown])
        for _ in range(8):
            m = s.modes(y, w, p)
            r = s.values(y, w, p, m)[z.nx : z.n]
            if np.abs(r).max() < 1e-16:
                break
            y[z.nx :] -= np.linalg.solve(s.jacobian(y, w, p, m)[z.nx : z.n, z.nx : z.n], r)
        return s.values(y, w, p, s.modes(y, w, p))

    return control.nlsys(
        lambda t, x, u, _: values(x, u)[: z.nx],
        lambda t, x, u, _: values(x, u)[z.n : z.main],
        states=list(s.states),
        inputs=list(s.inputs),
        outputs=list(s.outputs),
    )


def main() -> None:
    """Prints the figures."""
    model = load_model("vsc-hvdc-link")
    start = time.perf_counter()
    find_operating_point(model)
    first = time.perf_counter() - start
    point = find_operating_point(model)
    s = system(model)
    own = linearize(model, point)
    again = best(lambda: linearize(model, point), 300)
    gradients = best(lambda: linearize(model, point, sensitivities=["KPVDC", "KIVDC", "C1"]), 100)
    y, w, p = point.y, point.w, point.p
    m = s.modes(y, w, p)
    jacobian = best(lambda: s.jacobian(y, w, p, m), 3000)

    peer = as_control(s, point)
    x, u = np.array([*point.states.values()]), np.array([*point.inputs.values()])
    theirs = control.linearize(peer, x, u)
    peer_time = best(lambda: control.linearize(peer, x, u), 20)
    exact = reduced(s, s.complex_step(y, w, p))
    scale = np.maximum(np.abs(exact).max(axis=1, keepdims=True), 1e-300)

    def error(a, b, c, d) -> float:
        return float((np.abs(np.block([[a, b], [c, d]]) - exact) / scale).max())

    mine, other = error(own.A, own.B, own.C, own.D), error(theirs.A, theirs.B, theirs.C, theirs.D)
    values = np.linspace(250, 1500, 500)
    locus = best(lambda: root_locus(model, "KIVDC", values), 3)
    print(f"unknowns solved: {', '.join(torn(model))}")
    print(f"compile and first operating point  {first * 1e3:9.1f} ms")
    print(f"operating point                    {best(lambda: find_operating_point(model), 100) * 1e3:9.3f} ms")
    print(f"linear model, all of it            {again * 1e3:9.3f} ms   (must: under 2)")
    print(f"  with exact dA/dp for 3 parameters{gradients * 1e3:9.3f} ms")
    print(f"Jacobian alone                     {jacobian * 1e6:9.2f} us")
    print(f"control.linearize                  {peer_time * 1e3:9.3f} ms")
    print(f"  Jacobian faster by               {peer_time / jacobian:9.0f}      (must: 50)")
    print(f"  whole linear model faster by     {peer_time / again:9.0f}")
    print(f"largest error                      {mine:9.1e}      control: {other:.1e}")
    print(f"  closer by                        {other / max(mine, 1e-17):9.1e}      (must: 1e4)")
    print(f"locus of 500 KIVDC values          {locus:9.3f} s    (must: under 1)")


if __name__ == "__main__":
    main()
