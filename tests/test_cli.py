"""The command line: what it prints where, its exit codes, and that nothing surfaces as a traceback."""

from __future__ import annotations

import importlib
import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from hvdc_ident.cli import app
from hvdc_ident.errors import SimulationError, unknown_name
from hvdc_ident.simulate import core
from hvdc_ident.study.stages import stages

CARD = """\
schema = 1
name = "lag"
[parameters]
k = {value = 1.0, unit = "1/s", min = 0.001, max = 1000.0}
[inputs]
u = {value = 0.0}
[states]
x = {derivative = "k*(u - x)"}
[outputs]
y = "x"
"""
STUDY = """\
schema = 1
name = "first"
[model]
source = "lag.toml"
[parameters]
k = {start = 2, min = 0.5, max = 20}
[[experiment]]
name = "step"
data = "step.csv"
inputs = ["u"]
outputs = ["y"]
noise = {y = 1e-3}
[fit]
starts = 2
"""


@pytest.fixture
def study(tmp_path: Path) -> Path:
    time = np.arange(201) * 0.01
    u = np.where(time >= 0.5, 1.0, 0.0)
    y = np.where(time >= 0.5, 1.0 - np.exp(-5.0 * (time - 0.5)), 0.0) + 1e-3 * np.random.default_rng(3).standard_normal(
        201
    )
    rows = "\n".join(f"{t:.2f},{a:g},{b:.9f}" for t, a, b in zip(time, u, y, strict=True))
    (tmp_path / "step.csv").write_text(f"time,u,y\n{rows}\n")
    (tmp_path / "lag.toml").write_text(CARD)
    (tmp_path / "study.toml").write_text(STUDY)
    return tmp_path / "study.toml"


def said(result: Result) -> str:
    """What stood on stderr, but for the integrators' compilation, which an installation announces once."""
    lines = [s for s in result.stderr.splitlines() if not s.startswith("hvdc_ident: compiling")]
    return "\n".join(lines)


def call(*arguments: object) -> Result:
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_check_tells_what_it_found_and_writes_nothing(study: Path) -> None:
    before = sorted(study.parent.iterdir())
    result = call("check", study)
    assert result.exit_code == 0, result.output
    assert "study first: good" in result.stdout
    assert "candidate k: from 2 within [0.5, 20] 1/s" in result.stdout
    assert "201 rows, 0 to 2 s, event at 0.5 s; noise y 0.001 (given)" in result.stdout
    assert sorted(study.parent.iterdir()) == before


def test_fit_finds_the_gain_and_writes_every_file(study: Path) -> None:
    result = call("fit", study)
    assert result.exit_code == 0, result.output
    folder = study.parent / "study-results"
    found = json.loads((folder / "fit.json").read_text())
    assert abs(found["estimates"]["k"]["value"] - 5.0) < 0.05
    assert {"schema", "study", "model", "software", "seed"} <= set(found)
    names = {
        "summary.json",
        "identifiability.json",
        "fit.json",
        "fitted-values.toml",
        "fitted-values.csv",
        "fitted-values.ssv",
        "fit.step.csv",
    }
    assert {p.name for p in folder.iterdir() if p.name != ".store"} == names


def test_run_then_report_from_the_folder_alone(study: Path, tmp_path: Path) -> None:
    result = call("run", study, "--out", tmp_path / "r", "--quiet")
    assert result.stdout == said(result) == ""
    page = (tmp_path / "r" / "report.html").read_text()
    (tmp_path / "r" / "report.html").unlink()
    study.unlink()
    assert call("report", tmp_path / "r").exit_code == 0
    assert (tmp_path / "r" / "report.html").read_text() == page


def test_a_report_of_nothing_says_what_it_takes(tmp_path: Path) -> None:
    result = call("report", tmp_path / "nowhere")
    assert result.exit_code == 2
    assert "no such study, and no such folder" in said(result) and "hvdc-ident run STUDY" in said(result)


