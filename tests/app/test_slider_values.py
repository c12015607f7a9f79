"""What the sliders say, written into a study: what is fitted, from where and between which bounds, and what the model has."""

from __future__ import annotations

import pytest

pytest.importorskip("tomlkit", reason="the workbench needs: pip install 'hvdc_ident[app]'")

import hvdc_ident as hi
from hvdc_ident.app.setting import Setting, with_effects
from hvdc_ident.app.slider_values import slider_values, write_slider_values
from hvdc_ident.errors import StudyError

LAG = {"effect": "lag", "at": "u", "parameters": {"T": 0.002}}


def setting_of(study: hi.Study) -> Setting:
    return Setting.of(study.model.with_values(study.given), study.experiments[0])


def test_a_study_reads_back_what_the_sliders_said(small_study: hi.Study) -> None:
    setting = with_effects(setting_of(small_study).with_value("k", 6.123456789), [LAG]).with_value("lag_u_T", 0.05)
    said = write_slider_values(small_study.path, slider_values(small_study, setting, {"k"}, {"k": (1.0, 9.0)}))
    again = hi.load_study(small_study.path)
    (line,) = again.candidates.values()
    assert (line.start, line.min, line.max) == (6.12346, 1.0, 9.0) and again.given["k"] == 4.0
    assert again.model.parameters["lag_u_T"].value == 0.05
    assert "k start = 6.12346" in said and "effect lag at u" in said


def test_a_parameter_that_is_not_fitted_has_its_value_in_the_model(small_study: hi.Study) -> None:
    asked = slider_values(small_study, setting_of(small_study).with_value("k", 6.0), set(), {})
    assert write_slider_values(small_study.path, asked) == "study.toml: k is no longer fitted; k = 6."
    again = hi.load_study(small_study.path)
    assert not again.candidates and again.model.parameters["k"].value == 6.0
    back = slider_values(again, setting_of(again), {"k"}, {})
    write_slider_values(again.path, back)
    (line,) = hi.load_study(again.path).candidates.values()
    assert (line.given, line.min, line.max) == (6.0, 1.2, 30.0)


def test_what_cannot_hold_is_not_written(small_study: hi.Study) -> None:
    before = small_study.path.read_text()
    asked = slider_values(small_study, setting_of(small_study).with_value("k", 40.0), {"k"}, {})
    with pytest.raises(StudyError, match="outside its bounds"):
        write_slider_values(small_study.path, asked)
    assert small_study.path.read_text() == before


def test_what_the_study_states_already_is_not_written_again(small_study: hi.Study) -> None:
    before = small_study.path.read_text()
    assert write_slider_values(small_study.path, slider_values(small_study, setting_of(small_study), {"k"}, {})) == ""
    assert small_study.path.read_text() == before


def test_a_study_that_states_one_bound_has_no_other(small_study: hi.Study) -> None:
    file = small_study.path
    file.write_text(file.read_text().replace("k = {min = 0.5, max = 20}", "k = {max = 20}"))
    study = hi.load_study(file)
    write_slider_values(file, slider_values(study, setting_of(study).with_value("k", 7.0), {"k"}, {}))
    assert hi.load_study(file).start["k"] == 7.0
    with pytest.raises(StudyError, match="at most 20"):
        write_slider_values(file, slider_values(study, setting_of(study).with_value("k", 21.0), {"k"}, {}))


def test_values_of_a_model_that_is_not_the_studys_are_left_out_and_said(small_study: hi.Study) -> None:
    found = hi.apply_effects(small_study.model, [LAG])
    setting = Setting.of(found, small_study.experiments[0]).with_value("k", 5.0).with_value("lag_u_T", 0.03)
    asked = slider_values(small_study, setting, {"k"}, {})
    assert asked.elsewhere == ("lag_u_T",) and not asked.effects and asked.parameters == {"k": {"start": 5.0}}
    assert "not written, for the study's model does not have them: lag_u_T" in write_slider_values(
        small_study.path, asked
    )
