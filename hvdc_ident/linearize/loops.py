"""Loops opened at named signals, and their stability margins.

Open-loop transfer, sensitivity and complementary sensitivity; plant and controller; gain, phase, delay, modulus and disk
margin of each loop, and the disk margin of all together. python-control 0.10.2 finds a false gain margin of 3e-6 on the link, and
Slycot's bound for the disk margin of several loops is up to 1e-3 above this one (`benchmarks/linear_library.py`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, ClassVar, Self

import numpy as np
from scipy.optimize import brentq, minimize, minimize_scalar
from scipy.sparse.csgraph import connected_components

from hvdc_ident.codec import Coded, plain, stored_as
from hvdc_ident.errors import LinearizationError, unknown_name
from hvdc_ident.expression import symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.frequency import FrequencyResponse, default_omega, transfer, wide_omega
from hvdc_ident.linearize.gain_limits import FLOOR, NONE, Closing, Crossing, crossing_frequencies, refined
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.linearisation import linearize
from hvdc_ident.linearize.operating_point import find_operating_point, point_at, signal_values
from hvdc_ident.linearize.point import OperatingPoint
from hvdc_ident.linearize.realisation import whole
from hvdc_ident.linearize.stability import Characteristic, Stability, sliding_means, stability
from hvdc_ident.linearize.system import Array
from hvdc_ident.model import Model, Output, State, driven, fresh, is_white_box
from hvdc_ident.parameters import Input


@dataclass(frozen=True, eq=False)
class Loop:
    """A loop opened at a signal, or several opened together (their names joined by ", ").

    open: L, from what is injected to minus what comes back; det(1 + L) = 0 closes it.
    """

    signal: str
    open: LinearModel

    def response(self, omega: Array | None = None) -> FrequencyResponse:
        """L at omega in rad/s, delays exact."""
        return self.open.bode(omega)

    def closed_poles(self) -> Array:
        """Poles with the loop closed, rad/s, sliding means without their hidden zero.

        With delays: the rightmost roots of the exact characteristic equation, at least as many as there are states.
        Raises LinearizationError for an ill-posed loop.
        """
        equation = open_equation(self.open)
        closed = equation.closed(np.ones(len(self.open.input_names)))
        values, means = closed.roots.values, sliding_means(closed)
        return np.delete(values, np.argsort(np.abs(values), kind="stable")[:means])

    def sensitivity(self, omega: Array | None = None) -> FrequencyResponse:
        """S = (1 + L)^-1."""
        return self._of(omega, lambda value, one: np.linalg.inv(one + value), "S")

    def complementary(self, omega: Array | None = None) -> FrequencyResponse:
        """T = (1 + L)^-1 L."""
        return self._of(omega, lambda value, one: np.linalg.solve(one + value, value), "T")

    def _of(self, omega: Array | None, of: Callable[[Array, Array], Array], name: str) -> FrequencyResponse:
        w = default_omega(self.open) if omega is None else np.atleast_1d(np.asarray(omega, dtype=float))
        values = transfer(self.open, 1j * w)
        signals = self.open.input_names
        names = (name,) if len(signals) == 1 else tuple(f"{name} {n}" for n in signals)
        return FrequencyResponse(
            w, of(values, np.eye(len(signals))), names, signals, source=f"{name} at '{self.signal}'"
        )


def open_model(model: Model, signal: str) -> tuple[Model, str]:
    """Return (model, output): the model in which the signal is an input, and the output that shows what it would have been.

    A state is opened between its integrator and its readers. Raises UnknownNameError, and LinearizationError for an
    input, where there is nothing to open.
    """
    if signal in model.inputs:
        raise LinearizationError(
            f"'{signal}' is an input: no loop runs through it", where=f"model '{model.name}'", hint="open at a signal"
        )
    returned = fresh(model, f"{signal}_returned")
    if signal in model.signals or signal in model.algebraic:
        value = model.signals[signal].value if signal in model.signals else model.algebraic[signal].equation
        unit = model.signals[signal].unit if signal in model.signals else model.algebraic[signal].unit
        opened = driven(model, (signal,))
        return replace(opened, outputs=opened.outputs | {returned: Output(value, unit)}), returned
    if signal in model.states:
        old = model.states[signal]
        opened = replace(
            model,
            states=FrozenMap({returned if n == signal else n: s for n, s in model.states.items()}),
            inputs=model.inputs | {signal: Input(0.0, old.unit)},
            outputs=model.outputs | {f"{returned}_shown": Output(symbol(returned), old.unit)},
            parameters=model.parameters.without(f"{signal}_start") if old.start == "free" else model.parameters,
        )
        state = State(old.derivative, None, old.guess, None, old.unit, old.description)
        return replace(opened, states=opened.states | {returned: state}), f"{returned}_shown"
    raise unknown_name(
        "signal", signal, [*model.signals, *model.algebraic, *model.states], where=f"model '{model.name}'"
    )


def loop(
    model: Model,
    signal: str | Sequence[str],
    point: OperatingPoint | None = None,
    *,
    sensitivities: Sequence[str] = (),
    pade_order: int | None = None,
) -> Loop:
    """Return the loop opened at a named signal, unknown or state, or several opened together, at the operating point.

    Parameters
    ----------
    model : Model
        The closed model, with equations.
    signal : str or list of str
        Where the loop is opened; of a state between its integrator and its readers.
    point : OperatingPoint, default None
        Of the closed model. None: its steady state.
    sensitivities : list of str, default ()
        Parameters whose exact derivatives of the loop's A, B, C, D come along, the shift of the operating point included.
    pade_order : int, default None
        Order of the Pade approximant of every delay in the state space. None: 5. Frequency responses and margins take delays exactly.

    Returns
    -------
    Loop
        `open`: the linear model L from what is injected at the signals to minus what comes back; det(1 + L) = 0 closes it.

    Raises
    ------
    UnknownNameError
        A signal that the model lacks.
    SteadyStateError
        There is no steady state, where no point is given.
    LinearizationError
        The signal is an input, stands twice, or none is named; the point lies on a kink, or an algebraic loop is ill-posed.

    Examples
    --------
    >>> from hvdc_ident import load_model
    >>> from hvdc_ident.linear import loop, margins
    >>> opened = loop(load_model("vsc-hvdc-link"), "Irorder1")
    >>> round(margins(opened).phase_margin.value, 1)
    65.3
    """
    signals = (signal,) if isinstance(signal, str) else tuple(signal)
    if not signals or len(set(signals)) < len(signals):
        raise LinearizationError(
            "a loop is opened at different signals", where=f"model '{model.name}'", got=", ".join(signals) or "none"
        )
    closed = find_operating_point(model) if point is None else point
    opened, outputs, states = model, [], dict(closed.states)
    for name in signals:
        if name in model.states:
            states[fresh(opened, f"{name}_returned")] = closed.states[name]
        opened, output = open_model(opened, name)
        outputs.append(output)
    inputs = {**closed.inputs, **signal_values(model, closed, signals)}
    parameters = {n: v for n, v in closed.parameters.items() if n in opened.parameters}
    at = point_at(opened, {n: states[n] for n in opened.states}, inputs, parameters, time=closed.time)
    if sensitivities:  # the derivatives need the shift of a point that is at rest
        at = find_operating_point(opened, {**inputs, **parameters}, guess=states)
    linear = linearize(
        opened, at, inputs=list(signals), outputs=outputs, sensitivities=sensitivities, pade_order=pade_order
    )
    return Loop(", ".join(signals), linear.negated())


def plant_and_controller(
    model: Model, inputs: Sequence[str], outputs: Sequence[str], point: OperatingPoint | None = None
) -> tuple[LinearModel, LinearModel]:
    """Return the plant and the controller of a closed model, cut at the signals that go into the plant and those measured on it.

    Parameters
    ----------
    model : Model
        The closed model, with equations.
    inputs : list of str
        Names of the signals, unknowns or states that go into the plant.
    outputs : list of str
        Names of the signals, unknowns or states measured on the plant.
    point : OperatingPoint, default None
        Of the closed model. None: its steady state.

    Returns
    -------
    tuple of LinearModel
        (plant, controller). The plant is what lies between inputs and outputs with both cut, the controller what lies between outputs and
        inputs, with the sign of negative feedback.

    Raises
    ------
    UnknownNameError
        A signal that the model lacks.
    LinearizationError
        A way leads from inputs to inputs, or outputs to outputs, that passes neither: the cut does not part them.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> plant, controller = hi.linear.plant_and_controller(hi.load_model("vsc-hvdc-link"), ["Irorder1"], ["Vdc1_m"])
    >>> plant.input_names, controller.input_names
    (('Irorder1',), ('Vdc1_m',))
    """
    both = loop(model, (*inputs, *outputs), point).open
    back = both.negated()
    k = len(inputs)
    names = both.output_names
    returned_inputs, returned_outputs = names[:k], names[k:]
    w = wide_omega(both, 50)
    values = np.abs(transfer(both, 1j * w))
    size = np.maximum(values.max(axis=0), 1e-300)
    for part in ((slice(0, k), slice(0, k)), (slice(k, None), slice(k, None))):
        if (size[part] > 1e-9 * size.max()).any():
            i, j = (int(v) for v in np.argwhere(size[part] > 1e-9 * size.max())[0])
            signals = both.input_names[part[1]]
            raise LinearizationError(
                f"cutting at these signals does not part plant and controller: a way leads from '{signals[j]}' to "
                f"'{signals[i]}' beside them",
                where=f"model '{model.name}'",
                hint="name every signal that the controller sends or measures; of a state, a signal that only the "
                "controller reads",
            )
    plant = back.channel(list(inputs), list(returned_outputs))
    controller = both.channel(list(outputs), list(returned_inputs))
    return plant, controller


# --- stability margins ---


Curve = Callable[[float], complex]
Curves = Callable[[Array], Array]


@dataclass(frozen=True)
class Margins(Coded):
    """Margins of 1 + L = 0. Infinite where the curve has no such crossing, nan where the closed loop is not stable.

    gain: factors on L that reach -1, nearest to 1 first, those at 0 and infinite frequency among them. gain_margin: the
    smallest factor above 1 at which stability is lost, infinite where there is none; lower_gain_margin: the largest below 1,
    0 where the gain may fall to nothing. phase: degrees at |L| = 1. delay: s that the loop stands, at its frequency.
    modulus: the smallest |1 + L|, the stability margin, 1 over the peak of S. disk: alpha of the balanced disk
    |(S - T)/2| < 1/alpha, with the gain and phase it guarantees together. stability: of the closed loop, delays exact.
    """

    gain: tuple[Crossing, ...] = field(metadata=stored_as("gain_crossings"))
    gain_margin: Crossing
    lower_gain_margin: Crossing
    phase: tuple[Crossing, ...] = field(metadata=stored_as("phase_crossings_deg"))
    delay: Crossing = field(metadata=stored_as("delay_margin_s"))
    modulus: Crossing = field(metadata=stored_as("modulus_margin"))
    disk: Crossing = field(metadata=stored_as("disk_margin"))
    stability: Stability
    stored_properties: ClassVar[tuple[str, ...]] = ("stable",)

    @property
    def stable(self) -> bool | None:
        """True where the closed loop is stable, delays exact; None where it cannot be told."""
        return self.stability.stable

    @property
    def phase_margin(self) -> Crossing:
        """The phase margin of the smallest size, degrees; negative where a phase lead is what the loop stands least."""
        if not self.stable:
            return NONE
        return min(self.phase, key=lambda c: abs(c.value), default=Crossing())

    @property
    def disk_gain(self) -> float:
        """The factor by which the gain may change either way, phase held within `disk_phase` too."""
        return disk_gain(self.disk.value)

    @property
    def disk_phase(self) -> float:
        """Degrees the phase may change either way."""
        return disk_phase(self.disk.value)

    def to_dict(self) -> dict[str, Any]:
        """Return the margins as JSON holds them, the phase margin among them; None where there is no limit, or no stability."""
        return {**super().to_dict(), "phase_margin_deg": plain(self.phase_margin), "disk_margin": _disk_json(self.disk)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the margins that `to_dict` wrote. Raises InputError for anything else."""
        written = super().from_dict(data)
        if written.stable:
            return written
        return replace(written, gain_margin=NONE, lower_gain_margin=NONE, delay=NONE, modulus=NONE, disk=NONE)

    def __str__(self) -> str:
        if not self.stable:
            return _without_margins(self.stability, "the closed loop is")
        phase, hertz = self.phase_margin, 2 * np.pi
        second = (
            f"phase {phase.value:.4g} degrees at {phase.omega / hertz:.4g} Hz, delay {1e3 * self.delay.value:.4g} ms"
            if np.isfinite(phase.value)
            else "phase unlimited"
        )
        return f"{self._gain_text()}, {second}, modulus {self.modulus.value:.3g}, {_disk_text(self.disk)}"

    def _gain_text(self) -> str:
        upper, lower, hertz = self.gain_margin, self.lower_gain_margin, 2 * np.pi
        first = (
            f"gain {upper.value:.4g} at {upper.omega / hertz:.4g} Hz" if np.isfinite(upper.value) else "gain unlimited"
        )
        if lower.value > 0:
            first += f" and not below {lower.value:.4g} at {lower.omega / hertz:.4g} Hz"
        return first


