"""Times in text columns: numbers with more digits than a double, and dates with the month as a word."""

from __future__ import annotations

import datetime
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import csv_text, read_waveforms


def put(folder: Path, text: str) -> Path:
    (folder / "x.csv").write_text(text, "utf-8")
    return folder / "x.csv"


@pytest.mark.parametrize(
    "date",
    [
        "27/Nov/2026:10:00:{:02d}",
        "Fri Nov 27 10:00:{:02d} 2026",
        "20261127 1000{:02d}",
        "27-11-2026 10.00.{:02d}",
        "2026-331 10:00:{:02d}",
    ],
)
def test_a_date_in_another_form_is_called_one_with_the_forms_that_are_read(tmp_path: Path, date: str) -> None:
    rows = "".join(f"{date.format(k)};{k}\n" for k in range(30))
    with pytest.raises(WaveformError) as caught:
        read_waveforms(put(tmp_path, f"time;y\n{rows}"))
    said = str(caught.value)
    assert "x.csv, line 2, column 1 ('time'): the time is a date in no known form; expected as in 2026-11-21" in said
    assert f"got '{date.format(0)}'" in said and "Try: write the dates as year-month-day" in said


def test_a_word_among_times_is_no_date(tmp_path: Path) -> None:
    rows = "".join(f"{k};{k}\n" for k in range(30))
    with pytest.raises(WaveformError, match=r"line 32.*text where a number belongs.*got 'end'"):
        read_waveforms(put(tmp_path, f"time;y\n{rows}end;3\n"))


COUNTS = [1_689_000_000_123_456_789 + k * 137 for k in range(40)]
"""Nanoseconds since 1970, 137 ns apart: 256 ns are the spacing of doubles there."""


@pytest.mark.parametrize(
    ("label", "separator", "cell"),
    [
        ("timestamp", ",", lambda n: f"{n}"),
        ("timestamp [ns]", ",", lambda n: f"{n}"),
        ("timestamp [us]", ",", lambda n: f"{n // 1000}.{n % 1000:03d}"),
        ("timestamp", ";", lambda n: f"{n // 10**9},{n % 10**9:09d}"),
        ("Time [s]", "\t", lambda n: f'"{n // 10**9}.{n % 10**9:09d}"'),
        ("time", " ", lambda n: f"{n // 10**6}.{n % 10**6:06d}"),
        ("time [s]", ",", lambda n: f'"{n // 10**9},{n % 10**9:09d}"'),
    ],
)
@pytest.mark.parametrize("last", ["0", "n/a"])  # with a gap the careful reader reads
def test_times_since_1970_keep_all_their_digits(
    tmp_path: Path, label: str, separator: str, cell: object, last: str
) -> None:
    cells = [cell(n) for n in COUNTS]  # type: ignore[operator]
    text = "".join(f"{c}{separator}{k if k else last}\n" for k, c in enumerate(cells))
    found = read_waveforms(put(tmp_path, f"{label}{separator}u\n{text}"))
    exact = [float(Fraction(n - COUNTS[0], 10**9)) for n in COUNTS]
    np.testing.assert_allclose(found.time, exact, rtol=1e-14)
    assert found.origin.time_unit == "date"


def test_both_readers_take_off_the_same(tmp_path: Path) -> None:
    layout = csv_text._layout(put(tmp_path, "timestamp,u\n" + "".join(f"{n},1\n" for n in COUNTS)))
    quick = csv_text._fast(layout, [0, 1])
    assert quick is not None
    np.testing.assert_array_equal(quick, csv_text._careful(layout, [0, 1]))
    np.testing.assert_array_equal(quick[:, 0], [n - COUNTS[0] for n in COUNTS])


FIRST = datetime.datetime(2023, 12, 31, 23, 59, 59, 960_000)
STEPS = [datetime.timedelta(milliseconds=20 * k) for k in range(5)]
MONTHS = {
    "English": ("Dec", "Jan"),
    "German": ("Dez.", "Jän."),
    "French": ("déc.", "janv."),
    "Italian": ("dic", "gen"),
    "Spanish": ("dic", "ene"),
    "Portuguese": ("dez", "jan"),
    "in full": ("December", "January"),
}


@pytest.mark.parametrize(
    "form", ["{d}-{m}-{y} {t}", "{d} {m} {y} {t}", "{d}/{m}/{y} {t}", "{m} {d} {y} {t}", "{d}-{m}-{s} {t}"]
)
@pytest.mark.parametrize("months", MONTHS.values(), ids=MONTHS)
def test_dates_with_the_month_as_a_word(tmp_path: Path, form: str, months: tuple[str, str]) -> None:
    rows = []
    for k, step in enumerate(STEPS):
        at = FIRST + step
        date = form.format(
            d=f"{at.day:02d}",
            m=months[at.month == 1],
            y=at.year,
            s=at.year % 100,
            t=f"{at:%H:%M:%S}.{at.microsecond // 1000:03d}",
        )
        rows.append(f"{date},{'n. def.' if k == 0 else k},{'Non un numero reale' if k == 2 else 1}\n")
    found = read_waveforms(put(tmp_path, "Timestamp,V [kV],F\n" + "".join(rows)))
    np.testing.assert_allclose(found.time, [step.total_seconds() for step in STEPS], rtol=1e-12)
    assert found.gaps("V") == 1 and found.gaps("F") == 1 and found.origin.time_unit == "date"


@pytest.mark.parametrize("month", range(1, 13))
def test_every_month_by_its_english_name(tmp_path: Path, month: int) -> None:
    day = datetime.date(2024, month, 9)
    name = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")[month - 1]
    found = read_waveforms(put(tmp_path, f"t,u\n01-Jan-2024 00:00:00,1\n09-{name}-2024 00:00:00,2\n"))
    assert found.time[1] == (day - datetime.date(2024, 1, 1)).days * 86400.0


def test_a_date_of_words_in_a_column_of_its_own(tmp_path: Path) -> None:
    found = read_waveforms(put(tmp_path, "Date;Time;u\n29-Feb-2024;23:59:59,5;1\n01-Mar-2024;00:00:00,25;2\n"))
    assert found.time.tolist() == [0.0, 0.75] and found.names == ("u",)


@pytest.mark.parametrize("date", ["03-xyz-2016 03:54:22.400", "2016y5m3 03:54:22.400"])
def test_a_date_in_no_known_form_is_refused_as_a_date(tmp_path: Path, date: str) -> None:
    with pytest.raises(WaveformError, match=r"date|month") as said:
        read_waveforms(put(tmp_path, f"Timestamp,V\n{date},1\n{date},2\n"))
    assert "21-Nov-2026 10:15:00" in said.value.expected and "line 2, column 1" in said.value.where
    assert "take out the row" not in str(said.value)
