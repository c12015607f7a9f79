"""Measured frequency responses beside the model's, given and fitted: Bode diagrams and a table of the errors."""

from __future__ import annotations

from typing import Any

from hvdc_ident.colours import SERIES
from hvdc_ident.report.drawing import bode_axes, draw_response, figure, svg
from hvdc_ident.report.html import Section, captioned, number, rows_of, text
from hvdc_ident.summary import Results
from hvdc_ident.summary.compared_responses import ComparedResponse

STYLES = {"given": "--", "fitted": "-"}


def _render(results: Results) -> str:
    return "".join(map(_response, results.responses))


def _response(r: ComparedResponse) -> str:
    about = r.about
    unit = f" in {text(about.unit)}" if about.unit else ""
    held_out = ", held out" if about.role == "holdout" else ""
    low, high = about.band_hz
    head = (
        f"<h3>{text(r.name)}</h3><p>{text(about.kind).capitalize()}{unit}{held_out}: {about.points} frequencies from "
        f"{number(low)} to {number(high)} Hz. Dots are measured, the dashed lines are the given values"
        f"{', the full ones the fitted values' if 'fitted' in r.models else ''}.</p>"
    )
    reasons = "".join(
        f"<p>With the {text(n)} values there is no response: {text(m.reason)}</p>"
        for n, m in r.models.items()
        if m.reason
    )
    return head + _bode(r) + _errors(r) + reasons + _remarks(r)


def _remarks(r: ComparedResponse) -> str:
    """Remarks on a model that is unstable where it was measured, and on a response off by a sign or a unit."""
    remarks = [
        f"With the {text(n)} values the model is unstable where this was measured."
        for n, m in r.models.items()
        if m.stable is False
    ]
    remarks += [
        f"{text(e.channel)}: the measured response is {number(e.factor)} times the given model's: sign, unit or base?"
        for e in (r.models["given"].errors if "given" in r.models else ())
        if e.factor is not None
    ]
    return f"<p>{' '.join(remarks)}</p>" if remarks else ""


def _bode(r: ComparedResponse) -> str:
    fig = figure(7.5, 4.8, {"left": 0.1, "right": 0.99, "bottom": 0.11, "top": 0.98, "hspace": 0.1})
    (pair,) = bode_axes(fig)
    curves = {"measured": r.measured.curves, **{n: m.curves for n, m in r.models.items()}}
    for k, channel in enumerate(r.about.channels):
        for name, curve in curves.items():
            if curve is None:
                continue
            values, phase = curve
            style: dict[str, Any] = {"linestyle": STYLES.get(name, "-."), "linewidth": 1.2}
            if name == "measured":
                style = {"linestyle": "none", "marker": ".", "markersize": 4}
            label = f"{channel}, {name}" if k == 0 or name == "measured" else None
            draw_response(pair, r.omega, values[:, k], phase[:, k], label, color=SERIES[k % len(SERIES)], **style)
    pair[0].legend(fontsize="small")
    drawn = svg(fig, "Bode diagram of the measured response " + r.name)
    return captioned(drawn, f"{text(r.name)}: dots measured, lines of the model.")


def _errors(r: ComparedResponse) -> str:
    rows = []
    for name, m in r.models.items():
        for e in m.errors:
            share = None if e.relative is None else 100.0 * e.relative
            off = [v for d in (e.gain_db, e.phase_deg) for v in (d.value, d.hertz)]
            rows.append((e.channel, name, share, *off, "" if e.times_noise is None else e.times_noise))
    header = ["channel", "values", "error, %", "gain off by, dB", "at, Hz", "phase off by, degrees", "at, Hz"]
    return rows_of([*header, "error / noise"], rows)


SECTION = Section(
    order=45,
    title="Measured frequency responses",
    about="Measured impedances and transfer functions beside the model's.",
    render=_render,
)
