"""The files fitted-values.toml, .csv and .ssv: the fitted values that count, in forms that a study and other tools take."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvdc_ident.effects import EffectUse, effects
from hvdc_ident.files import csv_text
from hvdc_ident.model import Model
from hvdc_ident.model.card import toml_key
from hvdc_ident.study.augmented import augmented_model, use_of
from hvdc_ident.summary.summarise import counting_of, estimates_that_count

if TYPE_CHECKING:
    from hvdc_ident.model import AnyModel
    from hvdc_ident.study.study import Study

NAME = "fitted-values"


def after_fit(study: Study, folder: Path, data: Mapping[str, Any]) -> dict[str, str]:
    """Return the files where a diagnosis in the folder named an effect, so that the fit's own values are not those that count."""
    from hvdc_ident.study.pipeline import standing

    diagnosis, why = standing(study, "diagnose", folder)
    if why or not data["fingerprint"] or counting_of(data, diagnosis).name != "effect":
        return {}
    return value_files(study, data, diagnosis, folder)


def after_diagnosis(study: Study, folder: Path, data: Mapping[str, Any]) -> dict[str, str]:
    """Return the files where a fit stands in the folder: with the effect if the diagnosis named one, else those of the fit."""
    from hvdc_ident.study.pipeline import standing

    fit, why = standing(study, "fit", folder)
    return {} if why else value_files(study, fit, data if data["fingerprint"] else {}, folder)


def value_files(
    study: Study, fit: Mapping[str, Any], diagnosis: Mapping[str, Any] | None = None, folder: Path | None = None
) -> dict[str, str]:
    """Return the text of each file by its name. Each says which set of values it holds.

    fit, diagnosis: their JSON; folder: where the files of the diagnosis stand. Without a diagnosis they are the fit's values.
    """
    from hvdc_ident.study.export import ssv

    found = diagnosis or {}
    counts, estimates = counting_of(fit, found), estimates_that_count(fit, found)
    model, uses = study.model, []
    values = {n: float(fit["values"][n]) for n in study.candidates if n in fit["values"]}
    if counts.name == "effect":
        assert folder is not None
        model, uses = augmented_model(study, found, folder), [use_of(e) for e in found["effects"]]
        own = {n: q.value for n, q in study.model.parameters.items()}
        values = {n: q.value for n, q in model.parameters.items() if n in values or q.value != own.get(n)}
        estimates |= _sizes(found, model)
    units = {n: model.parameters[n].unit for n in values}
    held = {n: why for n, why in fit["held"].items() if n in values and n not in estimates}
    note = _note(study, fit, counts.name, counts.added, counts.doubt)
    return {
        f"{NAME}.toml": _toml(study, fit, values, units, uses, note),
        f"{NAME}.csv": values_csv(values, units, estimates, held, counts.name or "fit"),
        f"{NAME}.ssv": ssv(values, study.name, note),
    }


def _note(study: Study, fit: Mapping[str, Any], name: str, added: str, doubt: str) -> str:
    """Return which values a file holds, in one sentence."""
    if name == "effect":
        return (
            f"fitted values of study '{study.name}', set 'effect': fitted together with {added}, as the diagnosis named it; "
            "they hold in the model with it alone"
        )
    why = f"; {doubt}" if doubt else ""
    return f"fitted values of study '{study.name}', set 'fit': the model has no effect added (fit {fit['status']}){why}"


def values_csv(
    values: Mapping[str, float],
    units: Mapping[str, str],
    estimates: Mapping[str, Any],
    held: Mapping[str, str],
    of: str = "fit",
) -> str:
    """CSV text with a row for each parameter: value, unit, std, interval, why it is held, and the set ("fit" or "effect")."""
    rows: list[list[Any]] = []
    for name, value in values.items():
        e = estimates.get(name) or {}
        low, high = e.get("ci95") or (None, None)
        rows.append([name, value, units.get(name, ""), e.get("std"), low, high, held.get(name, ""), of])
    return csv_text(["parameter", "value", "unit", "std", "ci95_low", "ci95_high", "held", "set"], rows)


def _toml(
    study: Study,
    fit: Mapping[str, Any],
    values: Mapping[str, float],
    units: Mapping[str, str],
    uses: list[dict[str, Any]],
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
    for use in (EffectUse.of(u).to_dict() for u in uses):
        lines.append("[[model.effect]]")
        sizes = ", ".join(f"{toml_key(n)} = {v!r}" for n, v in use.pop("parameters").items())
        lines += [f"{key} = {json.dumps(v, ensure_ascii=False)}" for key, v in use.items()]
        lines.append(f"parameters = {{{sizes}}}")
    lines.append("[model.values]")
    own = study.model.parameters
    lines += [
        f"{toml_key(n)} = {v!r}" + (f"  # {units[n]}" if units.get(n) else "") for n, v in values.items() if n in own
    ]
    lines += _derived(study, fit, values)
    return "\n".join(lines) + "\n"


def _derived(study: Study, fit: Mapping[str, Any], values: Mapping[str, float]) -> list[str]:
    """Return a comment for each quantity that follows from the values."""
    if not isinstance(study.model, Model):
        return []
    known = {**study.model.values, **values}
    found = []
    for name in fit["derived"]:
        expression = study.model.signals[name].value
        value = float(expression.subs({s: known[s.name] for s in expression.free_symbols}))
        found.append(f"# {name} = {expression} = {value!r}")
    return found


def _sizes(diagnosis: Mapping[str, Any], model: AnyModel) -> dict[str, dict[str, Any]]:
    """Return the sizes of the effects as estimates, by the names of their parameters in the model."""
    found: dict[str, dict[str, Any]] = {}
    for line in diagnosis["effects"]:
        use, catalogue = EffectUse.of(use_of(line)), effects()[line["effect"]].parameters
        for name, size in line["parameters"].items():
            own = use.parameter_name(name)
            if name in catalogue and own in model.parameters and model.parameters[own].value == size["value"]:
                found[own] = {"value": size["value"], "ci95": size.get("ci95")}
    return found
