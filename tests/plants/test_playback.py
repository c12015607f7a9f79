"""A unit that is played back: the recorded terminal voltage gives the recorded powers, from references found before the event."""

from __future__ import annotations

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.data import InputSignal
from hvdc_ident.errors import InputError
from hvdc_ident.model import parse_card
from hvdc_ident.plants import UnitPart, unit_card

PARTS = {"gen": UnitPart("genrou"), "avr": UnitPart("sexs"), "gov": UnitPart("tgov1")}
TIMES = np.arange(0.0, 6.0, 0.01)
TRUTH = {"gen.H": 3.8, "avr.K": 130.0}


@pytest.fixture(scope="module")
def recorded() -> dict[str, np.ndarray]:
    """A ramp of the infinite bus's voltage as a recorder at the terminals sees it."""
    card = unit_card(PARTS, R=0.01, X=0.3)
    card = card.replace(
        "[outputs]", '[outputs]\nVr = {value = "line.Vr", unit = "pu"}\nVi = {value = "line.Vi", unit = "pu"}'
    )
    model = parse_card(card).with_values(TRUTH)
    point = hi.find_operating_point(model, outputs={"P": 80.0, "Vt": 1.02}, free=["Pref", "Vref"])
    ramp = InputSignal.corners([(1.0, 1.0), (1.5, 0.96)])
    run = hi.simulate(model.with_values(point.inputs), TIMES, inputs={"E": ramp})
    angle = np.unwrap(np.arctan2(run["Vi"], run["Vr"]))
    frequency = 50.0 + np.gradient(angle, TIMES) / (2.0 * np.pi)
    return {"V": run["Vt"], "theta": angle - angle[0], "f": frequency, "P": run["P"], "Q": run["Q"]}


def played(signals: dict[str, np.ndarray], recorded: dict[str, np.ndarray], **levels: float):
    model = parse_card(unit_card(PARTS, network="playback")).with_values({**TRUTH, **levels})
    inputs = {n: InputSignal.corners(zip(TIMES, v, strict=True)) for n, v in signals.items()}
    return hi.simulate(model, TIMES, inputs=inputs)


# The difference quotient of the angle rounds off the frequency's corner over two rows.
@pytest.mark.parametrize(("course", "share"), [("theta", 3e-3), ("f", 1e-2)])
def test_recorded_voltage_gives_the_recorded_powers(recorded, course: str, share: float) -> None:
    levels = {"P0": recorded["P"][0], "Q0": recorded["Q"][0]}
    run = played({n: recorded[n] for n in ("V", course)}, recorded, **levels)
    for n in ("P", "Q"):
        assert np.abs(run[n] - recorded[n]).max() < share * np.ptp(recorded[n])


def test_references_are_inputs_of_the_linear_model() -> None:
    """They stand where the start puts them: no eigenvalue at 0, and the same poles as with the references given."""
    model = parse_card(unit_card(PARTS, network="playback")).with_values({"P0": 80.0, "Q0": 10.0})
    point = hi.find_operating_point(model)
    assert point.outputs["P"] == pytest.approx(80.0) and point.outputs["Q"] == pytest.approx(10.0) and point.stable
    linear = hi.linearize(model)
    assert "Vref" in linear.input_names and "Vref" not in linear.state_names
    driven = model.driven(["Vref", "Pref"]).with_values({n: point.states[n] for n in ("Vref", "Pref")})
    expected = np.linalg.eigvals(hi.linearize(driven).A)
    assert np.sort_complex(np.linalg.eigvals(linear.A)) == pytest.approx(np.sort_complex(expected))


def test_a_study_finds_levels_in_the_record(recorded, tmp_path) -> None:
    (tmp_path / "unit.toml").write_text(unit_card(PARTS, network="playback"), encoding="utf-8")
    rng = np.random.default_rng(1)
    noise = {"V": 1e-4, "theta": 1e-4, "P": 0.05, "Q": 0.05}
    table = np.column_stack([TIMES, *(recorded[n] + s * rng.standard_normal(TIMES.size) for n, s in noise.items())])
    np.savetxt(tmp_path / "event.csv", table, delimiter=",", header="time,V,theta,P,Q", comments="")
    (tmp_path / "study.toml").write_text(
        """schema = 1
model = {source = "unit.toml"}
[parameters]
gen.H = {min = 1, max = 10}
avr.K = {min = 20, max = 400}
[[experiment]]
name = "event"
data = "event.csv"
inputs = ["V", "theta"]
outputs = ["P", "Q"]
trim = {P0 = "P", Q0 = "Q"}
event = 1.0
""",
        encoding="utf-8",
    )
    study = hi.load_study(tmp_path / "study.toml")
    (event,) = study.experiments
    assert event.values["P0"] == pytest.approx(recorded["P"][0], abs=0.02)
    assert event.inputs["V"].values[0] == pytest.approx(recorded["V"][0], abs=4e-5)
    found = hi.fit(study)
    assert found.estimates["gen.H"].value == pytest.approx(3.8, rel=0.02)
    assert found.estimates["avr.K"].value == pytest.approx(130.0, rel=0.01)
    assert found.adequacy is not None and found.adequacy.verdict == "fits"


def test_a_level_of_what_is_not_recorded_is_refused(tmp_path) -> None:
    (tmp_path / "unit.toml").write_text(unit_card(PARTS, network="playback"), encoding="utf-8")
    (tmp_path / "event.csv").write_text("time,V,P\n0,1,80\n1,1,80\n2,1,80\n", encoding="utf-8")
    (tmp_path / "study.toml").write_text(
        'schema = 1\nmodel = {source = "unit.toml"}\n[[experiment]]\nname = "e"\ndata = "event.csv"\n'
        'inputs = ["V"]\noutputs = ["P"]\ntrim = {Q0 = "Q"}\n',
        encoding="utf-8",
    )
    with pytest.raises(InputError, match=r"trim.*measured output 'Q'"):
        hi.load_study(tmp_path / "study.toml")
