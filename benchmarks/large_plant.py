"""Times of a plant of 63 states, beside those of the link.

    python benchmarks/large_plant.py

The plant: three machines, each with exciter, stabiliser and governor, on lines to a common bus with a load, and from there a line to an
infinite bus. All of it are standard components; the units' values are those of tests/plants/cases.toml. A run: 10 s, a step of a reference
at 1 s, 1001 rows, all outputs, default tolerance. Processor time, the least of 15. Nothing of the two models is compiled before their
first runs, apart from what the power flow of the plant needs.
"""

from __future__ import annotations

import os
import tempfile
import tomllib
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scaling import least, spent

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.linearize import find_operating_point, linearize
from hvdc_ident.model import Model, parse_card, read_card
from hvdc_ident.models import load_model
from hvdc_ident.plants import UnitPart, parts_of, unit_card
from hvdc_ident.simulate import simulate

CASES = Path(__file__).resolve().parents[1] / "tests" / "plants" / "cases.toml"
UNITS = {"steam": "sexs", "reheat": "ieeeg1", "hydro": "hygov"}
"""By unit: the case whose governor it has. Machine and stabiliser are those of `ieeest`, the exciter that of `exst1`."""
POWERS = {"steam": 80.0, "reheat": 60.0, "hydro": 70.0}
VOLTAGES = {"steam": 1.02, "reheat": 1.01, "hydro": 1.02}
"""Powers of the units, MW, and their terminal voltages, pu."""
SPEED = {"steam": "Pref", "reheat": "Pref", "hydro": "nref"}
"""The reference of each unit's governor."""
GAINS = ("steam.gen.H", "steam.avr.KA", "steam.pss.KS", "reheat.gov.K", "hydro.gov.R")
UNIT = """schema = 1
name = "unit"

[inputs]
Vr = {{value = 1.0, unit = "pu"}}
Vi = {{value = 0.2, unit = "pu"}}
Vref = {{value = 1.02, unit = "pu"}}
{speed} = {{value = {start}, unit = "pu"}}
{components}
[connections]
"gen.Vr" = "Vr"
"gen.Vi" = "Vi"
"gen.dwn" = "0"
"gen.Efd" = "avr.Efd"
"gen.Pm" = "gov.Pm"
"avr.Vt" = "gen.Vt"
"avr.Vref" = "Vref"
"avr.Vs" = "pss.Vs"
"avr.Voel" = "0"
"avr.Vuel" = "0"
"avr.Ifd" = "gen.Ifd"
"pss.dw" = "gen.dw"
"pss.dwn" = "0"
"pss.Pe" = "gen.Pe"
"pss.Pm" = "gov.Pm"
"pss.Vt" = "gen.Vt"
"gov.dw" = "gen.dw"
"gov.{speed}" = "{speed}"

[outputs]
Ir = "gen.Ir"
Ii = "gen.Ii"
P = {{value = "gen.P", unit = "MW"}}
Q = {{value = "gen.Q", unit = "Mvar"}}
Vt = {{value = "gen.Vt", unit = "pu"}}
dw = {{value = "gen.dw", unit = "pu"}}
"""


def component(name: str, source: str, values: str = "") -> str:
    """Return the lines of a component of a card."""
    return f'\n[components.{name}]\nsource = "{source}"\n' + (f"parameters = {{{values}}}\n" if values else "")


def unit(parts: dict[str, UnitPart], speed: str) -> str:
    """Return the card of a unit between its terminal voltage and its current."""
    values = {n: ", ".join(f"{k} = {float(v)!r}" for k, v in p.values.items()) for n, p in parts.items()}
    components = "".join(component(n, p.source, values[n]) for n, p in parts.items())
    return UNIT.format(speed=speed, start=0.8 if speed == "Pref" else 0.04, components=components)


