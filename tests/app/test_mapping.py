"""A recording mapped to a model: proposed, written, read again; two writers; names that lead out of the folder; broken files."""

from __future__ import annotations

import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("tomlkit", reason="the workbench needs: pip install 'hvdc_ident[app]'")

import hvdc_ident as hi
from hvdc_ident.app.desk import opened
from hvdc_ident.app.mapping import (
    RecordingMap,
    SignalLine,
    columns_with_derived,
    drafted,
    experiments_in,
    proposed,
    write_mapping,
)
from hvdc_ident.app.study_folder import (
    Seen,
    chosen_recording,
    keep_recordings,
    recordings_in,
    safe_name,
    write_study,
)
from hvdc_ident.errors import InputError, StudyError
from hvdc_ident.formats import formats
from hvdc_ident.study.parse import parse_study
from tests.formats.samples import SAMPLES

LINK = hi.load_model("vsc-hvdc-link")


def recording(path: Path, power: str = "P2 [pu]", factor: float = 1.0) -> Path:
    """Write a recording of the link after a step of Pref2 at 0.1 s, with noise."""
    time = np.linspace(0.0, 0.5, 501)
    ran = hi.simulate(LINK, time, inputs={"Pref2": hi.step(0.4, 0.5, at=0.1)})
    noise = np.random.default_rng(1).normal(scale=1e-4, size=time.size)
    rows = zip(time, np.where(time < 0.1, 0.4, 0.5), factor * (ran["P2"] + noise), strict=True)
    lines = [f"{t:.6g},{u:.17g},{p:.17g},{np.sin(t):.6g}" for t, u, p in rows]
    path.write_text("\n".join([f"time [s],PREF_2 [pu],{power},spare", *lines]) + "\n", "utf-8")
    return path


@pytest.fixture
def mapped(tmp_path: Path) -> tuple[Path, RecordingMap]:
    """A study file that is not there yet, and the mapping of a recording beside it."""
    path = recording(tmp_path / "step.csv")
    return tmp_path / "study.toml", proposed(hi.read_waveforms(path), LINK, "step", "step.csv")[0]


def test_columns_are_proposed_by_name(mapped: tuple[Path, RecordingMap]) -> None:
    found = {line.signal: (line.kind, line.column) for line in mapped[1].lines}
    assert found == {"Pref2": ("input", "PREF_2"), "P2": ("output", "P2")}


def test_a_written_mapping_is_read_again_as_it_was(mapped: tuple[Path, RecordingMap]) -> None:
    file, mapping = mapped
    mapping = replace(mapping, name="step-up", event=0.1, window=(0.05, 0.4)).stated("P2", "offset", 0.001)
    seen = write_mapping(Seen.now(file), mapping, "step", "vsc-hvdc-link")
    study = hi.load_study(file)
    (experiment,) = study.experiments
    plain = replace(mapping, lines=tuple(replace(line, why="") for line in mapping.lines))
    assert experiments_in(study.settings) == {"step-up": plain}
    assert (experiment.event, tuple(experiment.window or ())) == (0.1, (0.05, 0.4))
    record = hi.read_waveforms(file.parent / "step.csv")
    np.testing.assert_allclose(experiment.measured["P2"], record["P2"] + 0.001, rtol=0, atol=1e-15)
    again = write_mapping(seen, plain, "step-up", "vsc-hvdc-link")
    assert again.text == seen.text == file.read_text("utf-8")


def test_other_keys_and_comments_of_a_study_stay(mapped: tuple[Path, RecordingMap]) -> None:
    file, mapping = mapped
    seen = write_mapping(Seen.now(file), mapping, "step", "vsc-hvdc-link")
    text = (seen.text or "").replace(
        "[[experiment]]", "[[experiment]]\nnoise = {P2 = 2e-4} # stated", 1
    ) + "[fit]\nstarts = 2\n"
    file.write_text(text, "utf-8")
    read = experiments_in(parse_study(file.read_bytes(), file))["step"]
    write_mapping(Seen.now(file), replace(read, event=0.1), "step", "")
    assert [line for line in file.read_text("utf-8").splitlines() if line not in text.splitlines()] == ["event = 0.1"]
    assert hi.load_study(file).noise["step"]["P2"].std == 2e-4