def _without_margins(judged: Stability, what: str) -> str:
    """Return the sentence on closed loops that are not stable, or of which it cannot be told."""
    if judged.verdict == "not decided":
        return f"whether {what} stable cannot be told, so that no margins are given: {judged.reason}"
    if judged.verdict != "unstable":
        return f"{what} on the limit of stability: there are no margins"
    return f"{what} not stable ({judged.count_text}): there are no margins"


@dataclass(frozen=True, eq=False)
class LoopMargins(Coded):
    """Margins of several loops of one plant. each: of every loop alone, by signal, the others closed.

    disk: alpha of the balanced disk in which every loop's gain and phase may vary at once, independently of each other
    (multi-loop disk margin); a bound from below, exact for up to three loops. stability: of the closed loops, delays exact.
    """

    each: FrozenMap[Margins] = field(metadata=stored_as("loops"))
    disk: Crossing = field(metadata=stored_as("disk_margin"))
    stability: Stability
    stored_properties: ClassVar[tuple[str, ...]] = ("stable",)

    @property
    def stable(self) -> bool | None:
        """True where the closed loops are stable, delays exact; None where it cannot be told."""
        return self.stability.stable

    @property
    def disk_gain(self) -> float:
        """The factor by which every gain may change either way."""
        return disk_gain(self.disk.value)

    @property
    def disk_phase(self) -> float:
        """Degrees every phase may change either way."""
        return disk_phase(self.disk.value)

    def to_dict(self) -> dict[str, Any]:
        """Return the margins as JSON holds them."""
        return {**super().to_dict(), "disk_margin": _disk_json(self.disk)}

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> Self:
        """Return the margins that `to_dict` wrote. Raises InputError for anything else."""
        written = super().from_dict(data)
        return written if written.stable else replace(written, disk=NONE)

    def __str__(self) -> str:
        if not self.stable:
            return _without_margins(
                self.stability, "the closed loop is" if len(self.each) == 1 else "the closed loops are"
            )
        lines = [f"{name}: {m}" for name, m in self.each.items()]
        if len(self.each) > 1:
            lines.append(f"all loops at once: {_disk_text(self.disk)}")
        return "\n".join(lines)


