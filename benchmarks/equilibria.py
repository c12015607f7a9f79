"""Starts of a machine with any one effect at any place, at random values, against a continuation by scipy.

    python benchmarks/equilibria.py [--sets 2000] [--seed 1]

The machine has a torque angle delta and others at pi - delta and every turn more; its card's own lines are evaluated by
Python, and scipy's `fsolve` follows the equilibrium in small steps: first to the values, then the effect from nothing to its
size. A step counts where the determinant keeps its sign, or is 0: behind a deadband a state may rest anywhere. Printed: sets
with the same equilibrium, with another one (each is shown), without one in both, and where one of the two alone found none.
"""

from __future__ import annotations

import argparse
import math
import time
from collections import Counter
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from scipy.optimize import fsolve

from hvdc_ident.effects import EffectUse, apply_effects, effects
from hvdc_ident.errors import ModelError, SteadyStateError
from hvdc_ident.model import parse_card
from hvdc_ident.simulate import equilibria

PARAMETERS = {"H": 4.0, "K": 100.0, "TA": 0.02, "TC": 1.0, "KS": 8.0, "R": 0.05}
RANGES = {"H": (2, 8), "K": (20, 300), "TA": (0.005, 0.2), "TC": (0.2, 5), "KS": (0, 20), "R": (0.02, 0.1)}
INPUTS = {"Pm": 0.7, "Vref": 1.05, "V": 1.0}
STATES = {
    "delta": "314.0*w", "w": "(Pt - Pe - 2*w)/(2*H)", "E": "(efd - E - 1.4*id)/7",
    "lead": "(err - lead)/10", "efd": "(efc - efd)/TA", "wash": "(KS*w - wash)/5", "gate": "(order - gate)/0.5",
}  # fmt: skip
SIGNALS = {
    "iq": "V*sin(delta)/2.0", "id": "(E - V*cos(delta))/0.65", "vd": "1.65*iq", "vq": "E - 0.3*id",
    "Vm": "sqrt(vd**2 + vq**2)", "Pe": "vd*id + vq*iq", "Vs": "clip(KS*w - wash, -0.05, 0.05)", "err": "Vref - Vm + Vs",
    "through": "lead + TC/10*(err - lead)", "efc": "clip(K*through, 0, 5)", "order": "clip(Pm - w/R, 0, 1)", "Pt": "gate",
}  # fmt: skip
FIRST = {"delta": 1.0, "w": 0.0, "E": 1.0, "lead": 0.01, "efd": 1.5, "wash": 0.0, "gate": 0.7}
# What an effect makes of a signal that rests; all others let it through as it is.
STATIC: Mapping[str, Callable[[float, Mapping[str, float], float], float]] = {
    "gain": lambda u, q, _: q["k"] * u,
    "offset": lambda u, q, _: u + q["c"],
    "limit": lambda u, q, _: min(max(u, -q["level"]), q["level"]),
    "saturation": lambda u, q, _: q["level"] * math.tanh(u / q["level"]),
    "deadband": lambda u, q, _: u - min(max(u, -q["width"]), q["width"]),
    "conductance": lambda u, q, source: u - q["g"] * source,
    "loss": lambda u, q, source: u - (q["a"] + q["b"] * abs(source) + q["c"] * source**2),
    "filter": lambda u, q, _: u + q["k"] * q["low"] * u,
    "disturbance": lambda u, q, _: u + q["amplitude"] * math.sin(q["phase"]),
}
LEFT_OUT = ("term", "quantisation")  # a form of the user's own; edges that fsolve does not pass

_FUNCTIONS = {"sin": math.sin, "cos": math.cos, "sqrt": math.sqrt, "clip": lambda x, low, high: min(max(x, low), high)}
_CODE = {n: compile(e, n, "eval") for n, e in (SIGNALS | STATES).items()}
_DERIVATIVES = {n: compile(e, n, "eval") for n, e in STATES.items()}


def card() -> str:
    """Return the machine's card."""
    tables = {
        "parameters": [f"{n} = {{value = {v}}}" for n, v in PARAMETERS.items()],
        "inputs": [f"{n} = {{value = {v}}}" for n, v in INPUTS.items()],
        "states": [f'{n} = {{derivative = "{e}", guess = {FIRST[n]}}}' for n, e in STATES.items()],
        "signals": [f'{n} = "{e}"' for n, e in SIGNALS.items()],
        "outputs": ['delta = "delta"', 'Vm = "Vm"'],
    }
    return 'schema = 1\nname = "machine"\n' + "".join(f"[{k}]\n" + "\n".join(v) + "\n" for k, v in tables.items())


