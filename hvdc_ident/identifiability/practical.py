"""Practical identifiability: the stages that take parameters out of the fit, one after the other, each with its verdicts.

In order: those that no data could tell apart, those whose range changes nothing, those of which only a combination shows in
these data, and those whose profile stays open. An `Assessment` carries the state from stage to stage.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np

from hvdc_ident.executor import Executor, Progress
from hvdc_ident.fit import FitParameter, FitResult, Problem
from hvdc_ident.fit.jump_instants import PlacedInstant, within
from hvdc_ident.fit.nonsmooth import LUCK, roughness, trend_of
from hvdc_ident.fit.profile import Profile, profiles, trend_profiles
from hvdc_ident.fit.profile_path import ProfileOptions, Side
from hvdc_ident.fit.uncertainty import TWO_SIDED
from hvdc_ident.identifiability.likelihood_intervals import (
    OtherOptimum,
    bounded,
    joint_limits,
    other_optima,
    partner,
    physical_bounds,
    range_of,
    rise_at_ends,
    spreads,
    thresholds,
    undetermined,
)
from hvdc_ident.identifiability.pilot_fit import HALF_95, LocalAnalysis
from hvdc_ident.identifiability.structural import (
    StructuralAnalysis,
    combinations_of,
    parameter_directions,
    partners,
)
from hvdc_ident.identifiability.verdicts import (
    COLLINEAR,
    Verdict,
    at_bound_verdict,
    closed_verdict,
    insensitive_verdict,
    local_verdict,
    null_direction_verdict,
    open_verdict,
    structural_verdict,
)
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import Combination, independent, normalised, pivoted_order, rise_over_range
from hvdc_ident.sensitivity.information import inflation_index
from hvdc_ident.text import listed, quantity

WORTH = 0.02
"""A fall of the cost by less than this share of a threshold moves no interval: the walks of profiles restart from there too."""
RESTARTS = 3


@dataclass
class Assessment:
    """State of an assessment under way; it grows stage by stage.

    problem: all candidates free. verdicts: the first on each. held: reason by parameter. held_at: the value of a held one
    where that is not its start. remark: said of every parameter. quiet: no input moves. unmoved: parameters that show only
    where an input is moved that was not. ends: where the starts of the pilot fit ended, with their costs. optima: others
    as good as the last one. placed: instants of jumps that lie between two rows, by the parameter that sets them. opened: those held for an
    open profile, in their order. profiled: by parameter its first profile with two ends, and how many of these were held then.
    structure, pilot: the analysis of the structure and the pilot fit, None before they have come to their ends.
    """

    problem: Problem
    seed: int = 0
    profile_options: ProfileOptions = field(default_factory=ProfileOptions)
    progress: Progress | None = None
    verdicts: dict[str, Verdict] = field(default_factory=dict)
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
    placed: Mapping[str, PlacedInstant] = field(default_factory=dict)
    opened: list[str] = field(default_factory=list)
    profiled: dict[str, tuple[Profile, int]] = field(default_factory=dict)
    structure: StructuralAnalysis | None = None
    pilot: FitResult | None = None

    def __post_init__(self) -> None:
        self.free: dict[str, FitParameter] = {f.name: f for f in self.problem.free}
        self.units = {n: self.problem.simulator.parameters[n].unit for n in self.free}

    def report_stage(self, text: str) -> None:
        """Report the stage as progress."""
        if self.progress:
            self.progress(0, 1, text)

    def judge(self, verdict: Verdict) -> None:
        """Add the verdict, unless there is one on that parameter already."""
        self.verdicts.setdefault(verdict.name, verdict)

    def hold(self, optimum: LocalAnalysis, reasons: Mapping[str, str]) -> LocalAnalysis | None:
        """Return the optimum with some parameters held at their given values; None where none is left to fit.

        Where the model cannot be run so, or the records exclude it (the cost rises beyond a threshold, the others re-fitted),
        they are held at their values at the optimum, and their reasons say it: the others would answer for a wrong value.
        """
        if not reasons:
            return optimum
        self.held |= reasons
        if len(reasons) == len(optimum.names):
            return None
        reduced = optimum.with_held(reasons, {n: self.free[n].given for n in reasons})
        why = "the model cannot be run"
        if reduced.cost - optimum.cost > min(self.thresholds[n] for n in reasons):
            reduced = optimum.with_held(reasons, {n: optimum.value(n) for n in reasons})
            why = "the records cannot be met"
        for n in reasons:
            value, given = reduced.problem.held[n], self.free[n].given
            if value != given:
                unit = self.units[n]
                remark = f"It is held at {quantity(value, unit)}: at its given value, {quantity(given, unit)}, {why}."
                self.held_at[n] = value
                self.held[n] = f"{self.held[n]} {remark}"
                self.verdicts[n] = self.verdicts[n].noted(remark)
        return reduced


def hold_structural(assessment: Assessment, structure: StructuralAnalysis) -> None:
    """Hold the fewest parameters that no data could tell apart from the others."""
    assessment.unmoved = structure.unmoved
    stuck = [n for n in assessment.free if n not in structure.admissible]
    assessment.combinations += [
        replace(c, held=tuple(n for n in c.members if n in stuck)) for c in structure.combinations
    ]
    for c in structure.combinations:
        for n in c.members:
            at = assessment.free[n].given if n in stuck else None
            others = [m for m in c.members if m in stuck]
            assessment.judge(structural_verdict(n, c.words, at, assessment.units[n], others, local=structure.local))
    for n in stuck:
        assessment.held[n] = assessment.verdicts[n].reason if n in assessment.verdicts else "not seen"
    if structure.note:
        assessment.notes.append(f"Structure {structure.status}: {structure.note}.")


def with_placed_instants(assessment: Assessment, optimum: LocalAnalysis) -> LocalAnalysis:
    """Return the optimum whose parameters that move the instant of a jump are bounded by the rows on either side of it.

    The cost jumps where the instant passes a row. So the stages that follow, whose verdicts rest on derivatives or on a
    continuous cost, see it between these rows alone, and leave the parameters themselves to `_profile_of_instant`.
    """
    ranges = {n: instant.passes for n, instant in assessment.placed.items()}
    return replace(optimum, problem=within(optimum.problem, optimum.theta, ranges)) if ranges else optimum


def _beside_instants(assessment: Assessment, optimum: LocalAnalysis) -> LocalAnalysis:
    """Return the analysis of the other parameters, with those that place an instant held where they are; itself where all are such."""
    placed = [n for n in optimum.names if n in assessment.placed]
    if not placed or len(placed) == len(optimum.names):
        return optimum
    problem = replace(
        optimum.problem,
        free=tuple(f for f in optimum.problem.free if f.name not in placed),
        held=optimum.problem.held | {n: optimum.value(n) for n in placed},
    )
    kept = [i for i, n in enumerate(optimum.problem.names) if n not in placed]
    return LocalAnalysis(problem, optimum.theta[kept], optimum.trend)


def _thresholds(assessment: Assessment, optimum: LocalAnalysis) -> dict[str, float]:
    """Return the rise of the cost at the ends of each interval; of one that places an instant the largest of the others'."""
    limits = thresholds(_beside_instants(assessment, optimum))
    widest = max((v for n, v in limits.items() if n not in assessment.placed), default=TWO_SIDED * optimum.excess)
    return {n: widest if n in assessment.placed else limits[n] for n in optimum.names}


