"""The exceptions of the package.

    HvdcIdentError
    ├── InputError              the input is wrong: exit code 2 on the command line
    │   ├── ExpressionError     text that is no expression of the grammar
    │   ├── ModelError          a model or model card that does not hold together
    │   │   └── TimingError     a delay or sampling period that cannot be simulated at these values of the parameters
    │   ├── UnknownNameError    a name that is not there, with the nearest ones
    │   ├── WaveformError       a data file or signal that cannot be used
    │   ├── StudyError          a study file that asks for the impossible
    │   ├── SteadyStateError    a model that has no steady state where one was asked for
    │   └── LinearizationError  a point, loop or reduction that has no linear answer
    ├── ComputationError        the work ran and failed: exit code 1
    │   ├── SimulationError     a trajectory that did not reach its end
    │   └── FitError            an estimation that did not reach an optimum
    └── InstallationError       a part of the package is not there, or of another version: exit code 1

Every message says what is wrong, where, what was expected, what was found and what to try.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable, Collection, Iterable, Iterator
from contextlib import contextmanager
from functools import wraps
from typing import Any, ParamSpec, TypeVar

from hvdc_ident.next_step import Door, NextStep, next_phrases

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")


class HvdcIdentError(Exception):
    """Base of every error the package raises on purpose.

    Parts that are known are printed one after the other: `what (where): expected ..., got .... Try: ...`. next: what to do, as values,
    which `door` has its own words for.
    """

    def __init__(
        self,
        what: str,
        *,
        where: str = "",
        expected: str = "",
        got: str = "",
        hint: str = "",
        next: tuple[NextStep, ...] = (),
        door: Door = "shell",
    ) -> None:
        self.what, self.where, self.expected, self.got, self.hint = what, where, expected, got, hint
        self.next, self.door = next, door
        super().__init__(str(self))

    def __str__(self) -> str:
        text = f"{self.where}: {self.what}" if self.where else self.what
        if self.expected:
            text += f"; expected {self.expected}"
        if self.got:
            text += f", got {self.got}" if self.expected else f"; got {self.got}"
        tried = "; ".join(filter(None, [self.hint, next_phrases(self.next, self.door)]))
        return text + (f". Try: {tried}" if tried else "")

    def at(self, where: str) -> HvdcIdentError:
        """Return the error with an outer place put before its own."""
        place = f"{where}: {self.where}" if self.where else where
        return _rebuild(type(self), self.what, {**self._parts, "where": place})

    def read_in(self, door: Door) -> HvdcIdentError:
        """Return the error itself, its next step in the words of the place where it is read from now on."""
        self.door = door
        self.args = (str(self),)
        return self

    @property
    def _parts(self) -> dict[str, Any]:
        return {n: getattr(self, n) for n in ("where", "expected", "got", "hint", "next", "door")}

    def __reduce__(self) -> tuple[object, ...]:
        return _rebuild, (type(self), self.what, self._parts)


def in_python(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Return the function as a caller in Python meets it: its errors say what to do in Python."""

    @wraps(function)
    def called(*arguments: Arguments.args, **settings: Arguments.kwargs) -> Result:
        try:
            return function(*arguments, **settings)
        except HvdcIdentError as error:
            raise error.read_in("python") from error.__cause__

    return called


@contextmanager
def located(where: str) -> Iterator[None]:
    """Put a place before that of an InputError that is raised inside."""
    try:
        yield
    except InputError as e:
        raise e.at(where) from None


def _rebuild(kind: type[HvdcIdentError], what: str, parts: dict[str, Any]) -> HvdcIdentError:
    return kind(what, **parts)


class InputError(HvdcIdentError):
    """The input is wrong."""


class ExpressionError(InputError):
    """Text that is not an expression of the grammar."""


class ModelError(InputError):
    """A model that does not hold together."""


class TimingError(ModelError):
    """A delay or sampling period that cannot be simulated at these values; a search that meets it looks elsewhere."""


class UnknownNameError(InputError):
    """A name that is not there."""


class WaveformError(InputError):
    """Recorded data that cannot be used."""


class StudyError(InputError):
    """A study that asks for the impossible."""


class SteadyStateError(InputError):
    """No steady state where one is needed."""


class LinearizationError(InputError):
    """No linear model, margin or reduction where one was asked for."""


class ComputationError(HvdcIdentError):
    """The work ran and failed."""


class SimulationError(ComputationError):
    """A trajectory that did not reach its end."""


class SteadyStartError(SimulationError):
    """A trajectory that has no steady state to begin at, or none that was found."""


class FitError(ComputationError):
    """An estimation that did not reach an optimum."""


class InstallationError(HvdcIdentError):
    """A part of the package that is not there, or of another version: nothing that was asked for is at fault."""


LINE = 100
"""Characters: a message shows as many known names as a line holds, and never more than 12."""


def one_line(error: BaseException, most: int = 500) -> str:
    """Return the kind and the words of an error in one line of at most so many characters."""
    return " ".join(f"{type(error).__name__}: {error}".split())[:most]


def nearest(name: str, known: Iterable[str]) -> list[str]:
    """Return the known names that are most like a name, at most 3 that are equally like it; none where all are far from it."""
    near = difflib.get_close_matches(name, known, n=3, cutoff=0.5)
    likeness = {n: difflib.SequenceMatcher(None, n, name).ratio() for n in near}
    return [n for n in near if likeness[n] == max(likeness.values())]


def unknown_name(
    kind: str, name: str, known: Iterable[str], *, where: str = "", listing: NextStep | None = None, hint: str = ""
) -> UnknownNameError:
    """Return the error for a name that is not among the known ones, with the nearest of them as the hint.

    listing: the step that lists all of them, said where the message cannot. hint: what to try where none is near.
    """
    names = [str(k) for k in known]
    near = nearest(name, names)
    if not near and name.strip():  # the end of a path in a hierarchy is near to none of its names
        part = name.strip().casefold()
        near = sorted((n for n in names if part in n.casefold()), key=len)[:3]
    shown = ", ".join(names[: _shown(names)])
    more = len(names) - _shown(names)
    return UnknownNameError(
        f"no {kind} '{name}'",
        where=where,
        expected=(f"one of {shown}" + (f" and {more} more" if more else "")) if names else f"no {kind}s at all",
        hint=f"did you mean {' or '.join(repr(n) for n in near)}?" if near else hint,
        next=(listing,) if listing is not None and more else (),
    )


def require_known(kind: str, names: Iterable[str] | None, known: Collection[str], where: str, hint: str = "") -> None:
    """Raise UnknownNameError for the first of the names that is not among the known ones."""
    for name in names or ():
        if name not in known:
            raise unknown_name(kind, name, known, where=where, hint=hint)


def _shown(names: list[str]) -> int:
    """Return how many names a message shows."""
    total = 0
    for count, name in enumerate(names[:12]):
        total += len(name) + 2
        if total > LINE and count:
            return count
    return min(len(names), 12)
