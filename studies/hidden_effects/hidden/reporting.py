"""The summary of all cases as Markdown."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from hidden.judging import OUTCOMES


def report(found: Mapping[str, Any]) -> str:
    """Return the summary as Markdown."""
    sizes = {"all": found["sizes"]["all"], **found["sizes"]["by_effect"]}
    parts = [
        f"Cases: {', '.join(f'{n} {p}' for p, n in found['cases'].items())}; "
        f"{found['unreachable']} designs that no place could hold.",
        _table("Single effects by size (units)", found["outcomes_by_size"], OUTCOMES),
        "Size 10 and above: " + _said(found["large"]),
        "Pairs: " + _said(found["pairs"]),
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
        f"{shares['cases']} cases, right or covered {shares['right_or_covered']:.1%}, wrong names "
        f"{shares['wrong_names']:.1%} (upper limit {shares['wrong_names_limit']:.1%})"
    )


def _plain(values: Any) -> str:
    if isinstance(values, Mapping):
        return ", ".join(f"{k} {_plain(v)}" for k, v in values.items()) or "none"
    return f"{values:.3g}" if isinstance(values, float) else str(values)


def _table(title: str, rows: Mapping[str, Mapping[str, Any]], columns: Sequence[str]) -> str:
    head = f"| {title} | " + " | ".join(columns) + " |\n|" + "---|" * (len(columns) + 1)
    body = [f"| {name} | " + " | ".join(_plain(row.get(c, "")) for c in columns) + " |" for name, row in rows.items()]
    return "\n".join([head, *body])