def _profile_of_instant(instant: PlacedInstant, value: float) -> Profile:
    """Return the profile of a parameter that moves an instant: it ends where the instant passes a row, or before."""
    values, rises, thetas = (np.array(column) for column in zip(*instant.points, strict=True))
    lower, upper = Side("closed", instant.low), Side("closed", instant.high)
    return Profile(instant.name, value, lower, upper, values, rises, instant.rise, thetas=thetas)


def without_insensitive(assessment: Assessment, optimum: LocalAnalysis) -> LocalAnalysis | None:
    """Return the optimum without the parameters whose whole range changes nothing, confirmed by refits at both ends.

    Where there are no bounds any effect shows somewhere: only one without derivative is judged here, the others by profile.
    """
    matrix, names = optimum.information.matrix, optimum.names
    out: dict[str, str] = {}
    for i, n in enumerate(names):
        if n in assessment.placed:
            continue
        limit, free = assessment.thresholds[n], assessment.free[n]
        ends = range_of(free, optimum.value(n), assessment.profile_options.reach)
        unbounded = not math.isfinite(free.max - free.min)
        if (unbounded and matrix[i, i] > 0) or rise_over_range(
            matrix[i, i] / optimum.slope[i] ** 2, ends[1] - ends[0]
        ) >= limit:
            continue
        rise = rise_at_ends(optimum, i, ends)
        if rise is None or rise >= limit:
            continue
        still = "It shows only where an input is moved that was not." if n in assessment.unmoved else ""
        still = "No input moves in any of these experiments." if assessment.quiet else still
        assessment.judge(insensitive_verdict(free, ends, rise, limit, assessment.units[n], still))
        out[n] = assessment.verdicts[n].reason
    return assessment.hold(optimum, out)


