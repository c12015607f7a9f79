"""The cases: a seeded fractional design, and each case as records with their hidden effects."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hidden import mess
from hidden.campaigns import EVENT, EXCITATIONS, ROWS, VARIANTS
from hidden.kinds import OF_STATES, SLOW_STATE
from hidden.noise import KINDS, WRONG, added, whitened
from hidden.operators import CATALOGUE, OUTSIDE
from hidden.plant import INTERVAL
from hidden.plants import FIRST, PLANTS
from hidden.simulator import Hidden, Run, simulate
from hidden.sizes import UNIT, Nominal, needs_source, nominal, sized, units
from hidden.values import Value, misstated

Array = NDArray[np.floating]
SIZES = (1.0, 3.0, 10.0, 30.0)
TRIES = 12
MESS = 3.0
"""Units of size in messy records that are as large as the mess alone: at size 10 the effect is three times as large."""
FIRM = 1.0
"""Units by which the answer may change at half the step."""
LOUDNESS = (math.log(2e-3), math.log(2e-2))
"""Of the noise: its standard deviation in shares of an output's range, as logarithms."""
FED_BACK = ("coupling", "droop")
"""Effects that a plant's own list of feedbacks places in every second case."""
PARTS = {"single": 357, "pair": 60, "clean": 400, "outside": 50, "left-out": 60, "triple": 40, "value": 20}
"""How many cases each part has, of the first two plants together."""
MORE = {"single": 160, "pair": 30, "clean": 200, "outside": 25, "left-out": 30, "triple": 20, "value": 10}
"""How many each part has of every other plant."""
ASKED = ("triple", "value")
"""Parts that run only where they are asked for."""


@dataclass(frozen=True)
class Design:
    """One case before it is generated.

    effects: their names; size: of each, in units. told: True if the noise is stated. messy: True if the records have what those
    of real plants have.
    """

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
    messy: bool = False

    @property
    def name(self) -> str:
        """Return the name in tables."""
        return f"{self.part}-{self.number:03d}" + ("-messy" if self.messy else "")


@dataclass(frozen=True, eq=False)
class Case:
    """A case: records of two fitted experiments and a held-out one, and the truth.

    records, clean: (rows, 3, outputs), all outputs; clean: without noise. channels: the recorded ones. sigma: (outputs,) of
    the noise, with that of the quantisation of messy records. told: the stated standard deviation, or None. given: the
    parameters that a user would start from. units: the total size of the hidden effects, of messy records in units of the
    mess as well. tries: number of insertion points drawn until an effect of this size was possible. value: what the card states
    wrong, if anything; its size and draws are those that count then.
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
    value: Value | None = None

    @property
    def times(self) -> Array:
        """Return the rows' times, s."""
        return np.arange(ROWS) * INTERVAL * PLANTS[self.design.plant].pace

    @property
    def event(self) -> float:
        """Return the time of the event, s."""
        return EVENT * PLANTS[self.design.plant].pace

    @property
    def truth(self) -> list[dict[str, Any]]:
        """Return the hidden effects as plain numbers."""
        return [asdict(h) for h in self.hidden]


def designs(part: str, seed: int, plants: Sequence[str] = FIRST, messy: bool = False) -> tuple[Design, ...]:
    """Return the designs of one part for some of the plants: all effects equally often, the other factors balanced within each.

    The first two plants share their designs, every other plant has designs of its own, so that none depends on the choice of
    plants. messy: the same designs with messy records.
    """
    found: list[Design] = []
    if set(plants) & set(FIRST):
        rng = np.random.default_rng([seed, list(PARTS).index(part)])
        found += [d for d in _designs(part, rng, PARTS[part], FIRST, 0) if d.plant in plants]
    for number, plant in enumerate(PLANTS, start=1):
        if plant in plants and plant not in FIRST:
            rng = np.random.default_rng([seed, list(PARTS).index(part), number])
            found += _designs(part, rng, MORE[part], (plant,), 1000 * number)
    return tuple(replace(d, messy=messy) for d in found)


