"""Small plants drawn at random, as text: the same text makes the model card, and is evaluated here, by scipy alone.

Nothing here imports the package: the recordings are those of another simulation. A plant may have no state, no input, an
output that never moves or is an input, a parameter that does nothing, a loop without a state, limits, `time`.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.optimize import brentq, root

Array = NDArray[np.float64]
T = TypeVar("T")
WORD = re.compile(r"[A-Za-z_]\w*")


class Draw(Protocol):
    """Where choices come from: a seeded generator, or hypothesis."""

    def pick(self, options: Sequence[T]) -> T: ...
    def integer(self, low: int, high: int) -> int: ...


@dataclass(frozen=True)
class Seeded:
    """Choices of a numpy generator."""

    rng: np.random.Generator

    def pick(self, options: Sequence[T]) -> T:
        return options[int(self.rng.integers(len(options)))]

    def integer(self, low: int, high: int) -> int:
        return int(self.rng.integers(low, high + 1))


def number(draw: Draw, low: float, high: float) -> float:
    """A number of three digits between two others, both above 0, evenly in the logarithm."""
    share = draw.integer(0, 1000) / 1000
    return float(f"{low * (high / low) ** share:.3g}")


def chance(draw: Draw, percent: int) -> bool:
    return draw.integer(1, 100) <= percent


@dataclass(frozen=True)
class Plant:
    """Names to values or texts of the card's language. start: of a state, as text; left out, its rest.

    free: states whose start the card does not know.
    hidden: an effect of the plant that the card lacks, at the first input: ("lag" | "gain" | "limit" | "offset", size).
    """

    parameters: Mapping[str, float] = field(default_factory=dict)
    inputs: Mapping[str, float] = field(default_factory=dict)
    states: Mapping[str, str] = field(default_factory=dict)
    start: Mapping[str, str] = field(default_factory=dict)
    signals: Mapping[str, str] = field(default_factory=dict)
    algebraic: Mapping[str, str] = field(default_factory=dict)
    outputs: Mapping[str, str] = field(default_factory=dict)
    free: tuple[str, ...] = ()
    hidden: tuple[str, float] | None = None

    def seen(self) -> list[str]:
        """The parameters that some output leads back to."""
        texts = {**self.states, **self.signals, **self.algebraic}
        found, new = set(), {w for e in self.outputs.values() for w in WORD.findall(e)}
        while new:
            found |= new
            new = {w for n in new if n in texts for w in WORD.findall(texts[n])} - found
        return [n for n in self.parameters if n in found]

    def card(self, bounds: Mapping[str, tuple[float, float]]) -> str:
        """The text of the model card."""

        def table(name: str, lines: Mapping[str, str]) -> str:
            return f"[{name}]\n" + "".join(f"{n} = {text}\n" for n, text in lines.items()) if lines else ""

        def own(n: str, v: float) -> str:
            low, high = bounds.get(n, (None, None))
            return f"{{value = {v!r}" + ("" if low is None else f", min = {low!r}, max = {high!r}") + "}"

        starts = {n: f', start = "{"free" if n in self.free else s}"' for n, s in self.start.items()}
        return 'schema = 1\nname = "drawn"\n' + "".join(
            [
                table("parameters", {n: own(n, v) for n, v in self.parameters.items()}),
                table("inputs", {n: f"{{value = {v!r}}}" for n, v in self.inputs.items()}),
                table("states", {n: f'{{derivative = "{e}"{starts.get(n, "")}}}' for n, e in self.states.items()}),
                table("signals", {n: f'"{e}"' for n, e in self.signals.items()}),
                table("algebraic", {n: f'{{equation = "{e}", start = 0.1}}' for n, e in self.algebraic.items()}),
                table("outputs", {n: f'"{e}"' for n, e in self.outputs.items()}),
            ]
        )


# ------------------------------------------------------------------------------------------------------- its simulation

FUNCTIONS: dict[str, Any] = {
    "where": lambda condition, a, b: a if condition else b,
    "clip": lambda x, low, high: min(max(x, low), high),
    "sign": lambda x: float(np.sign(x)),
    "min": min, "max": max, "abs": abs, "sqrt": math.sqrt, "exp": math.exp, "log": math.log, "sin": math.sin,
    "cos": math.cos, "tan": math.tan, "tanh": math.tanh, "asin": math.asin, "acos": math.acos, "atan": math.atan,
    "atan2": math.atan2, "pi": math.pi, "__builtins__": {},
}  # fmt: skip

MOST_CALLS = 100_000
"""Evaluations of a recording, or until a plant is at rest, at most."""
Drive = Callable[[float], Mapping[str, float]]
"""The inputs at a time."""


class _Run:
    """The plant's equations as functions of time and state."""

    def __init__(self, plant: Plant, inputs: Drive) -> None:
        self.plant, self.inputs = plant, inputs
        texts = {
            **plant.states,
            **plant.signals,
            **plant.algebraic,
            **{f"out.{n}": e for n, e in plant.outputs.items()},
        }
        self.code = {n: compile(e, n, "eval") for n, e in texts.items()}
        self.lagged = plant.hidden is not None and plant.hidden[0] == "lag"
        self.left = MOST_CALLS

    def known(self, t: float, x: Sequence[float]) -> dict[str, float]:
        """Every name's value."""
        plant = self.plant
        given = dict(self.inputs(t))
        at: dict[str, float] = {**plant.parameters, **given, **dict(zip(plant.states, x, strict=False)), "time": t}
        if plant.hidden:
            first = next(iter(plant.inputs))
            at[first] = self._seen(given[first], x)
        for name, text in plant.signals.items():
            for z in (z for z in plant.algebraic if z in text and z not in at):
                at[z] = self._solved(z, at)
            at[name] = self._value(name, at)
        for z in (z for z in plant.algebraic if z not in at):
            at[z] = self._solved(z, at)
        return at

    def _seen(self, u: float, x: Sequence[float]) -> float:
        assert self.plant.hidden is not None
        kind, size = self.plant.hidden
        return {"lag": x[-1] if len(x) else u, "gain": size * u, "limit": min(max(u, -size), size), "offset": u + size}[
            kind
        ]

    def _value(self, name: str, at: Mapping[str, float]) -> float:
        return float(eval(self.code[name], FUNCTIONS, dict(at)))

    def _solved(self, z: str, at: Mapping[str, float]) -> float:
        return float(brentq(lambda v: self._value(z, {**at, z: v}) - v, -1e3, 1e3, xtol=1e-13))

    def slope(self, t: float, x: Sequence[float]) -> list[float]:
        self.left -= 1
        if not self.left:
            raise ArithmeticError("it takes too long")
        at = self.known(t, x)
        slope = [self._value(n, at) for n in self.plant.states]
        if self.lagged:
            assert self.plant.hidden is not None
            slope.append((self.inputs(t)[next(iter(self.plant.inputs))] - x[-1]) / self.plant.hidden[1])
        return slope

    def begin(self, t: float) -> Array:
        """The states at the start: what is given, else the rest."""
        plant = self.plant
        count = len(plant.states) + self.lagged
        given = {
            k: float(eval(plant.start[n], FUNCTIONS, dict(plant.parameters)))
            for k, n in enumerate(plant.states)
            if n in plant.start
        }
        free = [k for k in range(count) if k not in given]
        x = np.full(count, 0.1)
        x[list(given)] = list(given.values())
        if not free:
            return x

        def rest(values: Array) -> Array:
            x[free] = values
            return np.array(self.slope(t, x))[free]

        settled = solve_ivp(lambda s, v: rest(v), (0.0, 200.0), x[free], method="LSODA", rtol=1e-7, atol=1e-9)
        found = root(rest, settled.y[:, -1])
        if not np.abs(rest(found.x)).max() < 1e-8:
            raise ArithmeticError("no rest")
        x[free] = found.x
        return x

    def outputs(self, t: float, x: Sequence[float]) -> list[float]:
        at = self.known(t, x)
        if self.plant.hidden:  # an output that is the input shows the recorded one
            first = next(iter(self.plant.inputs))
            if any(e == first for e in self.plant.outputs.values()):
                at = {**at, first: self.inputs(t)[first]}
        return [self._value(f"out.{n}", at) for n in self.plant.outputs]


