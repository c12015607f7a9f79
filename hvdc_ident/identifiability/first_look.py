"""The first answer of a long assessment: what the curvature at the given values says, before any search."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from hvdc_ident.fit import Problem
from hvdc_ident.fit.noise_model import from_misfit
from hvdc_ident.identifiability.combinations import combinations_of
from hvdc_ident.identifiability.pilot import unfitted
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import independent, null_directions
from hvdc_ident.text import listed, quantity

HALF_95 = 1.96
"""Half the width of a normal distribution's central 95 %, in standard deviations."""


@dataclass(frozen=True)
class FirstLook:
    """The local analysis at the given values (Cramer and Rao's bound there): valid as far as the model is linear.

    values: where it was made. std: of each parameter in its unit beside the others, None where it is held, for these records do
    not tell it apart from others there, or not at all. combinations: in words, what alone is seen of some. conditional_on: for
    a member of one the members that are held. chi2_per_dof: of the misfit at the given values; None where no noise is
    known. seconds: what one evaluation with derivatives took.
    """

    values: FrozenMap[float]
    units: FrozenMap[str]
    std: FrozenMap[float | None]
    combinations: tuple[str, ...]
    conditional_on: FrozenMap[tuple[str, ...]]
    chi2_per_dof: float | None
    seconds: float

    @property
    def lines(self) -> list[str]:
        """The answer in lines for people."""
        found = ["First answer, from the curvature at the given values; the search for the optimum follows."]
        if self.chi2_per_dof is not None:
            found.append(f"Misfit of the given values: chi2/dof {self.chi2_per_dof:.3g}.")
        width = max(map(len, self.values), default=0)
        for name, value in self.values.items():
            std, unit = self.std[name], self.units[name]
            at = f"{name:{width}}  {quantity(value, unit)}"
            if std is None:
                found.append(f"{at}: not told there, held")
            else:
                share = f" ({100.0 * HALF_95 * std / abs(value):.2g} %)" if value else ""
                held = f" with {listed(self.conditional_on[name])} held" if name in self.conditional_on else ""
                found.append(f"{at}: would be known to \u00b1{quantity(HALF_95 * std, unit, 2)}{share}{held}")
        return [*found, *(f"{words[:1].upper()}{words[1:]}." for words in self.combinations)]

    def to_dict(self) -> dict[str, Any]:
        """The answer as it stands in the JSON under `first`."""
        return {
            "at": "given",
            "chi2_per_dof": self.chi2_per_dof,
            "parameters": {
                n: {
                    "value": v,
                    "std": self.std[n],
                    "unit": self.units[n],
                    "conditional_on": list(self.conditional_on.get(n, ())),
                }
                for n, v in self.values.items()
            },
            "combinations": list(self.combinations),
        }


def first_look(problem: Problem) -> FirstLook:
    """Return the local analysis of a fit's parameters at their given values; one evaluation with derivatives.

    Standard deviations that are not given are the misfit's there. Raises SimulationError where it cannot be made.
    """
    begun = time.perf_counter()
    at, result = unfitted(problem)
    columns = at.columns
    seconds = time.perf_counter() - begun
    names, k = at.names, len(at.names)
    null = null_directions(columns, at.error)[:, :k]
    null = null[(np.abs(null) > 0).any(axis=1)]
    logs = [f.min > 0 for f in problem.free]
    combos = combinations_of(null, names, logs, at.theta[:k].tolist(), "practical") if null.size else ()
    kept = independent(at.information.matrix, at.error)
    held = [n for i, n in enumerate(names) if i not in kept]
    std: dict[str, float | None] = dict.fromkeys(names)
    if kept:
        covariance = np.linalg.inv(at.information.select([names[i] for i in kept]).matrix)
        own = np.sqrt(np.diag(covariance)) * at.slope[list(kept)]
        std |= {names[i]: float(s) for i, s in zip(kept, own, strict=True)}
    conditional = {
        n: tuple(m for m in held if any(m in c.members and n in c.members for c in combos))
        for n in names
        if n not in held and any(n in c.members for c in combos)
    }
    known = not any(from_misfit(s) for s in result.noise_source.values())
    units = {n: problem.simulator.parameters[n].unit for n in names}
    return FirstLook(
        FrozenMap({n: at.value(n) for n in names}),
        FrozenMap(units),
        FrozenMap(std),
        tuple(c.words for c in combos),
        FrozenMap(conditional),
        at.misfit if known else None,
        seconds,
    )
