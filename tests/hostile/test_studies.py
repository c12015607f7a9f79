"""Every wrong study or recording: exit code 2, one message with what, where and what was expected, nothing written."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.errors import InputError
from hvdc_ident.study.study import load_study

GOOD = """\
schema = 1
name = "b"
[model]
source = "vsc-hvdc-link"
[parameters]
KIP = {start = 25, min = 5, max = 50}
[[experiment]]
name = "d"
data = "d.csv"
inputs = ["Pref2"]
outputs = ["Irorder2"]
"""
HEADER = "time,Pref2,Irorder2"
ROWS = [
    f"{0.005 * k:.3f},{0.4 if k < 20 else 0.5},{0.4 if k < 20 else 0.5 - 0.1 * 0.86 ** (k - 20):.9f}"
    for k in range(100)
]


@dataclass(frozen=True)
class Case:
    """study and data: how the good ones are spoilt; said: what the message must hold."""

    said: tuple[str, ...]
    study: Callable[[str], str | bytes] = lambda s: s
    data: Callable[[list[str]], str | bytes | None] = lambda rows: "\n".join([HEADER, *rows]) + "\n"


def _replace(old: str, new: str) -> Callable[[str], str]:
    def spoilt(study: str) -> str:
        assert old in study
        return study.replace(old, new)

    return spoilt


def _append(text: str) -> Callable[[str], str]:
    return lambda study: study + text


def _row(number: int, text: str) -> Callable[[list[str]], str]:
    return lambda rows: "\n".join([HEADER, *rows[:number], text, *rows[number + 1 :]]) + "\n"


CASES = {
    "unknown table": Case(("parametres", "did you mean 'parameters'"), _replace("[parameters]", "[parametres]")),
    "unknown key in a table": Case(("mn", "parameters.KIP", "min"), _replace("min = 5", "mn = 5")),
    "unknown key in an experiment": Case(
        ("wndow", "experiment 'd'", "did you mean 'window'"), _append("wndow = [0, 1]\n")
    ),
    "missing schema": Case(("schema",), _replace("schema = 1\n", "")),
    "another schema": Case(("schema", "expected schema = 1, got 2"), _replace("schema = 1", "schema = 2")),
    "missing model": Case(("'model' is missing",), _replace('[model]\nsource = "vsc-hvdc-link"\n', "")),
    "unknown model": Case(("vsc-hvdc-lnk", "did you mean 'vsc-hvdc-link'"), _replace("hvdc-link", "hvdc-lnk")),
    "missing model file": Case(("no model file 'm.toml'", "model.source"), _replace("vsc-hvdc-link", "m.toml")),
    "untrusted python": Case(("m.py", "model.source"), _replace("vsc-hvdc-link", "m.py")),
    "unknown parameterisation": Case(("gians",), _replace("[parameters]", 'parameterisation = "gians"\n[parameters]')),
    "unknown effect": Case(
        ("lagg",), _replace("[parameters]", '[[model.effect]]\neffect = "lagg"\nat = ["Ir1"]\n[parameters]')
    ),
    "unknown slot": Case(
        ("Ir9",), _replace("[parameters]", '[[model.effect]]\neffect = "lag"\nat = ["Ir9"]\n[parameters]')
    ),
    "unknown model value": Case(
        ("KIPP", "model.values"), _replace("[parameters]", "[model.values]\nKIPP = 3\n[parameters]")
    ),
    "value outside its bounds": Case(
        ("KIP", "bounds"), _replace("[parameters]", "[model.values]\nKIP = -3\n[parameters]")
    ),
    "unknown parameter": Case(("no parameter 'KIPP'", "'KIP'"), _replace("KIP =", "KIPP =")),
    "an input as parameter": Case(("'Pref2' is an input", "values"), _replace("KIP =", "Pref2 =")),
    "bounds that miss the start": Case(
        ("KIP", "min is not below max: min = 60, max = 50"), _replace("min = 5", "min = 60")
    ),
    "bounds beyond the model's": Case(("parameters.KIP", "the model's own"), _replace("min = 5", "min = -5")),
    "infinite start": Case(("parameters.KIP.start", "finite number", "inf"), _replace("start = 25", "start = inf")),
    "text as number": Case(("parameters.KIP.start", "a number"), _replace("start = 25", 'start = "25"')),
    "true as number": Case(("parameters.KIP.start", "a number", "true"), _replace("start = 25", "start = true")),
    "unknown output": Case(("no output 'Irorder9'", "experiment 'd'"), _replace('["Irorder2"]', '["Irorder9"]')),
    "unknown input": Case(("no input 'Pref9'", "'Pref2'"), _replace('["Pref2"]', '["Pref9"]')),
    "unknown column": Case(
        ("no signal 'P2 order'", "experiment 'd'"), _replace('["Irorder2"]', '{Irorder2 = "P2 order"}')
    ),
    "no outputs": Case(("experiment 'd'.outputs", "at least one"), _replace('["Irorder2"]', "[]")),
    "unknown noise": Case(("Irorder1", "noise"), _append("noise = {Irorder1 = 1e-4}\n")),
    "negative noise": Case(("noise.Irorder2", "at least 0"), _append("noise = {Irorder2 = -1e-4}\n")),
    "window the wrong way": Case(("window", "end"), _append("window = [0.4, 0.1]\n")),
    "window beside the data": Case(("window", "0 to 0.495 s"), _append("window = [4, 5]\n")),
    "event beside the data": Case(("event", "0 to 0.495 s", "got 7 s"), _append("event = 7\n")),
    "unknown role": Case(("role", "'fit', 'holdout'"), _append('role = "test"\n')),
    "unknown nuisance": Case(("nuisance", "time-shift"), _append('nuisance = ["time-shft"]\n')),
    "parameter among input values": Case(("values", "[model.values]"), _append("values = {KIP = 3}\n")),
    "input held and recorded": Case(("'Pref2'", "inputs and in values"), _append("values = {Pref2 = 0.4}\n")),
    "unknown driven slot": Case(("no insertion point 'Vacc1'",), _append('drive = {Vacc1 = "Pref2"}\n')),
    "unknown interpolation": Case(("interpolation", "'hold', 'linear'"), _append('interpolation = "spline"\n')),
    "wrong unit": Case(("kA", "'pu'", "scale"), _append('columns = {Irorder2 = {unit = "kA"}}\n')),
    "scale of nothing": Case(("scale of 0",), _append("columns = {Irorder2 = {scale = 0}}\n")),
    "two experiments of a name": Case(("two experiments",), lambda s: s + s[s.index("[[exp") :]),
    "name that leaves the folder": Case(("files are named after it",), _replace('"d"', '"../d"')),
    "unknown optimiser": Case(("optimiser 'trust'", "trust-region"), _append('[fit]\noptimiser = "trust"\n')),
    "individual without groups": Case(("groups",), _append('[fit]\nmode = "individual"\n')),
    "a tied parameter swept": Case(
        ("'KIQ' follows other parameters", "tie = 'KIP'", "sweep"),
        lambda s: s.replace("[[exp", 'KIQ = {tie = "KIP"}\n[[exp') + '[[sweep]]\nparameter = "KIQ"\nvalues = [3.0]\n',
    ),
    "a group of what each experiment has for itself": Case(
        ("'KPP' has a value in each experiment", "per-experiment = true", "fit.groups number 1"),
        lambda s: (
            s.replace("[[exp", "KPP = {start = 1.5, per-experiment = true}\n[[exp")
            + '[fit]\nmode = "individual"\ngroups = [{parameters = ["KPP"]}]\n'
        ),
    ),
    "not toml": Case(("TOML", "line"), _append("\n[[[")),
    "a Windows path in double quotes": Case(
        ("line 9", "\\ begins an escape sequence", 'got data = "C:\\Users', '"C:/Users/me/d.csv"', "single quotes"),
        _replace('"d.csv"', r'"C:\Users\me\d.csv"'),
    ),
    "a Windows path whose escapes are valid": Case(
        ("experiment 'd'.data", r'got "C:\temp\new.csv"', "single quotes or with /"),
        _replace('"d.csv"', r'"C:\temp\new.csv"'),
    ),
    "text without quotes": Case(('got role = fit. Try: text in quotes: "fit"',), _append("role = fit\n")),
    "a decimal comma": Case(
        ("got noise = {Irorder2 = 0,001}", "Try: a decimal point: 0.001"), _append("noise = {Irorder2 = 0,001}\n")
    ),
    "bounds in place of a table": Case(
        ("parameters.KPQ", "expected a table: {start = ..., min = ..., max = ...}", "Try: {min = 0.5, max = 5}"),
        _replace("[[exp", "KPQ = [0.5, 5]\n[[exp"),
    ),
    "a number in place of a table": Case(
        ("parameters.KPQ", "got 2.0. Try: {start = 2.0}"), _replace("[[exp", "KPQ = 2.0\n[[exp")
    ),
    "an input that nobody knows": Case(
        ("inputs.settable", "no input 'Pref9'", "'Pref2'"),
        _replace("[parameters]", '[inputs]\nsettable = "Pref9"\n[parameters]'),
    ),
    "a date without quotes": Case(('Try: text in quotes: "25.11.2026"',), _append("[letter]\ndate = 25.11.2026\n")),
    "a time of day for a number": Case(
        ("experiment 'd'.event", "expected a number, got 10:00:01", "s, as the time in the data"),
        _append("event = 10:00:01\n"),
    ),
    "a range the wrong way": Case(
        ("sweep number 1", "max is not above min", "Try: min = 1, max = 2"),
        _append('[[sweep]]\nparameter = "KIP"\nmin = 2\nmax = 1\npoints = 3\n'),
    ),
    "lmfit's word for a start": Case(
        ("parameters.KIP: unknown key 'value'", "start = ... for where the search begins"),
        _replace("start = 25", "value = 25"),
    ),
    "a given value below the bounds": Case(
        ("parameters.KIP", "begins at the given value, below min = 5", "got 4", "start = ..."),
        _replace("start = 25", "given = 4"),
    ),
    "toml nested for ever": Case(("TOML",), _append("x = " + "[" * 5000)),
    "study not text": Case(("UTF-8",), lambda s: s.encode() + b"\xff\xfe\x00"),
    "study too large": Case(("too large",), lambda s: s + "#" * 1_100_000),
    "missing file": Case(("no such file", "e.csv", "experiment 'd'"), _replace("d.csv", "e.csv")),
    "folder as file": Case(("folder",), _replace("d.csv", ".")),
    "empty file": Case(("d.csv", "empty"), data=lambda rows: ""),
    "header alone": Case(("d.csv",), data=lambda rows: HEADER + "\n"),
    "binary file": Case(("d.csv",), data=lambda rows: b"\x00\x01\x02" * 50),
    "nan in an input": Case(("d.csv", "'Pref2' is not recorded in 1 of"), data=_row(9, "0.045,nan,0.4")),
    "no number in an input": Case(
        ("d.csv", "'Pref2' is not recorded in any row"),
        data=lambda rows: "\n".join([HEADER, *(f"{r.split(',')[0]},nan,0.4" for r in rows)]) + "\n",
    ),
    "nan in a time": Case(("d.csv", "not finite"), data=_row(9, "nan,0.4,0.4")),
    "text in numbers": Case(("d.csv", "abc"), data=_row(9, "0.045,abc,0.4")),
    "ragged": Case(("d.csv",), data=_row(9, "0.045,0.4")),
    "unsorted": Case(("d.csv", "time"), data=_row(9, "0.001,0.4,0.4")),
    "no steady state": Case(
        ("steady",),
        lambda s: (
            s[: s.index("[model]")]
            + '[model]\nsource = "drift.toml"\n[parameters]\nk = {start = 1, min = 0.5, max = 2}\n'
            + '[[experiment]]\nname = "d"\ndata = "d.csv"\ninputs = {u = "Pref2"}\noutputs = {y = "Irorder2"}\n'
        ),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_a_bad_study_is_answered_with_one_message_and_leaves_nothing(name: str, tmp_path: Path) -> None:
    case = CASES[name]
    study, data = case.study(GOOD), case.data(ROWS)
    (tmp_path / "s.toml").write_bytes(study if isinstance(study, bytes) else study.encode())
    if data is not None:
        (tmp_path / "d.csv").write_bytes(data if isinstance(data, bytes) else data.encode())
    (tmp_path / "m.py").write_text("raise SystemExit('this code must not run')\n")
    (tmp_path / "drift.toml").write_text(
        'schema = 1\nname = "drift"\n[parameters]\nk = {value = 1.0}\n[inputs]\nu = {value = 0}\n'
        '[states]\nx = {derivative = "k"}\n[outputs]\ny = "x + u"\n'
    )
    before = sorted(p.name for p in tmp_path.iterdir())
    result = CliRunner().invoke(app, ["fit", str(tmp_path / "s.toml"), "--out", str(tmp_path / "r"), "--quiet"])
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    assert result.stdout == ""
    lines = [s for s in result.stderr.strip().splitlines() if not s.startswith("hvdc_ident: compiling")]  # once, ever
    message = "\n".join(lines)
    assert len(message.splitlines()) == 1 and message.startswith("error: "), message
    assert len(message) < 900
    for words in case.said:
        assert words in message, message
    assert sorted(p.name for p in tmp_path.iterdir()) == before


def test_the_good_study_is_good(tmp_path: Path) -> None:
    (tmp_path / "s.toml").write_text(GOOD)
    (tmp_path / "d.csv").write_text("\n".join([HEADER, *ROWS]) + "\n")
    study = load_study(tmp_path / "s.toml")
    assert [e.name for e in study.experiments] == ["d"]


def test_a_missing_study_and_a_folder_are_input_errors(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such study file"):
        load_study(tmp_path / "none.toml")
    with pytest.raises(InputError, match="a folder is no study"):
        load_study(tmp_path)