def residual(x: Any, values: Mapping[str, float], use: EffectUse | None, share: float) -> Any:
    """Return the derivatives (states,) with that share of the effect."""
    known: dict[str, Any] = {**_FUNCTIONS, **values, **dict(zip(STATES, x, strict=True))}

    def seen(name: str) -> None:
        if use is not None and name == use.at[0] and use.effect in STATIC:
            u = known[name]
            known[name] = u + share * (STATIC[use.effect](u, dict(use.parameters), known.get(use.source, 0.0)) - u)

    for name in (*values, *STATES):
        seen(name)
    for name in SIGNALS:
        known[name] = eval(_CODE[name], known)
        seen(name)
    return np.array([eval(code, known) for code in _DERIVATIVES.values()])


def turn(x: Any, *where: Any) -> float:
    """Return the sign of the Jacobian's determinant, by central differences."""
    steps = np.diag(1e-7 * np.maximum(np.abs(x), 1e-2))
    columns = [(residual(x + h, *where) - residual(x - h, *where)) / (2 * h.sum()) for h in steps]
    return float(np.linalg.slogdet(np.array(columns).T)[0])


def followed(x: Any, sign: float, at: Callable[[float], Any]) -> Any:
    """Return the equilibrium at share 1, followed from x at share 0; None where it ends on the way."""
    share, step = 0.0, 1 / 24
    while share < 1:
        ahead = min(share + step, 1.0)
        y = fsolve(residual, x, args=at(ahead), xtol=1e-13, full_output=True)[0]
        near = np.abs(y - x).max() < 0.3 and np.abs(residual(y, *at(ahead))).max() < 1e-8
        if near and turn(y, *at(ahead)) in (sign, 0.0):
            x, share, step = y, ahead, 1.5 * step
        elif step < 1e-4:
            return None
        else:
            step /= 2
    return x


def one(random: np.random.Generator, model: Any, base: Any, sign: float) -> tuple[str, str]:
    """Return how one random set came out, and the set in words."""
    catalogue = {n: e for n, e in effects().items() if n not in LEFT_OUT}
    own = PARAMETERS | INPUTS
    while True:
        effect = catalogue[str(random.choice(list(catalogue)))]
        place, source = str(random.choice([*INPUTS, *SIGNALS, *STATES])), str(random.choice([*INPUTS, *STATES]))
        size = {n: v * math.exp(random.uniform(-0.7, 0.7)) for n, v in effect.example.items()}
        if effect.name == "gain":
            size["k"] = random.uniform(0.85, 1.15)
        use = EffectUse(effect.name, (place,), size, source=source if effect.needs_source and source != place else "")
        try:
            made = apply_effects(model, [use])
            break
        except ModelError:  # signals would run in a circle, or a size is out of question there
            continue
    values = {n: random.uniform(*RANGES[n]) for n in PARAMETERS} | {
        n: v * random.uniform(0.96, 1.04) for n, v in INPUTS.items()
    }
    way = {n: (own[n], values[n]) for n in own}
    expected = followed(base, sign, lambda s: ({n: a + s * (b - a) for n, (a, b) in way.items()}, None, 0.0))
    expected = None if expected is None else followed(expected, sign, lambda s: (values, use, s))
    p = np.array([values.get(n, q.value) for n, q in made.parameters.items()])
    try:
        found = equilibria(made).start(made, p, np.array([values[n] for n in made.inputs])).y[: len(STATES)]
    except SteadyStateError:
        found = None
    text = f"{effect.name} at {place}, {dict(use.parameters)}: scipy {expected}, here {found}"
    if expected is None or found is None:
        kinds = {(True, True): "none in both", (True, False): "found here alone", (False, True): "found by scipy alone"}
        return kinds[expected is None, found is None], text
    return ("same" if np.abs(found - expected).max() < 1e-5 else "another one"), text


def main() -> None:
    """Print how the sets came out."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--sets", type=int, default=2000)
    parser.add_argument("--seed", type=int, default=1)
    asked = parser.parse_args()
    model, own = parse_card(card()), PARAMETERS | INPUTS
    base = fsolve(residual, np.array(list(FIRST.values())), args=(own, None, 0.0), xtol=1e-13)
    sign = turn(base, own, None, 0.0)
    random, begun = np.random.default_rng(asked.seed), time.process_time()
    counts: Counter[str] = Counter()
    for _ in range(asked.sets):
        outcome, text = one(random, model, base, sign)
        counts[outcome] += 1
        if outcome in ("another one", "found here alone", "found by scipy alone"):
            print(f"{outcome}: {text}")
    print(dict(counts), f"{time.process_time() - begun:.0f} s of processor time")


if __name__ == "__main__":
    main()