def without_null_directions(assessment: Assessment, optimum: LocalAnalysis) -> LocalAnalysis | None:
    """Return the optimum with the fewest parameters held so that no direction is invisible in these data."""
    seen = _beside_instants(assessment, optimum)
    k = len(seen.names)
    null = parameter_directions(seen.columns, k, seen.error)
    if not null.size:
        return optimum
    logs = [u.min > 0 for u in seen.problem.free]
    combos = combinations_of(null, seen.names, logs, seen.theta[:k].tolist(), "practical")
    kept = {seen.names[i] for i in independent(seen.information.matrix, seen.error)}
    members = [n for n in seen.names if any(n in c.members for c in combos)]
    out = {n: "" for n in members if n not in kept}
    assessment.combinations += [replace(c, held=tuple(n for n in c.members if n in out)) for c in combos]
    for n in members:
        words = next(c.words for c in combos if n in c.members)
        at = assessment.free[n].given if n in out else optimum.value(n)
        assessment.judge(null_direction_verdict(n, words, at, assessment.units[n]))
    return assessment.hold(optimum, {n: assessment.verdicts[n].reason for n in out})


def profile_remaining(
    assessment: Assessment, optimum: LocalAnalysis | None, executor: Executor | None = None
) -> LocalAnalysis | None:
    """Return the optimum of the largest set all of whose profiles are closed, with a verdict on every member.

    Of those whose profile is open the least determined is held, and the others are profiled again.
    """
    restarts = 0
    while optimum is not None:
        optimum, by_name = profiles_of(assessment, optimum, executor)
        limits = {n: assessment.thresholds[n] for n in optimum.names}
        reach = assessment.profile_options.reach
        ranges = {n: range_of(assessment.free[n], p.value, reach) for n, p in by_name.items()}
        flat = {n for n, p in by_name.items() if undetermined(optimum, p, ranges[n])}
        still_open = [n for n, p in by_name.items() if not bounded(p) or n in flat]
        for n, p in by_name.items():
            if n not in flat and p.within_bounds().closed:
                assessment.profiled.setdefault(n, (p, len(assessment.opened)))
        if not still_open:
            assessment.report_stage("other optima")
            others = other_optima(optimum, limits, assessment.ends)
            worth = WORTH * min(limits.values()) + (LUCK * optimum.trend.roughness if optimum.trend else 0.0)
            if others and others[0].rise < -worth and restarts < RESTARTS:
                fall = -others[0].rise
                assessment.notes.append(f"A better optimum was found, from elsewhere: the cost fell by {fall:.3g}.")
                restarts += 1
                theta = np.array([others[0].values[n] for n in optimum.problem.names])
                optimum = LocalAnalysis(optimum.problem, theta)
                continue
            assessment.optima = others
            _judge_closed(assessment, optimum, by_name)
            return optimum
        combo = _open_combination(assessment, optimum, still_open)
        for n in still_open:
            words = combo.words if combo and n in combo.members else ""
            assessment.judge(open_verdict(by_name[n], words, assessment.units[n]))
        order = [optimum.names[i] for i in pivoted_order(optimum.information.matrix)]
        least = max(still_open, key=order.index)
        if combo:
            assessment.combinations.append(replace(combo, held=(least,)))
        optimum = assessment.hold(optimum, {least: assessment.verdicts[least].reason})
        assessment.opened.append(least)
    return None


