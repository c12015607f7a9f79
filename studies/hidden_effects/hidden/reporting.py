"""The summary of all cases as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hidden.judging import OF_VALUES, OUTCOMES


def report(found: Mapping[str, Any]) -> str:
    """Return the summary as Markdown."""
    sizes = {"all": found["sizes"]["all"], **found["sizes"]["by_effect"]}
    parts = [
        f"Cases: {', '.join(f'{n} {p}' for p, n in found['cases'].items())}; "
        f"{found['unreachable']} designs that no place could hold.",
        _table("Single effects by size (units)", found["outcomes_by_size"], OUTCOMES),
        "Size 10 and above: " + _said(found["large"]),
        "Pairs: " + _said(found["pairs"]),
        "Three effects: " + _said(found["triples"]),
        *_by_plant(found["by_plant"]),
        *_calibration(found["calibration"]),
        _table("Size 10 and above, by noise", found["by_noise"], ("cases", *OUTCOMES)),
        _table("by excitation", found["by_excitation"], ("cases", *OUTCOMES)),
        _table("with a channel removed", found["by_channels"], ("cases", *OUTCOMES)),
        _table("by effect", found["by_effect"], OUTCOMES),
        "Confusion (hidden: named or verdict)\n"
        + "\n".join(
            f"- {e}: " + ", ".join(f"{k} {n}" for k, n in row.items()) for e, row in found["confusion"].items()
        ),
        f"Ambiguity sets: {_plain(found['ambiguity'])}",
        f"Clean cases: {_plain({k: v for k, v in found['clean'].items() if k != 'by_noise'})}",
        _table(
            "Clean cases by noise",
            found["clean"]["by_noise"],
            ("cases", "false_names", "limit", "evidence_without_name"),
        ),
        f"Outside the catalogue: {_plain(found['outside'])}",
        f"Left out of the search: {_plain(found['left_out'])}",
        *_values(found["values"]),
        f"Localisation: {_plain(found['location'])}",
        _table(
            "Sizes, of what was named rightly", sizes, ("cases", "median_error", "median_absolute_error", "coverage")
        ),
        f"Held-out shrink: {_plain(found['held_out'])}",
        _table("Baselines", found["baselines"], ("right", "wrong_effect", "false_names", "outside_names")),
        f"Sparse law for the residual (pysindy): {_plain(found['sindy'])}",
        f"Seconds a diagnosis: {_plain(found['seconds'])}",
    ]
    return "\n\n".join(parts) + "\n"


def _said(shares: Mapping[str, Any]) -> str:
    if not shares["cases"]:
        return "none"
    return (
        f"{shares['cases']} cases, right or covered {shares['right_or_covered']:.1%}, named {shares['named']:.1%}, wrong names "
        f"{shares['wrong_names']:.1%} (upper limit {shares['wrong_names_limit']:.1%})"
    )


def _by_plant(found: Mapping[str, Any]) -> list[str]:
    """Return the tables by plant and cleanliness of the records."""
    shares = ("cases", "right_or_covered", "named", "wrong_names", "wrong_names_limit", *OUTCOMES)

    def of(part: str) -> dict[str, Any]:
        return {room: row[part] for room, row in found.items() if row[part] and row[part].get("cases", 1)}

    return [
        _table("Size 10 and above, by plant and records", of("large"), (*shares, "places")),
        _table("Pairs, by plant and records", of("pair"), shares),
        _table("Three effects, by plant and records", of("triple"), shares),
        _table("Clean cases, by plant and records", of("clean"), ("cases", "named", "limit", "evidence_without_name")),
        _table("Outside, by plant and records", of("outside"), ("cases", "confident_wrong_names", "limit")),
        _table("Seconds a diagnosis, by plant and records", of("seconds"), ("5 %", "median", "95 %", "largest")),
    ]


def _values(found: Mapping[str, Any]) -> list[str]:
    """Return the table of values that the card states wrong; none without such cases."""
    if not found["by_plant"]:
        return []
    rows = {"all tidy": found["all"], **found["by_plant"]}
    shown = {
        name: row | {f"cpu, {q}": v for q, v in (row["cpu"] or {}).items() if q in ("median", "largest")}
        for name, row in rows.items()
    }
    shares = ("named_or_covered", "wrong_names", "wrong_names_limit", "estimated")
    return [
        _table(
            "Values stated wrong, by plant and records",
            shown,
            ("cases", *OF_VALUES, *shares, "cpu, median", "cpu, largest", "verdicts"),
        )
    ]


def _calibration(found: Mapping[str, Any]) -> list[str]:
    """Return the tables of stated probabilities; none from a room that states none."""
    if not any(row["findings"] for row in found["bins"].values()):
        return []
    columns = ("findings", "stated", "right", "limits", "placed")
    sure = {"all": found["sure"], **found["sure_by_plant"]}
    return [
        _table("Effects found, by stated probability", found["bins"], columns),
        _table("Effects found, said with at least 95 %", sure, columns),
    ]


def _plain(values: Any) -> str:
    if isinstance(values, Mapping):
        return ", ".join(f"{k} {_plain(v)}" for k, v in values.items()) or "none"
    if isinstance(values, tuple | list):
        return " to ".join(map(_plain, values))
    return f"{values:.3g}" if isinstance(values, float) else str(values)


def _table(title: str, rows: Mapping[str, Mapping[str, Any]], columns: Sequence[str]) -> str:
    head = f"| {title} | " + " | ".join(columns) + " |\n|" + "---|" * (len(columns) + 1)
    body = [f"| {name} | " + " | ".join(_plain(row.get(c, "")) for c in columns) + " |" for name, row in rows.items()]
    return "\n".join([head, *body])
