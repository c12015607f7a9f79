"""The letter: one printed page to the owner of a model, made from the results alone.

Who writes to whom about which model; whether it follows the recordings; the values given, fitted and with what it lacks; what
that is and which of the given values the recordings leave out; what the owner is asked to confirm; what to record to be sure;
and a figure of before and after.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hvdc_ident.errors import InputError
from hvdc_ident.files import write_text
from hvdc_ident.report.answers import AT_BOUND, Answers, Errors, Value, added_to, beyond_noise, places_of
from hvdc_ident.report.html import badge, estimate, number, table, text
from hvdc_ident.report.overlay import WORDS, Sheet, overlay_of
from hvdc_ident.report.results import Results
from hvdc_ident.text import (
    figures,
    figures_of,
    form_of,
    interval_text,
    listed,
    percentage,
    quantity,
    span,
    times_text,
    value_by_place,
)

FILE = "letter.html"
STAGE = "discrepancy"
MOVED = 0.02
"""Share of the given value from which on a fitted value is said to differ from it."""
RIVALS = 3
"""Effects and places that are told beside the one in the model."""
MOST_OFF = 4
"""Values that differ from the given ones which are told one by one."""
ASKED = {
    "backlash": "the play of the mechanism",
    "deadband": "the width of the dead band",
    "deadband-step": "the width of the dead band, and whether its output jumps at the edge",
    "delay": "the dead time of sampling, computation and communication",
    "gain": "the scaling",
    "inner-loop": "the bandwidth and damping of the inner control loop",
    "lag": "the time constant of the filter or transducer",
    "lead-lag": "the two time constants of the lead-lag",
    "limit": "the limit",
    "non-windup-limit": "the levels of the limit, and that it acts without windup",
    "offset": "the offset",
    "quantisation": "the resolution of the measurement",
    "rate-limit": "the limit of the rate of change",
    "sample-hold": "the sampling time",
    "saturation": "the level of saturation",
    "servo": "the time constant and the rate limits of the servo",
    "state-rate-limit": "the limits of the rate of change, upwards and downwards",
    "second-order": "the natural frequency and damping of the filter or transducer",
    "window-mean": "the length of the averaging window",
}
"""What a model's owner knows of an effect; of one that is not listed its name is asked for."""


@dataclass(frozen=True)
class Letterhead:
    """Who writes to whom about what; "" where a study does not say.

    author, to: with what belongs to an address. plant: what was recorded. version: of the model. date: as it is to be printed.
    """

    author: str = ""
    to: str = ""
    plant: str = ""
    version: str = ""
    date: str = ""


@dataclass(frozen=True)
class Letter:
    """The letter's sentences, in order, as plain text; the request, and the names of the files that go with it."""

    sentences: tuple[str, ...]
    request: str
    following: str
    attached: tuple[str, ...]


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
    answers = Answers(results)
    sentences = (_missed(answers), _consistent(answers), _values_judged(answers), _gained(found))
    return Letter(tuple(s for s in sentences if s), _request(answers), _next(found), tuple(_attached(results, found)))


def write_letter(folder: Path, head: Letterhead = Letterhead()) -> Path:
    """The path of letter.html in a folder of results, written from what the folder holds."""
    from hvdc_ident.report.page import document

    results = Results(folder)
    heading = results.get(STAGE) or results.heading
    letter = letter_of(results)
    title = f"Model {heading.get('model', '')}: what the recordings say"
    return write_text(
        folder / FILE, document(title, text(head.date), f"<main class='letter'>{_body(results, letter, head)}</main>")
    )


def _body(results: Results, letter: Letter, head: Letterhead) -> str:
    """The letter as HTML."""
    answers = Answers(results)
    missed, *rest = letter.sentences
    told = "".join(f"<p>{text(s)}</p>" for s in rest)
    attached = f"<p class='small'>Attached: {text(', '.join(letter.attached))}.</p>" if letter.attached else ""
    return (
        f"{_head(results, head)}<p>{badge(_passed(answers))} {text(missed)}</p>{_values(answers)}{told}"
        f"<p><strong>{text(letter.request)}</strong></p><p>{text(letter.following)}</p>{_figure(answers)}{attached}"
    )


