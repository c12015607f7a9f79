"""The cases: a seeded fractional design, and each case as records with their hidden effects."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hidden.campaigns import EVENT, EXCITATIONS, INTERVAL, ROWS, VARIANTS
from hidden.noise import KINDS, WRONG, added, whitened
from hidden.operators import CATALOGUE, OUTSIDE
from hidden.plants import PLANTS
from hidden.simulator import STEP, Hidden, Run, simulate
from hidden.sizes import UNIT, Nominal, needs_source, nominal, sized, units

Array = NDArray[np.floating]
SIZES = (1.0, 3.0, 10.0, 30.0)
TRIES = 12
FIRM = 1.0
"""Units by which the answer may change at half the step."""
LOUDNESS = (math.log(2e-3), math.log(2e-2))
"""Of the noise: its standard deviation in shares of an output's range, as logarithms."""
PARTS = {"single": 357, "pair": 60, "clean": 400, "outside": 50, "left-out": 60}
"""How many cases each part has."""


@dataclass(frozen=True)
class Design:
    """One case before it is generated. effects: their names; size: of each, in units. told: True if the noise is stated."""

    part: str
    number: int
    plant: str
    effects: tuple[str, ...]
    size: float
    noise: str
    excitation: str
    removed: bool
    told: bool
    level: float
    variant: int

    @property
    def name(self) -> str:
        """Return the name in tables."""
        return f"{self.part}-{self.number:03d}"


@dataclass(frozen=True, eq=False)
class Case:
    """A case: records of two fitted experiments and a held-out one, and the truth.

    records, clean: (rows, 3, outputs), all outputs; channels: the recorded ones. sigma: (outputs,) of the noise.
    told: the stated standard deviation, or None. given: the parameters that a user would start from. units: the total size
    of the hidden effects. tries: number of insertion points drawn until an effect of this size was possible.
    """

    design: Design
    hidden: tuple[Hidden, ...]
    records: Array
    clean: Array
    channels: tuple[int, ...]
    sigma: Array
    told: Array | None
    given: dict[str, float]
    runs: tuple[Run, Run, Run]
    units: float
    tries: int
    times: Array = field(default_factory=lambda: np.arange(ROWS) * INTERVAL)
    event: float = EVENT

    @property
    def truth(self) -> list[dict[str, Any]]:
        """Return the hidden effects as plain numbers."""
        return [asdict(h) for h in self.hidden]


