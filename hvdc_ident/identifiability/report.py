"""The report on identifiability: verdicts, the set to fit, and the evidence.

It prints one screen, plots profiles and verdicts, and `to_dict` is its JSON.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from hvdc_ident.display import Shown, Table, data_frame
from hvdc_ident.errors import ComputationError, unknown_name
from hvdc_ident.files import plain
from hvdc_ident.fit.profile import PairProfile, Profile
from hvdc_ident.identifiability.experiment_design import Recommendation
from hvdc_ident.identifiability.likelihood_intervals import OtherOptimum
from hvdc_ident.identifiability.misspecification import Heterogeneity, Misspecification
from hvdc_ident.identifiability.structural import StructuralAnalysis
from hvdc_ident.identifiability.verdicts import Verdict
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import Collinear, Combination, LocalSensitivities
from hvdc_ident.text import interval_text

IN_JSON = (
    "verdict",
    "reason",
    "value",
    "unit",
    "scale",
    "ci95",
    "std",
    "relative_std",
    "sensitivity_norm",
    "collinearity",
    "partner",
    "conditional_on",
    "optima",
)
"""Fields of a verdict in the JSON."""
CONDITIONS = (
    "Every verdict holds for these outputs, experiments, noise and bounds, at the optimum of the pilot fit; with other "
    "data it may be another."
)


@dataclass(frozen=True, eq=False, repr=False)
class IdentifiabilityReport(Shown):
    """Findings of the experiments about the candidates.

    parameters: the verdicts, in the order of the candidates. identifiable: the set a fit uses. held: the value and the
    reason of each other one. not_judged: those of the held that noise alone would tell, which only the misfit hides: a
    diagnosis leaves them free. optima: others, of the set fitted, that are as good as the best within the noise.
    combinations: what is seen of those that cannot be told apart. collinear: subsets with their index, worst first within
    each size. shares: of each parameter's information, by experiment.
    pair: the common profile of two, its rises in units of the threshold of one. notes: remarks on the data and on what the
    search met. recommended: what to measure next; not_recommended: why nothing is.
    sensitivities: exact ones of trajectories, steady state, eigenvalues and responses at the values found or held; None where
    the model has no equations here.
    """

    parameters: FrozenMap[Verdict]
    identifiable: tuple[str, ...]
    held: FrozenMap[tuple[float, str]]
    structure: StructuralAnalysis
    combinations: tuple[Combination, ...] = ()
    collinear: tuple[Collinear, ...] = ()
    correlation: Mapping[str, Mapping[str, float]] = field(default_factory=dict)
    shares: FrozenMap[FrozenMap[float]] = field(default_factory=FrozenMap)
    heterogeneity: FrozenMap[Heterogeneity] = field(default_factory=FrozenMap)
    misspecification: Misspecification = field(default_factory=lambda: Misspecification(False, ()))
    recommended: Recommendation | None = None
    not_recommended: str = ""
    thresholds: FrozenMap[float] = field(default_factory=FrozenMap)
    pilot: Mapping[str, Any] = field(default_factory=dict)
    notes: tuple[str, ...] = ()
    pair: PairProfile | None = None
    sensitivities: LocalSensitivities | None = None
    not_judged: tuple[str, ...] = ()
    optima: tuple[OtherOptimum, ...] = ()

    @property
    def conditional_on(self) -> dict[str, tuple[str, ...]]:
        """For each fitted one the held ones without which it could not be told."""
        return {n: v.conditional_on for n, v in self.parameters.items() if v.conditional_on and n in self.identifiable}

    def to_dict(self) -> dict[str, Any]:
        """The report as JSON takes it: full precision, None for what is not finite."""
        s = self.structure
        found = {
            "parameters": {n: {f: getattr(v, f) for f in IN_JSON} for n, v in self.parameters.items()},
            "identifiable": list(self.identifiable),
            "not_judged": list(self.not_judged),
            "optima": [{"values": dict(o.values), "cost_rise": o.rise} for o in self.optima],
            "held": {n: {"value": v, "reason": why} for n, (v, why) in self.held.items()},
            "combinations": [
                {
                    "members": list(c.members),
                    "seen": list(c.seen),
                    "words": c.words,
                    "kind": c.kind,
                    "direction": dict(c.direction),
                    "held": list(c.held),
                }
                for c in self.combinations
            ],
            "collinearity": [{"parameters": list(c.names), "index": c.index} for c in self.collinear],
            "correlation": self.correlation,
            "structural": {
                "status": s.status,
                "method": s.method,
                "unidentifiable": list(s.unidentifiable),
                "admissible": list(s.admissible),
                "note": s.note,
            },
            "misspecified": self.misspecification.flag,
            "misspecification": {
                "signs": list(self.misspecification.signs),
                "next": self.misspecification.pointer,
                "heterogeneity": {n: plain(h) for n, h in self.heterogeneity.items()},
            },
            "experiments": {e: {"information": dict(t)} for e, t in self.shares.items()},
            "recommended_experiment": self.recommended.to_dict() if self.recommended else None,
            "not_recommended": self.not_recommended,
            "profiles": {n: _profile(v.profile) for n, v in self.parameters.items() if v.profile is not None},
            "pair": self.pair,
            "sensitivities": self.sensitivities.to_dict() if self.sensitivities else None,
            "pilot": self.pilot,
            "notes": [*self.notes, CONDITIONS],
        }
        return {k: plain(v) for k, v in found.items()}

    def plot(self, parameter: str | None = None, ax: Any = None) -> Any:
        """Axes with one parameter's profile; without a name, with the interval and the verdict of every candidate.

        Raises UnknownNameError for a name that is no candidate, ComputationError for one that has no profile.
        """
        import matplotlib.pyplot as plt

        from hvdc_ident.axes import draw_intervals, draw_profile

        found = self.to_dict()
        if parameter is not None and parameter not in found["parameters"]:
            raise unknown_name("candidate", parameter, found["parameters"])
        if parameter is not None and parameter not in found["profiles"]:
            reason = found["parameters"][parameter]["reason"]
            raise ComputationError(f"{parameter} has no profile", got=reason, hint="plot() shows every verdict")
        axes = ax if ax is not None else plt.subplots(layout="constrained")[1]
        if parameter is None:
            draw_intervals(axes, found["parameters"])
        else:
            draw_profile(axes, parameter, found["profiles"][parameter], found["parameters"][parameter])
        return axes

    def _screen(self) -> Iterator[str | Table]:
        fitted = ", ".join(self.identifiable) or "none"
        yield f"Identifiable: {fitted} (of {len(self.parameters)} asked about)."
        rows = [(n, v.verdict, v.value, v.unit, interval_text(v.ci95)) for n, v in self.parameters.items()]
        yield Table(("parameter", "verdict", "value", "unit", "95 % interval"), tuple(rows))
        yield "\n".join(f"{n}: {v.reason}" for n, v in self.parameters.items())
        signs = self.misspecification
        if signs.flag:
            yield f"The model does not explain these data: {'; '.join(signs.signs)}."
        if self.recommended is not None:
            yield f"Measure next: {self.recommended.text}"
        elif self.not_recommended:
            yield self.not_recommended
        yield "\n".join([*self.notes, CONDITIONS])

    def __str__(self) -> str:
        return "\n\n".join(str(block) for block in self._screen() if block)  # reasons stay whole: they are searched for

    def to_dataframe(self) -> Any:
        """Return the verdicts as a pandas DataFrame, a row a parameter. Raises InputError where pandas is missing."""
        verdicts = self.parameters.values()
        ends = [v.ci95 or (None, None) for v in verdicts]
        columns: dict[str, Any] = {
            "verdict": [v.verdict for v in verdicts],
            "value": [v.value for v in verdicts],
            "unit": [v.unit for v in verdicts],
            "std": [v.std for v in verdicts],
            "ci95_low": [low for low, _ in ends],
            "ci95_high": [high for _, high in ends],
            "reason": [v.reason for v in verdicts],
        }
        return data_frame(columns, list(self.parameters), "parameter")


def _profile(p: Profile) -> dict[str, Any]:
    sides = {
        n: {"status": s.status, "limit": s.limit, "reason": s.reason}
        for n, s in (("lower", p.lower), ("upper", p.upper))
    }
    return {
        "values": np.asarray(p.values),
        "rises": np.asarray(p.rises),
        "threshold": p.threshold,
        "one_sided": p.one_sided,
        **sides,
    }
