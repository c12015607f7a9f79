"""The letter: one page to the owner of a model, made from the results alone, and the first part of the report's page.

What is missed, what that is consistent with, whether the gains are to blame, what adding the effect gains on data it
was not fitted to, what to record to be sure, and what is attached.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from hvdc_ident.errors import InputError
from hvdc_ident.files import write_text
from hvdc_ident.report.html import text
from hvdc_ident.report.results import Results
from hvdc_ident.text import form_of, listed, span

FILE = "letter.html"
STAGE = "discrepancy"


@dataclass(frozen=True)
class Letter:
    """The letter's sentences, in order, as plain text, and the curves of its slider, if any."""

    sentences: tuple[str, ...]
    attached: tuple[str, ...]
    sizes: dict[str, Any] | None


def letter_of(results: Results) -> Letter:
    """The letter of a folder of results. Raises InputError where no diagnosis has run."""
    found = results.get(STAGE)
    if not found or "verdict" not in found:
        raise InputError(
            "there is no diagnosis to write a letter about",
            where=str(results.folder),
            expected=f"{STAGE}.json",
            hint="hvdc-ident diagnose STUDY",
        )
    sentences = (_missed(results, found), _consistent(found), _gains(found), _gained(found), _next(found))
    return Letter(tuple(s for s in sentences if s), tuple(_attached(results, found)), found.get("sizes"))


def letter_body(letter: Letter) -> str:
    """The letter as HTML: its sentences, the figure with its slider, what is attached."""
    told = "".join(f"<p>{text(s)}</p>" for s in letter.sentences)
    attached = f"<p>Attached: {text(', '.join(letter.attached))}.</p>" if letter.attached else ""
    return f'<div class="letter">{told}{attached}</div>'


def write_letter(folder: Path) -> Path:
    """The path of letter.html in a folder of results, written from what the folder holds."""
    from hvdc_ident.report.page import document

    results = Results(folder)
    heading = results.get(STAGE) or results.heading
    title = f"Model {heading.get('model', '')}: what the recordings say"
    letter = letter_of(results)
    return write_text(folder / FILE, document(title, text(str(heading.get("study", ""))), letter_body(letter)))


def _missed(results: Results, found: dict[str, Any]) -> str:
    """Sentence on the largest error of the model with its nominal gains: as a share of the signal's swing or, where no record
    of it is at hand, as a multiple of its noise."""
    gap = found.get("gap") or {}
    noise = gap.get("noise_floor") or {}
    missed = [
        (output, experiment, rmse)
        for line in (gap.get("nominal") or {}).values()
        for output, errors in line.items()
        for experiment, rmse in errors.items()
        if rmse is not None and rmse >= 2.0 * (noise.get(output) or 0.0)  # less than that is noise
    ]
    if not missed:
        return "With the gains it came with, your model follows every recorded signal to within twice its noise."
    shares = [(m[2] / swing, m) for m in missed if (swing := _swing(results, *m[:2]))]
    times = [(m[2] / floor, m) for m in missed if (floor := noise.get(m[0]))]
    most, (output, experiment, rmse) = max(shares or times or [(m[2], m) for m in missed])
    how = ""
    if shares:
        how = f"by {100 * most:.2g} % of all that it does there "
    elif times:
        how = f"by {most:.3g} times its noise "
    return (
        f"With the gains it came with, your model misses {output} in experiment '{experiment}' {how}(RMSE {rmse:.3g} "
        f"{results.units.get(output, '')}), more than any other recorded signal."
    ).replace(" )", ")")


def _swing(results: Results, output: str, experiment: str) -> float | None:
    """Peak-to-peak value of a recorded signal in an experiment, in its unit; None where it is not recorded."""
    for stage in ("simulation", "fit"):
        table = results.table(f"{stage}.{experiment}.csv")
        if table is not None and f"{output}.measured" in table:
            record = table[f"{output}.measured"]
            return float(np.nanmax(record) - np.nanmin(record))
    return None


def _consistent(found: dict[str, Any]) -> str:
    """Sentences on what the difference is consistent with: the named effect, and those the data cannot tell from it."""
    verdict, effects = found["verdict"], found.get("effects") or []
    if verdict == "no-evidence":
        return f"Beyond the gains nothing is missing that these recordings could show. {found.get('text', '')}".strip()
    if not effects:
        return str(found.get("text", ""))
    told = [" ".join([e["text"].rstrip("."), _interval(e)]).strip() for e in effects]
    first = f"The difference is consistent with this: {'; and '.join(told)}."
    own = [(e["effect"], e["at"], e.get("from", "")) for e in effects]
    rivals = [r for group in found.get("ambiguity") or [] for r in group]
    names = list(
        dict.fromkeys(
            f"{form_of(r)} at {listed(r['at'])}" for r in rivals if (r["effect"], r["at"], r.get("from", "")) not in own
        )
    )
    if names:
        more = f" and {len(names) - 5} more" if len(names) > 5 else ""
        first = f"{first} The recordings cannot tell it from: {'; '.join(names[:5])}{more}.{_in_common(found)}"
    elif found.get("doubt"):
        they = "They" if len(effects) > 1 else "It"
        first += f" {they} may stand for something that none of those tried is: {found['doubt']}."
    else:
        first += " No other effect of the catalogue, and no other place, explains the recordings as well."
    if not found.get("doubt") and not (found.get("remaining") or {}).get("adequate", True):
        first += " It is not all that is missing: with it the residuals are still not noise."
    return first


