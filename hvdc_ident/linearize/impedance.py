"""Impedances of a port, dq in the network's frame or dc, and measured frequency responses.

A measured response comes from data, from recordings, or from a simulation of the nonlinear model.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np
import sympy as sp

from hvdc_ident.data import Experiment
from hvdc_ident.errors import LinearizationError, WaveformError, unknown_name
from hvdc_ident.expression import TIME, parse, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.frequency import FrequencyResponse, by_s, followed_phase, phase_of, sensitivity
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.linearisation import linearize
from hvdc_ident.linearize.operating_point import find_operating_point
from hvdc_ident.linearize.point import OperatingPoint
from hvdc_ident.linearize.system import Array
from hvdc_ident.model import AnyModel, Model, Output, fresh, is_white_box, rewritten
from hvdc_ident.parameters import Input

Names = tuple[str, ...] | str
"""Two names, of d and q, or one of a dc port, which may stand alone."""


@dataclass(frozen=True)
class Port:
    """Port at which an impedance is seen: d and q of an ac port, or one signal each of a dc port.

    source: the signals of a voltage (or current) behind the port that is disturbed; which side of the port it lies on
    decides what is seen: a source in the grid shows the station. voltage, current: expressions at the port, the current
    counted towards what is to be seen. angle: of the model's frame ahead of the network's, rad, as an expression.

    Raises LinearizationError where the three differ in their number of signals.
    """

    source: Names
    voltage: Names
    current: Names
    angle: str = "0"

    def __post_init__(self) -> None:
        for part in ("source", "voltage", "current"):
            names = getattr(self, part)
            object.__setattr__(self, part, (names,) if isinstance(names, str) else tuple(names))
        sizes = [len(part) for part in (self.source, self.voltage, self.current)]
        if sizes not in ([1, 1, 1], [2, 2, 2]) or (sizes[0] == 1 and self.angle != "0"):
            raise LinearizationError(
                "the signals of a port do not fit together",
                expected="source, voltage and current of two signals each (d, q), or of one each and no angle (dc)",
                got=f"{sizes[0]}, {sizes[1]} and {sizes[2]} signals, angle {self.angle}",
            )

    @property
    def axes(self) -> tuple[str, ...]:
        """Names of the axes: d and q, or dc."""
        return ("d", "q") if len(self.source) == 2 else ("dc",)


def port_impedance(
    model: Model, port: Port, omega: Sequence[float] | Array, point: OperatingPoint | None = None
) -> FrequencyResponse:
    """Return the impedance seen at a port, delays exact.

    Parameters
    ----------
    model : Model
        A model with equations.
    port : Port
        The disturbed source, and voltage and current at the port, the current counted towards what is to be seen.
    omega : array of float (n,)
        Frequencies in rad/s.
    point : OperatingPoint, default None
        Where: its inputs and parameters hold, and the search begins at its states. None: the model's steady state.

    Returns
    -------
    FrequencyResponse
        values (n, 2, 2) over [d, q] in the network's frame, or (n, 1, 1) of a dc port, complex, in voltage unit per current unit.

    Raises
    ------
    UnknownNameError
        A signal that is not there.
    SteadyStateError
        There is no steady state.
    LinearizationError
        The disturbance drives no current, or the point lies on a kink.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> port = hi.linear.Port(source=("Iload1",), voltage=("Vdc1",), current=("-Iload1",))
    >>> hi.linear.port_impedance(hi.load_model("vsc-hvdc-link"), port, [1.0, 10.0]).values.shape
    (2, 1, 1)
    """
    return port_response(port_model(model, port, point), port, omega, "impedance")


def port_admittance(
    model: Model, port: Port, omega: Sequence[float] | Array, point: OperatingPoint | None = None
) -> FrequencyResponse:
    """Return the admittance seen at a port, the inverse of `port_impedance`, delays exact.

    Parameters
    ----------
    model : Model
        A model with equations.
    port : Port
        The disturbed source, and voltage and current at the port, the current counted towards what is to be seen.
    omega : array of float (n,)
        Frequencies in rad/s.
    point : OperatingPoint, default None
        Where: its inputs and parameters hold, and the search begins at its states. None: the model's steady state.

    Returns
    -------
    FrequencyResponse
        values (n, 2, 2) over [d, q] in the network's frame, or (n, 1, 1) of a dc port, complex, in current unit per voltage unit.

    Raises
    ------
    UnknownNameError
        A signal that is not there.
    SteadyStateError
        There is no steady state.
    LinearizationError
        The disturbance drives no voltage, or the point lies on a kink.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> link, port = hi.load_model("vsc-hvdc-link"), hi.linear.Port(source=("Iload1",), voltage=("Vdc1",), current=("-Iload1",))
    >>> y, z = (of(link, port, [1.0, 10.0]).values for of in (hi.linear.port_admittance, hi.linear.port_impedance))
    >>> bool(abs(y * z - 1.0).max() < 1e-9)
    True
    """
    return port_response(port_model(model, port, point), port, omega, "admittance")


def port_model(model: Model, port: Port, point: OperatingPoint | None = None) -> LinearModel:
    """Return the linear model from the disturbances of a port's source to its voltages, then its currents."""
    disturbed, inputs, outputs = disturbed_model(model, port)
    given = {} if point is None else {**point.inputs, **point.parameters}
    guess = {} if point is None else {**point.states, **point.unknowns, **point.extras}
    at = find_operating_point(disturbed, given, guess=guess)
    return linearize(disturbed, at, inputs=inputs, outputs=outputs)


