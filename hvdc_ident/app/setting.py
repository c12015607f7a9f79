"""Settings of the workbench, as values: a model with numbers, courses of its inputs, and what is looked at."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

import hvdc_ident as hi
from hvdc_ident.data import Array, Band, Experiment, SignalLike, bands
from hvdc_ident.effects import EffectUse
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import FrequencyResponse, LinearModel
from hvdc_ident.model import AnyModel, Model, is_white_box
from hvdc_ident.simulate import Simulation
from hvdc_ident.text import listed

Kind = Literal["constant", "step", "ramp", "multisine"]
ROUNDING = 1e-12
"""Share of the largest eigenvalue below which one is a zero: the error of an eigenvalue is some 1e-16 of the matrix's norm."""
KINDS: tuple[Kind, ...] = ("constant", "step", "ramp", "multisine")


@dataclass(frozen=True)
class InputCourse:
    """An input over time. level: before the event; size: by how much it moves (of a multisine its amplitude), both in the
    input's unit; at: the event, s; length: of a ramp, s, and of a multisine its longest period."""

    kind: Kind = "constant"
    level: float = 0.0
    size: float = 0.0
    at: float = 0.1
    length: float = 0.2

    def signal(self, end: float) -> SignalLike:
        """Return the signal up to an end, s, for `hvdc_ident.simulate`."""
        if self.kind == "step":
            return hi.step(self.level, self.level + self.size, at=self.at)
        if self.kind == "ramp":
            return hi.ramp(self.level, self.level + self.size, start=self.at, end=self.at + max(self.length, 1e-9))
        if self.kind == "multisine":
            tones = [k / self.length for k in (1, 2, 5, 10)]
            return hi.multisine(self.level, self.size, tones, start=self.at, end=end)
        return self.level


