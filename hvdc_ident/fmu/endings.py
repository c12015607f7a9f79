"""Ends of an FMU's process in words: crash, hang, slow run or exhausted memory, from what the system says of it."""

from __future__ import annotations

import linecache
import math
import re
import signal
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

MIB = 2**20
EXHAUSTED = 0.5
"""Share of its memory from which an FMU may have run out of it: one that grows by doubling is refused from half on."""
CALL = re.compile(r"\b(fmi[23][A-Z]\w*)\s*\(|\b_(dlopen)\(")
FRAME = re.compile(r'^\s*File "(?P<file>.*)", line (?P<line>\d+) in (?P<name>\w*)')
BOUND = re.compile(r"fmi[23][A-Z]\w*")  # the name of a function bound by `fmu.binding`


@dataclass(frozen=True)
class Ending:
    """A process that ended.

    code: its exit code, negative where a signal ended it. resident, space: the most bytes of memory and of address space
    that it had; 0 where the system did not tell. traces: Python's frames when it crashed or was ended, innermost first.
    """

    code: int
    resident: int = 0
    space: int = 0
    traces: str = ""

    @classmethod
    def heard(cls, heading: dict[str, Any]) -> Ending:
        """The ending that a supervisor told."""
        return cls(heading["code"], heading["resident"], heading["space"], heading["traces"])

    @property
    def call(self) -> str:
        """Where in the FMU it was: "in fmi2DoStep"; empty where that is not known."""
        return where(self.traces)


@dataclass(frozen=True)
class Budget:
    """The memory that a worker may take, in bytes: `most` more than it began with. None: no limit."""

    most: int | None
    resident: int = 0
    space: int = 0

    def taken(self, resident: int, space: int) -> int:
        """Bytes taken since the worker began: of the address space, which the limit is on, where that is known."""
        return max(resident - self.resident if resident else 0, space - self.space if space else 0, 0)

    def exhausted(self, taken: int) -> bool:
        """Return whether the FMU may have run out of it."""
        return self.most is not None and taken >= EXHAUSTED * self.most

    def told(self, taken: int) -> str:
        """The memory taken, in words."""
        assert self.most is not None
        return f"it had used {taken / MIB:.0f} of its {self.most / MIB:.0f} MiB of memory"

    @property
    def hint(self) -> str:
        """The way to give more, in words."""
        assert self.most is not None
        more = math.ceil(2 * self.most / MIB)
        return f"a larger limit in MiB, if it needs that much: {key('memory', more)}"


def key(name: str, value: float) -> str:
    """Return how a limit is given: in the study, on the command line and in Python."""
    text = f"{value:.10g}"
    return f'`{name} = {text}` in the study\'s [model], --{name} {text}, or limits={{"{name}": {text}}} in Python'


def where(traces: str) -> str:
    """The FMI call of the innermost frame that is one, from a dump of Python's `faulthandler`."""
    for line in traces.splitlines():
        found = FRAME.match(line)
        if found is None:
            continue
        if BOUND.fullmatch(found["name"]):
            return f"in {found['name']}"
        call = CALL.search(linecache.getline(found["file"], int(found["line"])))
        if call is not None:
            return f"in {call[1]}" if call[1] else "in loading its library"
    return ""


def crash(end: Ending, budget: Budget, when: str) -> tuple[str, str]:
    """A process that ended by itself, in words, and what to try. when: "in the run"."""
    how = _signalled(-end.code) if end.code < 0 else f"it ended itself with exit code {end.code} and no result"
    place = f", {end.call}" if end.call else ""
    taken = budget.taken(end.resident, end.space)
    what = f"the FMU crashed {when}{place}: {how}"
    if budget.exhausted(taken):
        return f"{what}; {budget.told(taken)}", budget.hint
    if end.code == -signal.SIGKILL:
        what += f", from outside, as the system does where memory is short; it had used {taken / MIB:.0f} MiB"
    return what, ""


def overdue(
    end: Ending, budget: Budget, what: str, limit: tuple[str, float], instants: Sequence[float], still: float | None
) -> tuple[str, str]:
    """A process that was ended for its deadline, in words, and what to try.

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
        place += [end.call] if end.call else []
        if place and still is not None and reached:
            text += f"; it had stood {', '.join(place)} for {still:.2g} s"
        elif place:
            text += f"; it was {', '.join(place)}"
        hint = f"a longer deadline, if it is only slow: {key(name, _above(5.0 * deadline))}"
    if budget.exhausted(taken):
        return f"{text}; {budget.told(taken)}", budget.hint
    return text, hint


def _above(seconds: float) -> float:
    """The number rounded up to two figures."""
    step = 10.0 ** (math.floor(math.log10(seconds)) - 1)
    return float(f"{math.ceil(seconds / step - 1e-9) * step:.12g}")


def _signalled(number: int) -> str:
    try:
        return f"its process was ended by {signal.Signals(number).name}"
    except ValueError:
        return f"its process was ended by signal {number}"
