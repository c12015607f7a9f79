"""Errors in the language of model validation: maximum, mean and mean absolute error before, during and after an event.

The error is model - reference. Kinds of error and windows after IEC 61400-27-2; a tolerance profile, one data file each in
`tolerances/`, has the windows around the event and the limits of the errors in them.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, Experiment
from hvdc_ident.data.units import same_unit
from hvdc_ident.errors import StudyError, require_known
from hvdc_ident.fit.assessment import Curve
from hvdc_ident.immutable import FrozenMap

Span = tuple[float, float]

WINDOWS = ("before", "during", "after")
ERRORS = ("max", "mean", "mean_absolute")
LENGTHS = ("before", "gap_before", "gap_start", "gap_end", "gap_cleared", "after", "settling")
DEFAULT = "set-point-step-simulation"


@dataclass(frozen=True)
class ToleranceProfile:
    """A tolerance profile.

    windows: lengths in s by name (`LENGTHS`), settling as a share. limits: by window and kind of error, in `unit`.
    version, source, notes: where the numbers come from.
    """

    name: str
    version: str
    title: str
    source: str
    notes: str
    windows: FrozenMap[float]
    limits: FrozenMap[FrozenMap[float]]
    unit: str


def shipped() -> tuple[str, ...]:
    """Return the names of the profiles that come with the package."""
    folder = files("hvdc_ident.fit") / "tolerances"
    return tuple(sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")))


def tolerance(name: str = DEFAULT, folder: Path | None = None) -> ToleranceProfile:
    """Return the profile of a name, or of a TOML file at a path from `folder`.

    Raises UnknownNameError for a name that is not shipped, StudyError for a file that is missing or wrong.
    """
    if not name.endswith(".toml"):
        require_known("tolerance profile", [name], shipped(), "")
        return _profile((files("hvdc_ident.fit") / "tolerances" / f"{name}.toml").read_bytes(), f"{name}.toml")
    path = (folder or Path()) / name
    try:
        return _profile(path.read_bytes(), name)
    except OSError as e:
        raise StudyError(
            "the tolerance profile cannot be read",
            where=name,
            got=(e.strerror or str(e)).lower(),
            hint=f"one of the shipped profiles: {', '.join(shipped())}",
        ) from None


def _profile(content: bytes, where: str) -> ToleranceProfile:
    try:
        table = tomllib.loads(content.decode("utf-8"))
    except (UnicodeDecodeError, tomllib.TOMLDecodeError) as e:
        raise StudyError("the tolerance profile is not TOML", where=where, got=str(e)) from None
    _keys(table, ("schema", "name", "version", "title", "source", "notes", "windows", "limits"), where)
    if table["schema"] != 1:
        raise StudyError(
            "this version of hvdc_ident does not read this schema",
            where=where,
            expected="1",
            got=str(table["schema"]),
            hint="schema = 1, or the version of hvdc_ident that the file was written for",
        )
    windows, limits = table["windows"], table["limits"]
    _keys(windows, LENGTHS, f"{where}, windows")
    _keys(limits, ("unit", *WINDOWS), f"{where}, limits")
    for name in WINDOWS:
        _keys(limits[name], ERRORS, f"{where}, limits.{name}")
    texts = {k: str(table[k]) for k in ("name", "version", "title", "source", "notes")}
    return ToleranceProfile(
        **texts,
        windows=_numbers(windows, f"{where}, windows"),
        limits=FrozenMap({n: _numbers(limits[n], f"{where}, limits.{n}") for n in WINDOWS}),
        unit=str(limits["unit"]),
    )


def _keys(table: Any, wanted: tuple[str, ...], where: str) -> None:
    if not isinstance(table, Mapping) or set(table) != set(wanted):
        got = ", ".join(table) if isinstance(table, Mapping) else type(table).__name__
        raise StudyError("a tolerance profile's keys are wrong", where=where, expected=", ".join(wanted), got=got)


def _numbers(table: Mapping[str, Any], where: str) -> FrozenMap[float]:
    for name, value in table.items():
        if isinstance(value, bool) or not isinstance(value, int | float) or not (math.isfinite(value) and value >= 0):
            raise StudyError(
                f"'{name}' is wrong", where=where, expected="a finite number, not negative", got=repr(value)
            )
    return FrozenMap({k: float(v) for k, v in table.items()})


def windowed_errors(
    curves: Mapping[str, Mapping[str, Curve]],
    experiments: tuple[Experiment, ...],
    profile: ToleranceProfile,
    units: Mapping[str, str],
) -> dict[str, Any]:
    """Return the errors by output and experiment, with the profile they are held against.

    Each: event, end (s; the instant the event is over), end_from ("inputs" or "settling"), and for each window `from`,
    `to` (s), n, max, mean, mean_absolute (in the output's unit), limits and within (None where there is no limit for
    the unit, or no row in the window). Of the signal itself: within (None where no window is judged) and reason, why it is
    not judged. signals, windows: how many passed, failed and were not judged. curves: by experiment and output. units: of
    the outputs.
    """
    table: dict[str, dict[str, Any]] = {}
    by_name = {e.name: e for e in experiments}
    for name, line in curves.items():
        for output, curve in line.items():
            table.setdefault(output, {})[name] = _errors(by_name[name], curve, profile, units.get(output, ""))
    head = {"name": profile.name, "version": profile.version, "title": profile.title, "source": profile.source}
    each = [about for line in table.values() for about in line.values()]
    return {
        "profile": {**head, "notes": profile.notes, "unit": profile.unit},
        "errors": table,
        "signals": _counted([a["within"] for a in each]),
        "windows": _counted([a[w]["within"] for a in each if a["event"] is not None for w in WINDOWS]),
    }


def signal_within(about: Mapping[str, Any]) -> bool | None:
    """Return whether a signal keeps its limits in every window that is judged; None where none is."""
    judged = [w for n in WINDOWS if (w := (about.get(n) or {}).get("within")) is not None]
    return all(judged) if judged else None


def _counted(outcomes: Sequence[bool | None]) -> dict[str, int]:
    return {"passed": outcomes.count(True), "failed": outcomes.count(False), "not_judged": outcomes.count(None)}


def _errors(e: Experiment, curve: Curve, profile: ToleranceProfile, unit: str) -> dict[str, Any]:
    if e.event is None:
        return {"event": None, "within": None, "reason": "no event: no input moves and none is given"}
    end, source = event_end(e, curve.measured, profile.windows["settling"])
    spans = windows(e, end, profile)
    rows = np.zeros(e.time.size, dtype=bool)
    rows[curve.rows] = True
    limited = same_unit(unit, profile.unit)
    found = {w: _window(e.time, spans[w], rows, curve, profile.limits[w] if limited else None) for w in WINDOWS}
    within = signal_within(found)
    reason = f"the limits are in {profile.unit}, the output is {f'in {unit}' if unit else 'without a unit'}"
    reason = "" if within is not None else "no row in any window" if limited else reason
    return {"event": e.event, "end": end, "end_from": source, "within": within, "reason": reason, **found}


def _window(
    time: Array, span: Span, rows: NDArray[np.bool_], curve: Curve, limits: Mapping[str, float] | None
) -> dict[str, Any]:
    inside = rows & (time >= span[0]) & (time <= span[1])
    n = int(inside.sum())
    line: dict[str, Any] = {"from": span[0], "to": span[1], "n": n, "limits": dict(limits) if limits else None}
    if n == 0:
        return {**line, "max": None, "mean": None, "mean_absolute": None, "within": None}
    error = curve.model[inside] - curve.measured[inside]
    kinds = {
        "max": float(np.abs(error).max()),
        "mean": float(error.mean()),
        "mean_absolute": float(np.abs(error).mean()),
    }
    within = all(abs(kinds[k]) <= v for k, v in limits.items()) if limits else None
    return {**line, **kinds, "within": within}


def windows(e: Experiment, end: float, profile: ToleranceProfile) -> dict[str, Span]:
    """Return from and to, in s, of each window around an event that is over at `end`; one that is empty ends before it begins."""
    assert e.event is not None
    w = profile.windows
    first, last = float(e.time[0]), float(e.time[-1])
    until = e.event - w["gap_before"]
    cleared = end + w["gap_cleared"]
    return {
        "before": (max(first, until - w["before"]), until),
        "during": (e.event + w["gap_start"], end - w["gap_end"]),
        "after": (cleared, min(last - w["gap_end"], cleared + w["after"])),
    }


def event_end(e: Experiment, reference: Array, settling: float) -> tuple[float, str]:
    """Return the instant the event is over, s, and its source.

    "inputs": the last change of an input, where that is later than the event (the end of a ramp, the clearing of a
    dip). "settling": for a step, the last instant the reference is farther from its last value than the given share of
    its whole change.
    """
    assert e.event is not None
    ends = [e.event]
    for signal in e.inputs.values():
        moving = np.flatnonzero(np.diff(signal.values) != 0)
        if moving.size:
            ends.append(float(signal.times[moving[-1] + 1]))
    over = max(t for t in ends if t <= e.time[-1]) if any(t <= e.time[-1] for t in ends) else float(e.time[-1])
    if over > e.event:
        return over, "inputs"
    later = (e.time >= e.event) & np.isfinite(reference)
    y, t = reference[later], e.time[later]
    if y.size < 2 or np.ptp(y) == 0:
        return e.event, "settling"
    last = float(np.mean(y[-max(1, y.size // 50) :]))
    out = np.flatnonzero(np.abs(y - last) > settling * float(np.ptp(y)))
    return (float(t[min(out[-1] + 1, t.size - 1)]) if out.size else e.event), "settling"