def port_values(linear: LinearModel, port: Port, w: Array, kind: str) -> Array:
    """Return (n, k, k) values of the "impedance" or "admittance" that a port's linear model (`port_model`) shows at w, rad/s."""
    top, bottom = _parts(linear.response(w), port, kind)
    if (np.linalg.cond(bottom) > 1e14).any():
        hint = "choose a source on the other side of the port"
        moved = "both axes of the port" if len(port.axes) == 2 else "the port"
        raise LinearizationError(f"the {kind} does not exist: the disturbance does not move {moved}", hint=hint)
    return np.asarray(top @ np.linalg.inv(bottom))


def port_phase(linear: LinearModel, port: Port, w: Array, kind: str) -> Array:
    """Return (n, k, k) degrees of the same, turns between the frequencies counted."""

    def sloped(s: Array) -> tuple[Array, Array, Array]:
        (top, bottom), (d_top, d_bottom), (off_top, off_bottom) = (_parts(x, port, kind) for x in by_s(linear, s))
        inverse = np.linalg.inv(bottom)
        ratio = top @ inverse
        return ratio, (d_top - ratio @ d_bottom) @ inverse, (off_top + np.abs(ratio) @ off_bottom) @ np.abs(inverse)

    return followed_phase(sloped, linear, w)


def port_response(linear: LinearModel, port: Port, omega: Sequence[float] | Array, kind: str) -> FrequencyResponse:
    """Return the "impedance" or "admittance" that a port's linear model (`port_model`) shows, with its phase."""
    w = np.atleast_1d(np.asarray(omega, dtype=float))
    values, phase = port_values(linear, port, w, kind), port_phase(linear, port, w, kind)
    return FrequencyResponse(w, values, port.axes, port.axes, source=kind, phase=phase)


def port_sensitivity(linear: LinearModel, port: Port, omega: Array, kind: str, names: Sequence[str]) -> Array:
    """Return (n, k, k, parameters) derivatives of a port's response: dZ = (dV - Z dI) I^-1, the operating point's shift included."""
    top, bottom = _parts(linear.response(omega), port, kind)
    inverse = np.linalg.inv(bottom)
    ratio = top @ inverse
    slopes = []
    for slope in sensitivity(linear, omega, names).values():
        d_top, d_bottom = _parts(slope, port, kind)
        slopes.append((d_top - ratio @ d_bottom) @ inverse)
    return np.stack(slopes, axis=-1) if slopes else np.zeros((*ratio.shape, 0), dtype=complex)


def _parts(values: Array, port: Port, kind: str) -> tuple[Array, Array]:
    """Numerator and denominator of a response from the disturbances to [voltages, currents]."""
    k = len(port.axes)
    voltage, current = values[:, :k], values[:, k:]
    return (voltage, current) if kind == "impedance" else (current, voltage)


