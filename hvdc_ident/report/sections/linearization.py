"""The linear model: where it stands, its modes, what limits are near, and its frequency response."""

from __future__ import annotations

from typing import Any

import numpy as np

from hvdc_ident.report.drawing import figure, svg
from hvdc_ident.report.html import number, table, text
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section

NEAREST = 5
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINES = ("-", "--", "-.", ":")

CHECKS = {
    "symbolic": "complex steps",
    "directional": "central differences",
    "finite-difference": "differences of another step size",
}
"""What a Jacobian of each method was compared with."""


def _render(results: Results) -> str:
    data = results.get("linearization")
    modes = data.get("modes") or []
    if not modes:
        return ""
    point = data.get("operating_point") or {}
    return _point(data, point) + _modes(modes) + _limits(point) + _bode(data)


def _point(data: dict[str, Any], point: dict[str, Any]) -> str:
    real = [float(m["eigenvalue"][0]) for m in data["modes"] if "sliding mean" not in str(m.get("kind", ""))]
    right = max(real, default=0.0)
    verdict = "stable" if right < -1e-9 else "on the limit of stability" if right < 1e-6 else "unstable"
    return (
        f"<p>{len(data['modes'])} modes; the operating point is <strong>{verdict}</strong>, rightmost real part "
        f"{number(right)} 1/s. Largest scaled residual {number(point.get('residual'), 2)}; the Jacobian differs from "
        f"{CHECKS[data.get('method', 'symbolic')]} by {number(data.get('jacobian_error'), 2)}.</p>"
    )


def _modes(modes: list[dict[str, Any]]) -> str:
    rows = []
    for m in modes:
        re, im = (float(v) for v in m["eigenvalue"])
        if im < 0:
            continue
        shares = sorted(m["participation"].items(), key=lambda item: -item[1])[:3]
        states = ", ".join(f"{n} {v:.2f}" for n, v in shares if v >= 0.05)
        value = number(re) if im == 0 else f"{number(re)} ± {number(im)}j"
        rows.append([value, number(m["frequency_hz"]), number(m["damping"], 3), text(states), text(m.get("kind", ""))])
    return table(["eigenvalue, rad/s", "frequency, Hz", "damping", "states that take part", "kind"], rows, words=(3, 4))


def _limits(point: dict[str, Any]) -> str:
    active = point.get("active_limits") or []
    near = sorted(point.get("margins") or [], key=lambda x: abs(float(x["margin"])))[:NEAREST]
    held = ", ".join(f"{x['signal']} at {x['level']}" for x in active) or "none"
    rows = [[text(x["signal"]), text(x["limit"]), text(str(x["level"])), number(x["margin"])] for x in near]
    listed = table(["signal", "limit", "level", "margin"], rows, words=(0, 1, 2)) if rows else ""
    return f"<p>Active limits: {text(held)}.{' The nearest others:' if rows else ''}</p>{listed}"


def _bode(data: dict[str, Any]) -> str:
    response = data.get("frequency_response")
    if not response:
        return ""
    omega = np.array(response["omega"], dtype=float)
    values = np.array(response["real"], dtype=float) + 1j * np.array(response["imag"], dtype=float)
    fig = figure(7.5, 4.8, {"left": 0.1, "right": 0.99, "bottom": 0.11, "top": 0.98, "hspace": 0.1})
    gain, phase = fig.subplots(2, 1, sharex=True)
    k = 0
    for i, output in enumerate(response["outputs"]):
        for j, source in enumerate(response["inputs"]):
            v = values[:, i, j]
            keep = (omega > 0) & (np.abs(v) > 0)
            if not keep.any():
                continue
            style: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "linestyle": LINES[k % len(LINES)]}
            hertz = omega[keep] / (2 * np.pi)
            gain.semilogx(hertz, 20 * np.log10(np.abs(v[keep])), label=f"{source} to {output}", **style)
            phase.semilogx(hertz, np.degrees(np.unwrap(np.angle(v[keep]))), **style)
            k += 1
    if k == 0:
        return ""
    gain.set_ylabel("gain, dB")
    phase.set_ylabel("phase, degrees")
    phase.set_xlabel("frequency, Hz")
    gain.legend(fontsize="small")
    for axes in (gain, phase):
        axes.grid(True, color="#dddddd", linewidth=0.5)
        axes.yaxis.set_label_coords(-0.08, 0.5)
    return f"<figure>{svg(fig, 'Bode diagram of the linear model')}</figure>"


SECTION = Section(order=25, title="Linear model", render=_render)
