"""Frequency responses, delays exact: values, singular values, derivatives by parameters and error bands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.codec import read_fields
from hvdc_ident.display import Shown, Table, data_frame, first_rows
from hvdc_ident.errors import LinearizationError, unknown_name
from hvdc_ident.linearize.system import Array

if TYPE_CHECKING:
    import xarray

    from hvdc_ident.linearize.linear_model import LinearModel


@dataclass(frozen=True, eq=False)
class _Lists:
    """A frequency response as JSON has it: real and imaginary part, (n, outputs, inputs)."""

    omega: Array
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    real: Array
    imag: Array
    source: str


@dataclass(frozen=True, eq=False, repr=False)
class FrequencyResponse(Shown):
    """A frequency response. omega: (n,) rad/s; values: (n, outputs, inputs) complex, in output unit per input unit.

    std: (n, outputs, inputs) standard deviation of the error's modulus, where one is known. coherence: of a recording.
    """

    omega: Array
    values: Array
    output_names: tuple[str, ...]
    input_names: tuple[str, ...]
    units: tuple[tuple[str, str], ...] = ()
    std: Array | None = None
    coherence: Array | None = None
    source: str = "model"

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
        """(n, outputs, inputs) degrees, unwrapped along the frequency."""
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
        from hvdc_ident.linearize.plot import bode

        return bode([self], ax=ax)

    def to_dict(self) -> dict[str, Any]:
        """Return the response as plain lists."""
        return {
            "omega": self.omega.tolist(),
            "outputs": list(self.output_names),
            "inputs": list(self.input_names),
            "real": self.values.real.tolist(),
            "imag": self.values.imag.tolist(),
            "source": self.source,
        }

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> FrequencyResponse:
        """Return the response that `to_dict` wrote, without units. Raises InputError for anything else."""
        found = read_fields(_Lists, data)
        return cls(found.omega, found.real + 1j * found.imag, found.outputs, found.inputs, source=found.source)


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


def default_omega(model: LinearModel, points: int = 400) -> Array:
    """Return (n,) rad/s: logarithmic from a decade below the slowest to a decade above the fastest pole and zero."""
    from hvdc_ident.linearize.modal import approximate_poles

    own = approximate_poles(model)
    sizes = np.abs(own)
    fastest = sizes.max(initial=1.0)
    sizes = sizes[(sizes > 1e-6 * max(fastest, 1e-12)) & (sizes > 1e-6)]
    low, high = (sizes.min(), sizes.max()) if sizes.size else (1.0, 1.0)
    grid = np.logspace(np.log10(low) - 1.5, np.log10(high) + 1.5, points)
    inside = np.abs(own.imag)
    return np.unique(np.concatenate([grid, inside[(inside > grid[0]) & (inside < grid[-1])]]))


def frequency_response(model: LinearModel, omega: Array | Sequence[float] | None = None) -> FrequencyResponse:
    """Return the response of every channel at omega in rad/s (default: around the poles)."""
    w = default_omega(model) if omega is None else _checked(omega)
    units = tuple((o, i) for o in model.output_units for i in model.input_units)
    return FrequencyResponse(w, transfer(model, 1j * w), model.output_names, model.input_names, units)


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
    from hvdc_ident.linearize.modal import gradient_of

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
    return FrequencyResponse(
        plain.omega,
        plain.values,
        plain.output_names,
        plain.input_names,
        plain.units,
        np.sqrt(np.maximum(variance, 0.0)),
    )
