"""kill -9 at random instants of a sweep, an identification and a diagnosis, until the tables are there; then compared.

    python tests/faults/kills.py --kills 50 [--only sweep] [--seed 1] [--workers 1]

Each run is killed at a random instant (uniform over the time of an undisturbed run) and run again, killed again, until
it ends; then its tables have to be those of an undisturbed run, byte for byte, and it begins anew until there were so
many kills. Printed: how many pieces of work were done twice: with one worker at most one a kill, the one that was being
kept. What was running at a kill was not finished and is not counted. With more workers even the shortest sweep goes to
the pool, whose workers count what they finish.
"""

from __future__ import annotations

import argparse
import random
import shutil
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).parent))
import cases
import forks

STAGES = ("sweep", "identify", "diagnose")


@dataclass
class Tally:
    """What happened to one stage."""

    kills: int = 0
    rounds: int = 0
    pieces: int = 0
    twice: int = 0
    worst: int = 0
    different: list[str] = field(default_factory=list)


def killed(stage: str, folder: Path, kills: int, seed: int, workers: int) -> Tally:
    """The tally of so many kills of a stage, in a folder of its own. Raises AssertionError where a run fails by itself."""
    path = cases.write_study(folder, points=3000, hidden=0.02 if stage == "diagnose" else 0.0)
    options = ("--workers", workers)
    forks.run(stage, path, "--out", folder / "whole", *options)  # everything is compiled here
    begin = time.monotonic()
    pool = workers > 1
    code, said = forks.forked((stage, path, "--out", folder / "again", *options), folder / "again.log", in_pool=pool)
    assert code == 0, said
    span = time.monotonic() - begin
    tally, rng = Tally(pieces=len(forks.notes(folder / "again.log"))), random.Random(seed)
    while tally.kills < kills or (folder / "killed").exists():
        after = rng.uniform(0.0, span) if tally.kills < kills else None
        arguments = (stage, path, "--out", folder / "killed", *options)
        code, said = forks.forked(arguments, folder / "killed.log", after=after, in_pool=pool)
        if code == -9:
            tally.kills += 1
            continue
        assert code == 0, said
        _compare(stage, folder, tally, exact=not pool)  # a single point that is left does not go to the pool
    return tally


def _compare(stage: str, folder: Path, tally: Tally, *, exact: bool) -> None:
    """Counts a round that came to its end, and clears the way for the next."""
    tally.rounds += 1
    for name in cases.TABLES[stage]:
        if (folder / "killed" / name).read_bytes() != (folder / "whole" / name).read_bytes():
            tally.different.append(f"{name} in round {tally.rounds}")
    again = [n - 1 for n in Counter(note.work for note in forks.notes(folder / "killed.log")).values()]
    assert not exact or len(again) == tally.pieces, f"{len(again)} pieces of work, {tally.pieces} in an undisturbed run"
    tally.twice += sum(again)
    tally.worst = max(tally.worst, *again)
    shutil.rmtree(folder / "killed")
    (folder / "killed.log").unlink()


def main() -> int:
    """Prints a line a stage; 1 where a table differs."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--kills", type=int, default=50)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--only", choices=STAGES)
    given = parser.parse_args()
    failed = False
    for stage in STAGES:
        if given.only not in (None, stage):
            continue
        with tempfile.TemporaryDirectory() as folder:
            t = killed(stage, Path(folder), given.kills, given.seed, given.workers)
        same = "all the same" if not t.different else f"DIFFERENT: {', '.join(t.different)}"
        print(
            f"{stage}: {t.kills} kills in {t.rounds} rounds of {t.pieces} pieces of work; tables {same}; "
            f"{t.twice} finished pieces done again ({t.twice / max(t.kills, 1):.2f} a kill; one piece at most {t.worst} times)",
            flush=True,
        )
        failed |= bool(t.different)
    return int(failed)


if __name__ == "__main__":
    sys.exit(main())
