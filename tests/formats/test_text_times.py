"""Times in text columns: numbers with more digits than a double, and dates with the month as a word."""

from __future__ import annotations

import datetime
import re
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident.errors import WaveformError
from hvdc_ident.formats import csv_text, read_waveforms
from hvdc_ident.formats._clock import Clock


def put(folder: Path, text: str) -> Path:
    (folder / "x.csv").write_text(text, "utf-8")
    return folder / "x.csv"


@pytest.mark.parametrize(
    "date",
    [
        "27/Nov/2026:10:00:{:02d}",
        "Fri Nov 27 10:00:{:02d} 2026",
        "20261127 1000{:02d}",
        "27-11-2026 10h00m{:02d}",
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
    np.testing.assert_array_equal(quick, csv_text._careful(layout, [0, 1], Clock()))
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


LANGUAGES = [
    "en",
    "de",
    "de_AT",
    "fr",
    "es",
    "es_MX",
    "it",
    "pt",
    "pt_BR",
    "nl",
    "pl",
    "sv",
    "da",
    "nb",
    "nn",
    "fi",
    "ru",
]


@pytest.mark.parametrize("language", LANGUAGES)
def test_every_month_by_every_name_that_cldr_has_for_it(tmp_path: Path, language: str) -> None:
    names = pytest.importorskip("babel").Locale.parse(language).months
    table = {(m, word) for use in names.values() for width in ("abbreviated", "wide") for m, word in use[width].items()}
    assert len(table) >= 12
    for month, word in table:
        path = put(tmp_path, f"t;u\n01-01-2024 00:00:00;1\n9 {word} 2024 00:00:00;2\n")
        days = (datetime.date(2024, month, 9) - datetime.date(2024, 1, 1)).days
        assert read_waveforms(path).time[1] == days * 86400.0, (language, month, word)


NOON = datetime.datetime(2016, 5, 3, 12, 34, 56, 780_000)
FORMS = {
    "ISO with a zone in hours": "2016-05-03T12:34:56.780+02",
    "Spanish": "3 de mayo de 2016 12:34:56,780",
    "Spanish afternoon": "3-may-2016 00:34:56.780 p. m.",
    "Russian": "3 мая 2016 г., 12:34:56.780",
    "Finnish": "3. toukokuuta 2016 klo 12.34.56,780",
    "Danish": "3. maj 2016 12.34.56,780",
    "Chinese": "2016年5月3日 12:34:56.780",
    "Chinese in words": "2016年5月3日 下午0时34分56.780秒",
    "Japanese": "2016年5月3日 12時34分56.780秒",
    "Chinese afternoon": "2016/5/3 下午 0:34:56.780",
    "milliseconds behind a colon": "2016-05-03 12:34:56:780",
    "year first": "2016-May-03 12:34:56.780",
}


@pytest.mark.parametrize("cell", FORMS.values(), ids=FORMS)
def test_dates_as_the_settings_of_a_country_write_them(tmp_path: Path, cell: str) -> None:
    first, sign = NOON - datetime.timedelta(hours=3), "+02:00" if "+" in cell else ""
    found = read_waveforms(put(tmp_path, f"t;u\n{first:%Y-%m-%d %H:%M:%S.%f}{sign};1\n{cell};2\n"))
    assert found.time[1] == 10800.0 and not found.origin.notes
    alone = read_waveforms(put(tmp_path, f"t;u\n{cell};1\n{cell};2\n"))  # the first row tells how times are written
    assert alone.time.tolist() == [0.0, 0.0] and alone.origin.time_unit == "date"


def test_dates_without_seconds(tmp_path: Path) -> None:
    found = read_waveforms(put(tmp_path, "Datum;u\n03.05.2016 23:59;1\n04.05.2016 00:00;2\n04.05.2016 00:01;2\n"))
    assert found.time.tolist() == [0.0, 60.0, 120.0]


def test_times_of_two_zones_are_compared_in_one(tmp_path: Path) -> None:
    rows = ("02:59:59 CEST", "02:00:00 CET", "01:00:01 UTC", "03:00:02 GMT+2", "04:00:03+0300")
    found = read_waveforms(put(tmp_path, "t;u\n" + "".join(f"2026-10-25 {row};0\n" for row in rows)))
    assert found.time.tolist() == [0.0, 1.0, 2.0, 3.0, 4.0] and not found.origin.notes


def at_local_times(folder: Path, *instants: str) -> object:
    return read_waveforms(put(folder, "t;u\n" + "".join(f"{t};{k}\n" for k, t in enumerate(instants))))


def test_the_end_of_summer_time_is_bridged_and_told(tmp_path: Path) -> None:
    """Sunday, 25 October 2026: after 02:59:59 local clocks show 02:00:00 again."""
    found = at_local_times(
        tmp_path, *(f"2026-10-25 02:59:5{k}" for k in range(10)), *(f"2026-10-25 02:00:0{k}" for k in range(10))
    )
    assert found.time.tolist() == list(range(20))
    (note,) = found.origin.notes
    assert "goes back an hour at 2026-10-25 02:00:00" in note and "end of summer time" in note


def test_summer_time_ends_within_half_a_step_of_the_row_that_was_due(tmp_path: Path) -> None:
    """Rows a minute apart, and one 20 s late as the hour is turned back."""
    rows = ("02:57:00", "02:58:00", "02:59:00", "02:00:20", "02:01:20")
    found = at_local_times(tmp_path, *(f"2026-10-25 {row}" for row in rows))
    assert found.time.tolist() == [0.0, 60.0, 120.0, 200.0, 260.0]


def test_a_leap_of_an_hour_is_kept_and_told(tmp_path: Path) -> None:
    found = at_local_times(tmp_path, "29/03/2026 01:59:58", "29/03/2026 01:59:59", "29/03/2026 03:00:00")
    assert found.time.tolist() == [0.0, 1.0, 3602.0 - 0.0] and "where summer time began" in found.origin.notes[0]


@pytest.mark.parametrize("back", ["02:30:00", "01:59:59", "02:00:05"])
def test_other_times_that_go_back_are_refused(tmp_path: Path, back: str) -> None:
    with pytest.raises(WaveformError, match="the time goes back"):
        at_local_times(tmp_path, *(f"2026-10-25 02:59:5{k}" for k in range(10)), f"2026-10-25 {back}")


# Numbers that are dates


def serial(at: datetime.datetime) -> str:
    """As a spreadsheet stores a date: days since 1899-12-30, here to 12 digits behind the point."""
    days = Fraction((at - datetime.datetime(1899, 12, 30)) // datetime.timedelta(microseconds=1), 86_400_000_000)
    return f"{float(days):.12f}"


@pytest.mark.parametrize("label", ["Date", "Datum/Zeit", "Timestamp", "Zeitstempel", "Fecha y hora", "日期"])
def test_dates_as_a_spreadsheet_counts_them(tmp_path: Path, label: str) -> None:
    cells = [serial(FIRST + step) for step in STEPS]
    found = read_waveforms(put(tmp_path, f"{label};u\n" + "".join(f"{c};1\n" for c in cells)))
    np.testing.assert_allclose(
        found.time, [step.total_seconds() for step in STEPS], atol=1e-6
    )  # a double of a day has 0.6 us
    assert found.origin.time_unit == "date" and "as a spreadsheet counts them" in found.origin.notes[0]
    stated = read_waveforms(put(tmp_path, "time [d];u\n" + "".join(f"{c.replace('.', ',')};1\n" for c in cells)))
    np.testing.assert_allclose(stated.time, found.time, rtol=1e-12)


def test_a_clock_that_may_be_days_is_asked_about_and_others_are_not(tmp_path: Path) -> None:
    cells = [serial(FIRST + step) for step in STEPS]
    (note,) = read_waveforms(put(tmp_path, "t;u\n" + "".join(f"{c};1\n" for c in cells))).origin.notes
    assert "may be dates" in note and "taken as s" in note
    for clock in (["45000", "45001", "45002"], ["0.02", "0.04", "0.06"], ["5.0e4", "5.1e4"]):
        found = read_waveforms(put(tmp_path, "t;u\n" + "".join(f"{c};1\n" for c in clock)))
        assert found.time.tolist() == [float(c) for c in clock] and not found.origin.notes


@pytest.mark.parametrize("since", [1601, 1])
def test_ticks_of_a_tenth_of_a_microsecond(tmp_path: Path, since: int) -> None:
    first = (FIRST - datetime.datetime(since, 1, 1)) // datetime.timedelta(microseconds=1) * 10
    found = read_waveforms(put(tmp_path, "ticks,u\n" + "".join(f"{first + 3 * k},1\n" for k in range(9))))
    np.testing.assert_allclose(found.time, [3e-7 * k for k in range(9)], rtol=1e-12)


@pytest.mark.parametrize("name", ["x.h5", "x.nc", "x.mat", "x.parquet"])
def test_whole_nanoseconds_since_1970_in_files_of_numbers(tmp_path: Path, name: str) -> None:
    path, counts, u = tmp_path / name, np.array(COUNTS), np.arange(40.0)
    if name == "x.mat":
        pytest.importorskip("scipy.io").savemat(path, {"t": counts, "u": u})
    elif name == "x.parquet":
        table = pytest.importorskip("pyarrow").table({"timestamp": counts, "u": u})
        pytest.importorskip("pyarrow.parquet").write_table(table, path)
    else:
        with pytest.importorskip("h5py").File(path, "w") as file:
            file["time"], file["u"] = counts, u
            file["time"].attrs["units"] = "nanoseconds since 1970-01-01" if name == "x.nc" else "ns"
    found = read_waveforms(path)
    np.testing.assert_allclose(found.time, [137e-9 * k for k in range(40)], rtol=1e-14)
    assert found.origin.time_unit == "date" and found["u"].tolist() == u.tolist()


def test_a_date_of_words_in_a_column_of_its_own(tmp_path: Path) -> None:
    found = read_waveforms(put(tmp_path, "Date;Time;u\n29-Feb-2024;23:59:59,5;1\n01-Mar-2024;00:00:00,25;2\n"))
    assert found.time.tolist() == [0.0, 0.75] and found.names == ("u",)


@pytest.mark.parametrize("date", ["03-xyz-2016 03:54:22.400", "2016y5m3 03:54:22.400"])
def test_a_date_in_no_known_form_is_refused_as_a_date(tmp_path: Path, date: str) -> None:
    with pytest.raises(WaveformError, match=r"date|month") as said:
        read_waveforms(put(tmp_path, f"Timestamp,V\n{date},1\n{date},2\n"))
    assert "21-Nov-2026 10:15:00" in said.value.expected and "line 2, column 1" in said.value.where
    assert "take out the row" not in str(said.value)


# Rows that do not stand in the order of their instants


def rows_of(instants: np.ndarray) -> list[str]:
    return [f"{t:.2f},{np.sin(t):.6f}" for t in instants]


def written_as(tmp_path: Path, rows: list[str]) -> Path:
    (tmp_path / "r.csv").write_text("\n".join(["time [s],V", *rows]) + "\n")
    return tmp_path / "r.csv"


@pytest.mark.parametrize(
    ("order", "hint"),
    [
        ("reversed", "sort the rows by time: they are those of one record in another order"),
        ("in two parts", "sort the rows by time: they are those of one record in another order"),
        ("a block twice", "take out the 20 rows that stand twice to the last digit, the first of them data row 41"),
        (
            "a block twice, at the end",
            "take out the 20 rows that stand twice to the last digit, the first of them data row 61",
        ),
    ],
)
def test_what_makes_one_record_of_rows_out_of_order_is_said(tmp_path: Path, order: str, hint: str) -> None:
    rows = rows_of(np.arange(60) * 0.02)
    shuffled = {
        "reversed": rows[::-1],
        "in two parts": rows[25:] + rows[:25],
        "a block twice": rows[:40] + rows[20:40] + rows[40:],
        "a block twice, at the end": rows + rows[20:40],
    }[order]
    with pytest.raises(WaveformError, match=f"the time goes back.*{re.escape(hint)}$"):
        read_waveforms(written_as(tmp_path, shuffled))


def test_rows_that_are_no_single_record_are_not_to_be_sorted_alone(tmp_path: Path) -> None:
    instants = np.arange(60) * 0.02
    rows = rows_of(instants)
    other = [f"{t:.2f},5" for t in instants[20:40]]
    for wrong in (
        rows[:40] + other + rows[40:],  # an hour twice, as of a clock that is set back
        rows[:40] + rows_of(instants[20:40] + 0.01),  # between others
        rows[30:] + rows_of(instants[:10]),  # a gap between
        [*rows[:9], "0.001,0.3", *rows[10:]],  # one whose time is wrong
    ):
        with pytest.raises(WaveformError, match=r"the time goes back.*where its time begins again$"):
            read_waveforms(written_as(tmp_path, wrong))