def disk_gain(alpha: float) -> float:
    """Return the factor either way of a balanced disk margin alpha; nan for one that is nan."""
    if np.isnan(alpha):
        return alpha
    return (2.0 + alpha) / (2.0 - alpha) if alpha < 2.0 else float("inf")


def disk_phase(alpha: float) -> float:
    """Return the degrees either way of a balanced disk margin alpha; nan for one that is nan."""
    if np.isnan(alpha):
        return alpha
    return float(2.0 * np.degrees(np.arctan(alpha / 2.0))) if alpha < 2.0 else 90.0


def _disk_json(disk: Crossing) -> dict[str, Any]:
    """Return a disk margin with the gain and the phase that it allows, as JSON holds them."""
    fields: dict[str, Any] = plain(
        {"value": disk.value, "omega": disk.omega, "gain": disk_gain(disk.value), "phase_deg": disk_phase(disk.value)}
    )
    return fields


def _disk_text(disk: Crossing) -> str:
    a = disk.value
    factor = f"a factor of {disk_gain(a):.3g}" if a < 2.0 - 1e-9 else "any factor"
    where = f"at {disk.omega / (2 * np.pi):.4g} Hz"
    return f"disk margin {a:.3g} {where} (gain by {factor} and phase by {disk_phase(a):.3g} degrees, either way)"


