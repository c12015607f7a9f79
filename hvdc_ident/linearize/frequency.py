"""Frequency responses, delays exact: values, singular values, derivatives by parameters and error bands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.codec import read_fields
from hvdc_ident.display import Shown, Table, data_frame, first_rows
from hvdc_ident.errors import LinearizationError, unknown_name
from hvdc_ident.linearize import plot
from hvdc_ident.linearize.linear_model import LinearModel, approximate_poles, gradient_of
from hvdc_ident.linearize.stability import ZERO
from hvdc_ident.linearize.system import Array

if TYPE_CHECKING:
    import xarray


@dataclass(frozen=True, eq=False)
class _Lists:
    """A frequency response as JSON has it: real and imaginary part and phase, (n, outputs, inputs)."""

    omega: Array
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    real: Array
    imag: Array
    phase_deg: Array
    source: str


@dataclass(frozen=True, eq=False, repr=False)
class FrequencyResponse(Shown):
    """A frequency response. omega: (n,) rad/s; values: (n, outputs, inputs) complex, in output unit per input unit.

    std: (n, outputs, inputs) standard deviation of the error's modulus, where one is known. coherence: of a recording.
    phase: (n, outputs, inputs) degrees as a model's response turns between the frequencies too; None where it is known at
    the frequencies alone.
    """

    omega: Array
    values: Array
    output_names: tuple[str, ...]
    input_names: tuple[str, ...]
    units: tuple[tuple[str, str], ...] = ()
    std: Array | None = None
    coherence: Array | None = None
    source: str = "model"
    phase: Array | None = None

    @property
    def frequency_hz(self) -> Array:
        """(n,) Hz."""
        return self.omega / (2 * np.pi)

    @property
    def magnitude(self) -> Array:
        """(n, outputs, inputs) modulus."""
        return np.abs(self.values)

    @property
    def magnitude_db(self) -> Array:
        """(n, outputs, inputs) dB; a channel that is 0 has -inf, which is its value."""
        with np.errstate(divide="ignore"):
            return np.asarray(20 * np.log10(self.magnitude))

    @property
    def phase_deg(self) -> Array:
        """(n, outputs, inputs) degrees: `phase`, or where there is none the angle, from each frequency to the next by the shorter way."""
        if self.phase is not None:
            return self.phase
        return np.asarray(np.degrees(np.unwrap(np.angle(self.values), axis=0)))

    def channel(self, input: str, output: str) -> Array:
        """Return (n,) complex response of one channel."""
        if input not in self.input_names:
            raise unknown_name("input", input, self.input_names)
        if output not in self.output_names:
            raise unknown_name("output", output, self.output_names)
        return np.asarray(self.values[:, self.output_names.index(output), self.input_names.index(input)])

    def to_xarray(self) -> xarray.DataArray:
        """Return the response with labelled axes omega, output, input."""
        import xarray

        axes = {"omega": self.omega, "output": list(self.output_names), "input": list(self.input_names)}
        return xarray.DataArray(self.values, coords=axes, dims=tuple(axes), name="response")

    def to_dataframe(self) -> Any:
        """Return gain and phase of every channel as a pandas DataFrame over frequency in Hz.

        Raises InputError where pandas is not installed.
        """
        columns = {}
        for j, o in enumerate(self.output_names):
            for k, i in enumerate(self.input_names):
                columns[f"{o}/{i} gain"] = self.magnitude[:, j, k]
                columns[f"{o}/{i} phase, degrees"] = self.phase_deg[:, j, k]
        return data_frame(columns, self.frequency_hz, "frequency, Hz")

    def _screen(self) -> Iterator[str | Table]:
        f = self.frequency_hz
        yield f"Frequency response ({self.source}): {f.size} frequencies, {f.min():.4g} to {f.max():.4g} Hz"
        rows, magnitude, phases = [], self.magnitude, self.phase_deg
        for j, output in enumerate(self.output_names):
            for k, input in enumerate(self.input_names):
                gain, phase = magnitude[:, j, k], phases[:, j, k]
                peak = int(np.argmax(gain))
                rows.append(
                    (f"{input} to {output}", *map(float, (gain[0], phase[0], gain[peak], f[peak], gain[-1], phase[-1])))
                )
        header = ("channel", "first gain", "phase, deg", "largest gain", "at, Hz", "last gain", "phase, deg")
        yield from first_rows(header, rows, "channels")

    def plot(self, ax: Any = None) -> Any:
        """Return the two axes of a Bode diagram, gain and phase. ax: two axes to draw on."""
        return plot.bode([self], ax=ax)

    def to_dict(self) -> dict[str, Any]:
        """Return the response as plain lists."""
        return {
            "omega": self.omega.tolist(),
            "outputs": list(self.output_names),
            "inputs": list(self.input_names),
            "real": self.values.real.tolist(),
            "imag": self.values.imag.tolist(),
            "phase_deg": self.phase_deg.tolist(),
            "source": self.source,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FrequencyResponse:
        """Return the response that `to_dict` wrote, without units. Raises InputError for anything else."""
        found = read_fields(_Lists, data)
        values = found.real + 1j * found.imag
        return cls(found.omega, values, found.outputs, found.inputs, source=found.source, phase=found.phase_deg)


def transfer(model: LinearModel, s: Array) -> Array:
    """Return (points, outputs, inputs) transfer matrix at complex frequencies s, rad/s; delays exact.

    Raises LinearizationError exactly on a pole.
    """
    s = np.atleast_1d(np.asarray(s, dtype=complex))
    if model.delay_free is not None:
        return model.delay_free.response(s)
    if model.A.shape[0] == 0:
        return np.broadcast_to(model.D.astype(complex), (s.size, *model.D.shape)).copy()
    pencil = s[:, None, None] * model.E - model.A
    try:
        inner = np.linalg.solve(pencil, np.broadcast_to(model.B.astype(complex), (s.size, *model.B.shape)))
    except np.linalg.LinAlgError:
        raise LinearizationError(
            "a frequency lies exactly on a pole", where=f"linear model '{model.name}'", hint="leave this frequency out"
        ) from None
    return np.asarray(model.C @ inner + model.D)


def response(model: LinearModel, omega: Array | Sequence[float]) -> Array:
    """Return (frequencies, outputs, inputs) complex transfer matrix at omega in rad/s, delays exact."""
    return transfer(model, 1j * np.atleast_1d(np.asarray(omega, dtype=float)))


def transfer_slope(model: LinearModel, s: Array) -> Array:
    """Return (points, outputs, inputs) derivative of the transfer matrix by s; delays exact."""
    if model.delay_free is not None:
        return model.delay_free.response_by_s(s)
    if model.A.shape[0] == 0:
        return np.zeros((s.size, *model.D.shape), dtype=complex)
    pencil = s[:, None, None] * model.E - model.A
    inner = np.linalg.solve(pencil, np.broadcast_to(model.B.astype(complex), (s.size, *model.B.shape)))
    return np.asarray(-model.C @ np.linalg.solve(pencil, model.E @ inner))


VISIBLE = 0.01
"""Share of a channel's largest gain that a pole adds to the channel at least, to be shown: a hundredth is a line's width of 40 dB."""


def default_omega(model: LinearModel, points: int = 400) -> Array:
    """Return (n,) rad/s to show a response at: logarithmic, from a decade below the slowest to a decade above the fastest pole.

    A pole that no channel shows does not widen the band: one whose part of the response, at its own frequency, is below
    `VISIBLE` of the channel's largest gain.
    """
    poles = _poles_apart_from_0(model)
    shown = poles[_visible(model, poles)]
    return _around(poles, shown if shown.size else poles, 1.0, points)


def wide_omega(model: LinearModel, points: int = 400) -> Array:
    """Return (n,) rad/s to search a response at: as `default_omega`, with every pole and half a decade more on either side."""
    poles = _poles_apart_from_0(model)
    return _around(poles, poles, 1.5, points)


def _poles_apart_from_0(model: LinearModel) -> Array:
    poles = approximate_poles(model)
    return poles[np.abs(poles) > ZERO * max(1.0, float(np.abs(poles).max(initial=0.0)))]


def _around(poles: Array, ends: Array, decades: float, points: int) -> Array:
    """Return frequencies from the slowest to the fastest of `ends` and some decades beyond, those of resonances among them."""
    sizes = np.abs(ends) if ends.size else np.ones(1)
    grid = np.logspace(np.log10(sizes.min()) - decades, np.log10(sizes.max()) + decades, points)
    return np.unique(np.concatenate([grid, _resonances(poles, grid[0], grid[-1])]))


def _resonances(poles: Array, low: float, high: float) -> Array:
    """Return the frequencies of damped oscillations between two frequencies; on an undamped pole there is no response."""
    found = np.abs(poles[np.abs(poles.real) > 1e-9 * np.abs(poles)].imag)
    return np.asarray(found[(found > low) & (found < high)])


def _visible(model: LinearModel, poles: Array) -> Array:
    """Return a mask of the poles that some channel shows; all of them where a descriptor has no modes to tell by."""
    try:
        a, b, c, _ = model.standard()
    except LinearizationError:
        return np.ones(poles.size, dtype=bool)
    values, right = np.linalg.eig(a)
    parts = np.abs((c @ right).T[:, :, None] * np.linalg.lstsq(right, b.astype(complex), rcond=None)[0][:, None, :])
    largest = np.abs(transfer(model, 1j * _around(poles, poles, 0.1, 200))).max(axis=0)
    near = np.array([int(np.argmin(np.abs(values - p))) for p in poles], dtype=int)
    distance = np.abs(1j * np.abs(poles) - poles)[:, None, None]
    more_than_rounding = largest > 1e-12 * largest.max(initial=0.0)
    return np.asarray(((parts[near] > VISIBLE * largest * distance) & more_than_rounding).any(axis=(1, 2)))


TURN = 0.5
"""Largest difference in rad between what a phase's slopes at both ends of a step give for it: far below half a turn."""
ROUNDS = 60
"""Times that steps are parted where slopes differ: enough for any two numbers to be neighbours."""

