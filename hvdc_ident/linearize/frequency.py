"""Frequency responses, delays exact: values, singular values, derivatives by parameters and error bands."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.codec import read_fields
from hvdc_ident.display import Shown, Table, data_frame, first_rows
from hvdc_ident.errors import LinearizationError, unknown_name
from hvdc_ident.linearize import plot
from hvdc_ident.linearize.descriptor import Descriptor
from hvdc_ident.linearize.linear_model import LinearModel, gradient_of
from hvdc_ident.linearize.stability import Characteristic
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
        lists = read_fields(_Lists, data)
        values = lists.real + 1j * lists.imag
        return cls(lists.omega, values, lists.outputs, lists.inputs, source=lists.source, phase=lists.phase_deg)


def transfer(model: LinearModel, s: Array) -> Array:
    """Return (points, outputs, inputs) transfer matrix at complex frequencies s, rad/s; delays exact.

    Raises LinearizationError exactly on a pole.
    """
    s = np.atleast_1d(np.asarray(s, dtype=complex))
    try:
        return model.equation.response(s)
    except np.linalg.LinAlgError:
        raise LinearizationError(
            "a frequency lies exactly on a pole", where=f"linear model '{model.name}'", hint="leave this frequency out"
        ) from None


def response(model: LinearModel, omega: Array | Sequence[float]) -> Array:
    """Return (frequencies, outputs, inputs) complex transfer matrix at omega in rad/s, delays exact."""
    return transfer(model, 1j * np.atleast_1d(np.asarray(omega, dtype=float)))


@dataclass(frozen=True, eq=False)
class _Resolved:
    """G = C P^-1 F + D at some points, with right = P^-1 F and left = C P^-1: what its derivatives are made of.

    rounding: a bound on G's rounding errors. The solutions are refined once, after which they are those of a matrix within a
    few eps of P in every entry (Skeel 1980), however its rows and columns are scaled.
    """

    values: Array
    left: Array
    right: Array
    rounding: Array

    @classmethod
    def of(cls, equation: Characteristic | Descriptor, s: Array) -> _Resolved:
        pencil, drive = equation.pencil(s)
        read, through = equation.read, equation.through
        right = _refined(pencil, drive)
        seen = np.broadcast_to(read.T.astype(complex), (s.size, *read.T.shape))
        left = np.swapaxes(_refined(np.swapaxes(pencil, 1, 2), seen), 1, 2)
        terms = np.abs(left) @ np.abs(pencil) @ np.abs(right) + np.abs(read) @ np.abs(right) + np.abs(through)
        return cls(read @ right + through, left, right, pencil.shape[1] * np.finfo(float).eps * terms)

    def along(
        self, pencil: Array, drive: Array | float, read: Array | None = None, through: Array | float = 0.0
    ) -> Array:
        """Return the derivative of G for derivatives of P, F, C and D."""
        inner = self.left @ (drive - pencil @ self.right) + through
        return np.asarray(inner if read is None else inner + read @ self.right)


def _refined(matrix: Array, given: Array) -> Array:
    solution = np.linalg.solve(matrix, given)
    return np.asarray(solution + np.linalg.solve(matrix, given - matrix @ solution))


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
    poles = model.approximate.roots.values
    return poles[poles != 0]


def _around(poles: Array, ends: Array, decades: float, points: int) -> Array:
    """Return frequencies from the slowest to the fastest of `ends` and some decades beyond, those of resonances among them."""
    sizes = np.abs(ends) if ends.size else np.ones(1)
    grid = np.logspace(np.log10(sizes.min()) - decades, np.log10(sizes.max()) + decades, points)
    return np.unique(np.concatenate([grid, _resonances(poles, grid[0], grid[-1])]))


def _resonances(poles: Array, low: float, high: float) -> Array:
    """Return the frequencies of damped oscillations between two frequencies; on an undamped pole there is no response."""
    frequencies = np.abs(poles[np.abs(poles.real) > 1e-9 * np.abs(poles)].imag)
    return np.asarray(frequencies[(frequencies > low) & (frequencies < high)])


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
"""Largest difference of two estimates of the change of ln G over a step: with one root r near, G'/G = 1/(s - r), and the slopes at
the ends of a step of length h differ by h^2/|(s1 - r)(s2 - r)|. Below 0.5 a root beside the middle is 1.3 h away or more, where it
turns the phase by 0.73 rad, far below the half turn at which an angle could be taken the wrong way round."""
NARROWEST = 1e-9
"""Share of its frequency to which a step is halved: a root nearer to the axis lies on either side of it, as rounding has it."""
FREQUENCIES = 200_000
"""Frequencies after which steps are halved no more: what is left then has more turns than anyone looks at, or is rounding noise."""


Sloped = Callable[[Array], tuple[Array, Array, Array]]
"""A function of complex frequencies, its derivative by s and a bound on its rounding errors, each (points, outputs, inputs)."""


def by_s(model: LinearModel, s: Array) -> tuple[Array, Array, Array]:
    """Return the response at complex frequencies, its derivative by s and a bound on its rounding errors; delays exact."""
    resolved, equation = [], model.equation
    for part in np.array_split(s, 1 + s.size * model.A.size // 2_000_000):
        at = _Resolved.of(equation, part)
        resolved.append((at.values, at.along(*equation.pencil_by_s(part)), at.rounding))
    values, slopes, rounding = (np.concatenate(parts) for parts in zip(*resolved, strict=True))
    return values, slopes, rounding


def followed(at: Sloped, s: Array) -> tuple[Array, Array]:
    """Return complex frequencies from each of s straight to the next, and the changes of ln G over the steps between them.

    The angles alone leave whole turns open, of which a delay makes many in one step, and a damped root hides one. The
    slopes G'/G of ln G at both ends of a step tell how many, and by the modulus whether a root lies between: where what they
    give for the step's change of ln G differs by `TURN` among them, or from the change itself, the step is halved. A
    channel that is not above its rounding errors somewhere is not followed there.
    """
    values, slopes, known = _logarithmic(at, s)
    while True:
        step = np.diff(s)[:, None, None]
        expected = 0.5 * (slopes[1:] + slopes[:-1]) * step
        change = np.log(values[1:] / values[:-1])
        change += 2j * np.pi * np.round((expected - change).imag / (2 * np.pi))
        apart = np.maximum(np.abs(change - expected), np.abs((slopes[1:] - slopes[:-1]) * step))
        wide = ((apart > TURN) & known[1:] & known[:-1]).any(axis=(1, 2)) & (
            np.abs(np.diff(s)) > NARROWEST * np.abs(s[1:])
        )
        if not wide.any() or s.size > FREQUENCIES:
            return s, change
        k = np.flatnonzero(wide)
        low, high = s[k], s[k + 1]
        share = np.sqrt(np.maximum(np.abs(low / high), 1e-3))
        middle = np.where(share < 0.5, share * high, 0.5 * (low + high))
        added = (middle, *_logarithmic(at, middle))
        s, values, slopes, known = (
            np.insert(old, k + 1, new, axis=0) for old, new in zip((s, values, slopes, known), added, strict=True)
        )


def _logarithmic(at: Sloped, s: Array) -> tuple[Array, Array, Array]:
    """Return values, the derivative of their logarithm by s, and where they are above their rounding errors; elsewhere 1 and 0."""
    values, slopes, rounding = at(s)
    known = np.abs(values) > rounding
    values = np.where(known, values, 1.0)
    return values, np.where(known, slopes / values, 0.0), known


def followed_phase(at: Sloped, model: LinearModel, omega: Array) -> Array:
    """Return (n, outputs, inputs) degrees of a response at frequencies in rad/s, turns between them counted.

    model: the one it is made of, whose resonances are looked at. A channel that is 0 has 0.
    """
    rising, place = np.unique(omega, return_inverse=True)
    w = np.unique(np.concatenate([rising, _resonances(model.approximate.roots.values, rising[0], rising[-1])]))
    s, change = followed(at, 1j * w)
    angle = np.angle(at(1j * rising)[0])
    turned = np.concatenate([angle[:1], angle[:1] + np.cumsum(change.imag, axis=0)])[np.searchsorted(s.imag, rising)]
    return np.asarray(np.degrees(angle + 2 * np.pi * np.round((turned - angle) / (2 * np.pi))))[place]


def phase_of(model: LinearModel, omega: Array) -> Array:
    """Return (n, outputs, inputs) degrees of a model's response at frequencies in rad/s, as `followed_phase`."""
    return followed_phase(lambda s: by_s(model, s), model, omega)