def _in_common(found: dict[str, Any]) -> str:
    """Sentence on the delay of a slow signal that all effects of the only ambiguous set have in common; empty without one."""
    groups = found.get("ambiguity") or []
    late = [r.get("late") for group in groups for r in group if r.get("refitted", True)]
    if len(groups) != 1 or len(late) < 2 or any(v is None or v <= 0.0 for v in late):
        return ""
    return f" Whichever it is, a slow signal is late by between {span(min(late), max(late), 's', 3)}."


def _interval(effect: dict[str, Any]) -> str:
    parts = []
    for name, size in effect["parameters"].items():
        low, high = size.get("ci95") or (None, None)
        if low is not None and high is not None:
            parts.append(f"{name} between {span(low, high, size.get('unit') or '')}")
    return f"({', '.join(parts)}, 95 %)" if parts else ""


def _gains(found: dict[str, Any]) -> str:
    """Sentences on the gains: how far a fit moves them without the effect, and how far with it."""
    given, without, after = (found.get(f"parameters_{k}") or {} for k in ("before", "refitted", "after"))
    moved = {
        n: (without[n] / g - 1.0, after[n] / g - 1.0) for n, g in given.items() if g and n in without and n in after
    }
    if not moved:
        return ""
    name = max(moved, key=lambda n: abs(moved[n][0]))
    alone, with_it = moved[name]
    what = _added(found)
    if found.get("verdict") == "unnameable" and not what:
        return (
            f"Your gains cannot be judged while that is missing: a fit moves {name} by {_percent(alone)}, and how much of it "
            "makes up for what is missing these records do not tell."
        )
    if not what:
        if abs(alone) < 0.02:
            return "Your gains are not to blame: a fit leaves them within 2 % of what you gave."
        return f"Your gains are to blame: fitted, {name} moves by {_percent(alone)}, and that closes the gap as far as it closes."
    if abs(with_it) < 0.5 * abs(alone):
        return (
            f"Your gains are not to blame: a fit without the {what} moves {name} by {_percent(alone)} to make up for it; "
            f"with the {what} the same fit moves it by {_percent(with_it)}."
        )
    return (
        f"Your gains are to blame too: a fit moves {name} by {_percent(alone)} without the {what} and by "
        f"{_percent(with_it)} with it."
    )


def _added(found: dict[str, Any]) -> str:
    """Kind of the addition in the augmented model: "effect", "formula", "filter" or "curve"; empty where nothing was added."""
    if found.get("effects"):
        return "effect"
    kind = (found.get("fallback") or {}).get("kind", "") if found.get("augmented_model") else ""
    return {"term": "formula", "filter": "filter", "curve": "curve"}.get(kind, "")


def _percent(share: float) -> str:
    """A share with its sign in per cent; nothing has no sign."""
    shown = f"{100 * share:+.1f} %"
    return "0.0 %" if shown[1:] == "0.0 %" else shown


def _gained(found: dict[str, Any]) -> str:
    gap = found.get("gap") or {}
    shrink = gap.get("shrink_holdout")
    if shrink is None or not _added(found):
        return ""
    pooled = (gap.get("pooled") or {}).get("augmented") or {}
    left = pooled.get("holdout")
    rest = f"; what is left is {left:.3g} times the noise" if isinstance(left, int | float) else ""
    against = gap.get("held_out", "experiments")
    where = "experiments that no fit has seen" if against == "experiments" else against
    return (
        f"Adding it shrinks the error on {where} by {100 * shrink:.0f} %, "
        f"measured against the same model with its gains fitted and nothing added{rest}."
    )


def _next(found: dict[str, Any]) -> str:
    advice = (found.get("separating_experiment") or {}).get("text")
    if not advice:
        return ""
    several = any(len(group) > 1 for group in found.get("ambiguity") or [])
    start = "To tell them apart" if several else "What would show more"
    return f"{start}: {advice}" + ("" if advice.endswith(".") else ".")


def _attached(results: Results, found: dict[str, Any]) -> list[str]:
    card = found.get("augmented_model")
    names = [str(card), Path(str(card)).with_suffix(".fmu").name] if card else []
    return [n for n in names if (results.folder / n).is_file()]
