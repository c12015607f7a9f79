"""The linear model: where it stands, its modes, what limits are near, and its frequency response."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from markupsafe import Markup

from hvdc_ident.colours import SERIES
from hvdc_ident.linearize import FrequencyResponse, Mode, OperatingPoint, RootLocus
from hvdc_ident.linearize.gain_limits import Crossing
from hvdc_ident.linearize.modal import NamedMode
from hvdc_ident.linearize.plot import locus
from hvdc_ident.report.drawing import bode_axes, draw_response, figure, svg
from hvdc_ident.report.html import Section, captioned, number, rows_of, shown, text
from hvdc_ident.summary import Results
from hvdc_ident.summary.linear import (
    Linearisation,
    LinearResult,
    PortImpedance,
    StudyMargins,
    locus_lines,
    other_lines,
    port_line,
)
from hvdc_ident.text import capital, figures

NEAREST = 5
LINES = ("-", "--", "-.", ":")

CHECKS = {
    "symbolic": "complex steps",
    "directional": "central differences",
    "finite-difference": "differences of another step size",
}
"""Second Jacobian that one of each method was compared with."""


def _render(results: Results) -> str:
    """The linear model at the fitted values where there is one, beside the one at the given values."""
    linear = results.linear
    if linear is None or not linear.given.modes:
        return ""
    shown = linear.at_fitted or linear.given
    return (
        _which(linear, results)
        + _point(shown)
        + _modes(linear.given.modes, linear.at_fitted)
        + _limits(shown.point)
        + _bode(linear)
        + _margins(shown.margins)
        + _ports(shown.ports)
        + _locus(shown.locus)
        + _said(other_lines(shown))
    )


def _which(linear: Linearisation, results: Results) -> str:
    """At which values the linear models stand."""
    if linear.at_fitted is not None:
        lines = [f"At the <strong>{text(linear.fitted_note)}</strong>, beside the given values."]
    else:
        lines = [f"At the <strong>given</strong> values{': ' if linear.why_none else ''}{text(linear.why_none)}."]
    fit, diagnosis = (results.fingerprint(stage) for stage in ("fit", "discrepancy"))
    taken = linear.fitted
    if fit and (taken is None or taken.fit != fit):
        lines.append("A fit has run since: `hvdc-ident linearize` takes it in.")
    elif taken is not None and taken.diagnosis != diagnosis:
        lines.append("A diagnosis has run since: `hvdc-ident linearize` takes it in.")
    return f"<p>{' '.join(lines)}</p>"


def _point(linear: LinearResult) -> str:
    about = f"Largest scaled residual {number(linear.point.residual, 2)}; the Jacobian differs from {CHECKS[linear.method]} by "
    about += f"{number(linear.jacobian_error, 2)}."
    notes = "".join(f"<p>{text(note)}</p>" for note in linear.notes)
    return f"<p>{len(linear.modes)} modes; operating point <strong>{text(linear.verdict)}</strong>. {about}</p>{notes}"


def _modes(given: Sequence[NamedMode], fitted: LinearResult | None) -> str:
    """The modes, one a row; with those at the fitted values each under the given one that it belongs to."""
    head = ["eigenvalue, rad/s", "frequency, Hz", "damping"]
    rest = ["mode of", "states that take part", "kind"]
    if fitted is None:
        return rows_of([*head, *rest], ((*_numbers(m.mode), *_words(m)) for m in given if m.mode.eigenvalue.imag >= 0))
    if len(fitted.modes) != len(given):  # the fitted model has an effect with states
        return "".join(
            f"<h3>Modes at the {name} values</h3>{_modes(modes, None)}"
            for name, modes in (("fitted", fitted.modes), ("given", given))
        )
    pairs = [p for p in zip(given, fitted.modes, strict=True) if max(m.mode.eigenvalue.imag for m in p) >= 0]
    rows = [
        (name, *_numbers(m.mode), *_words(m))
        for pair in pairs
        for name, m in zip(("given", "fitted"), pair, strict=True)
    ]
    return rows_of(["values", *head, *rest], rows)


def _numbers(m: Mode) -> tuple[Any, ...]:
    re, im = m.eigenvalue.real, m.eigenvalue.imag
    value = number(re) if im == 0 else f"{number(re)} ± {number(abs(im))}j"
    return Markup(value), m.frequency_hz, figures(m.damping, 3)


def _words(m: NamedMode) -> tuple[str, str, str]:
    part = m.mode.participation
    shares = sorted(part.items(), key=lambda item: -item[1])[:3]
    states = ", ".join(f"{n} {v:.2f}" for n, v in shares if v >= 0.05)
    name = "" if all(n in part for n in (m.name, *m.name.split(" + ")[1:])) else m.name
    return name, states, m.mode.kind


def _limits(point: OperatingPoint) -> str:
    near = sorted(point.margins, key=lambda x: abs(x.margin))[:NEAREST]
    held = ", ".join(f"{x.signal} at {x.level}" for x in point.active_limits) or "none"
    listed = rows_of(["signal", "limit", "level", "margin"], ((x.signal, x.kind, x.level, x.margin) for x in near))
    return f"<p>Active limits: {text(held)}.{' The nearest others:' if near else ''}</p>{listed}"


def _bode(linear: Linearisation) -> str:
    """Gain and phase of every channel; with a model at the fitted values that one is solid and the given one dashed."""
    fitted = linear.at_fitted
    models = [("", linear.given)] if fitted is None else [(", fitted", fitted), (", given", linear.given)]
    drawn = [(label, m.frequency_response) for label, m in models if m.frequency_response is not None]
    if not drawn:
        return ""
    fig = figure(7.5, 4.8, {"left": 0.1, "right": 0.99, "bottom": 0.11, "top": 0.98, "hspace": 0.1})
    (pair,) = bode_axes(fig)
    seen = [_curves(pair, response, label, k if len(drawn) > 1 else None) for k, (label, response) in enumerate(drawn)]
    if not any(seen):
        return ""
    pair[0].legend(fontsize="small")
    name = "Bode diagram of the linear model"
    return captioned(svg(fig, name), f"{name}, gain above phase.")


def _curves(pair: Any, response: FrequencyResponse, label: str, which: int | None) -> bool:
    """Draw one model's channels, each in a colour of its own; whether there is one. which: of several models, their line."""
    seen = []
    for k, (i, j) in enumerate(np.ndindex(*response.values.shape[1:])):
        name = f"{response.input_names[j]} to {response.output_names[i]}{label}"
        line = LINES[(k if which is None else which) % len(LINES)]
        values, phase = response.values[:, i, j], response.phase_deg[:, i, j]
        style = {"color": SERIES[k % len(SERIES)], "linestyle": line}
        seen.append(draw_response(pair, response.omega, values, phase, name, **style))
    return any(seen)


