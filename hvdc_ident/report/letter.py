"""The letter: one printed page to the owner of a model, made from the results alone.

Who writes to whom about which model; whether it follows the recordings; the values given, fitted and with what it lacks; what
that is and what it does to the gains; what the owner is asked to confirm; what to record to be sure; and a figure of before
and after.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hvdc_ident.errors import InputError
from hvdc_ident.files import write_text
from hvdc_ident.report.answers import Answers, Errors
from hvdc_ident.report.html import badge, estimate, number, table, text
from hvdc_ident.report.overlay import Sheet, overlay_of
from hvdc_ident.report.results import Results
from hvdc_ident.text import form_of, listed, percentage, quantity, span

FILE = "letter.html"
STAGE = "discrepancy"
MOVED = 0.02
"""Share of the given value from which on a fitted value is said to differ from it."""
RIVALS = 3
"""Effects and places that are told beside the one in the model."""
ASKED = {
    "backlash": "the play of the mechanism",
    "deadband": "the width of the dead band",
    "delay": "the dead time of sampling, computation and communication",
    "gain": "the scaling",
    "inner-loop": "the bandwidth and damping of the inner control loop",
    "lag": "the time constant of the filter or transducer",
    "lead-lag": "the two time constants of the lead-lag",
    "limit": "the limit",
    "offset": "the offset",
    "quantisation": "the resolution of the measurement",
    "rate-limit": "the limit of the rate of change",
    "sample-hold": "the sampling time",
    "saturation": "the level of saturation",
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
    sentences = (_missed(answers), _consistent(found), _gains(answers), _gained(found))
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
    if errors is None:
        return None
    return errors.tolerated if answers.by_tolerance and errors.tolerated is not None else errors.on_noise


def _missed(answers: Answers) -> str:
    """Sentences on the largest error of the model with its given values, and in how many signals it is above the noise."""
    errors = _given(answers)
    if errors is None or answers.worst is None:
        return "The model could not be compared with the recordings at its given values."
    if _passed(answers):
        kind = (
            "keeps the tolerance in every recorded signal"
            if answers.by_tolerance
            else "follows every recorded signal to its noise"
        )
        return f"With the values it came with, your model {kind}."
    output, experiment = answers.worst
    unit = str(answers.results.units.get(output, ""))
    times = f", {errors.times:.2g} times the noise of the recording" if errors.times is not None else ""
    worst = f"most of all {output} in experiment '{experiment}': its RMSE there is {_plain(errors.rmse, unit)}{times}."
    if answers.by_tolerance and errors.limited:
        return f"With the values it came with, your model is outside the tolerance in {errors.outside} of {errors.limited} signals, {worst}"
    among = f" {errors.above} of {errors.judged} recorded signals" if errors.judged else " the recordings"
    return f"With the values it came with, your model misses{among}, {worst}{_in_windows(answers, errors)}"


def _in_windows(answers: Answers, errors: Errors) -> str:
    """Clause on the windows of the tolerance profile that stands in where a study names none."""
    if not errors.limited or not answers.profile:
        return ""
    name = str(answers.profile.get("source", "")).split(" (")[0] or str(answers.profile.get("name", ""))
    if errors.tolerated:
        return f" In every signal that is less than the windows of {name} allow."
    return f" In {errors.outside} of {errors.limited} signals that is more than the windows of {name} allow."


def _plain(value: float | None, unit: str) -> str:
    """A number with two digits and its unit, as plain text."""
    return "unknown" if value is None else f"{value:.2g} {unit}".rstrip()


def _values(answers: Answers) -> str:
    """The one table: each parameter given, fitted and with the effect."""
    rows = []
    for v in answers.values or ():
        fitted = estimate(v.fitted, answers.interval(v.name, "fit"))[0] if v.fitted is not None else ""
        value, interval = estimate(v.value, v.interval) if v.value is not None else ("", "")
        effect = value if v.effect is not None else ""
        rows.append([text(v.name), number(v.given), fitted, effect, interval if v.interval else "", text(v.unit)])
    if not rows:
        return ""
    kind = "with the effect" if any(v.effect is not None for v in answers.values) else "fitted"
    return table(
        ["parameter", "given", "fitted", "with the effect", f"95 % interval, {kind}", "unit"], rows, words=(0, 5)
    )


def _figure(answers: Answers) -> str:
    """The worst signal before and after."""
    if answers.worst is None:
        return ""
    after = "effect" if "effect" in answers.rmse else "fitted"
    overlay = overlay_of(answers.results, answers.worst[1], answers.worst[0], ("given", after))
    if overlay is None:
        return ""
    caption = f"{text(overlay.output)} in {text(overlay.experiment)}, before and after; below, recorded less simulated."
    return overlay.figure(Sheet.new(7.4, 2.7, 0.5), caption, overlay.span)


def _request(answers: Answers) -> str:
    """What the owner is asked to confirm."""
    found = answers.diagnosis
    asked = []
    for f in found.get("findings") or []:
        if f["effect"] == "parameter":
            sizes = listed(f"{n} = {quantity(p['value'], p.get('unit') or '')}" for n, p in f["parameters"].items())
            asked.append(f"the values that the recordings ask for: {sizes}")
            continue
        sizes = listed(
            f"{n} = {quantity(p['value'], p.get('unit') or '')}" for n, p in (f.get("parameters") or {}).items()
        )
        places = [listed(p["at"]) for p in f.get("places") or []]
        where = " or ".join(places[:2]) + (f" or one of {len(places) - 2} more places" if len(places) > 2 else "")
        what = ASKED.get(f["effect"], f"the {f['effect']}")
        asked.append(f"{what} at {where}, which the model leaves out (here {sizes})" if sizes else f"{what} at {where}")
    if asked:
        return f"Please confirm {'; and '.join(asked)}."
    if found["verdict"] == "unnameable":
        return "Please tell us which filters, limits and delays of the plant the model leaves out."
    moved = [
        v.name for v in answers.values if v.value is not None and v.given and abs(v.value / v.given - 1.0) >= MOVED
    ]
    return (
        f"Please confirm the value{'s' if len(moved) > 1 else ''} of {listed(moved)}: see the table." if moved else ""
    )


def _consistent(found: dict[str, Any]) -> str:
    """Sentences on what the difference is consistent with: the named effect, and those the data cannot tell from it."""
    verdict, effects = found["verdict"], found.get("effects") or []
    if verdict == "no-evidence":
        return f"Beyond its values nothing is missing that these recordings could show. {found.get('text', '')}".strip()
    if not effects:
        return str(found.get("text", ""))
    told = [" ".join([_inside(e["text"].rstrip(".")), _interval(e)]).strip() for e in effects]
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
        first = f"{first} The recordings cannot tell it from: {'; '.join(names[:RIVALS])}{more}.{_in_common(found)}"
    elif found.get("doubt"):
        they = "They" if len(effects) > 1 else "It"
        first += f" {they} may stand for something that none of those tried is: {found['doubt']}."
    else:
        first += " No other effect that was tried, and no other place, explains the recordings as well."
    if not found.get("doubt") and not (found.get("remaining") or {}).get("adequate", True):
        first += " It is not all that is missing: with it the residuals are still not noise."
    return first


def _inside(sentence: str) -> str:
    """A sentence as it goes on after a colon."""
    return "e" + sentence[1:] if sentence.startswith("Each of ") else sentence


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


def _gains(answers: Answers) -> str:
    """Sentences on the gains: how far a fit moves them without the effect, and how far with it.

    The fit is that of the table, and of the diagnosis where none has run.
    """
    found = answers.diagnosis
    given, without, after = (found.get(f"parameters_{k}") or {} for k in ("before", "refitted", "after"))
    without = without | {v.name: v.fitted for v in answers.values if v.fitted is not None}
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
        if abs(alone) < MOVED:
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
        f"Adding it shrinks the error on {where} by {percentage(shrink)}, "
        f"measured against the same model with its gains fitted and nothing added{rest}."
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
