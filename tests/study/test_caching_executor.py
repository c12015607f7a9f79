"""Finished work is kept bit for bit and not done again, wherever it is done."""

from __future__ import annotations

import json
import math
from pathlib import Path

import numpy as np
import pool_jobs
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hvdc_ident.errors import ComputationError
from hvdc_ident.fit import FitParameter
from hvdc_ident.fit.optimiser import OptimiserResult
from hvdc_ident.fit.profile import profiles
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.parallel import LocalPool
from hvdc_ident.study.store import CachingExecutor, packed, unpacked
from tests.fit.simulators import LeastSquares


class Shelf(dict):
    def get(self, keys):
        return {k: self[k] for k in keys if k in self}

    def put(self, key, value):
        self[key] = value


class Counted:
    def __init__(self, stop_at=None):
        self.done, self.stop_at = [], stop_at

    def __call__(self, x):
        if x == self.stop_at:
            raise KeyboardInterrupt
        self.done.append(x)
        return np.array([x, x / 3.0])


def test_a_second_run_does_only_what_is_missing():
    shelf, first = Shelf(), Counted(stop_at=6)
    with pytest.raises(KeyboardInterrupt):
        list(CachingExecutor(shelf).map(first, range(10)))
    second = Counted()
    found = list(CachingExecutor(shelf).map(second, range(10)))
    assert second.done == [6, 7, 8, 9]
    assert np.array_equal(found, [[x, x / 3.0] for x in range(10)])


def test_calls_and_items_are_told_apart():
    shelf = Shelf()
    kept = CachingExecutor(shelf)
    assert [list(kept.map(lambda x: x, [1, 2])), list(kept.map(lambda x: -x, [1, 2]))] == [[1, 2], [-1, -2]]
    again = CachingExecutor(shelf)
    assert list(again.map(lambda x: 100 * x, [1, 3])) == [1, 300]


def test_in_a_pool_the_same_is_kept():
    shelf = Shelf()
    with LocalPool(2).open() as pool:
        found = list(CachingExecutor(shelf, pool).map(pool_jobs.Job(), range(20)))
        assert found == [x * x for x in range(20)]
        assert list(pool.map(pool_jobs.Job(fails={99}), range(5))) == [0, 1, 4, 9, 16]  # the workers are still there
    assert list(CachingExecutor(shelf).map(pool_jobs.Job(fails=set(range(20))), range(20))) == found


def test_a_failed_item_is_not_kept():
    shelf = Shelf()
    with LocalPool(1).open() as pool, pytest.raises(ComputationError, match="item 3 failed"):
        list(CachingExecutor(shelf, pool).map(pool_jobs.Job(fails={2}), range(5)))
    assert not any(key.startswith(b"1/2/") for key in shelf)


PLAIN = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False) | st.text() | st.binary(max_size=8),
    lambda inner: st.lists(inner, max_size=3) | st.tuples(inner, inner) | st.dictionaries(st.text(), inner, max_size=3),
)


@given(PLAIN)
def test_what_is_packed_comes_back(value):
    assert unpacked(packed(value)) == value


def test_arrays_and_results_come_back_bit_for_bit():
    theta = np.array([0.1, math.nan, -0.0, math.inf])
    back = unpacked(packed(OptimiserResult(theta, 1 / 3, "converged", "µ", 7)))
    assert back.theta.tobytes() == theta.tobytes()
    assert (back.cost, back.status, back.message, back.evaluations) == (1 / 3, "converged", "µ", 7)
    assert unpacked(packed(FrozenMap({"a": (1, 2j)}))) == FrozenMap({"a": (1, 2j)})
    scalar = unpacked(packed(np.float64(0.1)))
    assert isinstance(scalar, np.float64)
    assert scalar == 0.1


@pytest.mark.parametrize(
    "name",
    ["os:system", "hvdc_ident.study.store:json", "subprocess:Popen", "hvdc_ident:os", "hvdc_ident.moved.away:Refit"],
)
def test_only_dataclasses_of_the_package_are_made(name):
    content = json.dumps({"!": "o", "of": name, "v": {}}).encode()
    with pytest.raises(ComputationError, match="cannot be read"):
        unpacked(content)


def test_what_cannot_be_kept_says_so():
    with pytest.raises(ComputationError, match="cannot be kept"):
        list(CachingExecutor(Shelf()).map(lambda x: Path(), [1]))


class Valley:
    """Rosenbrock's two residuals, counted; ends the program at the evaluation `stop_at`."""

    def __init__(self, stop_at=None):
        self.count, self.stop_at = 0, stop_at

    def __call__(self, t):
        self.count += 1
        if self.count == self.stop_at:
            raise KeyboardInterrupt
        return np.array([1 - t[0], 10 * (t[1] - t[0] ** 2)]), np.array([[-1.0, 0], [-20 * t[0], 10]])


def walked(valley, shelf):
    unknowns = (FitParameter("x", 0.0), FitParameter("y", 0.0))
    return profiles(LeastSquares(unknowns, valley), np.array([1.0, 1.0]), executor=CachingExecutor(shelf))


def test_a_profile_goes_on_from_its_last_step():
    whole, steps = Valley(), Shelf()
    expected = walked(whole, steps)
    assert len(steps) > 20 and whole.count > len(steps)
    longest = max(unpacked(v).evaluations for v in steps.values())
    for stop_at in range(1, whole.count, 7):
        shelf, first, second = Shelf(), Valley(stop_at), Valley()
        with pytest.raises(KeyboardInterrupt):
            walked(first, shelf)
        found = walked(second, shelf)
        assert first.count + second.count <= whole.count + longest  # no more than the running step again
        assert second.count == whole.count - sum(unpacked(v).evaluations for v in kept_before(shelf, first))
        for name, profile in expected.by_name.items():
            assert found.by_name[name].thetas.tobytes() == profile.thetas.tobytes()
            assert found.by_name[name].ci95 == profile.ci95


def kept_before(shelf, first):
    """The steps that were finished when the first run ended: the shelf keeps them in the order they were put."""
    kept, spent = [], 0
    for value in shelf.values():
        spent += unpacked(value).evaluations
        if spent >= first.count:
            break
        kept.append(value)
    return kept