def _limit(margin: Crossing, factor: float = 1.0) -> tuple[str, str]:
    """A margin and its frequency as text; infinite is no limit."""
    if np.isinf(margin.value):
        return "unlimited", ""
    return shown(factor * margin.value), "infinite" if np.isinf(margin.omega) else shown(margin.omega / (2 * np.pi))


def _margins(margins: StudyMargins | None) -> str:
    """The margins of each loop, of all at once, and of plant and controller."""
    if margins is None:
        return ""
    rows = [
        (
            name,
            *_limit(m.gain_margin),
            *(("unlimited", "") if m.lower_gain_margin.value == 0 else _limit(m.lower_gain_margin)),
            *_limit(m.phase_margin),
            _limit(m.delay, 1e3)[0],
            shown(m.modulus.value, 3),
            shown(m.disk.value, 3),
        )
        for name, m in margins.each.items()
    ]
    header = ["loop opened at", "gain", "at, Hz", "lower gain", "at, Hz", "phase, degrees", "at, Hz", "delay, ms"]
    return f"<h3>Margins</h3>{rows_of([*header, 'modulus', 'disk'], rows)}{_said(margins.common_lines())}"


def _ports(ports: Sequence[PortImpedance]) -> str:
    """The size of each port's impedance over frequency, and whether it is passive."""
    if not ports:
        return ""
    fig = figure(7.5, 2.9, {"left": 0.1, "right": 0.99, "bottom": 0.17, "top": 0.97})
    axes = fig.subplots()
    k = 0
    for port in ports:
        z = port.response
        for i, o in enumerate(z.output_names):
            for j, u in enumerate(z.input_names):
                style: dict[str, Any] = {"color": SERIES[k % len(SERIES)], "linestyle": LINES[k % len(LINES)]}
                label = port.name if len(z.input_names) == 1 else f"{port.name} {o}{u}"
                axes.loglog(z.frequency_hz, np.maximum(z.magnitude[:, i, j], 1e-12), label=label, **style)
                k += 1
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel("impedance")
    axes.legend(fontsize="small")
    axes.grid(True, color="#dddddd", linewidth=0.5)
    drawn = svg(fig, "Impedance of the ports over frequency")
    picture = captioned(drawn, "Size of the impedance at each port over frequency.")
    return f"<h3>Impedance at ports</h3>{picture}{_said(map(port_line, ports))}"


def _locus(loci: RootLocus | None) -> str:
    """The eigenvalues along a parameter, and where stability is lost or won."""
    if loci is None:
        return ""
    fig = figure(7.5, 3.6, {"left": 0.1, "right": 0.99, "bottom": 0.14, "top": 0.97})
    axes = fig.subplots()
    locus(loci, ax=axes)
    axes.set_title("")  # the caption says it
    # Linear about the origin and logarithmic outside: eigenvalues lie decades apart.
    slowest = np.abs(loci.eigenvalues)
    near = float(slowest[slowest > 0].min(initial=1.0))
    for scale in (axes.set_xscale, axes.set_yscale):
        scale("symlog", linthresh=near)
    unit = f" {text(loci.unit)}" if loci.unit else ""
    span = f"{text(loci.parameter)} from {number(loci.values[0])} (dots) to {number(loci.values[-1])}{unit} (squares)"
    picture = captioned(svg(fig, f"Eigenvalues along {loci.parameter}"), f"Eigenvalues along {span}.")
    return f"<h3>Eigenvalues along a parameter</h3>{picture}{_said(locus_lines(loci))}"


def _said(lines: Iterable[str]) -> str:
    """Lines of the stage as sentences."""
    return "".join(f"<p>{text(capital(line))}.</p>" for line in lines)


SECTION = Section(
    order=75,
    title="Linear model",
    about="Modes, damping, margins and frequency responses about the operating point.",
    render=_render,
)