def disturbed_model(model: Model, port: Port) -> tuple[Model, list[str], list[str]]:
    """Return (model, inputs, outputs): with the source's disturbances as inputs, and voltages and currents at the port as outputs."""
    inputs = [fresh(model, f"disturbance_{axis}") for axis in port.axes]
    angle = parse(port.angle)
    turned = _turned(tuple(symbol(n) for n in inputs), -angle)
    new = replace(model, inputs=model.inputs | FrozenMap({n: Input(0.0, "pu") for n in inputs}))
    seen: dict[sp.Symbol, sp.Symbol] = {}
    for name, part in zip(port.source, turned, strict=True):

        def add(m: Model, u: Any, part: sp.Expr = part) -> tuple[Model, Any]:
            return m, u + part

        before = set(new.signals)
        new = rewritten(new, name, "disturbance", add)
        if name in model.inputs or name in model.states:  # readers see another name, and so does the port
            seen |= {symbol(name): symbol(n) for n in new.signals if n not in before}
    outputs: dict[str, Output] = {}
    for kind, signals in (("voltage", port.voltage), ("current", port.current)):
        values = _turned(tuple(parse(s).xreplace(seen) for s in signals), angle)
        outputs |= {fresh(new, f"port_{kind}_{axis}"): Output(v) for axis, v in zip(port.axes, values, strict=True)}
    return replace(new, outputs=new.outputs | FrozenMap(outputs)), inputs, list(outputs)


def _turned(signals: tuple[sp.Expr, ...], angle: sp.Expr) -> tuple[sp.Expr, ...]:
    """d + jq turned ahead by an angle; one signal as it is."""
    if len(signals) == 1:
        return signals
    d, q = signals
    return d * sp.cos(angle) - q * sp.sin(angle), d * sp.sin(angle) + q * sp.cos(angle)


Kind = Literal["transfer", "impedance", "admittance"]