def _head(results: Results, head: Letterhead) -> str:
    """Who, to whom, about what: a line each."""
    heading = results.get(STAGE) or results.heading
    count = len(results.experiments)
    recordings = f", {count} recording{'s' if count > 1 else ''}" if count else ""
    lines = {
        "To": head.to,
        "From": head.author,
        "Plant": head.plant,
        "Model": " ".join(w for w in (str(heading.get("model", "")), head.version and f"version {head.version}") if w),
        "Study": f"{heading.get('study', '')}{recordings}; {heading.get('software', '')}",
    }
    return "<dl>" + "".join(f"<dt>{name}</dt><dd>{text(said)}</dd>" for name, said in lines.items() if said) + "</dl>"


def _given(answers: Answers) -> Errors | None:
    return next((e for e in answers.errors if e.name == "given"), None)


def _passed(answers: Answers) -> bool | None:
    """The verdict on the model as it was given."""
    errors = _given(answers)
    return None if errors is None else errors.follows


def _missed(answers: Answers) -> str:
    """Sentences on the largest error of the model with its given values, and in how many signals it is above the noise."""
    errors = _given(answers)
    if errors is None or answers.worst is None:
        return "The model could not be compared with the recordings at its given values."
    mine = "With the values it came with, your model"
    held = errors.by_limits
    failed, count = errors.deciding.failed, errors.deciding.judged
    rest = answers.not_judged(errors, limits=held)
    if count and not failed:
        kind = ("keeps the tolerance in", "") if held else ("follows", " to its noise")
        signals = f"{count} recorded signal{'s' if count > 1 else ''}" if rest else "every recorded signal"
        return f"{mine} {kind[0]} {signals}{kind[1]}{f'; {rest}' if rest else ''}."
    output, experiment = answers.worst
    unit = str(answers.results.units.get(output, ""))
    times = f", {times_text(errors.times)} the noise of the recording" if errors.times is not None else ""
    worst = f"{output} in experiment '{experiment}': its RMSE there is {_plain(errors.rmse, unit)}{times}"
    beside = f" Of the others, {rest}." if rest and count else ""
    if not count:
        return f"{mine} cannot be judged: neither the noise of the recordings nor a tolerance is known. It is farthest off in {worst}."
    if held:
        return f"{mine} is outside the tolerance in {failed} of {count} signals, most of all {worst}.{beside}"
    return f"{mine} misses {failed} of {count} recorded signals, most of all {worst}.{beside}{_in_windows(answers, errors)}"


def _in_windows(answers: Answers, errors: Errors) -> str:
    """Sentence on the windows of the tolerance profile that stands in where a study names none."""
    if not errors.in_limits.judged or not answers.profile:
        return ""
    name = str(answers.profile.get("source", "")).split(" (")[0] or str(answers.profile.get("name", ""))
    rest = answers.not_judged(errors, limits=True)
    rest = f"; {rest}" if rest else ""
    if errors.in_limits.failed:
        return f" In {errors.in_limits.failed} of {errors.in_limits.judged} signals that is more than the windows of {name} allow{rest}."
    count = errors.in_limits.judged
    signals = f"{count} signal{'s' if count > 1 else ''}" if rest else "every signal"
    return f" In {signals} it is less than the windows of {name} allow{rest}."


def _plain(value: float | None, unit: str) -> str:
    """A number with two digits and its unit, as plain text."""
    return "unknown" if value is None else f"{figures(value, 2)} {unit}".rstrip()


def _values(answers: Answers) -> str:
    """The one table: each parameter given, fitted and with the effect."""
    rows = []
    for v in answers.values:
        fitted, own = estimate(v.fitted, answers.interval(v.name, "fit")) if v.fitted is not None else ("", "")
        effect, later = estimate(v.effect, v.effect_interval) if v.effect is not None else (text(v.by_place), "")
        interval = later if v.effect is not None else "" if v.by_place else own
        said = v.note if v.note == AT_BOUND else f"held, {v.note.split(':')[0]}" if v.note else ""
        cells = [text(v.name), number(v.given), fitted, effect, "; ".join(s for s in (interval, text(said)) if s)]
        rows.append([*cells, text(v.unit)])
    if not rows:
        return ""
    added = any(v.effect is not None for v in answers.values)
    kind = "with the effect" if added else "fitted"
    head = [
        "parameter",
        "given",
        "fitted",
        "with the effect",
        f"{answers.interval_words(effect=added)}, {kind}",
        "unit",
    ]
    told = f"<p>{text(answers.condition.replace('They', 'The values', 1))}</p>" if added or answers.fitted else ""
    return table(head, rows, words=(0, 5)) + (told if answers.condition else "")


