"""Tolerance profiles: the windows around an event and the limits of the errors in them, a data file each in `tolerances/`.

Kinds of error and windows after IEC 61400-27-2.
"""

from __future__ import annotations

import math
import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Any

from hvdc_ident.errors import StudyError, require_known
from hvdc_ident.immutable import FrozenMap

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
