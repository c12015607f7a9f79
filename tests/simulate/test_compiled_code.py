"""Machine code: four instants at once give what one at a time gives, and little is loaded for it."""

from __future__ import annotations

import subprocess
import sys

import numpy as np

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.model import parse_card
from hvdc_ident.simulate import simulate

OUTPUTS = {
    "sine": "sin(x) + cos(2*x)",
    "roots": "sqrt(x + 1) - (x + 2)**1.5 + x**-2",
    "growth": "exp(-x) * log(x + 3)",
    "angles": "atan2(x, k) + asin(x/9) - acos(x/9) + atan(x) + tan(x/9) + tanh(x)",
    "limits": "clip(x, 0.5, 0.9) + min(x, u, 0.7) - max(x, 0.3) + abs(x - 0.6) + sign(x - 0.8)",
    "clock": "time * u",
    "fixed": "3",
}
CARD = f"""
schema = 1
name = "lag"
[parameters]
k = {{value = 2.0}}
[inputs]
u = {{value = 0.25}}
[states]
x = {{derivative = "k*(u - x)"}}
[outputs]
{chr(10).join(f'{name} = "{text}"' for name, text in OUTPUTS.items())}
"""


def expected(time, x, u, k=2.0):
    """The outputs, from numpy."""
    return {
        "sine": np.sin(x) + np.cos(2 * x),
        "roots": np.sqrt(x + 1) - (x + 2) ** 1.5 + x**-2,
        "growth": np.exp(-x) * np.log(x + 3),
        "angles": np.arctan2(x, k) + np.arcsin(x / 9) - np.arccos(x / 9) + np.arctan(x) + np.tan(x / 9) + np.tanh(x),
        "limits": np.clip(x, 0.5, 0.9)
        + np.minimum(np.minimum(x, u), 0.7)
        - np.maximum(x, 0.3)
        + np.abs(x - 0.6)
        + np.sign(x - 0.8),
        "clock": time * u,
        "fixed": np.full_like(time, 3.0),
    }


def test_outputs_of_a_plain_run_and_of_one_with_sensitivities_are_what_their_texts_say():
    time = np.linspace(0.0, 2.0, 403)
    step = experiment("step", time, {"u": InputSignal.step(0.1037, 0.25, 1.0)})
    u = np.where(time < 0.1037, 0.25, 1.0)
    x = 1.0 - 0.75 * np.exp(-2.0 * np.maximum(time - 0.1037, 0.0))
    for names in ((), ("k",)):
        for method in ("explicit", "rosenbrock"):
            found = simulate(parse_card(CARD), step, sensitivities=names, rtol=1e-9, method=method)
            for name, values in expected(time, x, u).items():
                assert np.allclose(found[name], values, rtol=1e-7, atol=1e-7), (name, names, method)


def test_a_simulation_loads_little():
    code = (
        "import sys, numpy as np\n"
        "from hvdc_ident import load_model, simulate\n"
        "from hvdc_ident.data import experiment\n"
        "case = experiment('short', np.linspace(0.0, 0.01, 11))\n"
        "simulate(load_model('vsc-hvdc-link'), case, sensitivities=('KIP',))\n"
        "print(*sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stderr == ""
    unwanted = {"scipy.linalg", "hvdc_ident.effects"}
    assert sorted(unwanted & set(found.stdout.split())) == []
