"""The linear model: where it stands, its modes, what limits are near, and its frequency response."""

from __future__ import annotations

from typing import Any

import numpy as np

from hvdc_ident.report.drawing import figure, svg
from hvdc_ident.report.html import captioned, number, table, text
from hvdc_ident.report.results import Results, Section
from hvdc_ident.text import unstable_roots

NEAREST = 5
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
LINES = ("-", "--", "-.", ":")

CHECKS = {
    "symbolic": "complex steps",
    "directional": "central differences",
    "finite-difference": "differences of another step size",
}
"""Second Jacobian that one of each method was compared with."""
EARLIER = {
    "verdict": "not decided",
    "rightmost": None,
    "unstable_roots": None,
    "method": "an earlier version",
    "reason": "these results are of an earlier version: hvdc-ident linearize makes them again",
}
"""Stands for the stability in results that have none."""


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
        + _others(shown)
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
    found = data.get("stability") or EARLIER
    right = f", rightmost real part {number(found['rightmost'][0])} 1/s" if found["rightmost"] else ""
    verdict = "not shown to be stable or unstable" if found["verdict"] == "not decided" else found["verdict"]
    why = "" if found["method"] == "eigenvalues of A" else f"; {text(found['method'])}{_count(found)}"
    return (
        f"<p>{len(data['modes'])} modes; the operating point is <strong>{text(verdict)}</strong>{right}{why}. Largest "
        f"scaled residual {number(point.get('residual'), 2)}; the Jacobian differs from "
        f"{CHECKS[data.get('method', 'symbolic')]} by {number(data.get('jacobian_error'), 2)}.</p>"
        + "".join(f"<p>{text(note)}</p>" for note in data.get("notes") or ())
    )


def _count(found: dict[str, Any]) -> str:
    """Return the number of unstable roots after a colon, and why that cannot be told where it cannot."""
    why = f" ({text(found['reason'])})" if found["reason"] else ""
    return f": {'not decided' if found['verdict'] == 'not decided' else unstable_roots(found)}{why}"


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
    axes = fig.subplots(2, 1, sharex=True)
    count = sum(
        _curves(axes, response, label, k if len(drawn) > 1 else None) for k, (label, response) in enumerate(drawn)
    )
    if count == 0:
        return ""
    gain, phase = axes
    gain.set_ylabel("gain, dB")
    phase.set_ylabel("phase, degrees")
    phase.set_xlabel("frequency, Hz")
    gain.legend(fontsize="small")
    for part in axes:
        part.grid(True, color="#dddddd", linewidth=0.5)
        part.yaxis.set_label_coords(-0.08, 0.5)
    return captioned(
        svg(fig, "Bode diagram of the linear model"), "Bode diagram of the linear model, gain above phase."
    )


def _curves(axes: Any, response: dict[str, Any], label: str, which: int | None) -> int:
    """Draw one model's channels, each in a colour of its own, and return how many. which: of several models, their line."""
    omega = np.array(response["omega"], dtype=float)
    values = np.array(response["real"], dtype=float) + 1j * np.array(response["imag"], dtype=float)
    channels = [(i, j) for i in range(len(response["outputs"])) for j in range(len(response["inputs"]))]
    count = 0
    for k, (i, j) in enumerate(channels):
        v = values[:, i, j]
        keep = (omega > 0) & (np.abs(v) > 0)
        if not keep.any():
            continue
        line = LINES[(k if which is None else which) % len(LINES)]
        style: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "linestyle": line}
        hertz, name = omega[keep] / (2 * np.pi), f"{response['inputs'][j]} to {response['outputs'][i]}{label}"
        axes[0].semilogx(hertz, 20 * np.log10(np.abs(v[keep])), label=name, **style)
        axes[1].semilogx(hertz, np.degrees(np.unwrap(np.angle(v[keep]))), **style)
        count += 1
    return count


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
    page = "<h3>Margins</h3>"
    if found.get("stable") is False:
        s = found.get("stability") or EARLIER
        count = f" ({_count(s).removeprefix(': ')})" if s["verdict"] == "unstable" else ""
        page += f"<p>The closed loops are {text(s['verdict'])}{count}: they have no margins.</p>"
    elif found.get("stable") is None and found.get("loops"):
        page += (
            "<p>Whether the closed loops are stable cannot be told, so that no margins are given: "
            f"{text((found.get('stability') or EARLIER)['reason'])}.</p>"
        )
    elif found.get("loops"):
        rows = []
        for name, m in found["loops"].items():
            gain, lower, phase = m["gain_margin"], m.get("lower_gain_margin"), m["phase_margin_deg"]
            delay, disk = m["delay_margin_s"], m["disk_margin"]
            rows.append(
                [
                    text(name),
                    *_limit(gain),
                    *(("unlimited", "") if lower and lower["value"] == 0 else _limit(lower)),
                    *_limit(phase),
                    _limit(delay, 1e3)[0],
                    number(m["modulus_margin"]["value"], 3),
                    number(disk["value"], 3),
                ]
            )
        header = ["loop opened at", "gain", "at, Hz", "lower gain", "at, Hz", "phase, degrees", "at, Hz", "delay, ms"]
        header += ["modulus", "disk"]
        page += table(header, rows)
        if len(rows) > 1:
            disk = found["disk_margin"]
            page += (
                f"<p>All loops at once: disk margin {number(disk['value'], 3)} at {_hertz(disk['omega'])} Hz, so every gain "
                f"may change by a factor of {number(disk['gain'], 3)} and every phase by {number(disk['phase_deg'], 3)} "
                "degrees, either way and independently.</p>"
            )
    if "ncf_margin" in found:
        n = found["ncf_margin"]
        page += (
            f"<p>Between plant ({text(', '.join(n['inputs']))} to {text(', '.join(n['outputs']))}) and controller the "
            f"normalised coprime factor margin is {number(n['value'])}; the largest that any controller attains is "
            f"{number(n['attainable'])}.</p>"
        )
    return page


