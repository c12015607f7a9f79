"""The files fitted-values.toml, .csv and .ssv: the fitted values that count, in forms that a study and other tools take."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvdc_ident.effects import EffectUse, effects
from hvdc_ident.files import csv_text
from hvdc_ident.fit import Estimate
from hvdc_ident.model import is_white_box
from hvdc_ident.model.card import toml_key
from hvdc_ident.study.augmented import augmented_model, use_of
from hvdc_ident.summary.decisions import counting_of, estimates_that_count
from hvdc_ident.summary.stage_results import StageResults

if TYPE_CHECKING:
    from hvdc_ident.discrepancy import Diagnosis
    from hvdc_ident.fit import FitResult
    from hvdc_ident.model import AnyModel
    from hvdc_ident.study.study import Study

NAME = "fitted-values"


def after_fit(study: Study, folder: Path, data: Mapping[str, Any]) -> dict[str, str]:
    """Return the files where a diagnosis in the folder named an effect, so that the fit's own values are not those that count.

    data: the JSON of the fit.
    """
    from hvdc_ident.study.pipeline import standing

    diagnosis, why = standing(study, "diagnose", folder)
    if why or not data["fingerprint"]:
        return {}
    results = StageResults.read({"fit": data, "discrepancy": diagnosis})
    return _files(study, results, folder) if counting_of(results.fit, results.diagnosis).name == "effect" else {}


def after_diagnosis(study: Study, folder: Path, data: Mapping[str, Any]) -> dict[str, str]:
    """Return the files where a fit stands in the folder: with the effect if the diagnosis named one, else those of the fit.

    data: the JSON of the diagnosis.
    """
    from hvdc_ident.study.pipeline import standing

    fit, why = standing(study, "fit", folder)
    if why:
        return {}
    return _files(study, StageResults.read({"fit": fit, "discrepancy": data if data["fingerprint"] else {}}), folder)


def _files(study: Study, results: StageResults, folder: Path) -> dict[str, str]:
    assert results.fit is not None
    return value_files(study, results.fit, results.of_fit.derived, results.diagnosis, folder)


def value_files(
    study: Study,
    fit: FitResult,
    derived: Iterable[str],
    diagnosis: Diagnosis | None = None,
    folder: Path | None = None,
) -> dict[str, str]:
    """Return the text of each file by its name. Each says which set of values it holds.

    derived: quantities that follow from the values. folder: where the files of the diagnosis stand. Without a
    diagnosis the values are the fit's.
    """
    from hvdc_ident.study.export import ssv

    counts, estimates = counting_of(fit, diagnosis), estimates_that_count(fit, diagnosis)
    model, uses = study.model, []
    values = {n: fit.values[n] for n in study.candidates if n in fit.values}
    if diagnosis is not None and counts.name == "effect":
        assert folder is not None
        model, uses = augmented_model(study, diagnosis, folder), [use_of(e) for e in diagnosis.effects]
        own = {n: q.value for n, q in study.model.parameters.items()}
        values = {n: q.value for n, q in model.parameters.items() if n in values or q.value != own.get(n)}
        estimates |= _sizes(diagnosis, model)
    units = {n: model.parameters[n].unit for n in values}
    held = {n: why for n, why in fit.held.items() if n in values and n not in estimates}
    note = _note(study, fit, counts.name, counts.added, counts.doubt)
    return {
        f"{NAME}.toml": _toml(study, derived, values, units, uses, note),
        f"{NAME}.csv": values_csv(values, units, estimates, held, counts.name or "fit"),
        f"{NAME}.ssv": ssv(values, study.name, note),
    }


def _note(study: Study, fit: FitResult, name: str, added: str, doubt: str) -> str:
    """Return which values a file holds, in one sentence."""
    if name == "effect":
        return (
            f"fitted values of study '{study.name}', set 'effect': fitted together with {added}, as the diagnosis named it; "
            "they hold in the model with it alone"
        )
    why = f"; {doubt}" if doubt else ""
    return f"fitted values of study '{study.name}', set 'fit': the model has no effect added (fit {fit.status}){why}"


def values_csv(
    values: Mapping[str, float],
    units: Mapping[str, str],
    estimates: Mapping[str, Estimate],
    held: Mapping[str, str],
    of: str = "fit",
) -> str:
    """CSV text with a row for each parameter: value, unit, std, interval, why it is held, and the set ("fit" or "effect")."""
    rows: list[list[Any]] = []
    for name, value in values.items():
        e = estimates.get(name)
        low, high = (e.ci95 if e is not None else None) or (None, None)
        std = e.std if e is not None else None
        rows.append([name, value, units.get(name, ""), std, low, high, held.get(name, ""), of])
    return csv_text(["parameter", "value", "unit", "std", "ci95_low", "ci95_high", "held", "set"], rows)


def _toml(
    study: Study,
    derived: Iterable[str],
    values: Mapping[str, float],
    units: Mapping[str, str],
    uses: Sequence[EffectUse],
    note: str,
) -> str:
    """Return the tables to paste into a study: [model.values], before it [[model.effect]] with what the values hold with."""
    given = ", ".join(f"{n} {study.candidates[n].given!r}" for n in values if n in study.candidates)
    lines = [
        f"# {note[:1].upper()}{' '.join(note[1:].split())}.",
        f"# Given were {' '.join(given.split())}.",
        "# In [model.values] they become the given values of a study, what its results are compared with, unless [parameters]",
        "# says otherwise: NAME = {given = ...}. `hvdc-ident export --values fitted` needs no pasting.",
    ]
    for use in (u.to_dict() for u in uses):
        lines.append("[[model.effect]]")
        sizes = ", ".join(f"{toml_key(n)} = {v!r}" for n, v in use.pop("parameters").items())
        lines += [f"{key} = {json.dumps(v, ensure_ascii=False)}" for key, v in use.items()]
        lines.append(f"parameters = {{{sizes}}}")
    lines.append("[model.values]")
    own = study.model.parameters
    lines += [
        f"{toml_key(n)} = {v!r}" + (f"  # {units[n]}" if units.get(n) else "") for n, v in values.items() if n in own
    ]
    lines += _derived(study, derived, values)
    return "\n".join(lines) + "\n"


def _derived(study: Study, names: Iterable[str], values: Mapping[str, float]) -> list[str]:
    """Return a comment for each quantity that follows from the values."""
    if not is_white_box(study.model):
        return []
    known = {**study.model.values, **values}
    comments = []
    for name in names:
        expression = study.model.signals[name].value
        value = float(expression.subs({s: known[s.name] for s in expression.free_symbols}))
        comments.append(f"# {name} = {expression} = {value!r}")
    return comments


def _sizes(diagnosis: Diagnosis, model: AnyModel) -> dict[str, Estimate]:
    """Return the sizes of the effects as estimates, by the names of their parameters in the model."""
    sizes = {}
    for line in diagnosis.effects:
        use, catalogue = use_of(line), effects()[line.effect].parameters
        for name, size in line.parameters.items():
            own = use.parameter_name(name)
            if name in catalogue and own in model.parameters and model.parameters[own].value == size.value:
                sizes[own] = Estimate(size.value, ci95=size.ci95)
    return sizes
