"""Experiments that could be made next: a step, a ramp or a multisine of one input, and a step followed by another's."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from hvdc_ident.data import Array, Experiment, InputSignal
from hvdc_ident.immutable import FrozenMap

Shape = Literal["step", "ramp", "multisine"]
FACTORS = (1.0, -1.0, 2.0)
"""Levels of a step, in multiples of the largest move of that input so far."""
UNMOVED = 0.05
"""An input that was never moved is moved by this share of its value, or of what inputs of its unit usually are."""
HARMONICS = (1, 2, 4, 8, 16)
PER_PERIOD = 20
"""Points of the fastest sine in a period."""


@dataclass(frozen=True)
class Move:
    """What one input does. before, after: in its unit (of a multisine the middle and the highest value); at: s;
    seconds: how long a ramp takes, or a multisine's slowest period."""

    input: str
    shape: Shape
    before: float
    after: float
    at: float
    seconds: float = 0.0

    @property
    def frequencies(self) -> tuple[float, ...]:
        """Hz: what a multisine consists of; empty for the others."""
        return tuple(k / self.seconds for k in HARMONICS) if self.shape == "multisine" else ()

    def signal(self, end: float) -> InputSignal:
        """The input up to `end`, s."""
        if self.shape == "step":
            return InputSignal.step(self.at, self.before, self.after)
        if self.shape == "ramp":
            return InputSignal.ramp(self.at, self.before, self.at + self.seconds, self.after)
        time = np.arange(self.at, end, self.seconds / (HARMONICS[-1] * PER_PERIOD))
        values = self.before + (self.after - self.before) * _multisine((time - self.at) / self.seconds)
        return InputSignal(np.r_[self.at, time], np.r_[self.before, values], time)

    def text(self, units: Mapping[str, str]) -> str:
        """The move in words, to begin a sentence with."""
        unit = f" {units[self.input]}" if units.get(self.input) else ""
        if self.shape == "multisine":
            hertz = ", ".join(f"{f:.3g}" for f in self.frequencies)
            size = abs(self.after - self.before)
            return f"superimpose on {self.input} ({self.before:g}{unit}) sines of {hertz} Hz together, peak {size:.4g}{unit}"
        span = f"{self.input} from {self.before:g} to {self.after:g}{unit}"
        return f"step {span}" if self.shape == "step" else f"ramp {span} in {self.seconds:.3g} s"

    def to_dict(self) -> dict[str, Any]:
        """The move as JSON takes it."""
        more: dict[str, Any] = {"seconds": self.seconds} if self.shape == "ramp" else {}
        if self.shape == "multisine":
            more = {"frequencies_hz": list(self.frequencies)}
        return {"input": self.input, "shape": self.shape, "from": self.before, "to": self.after, "at": self.at, **more}


def _multisine(phase: Array) -> Array:
    """Sines of equal size with Schroeder's phases (doi 10.1109/TIT.1970.1054411), largest value 1, over so many periods."""
    count = len(HARMONICS)
    parts = [np.sin(2 * np.pi * k * phase - np.pi * i * (i + 1) / count) for i, k in enumerate(HARMONICS)]
    whole = np.sum(parts, axis=0)
    return np.asarray(whole / np.abs(whole).max())


@dataclass(frozen=True)
class Trial:
    """One experiment that could be made; of two moves the second comes when the first has had half of the time."""

    moves: tuple[Move, ...]

    @property
    def kind(self) -> str:
        """Step, ramp or multisine; "step + step" where a second input follows."""
        return " + ".join(m.shape for m in self.moves)

    @property
    def inputs(self) -> tuple[str, ...]:
        """The inputs that move."""
        return tuple(m.input for m in self.moves)

    def experiment(self, template: Experiment) -> Experiment:
        """The experiment over the template's instants; nothing is recorded, so every output is given."""
        end = float(template.time[-1])
        signals = FrozenMap({m.input: m.signal(end) for m in self.moves})
        return Experiment(template.time, self.kind, inputs=signals, event=self.moves[0].at)

    def text(self, units: Mapping[str, str]) -> str:
        """The trial in words, without a full stop."""
        words = self.moves[0].text(units)
        if len(self.moves) > 1:
            words += f" and, {self.moves[1].at - self.moves[0].at:.3g} s later, {self.moves[1].text(units)}"
        return words[:1].upper() + words[1:]


def single_trials(
    experiments: Sequence[Experiment], inputs: Mapping[str, float], units: Mapping[str, str], template: Experiment
) -> Iterator[Trial]:
    """Every input alone: three steps, a ramp and a multisine. inputs: start values; units: of the inputs."""
    at, left = _begin(template)
    for name, value in inputs.items():
        move = _largest_move(experiments, name) or _usual(name, inputs, units)
        for factor in FACTORS:
            yield Trial((Move(name, "step", value, _rounded(value + factor * move), at),))
        yield Trial((Move(name, "ramp", value, _rounded(value + move), at, left / 4.0),))
        yield Trial((Move(name, "multisine", value, _rounded(value + abs(move)), at, left / 2.0),))


def double_trials(first: Sequence[Trial], singles: Sequence[Trial], template: Experiment) -> Iterator[Trial]:
    """Each of the given steps, followed half-way through the record by a step of another input at its first level."""
    at, left = _begin(template)
    seconds: dict[str, Move] = {}
    for trial in singles:
        if trial.kind == "step":
            seconds.setdefault(trial.inputs[0], trial.moves[0])
    for trial in first:
        move = trial.moves[0]
        for name, other in seconds.items():
            if name != move.input:
                yield Trial((move, Move(name, "step", other.before, other.after, at + left / 2.0)))


def _begin(template: Experiment) -> tuple[float, float]:
    """When the trial begins and how long it then lasts, s."""
    time = template.time
    at = template.event if template.event is not None else float(time[0] + 0.1 * np.ptp(time))
    return at, max(float(time[-1]) - at, 1e-3 * float(np.ptp(time)))


def _largest_move(experiments: Sequence[Experiment], name: str) -> float:
    """The largest move of the input made so far, with its sign; 0 where it never moved."""
    signals = [e.inputs[name] for e in experiments if name in e.inputs and name not in e.drive]
    moves = [s.values - s.values[0] for s in signals]
    return max((float(m[np.argmax(np.abs(m))]) for m in moves), key=abs, default=0.0)


def _usual(name: str, inputs: Mapping[str, float], units: Mapping[str, str]) -> float:
    """A move of an input that was never moved."""
    same = [abs(v) for n, v in inputs.items() if v and units.get(n, "") == units.get(name, "")]
    return UNMOVED * (abs(inputs[name]) or (float(np.median(same)) if same else 1.0))


def _rounded(value: float) -> float:
    return float(f"{value:.12g}")
