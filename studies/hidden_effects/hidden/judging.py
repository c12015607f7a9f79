"""Statistics of all cases: named and true effects, sizes, insertion points and held-out misfit."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np

from hidden.kinds import SLOW_STATE
from hidden.outcomes import (
    Line,
    effects_found,
    is_truth,
    members,
    named,
    outcome,
    same_effect,
    value_estimated,
    value_outcome,
)
from hidden.probabilities import calibration, limit_above

MAIN = {
    "lag": "T", "delay": "T", "window-mean": "T", "sample-hold": "Ts", "second-order": "wn", "inner-loop": "wn",
    "lead-lag": "T1", "limit": "level", "saturation": "level", "rate-limit": "rate", "deadband": "width",
    "backlash": "width", "quantisation": "step", "gain": "k", "offset": "c", "coupling": "k", "droop": "k",
    "conductance": "g", "inductance": "L", "disturbance": "amplitude", SLOW_STATE: "up",
}  # fmt: skip
"""The parameter that measures the effect; a limit of a state has one of two."""
OUTCOMES = ("right", "covered", "place", "wrong", "ambiguous", "abstained", "failed")
OF_VALUES = ("named", "covered", "beside", "wrong", "abstained", "failed")
PARTS = ("single", "pair", "clean", "outside", "left-out", "triple", "value")


def summary(lines: Sequence[Line]) -> dict[str, Any]:
    """Return everything that the study reports, as plain numbers.

    Messy records count in `by_plant`, `values` by plant, `calibration` and the numbers of cases only.
    """
    made = [x for x in lines if not x.get("unreachable")]
    tidy = [x for x in made if not x.get("messy")]
    by_part = {p: [x for x in tidy if x["part"] == p] for p in PARTS}
    single = by_part["single"]
    large = [x for x in single if x["size"] >= 10.0]
    return {
        "cases": {p: sum(x["part"] == p for x in made) for p in by_part},
        "unreachable": len(lines) - len(made),
        "seconds": _quantiles([x["seconds"] for x in made]),
        "outcomes_by_size": {
            f"{s:g}": _outcomes([x for x in single if x["size"] == s]) for s in (1.0, 3.0, 10.0, 30.0)
        },
        "large": _shares(large),
        "pairs": _shares(by_part["pair"]),
        "triples": _shares(by_part["triple"]),
        "by_plant": by_plant(made),
        "calibration": calibration(made),
        "by_noise": _by(large, "noise"),
        "by_excitation": _by(large, "excitation"),
        "by_channels": _by(large, "removed"),
        "by_effect": {
            e: _outcomes([x for x in large if x["effects"] == [e]]) for e in sorted({x["effects"][0] for x in large})
        },
        "confusion": _confusion(large),
        "ambiguity": _ambiguity(large),
        "clean": _clean(by_part["clean"]),
        "outside": _strangers(by_part["outside"]),
        "left_out": _strangers(by_part["left-out"]),
        "values": _values(made),
        "location": _location(large),
        "sizes": _sizes(single),
        "held_out": _held_out(large),
        "sindy": _sindy(large, by_part["clean"]),
        "baselines": _baselines(large, by_part["clean"], by_part["outside"]),
    }


def _outcomes(lines: Sequence[Line]) -> dict[str, int]:
    found = Counter(outcome(x) for x in lines)
    return {name: found.get(name, 0) for name in OUTCOMES}


def _shares(lines: Sequence[Line]) -> dict[str, Any]:
    found = _outcomes(lines)
    n = len(lines)
    wrong = found["wrong"]
    return {
        "cases": n,
        **found,
        "named": sum(map(named, lines)) / n if n else None,
        "right_or_covered": (found["right"] + found["covered"]) / n if n else None,
        "wrong_names": wrong / n if n else None,
        "wrong_names_limit": limit_above(wrong, n) if n else None,
    }


def _by(lines: Sequence[Line], key: str) -> dict[str, Any]:
    return {str(v): _shares([x for x in lines if x[key] == v]) for v in sorted({x[key] for x in lines}, key=str)}


def by_plant(lines: Sequence[Line]) -> dict[str, Any]:
    """Return the statistics of large effects, pairs, records without an effect, and strangers, by plant and cleanliness."""
    table: dict[str, Any] = {}
    for plant, messy in sorted({(x["plant"], bool(x.get("messy"))) for x in lines}):
        own = [x for x in lines if x["plant"] == plant and bool(x.get("messy")) == messy]
        parts = {p: [x for x in own if x["part"] == p] for p in PARTS}
        large = [x for x in parts["single"] if x["size"] >= 10.0]
        clean = [x for x in parts["clean"] if "failed" not in x]
        false = sum(x["verdict"] == "named" for x in clean)
        strangers = _strangers(parts["outside"])
        table[f"{plant}, {'messy' if messy else 'tidy'}"] = {
            "large": _shares(large) | {"places": _places(large)},
            "pair": _shares(parts["pair"]),
            "triple": _shares(parts["triple"]),
            "clean": {
                "cases": len(clean),
                "named": false,
                "limit": limit_above(false, len(clean)) if clean else None,
                "evidence_without_name": sum(x["verdict"] in ("ambiguous", "unnameable") for x in clean),
            },
            "outside": {k: strangers[k] for k in ("cases", "confident_wrong_names", "limit")},
            "seconds": _quantiles([x["seconds"] for x in own]),
        }
    return table


def _places(lines: Sequence[Line]) -> float | None:
    """Return the mean number of likely insertion points of the rightly named effects; None without any."""
    counts = [
        len({(tuple(m["at"]), m["from"]) for m in members(f)}) for x in lines if named(x) for f in effects_found(x)
    ]
    return float(np.mean(counts)) if counts else None


def _confusion(lines: Sequence[Line]) -> dict[str, dict[str, int]]:
    """Return by hidden effect the first named effect, or the verdict if nothing was named."""
    table: dict[str, Counter[str]] = {}
    for x in lines:
        if "failed" in x:
            told = "failed"
        elif x["verdict"] == "ambiguous" and outcome(x) == "covered":
            told = "ambiguous, truth in the set"
        elif x["verdict"] == "named" and x["found"]:
            told = x["found"][0]["effect"]
        else:
            told = x["verdict"]
        table.setdefault(x["effects"][0], Counter())[told] += 1
    return {e: dict(sorted(c.items())) for e, c in sorted(table.items())}


def _ambiguity(lines: Sequence[Line]) -> dict[str, Any]:
    """Return, for the cases with an ambiguity set, how often it contains the truth, and its number of members."""
    sets = [(x, x["ambiguity"][0]) for x in lines if "failed" not in x and x["ambiguity"]]
    inside = [any(is_truth(x, x["truth"][0], r) for r in members) for x, members in sets]
    return {
        "sets": len(sets),
        "coverage": float(np.mean(inside)) if sets else None,
        "mean_size": float(np.mean([len(m) for _, m in sets])) if sets else None,
    }


def _clean(lines: Sequence[Line]) -> dict[str, Any]:
    """Return the number of false names, in total and by noise; ambiguous verdicts are counted separately."""
    ran = [x for x in lines if "failed" not in x]

    def row(part: Sequence[Line]) -> dict[str, Any]:
        false = sum(x["verdict"] == "named" for x in part)
        claimed = sum(x["verdict"] in ("ambiguous", "unnameable") for x in part)
        return {
            "cases": len(part),
            "false_names": false,
            "limit": limit_above(false, len(part)) if part else None,
            "evidence_without_name": claimed,
        }

    return {
        **row(ran),
        "failed": len(lines) - len(ran),
        "by_noise": {n: row([x for x in ran if x["noise"] == n]) for n in sorted({x["noise"] for x in ran})},
        "verdicts": dict(Counter(x["verdict"] for x in ran)),
        "unreached_verdicts": dict(Counter(x["verdict"] for x in ran if x["noise"] == "unreached")),
    }


def _strangers(lines: Sequence[Line]) -> dict[str, Any]:
    """Return statistics of cases whose effect the search did not have: a name is wrong unless it is the same equation.

    alike: the wrong names whose fitted model reproduces all three records within a unit of the truth, so that these
    records cannot distinguish them.
    """
    ran = [x for x in lines if "failed" not in x]
    named = [x for x in ran if x["verdict"] == "named" and not any(is_truth(x, x["truth"][0], f) for f in x["found"])]
    alike = [x for x in named if x.get("apart") is not None and x["apart"] < 1.0]
    return {
        "cases": len(ran),
        "failed": len(lines) - len(ran),
        "confident_wrong_names": len(named),
        "share": len(named) / len(ran) if ran else None,
        "limit": limit_above(len(named), len(ran)) if ran else None,
        "alike": len(alike),
        "verdicts": dict(Counter(x["verdict"] for x in ran)),
        "named_as": {
            e: dict(Counter(x["found"][0]["effect"] for x in named if x["effects"][0] == e))
            for e in sorted({x["effects"][0] for x in named})
        },
    }


def _values(lines: Sequence[Line]) -> dict[str, Any]:
    """Return the statistics of values that the card states wrong: of all tidy records, and by plant and cleanliness."""
    own = [x for x in lines if x["part"] == "value"]
    rooms = sorted({(x["plant"], bool(x.get("messy"))) for x in own})

    def row(part: Sequence[Line]) -> dict[str, Any]:
        found, n = Counter(value_outcome(x) for x in part), len(part)
        right = [value_estimated(x) for x in part if value_outcome(x) == "named"]
        return {
            "cases": n,
            **{name: found.get(name, 0) for name in OF_VALUES},
            "named_or_covered": (found["named"] + found["covered"]) / n if n else None,
            "wrong_names": found["wrong"] / n if n else None,
            "wrong_names_limit": limit_above(found["wrong"], n) if n else None,
            "estimated": sum(right) / len(right) if right else None,
            "cpu": _quantiles([x["cpu"] for x in part if "cpu" in x]),
            "verdicts": dict(Counter(x.get("verdict", "failed") for x in part)),
        }

    return {
        "all": row([x for x in own if not x.get("messy")]),
        "by_plant": {
            f"{plant}, {'messy' if messy else 'tidy'}": row(
                [x for x in own if x["plant"] == plant and bool(x.get("messy")) == messy]
            )
            for plant, messy in rooms
        },
    }


def _location(lines: Sequence[Line]) -> dict[str, Any]:
    """Return how often the insertion point is right where the effect is, by itself and within the set."""
    named = [x for x in lines if "failed" not in x and x["verdict"] in ("named", "ambiguous") and x["found"]]
    named = [x for x in named if same_effect(x["truth"][0]["effect"], x["found"][0]["effect"])]
    exact = sum(is_truth(x, x["truth"][0], x["found"][0]) for x in named)
    inside = sum(outcome(x) in ("right", "covered") for x in named)
    n = len(named)
    return {"cases": n, "place": exact / n if n else None, "place_or_in_set": inside / n if n else None}


def _sizes(lines: Sequence[Line]) -> dict[str, Any]:
    """Return, for correctly named effects, the relative error of the size and the coverage of its interval."""
    table: dict[str, list[tuple[float, bool]]] = {}
    for x in lines:
        if "failed" in x or outcome(x) != "right" or len(x["found"]) != 1:
            continue
        effect, found = x["truth"][0]["effect"], x["found"][0]
        name = MAIN.get(effect)
        if name is None or found["effect"] != effect or name not in found["parameters"]:
            continue
        true, told = float(x["truth"][0]["parameters"][name]), found["parameters"][name]
        if not same_sign_place(x):
            continue
        low, high = told["ci95"] or (None, None)
        holds = (low is None or low <= true) and (high is None or true <= high)
        table.setdefault(effect, []).append((told["value"] / true - 1.0, holds))
    everything = [p for rows in table.values() for p in rows]

    def row(pairs: Iterable[tuple[float, bool]]) -> dict[str, Any]:
        rows = list(pairs)
        errors = np.array([e for e, _ in rows])
        return {
            "cases": len(rows),
            "median_error": float(np.median(errors)) if rows else None,
            "median_absolute_error": float(np.median(np.abs(errors))) if rows else None,
            "coverage": float(np.mean([h for _, h in rows])) if rows else None,
        }

    return {"all": row(everything), "by_effect": {e: row(rows) for e, rows in sorted(table.items())}}


def same_sign_place(line: Line) -> bool:
    """Return True if the effect was found at its own insertion point: at the other side of a sum the sign of its size differs."""
    return bool(line["found"][0]["at"] == [line["truth"][0]["at"]])


def _held_out(lines: Sequence[Line]) -> dict[str, Any]:
    """Return the held-out improvement over the refitted nominal model for named effects, and that of the oracle."""
    rows = []
    for x in lines:
        held = x.get("held_out") or {}
        if outcome(x) not in ("right", "covered", "place", "wrong") or None in (
            held.get("refitted"),
            held.get("augmented"),
            held.get("oracle"),
        ):
            continue
        rows.append((1 - held["augmented"] / held["refitted"], 1 - held["oracle"] / held["refitted"]))
    if not rows:
        return {"cases": 0}
    own, oracle = np.array(rows).T
    return {
        "cases": len(rows),
        "shrink_median": float(np.median(own)),
        "oracle_median": float(np.median(oracle)),
        "behind_oracle": _quantiles((oracle - own).tolist()),
        "within_a_tenth": float(np.mean(oracle - own <= 0.1)),
    }


def _baselines(large: Sequence[Line], clean: Sequence[Line], outside: Sequence[Line]) -> dict[str, Any]:
    """Return the results of simpler rules with the same candidates.

    refit only: never names. best score: the candidate with the best score before any refit, if p < 0.01. best BIC:
    the refit with the best BIC if it improves by more than 10, without held-out records or residual tests.
    """

    def rule(name: str, x: Line) -> Line | None:
        best = x.get(name)
        if best is None:
            return None
        sure = best["p"] < 0.01 if name == "best_score" else best["delta_bic"] > 10.0
        return best if sure else None

    found: dict[str, Any] = {"refit only": {"right": 0.0, "wrong_effect": 0.0, "false_names": 0, "outside_names": 0}}
    for name, title in (("best_score", "best score, no refit"), ("best_bic", "BIC, no adequacy test")):
        told = [(x, rule(name, x)) for x in large if "failed" not in x]
        n = max(len(told), 1)
        found[title] = {
            "right": sum(t is not None and is_truth(x, x["truth"][0], t) for x, t in told) / n,
            "wrong_effect": sum(t is not None and not is_truth(x, x["truth"][0], t, place=False) for x, t in told) / n,
            "false_names": sum(rule(name, x) is not None for x in clean if "failed" not in x),
            "outside_names": sum(rule(name, x) is not None for x in outside if "failed" not in x),
        }
    return found


def _sindy(large: Sequence[Line], clean: Sequence[Line]) -> dict[str, Any]:
    """Return the held-out improvement of the sparse law for the residual, with and without a hidden effect (should be 0)."""

    def row(lines: Sequence[Line]) -> dict[str, Any]:
        ran = [x for x in lines if "sindy" in x]
        sound = [x for x in ran if x["sindy"]["augmented"] is not None and x["held_out"]["refitted"]]
        shrinks = [1 - x["sindy"]["augmented"] / x["held_out"]["refitted"] for x in sound]
        return {
            "cases": len(ran),
            "ran_away": len(ran) - len(sound),
            "shrink": _quantiles(shrinks),
            "worse_than_without": float(np.mean(np.array(shrinks) < 0)) if shrinks else None,
        }

    return {"size 10 and above": row(large), "clean": row(clean)}


def _quantiles(values: Sequence[float]) -> dict[str, float] | None:
    if not values:
        return None
    low, middle, high, top = np.quantile(values, [0.05, 0.5, 0.95, 1.0])
    return {"5 %": float(low), "median": float(middle), "95 %": float(high), "largest": float(top)}
