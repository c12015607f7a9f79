"""Parameters as a caller in Python names them: names, bounds, starts, tables."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.errors import StudyError

TIME = np.linspace(0.0, 1.0, 21)
PLANT = hi.Model(
    "p", parameters={"k": 2.0, "T": 0.2}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"}
)
RECORD = hi.Experiment(TIME, "e", inputs={"u": hi.step(0.0, 1.0, at=0.2)}, outputs={"y": np.zeros(TIME.size)})


def candidate(given: Any) -> Any:
    """The candidate that `check` reports of k, given so."""
    return hi.check(PLANT, RECORD, {"k": given}).candidates["k"].candidate


@pytest.mark.parametrize(
    ("given", "start", "low", "high"),
    [
        ((1.0, 5.0), 2.0, 1.0, 5.0),
        ([3.0, 5.0], 4.0, 3.0, 5.0),  # the model's value lies outside: the search begins half-way
        (np.array([-5.0, 1.0]), -2.0, -5.0, 1.0),
        ((1.0, np.inf), 2.0, 1.0, None),
        (1.5, 1.5, None, None),
        ({"start": 1.5, "max": 9}, 1.5, None, 9.0),
        (None, 2.0, None, None),
    ],
)
def test_bounds_start_and_tables(given: Any, start: float, low: float | None, high: float | None) -> None:
    found = candidate(given)
    assert (found.start, found.min, found.max, found.given) == (start, low, high, 2.0)


@pytest.mark.parametrize("given", [(1.0,), (1.0, 2.0, 3.0), ("a", "b"), "strip", (1.0, "b"), object()])
def test_what_are_no_bounds_is_refused(given: Any) -> None:
    with pytest.raises(StudyError, match=r"parameters, 'k': no bounds; expected \(min, max\)"):
        candidate(given)


@pytest.mark.parametrize(("given", "tried"), [((5.0, 1.0), r"\(1, 5\)"), ((2.0, 2.0), "leave it out")])
def test_bounds_in_the_wrong_order_are_told_with_the_right_one(given: Any, tried: str) -> None:
    with pytest.raises(StudyError, match=f"bounds in the wrong order.*{tried}"):
        candidate(given)