def margins(loop: Loop | LinearModel, omega: Array | None = None) -> Margins:
    """Return the margins of one loop (1 + L = 0), searched on a grid around its poles and refined.

    Parameters
    ----------
    loop : Loop or LinearModel
        The loop, or the linear model L from what is injected to minus what comes back.
    omega : array of float (n,), default None
        The grid, in rad/s. None: around the open and closed poles.

    Returns
    -------
    Margins
        `gain_margin` (a factor), `phase_margin` (degrees), `delay` (s), `modulus` (the smallest |1 + L|), `disk` (alpha), each with its
        frequency in rad/s, and whether the closed loop is stable, delays exact; without stability margins are nan.

    Raises
    ------
    LinearizationError
        The model has more than one input or output, or the loop is ill-posed.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> margins = hi.linear.margins(hi.linear.loop(hi.load_model("vsc-hvdc-link"), "Irorder1"))
    >>> margins.stable, round(margins.phase_margin.value, 1)
    (True, 65.3)
    """
    model = loop.open if isinstance(loop, Loop) else loop
    if len(model.input_names) != 1 or len(model.output_names) != 1:
        raise LinearizationError(
            "margins belong to one loop", where=model.name, hint="open a loop, or use loop_margins() for several"
        )

    def values(w: Array) -> Array:
        return transfer(model, 1j * w)[:, 0, 0]

    closing = Closing(open_equation(model), 0)
    return _of_curve(values, _grid(model, closing, omega), closing)


