"""The stages of an assessment, each with its verdicts on the parameters it takes out of the fit."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.executor import Executor
from hvdc_ident.fit.nonsmooth import LUCK, Trend, roughness, trend_of
from hvdc_ident.fit.objective import LeastSquares
from hvdc_ident.fit.profile import Profile, Profiles, profiles, trend_profiles
from hvdc_ident.fit.profile_path import ProfileOptions
from hvdc_ident.identifiability import verdicts
from hvdc_ident.identifiability.combinations import Combination, combinations_of, partners
from hvdc_ident.identifiability.evidence import (
    bounded,
    joint_limits,
    partner,
    physical_bounds,
    range_of,
    rise_at_ends,
    spreads,
    thresholds,
    undetermined,
)
from hvdc_ident.identifiability.findings import Findings
from hvdc_ident.identifiability.optima import other_optima
from hvdc_ident.identifiability.pilot import Optimum
from hvdc_ident.identifiability.structure import Structure
from hvdc_ident.identifiability.verdicts import Verdict
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.sensitivity import independent, null_directions, pivoted_order, rise_over_range
from hvdc_ident.sensitivity.information import inflation_index

WORTH = 0.02
"""A fall of the cost by less than this share of a threshold moves no interval: the walks of profiles restart from there too."""
RESTARTS = 3


def structural(so_far: Findings, structure: Structure) -> None:
    """Holds the fewest parameters that no data could tell apart from the others."""
    so_far.unmoved = structure.unmoved
    stuck = [n for n in so_far.free if n not in structure.admissible]
    so_far.combinations += [replace(c, held=tuple(n for n in c.members if n in stuck)) for c in structure.combinations]
    for c in structure.combinations:
        for n in c.members:
            at = so_far.free[n].given if n in stuck else None
            others = [m for m in c.members if m in stuck]
            so_far.judge(verdicts.structural(n, c.words, at, so_far.units[n], others, local=structure.local))
    for n in stuck:
        so_far.held[n] = so_far.found[n].reason if n in so_far.found else "not seen"
    if structure.note:
        so_far.notes.append(f"Structure {structure.status}: {structure.note}.")


def insensitive(so_far: Findings, optimum: Optimum) -> Optimum | None:
    """The optimum without the parameters whose whole range changes nothing, confirmed by refits at both ends.

    Where there are no bounds any effect shows somewhere: only one without derivative is judged here, the others by profile.
    """
    matrix, names = optimum.information.matrix, optimum.names
    out: dict[str, str] = {}
    for i, n in enumerate(names):
        limit, free = so_far.thresholds[n], so_far.free[n]
        ends = range_of(free, optimum.value(n), so_far.profile_options.reach)
        unbounded = not math.isfinite(free.max - free.min)
        if (unbounded and matrix[i, i] > 0) or rise_over_range(
            matrix[i, i] / optimum.slope[i] ** 2, ends[1] - ends[0]
        ) >= limit:
            continue
        rise = rise_at_ends(optimum, i, ends)
        if rise is None or rise >= limit:
            continue
        so_far.judge(verdicts.insensitive(free, ends, rise, limit, so_far.units[n], _still(so_far, n)))
        out[n] = so_far.found[n].reason
    return so_far.without(optimum, out)


def _still(so_far: Findings, name: str) -> str:
    """The remark that it is for want of moving an input, where it is."""
    if so_far.quiet:
        return "No input moves in any of these experiments."
    return "It shows only where an input is moved that was not." if name in so_far.unmoved else ""


def lost(so_far: Findings, optimum: Optimum) -> Optimum | None:
    """The optimum with the fewest parameters held so that no direction is invisible in these data."""
    k = len(optimum.names)
    null = null_directions(optimum.columns, optimum.error)[:, :k]
    null = null[(np.abs(null) > 0).any(axis=1)]
    if not null.size:
        return optimum
    logs = [u.min > 0 for u in optimum.problem.free]
    combos = combinations_of(null, optimum.names, logs, optimum.theta[:k].tolist(), "practical")
    kept = {optimum.names[i] for i in independent(optimum.information.matrix, optimum.error)}
    members = [n for n in optimum.names if any(n in c.members for c in combos)]
    out = {n: "" for n in members if n not in kept}
    so_far.combinations += [replace(c, held=tuple(n for n in c.members if n in out)) for c in combos]
    for n in members:
        words = next(c.words for c in combos if n in c.members)
        at = so_far.free[n].given if n in out else optimum.value(n)
        so_far.judge(verdicts.lost(n, words, at, so_far.units[n]))
    return so_far.without(optimum, {n: so_far.found[n].reason for n in out})


def profiled(so_far: Findings, optimum: Optimum | None, executor: Executor | None = None) -> Optimum | None:
    """The optimum of the set all of whose profiles are closed, with a verdict on every member."""
    better = 0
    while optimum is not None:
        rough = roughness(optimum.problem, optimum.theta)
        trend = trend_of(optimum.problem, optimum.theta, rough)
        if trend is not None:
            optimum = Optimum(optimum.problem, trend.theta, trend)
        limits = thresholds(optimum)
        so_far.thresholds |= limits
        physical = physical_bounds(optimum.problem)
        walked = partial(
            profiles,
            LeastSquares.of(optimum.problem),
            physical=physical,
            options=_no_finer(so_far.profile_options, rough / min(limits.values())),
            executor=executor,
            progress=so_far.progress,
        )
        if trend is not None:
            by_name = _of_trend(optimum, trend, limits, physical, so_far.seed)
            if _note_of(trend) not in so_far.notes:
                so_far.notes.append(_note_of(trend))
        else:
            around = walked(optimum.theta, optimum.names, threshold=limits)
            so_far.notes += [f"A better optimum was found: {r}." for r in around.restarts]
            optimum = Optimum(optimum.problem, around.theta)

            def again(
                other: Mapping[str, float], walked: partial[Profiles] = walked, at: Array = around.theta
            ) -> Mapping[str, Profile]:
                return walked(at, list(other), threshold=other).by_name

            by_name = joint_limits(optimum, around.by_name, limits, again, seed=so_far.seed)
        opened = [n for n, p in by_name.items() if not bounded(p) or _undetermined(so_far, optimum, p)]
        if not opened:
            so_far.tell("other optima")
            others = other_optima(optimum, limits, so_far.ends)
            worth = WORTH * min(limits.values()) + (0.0 if trend is None else LUCK * trend.roughness)
            if others and others[0].rise < -worth and better < RESTARTS:
                so_far.notes.append(
                    f"A better optimum was found, from elsewhere: the cost fell by {-others[0].rise:.3g}."
                )
                better += 1
                optimum = Optimum(optimum.problem, np.array([others[0].values[n] for n in optimum.problem.names]))
                continue
            so_far.optima = others
            _closed(so_far, optimum, by_name, physical)
            return optimum
        combo = _open_combination(so_far, optimum, opened)
        for n in opened:
            words = combo.words if combo and n in combo.members else ""
            so_far.judge(verdicts.practical(by_name[n], words, so_far.units[n]))
        order = [optimum.names[i] for i in pivoted_order(optimum.information.matrix)]
        victim = max(opened, key=order.index)
        if combo:
            so_far.combinations.append(replace(combo, held=(victim,)))
        optimum = so_far.without(optimum, {victim: so_far.found[victim].reason})
    return None


def _no_finer(options: ProfileOptions, rough: float) -> ProfileOptions:
    """Return the options with crossings no finer than the roughness of the cost, as a share of the threshold."""
    return options if rough <= options.tolerance else replace(options, tolerance=rough)


def _of_trend(
    optimum: Optimum, trend: Trend, limits: Mapping[str, float], physical: Mapping[str, tuple[bool, bool]], seed: int
) -> FrozenMap[Profile]:
    """The profiles of the trend of a rough cost, with joint limits of several on bounds."""
    problem = optimum.problem
    r, jacobian = problem.residual(optimum.theta)

    def again(other: Mapping[str, float]) -> FrozenMap[Profile]:
        return trend_profiles(
            trend, problem.unknowns, list(other), optimum.uncertainty.raw, jacobian.T @ r, other, physical
        )

    return joint_limits(optimum, again({n: limits[n] for n in optimum.names}), limits, again, seed=seed)


def _note_of(trend: Trend) -> str:
    return f"{trend.text}."


def _undetermined(so_far: Findings, optimum: Optimum, profile: Profile) -> bool:
    free = so_far.free[profile.name]
    return undetermined(optimum, profile, range_of(free, profile.value, so_far.profile_options.reach))


def _locally(so_far: Findings, judged: Verdict, profile: Profile) -> Verdict:
    """The verdict, local where another optimum as good has a value outside the interval of this one."""
    low, high = profile.lower.limit, profile.upper.limit
    assert low is not None and high is not None
    rivals = [o for o in so_far.optima if o.rise < profile.threshold and not low <= o.values[profile.name] <= high]
    return verdicts.local(judged, [o.values[profile.name] for o in rivals], rivals[0].rise) if rivals else judged


def _open_combination(so_far: Findings, optimum: Optimum, opened: Sequence[str]) -> Combination | None:
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
    logs = [so_far.free[n].min > 0 for n in opened]
    null = vectors[:, :1].T / d
    found = combinations_of(null, opened, logs, [optimum.value(n) for n in opened], "practical")
    return found[0] if len(found[0].members) > 1 else None


def _closed(
    so_far: Findings, optimum: Optimum, found: Mapping[str, Profile], physical: Mapping[str, tuple[bool, bool]]
) -> None:
    """Verdicts on the set whose profiles are closed."""
    index = inflation_index(optimum.information.matrix)
    shares = optimum.information.shares()
    spread = spreads(optimum)
    conditional = partners(so_far.combinations, so_far.held)
    for i, n in enumerate(optimum.names):
        p, free, unit = found[n], so_far.free[n], so_far.units[n]
        if p.one_sided:
            own = physical[n][int(p.value >= free.max)]
            so_far.judge(verdicts.at_bound(p, free, own, unit))
            continue
        best = max(shares, key=lambda e: shares[e][n])
        judged = verdicts.closed(p, free, spread[n].std, float(index[i]), partner(optimum, i), f"'{best}'", unit)
        judged = _locally(so_far, judged, p)
        given = conditional.get(n, ())
        judged = replace(judged, conditional_on=given)
        if n in so_far.found:  # a member of a combination: its verdict stands, its interval is that of the set fitted
            first = so_far.found[n]
            so_far.found[n] = replace(judged, verdict=first.verdict, reason=first.reason).noted(
                f"With {', '.join(given)} held it is {judged.reason.removeprefix('It is ')}" if given else ""
            )
        else:
            so_far.judge(judged)