def _figure(answers: Answers) -> str:
    """The worst signal before and after."""
    if answers.worst is None:
        return ""
    after = "effect" if "effect" in answers.judgements else "fitted"
    overlay = overlay_of(answers.results, answers.worst[1], answers.worst[0], ("given", after))
    if overlay is None:
        return ""
    words = listed(WORDS[n] for n in overlay.runs)
    caption = f"{text(overlay.output)} in {text(overlay.experiment)}, recorded and simulated ({words}); below, recorded less simulated."
    return overlay.figure(Sheet.new(7.4, 2.7, 0.5), caption, overlay.span)


def _request(answers: Answers) -> str:
    """What the owner is asked to confirm."""
    found = answers.diagnosis
    asked: list[str] = []
    told: set[str] = set()
    for f in found.get("findings") or []:
        if f["effect"] == "parameter":
            told |= set(f["parameters"])
            others = [f"that {s['text']}" for s in (found.get("stand_ins") or [])[:1]]
            sizes = listed(f"{n} = {quantity(p['value'], p.get('unit') or '')}" for n, p in f["parameters"].items())
            asked.append(" or ".join([f"the values that the recordings ask for: {sizes}", *others]))
            continue
        sizes = listed(
            f"{n} = {quantity(p['value'], p.get('unit') or '')}" for n, p in (f.get("parameters") or {}).items()
        )
        depend = found.get("values_by_place") or {}
        places = list(places_of(f.get("places") or [], listed, depend))
        sizes = "" if depend else sizes
        where = " or ".join(places[:2]) + (f" or one of {len(places) - 2} more places" if len(places) > 2 else "")
        what = ASKED.get(f["effect"], f"the {f['effect']}")
        asked.append(f"{what} at {where}, which the model leaves out (here {sizes})" if sizes else f"{what} at {where}")
    off = [v for v in answers.values if v.differs and v.name not in told]
    if off and (asked or found["verdict"] != "unnameable"):
        asked.append(f"the value{'s' if len(off) > 1 else ''} {listed(_in_place_of(v, change=False) for v in off)}")
    if asked:
        return f"Please confirm {'; and '.join(dict.fromkeys(asked))}."
    if found["verdict"] == "unnameable":
        return "Please tell us which filters, limits and delays of the plant the model leaves out."
    moved = [v.name for v in answers.values if v.differs is None and abs(v.change or 0.0) >= MOVED]
    return (
        f"Please confirm the value{'s' if len(moved) > 1 else ''} of {listed(moved)}: see the table." if moved else ""
    )


def _consistent(answers: Answers) -> str:
    """Sentences on what the difference is consistent with: the named effect, and those the data cannot tell from it."""
    found = answers.diagnosis
    verdict, effects, doubt = found["verdict"], found.get("effects") or [], _without_chance(answers.doubt)
    if verdict == "no-evidence" and found.get("stand_ins"):
        return _without_chance(str(found.get("text", "")))
    if verdict == "no-evidence":
        return _nothing(answers)
    if not effects:
        return _without_chance(str(found.get("text", "")))
    told = [" ".join([_inside(e["text"].rstrip(".")), _interval(answers, e)]).strip() for e in effects]
    first = f"The difference is consistent with this: {'; and '.join(told)}."
    own = [(e["effect"], e["at"], e.get("from", "")) for e in effects]
    rivals = [r for group in found.get("ambiguity") or [] for r in group]
    names = list(
        dict.fromkeys(
            f"{form_of(r)} at {listed(r['at'])}" for r in rivals if (r["effect"], r["at"], r.get("from", "")) not in own
        )
    )
    if names:
        more = f" and {len(names) - RIVALS} more" if len(names) > RIVALS else ""
        first += f" The recordings cannot tell it from: {'; '.join(names[:RIVALS])}{more}.{_in_common(found)}"
    elif not doubt:
        first += " No other effect that was tried, and no other place, explains the recordings as well."
    if doubt:
        they = "They" if len(effects) > 1 else "It"
        first += f" {they} may stand for something that none of those tried is: {doubt}."
    if left := answers.remainder:
        first += " It is not all that is missing" + ("." if doubt else f": {left[:1].lower()}{left[1:]}.")
    return first


