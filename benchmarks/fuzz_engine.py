"""Random models against scipy, by the hour: values and sensitivities of the engine, seed by seed.

    PYTHONPATH=. python benchmarks/fuzz_engine.py FIRST LAST       one line a seed in FIRST .. LAST - 1
    PYTHONPATH=. python benchmarks/fuzz_engine.py --shrink SEED    a small case that still differs, as a model card

A line: seed, sizes (states x unknowns, delays, samples), method, rtol, events, largest error of values and of derivatives in
rtol, and where. DIFFERS: beyond `tests.simulate.random_models.ALLOWED`. UNDECIDED: no answer that a tolerance decides, as where a
switch is touched. A seed's case depends on the seed, this file, the strategies and the version of hypothesis alone, so that a
run is continued at the next seed.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
import warnings
from collections import Counter

from hypothesis import HealthCheck, Phase, given, seed, settings

from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.model import write_card
from tests.simulate.hybrid import Undecided
from tests.simulate.random_models import ALLOWED, cases, difference


def drawn(number):
    """The case of a seed."""
    found = []

    @seed(number)
    @settings(
        max_examples=2, database=None, deadline=None, phases=[Phase.generate], suppress_health_check=list(HealthCheck)
    )
    @given(cases())
    def draw(case):
        found.append(case)

    draw()  # the first one is the least, whatever the seed
    return found[-1]


def told(case):
    """One line on a case, and whether it differs."""
    m = case.model
    sizes = f"{len(m.states)}x{len(m.algebraic)} d{len(m.delays)} q{len(m.sampled)} {case.method} {case.rtol:.0e}"
    try:
        found = difference(case)
    except Undecided as e:
        return f"{sizes} UNDECIDED {e}", "undecided"
    except HvdcIdentError as e:
        return f"{sizes} REFUSED {' '.join(str(e).split())[:150]}", "refused"
    differs = not max(found.values, found.rows) <= ALLOWED
    text = f"{sizes} {found.events} events: {found.values:.3g} {found.rows:.3g} ({found.where})"
    return text + (" DIFFERS" if differs else ""), "differs" if differs else "agrees"


def shrink(number):
    """Prints a small case that differs, found from a seed's."""

    @seed(number)
    @settings(max_examples=2, database=None, deadline=None, suppress_health_check=list(HealthCheck), print_blob=False)
    @given(cases())
    def differs(case):
        text, kind = told(case)
        if kind in ("differs", "refused"):
            print(text, write_card(case.model), case.points, sep="\n", flush=True)
        assert kind not in ("differs", "refused"), text

    differs()


def main():
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("first", type=int, nargs="?")
    parser.add_argument("last", type=int, nargs="?")
    parser.add_argument("--shrink", type=int)
    asked = parser.parse_args()
    warnings.simplefilter("ignore")
    if asked.shrink is not None:
        shrink(asked.shrink)
    else:
        campaign(range(asked.first, asked.last))


def campaign(numbers):
    """Prints one line for each seed, and how many cases agree."""
    counts = Counter()
    with tempfile.TemporaryDirectory() as folder:
        os.environ["HVDC_IDENT_CACHE"] = folder
        for number in numbers:
            start = time.process_time()
            text, kind = told(drawn(number))
            counts[kind] += 1
            print(f"{number} {text} {time.process_time() - start:.1f} s", flush=True)
    print(dict(counts), f"{time.process_time():.0f} s of CPU time")


if __name__ == "__main__":
    main()
