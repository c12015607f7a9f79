"""What stages write: whole files, every digit, forms other tools read."""

from __future__ import annotations

import json
import math
import os
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.errors import InputError
from hvdc_ident.files import csv_text, json_text, write_text
from hvdc_ident.fit import Estimate
from hvdc_ident.study.examples import write_demo
from hvdc_ident.study.export import SSV, ssv
from hvdc_ident.study.study import load_study
from hvdc_ident.study.value_files import values_csv


def test_json_keeps_every_digit_and_has_no_infinity() -> None:
    value = 0.1 + 0.2
    text = json_text(
        {"a": value, "b": math.inf, "c": np.array([1.5, math.nan]), "d": 2 + 1j, "e": np.int64(3), "f": (Path("x/y"),)}
    )
    assert json.loads(text) == {"a": value, "b": None, "c": [1.5, None], "d": [2.0, 1.0], "e": 3, "f": ["x/y"]}
    with pytest.raises(TypeError, match="object has no JSON form"):
        json_text({"a": object()})


def test_a_write_that_fails_leaves_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_text(tmp_path / "deep" / "a.json", "old")

    def full(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match="no space left on device"):
        write_text(path, "new")
    assert path.read_text() == "old" and list(path.parent.iterdir()) == [path]


def test_ssv_is_xml_with_every_digit() -> None:
    root = ET.fromstring(ssv({"K<1>": 0.1 + 0.2}, 'a "study"').encode())
    (parameter,) = root.iter(f"{{{SSV}}}Parameter")
    assert parameter.get("name") == "K<1>" and root.get("name") == 'a "study"'
    assert float(parameter[0].get("value", "")) == 0.1 + 0.2


def test_tables_quote_names_and_leave_nothing_for_none() -> None:
    assert csv_text(["a,b", "c"], [[0.1 + 0.2, None]]) == '"a,b",c\n0.30000000000000004,\n'
    text = values_csv({"K": 2.0}, {"K": "pu"}, {"K": Estimate(2.0, 0.5, (1.0, None))}, {})
    assert text.splitlines()[1] == "K,2.0,pu,0.5,1.0,,,fit"


def test_the_demo_is_the_same_for_a_seed_and_holds_together(tmp_path: Path) -> None:
    first, second, third = (write_demo(tmp_path / n, seed=s) for n, s in (("a", 0), ("b", 0), ("c", 1)))
    assert (first.parent / "p-01-step.csv").read_bytes() == (second.parent / "p-01-step.csv").read_bytes()
    assert (first.parent / "p-01-step.csv").read_bytes() != (third.parent / "p-01-step.csv").read_bytes()
    tomllib.loads(first.read_text())
    study = load_study(first)
    assert list(study.candidates) == ["KIP", "KIQ", "KPVDC", "KIVDC"] and len(study.experiments) == 9
    for notes in study.noise.values():
        assert all(n.source == "given" and n.std == 1e-4 for n in notes.values())
