"""Which value is which: a study's given, start and fitted values, each set under its name.

given: the values the model came with, the vendor's; everything is simulated with them and compared with them.
start: where a search begins. fitted: what a fit in the folder of results estimated, with what it held.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

from hvdc_ident.errors import StudyError
from hvdc_ident.immutable import FrozenMap

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study

SetName = Literal["given", "start", "fitted"]
SETS: tuple[SetName, ...] = get_args(SetName)

NO_ESTIMATES = ("failed", "not-converged")
"""Ends of a fit whose numbers are no estimates: they are never the fitted values."""
NOT_BY_ITSELF = ("two-optima",)
"""Ends of a fit that gives several answers that are as good: its best one is taken only where it is asked for."""


@dataclass(frozen=True)
class ValueSet:
    """Values of a study's parameters, in their units.

    name: given, start or fitted. note: what is to be said of them, in words that stand alone: where they come from, and
    why they are not the fitted ones where those might be expected. fit: the fingerprint of the fit, of fitted ones.
    """

    name: SetName
    values: FrozenMap[float]
    note: str
    fit: str = ""


def value_set(study: Study, wanted: str | None, folder: Path | None = None) -> ValueSet:
    """The set of that name; None: the fitted values where a fit stands in the folder, else the given ones.

    folder: of results, by default the study's own. A fit stands where it came to an end on the study, the files and the
    software as they are now. Raises StudyError for another name, and where fitted values are asked for and none stand.
    """
    if wanted is not None and wanted not in SETS:
        raise StudyError("no such set of values", where="--values", expected=", ".join(SETS), got=repr(wanted))
    if wanted == "given":
        return _given(study)
    if wanted == "start":
        return ValueSet("start", study.start, f"start values of study '{study.name}', where a search begins")
    found, why = fitted_values(study, folder or study.folder)
    if found is not None and (wanted == "fitted" or not why):
        return found
    if wanted == "fitted":
        hint = f"hvdc-ident fit {study.path}, or --values given"
        raise StudyError("there are no fitted values", where=study.path.name, got=why, hint=hint)
    return _given(study, "" if why == NONE else why)


NONE = "no fit has run"


def fitted_values(study: Study, folder: Path) -> tuple[ValueSet | None, str]:
    """The fitted values of the folder; and why they are not to be taken unasked, "" where they are.

    None where there are none to take at all: no fit, one of another state of the study, or one that failed.
    """
    from hvdc_ident.study.pipeline import standing

    data, why = standing(study, "fit", folder)
    if why or data.get("status") in NO_ESTIMATES:
        return None, why or f"the fit in {folder} ended as {data['status']}: {data.get('message', '')}"
    values = study.given | {n: float(data["values"][n]) for n in study.candidates if n in data["values"]}
    found = ValueSet("fitted", values, f"fitted values of study '{study.name}' ({_outcome(data)})", data["fingerprint"])
    if data["status"] in NOT_BY_ITSELF:
        return (
            found,
            f"the fit in {folder} ended as {data['status']}: {data['message']}; --values fitted takes the best",
        )
    return found, ""


def _given(study: Study, why: str = "") -> ValueSet:
    return ValueSet("given", study.given, f"given values of study '{study.name}'" + (f"; {why}" if why else ""))


def _outcome(fit: Mapping[str, Any]) -> str:
    """Return how a fit ended, and how far above the noise: what a reader has to know of its values."""
    held = [n for n in fit.get("candidates", {}) if n not in (fit.get("fitted") or [])]
    chi = fit.get("chi2_per_dof")
    verdict = str((fit.get("adequacy") or {}).get("verdict", ""))
    parts = [f"fit {fit['status']}", *(["the model does not fit these records"] if verdict == "does-not-fit" else [])]
    parts += [f"chi2/dof {chi:.3g}"] if isinstance(chi, int | float) else []
    parts += [f"held: {', '.join(held)}"] if held else []
    return ", ".join(parts)
