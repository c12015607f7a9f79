"""The verb `identifiability`: structure, pilot fit, information and profiles, put together into verdicts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from hvdc_ident.errors import SimulationError, StudyError
from hvdc_ident.experiment import Experiment
from hvdc_ident.fit import FitResult, Free, Problem, Simulator
from hvdc_ident.fit.estimate import Executor, Progress
from hvdc_ident.fit.objective import LeastSquares
from hvdc_ident.fit.profile import Profile, Walk, profiles
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.identifiability import verdicts
from hvdc_ident.identifiability.combinations import Combination, combinations_of, partners
from hvdc_ident.identifiability.evidence import (
    bounded,
    joint_limits,
    pair_of,
    partner,
    physical_bounds,
    rise_at_ends,
    spreads,
    thresholds,
)
from hvdc_ident.identifiability.heterogeneity import Misspecification, heterogeneity, misspecification
from hvdc_ident.identifiability.pilot import Optimum, pilot
from hvdc_ident.identifiability.recommend import Recommendation, recommend
from hvdc_ident.identifiability.report import IdentifiabilityReport
from hvdc_ident.identifiability.structure import Structure
from hvdc_ident.identifiability.structure import structure as structure_of
from hvdc_ident.identifiability.verdicts import Verdict
from hvdc_ident.model.definition import Model
from hvdc_ident.sensitivity.fisher import (
    collinear_subsets,
    independent,
    inflation_index,
    null_directions,
    pivoted_order,
    rise_over_range,
)
from hvdc_ident.simulate.model_simulator import ModelSimulator


def identifiability(
    subject: Model | Simulator,
    experiments: Iterable[Experiment],
    candidates: Iterable[Free],
    *,
    starts: int = 8,
    seed: int = 0,
    held: Mapping[str, float] | None = None,
    pair: tuple[str, str] | None = None,
    walk: Walk | None = None,
    executor: Executor | None = None,
    progress: Progress | None = None,
) -> IdentifiabilityReport:
    """What the experiments tell about the candidates: a verdict on each, the set to fit, and what to measure next.

    subject: a model, or anything that can be simulated (then the structure is judged by numbers, at random points).
    candidates: the parameters to judge, with start and bounds. held: values of other parameters.
    pair: two candidates whose common profile is wanted too, over twice their intervals, where both are fitted.
    Raises StudyError where there is nothing to judge, SimulationError where an experiment cannot be simulated.
    """
    simulator: Simulator = ModelSimulator(subject) if isinstance(subject, Model) else subject
    problem = Problem(simulator, tuple(experiments), tuple(candidates), held=FrozenMap(held or {}))
    model = subject if isinstance(subject, Model) else None
    report, last = _Assessment(problem, model, seed, walk or Walk(), progress).report(starts, executor)
    if pair and last is not None and set(pair) <= set(report.identifiable):
        return replace(report, pair=pair_of(last, report.parameters, pair))
    note = f"No common profile of {' and '.join(pair)}: not both are fitted." if pair else ""
    return replace(report, notes=(*report.notes, note)) if note else report


class _Assessment:
    """One assessment; what was found so far."""

    def __init__(self, problem: Problem, model: Model | None, seed: int, walk: Walk, progress: Progress | None) -> None:
        self.problem, self.model, self.seed, self.walk, self.progress = problem, model, seed, walk, progress
        self.free = {f.name: f for f in problem.free}
        self.units = {n: problem.simulator.parameters[n].unit for n in self.free}
        self.found: dict[str, Verdict] = {}
        self.held: dict[str, str] = {}
        self.combinations: list[Combination] = []
        self.thresholds: dict[str, float] = {}
        self.notes: list[str] = []
        self.remark = ""

    def report(self, starts: int, executor: Executor | None) -> tuple[IdentifiabilityReport, Optimum | None]:
        """The report, and the optimum of the set that is fitted."""
        self._check()
        self._tell("structure")
        structure = structure_of(self.model, self.problem, self.seed)
        self._structural(structure)
        first = replace(
            self.problem,
            free=tuple(f for f in self.problem.free if f.name not in self.held),
            held=self.problem.held | {n: self.free[n].start for n in self.held},
        )
        optimum, result = pilot(first, starts=starts, seed=self.seed, executor=executor, progress=self.progress)
        self._data_notes(optimum, result)
        rest: Optimum | None = self._insensitive(optimum)
        rest = self._lost(rest) if rest else None
        last = self._profiled(rest) if rest else None
        return self._assembled(structure, optimum, last, result), last

    def _tell(self, text: str) -> None:
        if self.progress:
            self.progress(0, 1, text)

    def _check(self) -> None:
        for e in self.problem.fitted_experiments:
            assert e.measured is not None
            if not any(np.isfinite(e.measured[o][e.compared]).any() for o in e.outputs):
                raise StudyError(
                    "nothing was measured", where=f"experiment '{e.name}'", expected="finite values in its window"
                )
        self.quiet = all(s.is_constant for e in self.problem.fitted_experiments for s in e.inputs.values())
        if self.quiet and any(e.inputs for e in self.problem.fitted_experiments):
            self.notes.append("No input moves in any of the experiments: they show a steady state and nothing else.")

    def _data_notes(self, optimum: Optimum, result: FitResult) -> None:
        rows = sum(b.residual.size for b in optimum.blocks)
        if rows <= optimum.theta.size:
            self.notes.append(f"{rows} measured values cannot determine {optimum.theta.size} unknowns.")
        if optimum.deterministic:
            names = ", ".join(optimum.deterministic)
            self.notes.append(f"The records of {names} have no noise: standard deviations are those of the misfit.")
            self.remark = "The data have no noise; what noise they stand for is taken from the misfit."
        if result.status in ("two-optima", "not-converged"):
            self.notes.append(f"Pilot fit: {result.status}, {result.message}.")

    # --- the stages, each taking parameters out ---

    def _structural(self, structure: Structure) -> None:
        self.unmoved = structure.unmoved
        stuck = [n for n in self.free if n not in structure.admissible]
        self.combinations += [
            replace(c, held=tuple(n for n in c.members if n in stuck)) for c in structure.combinations
        ]
        for c in structure.combinations:
            for n in c.members:
                at = self.free[n].start if n in stuck else None
                others = [m for m in c.members if m in stuck]
                self.found.setdefault(
                    n,
                    verdicts.structural(
                        n, c.words, at, self.units[n], others, local=structure.method.endswith("local")
                    ),
                )
        for n in stuck:
            self.held[n] = self.found[n].reason if n in self.found else "not seen"
        if structure.note:
            self.notes.append(f"Structure {structure.status}: {structure.note}.")

    def _insensitive(self, optimum: Optimum) -> Optimum | None:
        """The optimum without the parameters whose whole range changes nothing, confirmed by refits at both ends."""
        self.thresholds = thresholds(optimum)
        matrix, names = optimum.information.matrix, optimum.names
        out: dict[str, str] = {}
        for i, n in enumerate(names):
            limit = self.thresholds[n]
            if rise_over_range(matrix[i, i] / optimum.slope[i] ** 2, self.free[n].span) >= limit:
                continue
            rise = rise_at_ends(optimum, i, self.free[n])
            if rise is None or rise >= limit:
                continue
            self._judge(verdicts.insensitive(self.free[n], rise, limit, self.units[n], self._still(n)))
            out[n] = self.found[n].reason
        return self._without(optimum, out)

    def _still(self, name: str) -> str:
        """The remark that it is for want of moving an input, where it is."""
        if self.quiet:
            return "No input moves in any of these experiments."
        return "It shows only where an input is moved that was not." if name in self.unmoved else ""

    def _lost(self, optimum: Optimum) -> Optimum | None:
        """The optimum with the fewest parameters held so that no direction is invisible in these data."""
        k = len(optimum.names)
        null = null_directions(optimum.columns)[:, :k]
        null = null[(np.abs(null) > 0).any(axis=1)]
        if not null.size:
            return optimum
        logs = [u.min > 0 for u in optimum.problem.free]
        combos = combinations_of(null, optimum.names, logs, optimum.theta[:k].tolist(), "practical")
        kept = {optimum.names[i] for i in independent(optimum.information.matrix)}
        members = [n for n in optimum.names if any(n in c.members for c in combos)]
        out = {n: "" for n in members if n not in kept}
        self.combinations += [replace(c, held=tuple(n for n in c.members if n in out)) for c in combos]
        for n in members:
            words = next(c.words for c in combos if n in c.members)
            self._judge(verdicts.lost(n, words, self.free[n].start if n in out else optimum.value(n), self.units[n]))
        return self._without(optimum, {n: self.found[n].reason for n in out})

    def _profiled(self, optimum: Optimum | None) -> Optimum | None:
        """The optimum of the set all of whose profiles are closed, with a verdict on every member."""
        while optimum is not None:
            limits = thresholds(optimum)
            self.thresholds |= limits
            physical = physical_bounds(optimum.problem)
            around = profiles(
                LeastSquares.of(optimum.problem),
                optimum.theta,
                optimum.names,
                threshold=limits,
                physical=physical,
                walk=self.walk,
                progress=self.progress,
            )
            self.notes += [f"A better optimum was found: {r}." for r in around.restarts]
            optimum = Optimum(optimum.problem, around.theta)
            around_by_name = joint_limits(optimum, around.by_name, limits, seed=self.seed)
            opened = [n for n, p in around_by_name.items() if not bounded(p)]
            if not opened:
                self._closed(optimum, around_by_name, physical)
                return optimum
            combo = self._open_combination(optimum, opened)
            for n in opened:
                words = combo.words if combo and n in combo.members else ""
                self._judge(verdicts.practical(around_by_name[n], words, self.units[n]))
            order = [optimum.names[i] for i in pivoted_order(optimum.information.matrix)]
            victim = max(opened, key=order.index)
            if combo:
                self.combinations.append(replace(combo, held=(victim,)))
            optimum = self._without(optimum, {victim: self.found[victim].reason})
        return None

    def _open_combination(self, optimum: Optimum, opened: Sequence[str]) -> Combination | None:
        """What of the open ones is seen together, where they are open because they make each other good."""
        if len(opened) < 2:
            return None
        matrix = optimum.information.select(opened).matrix
        d = np.sqrt(np.diag(matrix))
        if not (d > 0).all():
            return None
        values, vectors = np.linalg.eigh(matrix / np.outer(d, d))
        if values[0] > (2.0 / verdicts.COLLINEAR) ** 2:
            return None
        logs = [self.free[n].min > 0 for n in opened]
        null = vectors[:, :1].T / d
        found = combinations_of(null, opened, logs, [optimum.value(n) for n in opened], "practical")
        return found[0] if len(found[0].members) > 1 else None

    def _closed(
        self, optimum: Optimum, found: Mapping[str, Profile], physical: Mapping[str, tuple[bool, bool]]
    ) -> None:
        """Verdicts on the set whose profiles are closed."""
        index = inflation_index(optimum.information.matrix)
        shares = optimum.information.shares()
        spread = spreads(optimum)
        conditional = partners(self.combinations, self.held)
        for i, n in enumerate(optimum.names):
            p, free, unit = found[n], self.free[n], self.units[n]
            if p.one_sided:
                own = physical[n][int(p.value >= free.max)]
                self._judge(verdicts.at_bound(p, free, own, unit))
                continue
            best = max(shares, key=lambda e: shares[e][n])
            judged = verdicts.closed(p, free, spread[n].std, float(index[i]), partner(optimum, i), f"'{best}'", unit)
            given = conditional.get(n, ())
            judged = replace(judged, conditional_on=given)
            if n in self.found:  # a member of a combination: its verdict stands, its interval is that of the set fitted
                self.found[n] = replace(judged, verdict=self.found[n].verdict, reason=self.found[n].reason).noted(
                    f"With {', '.join(given)} held it is {_lower(judged.reason)}" if given else ""
                )
            else:
                self._judge(judged)

    def _judge(self, verdict: Verdict) -> None:
        self.found.setdefault(verdict.name, verdict)

    def _without(self, optimum: Optimum, out: Mapping[str, str]) -> Optimum | None:
        """The optimum with those held at their start values; None where nothing is left."""
        if not out:
            return optimum
        self.held |= out
        if len(out) == len(optimum.names):
            return None
        return optimum.held(out, {n: self.free[n].start for n in out})

    # --- the end ---

    def _assembled(
        self, structure: Structure, first: Optimum, last: Optimum | None, result: FitResult
    ) -> IdentifiabilityReport:
        bound = {n for n, v in self.found.items() if v.verdict == "at-bound"}
        fitted = tuple(n for n in self.free if last is not None and n in last.names and n not in bound)
        held = {
            n: (self.found[n].value, self.found[n].reason) if n in bound else (self.free[n].start, self.held[n])
            for n in self.free
            if n not in fitted
        }
        for n in self.free:
            self.found[n] = self.found[n].noted(self.remark)
            if n in held:
                self.found[n] = replace(self.found[n], value=held[n][0])
            elif last is not None and not np.isfinite(self.found[n].value):
                self.found[n] = replace(self.found[n], value=last.value(n))
        different = (
            heterogeneity(last) if last is not None and len(last.problem.fitted_experiments) > 1 else FrozenMap()
        )
        judged = misspecification(last, different, self.units) if last is not None else Misspecification(False, ())
        whole = self._whole(last or first)
        matrix = first.information.matrix
        collinear = collinear_subsets(matrix, first.names)[:200] if len(first.names) > 1 else ()
        return IdentifiabilityReport(
            FrozenMap({n: replace(self.found[n], sensitivity_norm=whole.information.norms[n]) for n in self.free}),
            fitted,
            FrozenMap(held),
            structure,
            tuple(self.combinations),
            collinear,
            last.uncertainty.correlation() if last is not None else {},
            whole.information.shares(),
            different,
            judged,
            self._recommended(whole),
            FrozenMap(self.thresholds),
            {
                "status": result.status,
                "message": result.message,
                "starts": len(result.starts),
                "cost": first.cost,
                "chi2_per_dof": first.misfit,
                "effective_samples": dict(first.uncertainty.effective),
                "noise_source": dict(result.noise_source),
            },
            tuple(self.notes),
        )

    def _whole(self, at: Optimum) -> Optimum:
        """All candidates free, at the values found or held."""
        values = {**{n: f.start for n, f in self.free.items()}, **at.problem.values(at.theta)}
        theta = [values[n] for n in self.free]
        theta += [v for u, v in zip(at.problem.names, at.theta, strict=True) if u not in self.free]
        return Optimum(replace(self.problem, weights=at.problem.weights), np.array(theta, dtype=float))

    def _recommended(self, whole: Optimum) -> Recommendation | None:
        """What to measure next, where the model's inputs are known."""
        if self.model is None:
            return None
        self._tell("what to measure next")
        inputs = {n: i.value for n, i in self.model.inputs.items()}
        units = {**self.units, **{n: i.unit for n, i in self.model.inputs.items()}}
        try:
            return recommend(whole, inputs, units, thresholds=self.thresholds)
        except SimulationError as error:
            self.notes.append(f"What to measure next cannot be told: {error.what}.")
            return None


def _lower(text: str) -> str:
    """A verdict's reason without its first words, to go on with after "it is"."""
    return text.removeprefix("It is ")