def test_a_draft_says_what_check_says_of_the_written_study(mapped: tuple[Path, RecordingMap]) -> None:
    file, mapping = mapped
    draft = drafted(mapping, hi.read_waveforms(file.parent / "step.csv"), LINK, None, "", "study.toml")
    write_mapping(Seen.now(file), mapping, "step", "vsc-hvdc-link")
    told, drafts = hi.check(file).to_dict(), draft.summary.to_dict()
    assert drafts["experiments"] == told["experiments"] and drafts["rest_levels"] == told["rest_levels"]
    assert draft.experiment.event == 0.1 and draft.noise["P2"].source == "estimated"
    assert draft.noise["P2"].std == pytest.approx(1e-4, rel=3.0 / np.sqrt(2.0 * 100))


def test_a_base_is_proposed_from_the_levels_and_its_absence_told(tmp_path: Path) -> None:
    record = hi.read_waveforms(recording(tmp_path / "step.csv", "P2 [MW]", 1000.0))
    mapping, matching = proposed(record, LINK, "step", "step.csv")
    (match,) = (m for m in matching.proposed if m.target.name == "P2")
    assert match.base == pytest.approx(1000.0, rel=0.01)
    mapping = mapping.assigned("P2", "P2", "output")
    with pytest.raises(InputError, match="another unit"):
        drafted(mapping, record, LINK, None, "", "study.toml")
    draft = drafted(mapping.stated("P2", "base", 1000.0), record, LINK, None, "", "study.toml")
    assert draft.experiment.measured is not None
    assert draft.experiment.measured["P2"][0] == pytest.approx(0.4, abs=1e-3)
    assert not draft.summary.to_dict()["rest_lines"]


def test_a_signal_has_one_column_and_base_excludes_scale() -> None:
    mapping = RecordingMap("a", "a.csv", (SignalLine("P2", "output", "x", base=3.0), SignalLine("Pref2", "input", "x")))
    assert [line.column for line in mapping.assigned("y", "P2", "output").lines] == ["x", "y"]
    assert mapping.assigned("x", "", "input").lines == ()
    assert mapping.stated("P2", "scale", 2.0).lines[0].conversion == {"scale": 2.0}
    twice = replace(mapping, lines=(*mapping.lines, SignalLine("P2", "output", "y")))
    with pytest.raises(StudyError, match="two columns for 'P2'"):
        twice.table("study.toml")


def test_the_second_of_two_writers_is_told_and_nothing_is_lost(mapped: tuple[Path, RecordingMap]) -> None:
    file, mapping = mapped
    seen = write_mapping(Seen.now(file), mapping, "step", "vsc-hvdc-link")
    write_mapping(seen, replace(mapping, event=0.1), "step", "")
    first = file.read_text("utf-8")
    with pytest.raises(StudyError, match="changed by someone else"):
        write_mapping(seen, replace(mapping, role="holdout"), "step", "")
    assert file.read_text("utf-8") == first
    write_mapping(Seen.now(file), replace(mapping, name="other"), "other", "")
    assert [e.name for e in hi.load_study(file).experiments] == ["step", "other"]
    file.unlink()
    with pytest.raises(StudyError, match="removed"):
        write_study(seen, "schema = 1")