def designs(part: str, seed: int) -> tuple[Design, ...]:
    """Return the designs of one part: all effects equally often, the other factors balanced within each."""
    names = {"outside": list(OUTSIDE), "clean": [""]}.get(part, list(CATALOGUE))
    count = PARTS[part]
    rng = np.random.default_rng([seed, list(PARTS).index(part)])
    found: list[Design] = []
    each = -(-count // len(names))
    tables = {name: _balanced(rng, each, part) for name in names}
    for number in range(count):
        name = names[number % len(names)]
        row = tables[name][number // len(names)]
        effects: tuple[str, ...] = (name,) if name else ()
        plant = "station" if name == "inductance" else row["plant"]
        if part == "pair":
            effects = (name, str(rng.choice([n for n in names if n not in (name, "inductance")])))
        if part == "clean" and row["noise"] == "unreached":
            effects = ("limit",)
        found.append(Design(part, number, effects=effects, **(row | {"plant": plant})))
    return tuple(found)


def factorial(seed: int) -> tuple[Design, ...]:
    """Return every combination of the factors for a single effect; the insertion point is drawn, as in the fractional design."""
    rng = np.random.default_rng([seed, 99])
    rows = product(CATALOGUE, PLANTS, SIZES, KINDS, EXCITATIONS, (False, True), (True, False), range(VARIANTS))
    found: list[Design] = []
    for effect, plant, size, noise, excitation, removed, told, variant in rows:
        if effect == "inductance" and plant != "station":
            continue
        level = float(np.exp(rng.uniform(LOUDNESS[0], LOUDNESS[1])))
        factors = (effect,), size, noise, excitation, removed, told, level, variant
        found.append(Design("single", len(found), plant, *factors))
    return tuple(found)


def _balanced(rng: np.random.Generator, count: int, part: str) -> list[dict[str, Any]]:
    """Return rows of factors with all levels equally often (at most one more)."""
    noise: Sequence[str] = KINDS
    sizes: Sequence[float] = SIZES
    if part == "clean":
        noise = [k for k in KINDS for _ in range(5)] + [*WRONG, "unreached"]
        sizes = (0.0,)
    elif part != "single":
        sizes = (10.0, 30.0)
    levels: dict[str, Sequence[Any]] = {
        "plant": tuple(PLANTS),
        "size": sizes,
        "noise": noise,
        "excitation": EXCITATIONS,
        "removed": (False, False, True),
        "told": (True, False),
        "variant": tuple(range(VARIANTS)),
    }
    columns = {}
    for name, options in levels.items():
        column = [options[k % len(options)] for k in range(count)]
        order = rng.permutation(count)
        columns[name] = [column[k] for k in order]
    loudness = np.exp(rng.uniform(LOUDNESS[0], LOUDNESS[1], count))
    return [{n: c[k] for n, c in columns.items()} | {"level": float(loudness[k])} for k in range(count)]


def made(design: Design, seed: int) -> Case | None:
    """Return the case; None if the effect cannot reach the size of the design at any of TRIES insertion points."""
    key = [seed, list(PARTS).index(design.part), design.number]
    rng = np.random.default_rng([*key, 7])
    base = nominal(design.plant, design.excitation, design.variant)
    plant = base.plant
    extent = np.ptp(base.outputs[:, :2], axis=(0, 1))
    sigma = design.level * np.maximum(extent, 0.02 * np.abs(base.outputs).max(axis=(0, 1)))
    channels = tuple(range(len(plant.outputs)))
    if design.removed:
        lost = int(rng.integers(len(plant.outputs)))
        channels = tuple(k for k in channels if k != lost)
    kind = design.noise if design.noise in KINDS else "ar" if design.noise == "told-white" else "white"
    drawn = _drawn(design, base, sigma, kind, channels, key, rng)
    if drawn is None:
        return None
    hidden, clean, size, tries = drawn
    event = round(EVENT / INTERVAL)
    noise = "white" if design.noise in ("told-half", "unreached") else design.noise
    records = np.stack([added(rng, clean[:, k], sigma, noise, event) for k in range(3)], axis=1)
    given = {n: plant.parameters[n] * float(np.exp(rng.uniform(-0.25, 0.25))) for n in plant.fitted}
    told = _told(design, sigma)
    return Case(design, tuple(hidden), records, clean, channels, sigma, told, given, base.runs, size, tries)


def _drawn(
    design: Design,
    base: Nominal,
    sigma: Array,
    kind: str,
    channels: tuple[int, ...],
    key: list[int],
    rng: np.random.Generator,
) -> tuple[list[Hidden], Array, float, int] | None:
    """Return the hidden effects, the plant's response, the size in units and the insertion points drawn; None after too many."""
    for tries in range(1, TRIES + 1):
        hidden: list[Hidden] = []
        for k, effect in enumerate(design.effects):
            at, source = _place(rng, base, effect, [h.at for h in hidden])
            if design.noise == "unreached":
                peak = float(np.abs(base.slots[at]).max())
                found: Hidden | None = Hidden("limit", at, {"level": 1.3 * peak + 0.05})
            else:
                seed = [*key, tries, k]
                found = sized(base, effect, at, source, design.size, sigma, kind, channels, seed)
            if found is None:
                break
            hidden.append(found)
        if len(hidden) < len(design.effects):
            continue
        clean = simulate(base.plant, base.runs, hidden) if hidden else base.outputs
        if not np.isfinite(clean).all() or (hidden and not _firm(base, hidden, clean, sigma, kind, channels)):
            continue
        size = float(units(base, clean[:, :2, None], sigma, kind, channels)[0])
        # Of two effects each has the size; together they may have more or less.
        if len(hidden) != 1 or design.size == 0.0 or 0.6 < size / design.size < 1.7:
            return hidden, clean, size, tries
    return None


def _firm(
    base: Nominal, hidden: list[Hidden], clean: Array, sigma: Array, kind: str, channels: tuple[int, ...]
) -> bool:
    """Return True if the response does not depend on the integrator: at half its step it is the same to FIRM units.

    A quantised loop that settles between two levels switches between them from step to step, and the level in a row is
    arbitrary. Static effects and filters are accurate to far less than a unit.
    """
    if not any((CATALOGUE | OUTSIDE)[h.effect].stepped for h in hidden):
        return True
    off = simulate(base.plant, base.runs, hidden, step=0.5 * STEP) - clean
    return float(np.linalg.norm(whitened(off, sigma, kind)[..., list(channels)])) < FIRM * UNIT


def _told(design: Design, sigma: Array) -> Array | None:
    """Return the stated noise; None in half of the cases, and for quantised records."""
    if design.noise == "told-half":
        return 0.5 * sigma
    if design.noise == "told-white":
        return sigma
    return sigma if design.told and design.noise != "quantised" else None


def _place(rng: np.random.Generator, base: Nominal, effect: str, taken: list[str]) -> tuple[str, str]:
    """Return an insertion point for the effect, and the other signal if it reads one."""
    plant = base.plant
    places = [*plant.slots, *(f"outputs.{o}" for o in plant.outputs)]
    if effect == "inductance":
        return plant.resistance[0], ""
    while True:
        at = str(rng.choice(places))
        if at in taken:
            continue
        if not needs_source(effect):
            return at, ""
        order = list(plant.slots)
        before = order if at.startswith("outputs.") else order[: order.index(at)]
        open_to = [n for n in {*plant.inputs, *plant.states, *(o for o in plant.outputs if o in before)} if n != at]
        # The slot's own signal under another name would make of every one of these effects a gain.
        moving = sorted(
            n for n in open_to if np.ptp(base.slots[n]) > 1e-6 and not _alike(base.slots[n], base.slots[at])
        )
        if moving:
            return at, str(rng.choice(moving))


def _alike(a: Array, b: Array) -> bool:
    """Return True if one signal is a multiple of the other."""
    return abs(float(np.vdot(a, b))) > (1.0 - 1e-9) * float(np.linalg.norm(a) * np.linalg.norm(b))