def margins_of(model: LinearModel, break_at: str | Sequence[str] | None = None) -> Margins | LoopMargins:
    """Return gain, phase, delay, modulus and disk margins; of several loops together with their common disk margin.

    break_at: the signal (or signals) of the model at which its closed loops are opened. Without it this linear model
    is taken for an open loop L with negative unit feedback. Raises LinearizationError where it is neither.
    """
    if break_at is None:
        return margins(model) if model.B.shape[1] == model.C.shape[0] == 1 else loop_margins(model)
    if model.point is None or not is_white_box(model.point.model):
        raise LinearizationError(
            "a loop can be opened only in a model with equations",
            where=f"linear model '{model.name}'",
            hint="margins() without a signal takes this linear model for the open loop",
        )
    opened = loop(model.point.model, break_at, model.point)
    return margins(opened) if isinstance(break_at, str) else loop_margins(opened)


def open_equation(model: LinearModel) -> Characteristic:
    """Return the characteristic equation of open loops, to be closed; sliding means of models with delays left in it.

    Raises LinearizationError where the direct part is -1.
    """
    equation = whole(model)
    through = np.eye(equation.through.shape[0]) + equation.through
    if np.linalg.cond(through) > 1e12 or np.abs(np.linalg.det(through)) < 1e-12:
        raise LinearizationError(
            "the loop is ill-posed: its direct part is -1",
            where=f"loop at '{', '.join(model.input_names)}'",
            hint="add the lag that is there",
        )
    return equation