def plant(folder: Path) -> Model:
    """Return the plant at its power flow. folder: where its cards are written."""
    cases = tomllib.loads(CASES.read_text(encoding="utf-8"))
    shared = parts_of(cases["ieeest"]) | {"avr": parts_of(cases["exst1"])["avr"]}
    lines = ["schema = 1", 'name = "plant"', "", "[inputs]", 'E = {value = 1.0, unit = "pu"}']
    for n, speed in SPEED.items():
        (folder / f"{n}.toml").write_text(unit(shared | {"gov": parts_of(cases[UNITS[n]])["gov"]}, speed), "utf-8")
        lines += [f'{n}_Vref = {{value = 1.02, unit = "pu"}}', f'{n}_{speed} = {{value = 0.5, unit = "pu"}}']
    parts = [
        component("bus", "infinite-bus"),
        component("tie", "line", "R = 0.005, X = 0.1"),
        component("load", "load"),
    ]
    for n in UNITS:
        parts += [component(n, f"{n}.toml"), component(f"{n}_line", "line", "R = 0.01, X = 0.2")]
    lines += [*parts, "[connections]", '"bus.V" = "E"', '"bus.theta" = "0"', '"load.dwn" = "0"']
    for i, start in (("r", 1.0), ("i", 0.1)):
        lines += [f'"tie.V{i}_far" = "bus.V{i}"']
        lines += [f'"tie.I{i}" = "' + " + ".join(f"{n}.I{i}" for n in (*UNITS, "load")) + '"']
        lines += [f'"load.V{i}" = {{value = "tie.V{i}", start = {start}}}']
        for n in UNITS:
            lines += [f'"{n}_line.V{i}_far" = "tie.V{i}"', f'"{n}_line.I{i}" = "{n}.I{i}"']
            lines += [f'"{n}.V{i}" = {{value = "{n}_line.V{i}", start = {start}}}']
    for n, speed in SPEED.items():
        lines += [f'"{n}.Vref" = "{n}_Vref"', f'"{n}.{speed}" = "{n}_{speed}"']
    lines += ["", "[outputs]"]
    lines += [f'{n}_{o} = "{n}.{o}"' for n in UNITS for o in ("P", "Q", "Vt", "dw")]
    (folder / "plant.toml").write_text("\n".join(lines) + "\n", "utf-8")
    return read_card(folder / "plant.toml")


def at_power_flow(model: Model) -> Model:
    """Return the plant with the references that give POWERS and VOLTAGES."""
    asked = {f"{n}_P": POWERS[n] for n in UNITS} | {f"{n}_Vt": VOLTAGES[n] for n in UNITS}
    free = [f"{n}_Vref" for n in UNITS] + [f"{n}_{speed}" for n, speed in SPEED.items()]
    return model.with_values(find_operating_point(model, outputs=asked, free=free).inputs)


def figures(model: Model, stepped: str, by: float, names: Sequence[str]) -> dict[str, float]:
    """Return the processor times of one model, s. stepped, by: the input of the run and its step; names: of the sensitivities."""
    before = model.inputs[stepped].value
    case = experiment("step", np.linspace(0.0, 10.0, 1001), {stepped: InputSignal.step(1.0, before, before + by)})
    row = {"first run": spent(lambda: simulate(model, case))[0]}
    row["run"] = least(lambda: simulate(model, case), 15)
    row["first run, 5 sensitivities"] = spent(lambda: simulate(model, case, sensitivities=names))[0]
    row["run, 5 sensitivities"] = least(lambda: simulate(model, case, sensitivities=names), 15)
    point = find_operating_point(model)
    if not point.stable:
        raise SystemExit(f"'{model.name}' is not stable: the times of its run mean nothing")
    linearize(model, point)
    row["operating point"] = least(lambda: find_operating_point(model), 15)
    row["linear model"] = least(lambda: linearize(model, point), 15)
    steps = simulate(model, case).statistics.accepted
    return {"states": len(model.states), "steps": steps} | row


def warm() -> None:
    """Make the same calls on a single unit."""
    card = unit_card(parts_of(tomllib.loads(CASES.read_text(encoding="utf-8"))["sexs"]), R=0.01, X=0.3, f0=60.0)
    point = find_operating_point(parse_card(card), outputs={"P": 80.0, "Vt": 1.02}, free=["Vref", "Pref"])
    figures(parse_card(card).with_values(point.inputs), "Vref", 0.02, ("gen.H", "avr.K"))


def main() -> None:
    """Print the figures."""
    warm()
    with tempfile.TemporaryDirectory() as folder:
        cpu, _, large = spent(lambda: plant(Path(folder)))
        point, _, large = spent(lambda: at_power_flow(large))
    print(
        f"the plant: read from its cards in {cpu:.3g} s, compiled and its power flow found in {point:.3g} s", flush=True
    )
    rows = {
        "plant": figures(large, "steam_Vref", 0.02, GAINS),
        "link": figures(load_model("vsc-hvdc-link"), "Vdcref1", 0.019, ("KPVDC", "KIVDC", "KPP", "KIP", "KPQ")),
    }
    print(f"load average {os.getloadavg()[0]:.1f}; s of processor time")
    print(f"| | {' | '.join(rows)} |\n|---|{'---|' * len(rows)}")
    for n in rows["plant"]:
        print(f"| {n} | {' | '.join(f'{r[n]:.4g}' for r in rows.values())} |")


if __name__ == "__main__":
    main()
