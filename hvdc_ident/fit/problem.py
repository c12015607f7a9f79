"""A fit put as a least-squares problem: unknowns, experiments, residuals over all of them."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import SimulationError, StudyError, unknown_name
from hvdc_ident.fit.fit_parameter import Coordinates, FitParameter
from hvdc_ident.fit.likelihood import LOSSES, Loss, Prior, QuantisedNoise, prior_rows
from hvdc_ident.fit.noise_model import AR, GIVEN, sigmas, source_of
from hvdc_ident.fit.residual import (
    Band,
    ComparedRecord,
    ResidualBlock,
    Treatment,
    centred,
    recentred,
    records,
    residual_blocks,
    unknown_initial_states,
)
from hvdc_ident.fit.simulator import Simulator, unknown_of, unknowns
from hvdc_ident.immutable import FrozenMap


@dataclass(frozen=True, eq=False)
class Problem:
    """Unknowns, and the residuals they leave.

    experiments: those with role "fit" make the residuals; held-out ones only appear in tables of RMSE.
    free: the parameters to estimate. held: values of parameters that stay, in their units; a parameter in neither keeps
    the simulator's own value. why: the reason for each held one. conditional_on: for a free parameter the held ones
    without which it could not be told.
    rho: the noise model to whiten with by output: an AR(1) coefficient or a tuple of AR coefficients.
    quantised_noise: by output whose record is rounded to steps that its noise does not hide; its residuals then know of it.
    weights: standard deviation by output that replaces the experiments' own noise, in the output's unit.
    guard: rows this close to a break of an input are not compared, s. band: Hz; given, the residual is the misfit's
    spectrum there. loss: what a residual costs. priors: by unknown ("EXPERIMENT:NUISANCE" for a nuisance).
    free_initial_states: whether the records, held-out ones too, begin elsewhere than at rest; what unknown starts of the states
    can make good is then taken out of residuals and jacobians.
    Theta, wherever it appears, holds the unknowns in the order of `unknowns`, each in its own unit.
    Raises StudyError or UnknownNameError where the parts do not fit.
    """

    simulator: Simulator
    experiments: tuple[Experiment, ...]
    free: tuple[FitParameter, ...]
    held: FrozenMap[float] = field(default_factory=FrozenMap)
    why: FrozenMap[str] = field(default_factory=FrozenMap)
    conditional_on: FrozenMap[tuple[str, ...]] = field(default_factory=FrozenMap)
    rho: FrozenMap[float | AR] = field(default_factory=FrozenMap)
    weights: FrozenMap[float] = field(default_factory=FrozenMap)
    guard: float = 0.0
    band: Band | None = None
    loss: Loss = LOSSES["linear"]
    priors: FrozenMap[Prior] = field(default_factory=FrozenMap)
    free_initial_states: bool = False
    quantised_noise: FrozenMap[QuantisedNoise] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        for name in ("experiments", "free"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("held", "why", "conditional_on", "rho", "weights", "priors", "quantised_noise"):
            object.__setattr__(self, name, FrozenMap(getattr(self, name)))
        self._check()

    def __getstate__(self) -> dict[str, Any]:
        """Only the definition travels to another process: the rest is worked out anew there."""
        return {k: v for k, v in self.__dict__.items() if k in self.__dataclass_fields__}

    def _check(self) -> None:
        known = self.simulator.parameters
        for name in (*(f.name for f in self.free), *self.held):
            if name not in known:
                raise unknown_name("parameter", name, known, where="the fit's parameters")
        own = {n for e in self.experiments for n in e.nuisance}
        twice = [
            k
            for k, n in Counter([*(f.name for f in self.free), *self.held]).items()
            if n > 1 or (k in own and k in known)
        ]
        if twice:
            raise StudyError(
                "a parameter stands twice in a fit",
                got=", ".join(twice),
                expected="free, held or a nuisance of each experiment, once",
            )
        names = Counter(e.name for e in self.experiments)
        if max(names.values(), default=0) > 1:
            raise StudyError("two experiments of one name", got=names.most_common(1)[0][0], expected="distinct names")
        if not self.fitted_experiments or not self.free:
            raise StudyError(
                "nothing to fit",
                expected='a free parameter and an experiment of role "fit" with measured outputs',
                got=f"{len(self.free)} free parameters, {len(self.fitted_experiments)} such experiments",
            )
        for name in self.priors:
            if name not in self.names and name not in known:
                raise unknown_name("unknown", name, [*self.names, *known], where="the fit's priors")

    @cached_property
    def fitted_experiments(self) -> tuple[Experiment, ...]:
        """The experiments that make the residuals."""
        return tuple(e for e in self.experiments if e.role == "fit" and e.outputs)

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Every output that is measured in one of those, in order of appearance."""
        return tuple(dict.fromkeys(o for e in self.fitted_experiments for o in e.outputs))

    @cached_property
    def outputs_in_time(self) -> tuple[str, ...]:
        """Those of recordings in time, without parts of measured frequency responses."""
        return tuple(dict.fromkeys(o for e in self.fitted_experiments if e.domain == "time" for o in e.outputs))

    @cached_property
    def unknowns(self) -> tuple[FitParameter, ...]:
        """The free parameters, then the nuisances of each experiment."""
        return (*self.free, *(u for e in self.fitted_experiments for u in unknowns(self.simulator, e)))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(u.name for u in self.unknowns)

    @property
    def start(self) -> Array:
        """(p,): the first guess."""
        return np.array([u.start for u in self.unknowns])

    @property
    def given(self) -> Array:
        """(p,): the values that the model came with."""
        return np.array([u.given for u in self.unknowns])

    @cached_property
    def rmse_start(self) -> dict[str, dict[str, float | None]]:
        """The table of RMSE at the first guess."""
        return self.rmse(self.start)

    @cached_property
    def rmse_given(self) -> dict[str, dict[str, float | None]]:
        """The table of RMSE at the given values."""
        return self.rmse_start if np.array_equal(self.given, self.start) else self.rmse(self.given)

    @cached_property
    def coordinates(self) -> Coordinates:
        """The scaled coordinates of the unknowns."""
        return Coordinates(self.unknowns)

    @cached_property
    def sigma(self) -> FrozenMap[FrozenMap[float]]:
        """The standard deviation of each output, in its unit, by experiment and output."""
        fitted = self.fitted_experiments
        return FrozenMap({e.name: FrozenMap(sigmas(e, fitted, self.weights)) for e in self.experiments})

    @cached_property
    def noise_dof(self) -> float:
        """How many independent samples the given noise of the least known output was estimated from; infinite: exact."""
        fitted = self.fitted_experiments
        known = [o for o in self.outputs if o not in self.weights and source_of(fitted, o) == GIVEN]
        sums = [sum(e.noise_dof.get(o, np.inf) for e in fitted if o in e.outputs) for o in known]
        return float(min(sums, default=np.inf))

    def values(self, theta: Array) -> dict[str, float]:
        """The parameters' values that go to the simulator, held ones included."""
        return {**self.held, **{f.name: float(v) for f, v in zip(self.free, theta, strict=False)}}

    @cached_property
    def treatment(self) -> Treatment:
        """What is done to misfits before they are residuals."""
        models = {o: (m,) if isinstance(m, float | int) else tuple(m) for o, m in self.rho.items()}
        return Treatment(FrozenMap(models), self.guard, self.band, self.quantised_noise)

    def blocks(self, theta: Array, *, derivatives: bool = True, in_time: bool = False) -> tuple[ResidualBlock, ...]:
        """The residuals of each output in each experiment; jacobians have a column for every unknown.

        Neither the loss nor the priors are in them. Without derivatives the columns are 0. in_time: samples in time
        even where the fit is of spectra. Raises SimulationError where a run fails: theta is then inadmissible.
        """
        treatment = replace(self.treatment, band=None) if in_time else self.treatment
        width = len(self.names)
        parts: list[ResidualBlock] = []
        for e in self.fitted_experiments:
            columns = self._columns[e.name]
            found = self._experiment(e, theta, derivatives, treatment)
            # Where every unknown is one of this experiment's they are in their order.
            whole = derivatives and len(columns) == width
            parts += found if whole else [b.among(columns if derivatives else (), width) for b in found]
        return tuple(parts)

    @cached_property
    def _columns(self) -> dict[str, list[int]]:
        """By experiment the places among all unknowns of those that it answers."""
        free = [f.name for f in self.free]
        local = {e.name: [*free, *(unknown_of(e.name, n) for n in e.nuisance)] for e in self.fitted_experiments}
        return {name: [self.names.index(n) for n in own] for name, own in local.items()}

    @cached_property
    def _records(self) -> dict[str, tuple[ComparedRecord, ...]]:
        """By fitted experiment what of its records is compared with every run."""
        return {e.name: records(e, self.guard) for e in self.fitted_experiments}

    def initial_state_jacobian(self, theta: Array) -> Array:
        """(N, k): how the residuals answer the states' starts that are not known, one column a state and experiment."""
        return np.asarray(block_diag(*(self._begun(e, theta)[1] for e in self.fitted_experiments)))

    def _begun(self, e: Experiment, theta: Array, treatment: Treatment | None = None) -> tuple[Experiment, Array]:
        """The experiment with the starts that suit its records best, and how its residuals answer them, (n, k)."""
        own, nuisance = self.values(theta), self.nuisances(e, theta)
        unknown_starts = unknown_initial_states(self.simulator, e)

        def blocks(at: Experiment) -> tuple[ResidualBlock, ...]:
            return residual_blocks(
                self.simulator, at, own, unknown_starts, self.sigma[e.name], nuisance=nuisance,
                treatment=treatment or self.treatment, compared=self._compared(e, treatment or self.treatment),
            )  # fmt: skip

        at = centred(self.simulator, e, own, unknown_starts, nuisance) if unknown_starts else e
        seen = blocks(at)
        if unknown_starts:
            at = recentred(at, seen, unknown_starts)
        return at, np.vstack([b.jacobian[:, : len(unknown_starts)] for b in seen])

    def _experiment(
        self, e: Experiment, theta: Array, derivatives: bool, treatment: Treatment
    ) -> tuple[ResidualBlock, ...]:
        unknown_starts = (
            unknown_initial_states(self.simulator, e) if self.free_initial_states and e.domain == "time" else ()
        )
        if e.domain == "frequency":  # is compared as it is: whitening, guards and bands are of samples in time
            treatment = Treatment()
        return residual_blocks(
            self.simulator,
            self._begun(e, theta, treatment)[0] if unknown_starts else e,
            self.values(theta),
            tuple(f.name for f in self.free),
            self.sigma[e.name],
            nuisance=self.nuisances(e, theta),
            treatment=treatment,
            derivatives=derivatives,
            unknown_starts=unknown_starts,
            compared=self._compared(e, treatment),
        )

    def _compared(self, e: Experiment, treatment: Treatment) -> tuple[ComparedRecord, ...] | None:
        """The records of an experiment, where it is one of the fit and compared as there."""
        return self._records.get(e.name) if treatment.guard == self.guard else None

    def nuisances(self, e: Experiment, theta: Array) -> dict[str, float]:
        """The value of each nuisance of an experiment of the fit; a held-out one has none."""
        if not e.nuisance:
            return {}
        at = dict(zip(self.names, theta, strict=True))
        return {n: float(at[k]) for n in e.nuisance if (k := unknown_of(e.name, n)) in at}

    def prior(self, theta: Array) -> tuple[Array, Array]:
        """The residuals of the priors, (k,), and their derivatives, (k, p)."""
        return prior_rows(self.priors, self.names, theta)

    def residual(self, theta: Array) -> tuple[Array, Array]:
        """r, (N,), and dr/dtheta, (N, p), over all experiments, the loss applied, and the priors.

        With the linear loss r = (measured - simulated)/sigma. Half of r'r is the cost.
        Raises SimulationError where a run fails or gives a number that is not finite; it never becomes a residual.
        """
        r, jacobian = self.loss.applied(*stacked(self.blocks(theta)))
        if not self.priors:
            return r, jacobian
        more, rows = self.prior(theta)
        return np.concatenate([r, more]), np.vstack([jacobian, rows])

    def cost(self, theta: Array) -> float:
        """The sum of the losses: the negative log-likelihood up to a constant. Raises SimulationError."""
        data = self.cost_of(self.blocks(theta, derivatives=False))
        return data + 0.5 * float(np.sum(self.prior(theta)[0] ** 2))

    def cost_of(self, blocks: Sequence[ResidualBlock]) -> float:
        """The sum of the losses of some blocks."""
        return sum(float(np.sum(self.loss.rho(b.residual))) for b in blocks)

    def rmse(self, theta: Array) -> dict[str, dict[str, float | None]]:
        """Root mean square of measured - simulated by output and experiment, held-out ones too, in the output's unit.

        None where the run fails; a held-out experiment has no nuisance.
        """
        table: dict[str, dict[str, float | None]] = {}
        plain = Treatment()
        for e in self.experiments:
            seen = e if e.role == "fit" else e.with_(nuisance=())
            try:
                errors: dict[str, float] = {b.output: b.rmse for b in self._experiment(seen, theta, False, plain)}
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


def stacked(blocks: Sequence[ResidualBlock]) -> tuple[Array, Array]:
    """Residual, (N,), and jacobian, (N, p), of several blocks in one."""
    return np.concatenate([b.residual for b in blocks]), np.vstack([b.jacobian for b in blocks])
