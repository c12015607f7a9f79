"""Small studies with something to do for each stage that keeps its work."""

from __future__ import annotations

from pathlib import Path

import numpy as np

CARD = """\
schema = 1
name = "pair"
[parameters]
a = {value = 3.0, unit = "1/s", min = 0.1, max = 100.0}
g = {value = 1.0, min = 0.01, max = 100.0}
[inputs]
u = {value = 0.0}
[signals]
v = "g*u"
[states]
x = {derivative = "a*(v - x)"}
[outputs]
y = "x"
"""
HEAD = """\
schema = 1
name = "faults"
[model]
source = "pair.toml"
[parameters]
a = {start = 2.0, min = 0.5, max = 20.0}
g = {start = 1.4, min = 0.2, max = 5.0}
"""
RECORDING = """\
[[experiment]]
name = "e{k}"
data = "e{k}.csv"
inputs = ["u"]
outputs = ["y"]
event = 0.2
noise = {{y = 1e-3}}
"""
FIT = "[fit]\nstarts = {starts}\n"
SWEEP = '[[sweep]]\nparameter = "a"\nmin = 0.5\nmax = 20\npoints = {points}\n'
DIAGNOSE = '[diagnose]\neffects = ["lag", "gain", "offset"]\n'
TABLES = {
    "sweep": ("sweep.json", "sweep.csv"),
    "identify": ("identifiability.json",),
    "fit": ("fit.json", "fitted-values.csv"),
    "diagnose": ("discrepancy.json",),
}
"""By stage the files that hold its result."""


def write_study(folder: Path, *, recordings: int = 5, points: int = 40, starts: int = 4, hidden: float = 0.0) -> Path:
    """The path of a study of x' = a (g u - x) with a = 3 and g = 1 (1 + k/200 in recording k), noise 1e-3.

    hidden: time constant, s, of a lag before the recorder that the model does not have.
    """
    folder.mkdir(parents=True, exist_ok=True)
    random = np.random.default_rng(7)
    t = np.arange(201) * 0.01
    for k in range(recordings):
        gain, rate = 1.0 + k / 200.0, 3.0
        s = np.clip(t - 0.2, 0.0, None)
        y = gain * (1.0 - np.exp(-rate * s))
        if hidden:
            fast = 1.0 / hidden
            y = gain * (1.0 - (fast * np.exp(-rate * s) - rate * np.exp(-fast * s)) / (fast - rate))
        y = y + 1e-3 * random.standard_normal(t.size)
        rows = "\n".join(f"{a:.2f},{float(a >= 0.2):g},{b:.9f}" for a, b in zip(t, y, strict=True))
        (folder / f"e{k}.csv").write_text(f"time,u,y\n{rows}\n")
    (folder / "pair.toml").write_text(CARD)
    text = HEAD + "".join(RECORDING.format(k=k) for k in range(recordings))
    text += FIT.format(starts=starts) + SWEEP.format(points=points) + DIAGNOSE
    (folder / "study.toml").write_text(text)
    return folder / "study.toml"
