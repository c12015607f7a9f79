"""The list of studies with their headline numbers from expected.json: studies/README.md.

python studies/index.py            # writes the list
A study is listed if it has a README; one without a headline here is listed under its README's title.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE))
from common import paper  # noqa: E402
from common.ending import number  # noqa: E402

from hvdc_ident.files import write_text  # noqa: E402

HEAD = """\
# Studies

Each folder has one command, `python studies/NAME/run.py`, its numbers in `expected.json` (checked by `tests/studies`), and a
README that states what was done, what the paper reports, and why the two differ. `--pin`, where it exists, writes the computed
numbers into the folder. The reference waveforms come from the average-value link, a substitute for EMTP-RV. This list is written
by `python studies/index.py`.

"""


RESISTANCES = 2 * 0.267 / 409.6
"""Of both stations' dc sides in the authors' model, pu."""


def _mean(values: dict[str, Any], mode: str, gain: str) -> str:
    v = np.array(values[mode][gain])
    return f"{number(v.mean(), 3)} ± {number(v.std(ddof=1), 2)}"


def _table_1(e: dict[str, Any]) -> str:
    d, g = e["values"]["design"], e["values"]["gains"]
    return f"J = {d['J']:g} s and Ts = {d['Ts']:g} s give KPVDC {g['KPVDC']:.0f}, KIVDC {g['KIVDC']:.1f} and KIP = KIQ = 30"


def _table_2(e: dict[str, Any]) -> str:
    own, avm = (e["values"][d]["all three"] for d in ("the link itself", "the average-value link"))
    return (
        f"{own['to the optimum']} of {own['starts']} starts find the true gains on the link's own waveforms; "
        f"{avm['to the optimum']} of {avm['starts']} end at KIVDC {number(avm['optimum']['KIVDC'], 3)} on the "
        "average-value link's"
    )


def _table_3(e: dict[str, Any]) -> str:
    v = e["values"]
    theirs = paper.TABLE_3["KIVDC"]
    return (
        f"KIVDC {_mean(v, 'individual', 'KIVDC')} individually and {_mean(v, 'simultaneous', 'KIVDC')} simultaneously "
        f"(paper {theirs['II']['mean']:.0f} ± {theirs['II']['std']:.2g}, {theirs['SI']['mean']:.0f} ± "
        f"{theirs['SI']['std']:.2g}; true {paper.TABLE_1['KIVDC']}), KIP {_mean(v, 'individual', 'KIP')} (paper 31.49)"
    )


def _table_4(e: dict[str, Any]) -> str:
    v, theirs = e["values"]["Irorder1"], paper.TABLE_4["Irorder1"]
    return (
        f"RMSE of Irorder1 {number(v['upper II'], 2)} with fitted gains, {number(v['EMTP'], 2)} with the true ones "
        f"(paper {theirs['upper II']}, {theirs['EMTP']})"
    )


def _figure_5(e: dict[str, Any]) -> str:
    found = e["values"]["Vdc"]["estimates"]
    gains = ", ".join(f"{n} {number(v['value'])}" for n, v in found.items())
    return f"four study files; the one for Vdc gives {gains}"


def _figure_6(e: dict[str, Any]) -> str:
    v = e["values"]["KPVDC"]
    return f"KPVDC has two peaks: {number(np.mean(v['step']))} from steps, {number(np.mean(v['ramp']))} from ramps"


def _figure_7(e: dict[str, Any]) -> str:
    shares = [r["upper"] / r["test"] for o in e["values"]["rmse"].values() for r in o.values()]
    return (
        f"with fitted gains {number(100 * min(shares), 2)} to {number(100 * max(shares), 2)} % of the test values' RMSE"
    )


def _figure_8(e: dict[str, Any]) -> str:
    line = e["rmse"]["vdc-step"]
    ours = ", ".join(str(line[k]) for k in ("550.0", "850.0", "950.0"))
    return f"RMSE of Irorder1 {ours} at KIVDC 550, 850, 950 (paper .0053, .0033, .0036); identifiable all the same"


def _figure_9(e: dict[str, Any]) -> str:
    line = e["rmse"]["vdc-step"]
    return f"RMSE {line['250.0']} at 250, {line['850.0']} at 850, {line['1500.0']} at 1500: no negligible impact"


def _plain(e: dict[str, Any]) -> str:
    cases = {case: ", ".join(f"{n} {v:g}" for n, v in gains.items()) for case, gains in e["gains"].items()}
    return "; ".join(f"{case} {gains}" for case, gains in cases.items())


def _modes(e: dict[str, Any]) -> str:
    v = e["vsc-hvdc-avm"]
    return f"each filtered measurement has a delay of {v['measurement_ms']} ms; dc voltage control at {v['dc voltage control Hz']} Hz"


def _software(e: dict[str, Any]) -> str:
    v = e["rmse_%"]
    return (
        f"RMSE against Dymola {v['P2']} % (P), {v['Irorder2']} % (Id_ref), {v['Vdc1']} % (Vdc) of each signal's range"
    )


def _dymola(e: dict[str, Any]) -> str:
    g = e["gains fitted"]
    return f"KIP {g['KIP']:.2f} (true 30), KPVDC {g['KPVDC']:.2f} (9.6), KIVDC {g['KIVDC']:.1f} (293.9)"


def _coverage(e: dict[str, Any]) -> str:
    p = e["parameters"]
    return f"{100 * p['KPVDC']['coverage']:.1f} % (KPVDC) and {100 * p['KIVDC']['coverage']:.1f} % (KIVDC) of {e['runs']} runs"


def _why(e: dict[str, Any]) -> str:
    p, parts = e["values"]["planted"], e["values"]["parts off, without filters"]
    moved = ", ".join(f"{n} {number(p['plain link'][n])}" for n in ("KIP", "KPVDC", "KIVDC"))
    back = ", ".join(f"{p['with the lag'][n]:.1f}" for n in ("KIP", "KPVDC", "KIVDC"))
    inner = number(parts["inner current loop's time"]["KIVDC"])
    (finer,) = e["values"]["finer"]
    found = e["values"]["put in"][finer]
    plain, named = (max(abs(found[k][n] / paper.TABLE_1[n] - 1.0) for n in found[k]) for k in ("refitted", "augmented"))
    return (
        f"a lag of 1.6 ms that the model lacks gives {moved}, in the model {back}; without filters and inner loop KIVDC is "
        f"{inner}; with the effects that `diagnose` finds if a twentieth of the noise is relevant, the gains are at most "
        f"{100 * named:.1f} % off Table I (plain link {100 * plain:.0f} %)"
    )


def _missing(e: dict[str, Any]) -> str:
    told, cases = e["values"]["told nothing"], e["values"]["refits"]
    drop, late = told["findings"][:2]
    (share,) = drop["parameters"].values()
    before, after = (cases[c]["values"]["KIVDC"] for c in ("fitted", "with the findings"))
    return (
        f"the dc voltage of station 2 is {number(abs(share['value']), 3)} pu per pu lower than the model's (the card "
        f"has {number(RESISTANCES, 3)} pu too much between the terminals), its power {1e3 * late['equivalent_delay']['value']:.1f} ms "
        f"late; with both KIVDC is {number(after)} instead of {number(before)} (true 293.9)"
    )


def _tools(e: dict[str, Any]) -> str:
    v = e["values"]
    card, bare = v["as described"]["Dynawo"]["Vdc step"]["Ip1"], v["Dynawo without the measurement"]["Vdc step"]["Ip1"]
    found = {part: v["named"][part]["effects"][0]["parameters"] for part in v["named"]}
    lag = found["10 ms measurement of the dc voltage"]
    late = 1e3 * (lag["T2"]["value"] - lag["T1"]["value"])
    droop = -found["droop of the ac voltage controls"]["k"]["value"]
    slew = found["slew of the power set-point"]["rate"]["value"]
    return (
        f"the card follows Eurostag, and Dynawo's dc voltage step only without the 10 ms measurement (RMSE of the current "
        f"{1e3 * card:.0f}e-3 with, {1e3 * bare:.0f}e-3 without); `diagnose` finds removed parts in Eurostag's record: "
        f"{late:.1f} ms (described 10), a droop of {droop:.4f} (0.1316), a slew of {slew:.4f} pu/s (0.0833)"
    )


def _optimisers(e: dict[str, Any]) -> str:
    m = e["methods"]
    own, swarm = m["trust-region"]["evaluations"], m["particle-swarm"]["evaluations"]
    return f"the same optimum from all {len(m)}; {own} evaluations with exact sensitivities, {swarm} for the particle swarm"


def _units(e: dict[str, Any]) -> str:
    units = e["effects"].values()
    found = sum(u.get("effect") in ("named", "covered") for u in units)
    near = sum(u.get("parameter") in ("found", "near") for u in units)
    seconds = [u["cpu_seconds"] for u in units]
    others = [u.get(outcome) for n, outcome in (("cards", "card"), ("values", "named")) for u in e[n].values()]
    told = sum(o in ("named", "covered") for o in others)
    return (
        f"of {len(units)} units, the effect is named or among the likely ones for {found}, the wrong parameter within its interval "
        f"or 5 % for {near}; {number(np.median(seconds), 2)} s of CPU each (median); of {len(others)} with another card or a wrong value "
        f"that is not asked about, that is named or among the likely ones for {told}"
    )


HEADLINES: dict[str, tuple[str, Callable[[dict[str, Any]], str]]] = {
    "software_to_software": ("Fig. 3: can the reference be trusted?", _software),
    "table_1": ("Table I: six gains from two numbers", _table_1),
    "table_2": ("Table II: bounds and start values of the fits", _table_2),
    "figure_5": ("Fig. 5: the set-up of a fit", _figure_5),
    "table_3": ("Table III: 30 experiments, fitted one by one and together", _table_3),
    "figure_6": ("Fig. 6: the histograms of Table III", _figure_6),
    "table_4": ("Table IV: errors with the fitted gains", _table_4),
    "figure_7": ("Fig. 7: the waveforms with the fitted gains", _figure_7),
    "figure_8": ("Fig. 8: does KIVDC matter from 550 to 950?", _figure_8),
    "figure_9": ("Fig. 9: and from 250 to 1500?", _figure_9),
    "plain_link_on_avm": ("How the gains compensate for a missing delay", _plain),
    "why_table_3_is_biased": ("Why the gains of Table III differ from Table I", _why),
    "avm_modes": ("The modes of the average-value link", _modes),
    "dymola_waveform": ("The phasor link on Dymola's waveforms", _dymola),
    "dymola_missing": ("What the phasor link lacks on Dymola's waveforms", _missing),
    "two_tools_one_link": ("One link in two tools", _tools),
    "optimisers": ("RaPId's optimisers on the link", _optimisers),
    "units_by_andes": ("Units from a vendor's .dyr and andes' records", _units),
    "profile_coverage": ("Coverage of the profile likelihood interval", _coverage),
}


def row(name: str) -> str:
    """Return the row of one study; without a headline here, the title of its README."""
    folder = HERE / name
    if name in HEADLINES:
        title, headline = HEADLINES[name]
        found = headline(json.loads((folder / "expected.json").read_text(encoding="utf-8")))
    else:
        title = (folder / "README.md").read_text(encoding="utf-8").splitlines()[0].lstrip("# ")
        found = "see the page"
    return f"| [{name}]({name}) | {title} | {found} |"


def folders() -> list[str]:
    """Return the studies that have a README, those with a headline first."""
    found = sorted(p.parent.name for p in HERE.glob("*/README.md"))
    return [n for n in HEADLINES if n in found] + [n for n in found if n not in HEADLINES]


def text() -> str:
    """Return the list as Markdown."""
    rows = ["| study | what | headline |", "| --- | --- | --- |", *(row(n) for n in folders())]
    return HEAD + "\n".join(rows) + "\n"


if __name__ == "__main__":
    write_text(HERE / "README.md", text())
    print(text())
