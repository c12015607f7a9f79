"""The outcome of one case: named and true effects and insertion points, or a named and a true value."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hidden.plants import PLANTS

Line = Mapping[str, Any]
SAME_NAME = ({"coupling", "droop"}, {"lag", "inductance"})
"""Effects that are one equation: a droop is a coupling with the other sign, an inductance over R a lag of L/R."""
SUMS: Mapping[str, Sequence[set[str]]] = {
    "station": ({"Pref", "Pm", "err"}, {"E", "V"}),
    "drive": ({"wref", "wm", "err"}, {"torque", "friction", "load"}, {"v", "emf"}),
    "machine": ({"Vref", "Vm", "err"}, {"Pref", "order"}),
    "converter": (
        {"Pref", "erp"}, {"Qref", "err"}, {"idref", "erd"}, {"iqref", "erq"}, {"xd", "vcd"}, {"xq", "vcq"}, {"xl", "wl"},
    ),
    "hydro": ({"Pref", "perm", "temp", "err"},),
    "park": ({"Vref", "Vc", "verr"}, {"xv", "Qcmd"}, {"Qt", "qerr"}, {"Vcmd", "vterr"}, {"Pref", "fdb", "perr"}, {"xp", "Pcmd"}),
}  # fmt: skip
"""Slots that only enter one sum together: what is added at one might as well be added at another."""
ONLY_RECORDED: Mapping[str, Sequence[str]] = {"machine": ("Qe",), "converter": ("V", "df")}
"""Signals that nothing reads but the output of the same name: every effect at one is the same at the other."""
ONE_SOURCE: Mapping[str, Sequence[set[str]]] = {"machine": ({"w", "dw"},), "hydro": ({"w", "dw"},)}
"""Signals that differ by a constant, which the steady state takes up: what one brings in, so does the other."""
CLOSE = 0.05
"""Share of the true value by which an estimate may be off, whatever its interval."""
ADDED = ("offset", "disturbance", "coupling", "droop", "conductance", "loss")


def same_effect(a: str, b: str) -> bool:
    """Return True if two names stand for one equation."""
    return a == b or any({a, b} <= group for group in SAME_NAME)


def same_place(plant: str, effect: str, a: str, b: str) -> bool:
    """Return True if an effect is the same at both insertion points."""
    if any({a, b} == {signal, f"outputs.{signal}"} for signal in ONLY_RECORDED.get(plant, ())):
        return True
    return a == b or (effect in ADDED and any({a, b} <= group for group in SUMS[plant]))


def is_truth(line: Line, truth: Line, told: Line, place: bool = True) -> bool:
    """Return True if the reported effect (effect, at, from) is the hidden one."""
    if not same_effect(truth["effect"], told["effect"]):
        return False
    if not place:
        return True
    sources = {truth.get("source") or "", told.get("from") or ""}
    one_source = len(sources) == 1 or any(sources <= group for group in ONE_SOURCE.get(line["plant"], ()))
    one_slot = len(told["at"]) == 1 and same_place(line["plant"], truth["effect"], truth["at"], told["at"][0])
    return one_slot and one_source


def outcome(line: Line) -> str:
    """Return the outcome of one case with an effect.

    right: named, effect and place. covered: the truth is in the ambiguity set. place: the effect is right, its place is
    not (and not in the set). wrong: another effect is named, or one beside the right ones. ambiguous: a set without the
    truth. abstained: nothing is named. failed: no diagnosis. A pair is right if both are.
    """
    if "failed" in line:
        return "failed"
    truths, found = line["truth"], line["found"]
    sets = [r for group in line["ambiguity"] for r in group] + [m for f in effects_found(line) for m in members(f)]
    if line["verdict"] not in ("named", "ambiguous"):
        return "abstained"
    if (
        line["verdict"] == "named"
        and len(found) == len(truths)
        and all(any(is_truth(line, t, f) for f in found) for t in truths)
    ):
        return "right"
    if all(any(is_truth(line, t, told) for told in (*found, *sets)) for t in truths) and len(found) <= len(truths):
        return "covered"
    if line["verdict"] == "ambiguous":
        return "ambiguous"
    if all(any(is_truth(line, t, f, place=False) for t in truths) for f in found):
        return "place"
    return "wrong"


def effects_found(line: Line) -> list[Line]:
    """Return the findings that are effects; none from a room without findings, or where a parameter explains the gap."""
    return [f for f in line.get("findings", []) if f["effect"] != "parameter"]


def members(finding: Line) -> list[Line]:
    """Return what a finding stands for: each of its names at each of its likely places."""
    names = list(dict.fromkeys((finding["effect"], *finding["same_as"])))
    return [{"effect": n, "at": p["at"], "from": p.get("from", "")} for n in names for p in finding["places"]]


def named(line: Line) -> bool:
    """Return True if every hidden effect is named and no other, each at any insertion point."""
    if "failed" in line or line["verdict"] != "named":
        return False
    told = effects_found(line)
    groups = [{f["effect"], *f["same_as"]} for f in told] or [{f["effect"]} for f in line["found"]]
    truths = [t["effect"] for t in line["truth"]]

    def meets(group: set[str], effect: str) -> bool:
        return any(same_effect(name, effect) for name in group)

    all_found = all(any(meets(g, t) for g in groups) for t in truths)
    return all_found and all(any(meets(g, t) for t in truths) for g in groups) and len(groups) == len(truths)


def value_outcome(line: Line) -> str:
    """Return the outcome of one case in which the card states a value wrong.

    named: it is named, and nothing beside it. beside: it is named, and an effect or another value too. covered: it is among what
    is told as likely. wrong: something is named, and it is not among it. abstained: nothing of these. failed: no diagnosis.
    A fitted parameter that is told to be off its start is no other value: it is off in every case.
    """
    if "failed" in line:
        return "failed"
    name = line["value"]["name"]
    if line["verdict"] not in ("named", "ambiguous"):
        return "abstained"
    findings = _values_found(line)
    told = {n for f in findings for n in f["parameters"]} - set(PLANTS[line["plant"]].fitted)
    if line["verdict"] == "named" and name in told:
        return "named" if told == {name} and not effects_found(line) else "beside"
    sets = [r["at"] for group in line["ambiguity"] for r in group if r["effect"] == "parameter"]
    if name in told or any(name in at for at in (*sets, *(p["at"] for f in findings for p in f["places"]))):
        return "covered"
    return "wrong" if line["verdict"] == "named" else "abstained"


def value_estimated(line: Line) -> bool:
    """Return True if the value that is named is right: the truth is in its 95 % interval, or it is off by CLOSE at most."""
    name, true = line["value"]["name"], float(line["value"]["true"])
    told = next(f["parameters"][name] for f in _values_found(line) if name in f["parameters"])
    if abs(told["value"] - true) <= CLOSE * abs(true):
        return True
    if told["ci95"] is None:
        return False
    low, high = told["ci95"]
    return (low is None or bool(low <= true)) and (high is None or bool(true <= high))


def _values_found(line: Line) -> list[Line]:
    """Return the findings that are values that are off."""
    return [f for f in line.get("findings", []) if f["effect"] == "parameter"]
