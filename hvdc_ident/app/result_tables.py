"""Results of a study as the page shows them: tables of text, and columns of curves."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from hvdc_ident.axes import joined
from hvdc_ident.data import Array
from hvdc_ident.display import Table, rounded
from hvdc_ident.report.answers import beyond_noise, places_of
from hvdc_ident.report.overlay import Overlay
from hvdc_ident.text import figures_of, interval_text, interval_words, one_of, percentage

_COMMAND = re.compile(r"`?hvdc-ident ([a-z]+) STUDY(?: --to FILE)?`?")
_BUTTONS = {"letter": "the button Letter", "export": "a button below Take away", "run": "Run all"}
"""Names on the page for commands that are no stages."""
MODELS = {"nominal": "given values", "refitted": "refitted", "augmented": "with the effect"}
"""Models whose gaps a diagnosis compares, and their names on the page."""
PLACES = 6
"""Likely places of an effect that are listed."""


def verdict_table(identified: Mapping[str, Any]) -> Table:
    """Return each candidate's verdict with its value, interval and reason."""
    rows = []
    for name, p in (identified.get("parameters") or {}).items():
        ci95 = p.get("ci95")
        value = rounded(p.get("value"), figures_of(ci95, 5))
        rows.append((name, p["verdict"], value, interval_text(ci95), p.get("unit", ""), p["reason"]))
    return Table(("parameter", "verdict", "value", "95 % interval", "unit", "reason"), tuple(rows))


def profile_columns(profile: Mapping[str, Any]) -> list[Array]:
    """Return the columns of a profile's picture, (n,) each: the values, the rise of the cost between what was computed, the
    rise computed, the 95 % level, and the ends of the interval; the rise in units of that level, nan where there is none.
    """
    x = np.array(profile["values"], dtype=float)
    rise = np.array(profile["rises"], dtype=float) / profile["threshold"]
    ends = [end for side in ("lower", "upper") if (end := profile[side]["limit"]) is not None]
    dense, between = joined(x, rise)
    at = np.unique(np.concatenate([dense, x, ends]))

    def only(places: Any, values: Any) -> Array:
        column = np.full(at.size, np.nan)
        column[np.searchsorted(at, places)] = values
        return column

    level = np.ones(at.size)
    return [at, np.interp(at, dense, between), only(x, rise), level, only(ends, 1.0)]


def overlay_columns(overlay: Overlay, sets: tuple[str, ...], *, errors: bool = False) -> list[Array]:
    """Return the columns of an output's picture, (n,) each: time, recorded, and the runs by set of values; nan where one is not.

    errors: recorded less simulated in place of the runs, and none in place of the recorded signal.
    """
    record = overlay.record
    missing = np.full(record.time.size, np.nan)
    columns = [record.time, missing if errors else record[f"{overlay.output}.measured"]]
    for name in sets:
        run = overlay.runs.get(name)
        if run is None or run.time.size != record.time.size:
            columns.append(missing)
        else:
            columns.append(overlay.error(name) if errors else run[overlay.output])
    return columns


def finding_table(diagnosis: Mapping[str, Any]) -> Table:
    """Return what may be missing: effects with probabilities, sizes and likely places."""
    rows, depend = [], diagnosis.get("values_by_place") or {}
    for f in diagnosis.get("findings") or []:
        sizes = []
        for name, p in (f.get("parameters") or {}).items():
            within = interval_text(p.get("ci95"))
            value = f"{name} = {p['value']:.{figures_of(p.get('ci95'), 4)}g} {p.get('unit') or ''}".rstrip()
            sizes.append(f"{value} ({within})" if within else value)
        places = [f"{at} ({percentage(p)})" for at, p in places_of(f["places"], depend=depend).items()]
        more = [f"{len(places) - PLACES} more"] if len(places) > PLACES else []
        where = "; ".join([*places[:PLACES], *more])
        rows.append((one_of(f["same_as"]), percentage(f["probability"]), "; ".join(sizes), where))
    words = "95 %" if not beyond_noise(diagnosis) else interval_words(beyond_noise=True)
    return Table(("effect", "probability", f"size ({words})", "likely at"), tuple(rows)).without_empty()


def gap_table(diagnosis: Mapping[str, Any]) -> Table:
    """Return the gaps before and after in units of the noise, over the fitted and over the held-out recordings."""
    pooled = (diagnosis.get("gap") or {}).get("pooled") or {}
    rows = [
        (MODELS[n], rounded(g.get("fit"), 3), rounded(g.get("holdout"), 3)) for n, g in pooled.items() if n in MODELS
    ]
    if not diagnosis.get("augmented_model"):
        rows = [row for row in rows if row[0] != MODELS["augmented"]]
    return Table(("gap, times the noise", "fitted records", "held-out records"), tuple(rows)).without_empty()


def on_page(text: str) -> str:
    """Return the text of a result with the commands in it as what stands on the page for them."""
    return _COMMAND.sub(lambda found: _BUTTONS.get(found[1], f"the stage {found[1]}"), text)
