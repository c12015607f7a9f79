"""The noise that is found in the rows before an event, over recorders, files, noises and faults, beside the truth and the best there is.

    python benchmarks/noise_of_records.py [--seeds 1] [--bits 8 12 16] [--rows 20 50 200 2000] [--worst]

A recorder of 8 to 16 bits over 750 MW rounds to its levels, and its file to 1 to 6 decimals or to float32; a step is that of both together,
the root of the sum of their squares. The noise is 0.2 to 5 steps, white or of first order; before the event there is nothing else, or one
row in fifty is off by 10 to 30 times the noise, or the level drifts by 5 times the noise, or it steps by 5 to 10 times. The truth is the
root of the noise's variance and that of the rounding, step^2/12: what a residual of the right model has.

By each group: the share of records whose noise is found within 20 % of the truth; of what a formula makes of the unrounded, undisturbed
noise itself, whose mean it knows (no estimator can do better without knowing more); and the number of records that show nothing.
"""

from __future__ import annotations

import argparse
import itertools
import time as clock
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from hvdc_ident.data import noise_estimate, noise_floor
from hvdc_ident.data.trajectory import Array

RANGE, LEVEL = 750.0, 200.0
AFTER = 250
WITHIN = 1.2
DISTURBED = "none", "outliers", "drift", "steps"
FLOAT = "float32"
HEAD = "share of records within 20 %"


@dataclass(frozen=True)
class Kind:
    """A way to record. decimals: of the file, or float32; noise: in steps; rho: its lag-1 coefficient; rows: before the event."""

    bits: int
    decimals: int | str
    noise: float
    rho: float
    rows: int
    disturbed: str

    @property
    def step(self) -> float:
        """The step that recorder and file round to, together."""
        printed = float(np.spacing(np.float32(LEVEL))) if self.decimals == FLOAT else 10.0 ** -float(self.decimals)
        return float(np.hypot(RANGE / 2**self.bits, printed))

    @property
    def std(self) -> float:
        """The truth."""
        return self.step * float(np.hypot(self.noise, 1.0 / np.sqrt(12.0)))

    def record(self, seed: int) -> tuple[Array, Array, float, float]:
        """Instants, values, the event, and the standard deviation that the noise before it would tell by itself."""
        random = np.random.default_rng(
            [seed, self.bits, hash_of(self.decimals), int(10 * self.noise), int(10 * self.rho), self.rows]
        )
        count = self.rows + AFTER
        size = self.noise * self.step
        white = random.standard_normal(count + 300)
        noise = size * lfilter([np.sqrt(1.0 - self.rho**2)], [1.0, -self.rho], white)[300:]
        best = float(np.hypot(np.sqrt(np.mean(noise[: self.rows] ** 2)), self.step / np.sqrt(12.0)))
        time = np.arange(count) * 0.02
        since = np.maximum(np.arange(count) - self.rows, 0) * 0.02
        values = LEVEL + random.uniform(-0.5, 0.5) * 10.0 * self.step + noise
        values += 0.05 * RANGE * (1.0 - np.exp(-since))
        if self.disturbed == "outliers":
            off = random.choice(self.rows, max(1, self.rows // 50), replace=False)
            values[off] += self.std * random.uniform(10.0, 30.0, off.size) * random.choice([-1.0, 1.0], off.size)
        if self.disturbed == "drift":
            values += 5.0 * self.std * np.arange(count) / self.rows
        if self.disturbed == "steps":
            place = random.integers(self.rows // 10, self.rows - self.rows // 10)
            values[place:] += self.std * random.uniform(5.0, 10.0) * random.choice([-1.0, 1.0])
        seen = np.round(values / (RANGE / 2**self.bits)) * (RANGE / 2**self.bits)
        printed = (
            seen.astype(np.float32).astype(float) if self.decimals == FLOAT else np.round(seen, int(self.decimals))
        )
        return time, printed, self.rows * 0.02, best


def hash_of(decimals: int | str) -> int:
    """A number for a seed."""
    return 99 if decimals == FLOAT else int(decimals)


def kinds(bits: list[int], rows: list[int]) -> Iterator[Kind]:
    """All of them."""
    decimals: list[int | str] = [1, 2, 3, 4, 6, FLOAT]
    noises, colours = (0.2, 0.3, 0.5, 1.0, 2.0, 5.0), (0.0, 0.6, 0.9)
    for parts in itertools.product(bits, decimals, noises, colours, rows, DISTURBED):
        yield Kind(*parts)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--bits", type=int, nargs="+", default=[8, 10, 12, 14, 16])
    parser.add_argument("--rows", type=int, nargs="+", default=[20, 50, 200, 2000])
    parser.add_argument("--worst", action="store_true", help="name the records that are farthest off")
    asked = parser.parse_args()
    groups: dict[tuple[str, object], list[tuple[float, float]]] = defaultdict(list)
    lost, spent, off = defaultdict(int), 0.0, []
    for kind in kinds(asked.bits, asked.rows):
        for seed in range(asked.seeds):
            time, values, event, best = kind.record(seed)
            begun = clock.process_time()
            found = noise_estimate(time, values, event)
            spent += clock.process_time() - begun
            std = max(found.std, noise_floor(values))
            differ = bool(np.ptp(values[time < event - 1e-9]) > 0.0)
            ratio = (std / kind.std, best / kind.std)
            colour = f"rho {kind.rho:g}" if kind.rho else "white"
            keys = [
                ("all", ""), ("rows", kind.rows), ("noise, steps", kind.noise), ("colour", colour), ("bits", kind.bits),
                ("decimals", kind.decimals), ("before the event", kind.disturbed), (f"{colour}, rows", kind.rows),
                (f"{colour}, {kind.disturbed}, rows", kind.rows),
            ]  # fmt: skip
            for key in keys:
                groups[key].append(ratio)
                lost[key] += differ and found.std == 0.0
            off.append((abs(float(np.log(ratio[0]))) - abs(float(np.log(ratio[1]))), kind, seed, ratio, found))
    print(f"{HEAD}; {len(off)} records, {1e3 * spent / len(off):.1f} ms each\n")
    print(f"| {'group':34} | {'':8} | records | found | best | median ratio | 2.5 %, 97.5 % | none shown |")
    print("|---|---|---|---|---|---|---|---|")
    for key, ratios in groups.items():
        found_, best_ = np.array(ratios).T
        within = [float(np.mean(np.abs(np.log(r)) < np.log(WITHIN))) for r in (found_, best_)]
        low, middle, high = np.quantile(found_, [0.025, 0.5, 0.975])
        print(
            f"| {key[0]:34} | {key[1]!s:8} | {found_.size:7} | {100 * within[0]:4.1f} | {100 * within[1]:4.1f} "
            f"| {middle:.3f} | {low:.2f}, {high:.2f} | {lost[key]} |"
        )
    if asked.worst:
        for _, kind, seed, ratio, found in sorted(off, key=lambda o: -o[0])[:40]:
            print(kind, seed, f"found {ratio[0]:.2f}, best {ratio[1]:.2f} of the truth", found)


if __name__ == "__main__":
    main()
