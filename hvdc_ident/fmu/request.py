"""What goes between the pool and the worker that makes it: a run that is asked for, and an FMU at a point."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from hashlib import sha256

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, InputSignal


@dataclass(frozen=True, eq=False)
class RunRequest:
    """A run to be made: values of parameters, signals of all inputs, instants of the rows, names recorded, relative tolerance."""

    values: Mapping[str, float]
    inputs: tuple[InputSignal, ...]
    time: Array
    names: tuple[str, ...]
    tolerance: float

    @cached_property
    def breaks(self) -> Array:
        """Instants an integrator has to stop at, s."""
        return np.unique(np.concatenate([np.empty(0), *(i.breaks for i in self.inputs)]))

    def at(self, t: Array, *, before_jump: bool) -> Array:
        """(n, inputs) their values at instants, before the jumps there or after them."""
        return (
            np.stack([i.at(t, before_jump=before_jump) for i in self.inputs], axis=1)
            if self.inputs
            else np.empty((t.size, 0))
        )

    def stepped(self, by: Sequence[float], at: float) -> RunRequest:
        """Return the run with a step added to each input at an instant, s."""
        return replace(self, inputs=tuple(i.stepped(size, at) for i, size in zip(self.inputs, by, strict=True)))

    def moved(self, share: float, points: Sequence[Array]) -> RunRequest:
        """Return the run with a share of other points added to those of each input."""
        pairs = zip(self.inputs, points, strict=True)
        return replace(self, inputs=tuple(InputSignal(i.times, i.values + share * p, i.breaks) for i, p in pairs))

    def experiment(self, noise_key: str = "") -> bytes:
        """Return a digest of everything but the values of parameters. noise_key: taken in the place of the inputs."""
        inputs = noise_key.encode() or b"|".join(i.times.tobytes() + i.values.tobytes() for i in self.inputs)
        return sha256(self.time.tobytes() + inputs + repr((self.names, self.tolerance)).encode()).digest()

    @property
    def key(self) -> bytes:
        """A digest of everything that decides the outputs."""
        return self.experiment() + repr(sorted(self.values.items())).encode()


@dataclass(frozen=True, eq=False)
class FmuPoint:
    """x (nx,), its derivatives (nx,), outputs (ny,), and the Jacobian of both by [x, u, p], (nx + ny, nx + nu + np).

    directional: which columns are the FMU's own. error: of the Jacobian, in shares of each row's largest entry: the largest
    difference from central differences or, where those are used, between two step sizes. near: whether differences of two
    step sizes disagree, as beside a limit.
    """

    x: Array
    derivatives: Array
    outputs: Array
    jacobian: Array
    directional: NDArray[np.bool_]
    error: float
    near: bool