def test_a_second_run_keeps_what_stands_and_a_change_is_done_again(study: Path) -> None:
    def states() -> dict[str, str]:
        lines = [line.partition(": ") for line in call("run", study).stdout.splitlines()]
        return {a: b.split(";")[0] for a, _, b in lines if a in ("simulate", "fit")}

    assert states() == {"simulate": "done", "fit": "done"}
    assert states() == {"simulate": "kept from before", "fit": "kept from before"}
    (study.parent / "study-results" / "fitted-values.ssv").unlink()
    assert states() == {"simulate": "kept from before", "fit": "done"}
    study.write_text(STUDY.replace("start = 2", "start = 3"))
    assert states() == {"simulate": "done", "fit": "done"}


def test_simulate_prints_the_errors_in_the_outputs_unit(study: Path) -> None:
    """The model of rate 1/s against a recording of rate 5/s: both are exponentials."""
    card = study.parent / "lag.toml"
    card.write_text(CARD.replace('y = "x"', 'y = {value = "x", unit = "kA"}'))
    recording = np.loadtxt(study.parent / "step.csv", delimiter=",", skiprows=1)
    time, recorded = recording[:, 0], recording[:, 2]
    gap = recorded - np.where(time >= 0.5, 1.0 - np.exp(-(time - 0.5)), 0.0)
    rmse, worst = float(np.sqrt(np.mean(gap**2))), int(np.argmax(np.abs(gap)))
    shown = call("simulate", study).stdout
    (found,) = json.loads((study.parent / "study-results" / "simulation.json").read_text())["gaps"]
    assert found["rmse"] == pytest.approx(rmse, rel=1e-6) and found["noise_units"] == pytest.approx(
        1e3 * rmse, rel=1e-6
    )
    assert found["nrmse"] == pytest.approx(rmse / np.ptp(recorded), rel=1e-6)
    assert (found["largest"], found["at"]) == (pytest.approx(gap[worst], rel=1e-5), time[worst])
    assert f"Worst signal: y in step, RMSE {rmse:.4g} kA, {100 * rmse / np.ptp(recorded):.3g} %" in shown
    assert f"{abs(gap[worst]):.4g} kA above the model at {time[worst]:g} s" in shown
    assert f"`hvdc-ident fit {study}` estimates what the recordings determine of k." in shown


def test_linearize_prints_the_point_the_modes_and_the_limits(study: Path) -> None:
    """A pendulum of 2 Hz and damping 0.1 beside a lag of 4 s, with its torque held at a limit."""
    w, zeta = float(4.0 * np.pi / np.sqrt(1.0 - 0.01)), 0.1
    (study.parent / "lag.toml").write_text(
        'schema = 1\nname = "swing"\n[inputs]\nu = {value = 3.0, unit = "kN"}\n[states]\n'
        f'x = {{derivative = "v", unit = "m"}}\nv = {{derivative = "{w**2!r}*(f - x) - {2 * zeta * w!r}*v"}}\n'
        'z = {derivative = "(x - z)/4"}\n[signals]\nf = "clip(u, -2, 2)"\n[outputs]\nx = "x"\n'
    )
    study.write_text('schema = 1\n[model]\nsource = "lag.toml"\n[linearize]\ninputs = ["u"]\noutputs = ["x"]\n')
    shown = call("linearize", study).stdout
    assert "mode at 2 Hz, damping 10 %: " in shown
    assert "operating point: stable, rightmost eigenvalue -0.25 1/s\ninputs: u = 3 kN\noutputs: x = 2" in shown
    assert "modes without oscillation: 1, the slowest with a time constant of 4 s: z" in shown
    assert "active limit: f is held by 2 (upper limit)" in shown


