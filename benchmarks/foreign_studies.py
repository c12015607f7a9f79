"""Studies of one FMU for `foreign_fmus.py`: FMPy makes the records, `hvdc-ident` is asked as a user asks it.

Noise is 0.1 % of each output's range, seeded and stated. Inputs are stairs, held between rows: so that all tools can be
given the same. A parameter is planted 10 % off its start value; what is hidden at an input has a size of a fiftieth of the
record, which is 20 ms of a second.
"""

from __future__ import annotations

import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from foreign_cases import REAL, RTOL, Array, Peer, Plan, Told, ranges

from hvdc_ident import load_study
from hvdc_ident.fit.optimisers.trust_region import TrustRegion
from hvdc_ident.study.fitting import problem_of

NOISE, PLANTED, GAIN = 1e-3, 1.1, 1.05
FINER = 5  # parts of a row's interval in which a lagged input is given
SHARE = 50  # of the record
MOVES = 0.02  # of the range, the least that a planted parameter has to move an output by
DIVERGED = 100.0  # ranges: a parameter that moves an output by more has made the FMU's own solver unstable
FITTED, APART = 4, 0.9999  # parameters of which runs are counted; cosine between responses above which two are one
SEEN = 0.005  # of the range, the least that what is hidden has to move an output by
LONG = 8  # iterations of a fit from which the runs of its first derivative count among them
MOST_OUTPUTS, MOST_TRIED, SECONDS_TRIED = 4, 40, 60.0
COMMAND = "from hvdc_ident.cli import main; main()"


@dataclass(frozen=True)
class Record:
    """One experiment: what the FMU was told to get, and what came out, NaN where FMPy reads on the other side of a jump."""

    rows: Array
    inputs: Mapping[str, Array]
    outputs: Array


@dataclass(frozen=True)
class Mover:
    """A parameter, and how the outputs move with it, over their ranges."""

    name: str
    start: float
    bounds: tuple[float, float]
    response: Array

    @property
    def size(self) -> float:
        return float(np.nanmax(np.abs(self.response)))


