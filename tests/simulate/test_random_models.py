"""Random models of the grammar against scipy, a few of those of `benchmarks/fuzz_engine.py`."""

from hypothesis import Phase, assume, given, seed, settings

from tests.simulate.hybrid import Undecided
from tests.simulate.random_models import ALLOWED, cases, difference


@seed(61)
@settings(max_examples=12, database=None, deadline=None, phases=[Phase.generate])  # to shrink a case takes minutes
@given(cases(most=4, kinds=("plain", "delay", "sampled", "both")))
def test_values_and_sensitivities_of_a_random_model(case):
    try:
        found = difference(case)
    except Undecided:
        assume(False)
    assert max(found.values, found.rows) <= ALLOWED, found.where