def test_run_prints_the_verdict_of_each_stage_and_the_values(study: Path) -> None:
    lines = call("run", study).stdout.splitlines()
    assert lines[0].startswith("simulate: done; worst is y in step, RMSE 0.")
    assert lines[1] == "identify: done; identifiable: k"
    assert lines[2] == "fit: done; converged"
    assert lines[4] == "PASS. The fitted model follows every recorded signal to its noise."
    header, row = lines[6], lines[7].split()
    assert header.split() == ["parameter", "unit", "given", "fitted", "95", "%", "interval"]
    assert row[:3] == ["k", "1/s", "1"] and float(row[4]) < 5.0 < float(row[6])
    assert lines[-1] == f"report: {study.parent / 'study-results' / 'report.html'}"


class Browser:
    """A browser that notes what it is to open."""

    def __init__(self, *, works: bool) -> None:
        self.works, self.opened = works, []  # type: ignore[var-annotated]

    def open(self, address: str) -> bool:
        self.opened.append(address)
        return self.works


@pytest.mark.parametrize("command", ["run", "report", "letter"])
def test_open_opens_the_page_in_the_browser(study: Path, command: str, monkeypatch: pytest.MonkeyPatch) -> None:
    call("run", study)
    browser = Browser(works=True)
    monkeypatch.setattr("webbrowser.get", lambda: browser)
    result = call(command, study, "--open", "--json")
    assert result.exit_code == 0 and said(result) == "" and json.loads(result.stdout)["schema"] == 1
    page = "letter.html" if command == "letter" else "report.html"
    assert browser.opened == [(study.parent / "study-results" / page).as_uri()]
    assert call(command, study).exit_code == 0 and len(browser.opened) == 1