def test_of_many_writers_at_once_one_wins(tmp_path: Path) -> None:
    file = tmp_path / "study.toml"
    seen = Seen.now(file)
    won: list[int] = []

    def write(number: int) -> None:
        try:
            write_study(seen, f"number = {number}\n" * 1000)
            won.append(number)
        except StudyError:
            pass  # the others are told

    writers = [threading.Thread(target=write, args=(n,)) for n in range(8)]
    for w in writers:
        w.start()
    for w in writers:
        w.join()
    assert len(won) == 1 and file.read_text("utf-8") == f"number = {won[0]}\n" * 1000


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("../../x.csv", "x.csv"),
        ("..\\..\\x.csv", "x.csv"),
        ("/etc/passwd", "passwd"),
        ("C:\\Users\\me\\step up.csv", "step up.csv"),
        (".hidden.csv", "hidden.csv"),
        ("a\x00b\nc.csv", "a-b-c.csv"),
        ("Prüfung 1.csv", "Prüfung 1.csv"),
        ("x" * 300 + ".csv", "x" * 96 + ".csv"),
        ("--rf.csv", "rf.csv"),
    ],
)
def test_names_lead_nowhere(name: str, expected: str) -> None:
    assert safe_name(name) == expected


@pytest.mark.parametrize("name", ["", "..", "../..", "/", "a/", "."])
def test_names_of_nothing_are_refused(name: str) -> None:
    with pytest.raises(InputError, match="no usable name"):
        safe_name(name)


def test_nothing_outside_the_folder_is_chosen(tmp_path: Path) -> None:
    folder = tmp_path / "study"
    folder.mkdir()
    recording(tmp_path / "outside.csv")
    recording(folder / "inside.csv")
    (folder / "link.csv").symlink_to(tmp_path / "outside.csv")
    (folder / "s-results").mkdir()
    recording(folder / "s-results" / "simulated.csv")
    assert recordings_in(folder) == ["inside.csv", "link.csv"]
    assert chosen_recording(folder, "inside.csv") == folder / "inside.csv"
    for name in ("../outside.csv", "link.csv", str(tmp_path / "outside.csv")):
        with pytest.raises(InputError, match="outside the study's folder"):
            chosen_recording(folder, name)


def arrived(place: Path, *names: str, content: bytes = b"") -> Path:
    place.mkdir()
    for name in names:
        (place / name).write_bytes(content)
    return place


def test_a_broken_file_gives_the_readers_message_and_is_not_kept(tmp_path: Path) -> None:
    place = arrived(tmp_path / "in", "bad.mat", content=b"MATLAB 5.0 MAT-file" + bytes(200))
    with pytest.raises(InputError) as told:
        keep_recordings(tmp_path / "study", place)
    assert "bad.mat" in str(told.value) and str(tmp_path) not in str(told.value)
    assert not (tmp_path / "study").exists()


@pytest.mark.parametrize("name", sorted(formats()))
def test_every_format_is_kept_whole(name: str, tmp_path: Path) -> None:
    module = formats()[name]
    place = arrived(tmp_path / "in")
    SAMPLES[module.NAME](place / f"sample{module.SUFFIXES[0]}")
    expected = hi.read_waveforms(place / f"sample{module.SUFFIXES[0]}")
    (kept,), record = keep_recordings(tmp_path / "study", place)
    again = hi.read_waveforms(tmp_path / "study" / kept)
    assert record.names == again.names == expected.names
    np.testing.assert_array_equal(again.values, expected.values)


def test_another_file_of_the_same_name_goes_into_a_folder_of_its_own(tmp_path: Path) -> None:
    kept = []
    for number, factor in enumerate((1.0, 1.0, 2.0)):
        place = arrived(tmp_path / f"in{number}")
        recording(place / "step.csv", factor=factor)
        kept += keep_recordings(tmp_path / "study", place)[0]
    assert kept == ["step.csv", "step.csv", "step-2/step.csv"]


def test_a_recording_is_opened_with_a_study_to_be_made_beside_it(tmp_path: Path) -> None:
    desk = opened(str(recording(tmp_path / "step.csv")))
    assert desk.study is None and desk.recording == tmp_path / "step.csv"
    assert desk.file == tmp_path / "step-study" / "study.toml" and not desk.file.parent.exists()
    mapping = proposed(hi.read_waveforms(tmp_path / "step.csv"), desk.model, "step", "../step.csv")[0]
    write_mapping(Seen.now(desk.file), mapping, "step", desk.source)
    found = desk.renewed()
    assert found.study is not None and found.study.experiments[0].outputs == ("P2",)
    assert found.renewed() is found
    desk.file.write_text("schema = 1\n[model", "utf-8")
    broken = found.renewed()
    assert broken.study is found.study and "the study file is not valid TOML" in broken.why
    assert opened(str(tmp_path / "step.csv")).file == tmp_path / "step-study-2" / "study.toml"


