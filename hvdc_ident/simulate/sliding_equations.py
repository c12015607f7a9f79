"""Equations of a model that slides along the surface on which one of its switches is 0 (Filippov 1988).

Where both sides' fields lead to the surface, the solution stays on it. Its field is the mean f = a f1 + (1 - a) f0 of the
sides' fields with the share a of the side where the switch is negative, mode 1, that keeps the switch at 0:

    a = s0/(s0 - s1), with the speeds s1 = n f1 + s_t and s0 = n f0 + s_t across the surface.

n is one side's gradient of the switch as a function of the states. Through algebraic unknowns, g(x, z) = 0, it is
s_x + l g_x with the adjoint unknowns l that solve l g_z + s_z = 0. The unknowns have a copy for each side where the switch
acts on their equations: a limit in an algebraic loop changes the loop's gain, and with it the size of the gradient. With
each side's own gradient the share would be wrong.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from hvdc_ident.simulate.graph import Graph

Partial = Callable[[int, str], dict[int, int]]
Rate = Callable[[int, bool], int]


@dataclass(frozen=True)
class Sliding:
    """Equations of a slide, as nodes of the graph.

    twin: the switch that is 0 on the same surface with the other sign, or -1. switches: with 0 for the twin, and for the
    sliding switch a (1 - a), which is negative where the slide has ended. surface: the switch's own value, a, s1 - s0,
    then for each state (f1 - f0)/(s1 - s0), along which a point returns to the surface.
    """

    twin: int
    derivatives: list[int]
    residuals: list[int]
    observed: list[int]
    sources: list[int]
    switches: list[int]
    surface: list[int]


def sliding(
    graph: Graph,
    switch: int,
    derivatives: Sequence[int],
    residuals: Sequence[int],
    observed: Sequence[int],
    sources: Sequence[int],
    partial: Partial,
    rate: Rate,
) -> Sliding:
    """Return the equations of a model, given as nodes, with one switch sliding.

    partial: a node's derivatives with respect to one vector's leaves. rate: its derivative in time, through `w` alone
    where the second argument is False.
    """
    g, nx, nz = graph, len(derivatives), len(residuals)
    value = g.switches[switch]
    opposite = g.neg(value)
    twin = g.switches.index(opposite) if opposite in g.switches else -1

    def held(mode: bool) -> dict[int, int]:
        known = {g.condition(switch): g.truth(mode)}
        return known if twin < 0 else known | {g.condition(twin): g.truth(not mode)}

    zero, one = held(False), held(True)
    loop = g.replaced(residuals, zero)
    count, other = nz, list[int]()
    if g.replaced(residuals, one) != loop:
        one |= {g.leaf("y", nx + i): g.leaf("y", nx + nz + i) for i in range(nz)}
        other, count = g.replaced(residuals, one), 2 * nz
    normal, speed, adjoint = partial(value, "y"), rate(value, False), list[int]()
    if any(j >= nx for j in normal):
        gradient, normal = normal, {}
        for j in range(nx + nz):
            total = gradient.get(j, g.zero)
            for i, equation in enumerate(loop):
                slope = partial(equation, "y").get(j, g.zero)
                total = g.add(total, g.mul(g.leaf("y", nx + count + i), slope))
            if j < nx:
                normal[j] = total
            else:
                adjoint.append(total)
        for i, equation in enumerate(loop):
            speed = g.add(speed, g.mul(g.leaf("y", nx + count + i), rate(equation, False)))
        count += nz

    def both(nodes: Iterable[int]) -> tuple[list[int], list[int]]:
        nodes = list(nodes)
        return g.replaced(nodes, one), g.replaced(nodes, zero)

    f1, f0 = both(derivatives)
    s1 = s0 = speed
    for j, slope in normal.items():
        s1, s0 = g.add(s1, g.mul(slope, f1[j])), g.add(s0, g.mul(slope, f0[j]))
    approach = g.sub(s1, s0)
    share = g.neg(g.div(s0, approach))
    switches = both(g.switches)

    def mean(sides: tuple[list[int], list[int]]) -> list[int]:
        return [a if a == b else g.add(b, g.mul(share, g.sub(a, b))) for a, b in zip(sides[0], sides[1], strict=True)]

    watched = mean(switches)
    watched[switch] = g.mul(share, g.sub(g.one, share))
    if twin >= 0:
        watched[twin] = g.zero
    back = [g.div(g.sub(a, b), approach) for a, b in zip(f1, f0, strict=True)]
    return Sliding(
        twin,
        mean((f1, f0)),
        [*loop, *other, *adjoint],
        mean(both(observed)),
        mean(both(sources)),
        watched,
        [value, share, approach, *back],
    )
