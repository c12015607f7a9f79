"""The codec: what JSON cannot hold as it stands comes back as it was, and what is no result is told with its place."""

from __future__ import annotations

import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from hvdc_ident.codec import INLINE, NOT_STORED, Coded, stored_as
from hvdc_ident.errors import InputError
from hvdc_ident.immutable import FrozenMap


@dataclass(frozen=True)
class Part:
    size: float
    source: str = field(default="", metadata=stored_as("from", optional=True))


@dataclass(frozen=True)
class Bounds:
    low: float = -math.inf
    high: float = math.inf


@dataclass(frozen=True, eq=False)
class Whole(Coded):
    kind: Literal["one", "two"]
    number: float
    known: float | None
    pair: tuple[int, str]
    pole: complex
    rows: NDArray[np.float64]
    roots: NDArray[np.complex128]
    parts: FrozenMap[tuple[Part, ...]]
    path: Path
    nested: Part | None = None
    either: int | tuple[float, float] = 0
    bounds: Bounds = field(default_factory=Bounds, metadata=INLINE)
    scratch: Any = field(default=None, metadata=NOT_STORED)
    stored_properties = ("doubled",)

    @property
    def doubled(self) -> float:
        return 2.0 * self.number


def whole(**given: Any) -> Whole:
    plain: dict[str, Any] = {
        "kind": "one",
        "number": 0.1,
        "known": None,
        "pair": (1, "a"),
        "pole": 1.0 - 2.0j,
        "rows": np.array([[0.1, math.nan], [math.inf, 3.0]]),
        "roots": np.array([1.0 + 2.0j, -3.0j]),
        "parts": FrozenMap({"x": (Part(1.5), Part(math.nan, "u"))}),
        "path": Path("a/b.csv"),
    }
    return Whole(**(plain | given))


def again(value: Whole) -> Whole:
    return Whole.from_dict(json.loads(json.dumps(value.to_dict(), allow_nan=False)))


def test_every_kind_of_field_comes_back() -> None:
    first = whole(nested=Part(2.0), either=(1.0, 2.0), scratch=object())
    found = again(first)
    assert (found.kind, found.number, found.known, found.pair, found.pole) == ("one", 0.1, None, (1, "a"), 1.0 - 2.0j)
    assert np.isnan(found.rows[0, 1]) and found.rows[1, 1] == 3.0, "what is not finite is null, which is nan"
    assert np.isnan(found.rows[1, 0]) and found.roots.tolist() == first.roots.tolist()
    assert (
        isinstance(found.parts, FrozenMap)
        and found.parts["x"][1].source == "u"
        and math.isnan(found.parts["x"][1].size)
    )
    assert found.path == Path("a/b.csv") and found.nested == Part(2.0) and found.either == (1.0, 2.0)
    assert found.scratch is None and found.to_dict() == first.to_dict()


def test_a_part_may_stand_among_the_keys_of_the_whole_and_a_bound_that_is_not_there_is_none() -> None:
    first = whole(bounds=Bounds(high=2.0))
    data = first.to_dict()
    assert (data["low"], data["high"]) == (None, 2.0) and "bounds" not in data
    assert again(first).bounds == first.bounds


def test_keys_are_those_that_the_fields_state() -> None:
    data = whole(nested=Part(1.0, "u"), scratch=1).to_dict()
    assert data["nested"] == {"size": 1.0, "from": "u"} and data["parts"]["x"][0] == {"size": 1.5}
    assert "scratch" not in data and data["doubled"] == 0.2


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"kind": "three"}, "kind: not the JSON of a Whole; expected one of one, two, got 'three'"),
        ({"number": "much"}, "number: .*expected a number, got 'much'"),
        ({"number": True}, "number: .*expected a number, got True"),
        ({"pair": [1]}, r"pair: .*expected a list of 2, got \[1\]"),
        ({"parts": {"x": [{"size": 1.0}, {"from": "u"}]}}, r"parts\.x\.1: .*expected the key size, got \['from'\]"),
        ({"rows": [["a"]]}, "rows: .*expected rows of numbers"),
        ({"pole": [1.0]}, r"pole: .*expected \[re, im\]"),
    ],
)
def test_what_is_no_result_is_told_with_its_place(change: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        Whole.from_dict(whole().to_dict() | change)
