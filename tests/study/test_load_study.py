"""A study becomes a model, candidates and experiments with every rule of the study file applied."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.data import conversion, same_unit
from hvdc_ident.errors import InputError, StudyError
from hvdc_ident.study import recordings
from hvdc_ident.study.study import Study, load_study
from hvdc_ident.study.summary import Summary

TIME = np.arange(101) * 0.01


def write(folder: Path, extra: str = "", head: str = "", **columns: np.ndarray) -> Path:
    """A study of the link with one recording; `extra` goes into its experiment, `head` before it."""
    data = {"Pref2": np.where(TIME >= 0.5, 0.5, 0.4), "Irorder2": np.linspace(0.4, 0.5, 101) ** 2, **columns}
    rows = zip(TIME, *data.values(), strict=True)
    (folder / "d.csv").write_text(
        ",".join(["time", *data]) + "\n" + "\n".join(",".join(map(repr, map(float, r))) for r in rows) + "\n"
    )
    names = "" if "inputs" in extra else 'inputs = ["Pref2"]\n'
    names += "" if 'outputs = ["Irorder2"]' in extra or "outputs = {" in extra else 'outputs = ["Irorder2"]\n'
    (folder / "s.toml").write_text(
        f'schema = 1\n[model]\nsource = "vsc-hvdc-link"\n{head}\n'
        f'[[experiment]]\nname = "d"\ndata = "d.csv"\n{names}{extra}\n'
    )
    return folder / "s.toml"


def loaded(folder: Path, extra: str = "", head: str = "", **columns: np.ndarray) -> Study:
    return load_study(write(folder, extra, head, **columns))


def test_names_defaults_and_sources(tmp_path: Path) -> None:
    study = loaded(tmp_path)
    assert study.name == "s" and study.folder == tmp_path / "s-results"
    assert set(study.sources) == {"s.toml", "d.csv"}
    (experiment,) = study.experiments
    assert experiment.event == pytest.approx(0.5)
    assert experiment.inputs["Pref2"](0.499) == 0.4 and experiment.inputs["Pref2"](0.5) == 0.5
    assert experiment.measured is not None and experiment.measured.unit("Irorder2") == "pu"


def test_values_effects_and_parameterisation_reach_the_model(tmp_path: Path) -> None:
    head = 'parameterisation = "physical"\n[model.values]\nZg = 0.02\n[[model.effect]]\neffect = "lag"\n'
    head += 'at = ["Ir1", "Ir2"]\nparameters = {T = 0.002}\n'
    study = loaded(tmp_path, head=head)
    assert study.model.values["Zg"] == 0.02
    assert {"J", "Ts"} <= set(study.model.parameters)
    assert 0.002 in study.model.values.values()


def test_the_study_says_which_inputs_a_person_can_set(tmp_path: Path) -> None:
    own = {n for n, i in loaded(tmp_path).model.inputs.items() if i.settable}
    assert own == {"Vdcref1", "Qref1", "Pref2", "Qref2"}  # the card: neither grid voltages nor a dc load
    stated = loaded(tmp_path, head='[inputs]\nsettable = ["Pref2", "E1"]\n').model.inputs
    assert {n for n, i in stated.items() if i.settable} == {"Pref2", "E1"}
    assert not any(i.settable for i in loaded(tmp_path, head="[inputs]\nsettable = []\n").model.inputs.values())
    with pytest.raises(InputError, match=r"no input 'Pref'.*Pref2"):
        loaded(tmp_path, head='[inputs]\nsettable = ["Pref"]\n')


def test_a_simulation_has_the_given_values_and_a_fit_begins_at_the_starts(tmp_path: Path) -> None:
    head = "[model.values]\nKIP = 31\n[parameters]\nKIP = {start = 25, min = 5, max = 50}\n"
    head += "KPVDC = {start = 20, max = 40}\n"
    study = loaded(tmp_path, head=head)
    assert dict(study.given) == {"KIP": 31.0, "KPVDC": 24.0}  # the study's own value, and the model's
    assert dict(study.start) == {"KIP": 25.0, "KPVDC": 20.0}
    assert study.candidates["KPVDC"].min == 0.0


def test_columns_are_mapped_and_scaled(tmp_path: Path) -> None:
    extra = 'outputs = ["Irorder2"]\ncolumns = {Irorder2 = {name = "I [kA]", scale = 5.54}, Pref2 = {scale = 1}}'
    study = loaded(tmp_path, extra, **{"I [kA]": np.full(101, 0.1)})
    assert study.experiments[0].measured is not None
    assert study.experiments[0].measured["Irorder2"] == pytest.approx(0.554)


def test_a_column_that_is_renamed_twice_is_refused(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="two columns for 'Irorder2'"):
        loaded(tmp_path, 'outputs = {Irorder2 = "a"}\ncolumns = {Irorder2 = {name = "b"}}')


def test_the_unit_in_the_file_counts_too(tmp_path: Path) -> None:
    with pytest.raises(StudyError, match="'kA'"):
        loaded(tmp_path, 'outputs = {Irorder2 = "I"}', **{"I [kA]": np.full(101, 0.1)})
    with pytest.raises(StudyError, match="contradicts the file's"):
        loaded(
            tmp_path, 'outputs = {Irorder2 = "I"}\ncolumns = {Irorder2 = {unit = "A"}}', **{"I [kA]": np.full(101, 0.1)}
        )


def test_time_may_be_in_other_units(tmp_path: Path) -> None:
    assert loaded(tmp_path, 'columns = {time = {unit = "ms"}}').experiments[0].time[-1] == pytest.approx(1e-3)
    with pytest.raises(StudyError, match="no unit of time"):
        loaded(tmp_path, 'columns = {time = {unit = "kV"}}')


def test_noise_is_given_estimated_or_the_floor(tmp_path: Path) -> None:
    noisy = 0.4 + 1e-3 * np.random.default_rng(1).standard_normal(101)
    study = loaded(tmp_path, Irorder2=noisy)
    note = study.noise["d"]["Irorder2"]
    assert note.source == "estimated" and note.std == pytest.approx(1e-3, rel=0.4)
    assert study.experiments[0].noise["Irorder2"] == note.std
    given = loaded(tmp_path, "noise = {Irorder2 = 0.02}", Irorder2=noisy)
    assert given.noise["d"]["Irorder2"].source == "given" and given.experiments[0].noise["Irorder2"] == 0.02
    smooth = loaded(tmp_path)
    assert smooth.noise["d"]["Irorder2"].source == "floor" and not smooth.experiments[0].noise


def test_without_quiet_rows_before_an_event_the_noise_is_left_to_the_residual(tmp_path: Path) -> None:
    noisy = 0.4 + 1e-3 * np.random.default_rng(1).standard_normal(101)
    for place in ("event = 0.0", "event = 0.05"):
        study = loaded(tmp_path, place, Irorder2=noisy)
        assert study.noise["d"]["Irorder2"].source == "residual" and not study.experiments[0].noise
        assert "from the residual of the fit" in str(Summary.of(study))


def test_drive_instrument_interpolation_and_role(tmp_path: Path) -> None:
    extra = (
        'role = "holdout"\ndrive = {Vac1 = "V1"}\ninstrument = {Irorder2 = {window-mean = 0.02, class = 0.5}}\n'
        'interpolation = {Pref2 = "linear"}\nnuisance = ["time-shift"]\nwindow = [0.1, 0.9]'
    )
    (experiment,) = loaded(tmp_path, extra, V1=np.linspace(1.0, 0.9, 101)).experiments
    assert experiment.drive == ("Vac1",) and experiment.inputs["Vac1"](0.5) == pytest.approx(0.95)
    assert dict(experiment.instrument["Irorder2"]) == {"window-mean": 0.02, "class": 0.5}
    assert experiment.inputs["Pref2"](0.495) == pytest.approx(0.45)
    assert experiment.role == "holdout" and experiment.nuisance == ("time-shift",) and experiment.window == (0.1, 0.9)


def test_a_shared_file_is_read_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path)
    text = path.read_text()
    path.write_text(text + text[text.index("[[experiment]]") :].replace('"d"', '"e"') + "window = [0.2, 0.6]\n")
    reads = []
    plain = recordings.read_waveforms
    monkeypatch.setattr(recordings, "read_waveforms", lambda *a: reads.append(a) or plain(*a))
    assert len(load_study(path).experiments) == 2
    assert len(reads) == 1


@pytest.mark.parametrize(
    ("table", "said"),
    [
        ('[linearize]\ninputs = ["Vdcref"]', "Vdcref1"),
        ('[linearize]\noutputs = ["Irorder"]', "Irorder1"),
        ('[[sweep]]\nparameter = "KIV"\nmin = 1\nmax = 2\npoints = 3', "KIVDC"),
        ('[[sweep]]\nparameter = "KIVDC"\nmin = -1\nmax = 2\npoints = 3', "the model's own bounds"),
        ('[[sweep]]\nparameter = "KIVDC"\nvalues = [1]\nmin = 1', "either"),
        ('[fit]\nmode = "individual"\ngroups = [{parameters = ["KIP"]}]', "candidate 'KIP'"),
        ('[diagnose]\neffects = ["lga"]', "'lag'"),
        ("[diagnose]\nmaterial = {P2 = 0.1}", r"diagnose\.material: no measured output 'P2'"),
        ('[linearize]\nbreak_at = "Irorder9"', r"linearize\.break_at: no signal 'Irorder9'.*did you mean 'Irorder"),
        ('[linearize]\nplant = {inputs = "x1", outputs = "I9"}', r"linearize\.plant\.inputs: no signal 'x1'"),
        ("[linearize]\nscale = {Vdcref9 = 0.1}", r"linearize\.scale: no input or output of \[linearize\] 'Vdcref9'"),
        ('[linearize]\nformula = ["KIVD"]', r"linearize\.formula: no parameter 'KIVD'.*did you mean 'KIVDC'"),
        (
            '[linearize]\nlocus = {parameter = "KI", min = 1, max = 2}',
            r"linearize\.locus\.parameter: no input or parameter",
        ),
        ("[linearize]\ntrim = {outputs={P9 = 1.0}}", r"linearize\.trim\.outputs: no output 'P9'"),
        (
            '[[linearize.port]]\nname = "dc"\nsource = "I9"\nvoltage = "Vdc1"\ncurrent = "Vdc1"',
            r"linearize\.port 'dc'\.source: no insertion point 'I9'",
        ),
        ('[screening]\nparameters = ["KIP"]', r"screening\.parameters: no candidate 'KIP'"),
        ('[identifiability]\npair = ["KIP", "KIQ"]', r"identifiability\.pair: no candidate 'KIP'"),
        (
            '[fit]\nmode = "individual"\ngroups = [{parameters = ["KIP"], experiments = ["e"]}]\n[parameters]\nKIP = {}',
            r"fit\.groups number 1\.experiments: no experiment 'e'",
        ),
    ],
)
def test_later_stages_are_checked_as_well(tmp_path: Path, table: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        loaded(tmp_path, table)


@pytest.mark.parametrize(
    "table",
    [
        '[linearize]\ninputs = ["Vdcref1"]\nat = "start"',
        '[[sweep]]\nparameter = "KIVDC"\nmin = 250\nmax = 1500\npoints = 51\nscale = "log"',
        '[[sweep]]\nparameter = "KIVDC"\nmin = 1\nmax = 2\npoints = 5\n[[sweep]]\nparameter = "KIP"\nvalues = [1, 2.5]',
        "[identifiability]",
        '[fit]\nmode = "simultaneous"\noptimiser = "trust-region"\nstarts = 3',
        '[diagnose]\neffects = "all"\nmaterial = {Irorder2 = 0.005}',
        '[diagnose]\neffects = ["lag"]',
    ],
)
def test_every_table_of_the_contract_is_read(tmp_path: Path, table: str) -> None:
    assert loaded(tmp_path, table).experiments


def test_units() -> None:
    assert same_unit("", "pu") and same_unit("p.u.", "1") and not same_unit("kV", "V")
    assert conversion("kV", "V") == (1e3, 0.0) and conversion("ms", "s") == (1e-3, 0.0)
    assert conversion("kA", "pu") is None and conversion("m", "s") is None


@pytest.mark.parametrize("stage", ["identify", "fit", "screen", "diagnose"])
def test_a_model_without_parameters_is_said_to_have_none(tmp_path: Path, stage: str) -> None:
    (tmp_path / "m.toml").write_text(
        'schema = 1\nname = "lag"\n[inputs]\nu = {value = 0}\n[states]\nx = {derivative = "u - x"}\n[outputs]\ny = "x"\n'
    )
    np.savetxt(tmp_path / "d.csv", np.c_[TIME, TIME >= 0.2, TIME], delimiter=",", header="time,u,y", comments="")
    (tmp_path / "s.toml").write_text(
        'schema = 1\n[model]\nsource = "m.toml"\n[[experiment]]\nname = "e"\ndata = "d.csv"\ninputs = ["u"]\n'
        'outputs = ["y"]\nnoise = {y = 0.01}\n[fit]\n[diagnose]\n[screening]\n[identifiability]\n'
    )
    result = CliRunner().invoke(app, [stage, str(tmp_path / "s.toml")])
    words = " ".join(result.output.split())
    assert result.exit_code == 2 and "needs parameters to estimate" in words and "this one has none" in words