@dataclass(frozen=True, eq=False)
class MeasuredResponse:
    """A frequency response that was measured on the plant, and where a model shows the same.

    channels: (output, input) of each measured channel: of the model, or axes of the port ("d", "q", "dc").
    omega: (n,) rad/s; values: (n, channels) complex, in the model's units. std: (n, channels) standard deviation of the
    error's modulus, None where it is not known. dof: independent numbers it was estimated from, infinite where it is exact.
    port: for an impedance or admittance. fixed: inputs held at the operating point. trim: values of outputs there, which
    `free` inputs are set for. role: "fit" or "holdout". unit: as it was measured, for people.

    Raises LinearizationError where the parts do not fit.
    """

    name: str
    kind: Kind
    channels: tuple[tuple[str, str], ...]
    omega: Array
    values: Array
    std: Array | None = None
    dof: float = float("inf")
    port: Port | None = None
    fixed: FrozenMap[float] = field(default_factory=FrozenMap)
    trim: FrozenMap[float] = field(default_factory=FrozenMap)
    free: tuple[str, ...] = ()
    role: Literal["fit", "holdout"] = "fit"
    unit: str = ""

    def __post_init__(self) -> None:
        shape = (self.omega.size, len(self.channels))
        fits = self.values.shape == shape and (self.std is None or self.std.shape == shape)
        if not fits or not self.channels or (self.port is None) != (self.kind == "transfer"):
            raise LinearizationError(
                "a measured response does not fit together",
                where=f"response '{self.name}'",
                expected=f"values and std of shape {shape}, and a port for an impedance or admittance",
                got=f"{self.values.shape}, kind {self.kind}",
            )

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each channel: "Vdc1 from Vdcref1", or "d from q"."""
        return tuple(f"{o} from {i}" for o, i in self.channels)

    def point(self, model: AnyModel, values: Mapping[str, float]) -> OperatingPoint:
        """Return the operating point it was measured at. Raises SteadyStateError."""
        fixed = {**values, **self.fixed}
        return find_operating_point(model, fixed, self.free, outputs=dict(self.trim) or None)

    def linear(self, model: AnyModel, values: Mapping[str, float], names: Sequence[str] = ()) -> LinearModel:
        """Return the linear model that shows the response: of the channels, or of the port's disturbances.

        values: of parameters. names: parameters for derivatives. Raises SteadyStateError, or LinearizationError where the
        model has no linear one there.
        """
        if self.port is None:
            outputs, inputs = (list(dict.fromkeys(c[k] for c in self.channels)) for k in (0, 1))
            point = self.point(model, values)
            return linearize(model, point, inputs=inputs, outputs=outputs, sensitivities=tuple(names))
        if not is_white_box(model):
            raise LinearizationError("an impedance needs the model's equations", where=f"model '{model.name}'")
        disturbed, inputs, outputs = self._disturbed(model)
        point = self.point(disturbed, values)
        return linearize(disturbed, point, inputs=inputs, outputs=outputs, sensitivities=tuple(names))

    def of_model(self, model: AnyModel, values: Mapping[str, float], names: Sequence[str] = ()) -> tuple[Array, Array]:
        """Return (response, derivatives) of a model, (n, channels) and (n, channels, names), at the same frequencies.

        The derivatives hold the operating point's shift. Arguments and errors as in `linear`.
        """
        return self.seen(self.linear(model, values, names), names)

    def seen(self, linear: LinearModel, names: Sequence[str] = ()) -> tuple[Array, Array]:
        """Return the same of a linear model that `linear` gave."""
        if self.port is None:
            values = linear.response(self.omega)
            slopes = np.zeros((*values.shape, 0), dtype=complex)
            if names:
                slopes = np.stack([*sensitivity(linear, self.omega, names).values()], axis=-1)
        else:
            values = port_values(linear, self.port, self.omega, self.kind)
            slopes = port_sensitivity(linear, self.port, self.omega, self.kind, names)
        return self._channels_of(linear, values), self._channels_of(linear, slopes)

    def phase(self, linear: LinearModel) -> Array:
        """Return (n, channels) degrees of the response of a linear model that `linear` gave, turns between frequencies counted."""
        if self.port is None:
            degrees = phase_of(linear, self.omega)
        else:
            degrees = port_phase(linear, self.port, self.omega, self.kind)
        return self._channels_of(linear, degrees)

    def _channels_of(self, linear: LinearModel, values: Array) -> Array:
        """Return the measured channels, (n, channels, ...), of (n, outputs, inputs, ...)."""
        names = (linear.output_names, linear.input_names) if self.port is None else (self.port.axes, self.port.axes)
        rows, columns = ([n.index(c[k]) for c in self.channels] for k, n in enumerate(names))
        return np.asarray(values[:, rows, columns])

    def _disturbed(self, model: Model) -> tuple[Model, list[str], list[str]]:
        """Return the model with the port's disturbances, made once for a model."""
        assert self.port is not None
        known = self._made
        if known.get("of") is not model:
            known |= {"of": model, "made": disturbed_model(model, self.port)}
        made: tuple[Model, list[str], list[str]] = known["made"]
        return made

    @cached_property
    def _made(self) -> dict[str, Any]:
        return {}

    def __getstate__(self) -> dict[str, Any]:
        """Return the data alone, which travel to another process."""
        return {k: v for k, v in self.__dict__.items() if k in self.__dataclass_fields__}

    def errors(self, model_values: Array) -> list[dict[str, Any]]:
        """Return the distance of a model's response from the measured one, by channel.

        relative: root mean square of the error over that of the measurement; largest deviations of gain (dB) and phase
        (degrees) and where; chi2_per_point: mean square of the error in standard deviations, None where none is known.
        factor: what the model's response times it meets the measured one best by, where that is no matter of a gain alone
        (negative, or over 2 or below a half) and explains nine tenths of the squared error; else None.
        """
        by_channel = []
        for k, label in enumerate(self.labels):
            measured, model = self.values[:, k], model_values[:, k]
            apart = model - measured
            with np.errstate(divide="ignore", invalid="ignore"):
                gain = 20 * np.log10(np.abs(model) / np.abs(measured))
                phase = np.degrees(np.angle(model * np.conj(measured)))
            gain, phase = np.where(np.isfinite(gain), gain, 0.0), np.where(np.isfinite(phase), phase, 0.0)
            size = float(np.sqrt(np.mean(np.abs(measured) ** 2)))
            first, second = int(np.argmax(np.abs(gain))), int(np.argmax(np.abs(phase)))
            chi2 = None if self.std is None else float(np.mean(np.abs(apart / self.std[:, k]) ** 2))
            by_channel.append(
                {
                    "channel": label,
                    "relative": float(np.sqrt(np.mean(np.abs(apart) ** 2))) / size if size > 0 else None,
                    "gain_db": {"value": float(gain[first]), "omega": float(self.omega[first])},
                    "phase_deg": {"value": float(phase[second]), "omega": float(self.omega[second])},
                    "chi2_per_point": chi2,
                    "factor": _factor(measured, model),
                }
            )
        return by_channel


