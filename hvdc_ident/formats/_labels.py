"""Names and units from the cells above a table: `U [kV]`, `P (MW)`, `Time(s)`, `Uf / p.u.`, `t/ms`, `Voltage in p.u.`."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Collection, Sequence

from hvdc_ident.data import conversion, is_unit
from hvdc_ident.data.phase_sets import LETTERS
from hvdc_ident.formats import FORMULA_START

TIME_WORDS = (
    "time", "zeit", "temps", "tiempo", "tempo", "tijd", "timestamp", "zeitstempel", "datetime", "date/time", "date time",
    "datum/zeit", "time stamp", "horodatage", "utc", "b:tnow",
)  # fmt: skip
"""Names of a column of times, lower case, where it is not the first."""

_DATE_NAME = re.compile(r"dat(?:e|um|a (?:e )?ora|enum)|fecha|stamp|stempel|horodat|дата|日期|日時", re.IGNORECASE)
_KINDS = {
    "W": "p", "var": "q", "VA": "s", "V": "[uve]", "A": "i", "Hz": "f", "rad/s": "[wnωΩ]|om|sp", "rad": "[δθφϕ]|a|d|th|ph",
    "N.m": "t|m", "K": "t|th", "s": "t(?:ime)?_", "pu": "",
}  # fmt: skip
"""By unit what a name of such a quantity begins with."""
_BRACKETS = re.compile(r"(?P<name>.*\S)\s*\[(?P<unit>[^\[\]]*)\]", re.DOTALL)
_ROUND = re.compile(r"(?P<name>.*[^\s(])\s*\((?P<unit>[^()]*)\)", re.DOTALL)
_IN = re.compile(r"(?P<name>.*\S)\s+in\s+(?P<unit>\S.*)", re.DOTALL)
_SUBSCRIPT = re.compile(r"[\d,:\s]+")


def name_and_unit(label: str) -> tuple[str, str]:
    """Name and unit of a header cell, "" where it has none.

    What stands in square brackets is the unit unless it is an index. Expansion brackets, `in` and a stroke stand in names
    as well (`der(x)`, `U (L1)`, `P/Q`): there only a known unit counts.
    """
    name, unit = _split(label.strip())
    if name.startswith("'") and FORMULA_START.match(name[1:]):
        name = name[1:]
    return name, unit


def _split(label: str) -> tuple[str, str]:
    match = _BRACKETS.fullmatch(label)
    if match:
        return (label, "") if _SUBSCRIPT.fullmatch(match["unit"]) else (match["name"], match["unit"].strip())
    for form in (_ROUND, _IN):
        match = form.fullmatch(label)
        if match and is_unit(match["unit"]):
            return match["name"], match["unit"].strip()
    for place in [i for i, c in enumerate(label) if c == "/"]:
        name, unit = label[:place].strip(), label[place + 1 :].strip()
        if name and is_unit(unit):
            return name, unit
    return label, ""


def unit_in_name(name: str, names: Collection[str]) -> str:
    """The unit behind the last underscore of a name, as in `P_MW` and `f_Hz`; "" where that may be something else.

    It has to be a unit of what the name begins with: a power for P, a voltage for V, U and E, and so on, for `V_s` and `I_h` are no
    seconds and hours. Nor is A an ampere where `I_B` stands beside `I_A`. names: all of the file.
    """
    stem, _, unit = name.rpartition("_")
    if (
        not stem
        or not is_unit(unit)
        or not any(
            conversion(unit, kind) is not None and re.match(letters, name, re.IGNORECASE)
            for kind, letters in _KINDS.items()
        )
    ):
        return ""
    phases = [other for letters in LETTERS if unit.lower() in letters for other in letters if other != unit.lower()]
    beside = {other.lower() for other in names}
    return "" if any(f"{stem}_{letter}".lower() in beside for letter in phases) else unit


def names_and_units(labels: Sequence[str]) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Names and units of the header cells; a cell keeps its unit in the name where two would be the same without."""
    parts = [name_and_unit(label) for label in labels]
    counts = Counter(name for name, _ in parts)
    names = [name if counts[name] == 1 else label for (name, _), label in zip(parts, labels, strict=True)]
    return tuple(names), tuple(unit for _, unit in parts)


def merged(rows: Sequence[Sequence[str]]) -> list[str]:
    """One label a column from header lines below each other: a last line of units goes into brackets, others are joined."""
    *above, last = rows
    if above and _are_units(last):
        return [f"{_joined(cells)} {_bracketed(unit)}".strip() for *cells, unit in zip(*rows, strict=True)]
    return [_joined(cells) for cells in zip(*rows, strict=True)]


def time_column(labels: Sequence[str]) -> int:
    """The place of the column of times: the first, or the first that is called so where the first is not."""
    called = [name_and_unit(label)[0].strip().lower() in TIME_WORDS for label in labels]
    return called.index(True) if any(called) else 0


def is_date_name(label: str) -> bool:
    """Return whether a column of this name holds dates."""
    return _DATE_NAME.search(label) is not None


def _joined(cells: Sequence[str]) -> str:
    return " ".join(dict.fromkeys(c.strip() for c in cells if c.strip()))


def _bracketed(unit: str) -> str:
    text = unit.strip().strip("[]()").strip().removeprefix("in ")
    return f"[{text}]" if text else ""


def _are_units(cells: Sequence[str]) -> bool:
    """Return whether a line holds units and no names: at least one, and nothing else but empty cells and strokes."""
    texts = [c.strip() for c in cells]
    known = [bool(t) and (is_unit(t.strip("[]()")) or t[0] + t[-1] in ("[]", "()")) for t in texts]
    return any(known) and all(k or t in ("", "-", "1", "[-]") for k, t in zip(known, texts, strict=True))
