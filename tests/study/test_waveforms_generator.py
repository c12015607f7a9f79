"""The generated recordings: seeded, inside the links' limits, with the noise asked for, readable as a study."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hvdc_ident.errors import InputError
from hvdc_ident.simulate import simulate
from hvdc_ident.study.examples import MOVED, Campaign, Noise, experiments, recorded, write_waveforms
from hvdc_ident.study.study import load_study

SMALL = Campaign(count=2, holdout=1, noise=Noise(1e-4))


def test_thirty_of_each_differ_in_size_slope_sign_and_operating_point():
    driven = experiments(Campaign())
    assert len(driven) == 90 and len({e.name for e in driven}) == 90
    for moved in MOVED.values():
        signals = [e.inputs[moved.setpoint] for e in driven if moved.setpoint in e.inputs]
        changes = np.array([s.values[-1] - s.values[0] for s in signals])
        assert len(signals) == 30 and 8 < (changes > 0).sum() < 22
        assert np.unique(np.abs(changes)).size > 20 and np.unique([s.values[0] for s in signals]).size > 20
        slopes = [(s.times[-1] - s.times[0]) for s in signals]
        assert slopes.count(0.0) == 15 and np.ptp([s for s in slopes if s]) > 0.1
        assert max(np.abs(s.values).max() for s in signals) <= moved.most


def test_no_seed_moves_a_set_point_beyond_its_range():
    driven = [e for seed in range(30) for e in experiments(Campaign(kinds=("Vdc",), seed=seed))]
    ends = np.array([e.inputs["Vdcref1"].values[-1] for e in driven])
    assert 1.029 < ends.max() <= MOVED["Vdc"].most


def test_at_rest_every_experiment_begins_at_the_links_own_set_points():
    anywhere, rest = experiments(Campaign()), experiments(Campaign(at_rest=True))
    start = {"Pref2": 0.4, "Qref1": 0.0, "Vdcref1": 1.0}
    for a, r in zip(anywhere, rest, strict=True):
        ((name, signal),) = r.inputs.items()
        assert signal.values[0] == start[name] and not r.values
        assert np.ptp(signal.values) == pytest.approx(np.ptp(a.inputs[name].values)) and r.name == a.name
        assert abs(signal.values[-1]) <= MOVED[{"p": "P", "q": "Q", "v": "Vdc"}[r.name[0]]].most


def test_a_seed_gives_the_same_recordings_whatever_else_is_recorded(tmp_path):
    one, two = (next(recorded(replace(SMALL, kinds=kinds))) for kinds in (("Q",), ("Q", "P")))
    np.testing.assert_array_equal(one.measured.values, two.measured.values)
    other = next(recorded(replace(SMALL, kinds=("Q",), seed=1)))
    assert not np.array_equal(one.measured.values, other.measured.values)


@pytest.mark.parametrize("rho", [0.0, 0.9])
def test_the_noise_has_the_size_and_colour_asked_for(rho):
    noise = Noise(2e-4, rho).on(np.zeros(20_000), np.random.default_rng(0))
    assert noise.std() == pytest.approx(2e-4, rel=0.1)
    assert np.corrcoef(noise[1:], noise[:-1])[0, 1] == pytest.approx(rho, abs=0.03)


def test_a_quantised_record_has_its_resolution():
    seen = Noise(0.0, resolution=0.01).on(np.linspace(0.0, 1.0, 1000), np.random.default_rng(0))
    np.testing.assert_allclose(seen / 0.01, np.round(seen / 0.01), atol=1e-9)
    assert np.unique(seen).size == 101


def test_the_study_reads_back_what_was_recorded(tmp_path):
    study = load_study(write_waveforms(tmp_path, SMALL))
    made = {e.name: e for e in recorded(SMALL)}
    assert [e.name for e in study.experiments] == list(made)
    for e in study.experiments:
        np.testing.assert_allclose(e.measured.values, made[e.name].measured.values, atol=1e-9)
        ((name, signal),) = made[e.name].inputs.items()
        assert signal.times[0] == pytest.approx(0.1) and e.role == made[e.name].role
        np.testing.assert_allclose(e.inputs[name](e.time), signal(e.time), atol=1e-9)
    assert [e.role for e in study.experiments] == ["fit", "holdout"] * 3


def test_a_hidden_effect_is_in_the_waveforms():
    hidden = {"effect": "lag", "at": ["P2_m"], "parameters": {"T": 0.005}}
    plain, lagged = (
        next(recorded(Campaign(kinds=("P",), count=1, noise=Noise(0.0), effects=e))) for e in ((), (hidden,))
    )
    assert np.abs(plain.measured["Irorder2"] - lagged.measured["Irorder2"]).max() > 1e-3
    np.testing.assert_allclose(plain.measured["Irorder2"][:200], lagged.measured["Irorder2"][:200], atol=1e-8)


def test_no_experiment_reaches_a_limit():
    campaign = Campaign(noise=Noise(0.0))
    for e in recorded(replace(campaign, count=6)):
        assert np.abs(e.measured["Irorder1"]).max() < 1.05
        assert simulate(campaign.model, e, outputs=["Vdc1"]).status == "converged"


def test_what_cannot_be_recorded_is_refused(tmp_path):
    with pytest.raises(InputError, match="noise is wrong"):
        Noise(rho=1.0)
    with pytest.raises(InputError, match="campaign is wrong"):
        Campaign(count=2, holdout=2)
    (tmp_path / "study.toml").write_text("schema = 1\n")
    with pytest.raises(InputError, match="another study"):
        write_waveforms(tmp_path, SMALL)