def stairs(peer: Peer, seed: int | None, times: float = 1.0) -> dict[str, Array]:
    """Each continuous input at each row: a step and a sine in stairs; with a seed, random stairs, so many times larger."""
    plan = peer.plan()
    last = np.searchsorted(plan.corners, plan.rows, side="right") - 1
    values = {n: v[last] for n, v in plan.inputs.items()}
    if seed is None:
        return values
    random = np.random.default_rng(seed)
    for v in peer.inputs:
        if v.type in REAL and v.variability == "continuous":
            length = plan.rows.size // 20
            levels = random.uniform(-0.5, 0.5, plan.rows.size // length + 1)
            levels[0] = 0.0  # the record begins at the start value
            u = peer.start(v) + times * peer.size(v) * np.repeat(levels, length)[: plan.rows.size]
            u[-1] = u[-2]
            values[v.name] = u
        else:
            values[v.name] = np.full(plan.rows.size, peer.start(v))
    return values


def recorded(
    peer: Peer,
    inputs: Mapping[str, Array],
    values: Mapping[str, float] | None = None,
    *,
    hidden: str = "",
    at: str = "",
) -> Record:
    """FMPy's run with held inputs; hidden: a lag or a delay at one of them, done to its values exactly."""
    rows = peer.grid
    late = round((rows.size - 1) / SHARE)
    given = dict(inputs)
    if hidden == "delay":
        u = inputs[at]
        given[at] = np.concatenate([np.full(late, u[0]), u[:-late]])
    if hidden == "lag":
        return Record(rows, inputs, _lagged(peer, rows, given, at, late, values))
    jumps = np.zeros(rows.size, dtype=bool)
    for u in given.values():
        jumps[1:] |= np.diff(u) != 0.0
    return Record(rows, inputs, _run(peer, held(rows, given, jumps), values, jumps))


def held(rows: Array, inputs: Mapping[str, Array], jumps: Array) -> Plan:
    """The plan of inputs that hold from row to row."""
    corners = np.sort(np.concatenate([rows, rows[jumps]]))
    place = np.searchsorted(rows, corners)
    first = np.zeros(corners.size, dtype=bool)
    first[:-1] = corners[:-1] == corners[1:]
    # Between jumps the value stands: before one it is the last row's.
    return Plan(rows, corners, {n: u[np.where(first, place - 1, place)] for n, u in inputs.items()})


def _lagged(
    peer: Peer, rows: Array, inputs: Mapping[str, Array], at: str, late: int, values: Mapping[str, float] | None
) -> Array:
    """Outputs with one input behind a lag of `late` rows, given as its mean in each step of a finer grid."""
    step = (rows[1] - rows[0]) / FINER
    fine = rows[0] + step * np.arange((rows.size - 1) * FINER + 1)
    finer = {n: np.repeat(v, FINER)[: fine.size] for n, v in inputs.items()}
    u, a = finer[at], 1.0 / (FINER * late)
    y = np.empty(fine.size)
    y[0] = u[0]
    for k in range(fine.size - 1):
        y[k + 1] = u[k] + (y[k] - u[k]) * np.exp(-a)
    finer[at] = u + (y - u) * (1.0 - np.exp(-a)) / a
    jumps, ours = np.zeros(fine.size, dtype=bool), np.zeros(fine.size, dtype=bool)
    for n, v in finer.items():
        jumps[1:] |= np.diff(v) != 0.0
        ours[1:] |= (np.diff(inputs[n])[:, None] != 0.0).repeat(FINER, 1).ravel() & (
            np.arange(1, fine.size) % FINER == 0
        )
    plan = held(fine, finer, jumps)
    divide = FINER if peer.interface == "co-simulation" else 1
    return _run(peer, Plan(rows, plan.corners, plan.inputs), values, ours[::FINER], divide=divide)


def _run(peer: Peer, plan: Plan, values: Mapping[str, float] | None, jumps: Array, divide: int = 1) -> Array:
    y = peer.run(plan, values, divide=divide)
    if peer.interface == "co-simulation":
        y[jumps] = np.nan
    return y


def movers(peer: Peer, inputs: Mapping[str, Array]) -> tuple[Array, Array, list[Mover]]:
    """The outputs at the start values, their ranges, and the parameters that move them, the strongest first."""
    y = recorded(peer, inputs).outputs
    scale = ranges(y)
    found = []
    until = time.perf_counter() + SECONDS_TRIED
    for v in peer.parameters[:MOST_TRIED]:
        start = peer.start(v)
        low, high = (
            getattr(v, n) if getattr(v, n) is not None else getattr(v.declaredType, n, None) for n in ("min", "max")
        )
        low = max(min(0.5 * start, 2.0 * start), float(low) if low is not None else -np.inf)
        high = min(max(0.5 * start, 2.0 * start), float(high) if high is not None else np.inf)
        if start == 0.0 or not low < PLANTED * start < high or time.perf_counter() > until:
            continue
        try:
            moved = recorded(peer, inputs, {v.name: PLANTED * start}).outputs
        except Exception as e:  # FMPy's, of a value that the FMU refuses or cannot set
            print(f"{v.name}: {e}", file=sys.stderr)
            continue
        if np.isfinite(moved).sum() == np.isfinite(y).sum():
            found.append(Mover(v.name, start, (low, high), (moved - y) / scale))
    return y, scale, sorted((m for m in found if MOVES < m.size < DIVERGED), key=lambda m: -m.size)


def _text(names: Mapping[str, str]) -> str:
    return "{" + ", ".join(f"{json.dumps(n)} = {json.dumps(c)}" for n, c in names.items()) + "}"


def write_study(
    folder: Path, peer: Peer, records: Sequence[Record], scale: Array, free: Sequence[Mover], extra: str
) -> Path:
    """A study of the FMU with noisy records, the last held out where there are three."""
    random = np.random.default_rng(38)
    seen = [
        k for k in range(len(peer.names)) if np.nanmax(records[0].outputs[:, k]) > np.nanmin(records[0].outputs[:, k])
    ]
    seen = seen[:MOST_OUTPUTS]
    outputs = {peer.names[k]: f"y{k}" for k in seen}
    inputs = {n: f"u{k}" for k, n in enumerate(records[0].inputs)}
    noise = ", ".join(f"{json.dumps(peer.names[k])} = {float(NOISE * scale[k])!r}" for k in seen)
    text = ["schema = 1", 'name = "foreign"', "[model]", f"source = {json.dumps(str(peer.path))}"]
    text += [f'interface = "{peer.interface}"', "[parameters]"]
    text += [
        f"{json.dumps(m.name)} = {{start = {float(m.start)!r}, min = {float(m.bounds[0])!r}, max = {float(m.bounds[1])!r}}}"
        for m in free
    ]
    for k, record in enumerate(records):
        y = record.outputs[:, seen] + NOISE * scale[seen] * random.standard_normal((record.rows.size, len(seen)))
        columns = [record.rows, *record.inputs.values(), *y.T]
        lines = [",".join(["time", *inputs.values(), *outputs.values()])]
        lines += [",".join("" if np.isnan(v) else repr(float(v)) for v in line) for line in zip(*columns, strict=True)]
        (folder / f"{k}.csv").write_text("\n".join(lines) + "\n")
        role = "holdout" if k == 2 else "fit"
        text += ["[[experiment]]", f'name = "e{k}"', f'data = "{k}.csv"', f'role = "{role}"', 'interpolation = "hold"']
        text += [f"inputs = {_text(inputs)}", f"outputs = {_text(outputs)}", f"noise = {{{noise}}}"]
    path = folder / "study.toml"
    path.write_text("\n".join([*text, extra]) + "\n")
    return path


def asked(study: Path, verb: str, told: Told) -> dict[str, Any] | None:
    """The command's JSON; None where it gave none, with what it said told."""
    begin = time.perf_counter()
    done = subprocess.run(
        [sys.executable, "-c", COMMAND, verb, str(study), "--json"],
        capture_output=True,
        encoding="utf-8",
        errors="replace",
        stdin=subprocess.DEVNULL,
    )
    told({"code": done.returncode, "seconds": time.perf_counter() - begin})
    said = [line for line in done.stderr.strip().splitlines() if line.strip()]
    crashed = "Traceback" in done.stderr or "a bug in hvdc-ident" in done.stderr or done.returncode not in (0, 1, 2)
    if done.stdout.strip():
        found: dict[str, Any] = json.loads(done.stdout)
        if not crashed and done.returncode == 0:
            return found
        said = said or [str(found.get("message", ""))]
    message = " ".join(" ".join(said[-6:] if crashed else said[-1:]).split())[-600:]
    told({"outcome": "crash" if crashed else "failed", "detail": message})
    return None


def fit(path: Path, interface: str, told: Told) -> None:
    """A planted parameter, estimated by `hvdc-ident fit`."""
    told({"stage": "fmpy"})
    peer = Peer(path, interface)
    inputs = stairs(peer, None)
    _, scale, moving = movers(peer, inputs)
    if not moving:
        told({"not_applicable": "no parameter moves an output", "stage": "done"})
        return
    planted = moving[0]
    truth = PLANTED * planted.start
    record = recorded(peer, inputs, {planted.name: truth})
    if not (np.nanmax(record.outputs, axis=0) > np.nanmin(record.outputs, axis=0)).any():
        told({"not_applicable": "no output moves in the record", "stage": "done"})
        return
    told({"stage": "run", "parameter": planted.name, "truth": truth})
    with tempfile.TemporaryDirectory() as folder:
        study = write_study(Path(folder), peer, [record], scale, [planted], "[fit]")
        found = asked(study, "fit", told)
    if found is None:
        return
    estimate = found["estimates"].get(planted.name)
    if planted.name not in found["fitted"] or estimate is None:
        why = found["held"].get(planted.name, found.get("message", ""))
        told({"outcome": "held", "detail": f"{planted.name}: {why}", "stage": "done"})
        return
    low, high = estimate["ci95"] or (None, None)
    inside = low is not None and high is not None and low <= truth <= high
    wide = high - low if low is not None and high is not None else 0.0
    off = (estimate["value"] - truth) / (0.25 * wide) if wide > 0.0 else None
    detail = f"{planted.name} = {estimate['value']:.8g}, true {truth:.8g}, 95 % {estimate['ci95']}, {found['status']}"
    judged = (found["adequacy"] or {}).get("text")
    detail += f"; {judged}" if judged and not inside else ""
    told({"outcome": "ok" if inside else "outside", "sigmas": off, "detail": detail, "stage": "done"})


def runs(path: Path, interface: str, told: Told) -> None:
    """Whole runs of the FMU that an iteration of a fit of four parameters takes, the first derivative's among them."""
    told({"stage": "fmpy"})
    peer = Peer(path, interface)
    inputs = stairs(peer, None)
    _, scale, moving = movers(peer, inputs)
    free: list[Mover] = []
    for m in moving:
        if len(free) < FITTED and all(_alike(m.response, other.response) < APART for other in free):
            free.append(m)
    if len(free) < FITTED:
        told({"not_applicable": f"{len(free)} parameters that move outputs each in its own way", "stage": "done"})
        return
    record = recorded(peer, inputs, {m.name: PLANTED * m.start for m in free})
    told({"stage": "run", "parameter": ", ".join(m.name for m in free)})
    with tempfile.TemporaryDirectory() as folder:
        path_of = write_study(Path(folder), peer, [record], scale, free, "[fit]")
        alone = load_study(path_of)
        problem_of(alone).residual(problem_of(alone).start)
        first = alone.model.pool.runs
        alone.model.pool.close()
        study = load_study(path_of)
        problem, host = problem_of(study), study.model.pool
        end = TrustRegion().run(problem, problem.start)
        iterations = end.evaluations
        each = host.runs / iterations if iterations >= LONG else (host.runs - first) / iterations
        detail = f"{host.runs} runs in {iterations} iterations, {first} for the first derivative; {end.status}"
        told({"iterations": iterations, "runs": host.runs, "first": first, "each": each, "detail": detail})
        told({"outcome": "ok" if each <= FITTED + 2 else "more runs", "stage": "done"})
        host.close()


def lag(path: Path, interface: str, told: Told) -> None:
    """A lag hidden at an input."""
    diagnosed(path, interface, told, "lag")


def delay(path: Path, interface: str, told: Told) -> None:
    """A delay hidden at an input."""
    diagnosed(path, interface, told, "delay")


def gain(path: Path, interface: str, told: Told) -> None:
    """A gain hidden at an output."""
    diagnosed(path, interface, told, "gain")


def diagnosed(path: Path, interface: str, told: Told, effect: str) -> None:
    """Verdict on what is hidden, looked for by `hvdc-ident diagnose`: named, in the set, or missed."""
    told({"stage": "fmpy"})
    peer = Peer(path, interface)
    continuous = [v.name for v in peer.inputs if v.type in REAL and v.variability == "continuous"]
    if not continuous:
        told({"not_applicable": "no continuous input", "stage": "done"})
        return
    for times in (1.0, 10.0, 100.0):  # as large as it takes for a lag to be seen
        cases = [stairs(peer, 3800 + k, times) for k in range(3)]
        y = recorded(peer, cases[0]).outputs
        scale = ranges(y)
        lags = {n: (recorded(peer, cases[0], hidden="lag", at=n).outputs - y) / scale for n in continuous}
        if max(float(np.nanmax(np.abs(s))) for s in lags.values()) > MOVES:
            break
    y, scale, moving = movers(peer, cases[0])
    varying = [k for k in range(len(peer.names)) if np.nanmax(y[:, k]) > np.nanmin(y[:, k])][:MOST_OUTPUTS]
    signatures = {("lag", n): s for n, s in lags.items()}
    for name in continuous:
        signatures["delay", name] = (recorded(peer, cases[0], hidden="delay", at=name).outputs - y) / scale
    for k in varying[:1]:
        column = np.zeros_like(y)
        column[:, k] = (GAIN - 1.0) * y[:, k] / scale[k]
        signatures["gain", peer.names[k]] = column
    fit_for = {key: s[:, varying] for key, s in signatures.items() if key[0] == effect}
    key = max(fit_for, key=lambda n: np.nanmax(np.abs(fit_for[n]), initial=0.0), default=None)
    if not moving or key is None or np.nanmax(np.abs(fit_for[key]), initial=0.0) < SEEN:
        told({"not_applicable": "no parameter or no input moves an output", "stage": "done"})
        return
    hidden, at = key
    alike = {m.name: _alike(m.response[:, varying], fit_for[key]) for m in moving}
    free = min(moving, key=lambda m: alike[m.name])
    told({"stage": "run", "hidden": f"{hidden} at {at}", "parameter": free.name, "alike": alike[free.name]})
    records = []
    for inputs in cases:
        record = recorded(peer, inputs, hidden=hidden if hidden != "gain" else "", at=at)
        if hidden == "gain":
            record.outputs[:, peer.names.index(at)] *= GAIN
        records.append(record)
    with tempfile.TemporaryDirectory() as folder:
        extra = '[fit]\nstarts = 1\n[diagnose]\neffects = "all"'
        found = asked(write_study(Path(folder), peer, records, scale, [free], extra), "diagnose", told)
    if found is None:
        return
    if "verdict" not in found:
        told({"outcome": "failed", "detail": str(found.get("message", "")), "stage": "done"})
        return
    places = {at, f"outputs.{at}"}
    named = [e for e in found["effects"] if e["effect"] == hidden and set(e["at"]) <= places]
    listed = [r for group in found["ambiguity"] for r in group if r["effect"] == hidden and set(r["at"]) <= places]
    said = ", ".join(f"{e['effect']} at {'+'.join(e['at'])}" for e in found["effects"]) or "nothing"
    fixed = f"free: {free.name}, alike {alike[free.name]:.2f}"
    told({
        "outcome": "ok" if named or listed else "missed",
        "how": "named" if named and found["verdict"] == "named" else "in the set" if named or listed else "",
"detail": f"hidden {hidden} at {at} ({fixed}): {found['verdict']}, {said}; {found['text'][:300]}",
        "stage": "done",
    })  # fmt: skip


def _alike(a: Array, b: Array) -> float:
    """The cosine between two responses, over the rows that both have."""
    both = np.isfinite(a) & np.isfinite(b)
    x, y = a[both], b[both]
    size = np.linalg.norm(x) * np.linalg.norm(y)
    return float(abs(x @ y) / size) if size > 0.0 else 0.0


__all__ = ["RTOL", "delay", "fit", "gain", "lag", "runs"]
