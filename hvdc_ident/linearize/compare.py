"""Two linear models against each other: how far apart they are, for feedback and in their responses."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy.linalg

from hvdc_ident.errors import LinearizationError
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.linearize.gap import NuGap, gap, ncf_margin, nu_gap, same_channels
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.norms import Peak, linf_norm
from hvdc_ident.linearize.reduce import without_sliding_means


@dataclass(frozen=True)
class ModelDistance:
    """Distance of a second model from a first one, between the same inputs and outputs.

    nu_gap: in [0, 1], with its winding condition. gap: in [0, 1], None where it was not found. attainable: the largest
    normalised coprime factor margin that any controller of the first attains: where the nu-gap is below it, one
    controller can suit both. difference: L-infinity norm of first - second, in output per input units, None where it is
    infinite. relative: that over the norm of the first, None where there is none. notes: why a number is missing.
    """

    first: str
    second: str
    nu_gap: NuGap
    gap: float | None
    attainable: float | None
    difference: Peak | None
    relative: float | None
    notes: tuple[str, ...] = ()

    def to_dict(self) -> dict[str, Any]:
        """The comparison as plain numbers."""
        return {
            "model": self.first,
            "other": self.second,
            **self.nu_gap.to_dict(),
            "gap": self.gap,
            "attainable_margin": self.attainable,
            "difference": None if self.difference is None else self.difference.to_dict(),
            "relative_difference": self.relative,
            "notes": list(self.notes),
        }

    def __str__(self) -> str:
        far = self.nu_gap
        verdict = (
            "no controller of one need suit the other"
            if far.value >= 1.0
            else f"largest at {far.omega / (2 * np.pi):.4g} Hz"
        )
        lines = [f"{self.first} against {self.second}: nu-gap {far.value:.4g}, {verdict}"]
        if self.attainable is not None:
            lines.append(f"largest margin that a controller of {self.first} attains: {self.attainable:.4g}")
        if self.difference is not None:
            share = "" if self.relative is None else f", {100 * self.relative:.3g} % of the largest gain"
            where = self.difference.omega / (2 * np.pi)
            lines.append(f"largest difference of gain {self.difference.value:.4g} at {where:.4g} Hz{share}")
        return "\n".join([*lines, *self.notes])


def compare(first: LinearModel, second: LinearModel) -> ModelDistance:
    """Return how far two models with the same inputs and outputs are apart.

    Every number depends on units: scale both first (`LinearModel.scaled`) so that 1 matters equally in each channel.
    Raises LinearizationError where the numbers of inputs or outputs differ.

    >>> from hvdc_ident import compare, linearize, load_model
    >>> link = load_model("vsc-hvdc-link")
    >>> channel = {"inputs": "Vdcref1", "outputs": "Vdc1"}
    >>> other = linearize(link.with_values({"KIVDC": 500.0}), **channel)
    >>> round(compare(linearize(link, **channel), other).nu_gap.value, 2)
    0.07
    """
    far = nu_gap(first, second)
    notes: list[str] = []
    both: float | None = None
    attainable: float | None = None
    try:
        attainable = ncf_margin(first).value
        both = gap(first, second)
    except LinearizationError as e:
        notes.append(f"gap: {e.what}")
    apart, relative = None, None
    try:
        apart = linf_norm(difference(first, second))
        size = linf_norm(first).value
        relative = apart.value / size if size > 0 else None
    except LinearizationError as e:
        notes.append(f"difference: {e.what}")
    return ModelDistance(first.name, second.name, far, both, attainable, apart, relative, tuple(notes))


def difference(first: LinearModel, second: LinearModel) -> LinearModel:
    """Return the model first - second, delays in their Pade form. Raises LinearizationError where the sizes differ."""
    same_channels(first, second)
    a1, b1, c1, d1 = without_sliding_means(first)
    a2, b2, c2, d2 = without_sliding_means(second)
    names = (*_names("1", first, a1.shape[0]), *_names("2", second, a2.shape[0]))
    return replace(
        first,
        A=scipy.linalg.block_diag(a1, a2) if names else np.zeros((0, 0)),
        B=np.concatenate([b1, b2]),
        C=np.concatenate([c1, -c2], axis=1),
        D=d1 - d2,
        E=np.eye(len(names)),
        state_names=names,
        state_units=(),
        x0=(0.0,) * len(names),
        point=None,
        gradients=FrozenMap(),
        delay_free=None,
        name=f"{first.name} - {second.name}",
    )


def _names(prefix: str, model: LinearModel, count: int) -> tuple[str, ...]:
    """The states' names; numbers where some states have been projected out."""
    known = model.state_names if count == len(model.state_names) else [f"x{k + 1}" for k in range(count)]
    return tuple(f"{prefix}.{n}" for n in known)
