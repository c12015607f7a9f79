"""What was set on the sliders, as a study file states it: candidates with bounds and starts, values of the model, effects."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import hvdc_ident as hi
from hvdc_ident.app.setting import Setting, effects_with_sizes, span_of
from hvdc_ident.app.study_folder import Seen, write_study
from hvdc_ident.app.study_text import with_parameters
from hvdc_ident.errors import StudyError
from hvdc_ident.study.parse import parse_study
from hvdc_ident.text import listed

DIGITS = 6
"""Significant digits of a value that a slider set."""


@dataclass(frozen=True)
class SliderValues:
    """Changes of a study. parameters: keys of [parameters] by name, None where a parameter is fitted no longer. values: of the model.

    effects: tables for [[model.effect]]. elsewhere: parameters with other values, which the study's model does not have.
    """

    parameters: Mapping[str, Mapping[str, float] | None]
    values: Mapping[str, float]
    effects: tuple[Mapping[str, Any], ...] = ()
    elsewhere: tuple[str, ...] = ()


def slider_values(
    study: hi.Study, setting: Setting, fitted: Collection[str], spans: Mapping[str, tuple[float, float]]
) -> SliderValues:
    """Return what differs from the study. fitted: the parameters to estimate; spans: of the sliders whose ends were changed."""
    stated, own = study.settings.parameters, study.model.parameters
    parameters: dict[str, Mapping[str, float] | None] = {}
    values: dict[str, float] = {}
    set_by_hand = {n: _rounded(v) for n, v in setting.values.items()}
    for name in own:
        if name in fitted:
            keys = {"start": set_by_hand[name]} if name in set_by_hand else {}
            if name not in stated or name in spans:
                low, high = spans.get(name) or span_of(study.model, name, {})
                keys |= {"min": _rounded(low), "max": _rounded(high)}
            if keys:
                parameters[name] = keys
        else:
            if name in study.candidates:
                parameters[name] = None
            if name in set_by_hand:
                values[name] = set_by_hand[name]
            elif name in study.candidates and stated[name].given is not None:
                values[name] = own[name].value  # which went with the line that goes
    effects = effects_with_sizes(setting) if setting.base.parameters.keys() == own.keys() else []
    sizes = {n for n in setting.model.parameters if n not in setting.base.parameters}
    elsewhere = [n for n in setting.model.parameters if n not in own and n not in sizes]
    return SliderValues(parameters, values, tuple(effects), tuple(elsewhere))


def write_slider_values(file: Path, asked: SliderValues) -> str:
    """Write the changes into the study file as it is now, and return what was written, in words; "" where it states them all.

    Raises StudyError where a value lies outside its bounds, and where the file cannot be changed.
    """
    seen = Seen.now(file)
    now = parse_study((seen.text or "").encode(), file).parameters
    for name, keys in asked.parameters.items():
        line = {k: getattr(now[name], k) for k in ("start", "min", "max")} if name in now else {}
        line.update(keys or {})
        start, low, high = (line.get(k) for k in ("start", "min", "max"))
        if keys and start is not None and ((low is not None and start < low) or (high is not None and start > high)):
            raise StudyError(
                f"the value of '{name}' lies outside its bounds; nothing was written",
                where=file.name,
                expected=" and ".join(
                    f"{word} {v:g}" for word, v in (("at least", low), ("at most", high)) if v is not None
                ),
                got=f"{start:g}",
                hint="move the slider, or type another bound beside it",
            )
    text = with_parameters(seen.text or "", asked.parameters, asked.values, asked.effects, file.name)
    if text == seen.text:
        return ""
    parse_study(text.encode(), file)
    write_study(seen, text)
    return f"{file.name}: {_told(asked)}."


def _told(asked: SliderValues) -> str:
    said = [
        f"{n} is no longer fitted" if keys is None else f"{n} {', '.join(f'{k} = {v:g}' for k, v in keys.items())}"
        for n, keys in asked.parameters.items()
    ]
    said += [f"{n} = {v:g}" for n, v in asked.values.items()]
    said += [f"effect {use['effect']} at {use['at']}" for use in asked.effects]
    left = (
        f"; not written, for the study's model does not have them: {listed(asked.elsewhere)}" if asked.elsewhere else ""
    )
    return f"{'; '.join(said)}{left}"


def _rounded(value: float) -> float:
    return float(f"{value:.{DIGITS}g}")
