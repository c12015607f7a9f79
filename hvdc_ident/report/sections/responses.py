"""Measured frequency responses beside the model's, given and fitted: Bode diagrams and a table of the errors."""

from __future__ import annotations

from typing import Any

import numpy as np

from hvdc_ident.colours import SERIES
from hvdc_ident.report.drawing import bode_axes, complex_of, draw_response, figure, svg
from hvdc_ident.report.html import Section, captioned, number, rows_of, text
from hvdc_ident.summary import Results

STYLES = {"given": "--", "fitted": "-"}


def _render(results: Results) -> str:
    responses = results.get("fit").get("responses") or results.get("linearization").get("responses") or []
    return "".join(_response(r) for r in responses)


def _response(r: dict[str, Any]) -> str:
    unit = f" in {text(r['unit'])}" if r.get("unit") else ""
    held_out = ", held out" if r["role"] == "holdout" else ""
    low, high = r["band_hz"]
    head = (
        f"<h3>{text(r['name'])}</h3><p>{text(r['kind']).capitalize()}{unit}{held_out}: {r['points']} frequencies from "
        f"{number(low)} to {number(high)} Hz. Dots are measured, the dashed lines are the given values"
        f"{', the full ones the fitted values' if 'fitted' in r['models'] else ''}.</p>"
    )
    reasons = "".join(
        f"<p>With the {text(n)} values there is no response: {text(m['reason'])}</p>"
        for n, m in r["models"].items()
        if "reason" in m
    )
    return head + _bode(r) + _errors(r) + reasons + _remarks(r)


def _remarks(r: dict[str, Any]) -> str:
    """Remarks on a model that is unstable where it was measured, and on a response off by a sign or a unit."""
    found = [
        f"With the {text(n)} values the model is unstable where this was measured."
        for n, m in r["models"].items()
        if m.get("stable") is False
    ]
    found += [
        f"{text(e['channel'])}: the measured response is {number(e['factor'])} times the given model's: sign, unit or base?"
        for e in r["models"].get("given", {}).get("errors", ())
        if e.get("factor") is not None
    ]
    return f"<p>{' '.join(found)}</p>" if found else ""


def _bode(r: dict[str, Any]) -> str:
    omega = np.array(r["omega"], dtype=float)
    fig = figure(7.5, 4.8, {"left": 0.1, "right": 0.99, "bottom": 0.11, "top": 0.98, "hspace": 0.1})
    (pair,) = bode_axes(fig)
    curves = {"measured": r["measured"], **{n: m for n, m in r["models"].items() if "reason" not in m}}
    for k, channel in enumerate(r["channels"]):
        for name, parts in curves.items():
            style: dict[str, Any] = {"linestyle": STYLES.get(name, "-."), "linewidth": 1.2}
            if name == "measured":
                style = {"linestyle": "none", "marker": ".", "markersize": 4}
            label = f"{channel}, {name}" if k == 0 or name == "measured" else None
            values, phase = complex_of(parts["real"], parts["imag"])[:, k], np.array(parts["phase_deg"], dtype=float)[:, k]
            draw_response(pair, omega, values, phase, label, color=SERIES[k % len(SERIES)], **style)
    pair[0].legend(fontsize="small")
    drawn = svg(fig, "Bode diagram of the measured response " + r["name"])
    return captioned(drawn, f"{text(r['name'])}: dots measured, lines of the model.")


def _errors(r: dict[str, Any]) -> str:
    rows = []
    for name, m in r["models"].items():
        for e in m.get("errors", ()):
            share = None if e["relative"] is None else 100.0 * e["relative"]
            off = [v for kind in ("gain_db", "phase_deg") for v in (e[kind]["value"], e[kind]["omega"] / (2 * np.pi))]
            noise = "" if e["chi2_per_point"] is None else float(np.sqrt(e["chi2_per_point"]))
            rows.append((e["channel"], name, share, *off, noise))
    header = ["channel", "values", "error, %", "gain off by, dB", "at, Hz", "phase off by, degrees", "at, Hz"]
    return rows_of([*header, "error / noise"], rows)


SECTION = Section(
    order=45,
    title="Measured frequency responses",
    about="Measured impedances and transfer functions beside the model's.",
    render=_render,
)