def three_phases(path: Path) -> Path:
    """A voltage of 400 kV that falls to 80 % at 0.3 s, and the currents of 100 MW that follow with 50 ms: six columns of waves."""
    time = np.arange(0.0, 1.0, 1e-3)
    voltage = np.where(time >= 0.3, 0.8, 1.0) * 400.0 * np.sqrt(2.0 / 3.0)
    power = np.where(time >= 0.3, 0.8 + 0.2 * np.exp(-(time - 0.3) / 0.05), 1.0) * 1e5
    waves = [np.cos(2 * np.pi * 50 * time - 2 * np.pi * k / 3) for k in range(3)]
    sizes = (
        ((f"U{p} [kV]", voltage * w) for p, w in zip("ABC", waves, strict=True)),
        ((f"I{p} [A]", power / (1.5 * voltage) * w) for p, w in zip("ABC", waves, strict=True)),
    )
    columns = {"time [s]": time, **dict(sizes[0]), **dict(sizes[1])}
    np.savetxt(path, np.column_stack([*columns.values()]), delimiter=",", header=",".join(columns), comments="")
    return path


THREE = """schema = 1
name = "m"
[parameters]
T = {value = 0.05, unit = "s", min = 0.01, max = 1}
[inputs]
V = {value = 400, unit = "kV"}
[states]
x = {derivative = "(V/400 - x)/T", unit = "pu"}
[outputs]
P = {value = "100e6*x", unit = "W"}
"""


def test_three_phases_are_proposed_as_a_new_study_proposes_them(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(THREE)
    data = three_phases(tmp_path / "r.csv")
    model, record = hi.load_model(tmp_path / "c.toml"), hi.read_waveforms(data)
    mapping, matching = proposed(record, model, "r", "r.csv")
    by_new = hi.new_study(tmp_path / "new", data, tmp_path / "c.toml").to_dict()["experiments"]["r"]
    assert mapping.kept["phases"] == by_new["phases"] and {line.signal: line.column for line in mapping.lines} == {
        "P": "p"
    }
    assert {"v", "v-rms"} <= {m.column.name for m in matching.proposed} == {p["column"] for p in by_new["proposed"]}
    mapping = mapping.assigned("v-rms", "V", "input")
    shown = columns_with_derived(mapping, record, "study.toml")
    assert {"p", "v-rms", "UA"} <= set(shown.names) and "p" not in record
    draft = drafted(mapping, record, model, None, "", "study.toml")
    assert draft.experiment.measured["P"][0] == pytest.approx(1e8, rel=1e-2)
    assert draft.experiment.event == pytest.approx(0.3, abs=0.025)  # a cycle
    file = tmp_path / "study.toml"
    write_mapping(Seen.now(file), mapping, "r", str(tmp_path / "c.toml"))
    (read,) = hi.load_study(file).experiments
    np.testing.assert_array_equal(read.measured["P"], draft.experiment.measured["P"])
    assert set(read.inputs) == {"V"}


def test_three_phases_of_one_more_experiment_are_written_too(mapped: tuple[Path, RecordingMap], tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text(THREE)
    record = hi.read_waveforms(three_phases(tmp_path / "r.csv"))
    first = proposed(record, hi.load_model(tmp_path / "c.toml"), "r", "r.csv")[0]
    file = tmp_path / "study.toml"
    seen = write_mapping(Seen.now(file), first, "r", str(tmp_path / "c.toml"))
    write_mapping(seen, replace(first, name="again"), "", "")
    assert [e.name for e in hi.load_study(file).experiments] == ["r", "again"]
    tables = parse_study(file.read_bytes(), file).experiment
    assert tables[0].phases == tables[1].phases != []
