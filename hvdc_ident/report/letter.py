"""The letter: one printed page to the owner of a model, made from the results alone.

Who writes to whom about which model; whether it follows the recordings; the values given, fitted and with what it lacks; what
that is and which of the given values the recordings leave out; what the owner is asked to confirm; what to record to be sure;
and a figure of before and after.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

from hvdc_ident.effects import effects
from hvdc_ident.errors import InputError
from hvdc_ident.files import write_text
from hvdc_ident.fit.uncertainty import MOVED
from hvdc_ident.next_step import NextStep
from hvdc_ident.report.html import badge, table_of, text
from hvdc_ident.report.overlay import Sheet, worst_signal
from hvdc_ident.summary import Results, RunSummary
from hvdc_ident.summary.phrases import (
    WORDS,
    asked_text,
    by_place,
    condition,
    error_text,
    gained_sentence,
    noise_sentence,
    not_judged,
    place_texts,
    remainder_sentence,
    signed_text,
    sizes_text,
    windows_name,
)
from hvdc_ident.summary.run_summary import AddedEffect, FindingSummary, SetSummary
from hvdc_ident.summary.tables import values_table
from hvdc_ident.text import listed, quantity, span

FILE = "letter.html"
STAGE = "discrepancy"
RIVALS = 3
"""Effects and places that are told beside the one in the model."""
MOST_OFF = 4
"""Values that differ from the given ones which are told one by one."""


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
    s = results.summary
    if not s.diagnosis:
        raise InputError(
            "there is no diagnosis to write a letter about",
            where=str(results.folder),
            expected=f"{STAGE}.json",
            next=(NextStep("diagnose"),),
        )
    # What a diagnosis says ends with it where the diagnosis rests on it.
    unknown = "" if noise_sentence(s) in s.said else noise_sentence(s)
    sentences = (_missed(s), unknown, _consistent(s), _values_judged(s), gained_sentence(s))
    return Letter(tuple(t for t in sentences if t), _request(s), _next(s), tuple(_attached(results)))


def write_letter(folder: Path, head: Letterhead = Letterhead()) -> Path:
    """The path of letter.html in a folder of results, written from what the folder holds."""
    from hvdc_ident.report.page import document

    results = Results(folder)
    heading = results.get(STAGE) or results.heading
    letter = letter_of(results)
    title = f"Model {heading.get('model', '')}: what the recordings say"
    body = f"<main class='letter'>{_body(results, letter, head)}</main>"
    return write_text(folder / FILE, document(title, text(head.date), body))


def _body(results: Results, letter: Letter, head: Letterhead) -> str:
    """The letter as HTML."""
    s = results.summary
    missed, *rest = letter.sentences
    told = "".join(f"<p>{text(sentence)}</p>" for sentence in rest)
    attached = f"<p class='small'>Attached: {text(', '.join(letter.attached))}.</p>" if letter.attached else ""
    passed = {"pass": True, "fail": False}.get(s.sets["given"].verdict) if "given" in s.sets else None
    return (
        f"{_head(results, head)}<p>{badge(passed)} {text(missed)}</p>{_values(s)}{told}"
        f"<p><strong>{text(letter.request)}</strong></p><p>{text(letter.following)}</p>{_figure(results)}{attached}"
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


def _missed(s: RunSummary) -> str:
    """Sentences on the largest error of the model with its given values, and in how many signals it is above the noise."""
    given = s.sets.get("given")
    signal = s.signal(given.worst) if given is not None else None
    if given is None or signal is None:
        return "The model could not be compared with the recordings at its given values."
    mine = "With the values it came with, your model"
    held = given.by != "noise"
    failed, count = given.deciding.failed, given.deciding.judged
    rest = not_judged(s, given, limits=held)
    if count and not failed:
        kind = ("keeps the tolerance in", "") if held else ("follows", " to its noise")
        signals = f"{count} recorded signal{'s' if count > 1 else ''}" if rest else "every recorded signal"
        return f"{mine} {kind[0]} {signals}{kind[1]}{f'; {rest}' if rest else ''}."
    worst = f"{signal.output} in experiment '{signal.experiment}': its RMSE there is {error_text(signal, signal.errors['given'])}"
    beside = f" Of the others, {rest}." if rest and count else ""
    if not count:
        return f"{mine} cannot be judged: neither the noise of the recordings nor a tolerance is known. It is farthest off in {worst}."
    if held:
        return f"{mine} is outside the tolerance in {failed} of {count} signals, most of all {worst}.{beside}"
    return f"{mine} misses {failed} of {count} recorded signals, most of all {worst}.{beside}{_in_windows(s, given)}"


def _in_windows(s: RunSummary, given: SetSummary) -> str:
    """Sentence on the windows of the tolerance profile that stands in where a study names none."""
    count = given.in_limits
    if not count.judged or not s.profile:
        return ""
    rest = not_judged(s, given, limits=True)
    end = f"{f'; {rest}' if rest else ''}."
    if count.failed:
        return f" In {count.failed} of {count.judged} signals that is more than the windows of {windows_name(s)} allow{end}"
    signals = f"{count.judged} signal{'s' if count.judged > 1 else ''}" if rest else "every signal"
    return f" In {signals} it is less than the windows of {windows_name(s)} allow{end}"


def _values(s: RunSummary) -> str:
    """The one table: each parameter given, fitted and with the effect; and what the values that count rest on."""
    if not s.parameters:
        return ""
    subject = "The fitted values" if s.counting.name == "fit" else "The values"
    told = condition(s, subject)
    return table_of(values_table(s)) + (f"<p>{text(told)}</p>" if told else "")


def _figure(results: Results) -> str:
    """The worst signal at the given values, before and after."""
    sets = results.summary.sets
    overlay = worst_signal(results, next(iter(sets), None), ("given", "effect" if "effect" in sets else "fitted"))
    if overlay is None:
        return ""
    words = listed(WORDS[n] for n in overlay.runs)
    caption = f"{text(overlay.output)} in {text(overlay.experiment)}, recorded and simulated ({words}); below, recorded less simulated."
    return overlay.figure(Sheet.new(7.4, 2.7, 0.5), caption, overlay.span)


def _request(s: RunSummary) -> str:
    """What the owner is asked to confirm."""
    asked: list[str] = []
    told: set[str] = set()
    for f in s.findings:
        if f.effect == "parameter":
            told |= set(f.sizes)
            others = [f"that {stand_in}" for stand_in in s.stand_ins[:1]]
            asked.append(" or ".join([f"the values that the recordings ask for: {sizes_text(f.sizes)}", *others]))
        else:
            asked.append(_asked_of(f))
    off = [p for p in s.moved if p.name not in told]
    if off and (asked or s.diagnosis != "unnameable"):
        asked.append(f"the value{'s' if len(off) > 1 else ''} {listed(asked_text(p, change=False) for p in off)}")
    if asked:
        return f"Please confirm {'; and '.join(dict.fromkeys(asked))}."
    if s.diagnosis == "unnameable":
        return "Please tell us which filters, limits and delays of the plant the model leaves out."
    moved = [p.name for p in s.parameters if p.moved is None and abs(p.change or 0.0) >= MOVED]
    plural = "s" if len(moved) > 1 else ""
    return f"Please confirm the value{plural} of {listed(moved)}: see the table." if moved else ""


def _asked_of(f: FindingSummary) -> str:
    """Return what an owner knows of an effect, where it may be, and its size where that does not depend on the place."""
    places = list(place_texts(f, listed))
    shown = places[: RIVALS if len(places) <= RIVALS else 2]
    where = " or ".join(shown) + (f" or one of {len(places) - 2} more places" if len(places) > len(shown) else "")
    effect = effects().get(f.effect)
    known = effect.asked if effect is not None else ""
    what = f"{known or f'the {f.effect}'} at {where}"
    depends = any(p.values for p in f.places)
    return what if depends or not f.sizes else f"{what}, which the model leaves out (here {sizes_text(f.sizes)})"


def _consistent(s: RunSummary) -> str:
    """Sentences on what the difference is consistent with: the named effect, and those the data cannot tell from it."""
    doubt, left = _without_chance(s.remainder.doubt), remainder_sentence(s)
    if s.diagnosis == "no-evidence" and not s.stand_ins:
        return _nothing(s)
    if not s.effects or s.diagnosis == "no-evidence":
        return _without_chance(s.said)
    told = [f"{_inside(e.text)} {_interval(s, e)}".strip() for e in s.effects]
    parts = [f"The difference is consistent with this: {'; and '.join(told)}."]
    names = list(dict.fromkeys(f"{r.name} at {listed(r.at)}" for r in s.rivals))
    if names:
        more = f" and {len(names) - RIVALS} more" if len(names) > RIVALS else ""
        parts.append(f"The recordings cannot tell it from: {'; '.join(names[:RIVALS])}{more}.{_in_common(s)}")
    elif not doubt:
        parts.append("No other effect that was tried, and no other place, explains the recordings as well.")
    if doubt:
        they = "They" if len(s.effects) > 1 else "It"
        parts.append(f"{they} may stand for something that none of those tried is: {doubt}.")
    if left:
        parts.append("It is not all that is missing" + ("." if doubt else f": {left}."))
    return " ".join(parts)


def _nothing(s: RunSummary) -> str:
    """Sentences where no effect was found: that nothing else is missing, or that something is which none that was tried explains."""
    said = _without_chance(s.said).strip()
    if s.noise_from_misfit:
        return said
    if not s.findings:
        said = said.partition(". ")[2]  # the first sentence says by which test nothing was found
    if s.remainder.more_than_noise:
        return said or "What the model leaves is more than noise, and no effect that was tried explains it."
    return f"Beyond its values nothing is missing that these recordings could show. {said}".strip()


def _without_chance(sentence: str) -> str:
    """A sentence of a diagnosis without the chances of its tests, which its owner has no use for."""
    return re.sub(r" \(p = [^()]*\)", "", sentence)


def _inside(sentence: str) -> str:
    """A sentence as it goes on after a colon."""
    return "e" + sentence[1:] if sentence.startswith("Each of ") else sentence


def _in_common(s: RunSummary) -> str:
    """Sentence on the delay of a slow signal that all effects of the only ambiguous set have in common; empty without one."""
    if s.late is None:
        return ""
    ends = dict.fromkeys(quantity(v, "s", 3) for v in s.late)
    said = f"between {span(*s.late, 's', 3)}" if len(ends) > 1 else f"about {next(iter(ends))}"
    return f" Whichever it is, a slow signal is late by {said}."


def _interval(s: RunSummary, effect: AddedEffect) -> str:
    """The 95 % intervals of an effect's sizes in brackets; empty where what is left with it is more than noise."""
    if s.remainder.more_than_noise:
        return ""
    parts = []
    for name, size in effect.sizes.items():
        low, high = size.interval or (None, None)
        if low is not None and high is not None:
            parts.append(f"{name} between {span(low, high, size.unit)}")
    return f"({', '.join(parts)}, 95 %)" if parts else ""