PER_DECADE = 60
"""Frequencies that are looked at beside the given ones: two resonances that turn by 180 degrees each hide between two others."""


def followed_phase(model: LinearModel, omega: Array) -> Array:
    """Return (n, outputs, inputs) degrees at rising omega, rad/s, turns between the frequencies counted.

    The angles alone leave whole turns open, of which a delay makes many in one step. The phase's slopes Re(G'/G) at both
    ends tell how many; where they do not agree to `TURN`, the step is parted. A channel that is 0 has 0.
    """
    if omega.size < 2:
        return np.degrees(np.angle(transfer(model, 1j * omega)))
    between = _resonances(approximate_poles(model), omega[0], omega[-1])
    first = omega[omega > 0.0][0]
    fill = np.geomspace(first, omega[-1], 2 + round(PER_DECADE * np.log10(omega[-1] / first)))
    w = np.unique(np.concatenate([omega, between, fill[1:-1]]))
    values, slopes = _with_slopes(model, w)
    for _ in range(ROUNDS):
        change, apart = _turned(w, values, slopes)
        wide = (apart > TURN).any(axis=(1, 2)) & (np.diff(w) > 1e-9 * w[1:])
        if not wide.any():
            break
        low, high = w[:-1][wide], w[1:][wide]
        middle = np.where(high > 4.0 * low, np.sqrt(np.maximum(low, 1e-3 * high) * high), 0.5 * (low + high))
        order = np.argsort(np.concatenate([w, middle]), kind="stable")
        more, more_slopes = _with_slopes(model, middle)
        w, values, slopes = (
            np.concatenate(pair)[order] for pair in ((w, middle), (values, more), (slopes, more_slopes))
        )
    change, _ = _turned(w, values, slopes)
    phase = np.concatenate([np.angle(values[:1]), np.angle(values[:1]) + np.cumsum(change, axis=0)])
    return np.asarray(np.degrees(phase[np.searchsorted(w, omega)]))