@dataclass(frozen=True)
class Setting:
    """A model with values, courses of its inputs and what is looked at, of which the tab Explore shows the answers.

    start: the name of the values that it began with, "" for the given ones. base: the model without what is added here; effects: that,
    as `hvdc_ident.apply_effects` takes it; model: with it. titles: of parameters that are not called by their names. values: of
    its parameters, where they differ from the model's, in their units. courses: of
    its inputs. end: of the run, s, with so many rows. outputs: whose waveforms are shown. channel: input and output of the
    frequency response. opened: the signal at which the loop is opened for it instead; port: at which an impedance is seen
    instead. record: an experiment of the study in place of the courses.
    """

    base: AnyModel
    model: AnyModel
    effects: tuple[FrozenMap[Any], ...] = ()
    values: FrozenMap[float] = field(default_factory=FrozenMap)
    courses: FrozenMap[InputCourse] = field(default_factory=FrozenMap)
    end: float = 1.0
    rows: int = 1001
    outputs: tuple[str, ...] = ()
    channel: tuple[str, str] = ("", "")
    opened: str = ""
    port: hi.linear.Port | None = None
    record: Experiment | None = None
    start: str = ""
    titles: FrozenMap[str] = field(default_factory=FrozenMap)

    @classmethod
    def of(cls, model: AnyModel, record: Experiment | None = None) -> Setting:
        """Return the setting that a model begins with: a step of its first input by 2 % of its level, or of 0.02."""
        inputs = {n: InputCourse(level=i.value) for n, i in model.inputs.items()}
        first = next(iter(inputs), "")
        if first:
            inputs[first] = replace(inputs[first], kind="step", size=0.02 * (abs(inputs[first].level) or 1.0))
        plain = cls(
            model,
            model,
            courses=FrozenMap(inputs),
            outputs=tuple(model.outputs)[:3],
            channel=(first, next(iter(model.outputs))),
        )
        return plain if record is None else plain.of_record(record)

    def of_record(self, record: Experiment) -> Setting:
        """Return the setting that looks at an experiment: its outputs, and the response from an input that moves to one of them."""
        driven = [n for n in record.inputs if n in self.model.inputs]
        moved = [n for n in driven if np.ptp(record.inputs[n](record.time)) > 0.0]
        source = next(iter((*moved, *driven)), self.channel[0])
        outputs = tuple(record.outputs) or self.outputs
        return replace(
            self,
            record=record,
            end=float(record.time[-1]),
            outputs=outputs[:3],
            channel=(source, outputs[0]),
            opened="",
            port=None,
        )

    @property
    def time(self) -> Array:
        """The instants of the run, (rows,), s."""
        return self.record.time if self.record else np.linspace(0.0, self.end, self.rows)

    @property
    def parameters(self) -> dict[str, float]:
        """The values of all parameters."""
        return {**self.model.values, **self.values}

    def recorded(self, output: str) -> Array:
        """Return what the record has of an output, (rows,); nan where it has nothing."""
        if self.record is None or self.record.measured is None or output not in self.record.outputs:
            return np.full(self.time.size, np.nan)
        return self.record.measured[output]

    def bad(self, output: str) -> tuple[Band, ...]:
        """Return the bands of the record's rows that cannot be right or were left out, of an output or of what is played in."""
        return () if self.record is None else bands(self.record.recording, set(self.record.outputs) - {output})

    def with_value(self, name: str, value: float) -> Setting:
        """Return the setting with another value of a parameter."""
        return replace(self, values=self.values | {name: value})

    def with_course(self, name: str, course: InputCourse) -> Setting:
        """Return the setting with another course of an input."""
        return replace(self, courses=self.courses | {name: course})

    def run(self, sensitivities: tuple[str, ...] = ()) -> Simulation:
        """Return the waveforms of the chosen outputs, and of the recorded ones. Raises as `hvdc_ident.simulate`."""
        if self.record is not None:
            outputs = tuple(dict.fromkeys((*self.outputs, *self.record.outputs)))
            return hi.simulate(self.model, self.record, self.values, sensitivities, outputs=outputs)
        signals = {n: c.signal(self.end) for n, c in self.courses.items()}
        return hi.simulate(self.model, self.time, self.values, sensitivities, inputs=signals, outputs=self.outputs)

    def point(self) -> hi.OperatingPoint:
        """Return the operating point of the inputs before any event. Raises as `hvdc_ident.find_operating_point`."""
        levels = {n: c.level for n, c in self.courses.items()}
        if self.record is not None:
            levels |= {n: float(s(float(self.time[0]))) for n, s in self.record.inputs.items() if n in levels}
            levels |= {n: v for n, v in self.record.values.items() if n in levels}
        own = {n: v for n, v in self.values.items() if n in self.model.parameters}
        return hi.find_operating_point(self.model, levels, values=own)

    def linear(self, point: hi.OperatingPoint) -> LinearModel:
        """Return the linear model of the chosen channel, or of the opened loop. Raises as `hvdc_ident.linearize` and `loop`."""
        if self.opened and is_white_box(self.model):
            return hi.linear.loop(self.model, self.opened, point).open
        return hi.linearize(self.model, point, inputs=self.channel[0], outputs=self.channel[1])

    def response(self, point: hi.OperatingPoint, omega: Array | None = None) -> FrequencyResponse:
        """Return the response of the channel or the opened loop, or the impedance at the port, in its first axis; (n, 1, 1) or more.

        omega: (n,), rad/s; default, around the poles.
        """
        if self.port is not None and is_white_box(self.model):
            if omega is None:
                omega = hi.bode(self.model, point=point).omega
            return hi.linear.port_impedance(self.model, self.port, omega, point)
        return hi.bode(self.linear(point), omega)

    @property
    def response_text(self) -> str:
        """The signals from and to which the frequency response is, its operating point, and the size of 0 dB."""
        where = f"at the start of {self.record.name}" if self.record else "at the levels of the inputs"
        if self.port is not None:
            return f"Impedance at the source {self.port.source}, {where}."
        if self.opened:
            return f"Open loop at {self.opened}, {where}."
        source, output = self.channel
        up, down = self.model.outputs[output].unit, self.model.inputs[source].unit
        one = f"1 {up}" if up else "1"
        return f"From {source} to {output}, {where}; 0 dB is {f'{one}/{down}' if down else one}."

    def sensitivities(self) -> dict[str, dict[str, float]]:
        """Return, by parameter and shown output, the RMS of the derivative times the value. Raises as `hvdc_ident.sensitivities`."""
        names = [n for n in self.model.parameters if n in self.parameters]
        if self.record is not None:
            derivatives = hi.sensitivities(self.model, self.record, names, values=self.values)
        else:
            signals = {n: c.signal(self.end) for n, c in self.courses.items()}
            derivatives = hi.sensitivities(
                self.model, self.time, names, inputs=signals, outputs=self.outputs, values=self.values
            )
        assert derivatives.trajectories is not None  # there is an experiment
        rms = derivatives.trajectories.norms["rms"].isel(experiment=0)
        shown = [o for o in self.outputs if o in rms["output"]]
        return {n: {o: float(rms.sel(parameter=n, output=o)) for o in shown} for n in names}

    def margins(self, point: hi.OperatingPoint) -> str:
        """Return the margins of the opened loop in words; "" where none is opened."""
        return str(hi.linear.margins(self.linear(point))) if self.opened else ""

    def poles(self, point: hi.OperatingPoint) -> Array:
        """Return the poles of the closed model, (n,), rad/s."""
        return hi.linearize(self.model, point, inputs=self.channel[0], outputs=self.channel[1]).poles()


