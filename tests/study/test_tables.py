"""Tables are read by people with spreadsheets: a name or unit from somebody else's file is never a formula there."""

from __future__ import annotations

import csv
import io

import numpy as np

from hvdc_ident.files import csv_text
from hvdc_ident.fit import Estimate
from hvdc_ident.study.value_files import values_csv
from hvdc_ident.summary import Results


def test_no_cell_of_the_fitted_values_is_a_formula():
    text = values_csv(
        {"k": -2.5, "=k": 1.0},
        {"k": "=HYPERLINK(1)", "=k": "@SUM(A1)"},
        {"k": Estimate(-2.5, 0.5, (-3.5, -1.5))},
        {"=k": "-1 is\nheld"},
    )
    rows = list(csv.reader(io.StringIO(text)))
    assert rows[1] == ["k", "-2.5", "'=HYPERLINK(1)", "0.5", "-3.5", "-1.5", "", "fit"]  # numbers stay numbers
    assert rows[2] == ["'=k", "1.0", "'@SUM(A1)", "", "", "", "'-1 is held", "fit"]


def test_the_report_finds_a_column_by_its_own_name(tmp_path):
    (tmp_path / "t.csv").write_text(csv_text(["time", "=y", "-z"], [[0.0, 1.0, 2.0], [1.0, 3.0, 4.0]]))
    table = Results(tmp_path).table("t.csv")
    assert table is not None and table.names == ("=y", "-z")
    assert np.array_equal(table.values, [[1.0, 2.0], [3.0, 4.0]])