def _with_slopes(model: LinearModel, w: Array) -> tuple[Array, Array]:
    """Return the response, 1 where it is 0, and the slopes of its phase, rad per rad/s."""
    values = transfer(model, 1j * w)
    values = np.where(values == 0.0, 1.0, values)
    return values, (transfer_slope(model, 1j * w) / values).real


def _turned(w: Array, values: Array, slopes: Array) -> tuple[Array, Array]:
    """Return by how much the phase changes over each step, rad, and how far apart are that and what the slopes at its ends give."""
    step = np.diff(w)[:, None, None]
    expected = 0.5 * (slopes[1:] + slopes[:-1]) * step
    change = np.angle(values[1:] / values[:-1])
    change += 2 * np.pi * np.round((expected - change) / (2 * np.pi))
    return change, np.maximum(np.abs(change - expected), np.abs(slopes[1:] - slopes[:-1]) * step)


def frequency_response(model: LinearModel, omega: Array | Sequence[float] | None = None) -> FrequencyResponse:
    """Return the response of every channel at omega in rad/s (default: around the poles)."""
    w = default_omega(model) if omega is None else _checked(omega)
    rising, place = np.unique(w, return_inverse=True)
    units = tuple((o, i) for o in model.output_units for i in model.input_units)
    return FrequencyResponse(
        w, transfer(model, 1j * w), model.output_names, model.input_names, units,
        phase=followed_phase(model, rising)[place],
    )  # fmt: skip