def recorded(plant: Plant, time: Array, inputs: Mapping[str, Array], linear: bool) -> Array:
    """(rows, outputs) at the rows; the inputs hold until the next row, or are joined by lines. Raises ArithmeticError or
    ValueError for a plant that has no rest, or runs away."""

    def drive(t: float) -> dict[str, float]:
        if linear:
            return {n: float(np.interp(t, time, u)) for n, u in inputs.items()}
        return {n: float(u[max(int(np.searchsorted(time, t, "right")) - 1, 0)]) for n, u in inputs.items()}

    run = _Run(plant, drive)
    x = run.begin(float(time[0]))
    rows = [run.outputs(float(time[0]), x)]
    run.left = MOST_CALLS
    for start, end in pairwise(time):
        held = drive(float(start))
        run.inputs = drive if linear else lambda _, held=held: held
        if x.size:
            found = solve_ivp(run.slope, (start, end), x, method="LSODA", rtol=1e-8, atol=1e-10)
            x = found.y[:, -1]
            if not found.success or not np.abs(x).max() < 1e4:
                raise ArithmeticError("it runs away")
        run.inputs = drive
        rows.append(run.outputs(float(end), x))
    y = np.array(rows)
    if not (np.isfinite(y).all() and np.abs(y).max() < 1e5):
        raise ArithmeticError("it runs away")
    return y


