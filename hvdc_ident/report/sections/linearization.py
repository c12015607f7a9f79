"""The linear model: where it stands, its modes, what limits are near, and its frequency response."""

from __future__ import annotations

from typing import Any

import numpy as np

from hvdc_ident.colours import SERIES
from hvdc_ident.report.drawing import bode_axes, complex_of, draw_response, figure, svg
from hvdc_ident.report.html import Section, captioned, number, table, text
from hvdc_ident.summary import Results
from hvdc_ident.summary.linear import locus_lines, margin_lines, other_lines, port_lines, stability
from hvdc_ident.text import capital

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
    given = results.get("linearization")
    if not given.get("modes"):
        return ""
    fitted = given.get("fitted") or {}
    found = fitted if fitted.get("modes") else None
    shown = found or given
    point = shown.get("operating_point") or {}
    return (
        _which(given, results.get("fit"), results.get("discrepancy"))
        + _point(shown, point)
        + _modes(given["modes"], found)
        + _limits(point)
        + _bode(given, found)
        + _margins(shown)
        + _ports(shown)
        + _locus(shown)
        + _said(other_lines(shown))
    )


def _which(given: dict[str, Any], fit: dict[str, Any], diagnosis: dict[str, Any]) -> str:
    """At which values the linear models stand."""
    fitted, note = given.get("fitted") or {}, str(given.get("fitted_note") or "")
    if fitted.get("modes"):
        lines = [f"At the <strong>{text(note)}</strong>, beside the given values."]
    else:
        why = fitted.get("message") or note
        lines = [f"At the <strong>given</strong> values{': ' if why else ''}{text(why)}."]
    if fit.get("fingerprint") and fit["fingerprint"] != fitted.get("fit"):
        lines.append("A fit has run since: `hvdc-ident linearize` takes it in.")
    elif fitted and diagnosis.get("fingerprint", "") != fitted.get("diagnosis", ""):
        lines.append("A diagnosis has run since: `hvdc-ident linearize` takes it in.")
    return f"<p>{' '.join(lines)}</p>"


def _point(data: dict[str, Any], point: dict[str, Any]) -> str:
    verdict = stability(data) if data.get("stability") else "of an earlier version: hvdc-ident linearize makes it again"
    check = CHECKS[data.get("method", "symbolic")]
    about = f"Largest scaled residual {number(point.get('residual'), 2)}; the Jacobian differs from {check} by "
    about += f"{number(data.get('jacobian_error'), 2)}."
    notes = "".join(f"<p>{text(note)}</p>" for note in data.get("notes") or ())
    return f"<p>{len(data['modes'])} modes; operating point <strong>{text(verdict)}</strong>. {about}</p>{notes}"


def _modes(given: list[dict[str, Any]], fitted: dict[str, Any] | None) -> str:
    """The modes, one a row; with those at the fitted values each under the given one that it belongs to."""
    head = ["eigenvalue, rad/s", "frequency, Hz", "damping"]
    rest = ["mode of", "states that take part", "kind"]
    if fitted is None:
        rows = [[*_numbers(m), *_words(m)] for m in given if m["eigenvalue"][1] >= 0]
        return table([*head, *rest], rows, words=(3, 4, 5))
    if len(fitted["modes"]) != len(given):  # the fitted model has an effect with states
        return "".join(
            f"<h3>Modes at the {name} values</h3>{_modes(modes, None)}"
            for name, modes in (("fitted", fitted["modes"]), ("given", given))
        )
    pairs = [
        (g, f) for g, f in zip(given, fitted["modes"], strict=True) if max(g["eigenvalue"][1], f["eigenvalue"][1]) >= 0
    ]
    rows = [
        [name, *_numbers(m), *_words(m)] for pair in pairs for name, m in zip(("given", "fitted"), pair, strict=True)
    ]
    return table(["values", *head, *rest], rows, words=(0, 4, 5, 6))


def _numbers(m: dict[str, Any]) -> list[str]:
    re, im = (float(v) for v in m["eigenvalue"])
    value = number(re) if im == 0 else f"{number(re)} ± {number(abs(im))}j"
    return [value, number(m["frequency_hz"]), number(m["damping"], 3)]


def _words(m: dict[str, Any]) -> list[str]:
    shares = sorted(m["participation"].items(), key=lambda item: -item[1])[:3]
    states = ", ".join(f"{n} {v:.2f}" for n, v in shares if v >= 0.05)
    name = str(m.get("name", ""))
    name = "" if name in m["participation"] or all(n in m["participation"] for n in name.split(" + ")) else name
    return [text(name), text(states), text(m.get("kind", ""))]


def _limits(point: dict[str, Any]) -> str:
    active = point.get("active_limits") or []
    near = sorted(point.get("margins") or [], key=lambda x: abs(float(x["margin"])))[:NEAREST]
    held = ", ".join(f"{x['signal']} at {x['level']}" for x in active) or "none"
    rows = [[text(x["signal"]), text(x["limit"]), text(str(x["level"])), number(x["margin"])] for x in near]
    listed = table(["signal", "limit", "level", "margin"], rows, words=(0, 1, 2)) if rows else ""
    return f"<p>Active limits: {text(held)}.{' The nearest others:' if rows else ''}</p>{listed}"


def _bode(given: dict[str, Any], fitted: dict[str, Any] | None) -> str:
    """Gain and phase of every channel; with a model at the fitted values that one is solid and the given one dashed."""
    models = [("", given)] if fitted is None else [(", fitted", fitted), (", given", given)]
    drawn = [(label, found) for label, data in models if (found := data.get("frequency_response"))]
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