def _factor(measured: Array, model: Array) -> float | None:
    """Return a sign, unit or base by which two responses differ, as `MeasuredResponse.errors` says."""
    power = float(np.sum(np.abs(model) ** 2))
    apart = float(np.sum(np.abs(measured - model) ** 2))
    if power == 0.0 or apart == 0.0:
        return None
    factor = float(np.sum(measured * np.conj(model)).real) / power
    left = float(np.sum(np.abs(measured - factor * model) ** 2))
    return factor if not 0.5 <= factor <= 2.0 and left < 0.1 * apart else None


def response_at_tones(
    time: Array, u: Array, y: Array, omega: Array, *, input: str = "u", output: str = "y"
) -> FrequencyResponse:
    """Return the response at the frequencies at which a record was perturbed, by least squares on both signals.

    Each signal is a constant, a drift and a sine at each frequency; what is left of it gives the standard deviation, as white noise.

    Parameters
    ----------
    time : array of float (n,)
        In s; rows may be uneven.
    u : array of float (n,)
        The recorded input, in its unit.
    y : array of float (n,)
        The recorded output, in its unit.
    omega : array of float (k,)
        The frequencies, in rad/s.
    input : str, default "u"
        The input's name in the result.
    output : str, default "y"
        The output's name in the result.

    Returns
    -------
    FrequencyResponse
        values (k, 1, 1), complex, in output unit per input unit, and std (k, 1, 1), the standard deviation of the error's modulus.

    Raises
    ------
    WaveformError
        Too few rows or a value not finite, a record too short to tell the frequencies apart, or one at which the input does not move.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> t = np.linspace(0.0, 10.0, 2001)
    >>> u = np.sin(2 * np.pi * t)
    >>> response = hi.linear.response_at_tones(t, u, 2 * u + 0.1, np.array([2 * np.pi]))
    >>> round(float(response.magnitude[0, 0, 0]), 9)
    2.0
    """
    t, u, y = (np.asarray(v, dtype=float) for v in (time, u, y))
    w = np.atleast_1d(np.asarray(omega, dtype=float))
    span = float(np.ptp(t)) if t.size else 0.0
    columns = 2 + 2 * w.size
    if t.size <= 2 * columns or not (np.isfinite(u).all() and np.isfinite(y).all()):
        raise WaveformError(
            "too few rows for these frequencies", expected=f"more than {2 * columns} finite rows", got=f"{t.size}"
        )
    apart = np.diff(np.sort(w)).min(initial=w.min())
    if not (w > 0).all() or span * apart < 2 * np.pi * (1 - 1e-9):
        raise WaveformError(
            "the record is too short to tell these frequencies apart",
            expected=f"at least {2 * np.pi / apart:.4g} s, one period of the smallest distance between them",
            got=f"{span:.4g} s",
        )
    x = (t - t[0]) / span - 0.5
    basis = np.column_stack([np.ones(t.size), x, *(f(k * t) for k in w for f in (np.cos, np.sin))])
    solved, *_ = np.linalg.lstsq(basis, np.column_stack([u, y]), rcond=None)
    phasors = solved[2::2] - 1j * solved[3::2]
    left = np.column_stack([u, y]) - basis @ solved
    dof = t.size - columns
    sigma = np.sqrt((left**2).sum(axis=0) / dof)
    variance = np.linalg.inv(basis.T @ basis).diagonal()
    scatter = np.sqrt(variance[2::2] + variance[3::2])[:, None] * sigma  # of the phasors' moduli
    drive = np.abs(phasors[:, 0])
    if (drive <= 3.0 * scatter[:, 0]).any() or (drive == 0).any():
        k = int(np.argmin(drive / np.maximum(scatter[:, 0], 1e-300)))
        raise WaveformError(f"the input '{input}' does not move at {w[k] / (2 * np.pi):.6g} Hz", hint="leave it out")
    h = phasors[:, 1] / phasors[:, 0]
    std = np.sqrt(scatter[:, 1] ** 2 + np.abs(h) ** 2 * scatter[:, 0] ** 2) / drive
    shape = (-1, 1, 1)
    return FrequencyResponse(
        w, h.reshape(shape), (output,), (input,), (("", ""),), std.reshape(shape), source="recording"
    )


