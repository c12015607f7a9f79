"""DERA1, which andes does not have, against its block diagram in steps of 0.1 ms, with timers that count."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import hvdc_ident as hi
from hvdc_ident.cli import app
from hvdc_ident.model import Model, parse_card
from hvdc_ident.plants import UnitPart, parts_of, unit_card
from hvdc_ident.psse import read_dyr
from hvdc_ident.shelf import record_of

STEP = 1e-4
TIMES = np.round(np.arange(0.0, 3.01, 0.05), 6)
SN = 50.0
RECORD = [1, 0, 1, 1, 1, 1, 0.02, 0.03, -0.05, 0.05, 0, 0, 0.02, 0.02, 20, 0, -6e-4, 6e-4, 99, -99, 1.1, 0, 0.5, -0.5]
RECORD += [0.02, 0.1, 10, 1.2, 0.44, 0.49, 1.2, 1.15, 0.16, 0.16, 0.16, 0.16, 0.7, 56.5, 62, 0.16, 0.16, 0.02, 2]
RECORD += [0.02, 0.8, 1, -1]

Corners = Sequence[tuple[float, float]]


def played(values: Mapping[str, float], P: float, Q: float, V: float = 1.02) -> Model:
    """Return a DERA1 of 50 MVA that is played back, with its levels before the event."""
    parts = parts_of({"DERA1": RECORD})
    parts = {n: UnitPart(p.source, {**p.values, **values, "Sn": SN, "Tpfilt": 3e-4}) for n, p in parts.items()}
    model = parse_card(unit_card(parts, network="playback", f0=60.0))
    return model.with_values({"V": V, "f": 60.0, "P0": P, "Q0": Q})


class Timer:
    """Counts the time for which something holds without a break; once over, it stays over."""

    def __init__(self, length: float) -> None:
        self.length, self.run = length, 0.0

    def over(self, holds: bool) -> bool:
        if self.run < self.length:
            self.run = self.run + STEP if holds else 0.0
        return self.run >= self.length


class Trip:
    """What the voltage leaves of the resources on one side: x falls through one, at zero nothing is left."""

    def __init__(self, zero: float, one: float, last: float, first: float, recovers: float) -> None:
        self.zero, self.one, self.recovers = zero, max(one, zero + 1e-9), recovers
        self.all, self.some, self.worst = Timer(last), Timer(first), self.one

    def share(self, x: float) -> float:
        gone = self.all.over(x < self.zero)
        if self.some.over(x < self.one):
            self.worst = max(min(self.worst, x), self.zero)
        if gone or x <= self.zero:
            return 0.0
        if self.some.run < self.some.length:
            return min((x - self.zero) / (self.one - self.zero), 1.0)
        back = self.recovers * (min(x, self.one) - self.worst)
        return (self.worst - self.zero + back) / (self.one - self.zero)


def der_a(p: Mapping[str, float], V: Corners, f: Corners, P: float, Q: float) -> tuple[np.ndarray, np.ndarray]:
    """Return P and Q, pu, at TIMES, by Euler's rule. P, Q: before the event."""
    volts = V[0][1]
    ratio, Vref = Q / P, p["Vref0"] or volts
    if not p["dbd1"] <= Vref - volts <= p["dbd2"]:
        Vref = volts
    low = Trip(p["vl0"], p["vl1"], p["tvl0"], p["tvl1"], p["Vrfrac"])
    high = Trip(-p["vh0"], -p["vh1"], p["tvh0"], p["tvh1"], p["Vrfrac"])
    slow, fast = Timer(p["tfl"]), Timer(p["tfh"])
    s0, s1, s2, s3, s4, s5, s6, order, s8, s9 = volts, P, Q / volts, Q / volts, 1.0, 0.0, P, P, P, P / volts
    grid = np.arange(round(TIMES[-1] / STEP) + 1) * STEP
    voltage, frequency = (np.interp(grid, *zip(*course, strict=True)) for course in (V, f))
    found = []
    for v, hz in zip(voltage, frequency / 60.0 - 1.0, strict=True):
        found.append((v * s9, v * s3))
        divisor = max(s0, 0.01)
        wanted = ratio * s1 if p["PfFlag"] else Q
        error = Vref - s0
        beyond = error - min(max(error, p["dbd1"]), p["dbd2"])
        reactive = s2 + min(max(p["Kqv"] * beyond, p["Iql1"]), p["Iqh1"])
        active = s8 / divisor
        floor = 0.0 if p["GenFlag"] else -1.0
        if p["PQFlag"]:
            active = min(max(active, floor * p["Imax"]), p["Imax"])
            room = np.sqrt(p["Imax"] ** 2 - active**2)
            reactive = min(max(reactive, -room), room)
        else:
            reactive = min(max(reactive, -p["Imax"]), p["Imax"])
            room = np.sqrt(p["Imax"] ** 2 - reactive**2)
            active = min(max(active, floor * room), room)
        left = low.share(s0) * high.share(-s0) if p["VtripFlag"] else 1.0
        tripped = [slow.over(s0 >= p["Vpr"] and 60 * (1 + s5) < p["fl"])]
        tripped += [fast.over(s0 >= p["Vpr"] and 60 * (1 + s5) > p["fh"])]
        if p["FtripFlag"] and any(tripped):
            left = 0.0
        deviation = -s5 - min(max(-s5, p["fdbd1"]), p["fdbd2"])
        droop = p["Ddn"] * min(deviation, 0.0) + p["Dup"] * max(deviation, 0.0)
        e = min(max(P + droop - s1, p["femin"]), p["femax"])
        reference = min(max(p["Kpg"] * e + s6, p["Pmin"]), p["Pmax"]) if p["FreqFlag"] else P
        rate = (active * s4 - s9) / p["Tg"]
        s9 += STEP * (min(rate, p["rrpwr"]) if s9 >= 0.0 else max(rate, -p["rrpwr"]))
        s3 += STEP * (reactive * s4 - s3) / p["Tg"]
        s1 += STEP * (s8 - s1) / p["Tp"]
        s8 = min(max(s8 + STEP * (order - s8) / p["Tpord"], p["Pmin"]), p["Pmax"])
        order += min(max(reference - order, STEP * p["dPmin"]), STEP * p["dPmax"])
        s6 = min(max(s6 + STEP * p["Kig"] * e, p["Pmin"]), p["Pmax"])
        s5 += STEP * (hz - s5) / p["Trf"]
        s4 += STEP * (left - s4) / p["Tv"]
        s2 += STEP * (wanted / divisor - s2) / p["Tiq"]
        s0 += STEP * (v - s0) / p["Trv"]
    powers = np.array(found)[np.searchsorted(grid, TIMES - STEP / 2)]
    return powers[:, 0], powers[:, 1]


