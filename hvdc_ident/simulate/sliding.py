"""Slides along the surface of a switch: how a run begins and ends one, and stays on the surface.

The equations of a slide (sliding_equations.py) are compiled when a run first needs them; here the record of the run is given
their functions and sizes, its `head`, and the vector of states and unknowns their layout.
"""

from __future__ import annotations

from hvdc_ident.simulate.exogenous import outside
from hvdc_ident.simulate.native import indices, kernel, vector
from hvdc_ident.simulate.run_state import CONVERGED, HEAD, INCONSISTENT, SLIDING, TWO_SLIDES
from hvdc_ident.simulate.steps import evaluate
from hvdc_ident.simulate.unknowns import consistent, rates

NONE = -1
NEAR = 100.0  # slacks within which a switch that a step aimed at counts as met


@kernel()
def use(r, row):  # type: ignore[no-untyped-def]
    """Take functions and sizes from a row of r.heads: of the slide on that switch, or the last, of no slide."""
    head, given = indices(r.here, HEAD), indices(r.heads + 8 * HEAD * row, HEAD)
    for i in range(HEAD):
        head[i] = given[i]
    mass = vector(r.mass, r.size)
    for q in range(r.size):
        mass[q] = 0.0
    for i in range(r.nx):
        mass[i] = 1.0
        for c in range(r.width):
            mass[r.n + i * r.width + c] = 1.0


@kernel()
def force(r):  # type: ignore[no-untyped-def]
    """Note whether the right-hand side may change with time alone in this segment."""
    r.forced = r.timed > 0 or r.nd > 0 or not r.still
    if not r.forced:
        ft = vector(r.ft, r.size)
        for q in range(r.size):
            ft[q] = 0.0


@kernel()
def _change(r, row):  # type: ignore[no-untyped-def]
    """Use another row of r.heads and lay out r.y for it; each copy of the unknowns begins with the values of the first."""
    nx, nz, n, width = r.nx, r.nz, r.n, r.width
    y, rows = vector(r.y, n + nx * width), vector(r.f_after, nx * width)
    for q in range(nx * width):
        rows[q] = y[n + q]
    use(r, row)
    y = vector(r.y, r.n + nx * width)
    for q in range(nz, r.nz):
        y[nx + q] = y[nx + q % nz]
    for q in range(nx * width):
        y[r.n + q] = rows[q]
    force(r)


@kernel()
def _widest(r):  # type: ignore[no-untyped-def]
    """The distance from 0 at which the sliding switch counts as 0."""
    return 0.01 * r.rtol * r.surface_top + 1e-14


@kernel()
def leads_back(r, event, before):  # type: ignore[no-untyped-def]
    """True where the side that was just entered leads back to the surface of the switch `event`.

    before: the switch's value on the other side. Where a hysteresis parts the sides there is no common surface.
    """
    values, m, slack = vector(r.sv, r.ns), vector(r.m, r.ns), vector(r.slack, r.ns)
    evaluate(r, r.do_sw, r.y, r.sv)
    if abs(values[event] - before) > 2.0 * slack[event] or not rates(r):
        return False
    evaluate(r, r.do_swd, r.y, r.sv)
    return (2.0 * m[event] - 1.0) * values[event] > 0.0


@kernel()
def begin_slide(r, event):  # type: ignore[no-untyped-def]
    """Slide on a switch from the present state on, where both sides lead to its surface. Returns a status."""
    if r.sliding != NONE:
        return TWO_SLIDES
    if indices(r.heads + 8 * HEAD * event, HEAD)[0] == 0:  # no states: not compiled yet
        return SLIDING
    m, top, slack = vector(r.m, r.ns), vector(r.top, r.ns), vector(r.slack, r.ns)
    side = m[event]
    _change(r, event)
    other = 0.0 if r.twin == NONE else m[r.twin]
    r.surface_top, top[event] = top[event], 0.25  # of a (1 - a)
    slack[event] = 0.01 * r.rtol * top[event] + 1e-14
    m[event] = 0.0
    if r.twin != NONE:
        m[r.twin] = 0.0
    if consistent(r, False) and slides_on(r):
        to_surface(r)
        if slides_on(r):  # beside the surface a steep field without a jump leads to it too
            return CONVERGED
    twin = r.twin
    _leave(r)
    m[event] = side
    if twin != NONE:
        m[twin] = other
    return CONVERGED if consistent(r, False) else INCONSISTENT


@kernel()
def slides_on(r):  # type: ignore[no-untyped-def]
    """True where both sides lead to the surface and the present state is on it; leaves the surface's data in r.surface."""
    evaluate(r, r.do_surface, r.y, r.surface)
    surface = vector(r.surface, 3)
    value, share, approach = surface[0], surface[1], surface[2]
    between = share * (1.0 - share) >= -vector(r.slack, r.ns)[r.sliding]
    return abs(value) <= NEAR * _widest(r) and approach > 0.0 and between


@kernel()
def to_surface(r):  # type: ignore[no-untyped-def]
    """Bring states and sensitivities back to the surface, along the difference of the sides' fields.

    At the entry that is the jump of the sensitivities: from either side it makes the switch's own sensitivity 0.
    """
    nx, n, width = r.nx, r.n, r.width
    evaluate(r, r.do_surface, r.y, r.surface)
    y, surface = vector(r.y, n + nx * width), vector(r.surface, 3 + nx + width)
    for i in range(nx):
        back = surface[3 + i]
        y[i] -= surface[0] * back
        for c in range(width):
            y[n + i * width + c] -= surface[3 + nx + c] * back
    consistent(r, False)


@kernel()
def stay(r):  # type: ignore[no-untyped-def]
    """After a step of a slide: return to the surface where its error has led away from it."""
    outside(r, r.t, r.t)
    evaluate(r, r.do_surface, r.y, r.surface)
    if abs(vector(r.surface, 1)[0]) > _widest(r):
        to_surface(r)
        evaluate(r, r.do_rhs, r.y, r.k)
        r.fresh = 1


@kernel()
def end_slide(r):  # type: ignore[no-untyped-def]
    """End the slide on the side whose share is the larger. False where the unknowns have no solution there."""
    evaluate(r, r.do_surface, r.y, r.surface)
    event, twin, m = r.sliding, r.twin, vector(r.m, r.ns)
    side = 1.0 if vector(r.surface, 2)[1] > 0.5 else 0.0
    _leave(r)
    m[event] = side
    if twin != NONE:
        m[twin] = 1.0 - side
    return consistent(r, False)


@kernel()
def _leave(r):  # type: ignore[no-untyped-def]
    """Use the equations of no slide again."""
    top, slack, event = vector(r.top, r.ns), vector(r.slack, r.ns), r.sliding
    top[event], slack[event] = r.surface_top, _widest(r)
    _change(r, r.ns)


@kernel()
def settle(r):  # type: ignore[no-untyped-def]
    """Solve the unknowns after a jump, with modes found from the values; a slide goes on where it can. False: no solution.

    In between the run has no slide: the modes that the values say are those of the sides.
    """
    event = r.sliding
    if event != NONE:
        _leave(r)
    if not consistent(r, True):
        return False
    if event == NONE:
        return True
    evaluate(r, r.do_sw, r.y, r.sv)
    if abs(vector(r.sv, r.ns)[event]) > NEAR * _widest(r):
        return True
    return begin_slide(r, event) == CONVERGED