@pytest.mark.parametrize("works", [None, False])
def test_open_says_so_where_there_is_no_browser(
    study: Path, works: bool | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    import webbrowser

    def get() -> Browser:
        if works is None:
            raise webbrowser.Error("could not locate runnable browser")
        return Browser(works=works)

    monkeypatch.setattr("webbrowser.get", get)
    result = call("run", study, "--open")
    reason = "no browser was found on this machine" if works is None else "the browser did not open the page"
    address = (study.parent / "study-results" / "report.html").as_uri()
    assert result.exit_code == 0 and said(result) == f"--open: {reason}. Try: {address} in a browser"


def test_lines_are_folded_at_words_and_commands_stay_whole() -> None:
    from hvdc_ident.text import folded

    text = "The recordings tell nothing about this one, so try `hvdc-ident fit a/study.toml --force k` and see."
    lines = folded(text, 50).splitlines()
    assert len(lines) > 1 and max(map(len, lines)) <= 50 and "`hvdc-ident fit a/study.toml --force k`" in "".join(lines)
    assert folded(text, 200) == text and " ".join(folded(text, 50).split()) == text
    table = "parameter   unit   " + 10 * "0.123   "
    assert folded(table, 40) == table
    assert folded("k  identifiable: known to 1 % of its value", 30) == "k  identifiable: known to 1 %\n  of its value"


@pytest.mark.parametrize("command", ["check", "simulate", "fit", "run"])
def test_json_is_all_there_is_on_stdout(study: Path, command: str) -> None:
    result = call(command, study, "--json")
    found = json.loads(result.stdout)
    assert found["study"] == "first" and found["schema"] == 1 and found["seed"] == 0
    assert said(result) == ""


def test_two_seeds_two_headings_one_seed_one_result(study: Path) -> None:
    def fit(seed: int) -> dict[str, Any]:
        return dict(json.loads(call("fit", study, "--json", "--seed", seed).stdout))

    assert fit(4) == fit(4)
    assert fit(5)["seed"] == 5


@pytest.mark.parametrize(
    "arguments", [["chekc", "x"], ["check"], ["fit", "x", "--sed", "1"], ["run", "x", "--workers", "0"]]
)
def test_wrong_usage_is_exit_code_2(arguments: list[str]) -> None:
    assert call(*arguments).exit_code == 2


@pytest.mark.parametrize("kind", ["models", "effects", "formats"])
def test_catalogues(kind: str) -> None:
    text, data = call(kind), json.loads(call(kind, "--json").stdout)
    assert text.exit_code == 0
    assert len(text.stdout.splitlines()) == len(data[kind]) > 0
    assert all(line.strip() for line in data[kind].values())


def test_a_missing_core_is_told_as_an_incomplete_installation(
    study: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(core, "FOLDER", tmp_path)
    core.library.cache_clear()
    done = call("simulate", study, "--out", tmp_path / "r")
    core.library.cache_clear()
    assert done.exit_code == 1 and "the installation is incomplete: the compiled core is not there" in done.output
    assert "pip install" in done.output and "bug" not in done.output


def test_a_missing_package_is_told_as_an_incomplete_installation(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*_: object) -> None:
        raise ModuleNotFoundError("No module named 'h5py'")

    monkeypatch.setattr("hvdc_ident.study.checks.need_experiments", missing)
    done = call("simulate", study)
    assert (
        done.exit_code == 1
        and "the installation is incomplete: ModuleNotFoundError: No module named 'h5py'" in done.output
    )
    assert "pip install" in done.output and "bug" not in done.output


def test_convert_and_list(study: Path, tmp_path: Path) -> None:
    data = study.parent / "step.csv"
    assert call("convert", data, "--list", "").stdout.split() == ["u", "y"]
    assert call("convert", data, "--to", tmp_path / "y.csv", "--signal", "y").exit_code == 0
    assert (tmp_path / "y.csv").read_text().startswith("time,y\n")
    assert call("convert", data).exit_code == 2


def test_convert_cuts_by_time_and_counts(tmp_path: Path) -> None:
    data, out = tmp_path / "x.csv", tmp_path / "y.csv"
    data.write_text("t [ms],a\n" + "".join(f"{100 * n},{'' if n == 3 else n}\n" for n in range(11)))
    told = call("convert", data, "--to", out, "--window", "0.2", "0.7")
    assert "6 of 11 rows, 0.2 to 0.7 s" in told.stdout and "a: 1 of 6 rows not recorded" in told.stdout
    assert out.read_text().splitlines()[1:3] == ["0.2,2.0", "0.3,"] and out.read_text().endswith("0.7,7.0\n")
    found = json.loads(call("convert", data, "--to", out, "--window", "0.2", "0.7", "--json").stdout)
    assert (found["rows"], found["rows_in_file"], found["dropped"], found["not_recorded"]) == (6, 11, 0, {"a": 1})
    for window in (("5", "6"), ("0.7", "0.2")):
        refused = call("convert", data, "--to", out, "--window", *window)
        assert refused.exit_code == 2 and "of the 11 rows from 0 to 1 s" in refused.stderr
    assert call("convert", data, "--list", "", "--window", "0", "1").exit_code == 2


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (("export", "--to", "x.mat", "--values", "best"), "no such set of values"),
        (("export", "--to", "x.fmu", "--fmi", "1"), "no FMU is written in this version of FMI"),
        (("export", "--to", "x.mo", "--kind", "me"), "this ending is another format's"),
        (("fit", "--executor", "spark://h:1"), "on this machine or by a dask scheduler"),
        (("run", "--executor", "foo"), "expected local, dask://HOST:PORT or dask+tls://HOST:PORT, got 'foo'"),
        (("diagnose", "--executor", "dask://"), "on this machine or by a dask scheduler"),
        (("export", "--to", "x.xyz"), "expected one of .csv, .dyr, .fmu"),
        (("fit", "--force", "gain"), "no candidate 'gain'"),
    ],
)
def test_a_refused_option_says_why_and_what_to_try(study: Path, words: tuple[str, ...], reason: str) -> None:
    before = sorted(study.parent.iterdir())
    refused = call(words[0], study, *words[1:])
    assert refused.exit_code == 2 and reason in refused.stderr and "expected" in refused.stderr
    assert ". Try: " in refused.stderr
    assert sorted(study.parent.iterdir()) == before


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("step.csv", "time,u\n0,1\n1,2\n", ("a file of waveforms, not a study", "hvdc-ident convert {} --list")),
        (
            "step.txt",
            "time u\n0 1\n1 2\n",
            ("a file of waveforms, not a study", "hvdc-ident new DIR --from {} --model"),
        ),
        ("step.mat", "\0\1\2", ("a file of waveforms, not a study", "hvdc-ident convert {} --list")),
        ("plant.fmu", "PK", ("this is an FMU, not a study", "hvdc-ident check {}`")),
        ("study.txt", "[model", ("not valid TOML", "mend this line")),
    ],
)
def test_a_file_that_is_no_study_is_called_by_its_kind(
    tmp_path: Path, name: str, content: str, words: tuple[str, ...]
) -> None:
    (tmp_path / name).write_text(content)
    refused = call("run", tmp_path / name)
    assert refused.exit_code == 2 and all(w.format(tmp_path / name) in refused.stderr for w in words)