# ------------------------------------------------------------------------------------------------------------- drawing


class _Parts:
    """A plant as it grows."""

    def __init__(self, draw: Draw) -> None:
        self.draw = draw
        self.parameters: dict[str, float] = {}
        self.states: dict[str, str] = {}
        self.start: dict[str, str] = {}
        self.signals: dict[str, str] = {}
        self.algebraic: dict[str, str] = {}

    def p(self, low: float, high: float) -> str:
        """The name of a new parameter."""
        name = self.draw.pick(["K", "T", "a", "Kp", "gain_", "R"]) + str(len(self.parameters))
        self.parameters[name] = number(self.draw, low, high)
        return name

    def state(self) -> str:
        """The name of a new state, whose derivative is still to come."""
        name = f"{self.draw.pick(['x', 'w', 'v'])}{len(self.states)}"
        self.states[name] = ""
        return name


def _single(b: _Parts, e: str) -> str:
    x, t = b.state(), b.p(0.05, 0.8)
    forms = {
        "lag": lambda: f"({b.p(0.5, 2)}*{e} - {x})/{t}",
        "product": lambda: f"({b.p(0.5, 2)}*{b.p(0.5, 2)}*{e} - {x})/{t}",
        "cubic": lambda: f"({e} - {x} - {b.p(0.1, 2)}*{x}**3)/{t}",
        "clip": lambda: f"(clip({e}, -{(level := b.p(0.2, 1.5))}, {level}) - {x})/{t}",
        "tanh": lambda: f"({b.p(0.5, 2)}*tanh({e}) - {x})/{t}",
        "tank": lambda: f"(max({e}, 0.05) - {b.p(0.5, 2)}*sqrt(max({x}, 0.01)))/{t}",
        "min": lambda: f"(min({e}, {b.p(0.3, 1)}) - max({x}, -2))/{t}",
        "where": lambda: f"(where({e} > {b.p(0.2, 0.8)}, {e}, 0.5*{e}) - {x})/{t}",
        "dead": lambda: f"where(abs({e} - {x}) > 0.02, {e} - {x}, 0)/{t}",
        "diode": lambda: f"({e} - 0.01*(exp(clip(4*{x}, -20, 20)) - 1) - {x})/{t}",
        "angle": lambda: f"(atan2({e}, {b.p(0.5, 2)}) + asin(clip({e}, -0.9, 0.9)) - {x})/{t}",
        "time": lambda: f"({e} + 0.2*sin({b.p(2, 6)}*time) - {x})/{t}",
        "integrator": lambda: f"{b.p(0.1, 1)}*({e} - 0.2)",
        "rate": lambda: f"clip(({e} - {x})/{t}, -{(rate := b.p(0.3, 3))}, {rate})",
        "log": lambda: f"(log(1 + abs({e})) - {x}*abs({x}) - 0.1*{x})/{t}",
    }  # fmt: skip
    kind = b.draw.pick([*forms, "lag", "lag"])
    b.states[x] = forms[kind]()
    if kind in ("time", "integrator", "dead"):
        b.start[x] = b.draw.pick(["0.1", "0.25"])
    elif chance(b.draw, 15):
        b.start[x] = b.draw.pick(["0.0", "0.3", f"0.2*{t}"])
    return x


