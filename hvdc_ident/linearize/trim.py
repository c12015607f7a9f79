"""Trim: the inputs that are set so that outputs have given values at rest."""

from __future__ import annotations

from collections.abc import Collection, Mapping

import numpy as np

from hvdc_ident.errors import SteadyStateError, unknown_name
from hvdc_ident.linearize.matrices import Array
from hvdc_ident.linearize.operating_point import OperatingPoint
from hvdc_ident.model import AnyModel

DEPENDENT = 1e-8
"""Share of its length that is left of an output's row of gains, below which it follows from other outputs': gains are sums
of products that rounding changes by 1e-16 of their terms, and these may be a hundred million times what is left."""
NEGLIGIBLE = 1e-9
"""Share of the largest gain below which an input is taken for without effect: it would have to move a billion times as far
as the other one, in their units, and rounding leaves about 1e-16."""


def known_inputs(model: AnyModel, inputs: Mapping[str, float]) -> dict[str, float]:
    """Return the inputs' values. Raises UnknownNameError for a name that is no input."""
    for name in inputs:
        if name not in model.inputs:
            raise unknown_name("input", name, model.inputs, where=f"operating point of model '{model.name}'")
    return dict(inputs)


def freed_inputs(model: AnyModel, point: OperatingPoint, outputs: Collection[str], held: Collection[str]) -> list[str]:
    """Return the inputs that set some outputs at rest, where these are as many as the outputs; else SteadyStateError.

    point: where the dc gains are taken. held: inputs that stay. An input counts where its gain on one of the outputs
    is above NEGLIGIBLE of the largest that an input has on it.
    """
    gains = _dc_gains(model, point, outputs)
    names = [n for n in model.inputs if n not in held]
    columns = [list(model.inputs).index(n) for n in names]
    _independent(model, list(outputs), gains[:, columns])
    sizes = np.abs(gains[:, columns])
    effective = sizes > NEGLIGIBLE * sizes.max(axis=1, initial=0.0)[:, None]
    moving = [n for n, hit in zip(names, effective.any(axis=0), strict=True) if hit]
    if len(moving) == len(outputs):
        return moving
    listed = "; ".join(
        f"{n} moves {', '.join(f'{o} by {gains[i, k]:.3g}' for i, o in enumerate(outputs) if effective[i, j])}"
        for j, (n, k) in enumerate(zip(names, columns, strict=True))
        if n in moving
    )
    first = [moving[k] for k in np.argsort([-sizes[:, names.index(n)].max() for n in moving], kind="stable")]
    raise SteadyStateError(
        f"which inputs are to set {', '.join(outputs)}?",
        where=f"operating point of model '{model.name}'",
        expected=f"{len(outputs)} input{'s' if len(outputs) > 1 else ''} that can",
        got=listed or "no input moves them at rest",
        hint=f"name them: free={first[: len(outputs)]!r}" if moving else "free a parameter: free=[...]",
    )


def _independent(model: AnyModel, outputs: list[str], gains: Array) -> None:
    """Raise SteadyStateError where outputs move together at rest, so that no inputs give all of them values of their own.

    gains: (outputs, inputs). Each row is compared with what the rows before it make of it (modified Gram-Schmidt, with
    the inputs as they are).
    """
    lengths = np.linalg.norm(gains, axis=1)
    chosen: list[int] = []
    for i in (k for k in range(len(outputs)) if lengths[k] > 0.0):
        others = gains[chosen] / lengths[chosen, None]
        row = gains[i] / lengths[i]
        share = np.linalg.lstsq(others.T, row, rcond=DEPENDENT)[0] if chosen else np.zeros(0)
        if np.linalg.norm(row - share @ others) > DEPENDENT:
            chosen.append(i)
            continue
        parts = [
            (chosen[k], share[k] * lengths[i] / lengths[chosen[k]])
            for k in range(len(chosen))
            if abs(share[k]) > DEPENDENT
        ]
        rule = " + ".join(f"{factor:.4g} d({outputs[k]})" for k, factor in parts).replace("+ -", "- ")
        names = [outputs[i], *(outputs[k] for k, _ in parts)]
        raise SteadyStateError(
            f"{', '.join(outputs)} cannot all be set: at rest {outputs[i]} moves only with {' and '.join(names[1:])}",
            where=f"operating point of model '{model.name}'",
            expected="outputs that inputs can set one by one",
            got=f"d({outputs[i]}) = {rule}, whichever inputs move them",
            hint=f"leave out {' or '.join(names)}, or free a parameter: free=[...]",
        )


def _dc_gains(model: AnyModel, point: OperatingPoint, outputs: Collection[str]) -> Array:
    """(outputs, all inputs) gains at rest; 0 for an input that drives an integrator: there is no rest with another value."""
    from hvdc_ident.linearize.jacobian import linearize

    a, b, c, d = linearize(model, point, outputs=list(outputs)).standard()
    if not a.shape[0]:
        return d
    x = np.linalg.lstsq(a, -b, rcond=1e-13)[0]
    rest = np.linalg.norm(a @ x + b, axis=0) <= 1e-8 * np.maximum(np.linalg.norm(b, axis=0), 1e-300)
    return np.asarray(np.where(rest, d + c @ x, 0.0))