def _values_judged(s: RunSummary) -> str:
    """Sentences on the given values: those that the intervals leave out, those that they hold, and what a fit without the addition
    does to the one that it moves most."""
    most, what = s.most_moved, s.counting.kind
    alone = most.alone / most.given - 1.0 if most is not None and most.given and most.alone is not None else 0.0
    if s.diagnosis == "unnameable" and not what:
        name = most.name if most is not None else ""
        moved = f": a fit moves {name} by {signed_text(alone)}, and how much of it makes up for what is missing these records do not tell"
        return f"Your values cannot be judged while that is missing{moved if name else ''}."
    off = s.moved
    kept = [p.name for p in s.parameters if p.moved is False]
    with_it = [p for p in (*off, *(q for q in s.parameters if q.moved is False)) if p.asked_with_effect]
    sure = not s.conditional["effect" if with_it else "fitted"]
    parts = []
    if off:
        more = f" and {len(off) - MOST_OFF} more" if len(off) > MOST_OFF else ""
        wherever = "" if s.counting.name == "effect" else ", wherever it is"
        start = (
            f"With the {what}{wherever}, the" if with_it else "Without an effect, the" if s.counting.doubt else "The"
        )
        each = "; ".join(asked_text(p, interval=sure) for p in off[:MOST_OFF])
        parts.append(f"{start} recordings ask for other values than you gave: {each}{more}.")
    if kept:
        name = "95 % interval" if sure else "interval"
        one = f"Your value of {kept[0]} lies within its {name}."
        parts.append(one if len(kept) == 1 else f"Your values of {listed(kept)} lie within their {name}s.")
    if off and s.counting.doubt and not with_it:
        parts.append("They may make up for what is missing.")
    if depend := [p for p in s.parameters if p.by_place]:
        each = " ".join(f"{p.name} is {by_place(p)}." for p in depend)
        parts.append(
            f"What the recordings say of {listed(p.name for p in depend)} depends on which of these is the true one: {each}"
        )
    if (off or kept) and not sure:
        parts.append("That holds only if nothing else is missing.")
    after = most.effect / most.given - 1.0 if most is not None and most.given and most.effect is not None else None
    if most is not None and after is not None and abs(after) < 0.5 * abs(alone):
        parts.append(
            f"A fit without the {what} moves {most.name} by {signed_text(alone)} to make up for it; with the {what} the same fit "
            f"moves it by {signed_text(after)}."
        )
    elif most is not None and not off and not kept and abs(alone) >= MOVED:
        parts.append(f"A fit moves {most.name} by {signed_text(alone)}.")
    if parts and s.stand_ins:
        parts.append("An effect that your model leaves out explains them as well, with the values that you gave.")
    return " ".join(parts)


def _next(s: RunSummary) -> str:
    """Sentence on what to record to tell likely effects and places apart."""
    advice = next((step.text for step in s.next if step.kind == "separate"), "")
    if not advice:
        return ""
    return f"{'To tell them apart' if s.rivals else 'What would show more'}: {advice[:1].lower()}{advice[1:]}"


def _attached(results: Results) -> list[str]:
    card = results.get(STAGE).get("augmented_model")
    names = [str(card), Path(str(card)).with_suffix(".fmu").name] if card else []
    return [n for n in names if (results.folder / n).is_file()]
