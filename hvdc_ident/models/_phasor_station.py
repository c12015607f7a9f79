"""The signals of one phasor station: a current injector behind its grid, and the high-level controls.

i is the station's number as text. tag is put behind the names of a control that a two-terminal link has but once.
Per unit; positive power flows from the grid into the converter.
"""

from __future__ import annotations


def grid_impedance() -> dict[str, str]:
    """R and X of the grid behind every station, from its impedance Zg and ratio XR."""
    return {"R": "Zg / sqrt(1 + XR**2)", "X": "XR * R"}


def plant(i: str) -> dict[str, str]:
    """Terminal voltage and powers from the currents in the frame of the terminal voltage, without losses."""
    return {
        f"Vac{i}": f"sqrt(E{i}**2 - (X*Ir{i} - R*Ii{i})**2) - (R*Ir{i} + X*Ii{i})",
        f"P{i}": f"Vac{i} * Ir{i}",
        f"Q{i}": f"Vac{i} * Ii{i}",
        f"Pdc{i}": f"P{i}",
    }


def control_vdc(i: str, tag: str = "") -> dict[str, str]:
    """Return the dc voltage control, state xv: its measurement, error, limited output and current order."""
    return {
        f"Vdc{i}_m": f"Vdc{i}",
        f"ev{tag}": f"Vdcref{i} - Vdc{i}_m",
        f"yv{tag}_u": f"KPVDC{tag}*ev{tag} + xv{tag}",
        f"yv{tag}": f"clip(yv{tag}_u, -1.2, 1.2)",
        f"Irorder{i}": f"clip(yv{tag}, -1.1, 1.1)",
    }


def control_p(i: str, tag: str = "") -> dict[str, str]:
    """Return the active power control, state xp: its measurement, error, limited output and current order."""
    return {
        f"P{i}_m": f"P{i}",
        f"ep{tag}": f"Pref{i} - P{i}_m",
        f"yp{tag}_u": f"KPP{tag}*ep{tag} + xp{tag}",
        f"yp{tag}": f"clip(yp{tag}_u, -1.2, 1.2)",
        f"Irorder{i}": f"clip(yp{tag} / clip(Vac{i}, 0.01, 2), -1.1, 1.1)",
    }


def control_q(i: str, kp: str, ki: str) -> dict[str, str]:
    """Return the reactive power control, state xq: what the active current leaves bounds its order."""
    return {
        f"Q{i}_m": f"Q{i}",
        f"eq{i}": f"Qref{i} - Q{i}_m",
        f"yq{i}_u": f"{kp}*eq{i} + xq{i}",
        f"yq{i}": f"clip(yq{i}_u, -0.5, 0.5)",
        f"m{i}": f"min(0.5, sqrt(max(0, 1.1**2 - Irorder{i}**2)))",
        f"Iiorder{i}": f"clip(yq{i} / clip(Vac{i}, 0.01, 2), -m{i}, m{i})",
    }
