"""Modes of the average-value link, named by participation, and the delays of its inner loop and measurements.

python studies/avm_modes/run.py
"""

from __future__ import annotations

from typing import Any

import numpy as np

from hvdc_ident.linearize import LinearModel, linearize, named_modes, parts_of
from hvdc_ident.models import load_model

CASES = ("vsc-hvdc-avm", "vsc-hvdc-avm-unfiltered", "vsc-hvdc-avm-authors")
PATHS = {  # what: (input that moves both, from, to)
    "active current, order to current": ("Pref2", "Irorder2", "Ir2"),
    "reactive current, order to current": ("Qref1", "Iiorder1", "Ii1"),
    "active power measurement": ("Pref2", "P2", "P2_m"),
    "dc voltage measurement": ("Vdcref1", "Vdc1", "Vdc1_m"),
}
OMEGA = 1.0  # rad/s, far below every mode


def path_delay(linear: LinearModel, source: str, before: str, after: str, omega: float = 1.0) -> float:
    """Return the delay in s between two outputs at omega in rad/s, both driven by one input: -arg(after/before)/omega."""
    response = linear.response(np.array([omega]))[0, :, linear.input_names.index(source)]
    ratio = response[linear.output_names.index(after)] / response[linear.output_names.index(before)]
    return float(-np.angle(ratio) / omega)


def main(name: str) -> dict[str, Any]:
    """Return modes (name, rad/s, Hz, damping), the slowest first, and low-frequency delays in ms of a shipped link."""
    model = load_model(name)
    inputs = list(dict.fromkeys(source for source, _, _ in PATHS.values()))
    outputs = [signal for _, *pair in PATHS.values() for signal in pair]
    linear = linearize(model, inputs=inputs, outputs=outputs)
    modes = [
        {
            "name": named.name,
            "eigenvalue": [named.mode.eigenvalue.real, named.mode.eigenvalue.imag],
            "frequency_hz": named.mode.frequency_hz,
            "damping": named.mode.damping,
        }
        for named in named_modes(linear, parts_of(model))
        if abs(named.mode.eigenvalue) > 1e-6  # the PLL's sliding mean: cancelled by its delay
    ]
    delays = {what: 1e3 * path_delay(linear, *path, OMEGA) for what, path in PATHS.items()}
    return {"modes": modes, "delay_ms": delays}


if __name__ == "__main__":
    for case in CASES:
        found = main(case)
        print(f"{case}\n  {'real, 1/s':>10s}{'Hz':>9s}{'damping':>9s}  parts")
        for mode in found["modes"]:
            print(f"  {mode['eigenvalue'][0]:10.2f}{mode['frequency_hz']:9.2f}{mode['damping']:9.3f}  {mode['name']}")
        for what, delay in found["delay_ms"].items():
            print(f"  delay of {what}: {delay:.3f} ms")
