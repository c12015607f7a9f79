"""Looking for an effect at a slot: which sizes to try there, and where a refit may move its parameters.

For whoever searches (the discrepancy room):

    signal = SlotSignal.of(times, values)                 # the slot's signal in each experiment, from any simulation
    for probe in probes(effect, signal, source):          # a few finite sizes
        use = probe.use(at=("Ir1",), source="Vdc2")       # goes into Model.with_effects; its values are the refit's start
        probe.free                                        # {parameter: (min, max)} of the refit, finite, min < start < max
        probe.model_names(use)                            # the same under the names that the model then has

`probe.free` names the parameters to estimate, the others keep the probe's value. A range that spans more than a decade
above 0 is one for a logarithmic scale, as `hvdc_ident.fit.fit_parameter.FitParameter` takes it. `clearance(effect, values)` measures
how far a set of values is from neutral, as something whose interval can be compared with 0. `sources(model, place)`
lists the signals that an effect with `needs_source` may bring in at this place without closing a circle;
`resistances(model, place)` the parameters that may stand for R in an effect with a `resistance` (none: do not try it
there). `alone(use)` is the effect as a model of its own, to turn a recorded signal u into y without the plant.
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
from hvdc_ident.effects.placing import EffectUse
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, Output, insertion_point
from hvdc_ident.parameters import Input


@dataclass(frozen=True)
class SlotSignal:
    """Range and time scales of a slot's signal over all experiments, from which the sizes of an effect are chosen.

    low, high: its extremes; rest: the largest magnitude it has at a start; all in its unit. fast, slow: the shortest
    and the longest time worth a thought, s. tones: frequencies, Hz, that stand out in what is unexplained.
    """

    low: float
    high: float
    rest: float
    fast: float
    slow: float
    tones: tuple[float, ...] = ()

    @classmethod
    def of(cls, times: Sequence[Array], values: Sequence[Array], tones: Iterable[float] = ()) -> SlotSignal:
        """From the signal in each experiment: times in s, values in the slot's unit, one array an experiment each.

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
    def joined(cls, signals: Sequence[SlotSignal]) -> SlotSignal:
        """One for several slots that share an effect."""
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
        """Its largest magnitude; 1 where it is always 0."""
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
        """The time at a share of the way from fast to slow, evenly in the logarithm, s."""
        return self.fast * (self.slow / self.fast) ** share


Size = Callable[[float, SlotSignal, SlotSignal, Mapping[str, float]], float]
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
    "of T2": lambda x, u, source, p: x * p["T2"],
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
    "of T2": (0.02, 50.0),
}
SMALLEST = 1e-3
"""Of the largest size: where a search over a parameter that cannot be negative begins."""


@dataclass(frozen=True)
class Probe:
    """A finite size of an effect, and the bounds of a refit that starts from it, in the parameters' units."""

    effect: str
    values: FrozenMap[float]
    free: FrozenMap[tuple[float, float]] = field(default_factory=FrozenMap)

    def use(self, at: Sequence[str], source: str = "", named: Mapping[str, str] | None = None) -> EffectUse:
        """The effect at the slots with these values. named: parameters of the model that stand in for some of its own."""
        parameters: dict[str, float | str] = {**self.values, **(named or {})}
        return EffectUse(self.effect, tuple(at), FrozenMap(parameters), source=source)

    def model_names(self, use: EffectUse) -> dict[str, tuple[float, float]]:
        """The bounds by the names that the parameters have in a model with this effect on it."""
        own = {n: b for n, b in self.free.items() if not isinstance(use.parameters.get(n), str)}
        return {use.parameter_name(n): b for n, b in own.items()}


def probes(
    effect: Effect,
    signal: SlotSignal,
    source: SlotSignal | None = None,
    given: Mapping[str, float] | None = None,
) -> tuple[Probe, ...]:
    """Sizes worth trying at a slot with this signal; none for a term, whose form has to be found first.

    source: the signal that the effect brings in, where it does. given: values that are settled, such as a resistance
    of the model. An effect made of optional parts only is tried with each of them and with all.
    """
    if effect.needs_expression:
        return ()
    other = source or signal
    settled = {n: replace(effect.parameters[n], value=v, probes=()) for n, v in (given or {}).items()}
    effect = replace(effect, parameters=effect.parameters | settled)
    switched = {n: q for n, q in effect.parameters.items() if not q.optional}
    absent = {n: 0.0 for n, q in effect.parameters.items() if q.optional}
    groups: list[list[str]] = [[]]
    if not switched:
        parts = [n for n in absent if effect.parameters[n].probes]
        groups = [*([n] for n in parts if not effect.parameters[n].companion), parts]
    found = []
    for group in groups:
        tried = switched | {n: effect.parameters[n] for n in group}
        found += [{n: values.get(n, 0.0) for n in effect.parameters} for values in _combinations(tried, signal, other)]
    return tuple(_probe(effect, values, signal, other) for values in found)


