"""Plants of other code: scipy integrates their equations and the files of a study are written; the package is not imported.

A plant has the equations twice: as Python for scipy, here, and as the text of a model card, which the package reads. What the
card lacks (the plant's `hidden` effect) stands in the Python alone.
"""

from __future__ import annotations

import itertools
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp
from scipy.optimize import root

Values = Mapping[str, float]
Steps = Sequence[tuple[float, float]]


@dataclass(frozen=True)
class Record:
    """One recording: each input's steps as (time in s, value from then on), the first being the rest."""

    name: str
    inputs: Mapping[str, Steps]
    duration: float
    step: float
    role: str = "fit"

    def __post_init__(self) -> None:
        assert np.isin(np.round(self.breaks, 9), self.time).all(), "a step that no row shows"

    @property
    def time(self) -> np.ndarray:
        """(n,) instants in s."""
        return np.round(np.arange(round(self.duration / self.step) + 1) * self.step, 9)

    def input(self, name: str, time: float) -> float:
        """The input's value from `time` on."""
        return [value for begin, value in self.inputs[name] if begin <= time][-1]

    @property
    def breaks(self) -> list[float]:
        """The instants at which an input steps."""
        return sorted({begin for steps in self.inputs.values() for begin, _ in steps[1:]})


@dataclass(frozen=True)
class Hidden:
    """An effect that the plant has and its card lacks; as the catalogue names it, with where it sits and how large it is.

    others: effects that the same records may show as well, so that an ambiguity with them is a right answer.
    """

    effect: str
    at: Sequence[str]
    parameters: Values
    others: Sequence[str] = ()


@dataclass(frozen=True)
class Plant:
    """A plant with its card and records.

    derivative(t, x, u, p, h), outputs(x, u, p, h): in numbers, h the hidden effect's parameters or None. begin: a guess of the
    rest; settling: s after which the plant has come near its rest from there. true: the plant's values, which differ from the
    card's. bounds: of those that are to be estimated. noise: standard deviation of each output. rest: the inputs' values
    where a record does not move them. write: writes one record's columns to a file and returns the lines of its
    [[experiment]]. extra: guesses of the states that the hidden effect adds. delayed: inputs that reach the plant later by
    the hidden effect's T.
    """

    name: str
    card: str
    begin: Values
    true: Values
    bounds: Mapping[str, tuple[float, float]]
    noise: Values
    rest: Values
    records: Sequence[Record]
    derivative: Callable[..., Sequence[float]]
    outputs: Callable[..., Mapping[str, Any]]
    hidden: Hidden
    write: Callable[[Path, Record, Mapping[str, np.ndarray]], str]
    extra: Callable[[Values, Values, Values], Sequence[float]] = lambda u, p, h: ()
    delayed: Sequence[str] = ()
    settling: float = 60.0

    @property
    def given(self) -> dict[str, float]:
        """The card's values of the parameters."""
        return {n: q["value"] for n, q in tomllib.loads(self.card)["parameters"].items()}

    def run(self, record: Record, hidden: bool) -> dict[str, np.ndarray]:
        """Time, inputs and outputs without noise, at the record's instants; a row at a step shows what follows it."""
        h = dict(self.hidden.parameters) if hidden else None
        late = h["T"] if h is not None and self.delayed else 0.0
        plan = {
            n: [(t if k == 0 or n not in self.delayed else t + late, v) for k, (t, v) in enumerate(s)]
            for n, s in record.inputs.items()
        }
        seen = Record(record.name, plan, record.duration, record.step)
        u = {**self.rest, **{n: s[0][1] for n, s in plan.items()}}
        guess = [*self.begin.values(), *(self.extra(u, self.true, h) if h is not None else ())]
        x = self.steady_state(self.true, u, h, guess)
        time, edges = record.time, [0.0, *[b for b in seen.breaks if b < record.duration], record.duration]
        columns: dict[str, list[np.ndarray]] = {}
        for begin, end in itertools.pairwise(edges):
            u = {**self.rest, **{n: seen.input(n, begin) for n in plan}}
            last = end == record.duration
            rows = time[(time >= begin - 1e-12) & ((time < end - 1e-12) | last)]
            found = solve_ivp(
                self.derivative, (begin, end), x, method="LSODA", t_eval=np.union1d(rows, [end]), args=(u, self.true, h),
                rtol=1e-9, atol=1e-11,
            )  # fmt: skip
            assert found.success, (self.name, found.message)
            x = found.y[:, -1]
            states = found.y[:, : rows.size] if not last else found.y
            out = self.outputs(states, u, self.true, h)
            for name, values in out.items():
                columns.setdefault(name, []).append(np.broadcast_to(values, rows.shape).astype(float))
        shown = {n: np.array([record.input(n, t) for t in time]) for n in plan}
        return {"time": time, **shown, **{n: np.concatenate(v) for n, v in columns.items()}}

    def steady_state(self, p: Values, u: Values, h: Values | None, guess: Sequence[float]) -> np.ndarray:
        """The stable steady state next to the guess, (n,)."""

        def rates(x: np.ndarray) -> np.ndarray:
            return np.asarray(self.derivative(0.0, x, u, p, h), dtype=float)

        # Followed from the guess for a while the plant is where Newton's method ends on the stable steady state.
        near = solve_ivp(lambda t, x: rates(x), (0.0, self.settling), guess, method="LSODA", rtol=1e-8, atol=1e-10)
        x = root(rates, near.y[:, -1], tol=1e-13).x
        slopes = np.column_stack([(rates(x + e) - rates(x - e)) / 2e-6 for e in 1e-6 * np.eye(x.size)])
        assert np.abs(rates(x)).max() < 1e-8 and np.linalg.eigvals(slopes).real.max() < 1e-6, self.name
        return x

    def study(self, folder: Path, *, hidden: bool, seed: int, tables: str) -> Path:
        """The path of a study with its card and recordings, in the folder. tables: the text of the stages' tables."""
        assert {n for n in self.given if self.given[n] != self.true[n]} <= set(self.bounds), (
            "a value off the card is not estimated"
        )
        rng = np.random.default_rng(seed)
        (folder / "model.toml").write_text(self.card, encoding="utf-8")
        parts = [f'schema = 1\nname = "{self.name}"\n[model]\nsource = "model.toml"\n[parameters]']
        parts += [f"{n} = {{min = {low}, max = {high}}}" for n, (low, high) in self.bounds.items()]
        for record in self.records:
            columns = self.run(record, hidden)
            for n, sigma in self.noise.items():
                columns[n] = columns[n] + sigma * rng.standard_normal(record.time.size)
            parts.append(f'\n[[experiment]]\nname = "{record.name}"\nrole = "{record.role}"')
            parts.append(self.write(folder, record, columns))
        path = folder / "study.toml"
        path.write_text("\n".join([*parts, tables, ""]), encoding="utf-8")
        return path