def _designs(part: str, rng: np.random.Generator, count: int, plants: Sequence[str], first: int) -> Iterator[Design]:
    """Return the designs of one part for plants that share them, with numbers from the first on."""
    known = [n for n in CATALOGUE if n != "inductance" or any(PLANTS[p].resistance[0] for p in plants)]
    if all(PLANTS[p].servos for p in plants):
        known += OF_STATES
    names = {"outside": list(OUTSIDE), "clean": [""], "value": [""]}.get(part, known)
    each = -(-count // len(names))
    tables = {name: _balanced(rng, each, part, plants) for name in names}
    for number in range(count):
        name = names[number % len(names)]
        row = tables[name][number // len(names)]
        effects: tuple[str, ...] = (name,) if name else ()
        plant = "station" if name == "inductance" else row["plant"]
        if part == "pair":
            effects = (name, str(rng.choice([n for n in names if n not in (name, "inductance")])))
        if part == "triple":
            others = [n for n in names if n not in (name, "inductance")]
            effects = (name, *map(str, rng.choice(others, size=2, replace=False)))
        if part == "clean" and row["noise"] == "unreached":
            effects = ("limit",)
        yield Design(part, first + number, effects=effects, **(row | {"plant": plant}))


def factorial(seed: int) -> tuple[Design, ...]:
    """Return every combination of the factors for a single effect; the insertion point is drawn, as in the fractional design."""
    rng = np.random.default_rng([seed, 99])
    rows = product(CATALOGUE, FIRST, SIZES, KINDS, EXCITATIONS, (False, True), (True, False), range(VARIANTS))
    found: list[Design] = []
    for effect, plant, size, noise, excitation, removed, told, variant in rows:
        if effect == "inductance" and plant != "station":
            continue
        level = float(np.exp(rng.uniform(LOUDNESS[0], LOUDNESS[1])))
        factors = (effect,), size, noise, excitation, removed, told, level, variant
        found.append(Design("single", len(found), plant, *factors))
    return tuple(found)


def _balanced(rng: np.random.Generator, count: int, part: str, plants: Sequence[str]) -> list[dict[str, Any]]:
    """Return rows of factors with all levels equally often (at most one more)."""
    noise: Sequence[str] = KINDS
    sizes: Sequence[float] = SIZES
    if part == "clean":
        noise = [k for k in KINDS for _ in range(5)] + [*WRONG, "unreached"]
        sizes = (0.0,)
    elif part != "single":
        sizes = (10.0, 30.0)
    levels: dict[str, Sequence[Any]] = {
        "plant": tuple(plants),
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
    """Return the case; None if none of TRIES insertion points, or wrong values, reaches the size of the design."""
    key = [seed, list(PARTS).index(design.part), design.number]
    rng = np.random.default_rng([*key, 7])
    base = nominal(design.plant, design.excitation, design.variant)
    plant = base.plant
    extent = np.ptp(base.outputs[:, :2], axis=(0, 1))
    own = design.level * np.maximum(extent, 0.02 * np.abs(base.outputs).max(axis=(0, 1)))
    levels = mess.resolution(base.outputs)
    sigma = np.hypot(own, levels / np.sqrt(12.0)) if design.messy else own
    channels = tuple(range(len(plant.outputs)))
    if design.removed:
        lost = int(rng.integers(len(plant.outputs)))
        channels = tuple(k for k in channels if k != lost)
    kind = design.noise if design.noise in KINDS else "ar" if design.noise == "told-white" else "white"
    unit = 1.0
    if design.messy and (design.effects or design.part == "value"):
        alone = mess.recorded(plant, base.runs, [], extent, [*key, 8])
        unit = math.hypot(1.0, float(units(base, alone[:, :2, None], sigma, kind, channels)[0]) / MESS)
    hidden: list[Hidden] = []
    value, runs = None, base.runs
    if design.part == "value":
        wrong = misstated(base, design.size * unit, sigma, kind, channels, rng, TRIES)
        if wrong is None:
            return None
        value, clean, size, tries = wrong
        size, runs = size / unit, value.truly(runs)
    else:
        drawn = _drawn(design, base, sigma, kind, channels, key, rng, unit)
        if drawn is None:
            return None
        hidden, clean, size, tries = drawn
    if design.messy:
        hidden = mess.on_coarse_steps(plant, hidden)
        clean = mess.recorded(plant, runs, hidden, extent, [*key, 8])
        if not np.isfinite(clean).all():
            return None
    event = round(EVENT / INTERVAL)
    noise = "white" if design.noise in ("told-half", "unreached") else design.noise
    records = np.stack([added(rng, clean[:, k], own, noise, event) for k in range(3)], axis=1)
    if design.messy:
        records = mess.quantised(records, levels)
    given = {n: plant.parameters[n] * float(np.exp(rng.uniform(-0.25, 0.25))) for n in plant.fitted}
    told = _told(design, sigma)
    return Case(design, tuple(hidden), records, clean, channels, sigma, told, given, runs, size, tries, value)


def _drawn(
    design: Design,
    base: Nominal,
    sigma: Array,
    kind: str,
    channels: tuple[int, ...],
    key: list[int],
    rng: np.random.Generator,
    unit: float,
) -> tuple[list[Hidden], Array, float, int] | None:
    """Return the hidden effects, the plant's response, the size in units and the insertion points drawn; None after too many.

    unit: of the case, in units of the noise.
    """
    for tries in range(1, TRIES + 1):
        hidden: list[Hidden] = []
        for k, effect in enumerate(design.effects):
            at, source = _place(rng, base, effect, [h.at for h in hidden])
            if design.noise == "unreached":
                peak = float(np.abs(base.slots[at]).max())
                found: Hidden | None = Hidden("limit", at, {"level": 1.3 * peak + 0.05})
            else:
                seed = [*key, tries, k]
                found = sized(base, effect, at, source, design.size * unit, sigma, kind, channels, seed)
            if found is None:
                break
            hidden.append(found)
        if len(hidden) < len(design.effects):
            continue
        clean = simulate(base.plant, base.runs, hidden) if hidden else base.outputs
        if not np.isfinite(clean).all() or (hidden and not _firm(base, hidden, clean, sigma, kind, channels)):
            continue
        size = float(units(base, clean[:, :2, None], sigma, kind, channels)[0]) / unit
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
    if not any(h.effect in OF_STATES or (CATALOGUE | OUTSIDE)[h.effect].stepped for h in hidden):
        return True
    off = simulate(base.plant, base.runs, hidden, step=0.5 * base.plant.step) - clean
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
    if effect in OF_STATES:
        states = [s for s in (plant.servos if effect == SLOW_STATE else plant.bounded) if s not in taken]
        return str(rng.choice(states)), ""
    if effect in FED_BACK and plant.feedbacks and rng.random() < 0.5:
        pairs = [f for f in plant.feedbacks if f[0] not in taken]
        return pairs[int(rng.integers(len(pairs)))]
    while True:
        at = str(rng.choice(places))
        if at in taken:
            continue
        if not needs_source(effect):
            return at, ""
        order = list(plant.slots)
        before = order if at.startswith("outputs.") else order[: order.index(at)]
        known = {*plant.inputs, *(s for s in plant.states if s in order), *(o for o in plant.outputs if o in before)}
        open_to = [n for n in known if n != at]
        # The slot's own signal under another name would make of every one of these effects a gain.
        moving = sorted(
            n for n in open_to if np.ptp(base.slots[n]) > 1e-6 and not _alike(base.slots[n], base.slots[at])
        )
        if moving:
            return at, str(rng.choice(moving))


def _alike(a: Array, b: Array) -> bool:
    """Return True if one signal is a multiple of the other."""
    return abs(float(np.vdot(a, b))) > (1.0 - 1e-9) * float(np.linalg.norm(a) * np.linalg.norm(b))