def frequency_response(
    model: LinearModel,
    omega: Array | Sequence[float] | None = None,
    *,
    covariance: Array | None = None,
    parameters: Sequence[str] = (),
) -> FrequencyResponse:
    """Return the response of every channel at omega in rad/s (default: around the poles), with units; it draws itself.

    covariance: (k, k) of parameters in their units, in the order of `parameters`, whose derivatives the model must
    have (`linearize(..., sensitivities=...)`): the response then has, as std, the first-order standard deviation of its error.
    """
    w = default_omega(model) if omega is None else _checked(omega)
    units = tuple((o, i) for o in model.output_units for i in model.input_units)
    std = None if covariance is None else _std(model, w, np.asarray(covariance, dtype=float), parameters)
    return FrequencyResponse(
        w, transfer(model, 1j * w), model.output_names, model.input_names, units, std, phase=phase_of(model, w)
    )


def _std(model: LinearModel, w: Array, covariance: Array, parameters: Sequence[str]) -> Array:
    k = len(parameters)
    if covariance.shape != (k, k) or not np.isfinite(covariance).all():
        raise LinearizationError(
            "the covariance does not fit", expected=f"a finite ({k}, {k}) matrix", got=f"{covariance.shape}"
        )
    slopes = np.array([*sensitivity(model, w, parameters).values()])
    return np.sqrt(np.maximum(np.einsum("a...,ab,b...->...", slopes.conj(), covariance, slopes).real, 0.0))


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
    equation = model.equation
    at = _Resolved.of(equation, s)
    changes = {name: gradient_of(model, name).change for name in names}
    return {n: at.along(*equation.pencil_along(s, c), c.read, c.through) for n, c in changes.items()}