def test_a_study_that_is_not_there_is_looked_for_beside(study: Path) -> None:
    refused = call("check", study.with_name("studi.toml"))
    assert refused.exit_code == 2 and said(refused).endswith(f"no such study file. Try: {study}?")


def test_two_names_of_one_key_say_which_to_keep(study: Path) -> None:
    study.write_text(STUDY + "[diagnose]\ntolerance = {y = 0.1}\nmaterial = {y = 0.1}\n")
    refused = call("check", study)
    assert refused.exit_code == 2
    assert said(refused).endswith(
        "diagnose.material: it is the earlier name of tolerance, which is given too. Try: tolerance alone"
    )


def test_only_the_nearest_names_are_suggested() -> None:
    assert str(unknown_name("gain", "KIVCD", ["KIP", "KIVDC", "KIQ"])).endswith("Try: did you mean 'KIVDC'?")
    assert str(unknown_name("gain", "KI", ["KIP", "KPVDC", "KIQ"])).endswith("Try: did you mean 'KIQ' or 'KIP'?")


def test_new_writes_a_study_that_passes_check(tmp_path: Path) -> None:
    assert call("new", tmp_path / "n").exit_code == 0
    assert call("check", tmp_path / "n" / "study.toml").exit_code == 0
    again = call("new", tmp_path / "n")
    assert again.exit_code == 2 and "already" in again.stderr


def test_a_demo_never_overwrites_a_study(study: Path) -> None:
    result = call("demo", "--out", study.parent)
    assert result.exit_code == 2 and "another study" in result.stderr
    assert study.read_text() == STUDY


def test_a_folder_that_cannot_be_made_is_the_users_to_mend(study: Path) -> None:
    result = call("simulate", study, "--out", study / "inside-a-file")
    assert result.exit_code == 2 and "cannot write" in result.stderr


def test_results_without_a_stage(tmp_path: Path) -> None:
    result = call("report", tmp_path)
    assert result.exit_code == 2 and "no results" in result.stderr


