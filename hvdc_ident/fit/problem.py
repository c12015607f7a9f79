"""A fit put as a least-squares problem: its unknowns, its experiments, and the residuals of all of them.

A `Problem` is a value: it says what is estimated from what, and evaluates residuals, their derivatives and the cost.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from hvdc_ident.data import Array, Experiment
from hvdc_ident.errors import SimulationError, StudyError, require_known
from hvdc_ident.fit.fit_parameter import Coordinates, FitParameter
from hvdc_ident.fit.likelihood import LOSSES, Loss, Prior, QuantisedNoise, prior_rows
from hvdc_ident.fit.noise import GIVEN, sigmas, source_of
from hvdc_ident.fit.passed_noise import PassedNoise, passed_noise
from hvdc_ident.fit.residual import (
    Band,
    ComparedRecord,
    Comparison,
    ResidualBlock,
    Treatment,
    compared_records,
    residual_blocks,
    unknown_initial_states,
    with_best_start,
    with_steady_start,
)
from hvdc_ident.fit.simulator import Simulator, approximate, observe, unknown_of, unknowns
from hvdc_ident.fit.whitening import AR
from hvdc_ident.immutable import FrozenMap

TELLING = 4
"""Rows after the events for each unknown, below which a cut record tells too little."""


@dataclass(frozen=True, eq=False)
class Problem:
    """A fit to be made: its unknowns, and the residuals at given values of them.

    experiments: those with role "fit" make the residuals; held-out ones only appear in tables of RMSE.
    free: the parameters to estimate. held: values of parameters that stay, in their units; a parameter in neither keeps
    the simulator's own value. why: the reason for each held one. conditional_on: for a free parameter the held ones
    without which it could not be determined.
    rho: the noise model to whiten with by output: an AR(1) coefficient or a tuple of AR coefficients.
    quantised_noise: by output whose record is rounded to steps that its noise does not hide; its residuals are then those of
    the quantised-noise likelihood.
    weights: standard deviation by output that replaces the experiments' own noise, in the output's unit.
    guard: rows this close to a break of an input are not compared, s. band: Hz; given, the residual is the misfit's
    spectrum there. loss: what a residual costs. priors: by unknown ("EXPERIMENT:NUISANCE" for a nuisance).
    free_initial_states: whether the records, held-out ones too, begin elsewhere than at rest; the part that unknown starts of
    the states can make good is then taken out of residuals and jacobians.
    passed: by experiment the noise that its recorded inputs pass on to its outputs; left out, that of this simulator at the first guess.
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
    passed: FrozenMap[PassedNoise] = field(default_factory=FrozenMap)

    def __post_init__(self) -> None:
        for name in ("experiments", "free"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        for name in ("held", "why", "conditional_on", "rho", "weights", "priors", "quantised_noise"):
            object.__setattr__(self, name, FrozenMap(getattr(self, name)))
        self._check()
        if noisy := [e for e in self.experiments if e.input_noise and e.outputs and e.name not in self.passed]:
            object.__setattr__(self, "passed", self.passed | self._passed(noisy))

    def _passed(self, experiments: Sequence[Experiment]) -> dict[str, PassedNoise]:
        values, free = self.values(self.start), () if approximate(self.simulator) else tuple(f.name for f in self.free)
        passed = {}
        for e in experiments:
            with suppress(SimulationError):  # the fit says so where it is run
                passed[e.name] = passed_noise(self.simulator, e, values, free)
        return passed

    def __getstate__(self) -> dict[str, Any]:
        """Return the definition alone: another process works out what is cached anew."""
        return {k: v for k, v in self.__dict__.items() if k in self.__dataclass_fields__}

    def _check(self) -> None:
        known = self.simulator.parameters
        parameters = [*(f.name for f in self.free), *self.held]
        require_known("parameter", parameters, known, "the fit's parameters")
        nuisances = {n for e in self.experiments for n in e.nuisance}
        repeated = [k for k, n in Counter(parameters).items() if n > 1 or (k in nuisances and k in known)]
        if repeated:
            raise StudyError(
                "a parameter stands twice in a fit",
                got=", ".join(repeated),
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
        if self.priors:
            require_known("unknown", self.priors, [*self.names, *known], "the fit's priors")

    @cached_property
    def fitted_experiments(self) -> tuple[Experiment, ...]:
        """Experiments that make the residuals."""
        return tuple(e for e in self.experiments if e.role == "fit" and e.outputs)

    @cached_property
    def outputs(self) -> tuple[str, ...]:
        """Outputs that are measured in one of those, in order of appearance."""
        return tuple(dict.fromkeys(o for e in self.fitted_experiments for o in e.outputs))

    @cached_property
    def rows(self) -> int:
        """Number of measured values that are compared."""
        return sum(record.rows.size for records in self._records.values() for record in records)

    @cached_property
    def noise_source(self) -> FrozenMap[str]:
        """Source of each output's standard deviation: "given" or "misfit", see `source_of`."""
        return FrozenMap({o: source_of(self.fitted_experiments, o) for o in self.outputs})

    @cached_property
    def outputs_in_time(self) -> tuple[str, ...]:
        """Outputs of recordings in time, without parts of measured frequency responses."""
        return tuple(dict.fromkeys(o for e in self.fitted_experiments if e.domain == "time" for o in e.outputs))

    @cached_property
    def unknowns(self) -> tuple[FitParameter, ...]:
        """Free parameters, then the nuisances of each experiment."""
        return (*self.free, *(u for e in self.fitted_experiments for u in unknowns(self.simulator, e)))

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the unknowns."""
        return tuple(u.name for u in self.unknowns)

    @property
    def start(self) -> Array:
        """First guess, (p,)."""
        return np.array([u.start for u in self.unknowns])

    @property
    def given(self) -> Array:
        """Values that the model came with, (p,)."""
        return np.array([u.given for u in self.unknowns])

    @cached_property
    def rmse_start(self) -> dict[str, dict[str, float | None]]:
        """Table of RMSE at the first guess."""
        return self.rmse(self.start)

    @cached_property
    def rmse_given(self) -> dict[str, dict[str, float | None]]:
        """Table of RMSE at the given values."""
        return self.rmse_start if np.array_equal(self.given, self.start) else self.rmse(self.given)

    @cached_property
    def coordinates(self) -> Coordinates:
        """Scaled coordinates of the unknowns."""
        return Coordinates(self.unknowns)

    @cached_property
    def sigma(self) -> FrozenMap[FrozenMap[float]]:
        """Standard deviation of each output, in its unit, by experiment and output."""
        return _deviations(self.experiments, self.fitted_experiments, self.weights)

    @cached_property
    def noise_dof(self) -> float:
        """Number of independent samples behind the given noise of the least known output; infinite: exact."""
        fitted = self.fitted_experiments
        known = [o for o in self.outputs if o not in self.weights and source_of(fitted, o) == GIVEN]
        sums = [sum(e.noise_dof.get(o, np.inf) for e in fitted if o in e.outputs) for o in known]
        return float(min(sums, default=np.inf))

    def values(self, theta: Array) -> dict[str, float]:
        """Return the parameters' values that go to the simulator, held ones included."""
        return {**self.held, **{f.name: float(v) for f, v in zip(self.free, theta, strict=False)}}

    @cached_property
    def treatment(self) -> Treatment:
        """Treatment that turns misfits into residuals."""
        models = {o: (m,) if isinstance(m, float | int) else tuple(m) for o, m in self.rho.items()}
        return Treatment(FrozenMap(models), self.guard, self.band, self.quantised_noise, self.passed)

    def blocks(
        self,
        theta: Array,
        *,
        derivatives: bool = True,
        in_time: bool = False,
    ) -> tuple[ResidualBlock, ...]:
        """Return the residuals of each output in each experiment; jacobians have a column for every unknown, without derivatives none.

        Neither the loss nor the priors are in them. in_time: samples in time
        even where the fit is of spectra. Raises SimulationError where a run fails: theta is then inadmissible.
        """
        treatment = replace(self.treatment, band=None) if in_time else self.treatment
        width = len(self.names)
        blocks: list[ResidualBlock] = []
        for e in self.fitted_experiments:
            columns = self._columns[e.name]
            answered = self._experiment(e, theta, derivatives, treatment)
            # Where every unknown is one of this experiment's they are in their order.
            whole = not derivatives or len(columns) == width
            blocks += answered if whole else [b.among(columns, width) for b in answered]
        return tuple(blocks)

    def misfits(self, theta: Array, also: Mapping[str, float]) -> Array:
        """Return (M,) what `residuals` makes the residuals of: the misfits of a run of each experiment, in standard deviations.

        also: values of further parameters of the simulator. With unknown initial states, which are found for each run by itself, these
        are the residuals. Raises SimulationError where a run fails.
        """
        if self.free_initial_states:
            return np.concatenate(
                [
                    b.residual
                    for e in self.fitted_experiments
                    for b in self._experiment(e, theta, False, self.treatment, also)
                ]
            )
        values = {**self.values(theta), **also}
        found = []
        for c in self._comparisons:
            nuisance = self.nuisances(c.experiment, theta)
            run = observe(self.simulator, c.experiment, values, (), nuisance, derivatives=False)
            found.append(c.misfits(run.values))
        return np.concatenate(found)

    def residuals(self, misfits: Array) -> Array:
        """Return (N, k) the residuals of all blocks in k runs, from their misfits (M, k): treated together in a fraction of the time."""
        if self.free_initial_states:
            return misfits
        ends = np.cumsum([sum(r.rows.size for r in c.records) for c in self._comparisons])
        parts = np.split(misfits, ends[:-1])
        return np.vstack([c.residuals(part) for c, part in zip(self._comparisons, parts, strict=True)])

    @cached_property
    def _comparisons(self) -> tuple[Comparison, ...]:
        """What the runs of each fitted experiment are compared with."""
        found = []
        for e in self.fitted_experiments:
            treatment = self._treatment_of(e, self.treatment)
            records = self._compared(e, treatment) or compared_records(e, treatment.guard)
            found.append(Comparison(e, records, self.sigma[e.name], treatment))
        return tuple(found)

    @cached_property
    def _columns(self) -> dict[str, list[int]]:
        """Indices of the unknowns that each experiment answers, by experiment."""
        free = [f.name for f in self.free]
        local = {e.name: [*free, *(unknown_of(e.name, n) for n in e.nuisance)] for e in self.fitted_experiments}
        return {name: [self.names.index(n) for n in names] for name, names in local.items()}

    def initial_state_jacobian(self, theta: Array) -> Array:
        """Return the derivatives of the residuals by the unknown initial states, (N, k), one column a state and experiment."""
        return np.asarray(block_diag(*(self._best_start(e, theta, self.treatment)[1] for e in self.fitted_experiments)))

    def _best_start(
        self, e: Experiment, theta: Array, treatment: Treatment, also: Mapping[str, float] | None = None
    ) -> tuple[Experiment, Array]:
        """Return the experiment with the initial states that suit its records best, and its residuals' derivatives, (n, k)."""
        states = unknown_initial_states(self.simulator, e)
        values, nuisance = {**self.values(theta), **(also or {})}, self.nuisances(e, theta)
        if states:
            e = with_steady_start(self.simulator, e, values, states, nuisance)
        blocks = residual_blocks(
            self.simulator, e, values, states, self.sigma[e.name], nuisance=nuisance, treatment=treatment,
            compared=self._compared(e, treatment),
        )  # fmt: skip
        if states:
            e = with_best_start(e, blocks, states)
        return e, np.vstack([b.jacobian[:, : len(states)] for b in blocks])

    @staticmethod
    def _treatment_of(e: Experiment, treatment: Treatment) -> Treatment:
        """Return the treatment of an experiment's misfits."""
        # Measured responses are compared as they are: whitening, guards and bands are of samples in time.
        return Treatment() if e.domain == "frequency" else treatment

    def _experiment(
        self,
        e: Experiment,
        theta: Array,
        derivatives: bool,
        treatment: Treatment,
        also: Mapping[str, float] | None = None,
    ) -> tuple[ResidualBlock, ...]:
        """Return the residuals of one experiment; jacobians have a column for every unknown that it answers."""
        treatment = self._treatment_of(e, treatment)
        eliminated = (
            unknown_initial_states(self.simulator, e) if self.free_initial_states and e.domain == "time" else ()
        )
        return residual_blocks(
            self.simulator,
            self._best_start(e, theta, treatment, also)[0] if eliminated else e,
            {**self.values(theta), **(also or {})},
            tuple(f.name for f in self.free),
            self.sigma[e.name],
            nuisance=self.nuisances(e, theta),
            treatment=treatment,
            derivatives=derivatives,
            eliminated=eliminated,
            compared=self._compared(e, treatment),
        )

    def _compared(self, e: Experiment, treatment: Treatment) -> tuple[ComparedRecord, ...] | None:
        """Return the records of an experiment, where it is one of the fit and compared with the fit's guard."""
        return self._records.get(e.name) if treatment.guard == self.guard else None

    @cached_property
    def _records(self) -> dict[str, tuple[ComparedRecord, ...]]:
        """Compared records of each fitted experiment."""
        return _compared(self.fitted_experiments, self.guard)

    def nuisances(self, e: Experiment, theta: Array) -> dict[str, float]:
        """Return the value of each nuisance of an experiment of the fit; a held-out one has none."""
        if not e.nuisance:
            return {}
        values = dict(zip(self.names, theta, strict=True))
        return {n: float(values[k]) for n in e.nuisance if (k := unknown_of(e.name, n)) in values}

    def prior(self, theta: Array) -> tuple[Array, Array]:
        """Return the residuals of the priors, (k,), and their derivatives, (k, p)."""
        return prior_rows(self.priors, self.names, theta)

    def residual(self, theta: Array) -> tuple[Array, Array]:
        """Return r, (N,), and dr/dtheta, (N, p), over all experiments, the loss applied, and the priors.

        With the linear loss r = (measured - simulated)/sigma. Half of r'r is the cost.
        Raises SimulationError where a run fails or gives a number that is not finite; it never becomes a residual.
        """
        r, jacobian = self.loss.applied(*stacked(self.blocks(theta)))
        if not self.priors:
            return r, jacobian
        prior, prior_jacobian = self.prior(theta)
        return np.concatenate([r, prior]), np.vstack([jacobian, prior_jacobian])

    def cost(self, theta: Array) -> float:
        """Return the sum of the losses: the negative log-likelihood up to a constant. Raises SimulationError."""
        data = sum(float(np.sum(self.loss.rho(b.residual))) for b in self.blocks(theta, derivatives=False))
        return data + 0.5 * float(np.sum(self.prior(theta)[0] ** 2))

    def rmse(self, theta: Array) -> dict[str, dict[str, float | None]]:
        """Return the root mean square of measured - simulated by output and experiment, held-out ones too, in the output's unit.

        None where the run fails; a held-out experiment has no nuisance.
        """
        table: dict[str, dict[str, float | None]] = {}
        plain = Treatment()
        for e in self.experiments:
            alone = e if e.role == "fit" else e.with_(nuisance=())
            try:
                errors: dict[str, float] = {b.output: b.rmse for b in self._experiment(alone, theta, False, plain)}
            except SimulationError:
                errors = {}
            for output in e.outputs:
                table.setdefault(output, {})[e.name] = errors.get(output)
        return table

    def with_(
        self, *, weights: Mapping[str, float] | None = None, experiments: Sequence[Experiment] | None = None
    ) -> Problem:
        """Return a copy with other weights or experiments."""
        return replace(
            self,
            weights=self.weights if weights is None else FrozenMap(weights),
            experiments=self.experiments if experiments is None else tuple(experiments),
        )


def shortened(problem: Problem, share: float) -> Problem | None:
    """Return the problem with the recordings cut after a share of the time from their event to their end.

    None where the rows after the events would be too few to tell the unknowns, and for residuals that need a record as a whole: of
    spectra, of measured responses, and with unknown initial states.
    """
    if problem.band is not None or problem.free_initial_states or len(problem.outputs_in_time) < len(problem.outputs):
        return None
    cut = [_first_part(e, share) if e.role == "fit" else e for e in problem.experiments]
    moving = sum(
        int(np.count_nonzero(e.compared & (e.time > _begin(e)))) * len(e.outputs) for e in cut if e.role == "fit"
    )
    if moving < TELLING * len(problem.unknowns) or any(not e.compared.any() for e in cut if e.role == "fit"):
        return None
    return problem.with_(experiments=cut)


def _first_part(e: Experiment, share: float) -> Experiment:
    begin = _begin(e)
    return e.until(begin + share * (float(e.time[-1]) - begin))


def _begin(e: Experiment) -> float:
    return float(e.time[0]) if e.event is None else e.event


# Hundreds of problems on the same records stand side by side in a search: what hangs on these alone they have in common.


@lru_cache(maxsize=8)
def _compared(experiments: tuple[Experiment, ...], guard: float) -> dict[str, tuple[ComparedRecord, ...]]:
    return {e.name: compared_records(e, guard) for e in experiments}


@lru_cache(maxsize=8)
def _deviations(
    experiments: tuple[Experiment, ...], fitted: tuple[Experiment, ...], weights: FrozenMap[float]
) -> FrozenMap[FrozenMap[float]]:
    return FrozenMap({e.name: FrozenMap(sigmas(e, fitted, weights)) for e in experiments})


def stacked(blocks: Sequence[ResidualBlock]) -> tuple[Array, Array]:
    """Return the residual, (N,), and the jacobian, (N, p), of several blocks in one."""
    return np.concatenate([b.residual for b in blocks]), np.vstack([b.jacobian for b in blocks])
