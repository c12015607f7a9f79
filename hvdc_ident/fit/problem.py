"""A fit put as a least-squares problem: unknowns, experiments, residuals over all of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from hvdc_ident.errors import SimulationError, StudyError, unknown_name
from hvdc_ident.experiment import Experiment
from hvdc_ident.fit.noise import sigmas
from hvdc_ident.fit.nuisance import unknown_of, unknowns
from hvdc_ident.fit.residual import Block, residual_blocks
from hvdc_ident.fit.simulator import Simulator
from hvdc_ident.fit.unknown import Coordinates, Free
from hvdc_ident.frozen import FrozenMap
from hvdc_ident.trajectory import Array


@dataclass(frozen=True, eq=False)
class Problem:
    """Unknowns, and the residuals they leave.

    experiments: those with role "fit" make the residuals; held-out ones only appear in tables of RMSE.
    free: the parameters to estimate. held: values of parameters that stay, in their units; a parameter in neither keeps
    the simulator's own value. why: the reason for each held one. conditional_on: for a free parameter the held ones
    without which it could not be told.
    rho: AR(1) coefficient by output, to whiten with. weights: standard deviation by output that replaces the
    experiments' own noise, in the output's unit.
    Theta, wherever it appears, holds the unknowns in the order of `unknowns`, each in its own unit.
    Raises StudyError or UnknownNameError where the parts do not fit.
    """

    simulator: Simulator
    experiments: tuple[Experiment, ...]
    free: tuple[Free, ...]
    held: FrozenMap[float] = field(default_factory=FrozenMap)
    why: FrozenMap[str] = field(default_factory=FrozenMap)
    conditional_on: FrozenMap[tuple[str, ...]] = field(default_factory=FrozenMap)
    rho: FrozenMap[float] = field(default_factory=FrozenMap)
    weights: FrozenMap[float] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        for name in ("experiments", "free"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("held", "why", "conditional_on", "rho", "weights"):
            object.__setattr__(self, name, FrozenMap(getattr(self, name)))
        self._check()

    def _check(self) -> None:
        known = self.simulator.parameters
        for name in (*(f.name for f in self.free), *self.held):
            if name not in known:
                raise unknown_name("parameter", name, known, where="the fit's parameters")
        twice = [k for k, n in Counter([*(f.name for f in self.free), *self.held]).items() if n > 1]
        if twice:
            raise StudyError("a parameter stands twice in a fit", got=", ".join(twice), expected="free or held, once")
        names = Counter(e.name for e in self.experiments)
        if max(names.values(), default=0) > 1:
            raise StudyError("two experiments of one name", got=names.most_common(1)[0][0], expected="distinct names")
        if not self.fitted_experiments or not self.free:
            raise StudyError(
                "nothing to fit",
                expected='a free parameter and an experiment of role "fit" with measured outputs',
                got=f"{len(self.free)} free parameters, {len(self.fitted_experiments)} such experiments",
            )

    @cached_property
    def fitted_experiments(self) -> tuple[Experiment, ...]:
        """The experiments that make the residuals."""
        return tuple(e for e in self.experiments if e.role == "fit" and e.outputs)

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Every output that is measured in one of those, in order of appearance."""
        return tuple(dict.fromkeys(o for e in self.fitted_experiments for o in e.outputs))

    @cached_property
    def unknowns(self) -> tuple[Free, ...]:
        """The free parameters, then the nuisances of each experiment."""
        return (*self.free, *(u for e in self.fitted_experiments for u in unknowns(e)))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(u.name for u in self.unknowns)

    @property
    def start(self) -> Array:
        """(p,): the first guess."""
        return np.array([u.start for u in self.unknowns])

    @cached_property
    def coordinates(self) -> Coordinates:
        """The scaled coordinates of the unknowns."""
        return Coordinates(self.unknowns)

    @cached_property
    def sigma(self) -> FrozenMap[FrozenMap[float]]:
        """The standard deviation of each output, in its unit, by experiment and output."""
        fitted = self.fitted_experiments
        return FrozenMap({e.name: FrozenMap(sigmas(e, fitted, self.weights)) for e in self.experiments})

    def values(self, theta: Array) -> dict[str, float]:
        """The parameters' values that go to the simulator, held ones included."""
        return {**self.held, **{f.name: float(v) for f, v in zip(self.free, theta, strict=False)}}

    def blocks(self, theta: Array, *, derivatives: bool = True) -> tuple[Block, ...]:
        """The residuals of each output in each experiment; jacobians have a column for every unknown.

        Without derivatives the columns are 0. Raises SimulationError where a run fails: theta is then inadmissible.
        """
        names = self.names
        parts = []
        for e in self.fitted_experiments:
            local = [*(f.name for f in self.free), *(unknown_of(e.name, n) for n in e.nuisance)]
            columns = [names.index(n) for n in local]
            for block in self._experiment(e, theta, derivatives):
                jacobian = np.zeros((block.residual.size, len(names)))
                if derivatives:
                    jacobian[:, columns] = block.jacobian
                parts.append(replace(block, jacobian=jacobian))
        return tuple(parts)

    def _experiment(self, e: Experiment, theta: Array, derivatives: bool) -> tuple[Block, ...]:
        at = dict(zip(self.names, theta, strict=True))
        return residual_blocks(
            self.simulator,
            e,
            self.values(theta),
            tuple(f.name for f in self.free) if derivatives else (),
            self.sigma[e.name],
            nuisance={n: float(at[unknown_of(e.name, n)]) for n in e.nuisance if e.role == "fit"},
            rho=self.rho,
        )

    def residual(self, theta: Array) -> tuple[Array, Array]:
        """r, (N,), and dr/dtheta, (N, p), over all experiments; r = (measured - simulated)/sigma.

        Raises SimulationError where a run fails or gives a number that is not finite; it never becomes a residual.
        """
        return stacked(self.blocks(theta))

    def cost(self, theta: Array) -> float:
        """Half the sum of squared residuals: the negative log-likelihood up to a constant. Raises SimulationError."""
        return sum(0.5 * float(b.residual @ b.residual) for b in self.blocks(theta, derivatives=False))

    def rmse(self, theta: Array) -> dict[str, dict[str, float | None]]:
        """Root mean square of measured - simulated by output and experiment, held-out ones too, in the output's unit.

        None where the run fails; a held-out experiment has no nuisance.
        """
        table: dict[str, dict[str, float | None]] = {}
        for e in self.experiments:
            try:
                errors: dict[str, float] = {b.output: b.rmse for b in self._experiment(e, theta, False)}
            except SimulationError:
                errors = {}
            for output in e.outputs:
                table.setdefault(output, {})[e.name] = errors.get(output)
        return table

    def with_(
        self, *, weights: Mapping[str, float] | None = None, experiments: Sequence[Experiment] | None = None
    ) -> Problem:
        """A copy with other weights or experiments."""
        return replace(
            self,
            weights=self.weights if weights is None else FrozenMap(weights),
            experiments=self.experiments if experiments is None else tuple(experiments),
        )


def stacked(blocks: Sequence[Block]) -> tuple[Array, Array]:
    """Residual, (N,), and jacobian, (N, p), of several blocks in one."""
    return np.concatenate([b.residual for b in blocks]), np.vstack([b.jacobian for b in blocks])