def loop_margins(loop: Loop | LinearModel, omega: Array | None = None) -> LoopMargins:
    """Return the margins of several loops opened together (det(1 + L) = 0), each alone and all at once.

    A loop alone has the others closed: 1 + L_i = 1/S_ii with S = (1 + L)^-1.

    Parameters
    ----------
    loop : Loop or LinearModel
        The loops, or the linear model L from what is injected to minus what comes back, with as many inputs as outputs.
    omega : array of float (n,), default None
        The grid on which margins are searched, in rad/s. None: around the open and closed poles.

    Returns
    -------
    LoopMargins
        `each`, the margins of every loop alone by signal; `disk`, alpha of the disk in which all gains and phases may vary at once (a
        bound from below, exact for up to three loops); whether the closed loops are stable, delays exact.

    Raises
    ------
    LinearizationError
        There are not as many inputs as outputs, or the loops are ill-posed.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> margins = hi.linear.loop_margins(hi.linear.loop(hi.load_model("vsc-hvdc-link"), ["Irorder1", "Irorder2"]))
    >>> list(margins.each), margins.stable
    (['Irorder1', 'Irorder2'], True)
    """
    model = loop.open if isinstance(loop, Loop) else loop
    names = model.input_names
    if len(names) != len(model.output_names):
        raise LinearizationError(
            "loops have as many inputs as outputs",
            where=model.name,
            got=f"{len(names)} inputs and {len(model.output_names)} outputs",
            hint="open the model at signals: loop(model, [...])",
        )
    equation = open_equation(model)
    closed = equation.closed(np.ones(len(names)))
    judged = stability(closed)

    def sensitivity(w: Array) -> Array:
        """S = 1 - T from the closed loops, which poles of L do not disturb."""
        return np.asarray(np.eye(len(names)) - closed.response(1j * w))

    each = {}
    for i, n in enumerate(names):
        closing = Closing(equation, i)
        each[n] = _of_curve(_alone(sensitivity, i), _grid(model, closing, omega), closing)
    if judged.verdict != "stable":
        return LoopMargins(FrozenMap(each), NONE, judged)
    if len(names) == 1:
        return LoopMargins(FrozenMap(each), each[names[0]].disk, judged)
    return LoopMargins(FrozenMap(each), _common_disk(sensitivity, _grid(model, Closing(equation, 0), omega)), judged)


def _alone(sensitivity: Curves, i: int) -> Curves:
    """L of the i-th loop with the others closed, 1/S_ii - 1."""

    def values(w: Array) -> Array:
        own = sensitivity(w)[:, i, i]
        return np.asarray(1.0 / np.where(np.abs(own) < 1e-300, 1e-300, own) - 1.0)

    return values


def _grid(model: LinearModel, closing: Closing, omega: Array | None) -> Array:
    """Return the frequencies at which curves are computed first: around open and closed poles, and beside crossings."""
    if omega is not None:
        return np.asarray(omega, dtype=float)
    own = wide_omega(model, 4000)
    closed = np.abs(closing.open.closed(np.ones(closing.open.through.shape[0])).roots.values)
    closed = closed[closed > 1e-6 * own[0]]
    beyond = [np.geomspace(own[-1], 30.0 * v, 200) for v in (closed.max(initial=0.0),) if 30.0 * v > own[-1]]
    grid = np.concatenate([own, own[0] * np.logspace(-4, 0, 200), *beyond])
    if not closing.open.channels and closing.open.through.shape == (1, 1):
        at = crossing_frequencies(closing.open.matrix, closing.open.given, closing.open.read, closing.open.through)
        grid = np.concatenate([grid, *(at * (1.0 + k) for k in (-1e-3, -1e-6, 1e-6, 1e-3))])
    return np.unique(grid[grid > 0.0])


def _of_curve(values_at: Curves, grid: Array, closing: Closing) -> Margins:
    """Return the margins of a loop whose transfer function is given over rad/s."""
    judged = closing.at(1.0)
    values = values_at(grid)
    if closing.open.channels and judged.verdict == "stable":
        grid, values = refined(values_at, grid, values)

    def curve(w: float) -> complex:
        return complex(values_at(np.array([w]))[0])

    gain, phase = (
        _gains(grid, values, curve, FLOOR if closing.open.channels else 0.0),
        tuple(_phases(grid, values, curve)),
    )
    if judged.verdict != "stable":
        return Margins(_nearest(gain), NONE, NONE, phase, NONE, NONE, NONE, judged)
    gain += closing.ends()
    modulus = _smallest(grid, np.abs(1 + values), lambda w: abs(1 + curve(w)))
    disk = _smallest(grid, _disk(values), lambda w: float(_disk(np.array([curve(w)]))[0]))
    upper, lower = closing.limit(gain, 1), closing.limit(gain, -1)
    return Margins(_nearest(gain), upper, lower, phase, _delay(phase, closing), modulus, disk, judged)


