"""Measured frequency responses beside those of a model, as `fit.json` and `linearization.json` hold them, and their words."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.codec import INLINE, stored_as
from hvdc_ident.data import Array
from hvdc_ident.text import figures


@dataclass(frozen=True)
class DescribedResponse:
    """A measured response in short. band_hz: its first and last frequency. relative_noise: None where it is not known."""

    role: str
    kind: str
    channels: tuple[str, ...]
    points: int
    band_hz: tuple[float, float]
    unit: str
    relative_noise: float | None
    noise_source: str

    @property
    def text(self) -> str:
        """Kind, channels, band and noise in words."""
        share = self.relative_noise
        noise = "not given" if share is None else f"{100 * share:.3g} % ({self.noise_source})"
        unit = f" in {self.unit}" if self.unit else ""
        low, high = self.band_hz
        return f"{self.kind}{unit}, {', '.join(self.channels)}; {self.points} frequencies, {low:.4g} to {high:.4g} Hz; noise {noise}"


@dataclass(frozen=True)
class Deviation:
    """The largest deviation of gain (dB) or phase (degrees), and where, rad/s."""

    value: float
    omega: float

    @property
    def hertz(self) -> float:
        """The frequency in Hz."""
        return self.omega / math.tau


@dataclass(frozen=True)
class ChannelError:
    """The distance of a model's response from the measured one, as `MeasuredResponse.errors` says."""

    channel: str
    relative: float | None
    gain_db: Deviation
    phase_deg: Deviation
    chi2_per_point: float | None
    factor: float | None

    @property
    def times_noise(self) -> float | None:
        """The error over the noise; None where that is not known."""
        return None if self.chi2_per_point is None else math.sqrt(self.chi2_per_point)


@dataclass(frozen=True, eq=False)
class Curves:
    """Complex values by frequency and channel, (n, channels), in their parts, with their phases; None where there are none."""

    real: Array | None = field(default=None, metadata=stored_as("real", optional=True))
    imag: Array | None = field(default=None, metadata=stored_as("imag", optional=True))
    phase_deg: Array | None = field(default=None, metadata=stored_as("phase_deg", optional=True))

    @property
    def curves(self) -> tuple[NDArray[np.complex128], Array] | None:
        """The values and their phases, degrees."""
        if self.real is None or self.imag is None or self.phase_deg is None:
            return None
        return np.asarray(self.real + 1j * self.imag), self.phase_deg


@dataclass(frozen=True, eq=False)
class ModelResponse(Curves):
    """A model's response at one set of values. reason: why there is none. stable: whether the model is, where it was measured."""

    errors: tuple[ChannelError, ...] = field(default=(), metadata=stored_as("errors", optional=True))
    stable: bool | None = field(default=None, metadata=stored_as("stable", optional=True))
    reason: str = field(default="", metadata=stored_as("reason", optional=True))


@dataclass(frozen=True, eq=False)
class ComparedResponse:
    """A measured response, and the model's by set of values. omega: (n,) rad/s. std: of each value's modulus, None where not known."""

    name: str
    about: DescribedResponse = field(metadata=INLINE)
    omega: Array
    measured: Curves
    std: Array | None
    models: Mapping[str, ModelResponse]

    def lines(self, of: str) -> Iterator[str]:
        """Yield a line for each channel: how far the model with one set of values is from what was measured."""
        model = self.models.get(of)
        if model is None:
            return
        if model.reason:
            yield f"response {self.name}: the {of} model has none: {model.reason}"
        if model.stable is False:
            yield f"response {self.name}, {of}: the model is unstable where it was measured"
        for e in model.errors:
            share = "" if e.relative is None else f" off by {100 * e.relative:.3g} %,"
            noise = "" if e.times_noise is None else f"; {figures(e.times_noise, 3)} times the noise"
            yield (
                f"response {self.name}, {e.channel}, {of}:{share} gain by up to {e.gain_db.value:+.3g} dB at "
                f"{e.gain_db.hertz:.4g} Hz, phase by up to {e.phase_deg.value:+.3g} degrees at "
                f"{e.phase_deg.hertz:.4g} Hz{noise}"
            )
            if e.factor is not None:
                yield (
                    f"response {self.name}, {e.channel}: the measured one is {e.factor:.4g} times the model's: sign, "
                    "unit or base? `scale` in [[response]] multiplies it"
                )


def response_lines(responses: Iterable[ComparedResponse], of: str) -> list[str]:
    """Return the lines of several responses with one set of values."""
    return [line for r in responses for line in r.lines(of)]