def _nothing(answers: Answers) -> str:
    """Sentences where no effect was found: that nothing else is missing, or that something is which none that was tried explains."""
    text_of = _without_chance(str(answers.diagnosis.get("text", ""))).strip()
    if not answers.diagnosis.get("findings"):
        text_of = text_of.partition(". ")[2]  # the first sentence says by which test nothing was found
    if beyond_noise(answers.diagnosis):
        return text_of or "What the model leaves is more than noise, and no effect that was tried explains it."
    return f"Beyond its values nothing is missing that these recordings could show. {text_of}".strip()


def _without_chance(sentence: str) -> str:
    """A sentence of a diagnosis without the chances of its tests, which its owner has no use for."""
    return re.sub(r" \(p = [^()]*\)", "", sentence)


def _inside(sentence: str) -> str:
    """A sentence as it goes on after a colon."""
    return "e" + sentence[1:] if sentence.startswith("Each of ") else sentence


def _in_common(found: dict[str, Any]) -> str:
    """Sentence on the delay of a slow signal that all effects of the only ambiguous set have in common; empty without one."""
    groups = found.get("ambiguity") or []
    late = [r.get("late") for group in groups for r in group if r.get("refitted", True)]
    if len(groups) != 1 or len(late) < 2 or any(v is None or v <= 0.0 for v in late):
        return ""
    ends = dict.fromkeys(quantity(v, "s", 3) for v in (min(late), max(late)))
    said = f"between {span(min(late), max(late), 's', 3)}" if len(ends) > 1 else f"about {next(iter(ends))}"
    return f" Whichever it is, a slow signal is late by {said}."


def _interval(answers: Answers, effect: dict[str, Any]) -> str:
    """The 95 % intervals of an effect's sizes in brackets; empty where what is left with it is more than noise."""
    if beyond_noise(answers.diagnosis):
        return ""
    parts = []
    for name, size in effect["parameters"].items():
        low, high = size.get("ci95") or (None, None)
        if low is not None and high is not None:
            parts.append(f"{name} between {span(low, high, size.get('unit') or '')}")
    return f"({', '.join(parts)}, 95 %)" if parts else ""


def _values_judged(answers: Answers) -> str:
    """Sentences on the given values: those that the intervals leave out, those that they hold, and what a fit without the addition
    does to the one that it moves most."""
    found, what = answers.diagnosis, answers.added
    if found.get("verdict") == "unnameable" and not what:
        name, alone, _ = _most_moved(answers)
        moved = f": a fit moves {name} by {_percent(alone)}, and how much of it makes up for what is missing these records do not tell"
        return f"Your values cannot be judged while that is missing{moved if name else ''}."
    off = sorted((v for v in answers.values if v.differs), key=lambda v: -abs(v.change or math.inf))
    kept = [v.name for v in answers.values if v.differs is False]
    parts = []
    if off:
        more = f" and {len(off) - MOST_OFF} more" if len(off) > MOST_OFF else ""
        with_it = answers.counting.name == "effect"
        start = f"With the {what}, the" if with_it else "Without an effect, the" if answers.counting.doubt else "The"
        each = "; ".join(_in_place_of(v, interval=not answers.conditional) for v in off[:MOST_OFF])
        parts.append(f"{start} recordings ask for other values than you gave: {each}{more}.")
    if kept:
        sure = "" if answers.conditional else "95 % "
        one = f"Your value of {kept[0]} lies within its {sure}interval."
        parts.append(one if len(kept) == 1 else f"Your values of {listed(kept)} lie within their {sure}intervals.")
    if off and answers.counting.doubt:
        parts.append("They may make up for what is missing.")
    if depend := found.get("values_by_place") or {}:
        each = " ".join(f"{n} is {value_by_place(at)}." for n, at in depend.items())
        parts.append(f"What the recordings say of {listed(depend)} depends on which of these is the true one: {each}")
    if (off or kept) and answers.conditional:
        parts.append("That holds only if nothing else is missing.")
    name, alone, with_it_too = _most_moved(answers)
    if name and what and abs(with_it_too) < 0.5 * abs(alone):
        parts.append(
            f"A fit without the {what} moves {name} by {_percent(alone)} to make up for it; with the {what} the same fit moves it "
            f"by {_percent(with_it_too)}."
        )
    elif name and not off and not kept and abs(alone) >= MOVED:
        parts.append(f"A fit moves {name} by {_percent(alone)}.")
    if parts and found.get("stand_ins"):
        parts.append("An effect that your model leaves out explains them as well, with the values that you gave.")
    return " ".join(parts)


