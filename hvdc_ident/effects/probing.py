"""Sizes at which the search for an effect begins, and the bounds within which a refit may move its parameters.

    signal = SignalScales.of(times, values)               # the signal at the insertion point, in each experiment
    for probe in probes(effect, signal, source):          # a few finite sizes
        use = probe.use(at=("Ir1",), source="Vdc2")       # for `apply_effects`; its values are the refit's start
        probe.free                                        # {parameter: (min, max)} of the refit, finite, min < start < max
        probe.model_names(use)                            # the same under the names that the model then has

`probe.free` names the parameters to estimate; the others keep the probe's value. Bounds more than a decade apart and above
0 suit a logarithmic scale.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import sympy as sp

from hvdc_ident.data import Array
from hvdc_ident.effects.base import Effect, EffectParameter, Measure
from hvdc_ident.effects.placement import EffectUse, apply_effects
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, Output, insertion_point
from hvdc_ident.parameters import Input, Parameter


@dataclass(frozen=True)
class SignalScales:
    """Range and time scales of a signal over all experiments, from which the sizes of an effect are chosen.

    low, high: its extremes; rest: its largest magnitude at the start of an experiment; all in its unit. fast, slow: the
    shortest and the longest time scale considered, s. tones: frequencies, Hz, that stand out in the residual.
    """

    low: float
    high: float
    rest: float
    fast: float
    slow: float
    tones: tuple[float, ...] = ()

    @classmethod
    def of(cls, times: Sequence[Array], values: Sequence[Array], tones: Iterable[float] = ()) -> SignalScales:
        """Return the scales of a signal: times in s and values in its unit, one array an experiment each.

        fast is a twentieth of the time in which the signal, at its quickest, crosses its range, and at least half a
        sampling interval; slow is a fifth of the longest experiment.
        """
        low, high = min(float(v.min()) for v in values), max(float(v.max()) for v in values)
        interval = min(float(np.median(np.diff(t))) for t in times)
        slope = max(
            float(np.abs(np.diff(v) / np.maximum(np.diff(t), 1e-12)).max()) for t, v in zip(times, values, strict=True)
        )
        rise = (high - low) / slope if slope > 0 else math.inf
        slow = max(float(t[-1] - t[0]) for t in times) / 5.0
        fast = min(max(0.05 * rise, 0.5 * interval), 0.25 * slow)
        return cls(low, high, max(abs(float(v[0])) for v in values), fast, slow, tuple(tones))

    @classmethod
    def joined(cls, signals: Sequence[SignalScales]) -> SignalScales:
        """Return the scales that cover several signals whose insertion points share an effect."""
        return cls(
            min(s.low for s in signals),
            max(s.high for s in signals),
            max(s.rest for s in signals),
            min(s.fast for s in signals),
            max(s.slow for s in signals),
            tuple(dict.fromkeys(f for s in signals for f in s.tones)),
        )

    @property
    def peak(self) -> float:
        """Largest magnitude; 1 where the signal is always 0."""
        return max(abs(self.low), abs(self.high)) or 1.0

    @property
    def range(self) -> float:
        """Peak-to-peak range in the signal's unit; a thousandth of its peak where the signal is constant."""
        return max(self.high - self.low, 1e-3 * self.peak)

    @property
    def excursion(self) -> float:
        """Rise of the magnitude above its value at rest, in the signal's unit; at least a thousandth of the peak."""
        return max(self.peak - self.rest, 1e-3 * self.peak)

    def time(self, share: float) -> float:
        """Return the time, s, at a share of the way from fast to slow on a logarithmic scale."""
        return self.fast * (self.slow / self.fast) ** share


