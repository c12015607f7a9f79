"""Recorded and simulated data: signals over time, input signals, experiments, noise, units."""

from __future__ import annotations

from hvdc_ident.data.experiment import Experiment, SignalLike, experiment, recording_lines
from hvdc_ident.data.noise import (
    FEWEST_QUIET,
    FLOOR_SHARE,
    GAP,
    MAD_TO_STD,
    at_rest,
    event_time,
    noise_estimate,
    noise_floor,
    pre_event_ar,
    row_scatter,
)
from hvdc_ident.data.signals import InputSignal, Interpolation, input_signal, multisine, ramp, step
from hvdc_ident.data.trajectory import Array, Origin, Trajectory, trajectory
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
    "Experiment",
    "InputSignal",
    "Interpolation",
    "Origin",
    "SignalLike",
    "Trajectory",
    "at_rest",
    "conversion",
    "event_time",
    "experiment",
    "input_signal",
    "is_unit",
    "multisine",
    "noise_estimate",
    "noise_floor",
    "pre_event_ar",
    "ramp",
    "recording_lines",
    "row_scatter",
    "same_unit",
    "scaled",
    "seconds_of",
    "step",
    "trajectory",
]