def scanned(effect: Effect, signal: SlotSignal) -> tuple[Probe, Array]:
    """One probe of a closer look at a slot with this signal, and (C,) all its sizes, in the unit of the parameter that asks
    for them.
    """
    name, q = next((n, q) for n, q in effect.parameters.items() if q.scan is not None)
    assert q.scan is not None
    many = replace(q, probes=tuple(q.scan(signal)), measure=q.scanned_in or q.measure)
    sizes = np.array([_SIZES[many.measure](x, signal, signal, {}) for x in many.probes])
    one = replace(effect, parameters=effect.parameters | {name: replace(many, probes=many.probes[:1])})
    return probes(one, signal)[0], np.clip(sizes, q.min, q.max)


def _combinations(
    parameters: Mapping[str, EffectParameter], signal: SlotSignal, source: SlotSignal
) -> list[dict[str, float]]:
    """Every combination of the parameters' sizes; those measured by another one come after it."""
    order = sorted(parameters, key=lambda n: parameters[n].measure in ("of T2", "time*R"))
    found: list[dict[str, float]] = []
    for sizes in itertools.product(*(_tried(parameters[n], signal) for n in order)):
        values: dict[str, float] = {}
        for name, x in zip(order, sizes, strict=True):
            q = parameters[name]
            value = x if x is None else _SIZES[q.measure](x, signal, source, values)
            values[name] = q.value if value is None else min(max(value, q.min), q.max)
        found.append({n: values[n] for n in parameters})
    return found


def _tried(q: EffectParameter, signal: SlotSignal) -> tuple[float | None, ...]:
    """The sizes of one parameter, counted in its measure; None: its own value."""
    if q.unit == "Hz" and signal.tones:
        span = math.log(signal.slow / signal.fast)
        return tuple(-math.log(f * signal.fast) / span for f in signal.tones)
    return q.probes or (None,)


def _probe(effect: Effect, values: Mapping[str, float], signal: SlotSignal, source: SlotSignal) -> Probe:
    free: dict[str, tuple[float, float]] = {}
    for name, q in effect.parameters.items():
        if q.held or (q.optional and values[name] == q.neutral):
            continue
        low, high = (_SIZES[q.measure](x, signal, source, values) for x in (q.search or _SEARCH[q.measure]))
        if q.near is not None:
            low, high = values[name] / q.near, values[name] * q.near
        elif q.min == 0.0 and low <= 0.0:
            low = SMALLEST * high
        if not low < values[name] < high:
            margin = 0.5 * abs(values[name])
            low, high = min(low, values[name] - margin), max(high, values[name] + margin)
        free[name] = (max(low, q.min), min(high, q.max))
    return Probe(effect.name, FrozenMap(values), FrozenMap(free))


def clearance(effect: Effect, values: Mapping[str, float]) -> dict[str, float]:
    """Distance from neutral of each parameter that switches the effect off: 0 at neutral.

    The difference from the neutral value; 1/value where that is infinite; T1 - T2 where it is another parameter. An
    optional parameter that is left out (0) counts as not there.
    """
    found: dict[str, float] = {}
    for name, q in effect.parameters.items():
        if q.neutral is None or name not in values or (q.optional and values[name] == q.neutral):
            continue
        neutral = values[q.neutral] if isinstance(q.neutral, str) else q.neutral
        found[name] = 1.0 / values[name] if math.isinf(neutral) else values[name] - neutral
    return found


def sources(model: Model, place: str) -> tuple[str, ...]:
    """Inputs, signals, unknowns and states that an effect at this place may bring in without closing a circle."""
    kind, name = insertion_point(model, place)
    every = [*model.inputs, *model.signals, *model.algebraic, *model.states]
    if kind == "output":
        return tuple(every)
    if kind == "algebraic":
        return tuple(n for n in every if n != name)
    uses = {n: {s.name for s in v.value.free_symbols} for n, v in model.signals.items()}
    reaching = {name}
    growing = True
    while growing:
        more = {n for n, used in uses.items() if n not in reaching and used & reaching}
        reaching |= more
        growing = bool(more)
    return tuple(n for n in every if n not in reaching)


def resistances(model: Model, place: str) -> tuple[str, ...]:
    """Parameters by which the slot's own equation divides: where a current is a voltage over one, its resistance."""
    kind, name = insertion_point(model, place)
    if kind not in ("signal", "algebraic"):
        return ()
    equation = model.signals[name].value if kind == "signal" else model.algebraic[name].equation
    below = {e.base for e in equation.atoms(sp.Pow) if e.exp == -1 and e.base.is_Symbol}
    return tuple(n for n in model.parameters if symbol(n) in below)


def alone(use: EffectUse, source: bool = False) -> Model:
    """The effect as a model of its own: input `u` (and `source`), output `y`."""
    from hvdc_ident.effects import apply_effects

    inputs = {"u": Input()} | ({"source": Input()} if source else {})
    bench = Model("alone", inputs=FrozenMap(inputs), outputs=FrozenMap({"y": Output(symbol("u"))}))
    named = {n: v for n, v in use.parameters.items() if isinstance(v, str)}
    if named:
        from hvdc_ident.parameters import Parameter

        bench = replace(bench, parameters=FrozenMap({v: Parameter(1.0) for v in named.values()}))
    return apply_effects(bench, [replace(use, at=("u",), source="source" if source else "")])