def _checked(omega: Array | Sequence[float]) -> Array:
    w = np.atleast_1d(np.asarray(omega, dtype=float))
    if w.ndim != 1 or w.size == 0 or not np.isfinite(w).all() or (w < 0).any():
        raise LinearizationError("frequencies that cannot be used", expected="finite omega >= 0 in rad/s, at least one")
    return w


def sigma(model: LinearModel, omega: Array | Sequence[float] | None = None) -> tuple[Array, Array]:
    """Return (omega, (n, k) singular values, largest first) of the transfer matrix."""
    w = default_omega(model) if omega is None else _checked(omega)
    return w, np.linalg.svd(transfer(model, 1j * w), compute_uv=False)


def sensitivity(
    model: LinearModel, omega: Array | Sequence[float], parameters: Sequence[str] | None = None
) -> dict[str, Array]:
    """Return by parameter the (n, outputs, inputs) derivatives of the response, with the operating point's shift and delays."""
    w = _checked(omega)
    s = 1j * w
    names = list(model.gradients) if parameters is None else list(parameters)
    found = {}
    for name in names:
        g = gradient_of(model, name)
        if model.delay_free is not None and g.delay_free is not None:
            found[name] = model.delay_free.response_along(s, g.delay_free, g.times)
            continue
        pencil = s[:, None, None] * model.E - model.A
        right = np.linalg.solve(pencil, np.broadcast_to(model.B.astype(complex), (s.size, *model.B.shape)))
        left = np.swapaxes(
            np.linalg.solve(
                np.swapaxes(pencil, 1, 2), np.broadcast_to(model.C.T.astype(complex), (s.size, *model.C.T.shape))
            ),
            1,
            2,
        )
        found[name] = np.asarray(g.C @ right + left @ (g.A @ right) + left @ g.B + g.D)
    return found


def bands(
    model: LinearModel, omega: Array | Sequence[float], covariance: Array, parameters: Sequence[str]
) -> FrequencyResponse:
    """Return the response with, as std, the first-order standard deviation of its error from a parameter covariance.

    covariance: (k, k) in the parameters' units, in the order of `parameters`, whose derivatives the model must have.
    """
    cov = np.asarray(covariance, dtype=float)
    k = len(parameters)
    if cov.shape != (k, k) or not np.isfinite(cov).all():
        raise LinearizationError(
            "the covariance does not fit", expected=f"a finite ({k}, {k}) matrix", got=f"{cov.shape}"
        )
    plain = frequency_response(model, omega)
    slopes = sensitivity(model, plain.omega, parameters)
    stacked = np.array([slopes[n] for n in parameters])
    variance = np.einsum("a...,ab,b...->...", stacked.conj(), cov, stacked).real
    return replace(plain, std=np.sqrt(np.maximum(variance, 0.0)))


def bode(
    model: LinearModel,
    omega: Array | Sequence[float] | None = None,
    *,
    covariance: Array | None = None,
    parameters: Sequence[str] = (),
) -> FrequencyResponse:
    """Return the frequency response at omega in rad/s (default: around the poles), with units; it draws itself.

    covariance: (k, k) of parameters in their units, in the order of `parameters`, whose derivatives the model must
    have (`linearize(..., sensitivities=...)`): the response then has the standard deviation that follows, as a band.
    """
    if covariance is None:
        return frequency_response(model, omega)
    return bands(model, default_omega(model) if omega is None else omega, covariance, parameters)
