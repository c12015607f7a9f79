"""Table I: the six gains from two physical numbers, and the resulting loops.

python studies/table_1/run.py [--pin]
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from common import ending, paper  # noqa: E402
from common.ending import markdown, number  # noqa: E402

from hvdc_ident.expression import parse  # noqa: E402
from hvdc_ident.linearize import linearize  # noqa: E402
from hvdc_ident.models import load_model  # noqa: E402

BAND = 0.05  # of the step: exp(-3) is 5 %, which is where the 3 in wn = 3/(z Ts) comes from
AUTHORS = {"J": 0.16, "Ts": 0.1}  # their average-value model: 1000 MVA, 40 kJ/MVA twice
AUTHORS_GAINS = {"KPVDC": 9.6, "KIVDC": 293.87755}  # as its Modelica source and result file give them
DIGITS = {"KIVDC": 1}  # decimals printed in Table I; none for the others
FOLLOWS = {"P": "P2", "Q": "Q1", "Vdc": "Vdc1"}  # what each controller controls
EXPLAINED = {
    "KIVDC": "Ki = wn^2 J, wn = 3/(0.7 Ts)",
    "KPVDC": "Kp = 2 0.7 wn J",
    "KIP": "Ki = 3/Ts",
    "KIQ": "Ki = 3/Ts",
    "KPP": "no proportional part: power follows its order immediately",
    "KPQ": "the same",
}


def main() -> dict[str, Any]:
    """Return the rule's gains, its inputs, and the poles and settling times of the loops."""
    model = load_model(paper.LINK)
    rule = model.parameterisations["physical"]
    design = {n: p.value for n, p in rule.parameters.items()}
    authors = gains(rule.replaces, AUTHORS, model.values)
    return {
        "design": design,
        "capacitance of both stations, s": model.values["C1"] + model.values["C2"],
        "gains": gains(rule.replaces, design, model.values),
        "gains, authors' rating": {n: authors[n] for n in AUTHORS_GAINS},
        "back from Table I": inverse(),
        "dc voltage mode": mode(model),
        "settling, s": {kind: settling(kind) for kind in paper.CONTROLLERS},
    }


def gains(rule: Mapping[str, Any], design: Mapping[str, float], others: Mapping[str, float]) -> dict[str, float]:
    """Return the six gains of a design; those that the rule does not set keep the model's values."""
    at = {parse(n): v for n, v in design.items()}
    return {n: float(rule[n].subs(at)) if n in rule else others[n] for n in paper.GAINS}


def inverse() -> dict[str, float]:
    """Return J, Ts and damping from the printed gains: Kp = 2 z wn J with z wn = 3/Ts gives J, Ki = wn^2 J gives wn."""
    ts = 3.0 / paper.TABLE_1["KIP"]
    j = paper.TABLE_1["KPVDC"] * ts / 6.0
    return {"Ts": ts, "J": j, "damping": 3.0 / (ts * float(np.sqrt(paper.TABLE_1["KIVDC"] / j)))}


def mode(model: Any) -> dict[str, float]:
    """Return frequency in rad/s and damping of the link's one oscillatory mode with the gains of the rule."""
    linear = linearize(model, inputs=["Vdcref1"], outputs=["Vdc1"])
    (found,) = [m for m in linear.modes() if m.eigenvalue.imag > 0]
    return {"wn": abs(found.eigenvalue), "damping": float(found.damping)}


def settling(kind: str) -> float:
    """Return the time in s after the step from which the controlled quantity stays within 5 % of it."""
    c = paper.CONTROLLERS[kind]
    e = paper.step(kind, paper.LINK, [FOLLOWS[kind]])
    away = np.abs(e.measured[FOLLOWS[kind]] - c.after) > BAND * abs(c.after - c.before)
    return float(e.time[np.flatnonzero(away)[-1] + 1] - paper.EVENT)


def tables(values: Mapping[str, Any]) -> dict[str, str]:
    """Return the README's tables."""
    rows = [
        [n, number(paper.TABLE_1[n]), f"{values['gains'][n]:.{DIGITS.get(n, 0)}f}", EXPLAINED[n]] for n in paper.GAINS
    ]
    back, mode_, settled = values["back from Table I"], values["dc voltage mode"], values["settling, s"]
    total = number(values["capacitance of both stations, s"])
    wn = number(3 / (0.7 * values["design"]["Ts"]))
    within = "stays within 5 % of its step after, s"
    loops = [
        ["settling time Ts, s", "set by the user, not printed", number(back["Ts"]), "3/KIP"],
        ["capacitance J, s", "not printed", number(back["J"]), f"KPVDC Ts/6; C1 + C2 of the link is {total}"],
        ["damping z", "not printed", f"{back['damping']:.4f}", "3/(Ts sqrt(KIVDC/J))"],
        ["wn of the dc voltage mode, rad/s", "-", number(mode_["wn"]), f"3/(0.7 Ts) = {wn}; the link also has a line"],
        ["its damping", "-", number(mode_["damping"]), "0.7"],
        [f"P2 {within}", "-", number(settled["P"]), "Ts"],
        [f"Q1 {within}", "-", number(settled["Q"]), "Ts"],
        [f"Vdc1 {within}", "-", number(settled["Vdc"]), "near Ts, although the PI's zero causes an overshoot first"],
    ]
    for n, known in AUTHORS_GAINS.items():
        here = number(values["gains, authors' rating"][n], 6)
        loops.append([f"{n}, the authors' 1000 MVA link, J = {AUTHORS['J']} s", str(known), here, "the rule again"])
    return {
        "gains": markdown(["gain", "paper", "here, from J and Ts", "why"], rows),
        "loops": markdown(["", "paper", "here", "reason or source"], loops),
    }


def draw(values: Mapping[str, Any]) -> Any:
    """Draw the three controlled quantities after their steps, with the 5 % band and Ts."""
    from hvdc_ident.report.drawing import figure

    fig = figure(11, 3.2)
    for axes, (kind, c) in zip(fig.subplots(1, 3), paper.CONTROLLERS.items(), strict=True):
        e = paper.step(kind, paper.LINK, [FOLLOWS[kind]])
        done = (e.measured[FOLLOWS[kind]] - c.before) / (c.after - c.before)
        axes.axhspan(1 - BAND, 1 + BAND, color="0.9")
        axes.axvline(1e3 * values["design"]["Ts"], color="#d08020", linestyle=":", label="Ts")
        axes.axvline(1e3 * values["settling, s"][kind], color="0.5", linestyle="--", label="stays within 5 %")
        axes.plot(1e3 * (e.time - paper.EVENT), done, color="#1f5fa8", label=FOLLOWS[kind])
        title = f"{c.setpoint} {c.before:g} to {c.after:g} pu"
        axes.set(xlim=(-20, 400), xlabel="time after the step, ms", title=title)
        axes.legend(fontsize=8)
    fig.axes[0].set_ylabel("share of the step")
    return fig


if __name__ == "__main__":
    args = ending.arguments(__doc__)
    sys.exit(ending.ended(HERE, main(), tables, draw, pin=args.pin))