def dip(*levels: tuple[float, float], rest: float = 1.02) -> Corners:
    """Return a course that goes to each level at its time within 1 ms, from 1.02 pu or what is given."""
    corners, last = [(0.0, rest)], rest
    for time, level in levels:
        corners += [(time, last), (time + 1e-3, level)]
        last = level
    return [*corners, (9.0, last)]


STILL = dip(rest=60.0)
SUPPORT = {"PfFlag": 0.0, "Kqv": 5.0, "Imax": 1.1, "VtripFlag": 0.0}
CASES: dict[str, tuple[dict[str, float], Corners, Corners, float, float]] = {
    "a short dip": ({}, dip((0.5, 0.47), (0.6, 1.02)), STILL, 40.0, 10.0),
    "a dip in which some trip": ({}, dip((0.5, 0.46), (0.8, 0.48), (1.2, 1.02)), STILL, 40.0, 10.0),
    "a dip that becomes deeper": ({}, dip((0.5, 0.48), (0.8, 0.45), (0.9, 1.02)), STILL, 40.0, 10.0),
    "a dip in which all trip": ({}, dip((0.5, 0.3), (0.8, 1.02)), STILL, 40.0, 10.0),
    "one voltage for all": ({"vl1": 0.6, "vl0": 0.6}, dip((0.5, 0.5), (0.6, 1.02), (1.0, 0.5)), STILL, 40.0, 10.0),
    "a high voltage": ({}, dip((0.5, 1.18), (0.8, 1.02)), STILL, 40.0, 10.0),
    "a low frequency": ({}, dip(), dip((0.5, 56.0), (1.5, 60.0), rest=60.0), 40.0, 10.0),
    "a low frequency in a dip": (
        {},
        dip((0.5, 0.6), (0.9, 1.02)),
        dip((0.5, 56.0), (1.0, 60.0), rest=60.0),
        40.0,
        10.0,
    ),
    "support, priority of Q": (SUPPORT | {"PQFlag": 0.0}, dip((0.5, 0.75), (1.0, 1.1)), STILL, 40.0, 10.0),
    "support, priority of P": (SUPPORT | {"Vref0": 1.0}, dip((0.5, 0.75), (1.0, 1.1)), STILL, 40.0, 10.0),
    "a high frequency": (
        {"FreqFlag": 1.0, "Tpord": 0.2},
        dip(),
        dip((0.5, 60.6), (1.5, 60.0), rest=60.0),
        40.0,
        10.0,
    ),
    "a low frequency at its limit": (
        {"FreqFlag": 1.0, "Dup": 20.0, "dPmax": 99.0},
        dip(),
        dip((0.5, 59.2), (1.5, 60.0), rest=60.0),
        45.0,
        10.0,
    ),
    "a storage that takes power": (
        {"GenFlag": 0.0, "PQFlag": 0.0, "Pmin": -1.0, "Kqv": 3.0},
        dip((0.5, 0.6), (1.0, 1.02)),
        STILL,
        -35.0,
        5.0,
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_dera1_follows_its_block_diagram(name: str) -> None:
    values, V, f, P, Q = CASES[name]
    model = played(values, P, Q)
    p = {n.removeprefix("gen."): v for n, v in model.values.items()}
    run = hi.simulate(model, TIMES, inputs={"V": hi.InputSignal.corners(V), "f": hi.InputSignal.corners(f)})
    for output, expected in zip("PQ", der_a(p, V, f, P / SN, Q / SN), strict=True):
        assert np.ptp(expected) > 0.02
        assert np.abs(run[output] / SN - expected).max() < 3e-3 * np.ptp(expected), output


RECORDS = {"DERA1": "7 'DERA1' 1 {} / resources\n", "DERAU1": "7 'USRMDL' 1 'DERAU1' 101 1 6 41 10 23\n {} /\n"}
"""The two forms in which PSS/E has it: its own model, and the user-written one of earlier versions."""


@pytest.mark.nightly
@pytest.mark.parametrize("form", RECORDS)
def test_from_its_record_and_an_event_to_the_fitted_record(form: str, tmp_path: Path) -> None:
    """A gain of 3 where the record says 5, from a dip in which shares trip."""
    names = record_of("dera1")
    given = dict(zip(names, RECORD, strict=True)) | {"Kqv": 5.0, "PQFlag": 0}
    (tmp_path / "plant.dyr").write_text(RECORDS[form].format(" ".join(map(str, given.values()))), encoding="utf-8")
    times = np.round(np.arange(0.0, 3.0, 0.01), 6)
    V = [(0.0, 1.02), (0.5, 1.02), (0.7, 0.47), (0.9, 0.47), (1.1, 0.9), (1.5, 0.9), (1.7, 1.02), (9.0, 1.02)]
    truth = played({"Kqv": 3.0, "PQFlag": 0.0}, 40.0, 10.0)
    run = hi.simulate(truth, times, inputs={"V": hi.InputSignal.corners(V)})
    random = np.random.default_rng(3)
    noisy = [run[n] + 0.02 * random.standard_normal(times.size) for n in "PQ"]
    frequency = 60.0 + 1e-4 * random.standard_normal(times.size)
    table = np.column_stack([times, np.interp(times, *zip(*V, strict=True)), frequency, *noisy])
    np.savetxt(tmp_path / "event.csv", table, delimiter=",", header="time,V,f,P,Q", comments="")

    def done(*arguments: object) -> str:
        result = CliRunner().invoke(app, [str(a) for a in arguments])
        assert result.exit_code == 0, result.stderr
        return result.stdout

    study, unit = tmp_path / "unit" / "study.toml", ["--bus", 7, "--base", 50, "--frequency", 60]
    done("new", tmp_path / "unit", "--dyr", tmp_path / "plant.dyr", *unit, "--from", tmp_path / "event.csv", "--quiet")
    done("fit", study, "--quiet")
    done("export", study, "--to", tmp_path / "fitted.dyr", "--quiet")
    (record,) = read_dyr(tmp_path / "fitted.dyr").records
    fitted = dict(zip(names, record.values, strict=True))
    assert record.model == form
    assert fitted["Kqv"] == pytest.approx(3.0, rel=0.01)
    assert {n: v for n, v in fitted.items() if n != "Kqv"} == {n: v for n, v in given.items() if n != "Kqv"}


def test_it_takes_the_frequency_at_its_terminals() -> None:
    """A ramp of the recorded angle is a frequency of the network: 0.3 Hz above nominal the droop takes Ddn (0.005 - 0.0006)."""
    model = played({"FreqFlag": 1.0}, 40.0, 10.0)
    ramp = hi.ramp(0.0, 2.0 * np.pi * 0.3 * 4.0, start=1.0, end=5.0)
    run = hi.simulate(model, [0.0, 4.9], inputs={"theta": ramp})
    assert run["P"] == pytest.approx([40.0, 40.0 - SN * 20.0 * (0.3 / 60.0 - 6e-4)], abs=1e-3)


def test_the_voltage_reference_is_the_voltage_where_the_record_has_none() -> None:
    """None, or one outside the dead band."""
    for Vref0, expected in ((0.0, 1.02), (1.0, 1.0), (0.9, 1.02), (1.1, 1.02)):
        model = played({"Kqv": 5.0, "Vref0": Vref0}, 40.0, 10.0)
        point = hi.find_operating_point(model)
        assert point.states["gen.Vref"] == pytest.approx(expected), Vref0
        assert point.outputs["Q"] == pytest.approx(10.0)
