"""Coverage of the 95 % intervals that a fit states, over kinds of problem: how often they hold the true value.

    python benchmarks/coverage.py [--records 200] [--kinds line forced ...] [--workers 2]

Every kind is a small plant with records of its own noise, fitted as a user fits them (`hvdc_ident.fit`: identified, gated, fitted).
Of each parameter that is fitted the share of stated intervals that hold the truth is counted; of those held on a bound too, whose
interval ends at one limit. An estimate without interval is counted as such. Intervals that hold for others as held
(`conditional_on`, or a held one by its reason) are counted where these are held at their true values.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from concurrent.futures import ProcessPoolExecutor
from functools import cache, partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from scipy.stats import binom

import hvdc_ident as hi
from hvdc_ident.data import Array
from hvdc_ident.fit import FitParameter, FitResult, Problem, fit
from hvdc_ident.fit.frequency_data import with_responses
from hvdc_ident.identifiability import gated_fit, identifiability
from hvdc_ident.linearize import MeasuredResponse
from hvdc_ident.parameters import Parameter

Kind = Callable[[np.random.Generator], tuple[FitResult, Mapping[str, float]]]
"""From a random generator the fit to one record, and the true values."""
KINDS: dict[str, Kind] = {}
SURE = 1e-3
"""Two-sided chance by which a count is called out of the range of chance."""


def kind(function: Kind) -> Kind:
    """Enter a kind under the name of its function."""
    KINDS[function.__name__.replace("_", "-")] = function
    return function


@cache
def formula(text: str, *parameters: Parameter | tuple[str, float]) -> hi.Model:
    """Return the model whose output y is a formula of the time."""
    table = {p[0]: p[1] for p in parameters}
    return hi.Model("plant", parameters=table, states={"z": {"derivative": "0", "start": "0"}}, outputs={"y": text})


@cache
def lag() -> hi.Model:
    """Return a lag T behind a gain k, from u to y."""
    table = {"T": 1.0, "k": 2.0}
    return hi.Model("lag", parameters=table, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})


def record(t: Array, y: Array, noise: float | None, name: str = "e", **more: object) -> hi.Experiment:
    """Return a record of y. noise: its standard deviation as stated, None where it is not."""
    return hi.Experiment(t, name, outputs={"y": y}, noise={} if noise is None else {"y": noise}, **more)


def coloured(rng: np.random.Generator, n: int, rho: float) -> Array:
    """Return a stationary AR(1) noise of standard deviation 1."""
    e = rng.standard_normal(n)
    for k in range(1, n):
        e[k] = rho * e[k - 1] + np.sqrt(1.0 - rho**2) * e[k]
    return e


LINE = "a*time + b"
AB = {"a": (0.0, 5.0), "b": (-3.0, 3.0)}
TIME = np.linspace(0.0, 1.0, 60)
DECAY = "a*exp(-k*time)"
AK = {"a": (0.1, 10.0), "k": (0.1, 10.0)}
TRUE_DECAY = {"a": 2.0, "k": 1.5}


def line(a: float = 1.5, b: float = 0.2) -> hi.Model:
    return formula(LINE, ("a", a), ("b", b))


def decay() -> hi.Model:
    return formula(DECAY, ("a", 1.0), ("k", 1.0))


def decayed(rng: np.random.Generator, n: int, sigma: float, *, stated: bool) -> tuple[FitResult, Mapping[str, float]]:
    t = np.linspace(0.0, 2.0, n)
    y = 2.0 * np.exp(-1.5 * t) + sigma * rng.standard_normal(n)
    return hi.fit(decay(), record(t, y, sigma if stated else None), AK), TRUE_DECAY


@kind
def straight_line(rng):
    y = 2.0 * TIME + 0.3 + 0.1 * rng.standard_normal(TIME.size)
    return hi.fit(line(), record(TIME, y, 0.1), AB), {"a": 2.0, "b": 0.3}


@kind
def nonlinear(rng):
    return decayed(rng, 60, 0.1, stated=True)


@kind
def unknown_noise(rng):
    return decayed(rng, 60, 0.1, stated=False)


@kind
def few_rows(rng):
    return decayed(rng, 8, 0.1, stated=True)


@kind
def few_rows_of_unknown_noise(rng):
    return decayed(rng, 8, 0.05, stated=False)


@kind
def noise_before_the_event(rng):
    t = np.linspace(0.0, 5.0, 151)
    y = 3.0 * np.where(t > 1.0, 1.0 - np.exp(-(t - 1.0) / 0.5), 0.0) + 0.2 * rng.standard_normal(t.size)
    found = hi.fit(
        lag(), record(t, y, None, inputs={"u": hi.step(0.0, 1.0, at=1.0)}), {"T": (0.1, 10.0), "k": (0.0, 10.0)}
    )
    return found, {"T": 0.5, "k": 3.0}


@kind
def wide_and_logarithmic(rng):
    t = np.linspace(0.0, 2.0, 40)
    y = 2.0 * np.exp(-1.5 * t) + 0.5 * rng.standard_normal(t.size)
    return hi.fit(decay(), record(t, y, 0.5), {"a": (1e-3, 1e3), "k": (1e-3, 1e3)}), TRUE_DECAY


@kind
def beside_a_bound(rng):
    """The best b lies about its upper bound, which is no physical one; the vendor's b is 2 standard deviations off."""
    t = np.linspace(0.0, 1.0, 30)
    y = 2.0 * t - 0.017 + 0.1 * rng.standard_normal(30)
    return hi.fit(line(1.5, -0.1), record(t, y, 0.1), {"a": (0.0, 5.0), "b": (-1.0, 0.0)}), {"a": 2.0, "b": -0.017}


