"""Results of a step: rows of outputs at the instants asked for, and the history of delayed signals."""

from __future__ import annotations

from hvdc_ident.simulate.call import call
from hvdc_ident.simulate.exogenous import outside, quartic
from hvdc_ident.simulate.kernel import kernel
from hvdc_ident.simulate.machine import LANES
from hvdc_ident.simulate.memory import table, vector
from hvdc_ident.simulate.state import NODES
from hvdc_ident.simulate.steps import evaluate, interpolate, interpolate_four


@kernel()
def write_row(r, y):  # type: ignore[no-untyped-def]
    """Writes the next row of outputs from the flat vector at the address y, with what comes from outside as it stands."""
    evaluate(r, r.do_observe, y, r.out + 8 * r.i_out * max(r.no * (1 + r.width), 1))
    r.i_out += 1


@kernel()
def write_rows(r):  # type: ignore[no-untyped-def]
    """Writes the rows of outputs within the present step, from its dense output."""
    t_out = vector(r.t_out, r.n_out)
    while True:
        count = 0
        while count < LANES and r.i_out + count < r.n_out:
            at = t_out[r.i_out + count]
            if not (at < r.step_end or (at == r.step_end and r.step_end < r.tb)):
                break
            count += 1
        if count == 0:
            return
        if r.quiet and count > 2 and r.i_out + LANES <= r.n_out:  # four at once cost about as much as two alone
            _write_four(r, t_out, count)
        else:
            for _ in range(count):
                at = t_out[r.i_out]
                interpolate(r, (at - r.t) / r.hs, r.size, r.u)
                outside(r, at, r.t)
                write_row(r, r.u)


@kernel()
def _write_four(r, t_out, count):  # type: ignore[no-untyped-def]
    """Writes the next `count` rows in one go; the rows up to the fourth get the last one's values, until their turn comes."""
    instants, first, last = vector(r.instants, LANES), r.i_out, count - 1
    for k in range(LANES):
        instants[k] = t_out[first + min(k, last)]
    scale = 1.0 / r.hs
    x0, x1 = (instants[0] - r.t) * scale, (instants[1] - r.t) * scale
    x2, x3 = (instants[2] - r.t) * scale, (instants[3] - r.t) * scale
    interpolate_four(r, x0, x1, x2, x3)
    if r.do_rows:
        call(r.do_rows, r.block, r.instants, r.w, r.wd, r.p, r.m, r.out + 8 * first * max(r.no, 1))
        r.i_out += count
    else:
        for k in range(count):
            outside(r, instants[k], r.t)
            write_row(r, r.block + 8 * r.stride * k)


@kernel()
def remember(r):  # type: ignore[no-untyped-def]
    """Adds the present step to the history of delayed signals."""
    nd, width = r.nd, r.width
    rows = 1 + width
    src, nodes = vector(r.src, (nd + r.nq) * rows), vector(r.nodes, NODES * nd * rows)
    for j in range(NODES):
        share = j / (NODES - 1.0) * (r.step_end - r.t) / r.hs
        interpolate(r, share, r.size, r.u)
        outside(r, min(r.t + share * r.hs, r.step_end), r.t)
        evaluate(r, r.do_sources, r.u, r.src)
        for i in range(nd):
            place = (i * NODES + j) * rows
            nodes[place] = src[i]
            for c in range(width):
                nodes[place + 1 + c] = src[nd + r.nq + i * width + c]
    line = 2 + nd * NODES * rows
    step = r.history + 8 * line * r.kept
    head = vector(step, 2)
    head[0], head[1] = r.t, r.step_end - r.t
    for i in range(nd):
        offset = 8 * i * NODES * rows
        quartic(table(r.nodes + offset, NODES, rows), table(step + 16 + offset, NODES, rows))
    r.kept += 1