def response_from_record(
    time: Array, u: Array, y: Array, *, input: str = "u", output: str = "y", segments: int = 8, window: str = "hann"
) -> FrequencyResponse:
    """Return the response from recorded input to recorded output by Welch's averages, with coherence and standard deviation.

    The standard deviation is sqrt((1 - g2)/(2 k g2)) |H| (Bendat and Piersol, 9.2) with g2 the coherence and k the effective number of
    averages.

    Parameters
    ----------
    time : array of float (n,)
        In s; uneven rows are put on an even grid by straight lines.
    u : array of float (n,)
        The recorded input, in its unit.
    y : array of float (n,)
        The recorded output, in its unit.
    input : str, default "u"
        The input's name in the result.
    output : str, default "y"
        The output's name in the result.
    segments : int, default 8
        How many, half overlapped; more give a surer and coarser estimate. n is at least 16 times as many.
    window : str, default "hann"
        The window of each segment, by its name in `scipy.signal.get_window`.

    Returns
    -------
    FrequencyResponse
        omega (k,) in rad/s, values (k, 1, 1), complex, in output unit per input unit, std and coherence (k, 1, 1).

    Raises
    ------
    WaveformError
        The data are too short, constant or not finite.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> t, u = np.arange(4000) * 0.01, np.random.default_rng(0).standard_normal(4000)
    >>> response = hi.linear.response_from_record(t, u, 2 * u)
    >>> bool(abs(response.magnitude - 2.0).max() < 1e-9), response.coherence.shape == response.values.shape
    (True, True)
    """
    import scipy.signal

    t, u, y = (np.asarray(v, dtype=float) for v in (time, u, y))
    if not (t.ndim == 1 and t.shape == u.shape == y.shape and t.size >= 16 * max(segments, 1)):
        raise WaveformError(
            "too few rows for a frequency response",
            expected=f"three columns of at least {16 * segments} rows",
            got=f"{t.size}",
        )
    if not (np.isfinite(t).all() and np.isfinite(u).all() and np.isfinite(y).all()):
        raise WaveformError("a recorded value is not finite")
    even = np.linspace(t[0], t[-1], t.size)
    if np.abs(t - even).max() > 1e-6 * (even[1] - even[0]):
        u, y = np.interp(even, t, u), np.interp(even, t, y)
    if np.ptp(u) == 0.0:
        raise WaveformError(f"the input '{input}' never changes: it excites nothing", hint="choose an input that moves")
    length = 2 * t.size // (segments + 1)
    rate = 1.0 / (even[1] - even[0])
    common: dict[str, Any] = {"fs": rate, "nperseg": length, "window": window, "detrend": "constant"}
    f, cross = scipy.signal.csd(u, y, **common)
    own, other = scipy.signal.welch(u, **common)[1], scipy.signal.welch(y, **common)[1]
    keep = (f > 0) & (own > 1e-14 * own.max())
    h = cross[keep] / own[keep]
    power = own[keep] * other[keep]
    coherence = np.where(power > 0, np.abs(cross[keep]) ** 2 / np.where(power > 0, power, 1.0), 0.0).clip(0.0, 1.0)
    averages = max(1.0, segments * 0.947)  # half-overlapped Hann segments (Welch 1967)
    std = np.abs(h) * np.sqrt((1.0 - coherence) / (2.0 * averages * np.maximum(coherence, 1e-12)))
    shape = (-1, 1, 1)
    return FrequencyResponse(
        2 * np.pi * f[keep], h.reshape(shape), (output,), (input,), (("", ""),),
        std.reshape(shape), coherence.reshape(shape), "recording",
    )  # fmt: skip


