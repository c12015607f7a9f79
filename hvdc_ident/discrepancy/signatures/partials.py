"""A model's equations taken apart: every signal as a variable of its own, with the partial derivatives of each equation.

An additive disturbance at a slot then enters one equation alone, whatever loops run through it, and nothing has to be
compiled anew to put it anywhere.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.expression import symbol
from hvdc_ident.model import Model
from hvdc_ident.simulate import Code, Function, Graph, by_structure

_SIGNATURE = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 7)


@dataclass(frozen=True)
class Partials:
    """Partial derivatives of groups of equations by the variables, at K instants.

    signals (K, v, n), states (K, x, n), outputs (K, o, n), sources (K, w, n), rest (K, x, n): n variables in the order
    of `EquationPartials.variables`; v signals and unknowns, x states, o outputs, w delayed and sampled sources.
    """

    signals: Array
    states: Array
    outputs: Array
    sources: Array
    rest: Array


class EquationPartials:
    """The equations of one model structure, compiled with their partial derivatives; it knows no values, and serves for any."""

    def __init__(self, model: Model, outputs: tuple[str, ...]) -> None:
        self.outputs = outputs
        self.states = tuple(model.states)
        self.signals = (*model.signals, *model.algebraic)
        self.inputs = tuple(model.inputs)
        self.memory = (*model.delays, *model.sampled)
        self.variables = (*self.states, *self.signals, *self.inputs, *self.memory)
        self.place = {n: k for k, n in enumerate(self.variables)}
        self._compile(model)

    def _compile(self, m: Model) -> None:
        g = Graph()
        nodes = {n: g.leaf("y", k) for k, n in enumerate(self.variables)}
        nodes |= {n: g.leaf("p", k) for k, n in enumerate(m.parameters)} | {"time": g.leaf("w", 0)}
        memo: dict = {}
        sources = [d.of for d in m.delays.values()] + [s.value for s in m.sampled.values()]
        rest = [symbol(n) - s.rest if s.rest is not None else s.derivative for n, s in m.states.items()]
        rows = [
            *(s.value for s in m.signals.values()),
            *(a.equation for a in m.algebraic.values()),
            *(s.derivative for s in m.states.values()),
            *(m.outputs[o].value for o in self.outputs),
            *sources,
            *rest,
        ]
        self._rows, n = len(rows), len(self.variables)
        entries: list[tuple[int, int]] = []
        constants: list[tuple[int, float]] = []
        for i, e in enumerate(rows):
            for leaf, d in g.gradient(g.expression(e, nodes, memo)).items():
                group, j = g.nodes[leaf][1:]
                value = g.value(d)
                if group == "y" and value is None:
                    entries.append((i * n + j, d))
                elif group == "y" and value:
                    constants.append((i * n + j, value))
        self._places = np.array([p for p, _ in entries], dtype=np.intp)
        self._constants = constants
        self._code = Code(g, [Function("partials", [(k, d) for k, (_, d) in enumerate(entries)], live=True)], 1)
        self._call = _SIGNATURE(self._code.address["partials"])

    def partials(self, time: Array, values: Array, parameters: Array) -> Partials:
        """The derivatives along a trajectory. time: (K,); values: (K, n) of the variables; parameters: all the model's.

        One that is not finite at an instant, as that of sqrt(x) at x = 0, says nothing of a finite disturbance: it is left
        out, as 0.
        """
        k, n = time.size, len(self.variables)
        flat = np.zeros((k, self._rows * n))
        for place, constant in self._constants:
            flat[:, place] = constant
        moving = np.zeros((k, max(self._places.size, 1)))
        p = np.ascontiguousarray(parameters, dtype=float)
        y, t = np.ascontiguousarray(values, dtype=float), np.ascontiguousarray(time, dtype=float)
        unused = np.zeros(max(n, 1))
        spare = unused.ctypes.data
        if self._places.size:
            for i in range(k):
                self._call(
                    y[i].ctypes.data, spare, t[i:].ctypes.data, spare, p.ctypes.data, spare, moving[i].ctypes.data
                )
            flat[:, self._places] = np.where(np.isfinite(moving), moving, 0.0)
        rows = flat.reshape(k, self._rows, n)
        parts = np.split(rows, np.cumsum([len(self.signals), len(self.states), len(self.outputs), len(self.memory)]), 1)
        return Partials(*parts)


_tangent = by_structure(EquationPartials, room=8)


def tangent(model: Model, outputs: tuple[str, ...]) -> EquationPartials:
    """The tangent of a model's structure for some outputs, compiled once."""
    return _tangent(model, outputs)
