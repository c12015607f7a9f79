"""Ends of an FMU's process in words: crash, hang, slow run or exhausted memory, from what the system says of it."""

from __future__ import annotations

import linecache
import math
import re
import signal
from collections.abc import Sequence

from hvdc_ident.processes import MIB, Budget, Ending

CALL = re.compile(r"\b(fmi[23][A-Z]\w*)\s*\(|\b_(dlopen)\(")
BOUND = re.compile(r"fmi[23][A-Z]\w*")  # the name of a function bound by `fmu.binding`


def key(name: str, value: float) -> str:
    """Return how a limit is given: in the study, on the command line and in Python."""
    text = f"{value:.10g}"
    return f'`{name} = {text}` in the study\'s [model], --{name} {text}, or limits={{"{name}": {text}}} in Python'


def call_of(end: Ending) -> str:
    """Return where in the FMU a process was when it ended: "in fmi2DoStep"; empty where that is not known."""
    for file, line, name in end.frames():
        if BOUND.fullmatch(name):
            return f"in {name}"
        if call := CALL.search(linecache.getline(file, line)):
            return f"in {call[1]}" if call[1] else "in loading its library"
    return ""


def more_memory(budget: Budget) -> str:
    """Return the way to give more, in words."""
    return f"a larger limit in MiB, if it needs that much: {key('memory', budget.larger)}"


def crash(end: Ending, budget: Budget, when: str) -> tuple[str, str]:
    """Return a process that ended by itself, in words, and what to try. when: "in the run"."""
    how = f"its process {end}" if end.code < 0 else f"it ended itself with exit code {end.code} and no result"
    place = call_of(end)
    taken = budget.taken(end.resident, end.space)
    what = f"the FMU crashed {when}{f', {place}' if place else ''}: {how}"
    if budget.exhausted(taken):
        return f"{what}; {budget.told(taken)}", more_memory(budget)
    if end.code == -signal.SIGKILL:
        what += f", from outside, as the system does where memory is short; it had used {taken / MIB:.0f} MiB"
    return what, ""


def overdue(
    end: Ending, budget: Budget, what: str, limit: tuple[str, float], instants: Sequence[float], still: float | None
) -> tuple[str, str]:
    """Return a process that was ended for its deadline, in words, and what to try.

    what: the work. limit: the deadline's key and value, s. instants: first, last and present instant of the run, s, nan
    where not known. still: for how long, in s, the instant had not moved; None where it moved to the end.
    """
    name, deadline = limit
    start, stop, now = instants
    reached = not math.isnan(now)
    scale = "" if math.isnan(stop) else f" of {stop:.6g} s"
    taken = budget.taken(end.resident, end.space)
    if still is None and reached and now > start and not math.isnan(stop):
        times = (stop - start) / (now - start)
        enough = deadline * times
        text = (
            f"the FMU is slow: at t = {now:.6g} s{scale} when the deadline of {deadline:g} s for one run came, its process"
            f" was ended; at this pace {times:.2g} times the deadline would do"
        )
        hint = f"a longer deadline: {key(name, _above(1.2 * enough))}"
    else:
        text = f"the FMU hangs: no result of the {what} after {deadline:g} s, its process was ended"
        place = [f"at t = {now:.6g} s{scale}"] if reached else []
        place += list(filter(None, [call_of(end)]))
        if place and still is not None and reached:
            text += f"; it had stood {', '.join(place)} for {still:.2g} s"
        elif place:
            text += f"; it was {', '.join(place)}"
        hint = f"a longer deadline, if it is only slow: {key(name, _above(5.0 * deadline))}"
    if budget.exhausted(taken):
        return f"{text}; {budget.told(taken)}", more_memory(budget)
    return text, hint


def _above(seconds: float) -> float:
    """Return the number rounded up to two figures."""
    step = 10.0 ** (math.floor(math.log10(seconds)) - 1)
    return float(f"{math.ceil(seconds / step - 1e-9) * step:.12g}")