Size = Callable[[float, SignalScales, SignalScales, Mapping[str, float]], float]
_SIZES: dict[Measure, Size] = {
    "one": lambda x, u, source, p: x,
    "time": lambda x, u, source, p: u.time(x),
    "record/n": lambda x, u, source, p: 5.0 * u.slow / x,
    "time*R": lambda x, u, source, p: u.time(x) * p["R"],
    "rate": lambda x, u, source, p: 1.0 / u.time(x),
    "range": lambda x, u, source, p: x * u.range,
    "peak": lambda x, u, source, p: x * u.peak,
    "peak/n": lambda x, u, source, p: u.peak / x,
    "excursion": lambda x, u, source, p: u.peak + (x - 1.0) * u.excursion,
    "range/time": lambda x, u, source, p: u.range / u.time(x),
    "range/source": lambda x, u, source, p: x * u.range / source.range,
    "range/source2": lambda x, u, source, p: x * u.range / source.peak**2,
    "range/record": lambda x, u, source, p: x * u.range / (5.0 * u.slow),
    "one/record": lambda x, u, source, p: x / (5.0 * u.slow),
    "one/source": lambda x, u, source, p: x / source.peak,
    "source peak": lambda x, u, source, p: x * source.peak,
    "source low": lambda x, u, source, p: x * source.low,
    "source high": lambda x, u, source, p: x * source.high,
    "bend 2": lambda x, u, source, p: x * u.range / u.peak**2,
    "bend 3": lambda x, u, source, p: x * u.range / u.peak**3,
    "of T2": lambda x, u, source, p: x * p["T2"],
    "of up": lambda x, u, source, p: x * p["up"],
    "above low": lambda x, u, source, p: u.low + x * u.range,
    "below high": lambda x, u, source, p: u.high - x * u.range,
}
_SEARCH: dict[Measure, tuple[float, float]] = {
    "one": (-10.0, 10.0),
    "time": (-0.5, 1.3),
    "record/n": (1e4, 2.0),
    "time*R": (-0.5, 1.3),
    "rate": (1.3, -0.5),
    "range": (-2.0, 2.0),
    "peak": (0.1, 20.0),
    "peak/n": (5000.0, 0.3),
    "excursion": (0.02, 1.5),
    "range/time": (1.3, -0.5),
    "range/source": (-2.0, 2.0),
    "range/source2": (-2.0, 2.0),
    "range/record": (-2.0, 2.0),
    "one/record": (-2.0, 2.0),
    "one/source": (-2.0, 2.0),
    "source peak": (1e-3, 1.0),
    "source low": (1.0, 1.0),
    "source high": (1.0, 1.0),
    "bend 2": (-2.0, 2.0),
    "bend 3": (-2.0, 2.0),
    "of T2": (0.02, 50.0),
    "of up": (0.02, 50.0),
    "above low": (1e-3, 0.98),
    "below high": (0.98, 1e-3),
}
SMALLEST = 1e-3
"""Share of the largest size at which a search over a parameter that cannot be negative begins."""


@dataclass(frozen=True)
class Probe:
    """A finite size of an effect, and the bounds of a refit that starts from it, in the parameters' units."""

    effect: str
    values: FrozenMap[float]
    free: FrozenMap[tuple[float, float]] = field(default_factory=FrozenMap)

    def use(self, at: Sequence[str], source: str = "", named: Mapping[str, str] | None = None) -> EffectUse:
        """Return the effect at the places with these values. named: parameters of the model that replace some of its own."""
        parameters: dict[str, float | str] = {**self.values, **(named or {})}
        return EffectUse(self.effect, tuple(at), FrozenMap(parameters), source=source)

    def model_names(self, use: EffectUse) -> dict[str, tuple[float, float]]:
        """Return the bounds by the names that the parameters have in a model with this effect."""
        return {use.parameter_name(n): b for n, b in self.free.items() if not isinstance(use.parameters.get(n), str)}


def probes(
    effect: Effect,
    signal: SignalScales,
    source: SignalScales | None = None,
    given: Mapping[str, float] | None = None,
) -> tuple[Probe, ...]:
    """Return the sizes to try where the signal has these scales; none for a term, whose form has to be found first.

    source: scales of the signal that the effect brings in. given: known values, such as a resistance of the model. An
    effect made of optional parts only is tried with each of them and with all.
    """
    if effect.needs_expression:
        return ()
    other = source or signal
    known = {n: replace(effect.parameters[n], value=v, probes=()) for n, v in (given or {}).items()}
    effect = replace(effect, parameters=effect.parameters | known)
    switched = {n: q for n, q in effect.parameters.items() if not q.optional}
    absent = {n: float(q.neutral or 0.0) for n, q in effect.parameters.items() if q.optional}
    groups: list[list[str]] = [[]]
    if all(q.neutral is None for q in switched.values()):
        parts = [n for n in absent if effect.parameters[n].probes]
        groups = [*([n] for n in parts if not effect.parameters[n].companion), parts]
    combinations = []
    for group in groups:
        tried = switched | {n: effect.parameters[n] for n in group}
        combinations += [
            {n: v[n] if n in v else absent[n] for n in effect.parameters} for v in _combinations(tried, signal, other)
        ]
    return tuple(_probe(effect, values, signal, other) for values in combinations)


def size_grid(effect: Effect, signal: SignalScales) -> tuple[Probe, Array]:
    """Return one probe of a grid refinement where the signal has these scales, and its (C,) sizes in the parameter's unit."""
    name, q = next((n, q) for n, q in effect.parameters.items() if q.grid is not None)
    assert q.grid is not None
    many = replace(q, probes=tuple(q.grid(signal)), measure=q.grid_measure or q.measure)
    sizes = np.array([_SIZES[many.measure](x, signal, signal, {}) for x in many.probes])
    one = replace(effect, parameters=effect.parameters | {name: replace(many, probes=many.probes[:1])})
    return probes(one, signal)[0], np.clip(sizes, q.min, q.max)


