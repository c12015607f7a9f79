"""What a study may ask of a fit, from the file to fit.json and the report."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.codec import plain as plain_of
from hvdc_ident.errors import InputError
from hvdc_ident.fit.tolerance_profile import WINDOWS
from hvdc_ident.report.sections import gains, output_errors, residuals
from hvdc_ident.study import fitting
from hvdc_ident.study.examples import write_starter
from hvdc_ident.study.stages import StageOptions, stage
from hvdc_ident.study.study import load_study
from hvdc_ident.summary import Results

GAIN = "KIVDC = {start = 650, min = 550, max = 950}"
OUTPUT = 'outputs = ["Irorder1"]'


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    place = tmp_path_factory.mktemp("study")
    write_starter(place)
    return place


def study(folder: Path, name: str, *edits: tuple[str, str]):
    text = (folder / "study.toml").read_text(encoding="utf-8")
    for old, new in edits:
        assert old in text
        text = text.replace(old, new, 1)
    (folder / f"{name}.toml").write_text(text, encoding="utf-8")
    return load_study(folder / f"{name}.toml")


def fitted(made) -> tuple[dict, dict[str, str]]:
    report = stage("identify").run(made, StageOptions(), {})
    outcome = stage("fit").run(made, StageOptions(), {"identify": json.loads(json.dumps(plain_of(report.data)))})
    assert not outcome.failed, outcome.failed
    return json.loads(json.dumps(plain_of(outcome.data), allow_nan=False)), dict(outcome.files)


@pytest.fixture(scope="module")
def plain(folder) -> tuple[dict, dict[str, str]]:
    return fitted(study(folder, "plain"))


def pages(fit: dict) -> Results:
    """Results of a fit alone, as the report's sections read them."""
    results = Results(Path())
    vars(results)["stages"] = {"fit": fit}
    return results


def test_a_plain_fit_has_everything_a_reader_needs(plain):
    data, files = plain
    assert data["status"] == "converged"
    judged = data["judgement"]
    assert judged["profile"]["name"] == "set-point-step-simulation"
    assert judged["sets"]["fitted"]["follows"] is True
    for name, source in (("step-up", "settling"), ("ramp", "inputs")):
        line = judged["sets"]["fitted"]["signals"]["Irorder1"][name]["windows"]
        assert line["end_from"] == source
        assert all(line[w]["within"] is True and line[w]["n"] > 10 for w in WINDOWS)
    assert set(data["validation"]) == {"ramp"}
    held_out = data["validation"]["ramp"]["outputs"]["Irorder1"]
    assert held_out["of_fit"] == pytest.approx(1.0, abs=0.1)
    assert held_out["in_band"] == pytest.approx(0.93, abs=0.05)
    assert data["adequacy"]["verdict"] == "fits"
    header = files["fit.step-up.csv"].splitlines()[0].split(",")
    assert header == ["time", "Irorder1", "Irorder1.measured", "Irorder1.low", "Irorder1.high"]
    rows = np.genfromtxt(files["fit.ramp.csv"].splitlines(), delimiter=",", names=True)
    assert (rows["Irorder1low"] < rows["Irorder1"]).all() and (rows["Irorder1high"] > rows["Irorder1"]).all()
    page = "".join(s.SECTION.render(pages(data)) for s in (gains, output_errors, residuals))
    for words in ("The fit converged", "Correlation", "during", "Held-out experiments", "61400-27-2"):
        assert words in page
    assert "complian" not in page.lower()


def test_ties_priors_loss_and_whitening(folder):
    made = study(
        folder,
        "much",
        (GAIN, "KIVDC = {start = 650, min = 550, max = 950, prior = {mean = 734, std = 0.5}}\nKIQ2 = {tie = '2*KIQ'}"),
        ("[fit]", '[fit]\nloss = "huber"\nwhiten = true\nguard = 0.002'),
    )
    assert "KIQ2" not in made.model.parameters
    assert list(made.candidates) == ["KPVDC", "KIVDC"]
    assert not fitting.as_reported(made)
    data, files = fitted(made)
    assert (data["loss"], data["ties"]) == ("huber", {"KIQ2": "2*KIQ"})
    assert data["derived"]["KIQ2"] == {"value": 60.0, "std": None, "unit": "pu/s", "expression": "2*KIQ"}
    assert "# KIQ2 = 2*KIQ = 60.0" in files["fitted-values.toml"]
    assert data["estimates"]["KIVDC"]["method"] == "covariance"
    assert data["estimates"]["KIVDC"]["value"] == pytest.approx(734.7, abs=0.5)
    assert "What follows from the estimates" in gains.SECTION.render(pages(data))