def _nearest(gain: list[Crossing]) -> tuple[Crossing, ...]:
    return tuple(sorted(gain, key=lambda c: abs(np.log(c.value))))


def _delay(phase: Sequence[Crossing], closing: Closing) -> Crossing:
    """Return the smallest delay that takes a crossing of the unit circle to -1; none is stood where |L| >= 1 at infinity."""
    t = closing.open.closed(np.ones(closing.open.through.shape[0])).through[closing.place, closing.place]
    if abs(t) >= abs(1.0 - t):  # |L| = |T/(1 - T)|
        return Crossing(float("inf"), 0.0)
    delays = [Crossing(c.omega, float(np.radians(c.value % 360.0) / c.omega)) for c in phase if c.omega > 0]
    return min(delays, key=lambda c: c.value, default=Crossing())


def _common_disk(sensitivity: Curves, grid: Array) -> Crossing:
    """Return the largest balanced disk for all loops at once: 1 over the largest structured singular value of (S - T)/2.

    Its bound by Osborne's scaling is cheap and never below the sharper one, so that only the frequencies whose cheap
    bound exceeds the largest sharp one found so far have to be looked at.
    """

    def matrices(w: Array) -> Array:
        values = sensitivity(w)
        return np.asarray(values - 0.5 * np.eye(values.shape[1]))  # (S - T)/2 with T = 1 - S

    everywhere = matrices(grid)
    cheap = np.array([_scaled_norm(m, _osborne(m)) for m in everywhere])
    best, place = 0.0, 0
    for k in np.argsort(-cheap):
        if cheap[k] <= best * (1.0 + 1e-6):
            break
        sharp = structured_singular_value(everywhere[k])
        if sharp > best:
            best, place = sharp, int(k)
    low, high = grid[max(place - 1, 0)], grid[min(place + 1, grid.size - 1)]
    solution = minimize_scalar(
        lambda w: -structured_singular_value(matrices(np.array([w]))[0]), bounds=(low, high), method="bounded",
        options={"xatol": 1e-9 * high},
    )  # fmt: skip
    if -solution.fun > best:
        return Crossing(float(solution.x), float(-1.0 / solution.fun))
    return Crossing(float(grid[place]), 1.0 / best)


def structured_singular_value(matrix: Array) -> float:
    """Return the upper bound min over D of |D M D^-1| of mu for independent complex factors, one a row; exact up to three rows.

    D is positive and diagonal. The norm is convex in its logarithms (Sezginer and Overton 1990) but not smooth where two
    singular values meet; Schatten norms of rising order p, which exceed it by at most n^(1/p), are minimised instead.
    The value returned is the norm itself, so that it is a bound whatever the search did.
    """
    size = np.abs(matrix)
    # A coupling below the rounding of the largest entry is none; one that goes only one way is scaled away altogether.
    _, label = connected_components(size > 1e-15 * size.max(initial=0.0), directed=True, connection="strong")
    parts = [np.flatnonzero(label == k) for k in range(label.max() + 1)]
    return max(_strongly_coupled(matrix[np.ix_(part, part)]) for part in parts)


def _strongly_coupled(matrix: Array) -> float:
    if matrix.shape[0] == 1:
        return float(abs(matrix[0, 0]))
    logs = _osborne(matrix)
    best = _scaled_norm(matrix, logs)
    lower = float(np.abs(np.linalg.eigvals(matrix)).max())  # a common factor for all rows is one of the factors allowed
    for order in (8, 64, 512, 4096):
        if best <= lower * (1.0 + 1e-9):
            break
        solution = minimize(_schatten, logs, (matrix, order), jac=True, method="BFGS", options={"gtol": 1e-7})
        value = _scaled_norm(matrix, solution.x)
        if value < best:
            best, logs = value, solution.x - solution.x[0]
    return best


