"""The words of a linear model, from its JSON: shared by the screen of the stage and the report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from hvdc_ident.text import quantity, unstable_roots

MODES_SHOWN = 8
"""Modes on the screen, the least damped first."""
VALUES_SHOWN = 6
"""Inputs and outputs of the operating point in one line of the screen."""


def lines(data: Mapping[str, Any]) -> list[str]:
    """Return the lines that the stage prints of a linear model. data: its JSON."""
    found = [*_point_lines(data), *(f"operating point: {note}" for note in data["notes"]), *_mode_lines(data)]
    if "trim" in data:
        wanted = ", ".join(f"{n} = {v:g}" for n, v in data["trim"]["outputs"].items())
        made = ", ".join(f"{n} = {v:.6g}" for n, v in data["trim"]["found"].items())
        found.append(f"trimmed to {wanted}: {made or 'nothing had to move'}")
    margins = data.get("margins", {})
    for name, m in (margins.get("loops") or {}).items() if margins.get("stable") else ():
        found.append(
            f"loop at {name}: gain margin {_at(m['gain_margin'])}, lower gain margin {_at(m['lower_gain_margin'])}, phase "
            f"margin {_at(m['phase_margin_deg'], ' degrees')}, delay margin {_at(m['delay_margin_s'], ' ms', 1e3)}, disk "
            f"{m['disk_margin']['value']:.3g}"
        )
    return [*found, *margin_lines(margins), *locus_lines(data), *port_lines(data), *other_lines(data)]


def port_lines(data: Mapping[str, Any]) -> list[str]:
    """Return whether each port is passive."""
    found = []
    for port in data.get("ports", ()):
        least = port["least_real_part"]
        side = "passive" if least["value"] >= 0 else "not passive"
        at = f"{least['omega'] / math.tau:.4g} Hz"
        found.append(f"port {port['name']}: {side} over the band, least real part {least['value']:.4g} at {at}")
    return found


def other_lines(data: Mapping[str, Any]) -> list[str]:
    """Return the comparison with another model, the reduced model and the formulas of transfer functions."""
    found = []
    if c := data.get("comparison"):
        winding = (
            "" if c["winding"] == 0 else " (the winding condition fails: no controller of one need suit the other)"
        )
        room = "" if c["attainable_margin"] is None else f", attainable margin {c['attainable_margin']:.4g}"
        apart = c.get("difference")
        gain = f"; the gains differ by up to {_at(apart)}" if apart else ""
        found.append(f"against {c['other']}: nu-gap {c['nu_gap']:.4g}{winding}{room}{gain}")
    if r := data.get("reduced"):
        dc = ", dc gain matched" if r["match_dc"] else ""
        size = f"error {r['error']['value']:.4g}, bound {r['bound']:.4g}{dc}"
        found.append(f"reduced from {r['states_before']} to {r['order']} states: {size}")
    for f in data.get("formulas", ()):
        shown = f.get("reason") or f"({f['numerator']}) / ({f['denominator']})"
        found.append(f"{f['output']} from {f['input']}: {shown}")
    return found


def stability(data: Mapping[str, Any]) -> str:
    """Return whether the operating point is stable, with its rightmost eigenvalue; empty for a model without modes.

    Of a model with delays the number of its unstable roots comes along, which is what the verdict rests on.
    """
    found = data["stability"]
    right = f", rightmost eigenvalue {found['rightmost'][0]:.4g} 1/s" if found["rightmost"] else ""
    if found["method"] == "eigenvalues of A":
        return f"{found['verdict']}{right}" if right else ""
    if found["verdict"] == "not decided":
        return f"stability not decided: {found['reason']}"
    why = f": {found['reason']}" if found["reason"] else ""
    return f"{found['verdict']}{right} ({unstable_roots(found)}, delays exact){why}"


def _point_lines(data: Mapping[str, Any]) -> list[str]:
    """The verdict on stability, the inputs and outputs of the linear model at the point, and the limits that are active."""
    found = [f"operating point: {verdict}"] if (verdict := stability(data)) else []
    for kind in ("input", "output"):
        names = data[f"{kind}_names"]
        values = zip(names, data["u0" if kind == "input" else "y0"], data[f"{kind}_units"], strict=True)
        shown = [f"{n} = {quantity(v, u, 6)}" for n, v, u in list(values)[:VALUES_SHOWN]]
        more = f" and {len(names) - VALUES_SHOWN} more" if len(names) > VALUES_SHOWN else ""
        found += [f"{kind}s: {', '.join(shown)}{more}"] if shown else []
    active = data["operating_point"]["active_limits"]
    for limit in active:
        found.append(f"active limit: {limit['signal']} is held by {limit['level']} ({limit['limit']} limit)")
    return [*found] if active or not data["operating_point"]["margins"] else [*found, "active limits: none"]


def _mode_lines(data: Mapping[str, Any]) -> list[str]:
    """The oscillating modes, the least damped first, and how many decay without oscillation, with the slowest of them."""
    real = [m for m in data["modes"] if m["eigenvalue"][1] == 0.0 and "sliding mean" not in str(m["kind"])]
    swinging = sorted((m for m in data["modes"] if m["eigenvalue"][1] > 0), key=lambda m: m["damping"])
    found = []
    for m in swinging[:MODES_SHOWN]:
        shares = sorted(m["participation"], key=lambda n: -m["participation"][n])[:3]
        found.append(f"mode at {m['frequency_hz']:.4g} Hz, damping {100 * m['damping']:.3g} %: {', '.join(shares)}")
    if len(swinging) > MODES_SHOWN:
        better = swinging[MODES_SHOWN]["damping"]
        found.append(f"and {len(swinging) - MODES_SHOWN} more modes, of damping {100 * better:.3g} % and above")
    if real:
        slowest = max(real, key=lambda m: m["eigenvalue"][0])
        rate = slowest["eigenvalue"][0]
        part = max(slowest["participation"], key=lambda n: slowest["participation"][n])
        how = (
            f"the slowest with a time constant of {quantity(-1.0 / rate, 's')}"
            if rate < 0
            else f"one at {rate:.4g} 1/s"
        )
        found.append(f"modes without oscillation: {len(real)}, {how}: {part}")
    return found


def locus_lines(data: Mapping[str, Any]) -> list[str]:
    """Return a line for each place along the locus where stability is lost or won."""
    found = data.get("locus")
    if not found:
        return []
    unit = f" {found['unit']}" if found["unit"] else ""
    span = f"{found['parameter']} from {found['values'][0]:g} to {found['values'][-1]:g}{unit}"
    lines = [
        f"along {span} stability is {x['direction']} at {x['value']:.6g}{unit}, "
        f"{abs(x['eigenvalue'][1]) / math.tau:.4g} Hz"
        for x in found["limits"]
    ]
    return lines or [f"along {span} stability is neither lost nor won"]


def without_margins(found: Mapping[str, Any]) -> str:
    """Return the sentence on closed loops that are not stable, or of which it cannot be told."""
    s = found["stability"]
    if s["verdict"] == "not decided":
        return f"whether the closed loops are stable cannot be told, so that no margins are given: {s['reason']}"
    if s["verdict"] != "unstable":
        return "the closed loops are on the limit of stability: they have no margins"
    return f"the closed loops are not stable: they have no margins ({unstable_roots(s)})"


def _at(margin: Mapping[str, float | None], unit: str = "", factor: float = 1.0) -> str:
    """Return a margin with its frequency; one without a limit (infinite, or a factor of 0) is unlimited."""
    value, omega = margin["value"], margin["omega"]
    if value is None or (omega is None and value == 0.0 and not unit) or math.isinf(value):
        return "unlimited"
    where = "at infinite frequency" if omega is None or math.isinf(omega) else f"at {omega / math.tau:.4g} Hz"
    return f"{factor * value:.4g}{unit} {where}"


def margin_lines(found: Mapping[str, Any]) -> list[str]:
    """Return why there are no margins, else those of all loops together; and that of plant and controller."""
    result = []
    if "stable" in found and not found["stable"]:
        result.append(without_margins(found))
    if found.get("stable") and len(found["loops"]) > 1:
        disk = found["disk_margin"]
        result.append(f"all loops at once: disk margin {disk['value']:.3g}, phase {disk['phase_deg']:.3g} degrees")
    if "ncf_margin" in found:
        n = found["ncf_margin"]
        result.append(f"coprime factor margin {n['value']:.4g}; the largest attainable {n['attainable']:.4g}")
    return result
