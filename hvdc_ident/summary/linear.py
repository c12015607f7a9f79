"""The linear model of a study as `linearization.json` holds it, and its words: shared by the screen of the stage and the report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any

from hvdc_ident.codec import INLINE, Coded, plain, read_fields, stored_as
from hvdc_ident.linearize import (
    FrequencyResponse,
    LinearModel,
    LoopMargins,
    Margins,
    Reduction,
    RootLocus,
    TransferFunction,
)
from hvdc_ident.linearize.distance import ModelDistance
from hvdc_ident.linearize.gain_limits import Crossing
from hvdc_ident.linearize.loops import disk_phase
from hvdc_ident.linearize.modal import NamedMode
from hvdc_ident.linearize.norms import Peak
from hvdc_ident.linearize.point import OperatingPoint
from hvdc_ident.linearize.stability import EIGENVALUES, Stability
from hvdc_ident.summary.compared_responses import ComparedResponse, response_lines
from hvdc_ident.text import quantity

MODES_SHOWN = 8
"""Modes on the screen, the least damped first."""
VALUES_SHOWN = 6
"""Inputs and outputs of the operating point in one line of the screen."""


@dataclass(frozen=True)
class Trim:
    """Outputs and inputs that a point was trimmed to, as asked, and the values found for the freed ones."""

    outputs: Mapping[str, float]
    inputs: Mapping[str, float]
    found: Mapping[str, float]


@dataclass(frozen=True)
class CoprimeMargin:
    """The normalised coprime factor margin of plant and controller; the largest that any controller of the plant attains."""

    peak: Peak = field(metadata=INLINE)
    attainable: float
    inputs: tuple[str, ...]
    outputs: tuple[str, ...]


@dataclass(frozen=True)
class _Plant:
    ncf_margin: CoprimeMargin | None = None


@dataclass(frozen=True, eq=False)
class StudyMargins(Coded):
    """The margins of the loops that a study opens, and that of its plant and controller; None where it does not ask for them."""

    loops: LoopMargins | None = None
    plant: CoprimeMargin | None = None

    def to_dict(self) -> dict[str, Any]:
        """Return the margins of the loops, with that of the plant among them, as JSON holds them."""
        of_loops = {} if self.loops is None else self.loops.to_dict()
        return of_loops | ({} if self.plant is None else {"ncf_margin": plain(self.plant)})

    @classmethod
    def from_dict(cls, data: Mapping[str, Any]) -> StudyMargins:
        """Return the margins that `to_dict` wrote. Raises InputError for anything else."""
        return cls(LoopMargins.from_dict(data) if "loops" in data else None, read_fields(_Plant, data).ncf_margin)

    def lines(self) -> Iterator[str]:
        """Yield the margins of each loop alone."""
        if self.loops is None or not self.loops.stable:
            return
        for name, m in self.loops.each.items():
            yield (
                f"loop at {name}: gain margin {_at(m.gain_margin)}, lower gain margin {_at(m.lower_gain_margin)}, phase "
                f"margin {_at(m.phase_margin, ' degrees')}, delay margin {_at(m.delay, ' ms', 1e3)}, disk {m.disk.value:.3g}"
            )

    def common_lines(self) -> Iterator[str]:
        """Yield why there are no margins, else those of all loops together; and that of plant and controller."""
        if self.loops is not None and not self.loops.stable:
            yield _without_margins(self.loops.stability)
        if self.loops is not None and self.loops.stable and len(self.loops.each) > 1:
            disk = self.loops.disk.value
            yield f"all loops at once: disk margin {disk:.3g}, phase {disk_phase(disk):.3g} degrees"
        if self.plant is not None:
            yield f"coprime factor margin {self.plant.peak.value:.4g}; the largest attainable {self.plant.attainable:.4g}"

    @property
    def each(self) -> Mapping[str, Margins]:
        """The margins of each loop, none where the closed loops are not stable."""
        return self.loops.each if self.loops is not None and self.loops.stable else {}


@dataclass(frozen=True, eq=False)
class StudyReduction:
    """A reduced model with the error that it has, and the states before."""

    found: Reduction = field(metadata=INLINE)
    error: Peak
    states_before: int


@dataclass(frozen=True)
class Formula:
    """A transfer function with some parameters as symbols, as text; reason: why there is none."""

    input: str
    output: str
    numerator: str = field(default="", metadata=stored_as("numerator", optional=True))
    denominator: str = field(default="", metadata=stored_as("denominator", optional=True))
    latex: str = field(default="", metadata=stored_as("latex", optional=True))
    reason: str = field(default="", metadata=stored_as("reason", optional=True))


@dataclass(frozen=True, eq=False)
class PortImpedance:
    """The impedance at a port over frequency, and the least real part of it: below 0 the port is not passive."""

    name: str
    response: FrequencyResponse = field(metadata=INLINE)
    least_real_part: Crossing


@dataclass(frozen=True, eq=False)
class LinearResult(Coded):
    """A linear model of a study, and what its [linearize] asks beside it.

    values, set, parameters: at which values it stands (`ValueSet`). stable, branch, notes: of its operating point. method: of the
    Jacobian; jacobian_error: to a second one, made as jacobian_check says. Empty, or None: not asked for.
    """

    linear: LinearModel = field(metadata=INLINE)
    values: str
    set: str
    parameters: Mapping[str, float]
    stable: bool | None
    stability: Stability
    branch: str
    notes: tuple[str, ...]
    modes: tuple[NamedMode, ...]
    transfer_functions: tuple[TransferFunction, ...]
    method: str
    jacobian_error: float
    jacobian_check: str
    norms: Mapping[str, Any]
    frequency_response: FrequencyResponse | None = field(
        default=None, metadata=stored_as("frequency_response", optional=True)
    )
    scale: Mapping[str, float] = field(default_factory=dict, metadata=stored_as("scale", optional=True))
    trim: Trim | None = field(default=None, metadata=stored_as("trim", optional=True))
    margins: StudyMargins | None = field(default=None, metadata=stored_as("margins", optional=True))
    reduced: StudyReduction | None = field(default=None, metadata=stored_as("reduced", optional=True))
    comparison: ModelDistance | None = field(default=None, metadata=stored_as("comparison", optional=True))
    formulas: tuple[Formula, ...] = field(default=(), metadata=stored_as("formulas", optional=True))
    locus: RootLocus | None = field(default=None, metadata=stored_as("locus", optional=True))
    ports: tuple[PortImpedance, ...] = field(default=(), metadata=stored_as("ports", optional=True))
    responses: tuple[ComparedResponse, ...] = field(default=(), metadata=stored_as("responses", optional=True))

    @property
    def point(self) -> OperatingPoint:
        """The operating point."""
        assert self.linear.point is not None  # a study's linear model stands at one
        return self.linear.point

    @property
    def swinging(self) -> list[NamedMode]:
        """The oscillating modes, one of each pair, the least damped first."""
        return sorted((m for m in self.modes if m.mode.eigenvalue.imag > 0), key=lambda m: m.mode.damping)

    @property
    def verdict(self) -> str:
        """Stability of the operating point in words, with its rightmost eigenvalue; empty for a model without modes.

        Of a model with delays the number of its unstable roots comes along, which is what the verdict rests on.
        """
        s = self.stability
        right = f", rightmost eigenvalue {s.rightmost.real:.4g} 1/s" if s.rightmost is not None else ""
        if s.method == EIGENVALUES:
            return f"{s.verdict}{right}" if right else ""
        if s.verdict == "not decided":
            return f"stability not decided: {s.reason}"
        why = f": {s.reason}" if s.reason else ""
        return f"{s.verdict}{right} ({s.count_text}, delays exact){why}"

    @property
    def lines(self) -> list[str]:
        """The lines that the stage prints of the model."""
        margins = self.margins or StudyMargins()
        return [
            *_point_lines(self),
            *(f"operating point: {note}" for note in self.notes),
            *_mode_lines(self),
            *_trim_lines(self.trim),
            *margins.lines(),
            *margins.common_lines(),
            *locus_lines(self.locus),
            *map(port_line, self.ports),
            *other_lines(self),
            *response_lines(self.responses, self.values),
        ]


@dataclass(frozen=True)
class NoLinearModel:
    """Why there is no linear model at the fitted values. fit, diagnosis: fingerprints of the results that the values are of."""

    message: str
    values: str
    set: str
    parameters: Mapping[str, float]
    fit: str = ""
    diagnosis: str = ""


@dataclass(frozen=True, eq=False)
class FittedLinear(LinearResult):
    """A linear model at fitted values. fit, diagnosis: fingerprints of the results that the values are of."""

    fit: str = ""
    diagnosis: str = ""


@dataclass(frozen=True, eq=False)
class Linearisation(Coded):
    """The linear model at the given values, and at the fitted ones where they stand. fitted_note: which these are, or why none."""

    given: LinearResult = field(metadata=INLINE)
    fitted: NoLinearModel | FittedLinear | None = field(default=None, metadata=stored_as("fitted", optional=True))
    fitted_note: str = ""

    @property
    def at_fitted(self) -> FittedLinear | None:
        """The linear model at the fitted values; None where there is none."""
        return self.fitted if isinstance(self.fitted, FittedLinear) else None

    @property
    def why_none(self) -> str:
        """Why there is no linear model at the fitted values; "" where there is one, or no fit."""
        if isinstance(self.fitted, NoLinearModel):
            return self.fitted.message
        return self.fitted_note if self.fitted is None else ""


def port_line(port: PortImpedance) -> str:
    """Return whether a port is passive."""
    least = port.least_real_part
    side = "passive" if least.value >= 0 else "not passive"
    return f"port {port.name}: {side} over the band, least real part {least.value:.4g} at {_hertz(least.omega)}"


def other_lines(result: LinearResult) -> list[str]:
    """Return the comparison with another model, the reduced model and the formulas of transfer functions."""
    lines = []
    if (c := result.comparison) is not None:
        fails = " (the winding condition fails: no controller of one need suit the other)" if c.nu_gap.winding else ""
        room = "" if c.attainable is None else f", attainable margin {c.attainable:.4g}"
        gain = (
            ""
            if c.difference is None
            else f"; the gains differ by up to {_at(Crossing(c.difference.omega, c.difference.value))}"
        )
        lines.append(f"against {c.second}: nu-gap {c.nu_gap.value:.4g}{fails}{room}{gain}")
    if (r := result.reduced) is not None:
        dc = ", dc gain matched" if r.found.match_dc else ""
        size = f"error {r.error.value:.4g}, bound {r.found.bound:.4g}{dc}"
        lines.append(f"reduced from {r.states_before} to {r.found.order} states: {size}")
    lines += [
        f"{f.output} from {f.input}: {f.reason or f'({f.numerator}) / ({f.denominator})'}" for f in result.formulas
    ]
    return lines


def _point_lines(result: LinearResult) -> Iterator[str]:
    """Yield the verdict on stability, the inputs and outputs at the point, and the limits that are active."""
    if verdict := result.verdict:
        yield f"operating point: {verdict}"
    m = result.linear
    sides = (("inputs", m.input_names, m.u0, m.input_units), ("outputs", m.output_names, m.y0, m.output_units))
    for kind, names, values, units in sides:
        shown = [f"{n} = {quantity(v, u, 6)}" for n, v, u in zip(names, values, units, strict=True)][:VALUES_SHOWN]
        more = f" and {len(names) - VALUES_SHOWN} more" if len(names) > VALUES_SHOWN else ""
        yield from [f"{kind}: {', '.join(shown)}{more}"] if shown else []
    for limit in result.point.active_limits:
        yield f"active limit: {limit.signal} is held by {limit.level} ({limit.kind} limit)"
    if not result.point.active_limits and result.point.margins:
        yield "active limits: none"


def _mode_lines(result: LinearResult) -> Iterator[str]:
    """Yield the oscillating modes, the least damped first, and how many decay without oscillation, with the slowest of them."""
    swinging = [m.mode for m in result.swinging]
    for m in swinging[:MODES_SHOWN]:
        shares = sorted(m.participation, key=lambda n: -m.participation[n])[:3]
        yield f"mode at {m.frequency_hz:.4g} Hz, damping {100 * m.damping:.3g} %: {', '.join(shares)}"
    if len(swinging) > MODES_SHOWN:
        better = swinging[MODES_SHOWN].damping
        yield f"and {len(swinging) - MODES_SHOWN} more modes, of damping {100 * better:.3g} % and above"
    real = [m.mode for m in result.modes if m.mode.eigenvalue.imag == 0.0 and "sliding mean" not in m.mode.kind]
    if real:
        slowest = max(real, key=lambda m: m.eigenvalue.real)
        rate = slowest.eigenvalue.real
        how = (
            f"the slowest with a time constant of {quantity(-1.0 / rate, 's')}"
            if rate < 0
            else f"one at {rate:.4g} 1/s"
        )
        yield f"modes without oscillation: {len(real)}, {how}: {slowest.dominant}"


def _trim_lines(trim: Trim | None) -> list[str]:
    if trim is None:
        return []
    wanted = ", ".join(f"{n} = {v:g}" for n, v in trim.outputs.items())
    made = ", ".join(f"{n} = {v:.6g}" for n, v in trim.found.items())
    return [f"trimmed to {wanted}: {made or 'nothing had to move'}"]


def locus_lines(locus: RootLocus | None) -> list[str]:
    """Return a line for each place along the locus where stability is lost or won."""
    if locus is None:
        return []
    unit = f" {locus.unit}" if locus.unit else ""
    span = f"{locus.parameter} from {locus.values[0]:g} to {locus.values[-1]:g}{unit}"
    lines = [
        f"along {span} stability is {x.direction} at {x.value:.6g}{unit}, {_hertz(abs(x.eigenvalue.imag))}"
        for x in locus.limits
    ]
    return lines or [f"along {span} stability is neither lost nor won"]


def _without_margins(s: Stability) -> str:
    """Return the sentence on closed loops that are not stable, or of which it cannot be told."""
    if s.verdict == "not decided":
        return f"whether the closed loops are stable cannot be told, so that no margins are given: {s.reason}"
    if s.verdict != "unstable":
        return "the closed loops are on the limit of stability: they have no margins"
    return f"the closed loops are not stable: they have no margins ({s.count_text})"


def _at(margin: Crossing, unit: str = "", factor: float = 1.0) -> str:
    """Return a margin with its frequency; one without a limit (infinite, or a factor of 0) is unlimited."""
    if math.isinf(margin.value) or (margin.value == 0.0 and math.isinf(margin.omega) and not unit):
        return "unlimited"
    where = "at infinite frequency" if math.isinf(margin.omega) else f"at {_hertz(margin.omega)}"
    return f"{factor * margin.value:.4g}{unit} {where}"


def _hertz(omega: float) -> str:
    return f"{omega / math.tau:.4g} Hz"