def _curves(pair: Any, response: dict[str, Any], label: str, which: int | None) -> bool:
    """Draw one model's channels, each in a colour of its own; whether there is one. which: of several models, their line."""
    omega, values = np.array(response["omega"], dtype=float), complex_of(response["real"], response["imag"])
    phase = np.array(response["phase_deg"], dtype=float)
    channels = [(i, j) for i in range(len(response["outputs"])) for j in range(len(response["inputs"]))]
    seen = []
    for k, (i, j) in enumerate(channels):
        name = f"{response['inputs'][j]} to {response['outputs'][i]}{label}"
        line = LINES[(k if which is None else which) % len(LINES)]
        style = {"color": SERIES[k % len(SERIES)], "linestyle": line}
        seen.append(draw_response(pair, omega, values[:, i, j], phase[:, i, j], name, **style))
    return any(seen)


def _hertz(omega: Any) -> str:
    return number(omega / (2 * np.pi)) if isinstance(omega, int | float) else number(omega)


def _limit(margin: dict[str, Any] | None, factor: float = 1.0) -> tuple[str, str]:
    """A margin and its frequency as text; no value is no limit, and no frequency an infinite one."""
    if margin is None:
        return "–", ""
    if margin["value"] is None:
        return "unlimited", ""
    return number(factor * margin["value"]), "infinite" if margin["omega"] is None else _hertz(margin["omega"])


def _margins(data: dict[str, Any]) -> str:
    """The margins of each loop, of all at once, and of plant and controller."""
    found = data.get("margins")
    if not found:
        return ""
    rows = []
    for name, m in (found.get("loops") or {}).items() if found.get("stable") else ():
        lower = m.get("lower_gain_margin")
        rows.append(
            [
                text(name),
                *_limit(m["gain_margin"]),
                *(("unlimited", "") if lower and lower["value"] == 0 else _limit(lower)),
                *_limit(m["phase_margin_deg"]),
                _limit(m["delay_margin_s"], 1e3)[0],
                number(m["modulus_margin"]["value"], 3),
                number(m["disk_margin"]["value"], 3),
            ]
        )
    header = ["loop opened at", "gain", "at, Hz", "lower gain", "at, Hz", "phase, degrees", "at, Hz", "delay, ms"]
    shown = table([*header, "modulus", "disk"], rows) if rows else ""
    return f"<h3>Margins</h3>{shown}{_said(margin_lines(found))}"


def _ports(data: dict[str, Any]) -> str:
    """The size of each port's impedance over frequency, and whether it is passive."""
    ports = data.get("ports") or []
    if not ports:
        return ""
    fig = figure(7.5, 2.9, {"left": 0.1, "right": 0.99, "bottom": 0.17, "top": 0.97})
    axes = fig.subplots()
    k = 0
    for port in ports:
        omega = np.array(port["omega"], dtype=float)
        values = np.abs(complex_of(port["real"], port["imag"]))
        for i, o in enumerate(port["outputs"]):
            for j, u in enumerate(port["inputs"]):
                style: dict[str, Any] = {"color": SERIES[k % len(SERIES)], "linestyle": LINES[k % len(LINES)]}
                label = port["name"] if len(port["inputs"]) == 1 else f"{port['name']} {o}{u}"
                axes.loglog(omega / (2 * np.pi), np.maximum(values[:, i, j], 1e-12), label=label, **style)
                k += 1
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel("impedance")
    axes.legend(fontsize="small")
    axes.grid(True, color="#dddddd", linewidth=0.5)
    drawn = svg(fig, "Impedance of the ports over frequency")
    picture = captioned(drawn, "Size of the impedance at each port over frequency.")
    return f"<h3>Impedance at ports</h3>{picture}{_said(port_lines(data))}"


def _locus(data: dict[str, Any]) -> str:
    """The eigenvalues along a parameter, and where stability is lost or won."""
    found = data.get("locus")
    if not found:
        return ""
    values = np.array(found["eigenvalues"], dtype=float)
    fig = figure(7.5, 3.6, {"left": 0.1, "right": 0.99, "bottom": 0.14, "top": 0.97})
    axes = fig.subplots()
    for k in range(values.shape[1]):
        re, im = values[:, k, 0], values[:, k, 1]
        colour = SERIES[k % len(SERIES)]
        axes.plot(re, im, color=colour, linewidth=1.2)
        axes.plot(re[:1], im[:1], "o", color=colour, markersize=4)
        axes.plot(re[-1:], im[-1:], "s", color=colour, markersize=4)
    # Linear about the origin and logarithmic outside: eigenvalues lie decades apart.
    slowest = np.abs(values[..., 0] + 1j * values[..., 1])
    near = float(slowest[slowest > 0].min(initial=1.0))
    for scale in (axes.set_xscale, axes.set_yscale):
        scale("symlog", linthresh=near)
    axes.axvline(0.0, color="#999999", linewidth=0.8)
    axes.set_xlabel("real part, rad/s")
    axes.set_ylabel("imaginary part, rad/s")
    axes.grid(True, color="#dddddd", linewidth=0.5)
    unit = f" {text(found['unit'])}" if found["unit"] else ""
    span = f"{text(found['parameter'])} from {number(found['values'][0])} (dots) to {number(found['values'][-1])}{unit} (squares)"
    picture = captioned(svg(fig, f"Eigenvalues along {found['parameter']}"), f"Eigenvalues along {span}.")
    return f"<h3>Eigenvalues along a parameter</h3>{picture}{_said(locus_lines(data))}"


def _said(lines: list[str]) -> str:
    """Lines of the stage as sentences."""
    return "".join(f"<p>{text(capital(line))}.</p>" for line in lines)


SECTION = Section(
    order=75,
    title="Linear model",
    about="Modes, damping, margins and frequency responses about the operating point.",
    render=_render,
)