def _most_moved(answers: Answers) -> tuple[str, float, float]:
    """The parameter that a fit without the addition moves most, by which share of the given value, and by which with it; "" without.

    The fit is that of the table, and of the diagnosis where none has run.
    """
    found = answers.diagnosis
    given, without, after = (found.get(f"parameters_{k}") or {} for k in ("before", "refitted", "after"))
    without = without | {v.name: v.fitted for v in answers.values if v.fitted is not None}
    moved = {
        n: (without[n] / g - 1.0, after[n] / g - 1.0) for n, g in given.items() if g and n in without and n in after
    }
    moved = {n: shares for n, shares in moved.items() if n not in (found.get("values_by_place") or {})}
    name = max(moved, key=lambda n: abs(moved[n][0]), default="")
    return (name, *moved[name]) if name else ("", 0.0, 0.0)


def _in_place_of(v: Value, *, interval: bool = False, change: bool = True) -> str:
    """A value that counts in place of the given one; on demand its 95 % interval, where it has two ends, and the change."""
    digits = figures_of(v.interval, 4)
    ends = interval_text(v.interval) if interval and None not in (v.interval or (None,)) else ""
    moved = f" ({_percent(v.change)})" if change and v.change is not None else ""
    told = f"{v.name} = {quantity(v.value or 0.0, v.unit, digits)}{f' (95 %: {ends})' if ends else ''}"
    return f"{told} in place of {figures(v.given or 0.0, 6)}{moved}"


def _percent(share: float) -> str:
    """A share with its sign in per cent; nothing has no sign."""
    shown = f"{100 * share:+.1f} %"
    return "0.0 %" if shown[1:] == "0.0 %" else shown


def _gained(found: dict[str, Any]) -> str:
    gap = found.get("gap") or {}
    shrink = gap.get("shrink_holdout")
    if shrink is None or not added_to(found):
        return ""
    pooled = (gap.get("pooled") or {}).get("augmented") or {}
    left = pooled.get("holdout")
    rest = f"; what is left is {figures(left, 3)} times the noise" if isinstance(left, int | float) else ""
    against = gap.get("held_out", "experiments")
    where = "experiments that no fit has seen" if against == "experiments" else against
    return (
        f"Adding it shrinks the error on {where} by {percentage(shrink)}, "
        f"measured against the same model with its parameters fitted and nothing added{rest}."
    )


def _next(found: dict[str, Any]) -> str:
    advice = (found.get("separating_experiment") or {}).get("text")
    if not advice:
        return ""
    several = any(len(group) > 1 for group in found.get("ambiguity") or [])
    start = "To tell them apart" if several else "What would show more"
    advice = "r" + advice[1:] if advice.startswith("Record ") else advice
    return f"{start}: {advice}" + ("" if advice.endswith(".") else ".")


def _attached(results: Results, found: dict[str, Any]) -> list[str]:
    card = found.get("augmented_model")
    names = [str(card), Path(str(card)).with_suffix(".fmu").name] if card else []
    return [n for n in names if (results.folder / n).is_file()]