def test_nuisances_of_every_kind(folder):
    made = study(
        folder,
        "own",
        (GAIN, "KIVDC = {start = 650, min = 550, max = 950, per-experiment = true}"),
        (OUTPUT, OUTPUT + '\nnuisance = ["Pref2"]'),
    )
    assert made.experiments[0].nuisance == ("Pref2", "KIVDC")
    assert made.experiments[1].nuisance == ("KIVDC",)
    data, _ = fitted(made)
    assert data["fitted"] == ["KPVDC"]
    own = data["nuisance"]["step-up"]
    assert own["KIVDC"]["value"] == pytest.approx(734.7, abs=1.0)
    assert own["Pref2"]["value"] == pytest.approx(0.0, abs=1e-4)
    assert data["validation"]["ramp"]["nuisance"]["KIVDC"] == pytest.approx(734.7, abs=5.0)
    assert "from this record itself" in output_errors.SECTION.render(pages(data))
    assert "Pref2" in gains.SECTION.render(pages(data))


def test_capacitance_and_settling_time_with_the_gains_they_mean(folder, plain):
    made = study(
        folder,
        "physical",
        ('# parameterisation = "physical"', 'parameterisation = "physical"'),
        ("KPVDC = {start = 20, min = 10, max = 40}", "J = {start = 0.3, min = 0.1, max = 1}"),
        (GAIN, "Ts = {start = 0.15, min = 0.02, max = 0.5}"),
    )
    data, _ = fitted(made)
    found = data["derived"]["KIVDC"]
    assert found["value"] == pytest.approx(734.7, abs=0.5)
    assert 0 < found["std"] < 1
    # the same interval as of a fit of the gains themselves, by the derivative of the rule
    gain = plain[0]["estimates"]["KIVDC"]
    assert found["std"] == pytest.approx(gain["std_raw"], rel=0.05)


def test_a_frequency_residual_and_a_named_optimiser(folder):
    made = study(
        folder,
        "spectra",
        ("[fit]", '[fit]\nresidual = "frequency"\nband = [0, 50]\noptimiser = "l-bfgs-b"'),
    )
    data, _ = fitted(made)
    assert data["estimates"]["KPVDC"]["value"] == pytest.approx(24.0, abs=0.01)
    assert "then least squares" in data["starts"][0]["message"]
    assert data["residual_tests"]["Irorder1"]["step-up"]["n"] == len(made.experiments[0].time)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (("[fit]", '[fit]\noptimiser = "least-squarse"'), r"fit.optimiser: no optimiser.*did you mean 'least-squares'"),
        (("[fit]", '[fit]\nloss = "hubr"'), r"fit.loss: no loss.*did you mean 'huber'"),
        (("[fit]", '[fit]\nwhiten = "yes"'), r"fit.whiten.*'pre-event'"),
        (("[fit]", "[fit]\nband = [0, 10]"), 'band belongs to residual "frequency"'),
        (("[fit]", '[fit]\ntolerance = "mine.toml"'), r"fit.tolerance: mine.toml.*cannot be read"),
        ((GAIN, GAIN + "\nKIQ = {tie = 'KIQ2 +'}"), r"parameters.KIQ.tie"),
        ((GAIN, GAIN + "\nKIQ = {tie = 'KIQ2'}\nKIQ2 = {tie = 'KIQ'}"), "which is tied itself"),
        ((GAIN, GAIN + "\nKIQ = {tie = 'KIQ2', start = 3}"), "neither start, bounds nor prior"),
        ((GAIN, GAIN + "\nKIQ = {prior = {mean = 30, std = 0}}"), r"parameters.KIQ.prior.std"),
        (
            (GAIN, GAIN + "\nKIQ = {start = -3, per-experiment = true}"),
            "the search for 'KIQ' begins outside its bounds",
        ),
        ((OUTPUT, OUTPUT + '\nnuisance = ["Pref3"]'), r"no nuisance 'Pref3'.*did you mean 'Pref2'"),
    ],
)
def test_what_cannot_be_asked_is_told_with_its_place(folder, edit, message):
    with pytest.raises(InputError, match=message):
        study(folder, "wrong", edit)


def test_a_candidate_held_on_a_bound_is_in_the_status(folder):
    """The gate takes it out of the fit, whose rest converges: the fit has hit a bound all the same."""
    data, _ = fitted(study(folder, "narrow", (GAIN, "KIVDC = {start = 650, min = 550, max = 700}")))
    assert data["status"] == "at-bound"
    assert data["message"].endswith("held on a bound: KIVDC")
    assert data["estimates"]["KIVDC"]["std"] is None
    assert stage("fit").tell(data)[0].startswith("at-bound: ")
    assert "The fit ended on a bound" in gains.SECTION.render(pages(data))