def _ports(data: dict[str, Any]) -> str:
    """The size of each port's impedance over frequency, and whether it is passive."""
    ports = data.get("ports") or []
    if not ports:
        return ""
    fig = figure(7.5, 2.9, {"left": 0.1, "right": 0.99, "bottom": 0.17, "top": 0.97})
    axes = fig.subplots()
    k, words = 0, []
    for port in ports:
        omega = np.array(port["omega"], dtype=float)
        values = np.abs(np.array(port["real"], dtype=float) + 1j * np.array(port["imag"], dtype=float))
        for i, o in enumerate(port["outputs"]):
            for j, u in enumerate(port["inputs"]):
                style: dict[str, Any] = {"color": COLOURS[k % len(COLOURS)], "linestyle": LINES[k % len(LINES)]}
                label = port["name"] if len(port["inputs"]) == 1 else f"{port['name']} {o}{u}"
                axes.loglog(omega / (2 * np.pi), np.maximum(values[:, i, j], 1e-12), label=label, **style)
                k += 1
        least = port["least_real_part"]
        side = "passive over the band" if least["value"] >= 0 else "not passive"
        words.append(
            f"{text(port['name'])} is {side}: the least real part is {number(least['value'])} at "
            f"{_hertz(least['omega'])} Hz"
        )
    axes.set_xlabel("frequency, Hz")
    axes.set_ylabel("impedance")
    axes.legend(fontsize="small")
    axes.grid(True, color="#dddddd", linewidth=0.5)
    drawn = svg(fig, "Impedance of the ports over frequency")
    picture = captioned(drawn, "Size of the impedance at each port over frequency.")
    return f"<h3>Impedance at ports</h3>{picture}<p>{'; '.join(words)}.</p>"


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
        colour = COLOURS[k % len(COLOURS)]
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
    limits = "; ".join(
        f"stability is {text(x['direction'])} at {number(x['value'])}{unit} ({_hertz(abs(x['eigenvalue'][1]))} Hz)"
        for x in found["limits"]
    )
    drawn = svg(fig, f"Eigenvalues along {found['parameter']}")
    picture = captioned(drawn, f"Eigenvalues along {span}.")
    return f"<h3>Eigenvalues along a parameter</h3>{picture}<p>{limits or 'Stability is neither lost nor won'}.</p>"


def _others(data: dict[str, Any]) -> str:
    """The comparison with another model, and the reduced model, in a sentence each."""
    page = ""
    c = data.get("comparison")
    if c:
        winding = (
            ""
            if c["winding"] == 0
            else "; the winding condition fails, so that no controller of one need suit the other"
        )
        attainable = c.get("attainable_margin")
        room = (
            "" if attainable is None else f" (any controller of this one has a margin of at most {number(attainable)})"
        )
        apart = c.get("difference")
        gain = (
            "" if not apart else f" The gains differ by up to {number(apart['value'])}, at {_hertz(apart['omega'])} Hz."
        )
        page += (
            f"<p>Against {text(c['other'])}: nu-gap {number(c['nu_gap'])}{room}, largest at {_hertz(c['omega'])} Hz"
            f"{winding}.{gain}</p>"
        )
    r = data.get("reduced")
    if r:
        dc = ", with the dc gain kept" if r["match_dc"] else ""
        page += (
            f"<p>Reduced from {r['states_before']} to {r['order']} states{dc}: the gain differs by up to "
            f"{number(r['error']['value'])} (bound {number(r['bound'])}).</p>"
        )
    for f in data.get("formulas") or []:
        shown = f.get("reason") or f"({f['numerator']}) / ({f['denominator']})"
        page += f"<p>{text(f['output'])} from {text(f['input'])}: <code>{text(shown)}</code></p>"
    return page


SECTION = Section(
    order=75,
    title="Linear model",
    about="Modes, damping, margins and frequency responses about the operating point.",
    render=_render,
)