def test_a_stage_that_fails_keeps_its_results_and_ends_in_1(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fails(*_: object, **__: object) -> None:
        raise SimulationError("the run stopped at 0.5 s")

    monkeypatch.setattr(importlib.import_module("hvdc_ident.simulate"), "simulate", fails, raising=False)
    result = call("simulate", study)
    assert result.exit_code == 1
    assert result.stderr.strip() == "error: simulate: the run stopped at 0.5 s"
    kept = json.loads((study.parent / "study-results" / "simulation.json").read_text())
    assert kept["rmse"] == {"y": {"step": None}}
    assert kept["experiments"]["step"]["reason"] == "the run stopped at 0.5 s"


def test_simulate_tells_the_runs_that_ended_beside_those_that_failed(study: Path) -> None:
    """A model that leaves its domain for an input of 2: two recordings of three have no run, for one reason."""
    (study.parent / "lag.toml").write_text(CARD.replace("k*(u - x)", "k*(sqrt(1.5 - u) - x)"))
    rows = (study.parent / "step.csv").read_text().splitlines()
    high = "\n".join(
        [rows[0], *(",".join([t, "2" if u == "1" else u, y]) for t, u, y in (r.split(",") for r in rows[1:]))]
    )
    text = STUDY.replace("[fit]\nstarts = 2\n", "")
    for name in ("up", "again"):
        (study.parent / f"{name}.csv").write_text(high)
        text += f'[[experiment]]\nname = "{name}"\ndata = "{name}.csv"\ninputs = ["u"]\noutputs = ["y"]\nnoise = {{y = 1e-3}}\n'
    study.write_text(text)
    result = call("simulate", study)
    assert result.exit_code == 1
    assert "Worst signal: y in step, RMSE" in result.stdout and "simulate: failed" in result.stdout
    assert said(result).startswith("error: simulate: experiment 'up': t = 0.5 s: ")
    assert "; experiment 'again': t = 0.5 s: " in said(result)


def test_a_bug_is_one_line_and_the_traceback_is_asked_for(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def breaks(*_: object, **__: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr("hvdc_ident.study.study.load_study", breaks)
    result = call("check", study)
    assert result.exit_code == 1
    assert "Traceback" not in result.output and "ZeroDivisionError: division by zero" in result.stderr
    monkeypatch.setenv("HVDC_IDENT_DEBUG", "1")
    assert "Traceback" in call("check", study).stderr


def test_an_interrupt_is_130(study: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def stops(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("hvdc_ident.study.study.load_study", stops)
    result = call("run", study)
    assert result.exit_code == 130 and result.stderr.startswith("interrupted: ")


def test_every_stage_is_a_command_and_says_what_it_does() -> None:
    text = CliRunner().invoke(app, ["--help"], env={"COLUMNS": "200"}).stdout
    for stage in stages():
        assert f"  {stage.name}" in text
        assert stage.summary.rstrip(".") in text, (
            f"the summary of {stage.name} is cut off in --help: say it in one line"
        )


def test_the_installed_command_answers(tmp_path: Path) -> None:
    code = "from hvdc_ident.cli import main; main()"
    done = subprocess.run(
        [sys.executable, "-c", code, "check", "none.toml"], capture_output=True, text=True, cwd=tmp_path
    )
    assert done.returncode == 2
    assert (
        done.stderr == "error: none.toml: no such study file. Try: `hvdc-ident new DIR` writes a study to start from\n"
    )


@pytest.mark.parametrize(
    ("arguments", "expected"),
    [
        (("--budget", "soon"), "expected seconds, at least 0.001, got 'soon'. Try: --budget 600"),
        (("--budget", "0"), "expected seconds, at least 0.001, got '0'. Try: --budget 600"),
        (("--memory", "-5"), "expected MiB above 0, got '-5'. Try: --memory 4096"),
        (("--workers", "0"), "expected a whole number from 1 to 4096, got '0'. Try: --workers 2"),
    ],
)
def test_a_wrong_number_says_what_is_expected_and_what_to_try(arguments: tuple[str, str], expected: str) -> None:
    result = call("fit", "study.toml", *arguments)
    assert result.exit_code == 2 and expected in " ".join(result.stderr.split())


def test_an_fmu_that_is_not_there_names_those_beside_it(tmp_path: Path) -> None:
    result = call("check", tmp_path / "nothing.fmu")
    assert result.exit_code == 2 and "no such FMU" in result.stderr and ". Try: " in result.stderr
    (tmp_path / "link.fmu").touch()
    assert "Try: link.fmu in the same folder" in call("check", tmp_path / "nothing.fmu").stderr


def test_a_command_to_paste_has_the_options_that_were_given() -> None:
    from hvdc_ident.command import Access, pasteable

    access = Access(trust=True, deadline=300.0, memory=4096.0)
    text = pasteable("next: hvdc-ident diagnose STUDY", Path("a b.toml"), Path("r"), access)
    assert text == "next: hvdc-ident diagnose 'a b.toml' --out r --trust --deadline 300 --memory 4096"
