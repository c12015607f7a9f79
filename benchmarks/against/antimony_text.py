"""A model as Antimony text, from which SBML's simulators make machine code of their own."""

from __future__ import annotations

from collections.abc import Mapping

import sympy as sp
from sympy.printing.str import StrPrinter

from hvdc_ident.model import Model


class _Antimony(StrPrinter):
    """Expressions in Antimony: powers with ^, limits as min and max."""

    def _print_Pow(self, expr: sp.Pow, rational: bool = False) -> str:
        if expr.exp == sp.S.Half:
            return f"sqrt({self._print(expr.base)})"
        return f"(({self._print(expr.base)})^({self._print(expr.exp)}))"

    def _print_clip(self, expr: sp.Expr) -> str:
        x, low, high = map(self._print, expr.args)
        return f"min(max({x}, {low}), {high})"

    def _print_Max(self, expr: sp.Expr) -> str:
        return f"max({', '.join(map(self._print, expr.args))})"

    def _print_Min(self, expr: sp.Expr) -> str:
        return f"min({', '.join(map(self._print, expr.args))})"


def antimony_text(model: Model, start: Mapping[str, float], steps: Mapping[str, tuple[float, float, float]]) -> str:
    """The model with the states beginning at `start`; steps: by input when it steps, from where and to where."""
    text = _Antimony({"full_prec": True})
    lines = ["model link()"]
    lines += [f"  {n} = {v!r};" for n, v in model.values.items()]
    lines += [f"  {n} = {steps[n][1] if n in steps else i.value!r};" for n, i in model.inputs.items()]
    lines += [f"  {n} := {text.doprint(g.value)};" for n, g in model.signals.items()]
    lines += [f"  {n} := {text.doprint(a.equation)};" for n, a in model.algebraic.items()]
    lines += [f"  {n}' = {text.doprint(x.derivative)};\n  {n} = {start[n]!r};" for n, x in model.states.items()]
    lines += [f"  at (time >= {at!r}): {n} = {after!r};" for n, (at, _, after) in steps.items()]
    return "\n".join([*lines, "end", ""])