@kind
def truth_on_a_physical_bound(rng):
    """A leak k that cannot be negative and is not there."""
    model = formula("a*exp(-k*time)", ("a", 1.0), ("k", Parameter(0.1, min=0.0)))
    y = 2.0 + 0.1 * rng.standard_normal(TIME.size)
    return hi.fit(model, record(TIME, y, 0.1), {"a": (0.1, 10.0), "k": {"max": 5.0}}), {"a": 2.0, "k": 0.0}


@kind
def held_partner(rng):
    """Of a and b only the product shows: one is held at its true value."""
    model = formula("a*b*time + c", ("a", 2.0), ("b", 3.0), ("c", 0.0))
    y = 6.0 * TIME + 0.5 + 0.2 * rng.standard_normal(TIME.size)
    bounds = {"a": (0.1, 10.0), "b": (0.1, 10.0), "c": (-5.0, 5.0)}
    return hi.fit(model, record(TIME, y, 0.2), bounds), {"a": 2.0, "b": 3.0, "c": 0.5}


@kind
def forced(rng):
    """Two exponentials that hide each other: all four are forced."""
    t = np.linspace(0.3, 10.0, 100)
    y = 3.0 * np.exp(-t / 2.0) - 5.0 * np.exp(-t / 10.0) + 0.2 * rng.standard_normal(t.size)
    truth = {"a1": 3.0, "a2": -5.0, "t1": 2.0, "t2": 10.0}
    model = formula("a1*exp(-time/t1) + a2*exp(-time/t2)", *truth.items())
    bounds = {"a1": (0.01, 50.0), "a2": (-50.0, -0.01), "t1": (0.05, 20.0), "t2": (0.5, 100.0)}
    return hi.fit(model, record(t, y, 0.2), bounds, force=list(bounds)), truth


@kind
def forced_and_weak(rng):
    """A rise whose end the record does not show."""
    t = np.linspace(0.0, 1.0, 50)
    y = 2.0 * (1.0 - np.exp(-0.7 * t)) + 0.05 * rng.standard_normal(t.size)
    model = formula("a*(1 - exp(-k*time))", ("a", 1.0), ("k", 1.0))
    bounds = {"a": (0.0, 100.0), "k": (0.0, 20.0)}
    return hi.fit(model, record(t, y, 0.05), bounds, force=list(bounds)), {"a": 2.0, "k": 0.7}


@kind
def coloured_noise(rng):
    t = np.linspace(0.0, 2.0, 200)
    y = 2.0 * np.exp(-1.5 * t) + 0.1 * coloured(rng, t.size, 0.7)
    return hi.fit(decay(), record(t, y, 0.1), AK), TRUE_DECAY


@kind
def coloured_noise_of_unknown_size(rng):
    t = np.linspace(0.0, 2.0, 200)
    y = 2.0 * np.exp(-1.5 * t) + 0.1 * coloured(rng, t.size, 0.7)
    return hi.fit(decay(), record(t, y, None), AK), TRUE_DECAY