def with_effects(setting: Setting, effects: Iterable[Mapping[str, Any]]) -> Setting:
    """Return the setting with these effects and no others; their sizes are parameters, which keep the values that they have.

    Raises ModelError or UnknownNameError for one that does not fit.
    """
    uses = tuple(FrozenMap(use) for use in effects)
    changed = of_model(setting, setting.base, hi.apply_effects(setting.base, uses) if uses else setting.base, uses)
    of_base = FrozenMap({n: t for n, t in setting.titles.items() if n in setting.base.parameters})
    return replace(changed, titles=of_base | size_titles(setting.base, uses))


def of_model(
    setting: Setting, base: AnyModel, model: AnyModel | None = None, effects: tuple[FrozenMap[Any], ...] = ()
) -> Setting:
    """Return the setting of another model, with the values that are of its parameters."""
    model = base if model is None else model
    values = FrozenMap({n: v for n, v in setting.values.items() if n in model.parameters})
    return replace(setting, base=base, model=model, effects=effects, values=values)


def effects_with_sizes(setting: Setting) -> list[dict[str, Any]]:
    """Return the effects of a setting with its values, as a study's [[model.effect]] states them."""
    names = sizes_of(setting.base, setting.effects)
    return [
        {**use, "parameters": dict(use["parameters"]) | {key: setting.parameters[n] for n, key in own.items()}}
        for use, own in zip(setting.effects, names, strict=True)
    ]


def sizes_of(base: AnyModel, effects: Sequence[EffectUse | Mapping[str, Any]]) -> list[dict[str, str]]:
    """Return, by effect, the parameters that it adds to a model, with their keys among the effect's own. Raises as `with_effects`."""
    sizes: list[dict[str, str]] = []
    before = base
    for k, use in enumerate(effects):
        now = hi.apply_effects(base, effects[: k + 1])
        added = [n for n in now.parameters if n not in before.parameters]
        own = EffectUse.of(use).parameters
        sizes.append({n: next((key for key in own if n.endswith(f"_{key}")), n.rpartition("_")[2]) for n in added})
        before = now
    return sizes


def size_titles(base: AnyModel, effects: Sequence[EffectUse | Mapping[str, Any]]) -> FrozenMap[str]:
    """Return, by parameter that effects add to a model, what a reader calls it: "T of the lag at P"."""
    uses = [EffectUse.of(use) for use in effects]
    names = zip(uses, sizes_of(base, uses), strict=True)
    return FrozenMap(
        {n: f"{key} of the {use.effect} at {listed(use.at)}" for use, own in names for n, key in own.items()}
    )


def span_of(model: AnyModel, name: str, stated: Mapping[str, tuple[float, float]]) -> tuple[float, float]:
    """Return the ends of a parameter's slider: as a study states them, else the model's bounds, else a factor of 5 about its value."""
    if name in stated:
        return stated[name]
    q = model.parameters[name]
    value = q.value
    low, high = sorted((value / 5.0, value * 5.0)) if value else (-1.0, 1.0)
    low = q.min if math.isfinite(q.min) and (q.min > low or not value) else low
    high = q.max if math.isfinite(q.max) and (q.max < high or not value) else high
    return (low, high) if low < high else (value - 1.0, value + 1.0)


def equations_of(model: AnyModel) -> Model | None:
    """Return the model where it has equations, so that a loop can be opened and poles followed; None for an FMU."""
    return model if is_white_box(model) else None


def near(poles: NDArray[Any]) -> NDArray[Any]:
    """Return the poles that a picture shows: those within 30 times the slowest, and up to the slowest pair that resonates.

    Faster ones would press them into a line. A pair resonates where its damping is below 1/sqrt(2): its response has a peak then.
    """
    sizes = np.abs(poles)
    moves = sizes > ROUNDING * sizes.max(initial=0.0)  # an integrator's is 0 but for rounding, and slower than nothing
    rings = moves & (np.abs(poles.imag) > 0.0) & (-poles.real < sizes / math.sqrt(2.0))
    slowest = np.min(sizes, where=moves, initial=np.inf)
    first = np.min(sizes, where=rings, initial=np.inf)
    reach = max(30.0 * slowest, first * (1.0 + ROUNDING) if rings.any() else 0.0)
    return np.asarray(poles[sizes <= reach])