def profiles_of(
    assessment: Assessment, optimum: LocalAnalysis, executor: Executor | None
) -> tuple[LocalAnalysis, FrozenMap[Profile]]:
    """Return the optimum that the profiles start from, a better one where they met it, and the profiles by name.

    Where the cost is rough the optimum and the profiles are those of its trend.
    """
    problem = optimum.problem
    rough = roughness(problem, optimum.theta)
    trend = trend_of(problem, optimum.theta, rough)
    if trend is not None:
        optimum = LocalAnalysis(problem, trend.theta, trend)
    limits = _thresholds(assessment, optimum)
    assessment.thresholds |= limits
    physical = physical_bounds(problem) | dict.fromkeys(assessment.placed, (True, True))
    if trend is not None:
        note = f"{trend.text}."
        assessment.notes += [note] if note not in assessment.notes else []
        residual, jacobian = problem.residual(optimum.theta)
        raw, gradient = optimum.uncertainty.raw, jacobian.T @ residual

        def along_trend(to: Mapping[str, float]) -> FrozenMap[Profile]:
            return trend_profiles(trend, problem.unknowns, list(to), raw, gradient, to, physical)

        return optimum, joint_limits(optimum, along_trend(limits), limits, along_trend, seed=assessment.seed)
    finest = rough / min(limits.values())  # no crossing is known better than the roughness of the cost
    options = (
        assessment.profile_options
        if finest <= assessment.profile_options.tolerance
        else replace(assessment.profile_options, tolerance=finest)
    )
    walked = partial(
        profiles,
        problem,
        physical=physical,
        options=options,
        executor=executor,
        progress=assessment.progress,
    )
    names = [n for n in optimum.names if n not in assessment.placed]
    walk = walked(optimum.theta, names, threshold=limits)
    assessment.notes += [f"A better optimum was found: {r}." for r in walk.restarts]
    optimum = LocalAnalysis(problem, walk.theta)
    instants = {
        n: _profile_of_instant(assessment.placed[n], optimum.value(n)) for n in optimum.names if n in assessment.placed
    }

    def walk_again(to: Mapping[str, float]) -> FrozenMap[Profile]:
        return walked(walk.theta, list(to), threshold=to).by_name

    return optimum, joint_limits(optimum, walk.by_name, limits, walk_again, seed=assessment.seed) | instants


def _open_combination(assessment: Assessment, optimum: LocalAnalysis, opened: Sequence[str]) -> Combination | None:
    """Return the combination seen of the open ones, where they are open because they make each other good."""
    if len(opened) < 2:
        return None
    matrix = optimum.information.select(opened).matrix
    scaled, d = normalised(matrix)
    if not (np.diag(scaled) > 0).all():
        return None
    values, vectors = np.linalg.eigh(scaled)
    if values[0] > (2.0 / COLLINEAR) ** 2:
        return None
    logs = [assessment.free[n].min > 0 for n in opened]
    null = vectors[:, :1].T / d
    combinations = combinations_of(null, opened, logs, [optimum.value(n) for n in opened], "practical")
    return combinations[0] if len(combinations[0].members) > 1 else None