def _double(b: _Parts, e: str) -> str:
    x, v = b.state(), b.state()
    kind = b.draw.pick(["oscillator", "pi", "swing", "loop"])
    if kind == "oscillator":
        w, z = b.p(2, 12), b.p(0.1, 1.2)
        b.states[x], b.states[v] = v, f"{w}**2*({e} - {x}) - 2*{z}*{w}*{v}"
    elif kind == "pi":
        err = f"err_{x}"
        b.signals[err] = f"{e} - {x}"
        b.states[v] = f"{b.p(1, 6)}*{err}"
        b.states[x] = f"({b.p(0.5, 4)}*{err} + {v} - {x})/{b.p(0.05, 0.5)}"
    elif kind == "swing":
        b.states[x], b.states[v] = v, f"(clip({e}, -0.8, 0.8) - sin({x}) - {b.p(0.3, 2)}*{v})/{b.p(0.05, 0.5)}"
    else:
        order = f"order_{x}"
        b.signals[order] = f"{b.p(1, 6)}*({e} - {v})"
        b.states[x] = f"(clip({order}, -2, 2) - {x})/{b.p(0.05, 0.3)}"
        b.states[v] = f"({x} - {v})/{b.p(0.1, 0.5)}"
    return x


def plant(draw: Draw) -> Plant:
    """A plant of at most four states."""
    b = _Parts(draw)
    inputs = {n: draw.pick([0.0, 0.3, 0.5]) for n in ["u", "load"][: draw.pick([0, 1, 1, 1, 1, 2])]}
    drives = [*inputs] or ["0.4"]
    size, made = draw.pick([0, 1, 1, 2, 2, 3, 4]), []
    while len(b.states) < size:
        e = draw.pick([*drives, *made[-1:], *made[-1:]])
        if len(inputs) == 2 and chance(draw, 40):
            e = f"({e} - 0.3*load)"
        made.append(_double(b, e) if size - len(b.states) > 1 and chance(draw, 50) else _single(b, e))
    about = [*b.states, *inputs] or ["0.4"]
    if chance(draw, 20):
        e = draw.pick(about)
        b.algebraic["z"] = draw.pick(
            [lambda: f"{e} - {b.p(0.3, 3)}*tanh(z)", lambda: f"0.5*({e} + {b.p(0.3, 1.2)}*cos(z))"]
        )()
        about.append("z")
    if (not b.states and not b.algebraic) or chance(draw, 15):
        e = draw.pick(about)
        curves = {
            "rise": lambda: f"{b.p(0.5, 2)}*(1 - exp(-{b.p(0.5, 3)}*time))",
            "decay": lambda: f"{b.p(0.5, 2)}*exp(-{b.p(0.5, 3)}*time) + {e}",
            "line": lambda: f"{b.p(0.5, 2)}*{e} + {b.p(0.1, 1)}",
            "square": lambda: f"{b.p(0.5, 2)}*{e}**2",
        }
        b.signals["curve"] = curves[draw.pick([*curves])]()
        about.append("curve")
    if chance(draw, 40):
        e = draw.pick(about)
        b.signals["power"] = draw.pick(
            [f"{e}*{draw.pick(about)}", f"abs({e})", f"sign({e})*{e}**2", f"where({e} > 0.4, 1, 0)"]
        )
        about.append("power")
    if chance(draw, 25):
        b.p(0.5, 2)  # without effect
    if not b.parameters:
        b.p(0.5, 2)
    outputs = {}
    for k in range(draw.pick([1, 1, 2, 2, 3, 6])):
        e, f = draw.pick(about), draw.pick(about)
        kind = draw.integer(1, 100)
        rest = [f"{draw.pick([*b.parameters])}", "1.5", "time", *inputs]
        outputs[f"y{k}"] = (
            e
            if kind < 55
            else draw.pick([f"{e} + 0.5*{f}", f"{e}*{f}", f"2*{e} - 1"])
            if kind < 85
            else draw.pick(rest)
        )
    hidden = None
    if inputs and chance(draw, 35):
        hidden = draw.pick(
            [("lag", number(draw, 0.03, 0.3)), ("gain", 1.3), ("limit", number(draw, 0.3, 0.9)), ("offset", 0.1)]
        )
    free = tuple(n for n in b.start if chance(draw, 20))
    return Plant(b.parameters, inputs, b.states, b.start, b.signals, b.algebraic, outputs, free, hidden)