def _combinations(
    parameters: Mapping[str, EffectParameter], signal: SignalScales, source: SignalScales
) -> list[dict[str, float]]:
    """Return every combination of the parameters' sizes; those measured by another one come after it."""
    order = sorted(parameters, key=lambda n: parameters[n].measure in ("of T2", "of up", "time*R"))
    combinations: list[dict[str, float]] = []
    for sizes in itertools.product(*(_tried(parameters[n], signal) for n in order)):
        values: dict[str, float] = {}
        for name, x in zip(order, sizes, strict=True):
            q = parameters[name]
            value = x if x is None else _SIZES[q.measure](x, signal, source, values)
            values[name] = q.value if value is None else min(max(value, q.min), q.max)
        combinations.append({n: values[n] for n in parameters})
    return combinations


def _tried(q: EffectParameter, signal: SignalScales) -> tuple[float | None, ...]:
    """Return the sizes of one parameter, counted in its measure; None stands for its default."""
    if q.unit == "Hz" and signal.tones:
        span = math.log(signal.slow / signal.fast)
        return tuple(-math.log(f * signal.fast) / span for f in signal.tones)
    return q.probes or (None,)


def _probe(effect: Effect, values: Mapping[str, float], signal: SignalScales, source: SignalScales) -> Probe:
    free: dict[str, tuple[float, float]] = {}
    for name, q in effect.parameters.items():
        if q.fixed or (q.optional and values[name] == q.neutral):
            continue
        low, high = (_SIZES[q.measure](x, signal, source, values) for x in (q.search or _SEARCH[q.measure]))
        if q.search_factor is not None:
            low, high = values[name] / q.search_factor, values[name] * q.search_factor
        elif q.min == 0.0 and low <= 0.0:
            low = SMALLEST * high
        if not low < values[name] < high:
            margin = 0.5 * abs(values[name])
            low, high = min(low, values[name] - margin), max(high, values[name] + margin)
        free[name] = (max(low, q.min), min(high, q.max))
    return Probe(effect.name, FrozenMap(values), FrozenMap(free))


def distance_from_neutral(effect: Effect, values: Mapping[str, float]) -> dict[str, float]:
    """Return the distance from neutral of each parameter that switches the effect off: 0 at neutral.

    It is the difference from the neutral value; 1/value where that is infinite; T1 - T2 where it is another parameter. An
    optional parameter that is left out (0) has none.
    """
    distances: dict[str, float] = {}
    for name, q in effect.parameters.items():
        if q.neutral is None or name not in values or (q.optional and values[name] == q.neutral):
            continue
        neutral = values[q.neutral] if isinstance(q.neutral, str) else q.neutral
        if math.isinf(neutral):
            distances[name] = 1.0 / values[name] if values[name] else math.inf
        else:
            distances[name] = values[name] - neutral
    return distances


def admissible_sources(model: Model, place: str) -> tuple[str, ...]:
    """Return the inputs, signals, unknowns and states that an effect at this place may bring in without closing a circle.

    A place brings in no signal that is its own: that is a gain.
    """
    kind, name = insertion_point(model, place)
    names = [*model.inputs, *model.signals, *model.algebraic, *model.states]
    if kind == "output":
        shown = model.outputs[name].value
        return tuple(n for n in names if n != str(shown))
    if kind == "algebraic":
        return tuple(n for n in names if n != name)
    uses = {n: {s.name for s in v.value.free_symbols} for n, v in model.signals.items()}
    dependent = {name}
    while more := {n for n, used in uses.items() if n not in dependent and used & dependent}:
        dependent |= more
    return tuple(n for n in names if n not in dependent)


def resistance_parameters(model: Model, place: str) -> tuple[str, ...]:
    """Return the parameters by which the equation of the place divides: the resistance, where a current is a voltage over one."""
    kind, name = insertion_point(model, place)
    if kind not in ("signal", "algebraic"):
        return ()
    equation = model.signals[name].value if kind == "signal" else model.algebraic[name].equation
    below = {e.base for e in equation.atoms(sp.Pow) if e.exp == -1 and e.base.is_Symbol}
    return tuple(n for n in model.parameters if symbol(n) in below)


def effect_model(use: EffectUse, source: bool = False) -> Model:
    """Return the effect as a model of its own: input `u` (and `source`), output `y`."""
    inputs = {"u": Input()} | ({"source": Input()} if source else {})
    named = {v: Parameter(1.0) for v in use.parameters.values() if isinstance(v, str)}
    through = Model("effect", FrozenMap(named), inputs=FrozenMap(inputs), outputs=FrozenMap({"y": Output(symbol("u"))}))
    return apply_effects(through, [replace(use, at=("u",), source="source" if source else "")])
