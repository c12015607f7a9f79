"""Recorded and simulated data: signals over time, input signals, experiments, noise, units."""

from __future__ import annotations

from hvdc_ident.data.bad_rows import BadRows, bad_rows, gaps, without_bad_rows
from hvdc_ident.data.contradiction import Band, Contradiction, bands
from hvdc_ident.data.experiment import Experiment, SignalLike, experiment, recording_lines
from hvdc_ident.data.noise import (
    FEWEST_QUIET,
    FLOOR_SHARE,
    InputNoise,
    NoiseEstimate,
    QuietRows,
    at_rest,
    before_event,
    input_noise,
    noise_estimate,
    noise_floor,
    quiet_rows,
    row_scatter,
    without_line,
)
from hvdc_ident.data.signals import (
    MAD_TO_STD,
    InputSignal,
    Interpolation,
    event_time,
    input_signal,
    multisine,
    ramp,
    step,
)
from hvdc_ident.data.trajectory import GAP, Array, Origin, Trajectory, is_even, segments, trajectory
from hvdc_ident.data.units import PREFIXED, PREFIXES, UNITS, conversion, is_unit, same_unit, scaled, seconds_of

__all__ = [
    "FEWEST_QUIET",
    "FLOOR_SHARE",
    "GAP",
    "MAD_TO_STD",
    "PREFIXED",
    "PREFIXES",
    "UNITS",
    "Array",
    "BadRows",
    "Band",
    "Contradiction",
    "Experiment",
    "InputNoise",
    "InputSignal",
    "Interpolation",
    "NoiseEstimate",
    "Origin",
    "QuietRows",
    "SignalLike",
    "Trajectory",
    "at_rest",
    "bad_rows",
    "bands",
    "before_event",
    "conversion",
    "event_time",
    "experiment",
    "gaps",
    "input_noise",
    "input_signal",
    "is_even",
    "is_unit",
    "multisine",
    "noise_estimate",
    "noise_floor",
    "quiet_rows",
    "ramp",
    "recording_lines",
    "row_scatter",
    "same_unit",
    "scaled",
    "seconds_of",
    "segments",
    "step",
    "trajectory",
    "without_bad_rows",
    "without_line",
]