@kind
def rounded(rng):
    """The recorder's steps are twice the noise."""
    t = np.linspace(0.0, 5.0, 151)
    y = 3.0 * np.where(t > 1.0, 1.0 - np.exp(-(t - 1.0) / 0.5), 0.0) + 0.05 * rng.standard_normal(t.size)
    y = 0.1 * np.round(y / 0.1)
    found = hi.fit(
        lag(), record(t, y, None, inputs={"u": hi.step(0.0, 1.0, at=1.0)}), {"T": (0.1, 10.0), "k": (0.0, 10.0)}
    )
    return found, {"T": 0.5, "k": 3.0}


@kind
def two_optima(rng):
    """p and -p are nearly alike: a small odd part tells them apart only in most records."""
    model = formula("p**2*time + 0.05*p*time**2 + c", ("p", 0.5), ("c", 0.0))
    y = TIME + 0.05 * TIME**2 + 0.3 + 0.1 * rng.standard_normal(TIME.size)
    return hi.fit(model, record(TIME, y, 0.1), {"p": (-3.0, 3.0), "c": (-2.0, 2.0)}), {"p": 1.0, "c": 0.3}


@kind
def tied(rng):
    model = formula("a*exp(-k*time) + b*time", ("a", 1.0), ("k", 1.0), ("b", 1.0))
    y = 2.0 * np.exp(-1.5 * TIME) + TIME + 0.1 * rng.standard_normal(TIME.size)
    return hi.fit(model, record(TIME, y, 0.1), {**AK, "b": {"tie": "0.5*a"}}), TRUE_DECAY


@kind
def own_values(rng):
    """Three records of one slope, each with an offset of its own."""
    records = [
        record(TIME, 2.0 * TIME + b + 0.1 * rng.standard_normal(TIME.size), 0.1, f"e{i}")
        for i, b in enumerate((0.3, -0.5, 1.0))
    ]
    own = {"min": -3.0, "max": 3.0, "per-experiment": True}
    return hi.fit(line(), records, {"a": (0.0, 5.0), "b": own}), {"a": 2.0, "e0:b": 0.3, "e1:b": -0.5, "e2:b": 1.0}


@kind
def records_and_outputs(rng):
    """Two records of two outputs, of known and of unknown noise."""
    model = hi.Model(
        "pair", parameters={"T": 1.0, "k": 2.0, "g": 1.0}, inputs={"u": 0.0},
        states={"x": "(k*u - x)/T"}, outputs={"y": "x", "v": "g*x"},
    )  # fmt: skip
    t = np.linspace(0.0, 3.0, 61)
    records = []
    for i, size in enumerate((1.0, -0.5)):
        x = size * 3.0 * (1.0 - np.exp(-t / 0.5))
        seen = {"y": x + 0.1 * rng.standard_normal(t.size), "v": 0.5 * x + 0.2 * rng.standard_normal(t.size)}
        step = {"u": hi.step(0.0, size, at=0.0)}
        records.append(hi.Experiment(t, f"e{i}", inputs=step, outputs=seen, noise={"y": 0.1}, starts={"x": 0.0}))
    return hi.fit(model, records, {"T": (0.1, 10.0), "k": (0.0, 10.0), "g": (0.0, 5.0)}), {"T": 0.5, "k": 3.0, "g": 0.5}


@kind
def frequency_response(rng):
    omega = np.logspace(-1.0, 2.0, 25)
    exact = 3.0 / (1.0 + 0.5j * omega)
    std = 0.05 * np.ones((omega.size, 1))
    noise = (rng.standard_normal(omega.size) + 1j * rng.standard_normal(omega.size)) * 0.05 / np.sqrt(2.0)
    measured = MeasuredResponse("r", "transfer", (("y", "u"),), omega, (exact + noise)[:, None], std)
    return of_problem(lag(), measured), {"T": 0.5, "k": 3.0}


@kind
def frequency_response_of_unknown_noise(rng):
    omega = np.logspace(-1.0, 2.0, 25)
    exact = 3.0 / (1.0 + 0.5j * omega)
    noise = (rng.standard_normal(omega.size) + 1j * rng.standard_normal(omega.size)) * 0.05 / np.sqrt(2.0)
    measured = MeasuredResponse("r", "transfer", (("y", "u"),), omega, (exact * (1.0 + noise))[:, None])
    return of_problem(lag(), measured), {"T": 0.5, "k": 3.0}


