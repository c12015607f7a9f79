"""The words of a summary: sentences that terminal, report, letter, notebook and workbench share."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping

from hvdc_ident.fit.noise import misfit_sentence
from hvdc_ident.fit.result import FitResult
from hvdc_ident.fit.uncertainty import WIDER
from hvdc_ident.next_step import TO_DO, Door
from hvdc_ident.summary.run_summary import (
    FindingSummary,
    ParameterSummary,
    Quantity,
    RemainderSummary,
    RunSummary,
    SetSummary,
    SignalError,
    SignalSummary,
)
from hvdc_ident.text import (
    capital,
    figures,
    gap_text,
    interval_text,
    interval_words,
    listed,
    one_of,
    quantity,
    times_text,
    value_by_place,
)

WORDS: dict[str, str] = {"given": "given values", "fitted": "fitted", "effect": "with the effect"}
"""Names of the sets of values."""
SUBJECTS: dict[str, str] = {
    "given": "The model with its given values",
    "fitted": "The fitted model",
    "effect": "The model with the effect",
}
AT_BOUND = "at its bound"


# --- whether the model follows ---


def verdict_sentence(s: RunSummary) -> str:
    """Return whether the model follows its recordings: with which values, against what, and whether it does with the effect."""
    if s.judged is None or s.about is None:
        return "No recording was compared with the model."
    subject, judged = SUBJECTS[s.about], s.judged
    count = judged.deciding
    if not count.judged:
        return f"{subject} is not judged: neither the noise of the recordings nor a tolerance is known."
    rest = not_judged(s, judged, limits=judged.by != "noise")
    if not count.failed:
        return f"{subject} {kept(judged, rest)}{f'; {rest}' if rest else ''}."
    kind = "does not follow the recordings to their noise" if judged.by == "noise" else "does not keep the tolerance"
    if judged.by == "noise" and judged.in_limits.verdict:
        kind += ", but keeps the windows of the tolerance profile"
    return f"{subject} {kind}{_mended(s, judged)}."


def kept(judged: SetSummary, rest: str) -> str:
    """Return what a model does that passes. rest: the phrase on signals that are not judged."""
    count = judged.deciding.judged
    signals = f"the {count} signal{'s that are' if count > 1 else ' that is'} judged" if rest else ""
    if judged.by == "noise":
        return f"follows {signals} to the noise" if rest else "follows every recorded signal to its noise"
    return f"keeps the tolerance{f' in {signals}' if rest else ''}"


def noise_sentence(s: RunSummary) -> str:
    """Return that the noise of some outputs is taken from the misfit, and what settles it; empty where all of it is known."""
    return misfit_sentence(s.noise_from_misfit)


def _mended(s: RunSummary, judged: SetSummary) -> str:
    if "effect" not in s.sets:
        return ""
    after = s.sets["effect"].on_noise if judged.by == "noise" else s.sets["effect"].in_limits
    some = ", where it is judged" if after.not_judged else ""
    return f"; with the effect it does{some}" if after.passed and not after.failed else ""


def not_judged(s: RunSummary, judged: SetSummary, *, limits: bool) -> str:
    """Return a phrase on the signals without a verdict, in the limits or else by their noise, and what to state; "" without any."""
    count = (judged.in_limits if limits else judged.on_noise).not_judged
    if not count:
        return ""
    said = f"{count} signal{'s' if count > 1 else ''} not judged"
    if not limits:
        return f"{said}: state the noise of {listed(judged.noise_unknown)}"
    if s.limits == "tolerance":
        return f"{said}: the study states no tolerance for {listed(o for each in judged.not_judged.values() for o in each)}"
    reasons = [f"{one_of(outputs)} ({reason})" for reason, outputs in judged.not_judged.items()]
    return f"{said}: {'; '.join(reasons)}" if reasons else said


def windows_name(s: RunSummary) -> str:
    """Return the standard that the windows come from, else the name of their profile."""
    return str(s.profile.get("source", "")).split(" (")[0] or str(s.profile.get("name", ""))


def error_text(signal: SignalSummary, error: SignalError) -> str:
    """Return the RMSE of a signal in its unit and as a multiple of its noise."""
    size = f"{figures(error.rmse, 2)} {signal.unit}".rstrip()
    times = f", {times_text(error.times_noise)} the noise of the recording" if error.times_noise is not None else ""
    return f"{size}{times}"


def worst_text(s: RunSummary) -> str:
    """Return the worst signal with its error at the values that the verdict is about; empty without one."""
    signal = s.signal(s.judged.worst) if s.judged is not None else None
    if signal is None or s.about is None:
        return ""
    return f"{signal.output} in {signal.experiment}, RMSE {error_text(signal, signal.errors[s.about])}"


# --- the values ---


def size_text(q: Quantity) -> str:
    """Return a quantity with its unit and the digits that its interval leaves."""
    return quantity(q.value, q.unit, interval=q.interval)


def sizes_text(sizes: Mapping[str, Quantity]) -> str:
    """Return quantities by their names, without the digits of an interval: "T = 350 ms and k = 2"."""
    return listed(f"{n} = {quantity(q.value, q.unit)}" for n, q in sizes.items())


def values_line(s: RunSummary) -> str:
    """Return the values that count in one line: "k = 5.02 1/s, T = 31 ms"; empty where nothing was fitted."""
    known = [
        (p.name, Quantity(p.value, p.unit, p.interval)) for p in s.parameters if s.counting.name and p.value is not None
    ]
    placed = [f"{p.name} by place" for p in s.parameters if p.by_place]
    return ", ".join([*(f"{n} = {size_text(q)}" for n, q in known), *placed])


def interval_name(s: RunSummary, name: str) -> str:
    """Return what the intervals of a set of values are called: of a model that leaves more than noise none has a chance of 95 %."""
    return interval_words(beyond_noise=s.conditional[name])


def by_place(p: ParameterSummary) -> str:
    """Return the values of a parameter that depend on what is missing where, in words; empty for another one."""
    return value_by_place(p.by_place)


def asked_text(p: ParameterSummary, *, interval: bool = False, change: bool = True) -> str:
    """Return the value that the recordings ask for in place of the given one; on demand with its interval and the change."""
    assert p.asked is not None and p.given is not None
    both = p.asked.interval is not None and None not in p.asked.interval
    ends = f" (95 %: {interval_text(p.asked.interval)})" if interval and both else ""
    moved = f" ({signed_text(p.change)})" if change and p.change is not None else ""
    return f"{p.name} = {size_text(p.asked)}{ends} in place of {figures(p.given, 6)}{moved}"


def signed_text(share: float) -> str:
    """Return a share with its sign in per cent; nothing has no sign."""
    shown = f"{100.0 * share:+.1f} %"
    return "0.0 %" if shown[1:] == "0.0 %" else shown


def note_text(p: ParameterSummary) -> str:
    """Return that a value is on a bound, or why it is held, in a few words; empty for another one."""
    return AT_BOUND if p.at_bound else f"held, {p.reason.split(':')[0]}" if p.reason else ""


def remarks(fit: FitResult, candidates: Iterable[str]) -> dict[str, str]:
    """Return by candidate why it is held, or what its interval rests on; nothing of one without a remark."""
    noted = {}
    for name in candidates:
        notes = [f"held: {fit.held[name]}"] if fit.held.get(name) else []
        if (own := fit.estimates.get(name)) is not None:
            notes += ["on a bound, one-sided interval"] if own.method == "one-sided" else []
            notes += [f"estimated with {listed(own.conditional_on)} held"] if own.conditional_on else []
            notes += [own.reason.rstrip(".")] if own.reason else []
            alone, (low, high) = own.ci95_independent, own.ci95 or (None, None)
            if alone and low is not None and high is not None and high - low > WIDER * (alone[1] - alone[0]):
                notes.append(f"as if the residuals were independent: {interval_text(alone)}")
        if notes:
            noted[name] = "; ".join(notes)
    return noted


def condition(s: RunSummary, subject: str = "They") -> str:
    """Return what the values that count rest on, in sentences; empty where the search was sure and what is left is noise."""
    sentences = []
    if s.counting.name == "fit" and s.search_doubt:
        sentences.append(f"{subject} may not be the best there are: {s.search_doubt}.")
        subject = "They"
    if s.counting.name and s.counts_conditional:
        sentences.append(f"{subject} hold only if nothing else is missing: {why_conditional(s)}.")
    return " ".join(sentences)


def why_conditional(s: RunSummary) -> str:
    """Return why the values that count hold only if nothing else is missing, as a sentence goes on."""
    left = s.remainder
    if s.counting.name == "effect" and left.held_out and not left.share and left.record:
        return f"in the held-out recording {left.record} more than the noise remains"
    fitted = s.sets.get("fitted")
    if s.counting.name == "fit" and s.counting.doubt and fitted is not None and fitted.verdict == "pass":
        return s.counting.doubt
    if s.counting.name == "fit" and s.counting.added:
        return f"without {s.counting.added} more than the noise remains"
    return "what remains is more than the noise"


def counting_sentence(s: RunSummary, door: Door = "shell") -> str:
    """Return which of the fitted values count, and what takes them; empty where there is only one set of them."""
    counts, export = s.counting, TO_DO["export"][door].replace(" STUDY --to FILE", "")
    if counts.name == "effect":
        return f"The values that count are those with {counts.added}: fitted-values.* and {export} take them."
    if counts.name == "fit" and counts.doubt:
        with_it = f" --values effect takes those with {counts.added}." if counts.added and door == "shell" else ""
        return f"The values that count are those of the fit without an effect: {counts.doubt}.{with_it}"
    return ""


def which_values(s: RunSummary) -> str:
    """Return which values the ones that count are, in a sentence."""
    if s.counting.name == "fit" and s.counting.doubt:
        return f"Fitted without an effect: {s.counting.doubt}. They may make up for what is missing."
    if s.counting.kind and any(p.effect is not None or p.by_place for p in s.parameters):
        kind = "" if s.counting.kind == "effect" else f" ({s.counting.kind})"
        return f"Fitted together with what the model lacks{kind}."
    if s.counting.name == "fit" and any(p.fitted is not None for p in s.parameters):
        return "Fitted; the model has no effect added."
    return "The fit has no estimates: the model keeps its given values." if s.fit else ""


# --- what is missing ---


def finding_name(f: FindingSummary) -> str:
    """Return the effects that a finding may be; of values that are off, that."""
    return "values that are off" if f.effect == "parameter" else one_of(f.same_as)


def place_texts(f: FindingSummary, join: Callable[[Iterable[str]], str] = ", ".join) -> dict[str, float]:
    """Return likely places with their probabilities, each once, with the signal that is brought in where that tells them apart,
    and with what the place implies for the values that depend on it."""
    sources: dict[str, set[str]] = {}
    for p in f.places:
        sources.setdefault(join(p.at), set()).add(p.source)
    probabilities: dict[str, float] = {}
    for p in f.places:
        at = join(p.at)
        at += f" from {p.source}" if p.source and len(sources[at]) > 1 else ""
        at += f" (then {sizes_text(p.values)})" if p.values else ""
        probabilities[at] = probabilities.get(at, 0.0) + p.probability
    return probabilities


def remainder_sentence(s: RunSummary) -> str:
    """Return what is left with the findings in the model; empty where that is noise, or where nothing was added."""
    r: RemainderSummary = s.remainder
    if not s.counting.kind or not r.more_than_noise:
        return ""
    parts = []
    if r.share is not None:
        at = f"; an unknown input at {r.at} would explain it" if r.at else ""
        parts.append(f"{gap_text(r.share)} of the gap is left and is not noise{at}")
    if r.held_out is not None:
        times = f" ({times_text(r.record_times)} the noise)" if r.record_times else ""
        where = f", most of it in {r.record}{times}" if r.record else ""
        parts.append(f"on held-out recordings {gap_text(r.held_out)} is left{where}")
    told = ". ".join([*parts[:1], *map(capital, parts[1:])])
    return told or ("" if r.adequate else "what is left is still not noise")


def gained_sentence(s: RunSummary) -> str:
    """Return what the addition does to the error on recordings that no fit has seen; empty where that is not known."""
    r = s.remainder
    if r.shrink is None:
        return ""
    times = None if r.times is None else times_text(r.times)
    rest = "" if times is None else f"; what is left there is {'' if times == '1 times' else f'{times} '}the noise"
    where = "experiments that no fit has seen" if r.against == "experiments" else r.against
    return (
        f"Adding it shrinks the error on {where} by {gap_text(r.shrink)}, measured against the same model with its "
        f"parameters fitted and nothing added{rest}."
    )


# --- what to do next ---


def advice(s: RunSummary) -> str:
    """Return what to record next; empty where nothing is advised."""
    return next((step.text for step in s.next if step.text), "")
