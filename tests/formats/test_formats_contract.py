"""Every format found in the folder keeps the same promises."""

from __future__ import annotations

import re
import tomllib
import zipfile
from collections.abc import Sequence
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from hvdc_ident.data import Trajectory
from hvdc_ident.errors import UnknownNameError, WaveformError
from hvdc_ident.formats import Format, convert, formats, list_signals, read_waveforms
from tests.formats.samples import SAMPLES

FORMATS = list(formats().items())


@pytest.fixture(params=[module for _, module in FORMATS], ids=[name for name, _ in FORMATS])
def module(request: pytest.FixtureRequest) -> Format:
    return request.param


@pytest.fixture
def sample(module: Format, tmp_path: Path) -> Path:
    path = tmp_path / f"sample{module.SUFFIXES[0]}"
    assert module.NAME in SAMPLES, (
        f"no sample of format {module.NAME}: tests/formats/samples.py needs a function that writes one"
    )
    SAMPLES[module.NAME](path)
    return path


def test_a_plain_installation_reads_every_format_but_parquet() -> None:
    """What a reader imports late is a dependency, and the extra `formats` has what is left."""
    root = Path(__file__).resolve().parents[2]
    project = tomllib.loads((root / "pyproject.toml").read_text("utf-8"))["project"]
    late = {
        name
        for file in (root / "hvdc_ident" / "formats").glob("*.py")
        for name in re.findall(r'package\("(\w+)', file.read_text("utf-8"))
    }
    plain, extra = (
        {re.split(r"[<>=]", d)[0] for d in listed}
        for listed in (project["dependencies"], project["optional-dependencies"]["formats"])
    )
    assert {"comtrade", "h5py"} <= plain and late - plain == extra == {"pyarrow"}


def test_there_are_formats() -> None:
    assert {"csv", "dymola-mat"} <= set(formats())


def test_describes_itself(module: Format) -> None:
    assert module.NAME.strip().lower() == module.NAME
    assert module.SUMMARY
    assert "\n" not in module.SUMMARY
    assert all(suffix.startswith(".") and suffix == suffix.lower() for suffix in module.SUFFIXES)


def test_only_this_format_recognises_its_sample(module: Format, sample: Path) -> None:
    top = sample.read_bytes()
    others = [(name, other) for name, other in FORMATS if other is module or not getattr(other, "LAST", False)]
    assert [name for name, other in others if other.recognises(sample, top)] == [module.NAME]


def test_the_reader_of_any_text_is_asked_last(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def read(path: Path, signals: Sequence[str] | None = None) -> Trajectory:
        return Trajectory(np.array([0.0, 1.0]), np.array([[2.0], [3.0]]), ("own",))

    def recognises(path: Path, top: bytes) -> bool:
        return top.startswith(b"Recorder:")

    other = SimpleNamespace(
        NAME="other", SUMMARY="text of a recorder", SUFFIXES=(".txt",), recognises=recognises, read=read
    )
    catalogue = (("csv", formats()["csv"]), ("other", other))
    monkeypatch.setattr("hvdc_ident.formats._catalogue", lambda: catalogue)
    for text, names in (("Recorder: R1\nt,y\n0,1\n1,2\n", ("own",)), ("t,y\n0,1\n1,2\n", ("y",))):
        (tmp_path / "r.txt").write_text(text)
        assert read_waveforms(tmp_path / "r.txt").names == names


def test_reads_its_sample(module: Format, sample: Path) -> None:
    found = read_waveforms(sample)
    assert len(found) >= 2
    assert len(found.names) >= 1
    assert np.isfinite(found.values).all()
    assert (np.diff(found.time) >= 0).all()
    assert list_signals(sample) == list(zip(found.names, found.units, strict=True))


def test_reads_a_selection_in_its_order(sample: Path) -> None:
    whole = read_waveforms(sample)
    wanted = whole.names[::-1]
    found = read_waveforms(sample, wanted)
    assert found.names == wanted
    assert np.array_equal(found.values, whole.values[:, ::-1])
    assert found.units == whole.units[::-1]
    one = read_waveforms(sample, [wanted[0]])
    assert np.array_equal(one.values[:, 0], whole[wanted[0]])
    assert read_waveforms(sample, wanted[0]).names == (wanted[0],)


def test_an_unknown_signal_is_refused_with_the_near_ones(sample: Path) -> None:
    name = read_waveforms(sample).names[0]
    with pytest.raises(UnknownNameError, match=r"did you mean|expected one of"):
        read_waveforms(sample, [name + "x"])


def test_converts_to_csv_and_back(sample: Path, tmp_path: Path) -> None:
    found = convert(sample, tmp_path / "out.csv")
    back = read_waveforms(tmp_path / "out.csv")
    assert np.array_equal(back.time, found.time)
    assert np.array_equal(back.values, found.values)
    assert back.names == found.names
    assert [p.name for p in tmp_path.glob("*.part")] + [p.name for p in tmp_path.glob(".*")] == []


def test_a_sample_cut_off_is_refused_or_shorter(sample: Path) -> None:
    whole = sample.read_bytes()
    for share in (0.05, 0.3, 0.5, 0.8, 0.95):
        sample.write_bytes(whole[: int(share * len(whole))])
        try:
            found = read_waveforms(sample)
        except WaveformError as error:
            assert str(sample) in str(error)
        else:
            assert np.isfinite(found.values).all()


def test_a_spreadsheet_is_called_one_and_not_searched_for_columns(tmp_path: Path) -> None:
    path = tmp_path / "record.xlsx"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("xl/workbook.xml", "<workbook/>")
    with pytest.raises(
        WaveformError, match=r"record.xlsx: a spreadsheet.*CSV.*got '.xlsx'. Try: save the sheet as CSV"
    ):
        read_waveforms(path)


def test_recognises_nothing_in_noise(module: Format, tmp_path: Path) -> None:
    path = tmp_path / f"noise{module.SUFFIXES[0]}"
    path.write_bytes(np.random.default_rng(0).integers(0, 256, 4000, dtype=np.uint8).tobytes())
    assert not module.recognises(path, path.read_bytes())
    with pytest.raises(WaveformError):
        read_waveforms(path)
