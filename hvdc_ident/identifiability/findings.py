"""What an assessment has found so far: verdicts, what is held and why, combinations, remarks."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from hvdc_ident.executor import Progress
from hvdc_ident.fit import FitParameter, Problem
from hvdc_ident.fit.profile_path import ProfileOptions
from hvdc_ident.identifiability.combinations import Combination
from hvdc_ident.identifiability.optima import OtherOptimum
from hvdc_ident.identifiability.pilot import Optimum
from hvdc_ident.identifiability.verdicts import Verdict


@dataclass
class Findings:
    """One assessment's findings; it grows while the assessment runs.

    problem: all candidates free. found: the first verdict on each. held: reason by parameter. held_at: the value of a held one
    where that is not its start. remark: said of every
    parameter. quiet: whether no input moves. unmoved: parameters that show only where an input is moved that was not.
    ends: where the starts of the pilot fit ended, with their costs. optima: others as good as the last one.
    """

    problem: Problem
    seed: int = 0
    profile_options: ProfileOptions = field(default_factory=ProfileOptions)
    progress: Progress | None = None
    found: dict[str, Verdict] = field(default_factory=dict)
    held: dict[str, str] = field(default_factory=dict)
    held_at: dict[str, float] = field(default_factory=dict)
    combinations: list[Combination] = field(default_factory=list)
    thresholds: dict[str, float] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    remark: str = ""
    quiet: bool = False
    unmoved: tuple[str, ...] = ()
    ends: tuple[tuple[Mapping[str, float], float], ...] = ()
    optima: tuple[OtherOptimum, ...] = ()

    def __post_init__(self) -> None:
        self.free: dict[str, FitParameter] = {f.name: f for f in self.problem.free}
        self.units = {n: self.problem.simulator.parameters[n].unit for n in self.free}

    def tell(self, text: str) -> None:
        """Says what is being done, to whoever watches."""
        if self.progress:
            self.progress(0, 1, text)

    def judge(self, verdict: Verdict) -> None:
        """Notes the verdict, unless there is one on that parameter already."""
        self.found.setdefault(verdict.name, verdict)

    def without(self, optimum: Optimum, out: Mapping[str, str]) -> Optimum | None:
        """The optimum with those held at their given values, with their reasons; None where nothing is left.

        Where the model cannot be run so, or the records exclude it (the cost rises beyond a threshold, the others re-fitted),
        they are held at their values at the optimum, and their reasons say it: the others would answer for a wrong value.
        """
        if not out:
            return optimum
        self.held |= out
        if len(out) == len(optimum.names):
            return None
        fewer = optimum.held(out, {n: self.free[n].given for n in out})
        why = "the model cannot be run"
        if fewer.cost - optimum.cost > min(self.thresholds[n] for n in out):
            fewer = optimum.held(out, {n: optimum.value(n) for n in out})
            why = "the records cannot be met"
        for n in out:
            value, unit = fewer.problem.held[n], f" {self.units[n]}" if self.units[n] else ""
            if value != self.free[n].given:
                remark = f"It is held at {value:.4g}{unit}: at its given value, {self.free[n].given:.4g}{unit}, {why}."
                self.held_at[n] = value
                self.held[n] = f"{self.held[n]} {remark}"
                self.found[n] = self.found[n].noted(remark)
        return fewer
