"""Plant 4: a grid-following converter with phase-locked loop, power control and current control behind a grid impedance.

Its card has the currents in a frame that turns with the grid. Here, as in programs for electromagnetic transients, the circuit
has three phases with instantaneous voltages and currents, and the control turns them into its own frame and back.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from hidden.plant import Array, Plant, See

SPEED = 2.0 * np.pi * 50.0
"""rad/s, nominal."""
_BEHIND = 2.0 * np.pi / 3.0 * np.arange(3)[:, None]
COSINES, SINES = np.cos(_BEHIND), np.sin(_BEHIND)
"""Of the angles by which the phases are behind the first one, (3, 1)."""


def _turns(angle: Array) -> tuple[Array, Array]:
    """Return cosine and sine of an angle (runs,) as the three phases see it, each (3, runs)."""
    cos, sin = np.cos(angle), np.sin(angle)
    return cos * COSINES + sin * SINES, sin * COSINES - cos * SINES


def _sum(a: Array, b: Array) -> Array:
    """Return (runs,), the sum over the phases of the products."""
    return np.asarray(np.add.reduce(a * b))


def _park(phases: Array, turns: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return the components along an angle and a quarter of a turn ahead of it, of three phases that sum to zero."""
    cos, sin = turns
    return 2.0 / 3.0 * _sum(phases, cos), -2.0 / 3.0 * _sum(phases, sin)


def _converter(x: list[Array], u: Mapping[str, Array], p: Mapping[str, Array], see: See) -> list[Array]:
    active_order, reactive_order, grid, shift = (see(n, u[n]) for n in ("Pref", "Qref", "Vg", "phi"))
    turned = SPEED * u["time"]
    amps = np.array(x[:3])
    theta, x_loop, x_d, x_q, x_p, x_r, seen_d, seen_q, p_seen, q_seen = (
        see(n, x[3 + k]) for k, n in enumerate(list(CONVERTER.states)[3:])
    )
    turns = _turns(turned + theta)
    i_d, i_q = _park(amps, turns)
    i_d, i_q = see("id", i_d), see("iq", i_q)
    p_error = see("erp", active_order - p_seen)
    q_error = see("err", reactive_order - q_seen)
    d_order = see("idref", np.clip(p["KPP"] * p_error + x_p, -1.1, 1.1))
    q_order = see("iqref", np.clip(-p["KPQ"] * q_error - x_r, -0.6, 0.6))
    d_error, q_error_i = see("erd", d_order - i_d), see("erq", q_order - i_q)
    v_d = see("vcd", seen_d + p["KPC"] * d_error + x_d - p["Lf"] * i_q)
    v_q = see("vcq", seen_q + p["KPC"] * q_error_i + x_q + p["Lf"] * i_d)
    bridge = v_d * turns[0] - v_q * turns[1]
    source = grid * _turns(turned + shift)[0]
    # Both inductances carry the same current, so that the voltage between them is a divider's.
    rise = (bridge - source - (p["Rf"] + p["Rg"]) * amps) / (p["Lf"] + p["Lg"])
    volts = source + p["Rg"] * amps + p["Lg"] * rise
    m_d, m_q = _park(volts, turns)
    m_d, m_q = see("vd", m_d), see("vq", m_q)
    active = see("P", 2.0 / 3.0 * _sum(volts, amps))
    across = volts[[2, 0, 1]] - volts[[1, 2, 0]]  # c - b, a - c, b - a: a quarter of a turn ahead
    reactive = see("Q", -2.0 / (3.0 * np.sqrt(3.0)) * _sum(across, amps))
    see("outputs.V", see("V", np.sqrt(2.0 / 3.0 * _sum(volts, volts))))
    faster = see("wl", p["KPL"] * m_q + x_loop)
    see("outputs.df", see("df", faster / (2.0 * np.pi)))
    see("outputs.P", active)
    see("outputs.Q", reactive)
    return [
        *(SPEED * rise),
        faster,
        p["KIL"] * m_q,
        p["KIC"] * d_error,
        p["KIC"] * q_error_i,
        p["KIP"] * p_error,
        p["KIQ"] * q_error,
        (m_d - seen_d) / p["Tv"],
        (m_q - seen_q) / p["Tv"],
        (active - p_seen) / p["Tp"],
        (reactive - q_seen) / p["Tp"],
    ]


def _turning(x: list[Array]) -> list[Array]:
    """Return the derivatives of the states when the three currents turn steadily at nominal speed."""
    a, b, c = x[:3]
    turn = [SPEED * w / np.sqrt(3.0) for w in (c - b, a - c, b - a)]
    return [*turn, *(np.zeros_like(a) for _ in x[3:])]


CONVERTER = Plant(
    name="converter",
    parameters={
        "KPP": 0.2, "KIP": 30.0, "KPQ": 0.2, "KIQ": 30.0, "KPC": 0.24, "KIC": 10.0, "KPL": 100.0, "KIL": 4000.0,
        "Lf": 0.15, "Rf": 0.005, "Lg": 0.25, "Rg": 0.025, "Tp": 0.005, "Tv": 0.001,
    },
    inputs={"Pref": 0.5, "Qref": 0.1, "Vg": 1.0, "phi": 0.0},
    states={
        "ia": 0.5, "ib": -0.25, "ic": -0.25, "theta": 0.12, "xl": 0.0, "xd": 0.0, "xq": 0.0, "xp": 0.5, "xr": 0.1,
        "vdf": 1.0, "vqf": 0.0, "Pf": 0.5, "Qf": 0.1,
    },
    outputs=("P", "Q", "V", "df"),
    fitted=("KIP", "KIL", "Lg"),
    kicks={"Pref": 0.1, "Qref": 0.1, "Vg": 0.05, "phi": 0.1},
    slots=(
        "Pref", "Qref", "Vg", "phi", "theta", "xl", "xd", "xq", "xp", "xr", "vdf", "vqf", "Pf", "Qf", "id", "iq", "erp",
        "err", "idref", "iqref", "erd", "erq", "vcd", "vcq", "vd", "vq", "P", "Q", "V", "wl", "df",
    ),
    resistance=("", ""),
    flow=_converter,
    scheme="trapezoidal",
    pace=0.25,
    coarse=4,
    lead=0.25,
    turning=_turning,
    timed=True,
)  # fmt: skip