def simulated_response(
    model: Model,
    input: str,
    outputs: Sequence[str],
    omega: Sequence[float] | Array,
    amplitude: float,
    *,
    values: Mapping[str, float] | None = None,
    periods: int = 1,
    rtol: float = 1e-9,
    seed: int = 0,
) -> FrequencyResponse:
    """Return the response measured on the nonlinear model by a multisine about its steady state: a check on the linear one.

    Transients are waited for as long as the linear model's slowest stable mode asks.

    Parameters
    ----------
    model : Model
        A model with equations.
    input : str
        The input that the multisine is added to.
    outputs : list of str
        Names of outputs or signals.
    omega : array of float (n,)
        Wanted frequencies, in rad/s; each is moved to a multiple of the lowest one, so read them from the result.
    amplitude : float
        Of every sine, in the input's unit, small enough for no limit to act and large enough for the solver's tolerance.
    values : dict of float, default None
        Values of parameters and inputs by name, in the model's units, where they differ from the model's.
    periods : int, default 1
        How many periods of the lowest frequency are measured.
    rtol : float, default 1e-9
        Relative error of the integration; the absolute one is rtol / 100.
    seed : int, default 0
        Of the phases of the sines; same seed, same result.

    Returns
    -------
    FrequencyResponse
        omega (k,) in rad/s and values (k, outputs, 1), complex, in output unit per input unit.

    Raises
    ------
    UnknownNameError
        An input or output that the model lacks.
    LinearizationError
        The operating point is unstable, or there is no frequency or amplitude above 0.
    SimulationError
        The run stops early.

    Examples
    --------
    >>> import numpy as np, hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 0.5, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> response = hi.linear.simulated_response(lag, "u", ["y"], [2.0, 6.0], 0.01)
    >>> bool(np.allclose(response.values[:, 0, 0], 2.0 / (1.0 + 0.5j * response.omega), rtol=1e-5))
    True
    """
    from hvdc_ident.simulate import simulate

    if input not in model.inputs:
        raise unknown_name("input", input, model.inputs, where=f"model '{model.name}'")
    wanted = np.unique(np.asarray(omega, dtype=float))
    if wanted.size == 0 or not (wanted > 0).all() or not np.isfinite(wanted).all() or not amplitude > 0:
        raise LinearizationError(
            "a multisine needs frequencies and an amplitude above 0", where="response by simulation"
        )
    base = wanted[0]
    harmonics = np.unique(np.maximum(1, np.rint(wanted / base)).astype(int))
    phases = np.random.default_rng(seed).uniform(0, 2 * np.pi, harmonics.size)
    period = 2 * np.pi / base
    settle = _settling(model, values or {}) + 1e-9
    begin = period * np.ceil(settle / period)
    count = int(2 ** np.ceil(np.log2(max(64, 8 * harmonics.max()))))
    time = np.concatenate([[0.0], begin + period * periods * np.arange(count * periods) / (count * periods)])

    def multisine(m: Model, u: Any) -> tuple[Model, Any]:
        terms = [
            sp.Float(amplitude, 17) * sp.sin(sp.Float(k * base, 17) * TIME + sp.Float(q, 17))
            for k, q in zip(harmonics, phases, strict=True)
        ]
        return m, sum(terms, start=u)

    excited = rewritten(model, input, "multisine", multisine)
    run = simulate(excited, Experiment(time, "multisine"), values, outputs=list(outputs), rtol=rtol)
    response = np.empty((harmonics.size, len(outputs), 1), dtype=complex)
    drive = amplitude * np.exp(1j * (phases - np.pi / 2)) / 2
    for i, name in enumerate(outputs):
        spectrum = np.fft.fft(run.trajectory[name][1:]) / (count * periods)
        response[:, i, 0] = spectrum[harmonics * periods] / drive
    units = tuple((model.outputs[o].unit if o in model.outputs else "", model.inputs[input].unit) for o in outputs)
    return FrequencyResponse(harmonics * base, response, tuple(outputs), (input,), units, source="simulation")


def _settling(model: Model, values: Mapping[str, float]) -> float:
    """Seconds until the slowest stable mode has decayed by 1e-9; LinearizationError for an unstable point."""
    point = find_operating_point(model, dict(values))
    linear = linearize(model, point)
    rates = linear.poles().real
    if linear.stability().verdict in ("unstable", "not decided"):
        raise LinearizationError(
            f"the operating point is {linear.stability().verdict}: nothing to measure", where=f"model '{model.name}'"
        )
    slow = np.abs(rates[np.abs(rates) > 1e-6])
    return float(np.log(1e9) / slow.min()) if slow.size else 0.0