def _with_held_free(assessment: Assessment, profile: Profile) -> Profile:
    """Return the profile with those free, inside their bounds, that came to be held later; that with them held where there is none.

    Those were held because these data do not bound them; an interval beside a value at which one is held would not hold for others.
    profile: of the set that is fitted, whose best value is to lie in the interval.
    """
    earlier, _ = assessment.profiled.get(profile.name, (profile, 0))
    if earlier is profile or profile.one_sided or earlier.one_sided:
        return profile
    earlier = earlier.within_bounds()
    low, high = earlier.ci95
    assert low is not None and high is not None
    # The estimate is that beside the held ones.
    return replace(earlier, value=profile.value) if low <= profile.value <= high else profile


def _std_of(profile: Profile) -> float:
    """Return the standard deviation that a closed profile's interval would have as a normal distribution's."""
    low, high = profile.ci95
    assert low is not None and high is not None
    return 0.5 * (high - low) / HALF_95


def _judge_closed(assessment: Assessment, optimum: LocalAnalysis, by_name: Mapping[str, Profile]) -> None:
    """Add the verdicts on the set whose profiles are closed."""
    seen = _beside_instants(assessment, optimum)
    index = inflation_index(seen.information.matrix)
    shares = optimum.information.shares()
    spread = spreads(seen)
    physical = physical_bounds(optimum.problem)
    conditional = partners(assessment.combinations, assessment.held)
    for n in optimum.names:
        profile, free, unit = by_name[n], assessment.free[n], assessment.units[n]
        if n in assessment.placed:
            instant = assessment.placed[n]
            std = (instant.high - instant.low) / math.sqrt(12.0)
            judged = closed_verdict(profile, free, std, 1.0, "", "the rows on either side of its jump", unit)
            assessment.judge(judged.noted(f"{instant.text}."))
            continue
        i = seen.names.index(n)
        if profile.one_sided:
            assessment.judge(at_bound_verdict(profile, free, physical[n][int(profile.value >= free.max)], unit))
            continue
        best = max(shares, key=lambda e: shares[e][n])
        judge = partial(
            closed_verdict,
            free=free,
            collinearity=float(index[i]),
            partner=partner(seen, i),
            best=f"'{best}'",
            unit=unit,
        )
        whole = _with_held_free(assessment, profile)
        std = spread[n].std if whole is profile and not assessment.placed else max(spread[n].std, _std_of(whole))
        verdict = judge(whole, std=std)
        if whole is not profile and not assessment.profiled[n][0].closed and verdict.verdict == "weak":
            # Where the ends are those of the bounds of the search, what the records tell beside a held one is told instead.
            whole = profile
            verdict = judge(profile, std=spread[n].std)
        low, high = whole.lower.limit, whole.upper.limit
        assert low is not None and high is not None
        rivals = [o for o in assessment.optima if o.rise < profile.threshold and not low <= o.values[n] <= high]
        if rivals:
            verdict = local_verdict(verdict, [o.values[n] for o in rivals], rivals[0].rise)
        first_free = assessment.profiled[n][1] if whole is not profile else len(assessment.opened)
        later = assessment.opened[first_free:]
        given = tuple(
            dict.fromkeys(m for m in (*conditional.get(n, ()), *assessment.opened[:first_free]) if m not in later)
        )
        verdict = replace(verdict, conditional_on=given)
        if later:
            verdict = verdict.noted(f"It holds for every {listed(later)} within the bounds.")
        elif (
            n in assessment.verdicts
        ):  # a member of a combination: its verdict stands, its interval is of the fitted set
            first = assessment.verdicts[n]
            verdict = replace(verdict, verdict=first.verdict, reason=first.reason).noted(
                f"With {', '.join(given)} held it is {verdict.reason.removeprefix('It is ')}" if given else ""
            )
        assessment.verdicts[n] = verdict