def _scaled_norm(matrix: Array, logs: Array) -> float:
    scale = np.exp(logs)
    return float(np.linalg.norm(scale[:, None] * matrix / scale, 2))


def _schatten(logs: Array, matrix: Array, order: int) -> tuple[float, Array]:
    """Return the logarithm of the Schatten norm of D M D^-1 and its derivatives by log D."""
    scale = np.exp(logs - logs.mean())
    u, s, vh = np.linalg.svd(scale[:, None] * matrix / scale)
    weight = (s / s[0]) ** order
    total = weight.sum()
    slope = (np.abs(u) ** 2 - np.abs(vh.T) ** 2) @ weight / total
    return float(np.log(s[0]) + np.log(total) / order), np.asarray(slope)


def _osborne(matrix: Array) -> Array:
    """log D for which every row of |D M D^-1| has the norm of its column, off the diagonal (Osborne 1960)."""
    size = np.abs(matrix) ** 2
    np.fill_diagonal(size, 0.0)
    logs = np.zeros(size.shape[0])
    for _ in range(20):
        moved = 0.0
        for i in range(logs.size):
            row = float(size[i] @ np.exp(2 * (logs[i] - logs)))
            column = float(size[:, i] @ np.exp(2 * (logs - logs[i])))
            if row > 0 and column > 0:
                step = 0.25 * np.log(column / row)
                logs[i] += step
                moved = max(moved, abs(step))
        if moved < 1e-6:
            break
    return logs


def _disk(values: Array) -> Array:
    """1/|(S - T)/2| for L: the balanced disk at each frequency."""
    return np.asarray(2.0 * np.abs(1 + values) / np.maximum(np.abs(1 - values), 1e-300))


def _gains(grid: Array, values: Array, curve: Curve, floor: float) -> list[Crossing]:
    """Crossings of the negative real axis, where L is above a floor: with delays there are infinitely many near 0."""
    crossings = []
    imag, large = values.imag, np.maximum(np.abs(values[1:]), np.abs(values[:-1])) > floor
    for k in np.flatnonzero((imag[:-1] * imag[1:] <= 0) & (imag[:-1] != imag[1:]) & large):
        w = _zero(lambda x: curve(x).imag, grid[k], grid[k + 1])
        real = curve(w).real
        if real < -1e-9 and abs(curve(w).imag) < 1e-6 * abs(real):
            crossings.append(Crossing(w, -1.0 / real))
    return crossings


def _phases(grid: Array, values: Array, curve: Curve) -> list[Crossing]:
    """Crossings of the unit circle."""
    crossings = []
    level = np.abs(values) - 1.0
    for k in np.flatnonzero((level[:-1] * level[1:] <= 0) & (level[:-1] != level[1:])):
        w = _zero(lambda x: abs(curve(x)) - 1.0, grid[k], grid[k + 1])
        angle = float(np.degrees(np.angle(curve(w)))) + 180.0
        crossings.append(Crossing(w, (angle + 180.0) % 360.0 - 180.0))
    return crossings


def _zero(function: Callable[[float], float], low: float, high: float) -> float:
    """Return where a function changes sign; the end nearer to 0 where rounding errors alone made it seem to."""
    first, last = function(low), function(high)
    if first * last > 0.0:
        return low if abs(first) < abs(last) else high
    return float(brentq(function, low, high, xtol=1e-14 * high, rtol=1e-14))


def _smallest(grid: Array, values: Array, at: Callable[[float], float]) -> Crossing:
    """Return the smallest value of a curve over the frequencies, refined between the grid's neighbours."""
    k = int(np.argmin(values))
    low, high = grid[max(k - 1, 0)], grid[min(k + 1, grid.size - 1)]
    if high > low:
        least = minimize_scalar(at, bounds=(low, high), method="bounded", options={"xatol": 1e-12 * high})
        if least.fun <= values[k]:
            return Crossing(float(least.x), float(least.fun))
    return Crossing(float(grid[k]), float(values[k]))