def of_problem(model: hi.Model, measured: MeasuredResponse) -> FitResult:
    """Return the gated fit of T and k to a measured response."""
    simulator, experiments = with_responses(model, (), (measured,))
    free = (FitParameter("T", 1.0, 0.1, 10.0), FitParameter("k", 2.0, 0.0, 10.0))
    problem = Problem(simulator, experiments, free)
    return gated_fit(problem, identifiability(simulator, experiments, free), partial(fit))


@kind
def frequency_of_a_sine(rng):
    t = np.linspace(0.0, 10.0, 200)
    y = 1.3 * np.sin(2.9 * t + 1.5) + 0.1 * rng.standard_normal(t.size)
    model = formula("A*sin(w*time + ph)", ("A", 0.9), ("w", 2.0), ("ph", 0.01))
    bounds = {"A": (0.0, 5.0), "w": (0.5, 6.0), "ph": (0.0, 2.0 * np.pi)}
    return hi.fit(model, record(t, y, None), bounds), {"A": 1.3, "w": 2.9, "ph": 1.5}


@kind
def unknown_start(rng):
    """A lag that is not at rest when its record begins: where its state starts is estimated too."""
    t = np.linspace(0.0, 3.0, 61)
    y = 3.0 + (1.0 - 3.0) * np.exp(-t / 0.5) + 0.1 * rng.standard_normal(t.size)
    seen = record(t, y, 0.1, inputs={"u": 1.0}, starts={"x": 0.5}, nuisance=("x",))
    return hi.fit(lag(), seen, {"T": (0.1, 10.0), "k": (0.0, 10.0)}), {"T": 0.5, "k": 3.0}


def one(job: tuple[str, int]) -> list[tuple[str, float | None, float | None, float | None, str]]:
    """Return of each parameter its name, value, the ends of its interval, and what it is: stated, none, held."""
    name, seed = job
    result, truth = KINDS[name](np.random.default_rng([seed, 4711]))
    rows = []
    known = dict(result.estimates) | {f"{e}:{n}": v for e, line in result.nuisance.items() for n, v in line.items()}
    for parameter, true in truth.items():
        e = known.get(parameter)
        if e is None:
            rows.append((parameter, result.values.get(parameter), None, None, "held"))
            continue
        off = [n for n in e.conditional_on if n in result.held and result.values[n] != truth[n]]
        low, high = e.ci95 or (None, None)
        if (low is None and high is None) or off:
            rows.append((parameter, e.value, None, None, "conditional" if off else "none"))
            continue
        low, high = -np.inf if low is None else low, np.inf if high is None else high
        inside = low <= true <= high or "another optimum" in e.reason or "so does" in e.reason
        rows.append((parameter, e.value, low, high, "in" if inside else "out"))
    return rows


def main(names: list[str], records: int, workers: int) -> dict[str, dict[str, dict[str, int]]]:
    """Return by kind and parameter how many intervals were in, out, or not stated."""
    table: dict[str, dict[str, dict[str, int]]] = {}
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        for name in names:
            counts: dict[str, dict[str, int]] = {}
            for rows in pool.map(one, [(name, seed) for seed in range(records)], chunksize=10):
                for parameter, _, _, _, what in rows:
                    line = counts.setdefault(parameter, dict.fromkeys(("in", "out", "none", "conditional", "held"), 0))
                    line[what] += 1
            table[name] = counts
            tell(name, counts)
    return table


def tell(name: str, counts: Mapping[str, Mapping[str, int]]) -> None:
    """Print the counts of one kind, a line a parameter."""
    for parameter, c in counts.items():
        n = c["in"] + c["out"]
        share = f"{100.0 * c['in'] / n:5.1f} %" if n else "   -   "
        low, high = binom.ppf([SURE / 2, 1.0 - SURE / 2], n, 0.95) if n else (0, 0)
        sign = "" if not n else "  TOO FEW" if c["in"] < low else "  too many" if c["in"] > high else ""
        others = ", ".join(f"{k} {c[k]}" for k in ("none", "conditional", "held") if c[k])
        print(f"{name:38} {parameter:5} {c['in']:4} of {n:4} {share}{sign}  {others}", flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser()
    parser.add_argument("--records", type=int, default=200)
    parser.add_argument("--kinds", nargs="*", choices=list(KINDS), default=list(KINDS))
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--json", type=Path, help="a file for the counts")
    options = parser.parse_args()
    found = main(options.kinds, options.records, options.workers)
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
