"""DERA1 against the response that PSS/E gives, as PowerSimulationsDynamics.jl publishes it.

    python benchmarks/dera1_against_psse.py dera_freqflag0.csv

The file, of the folder test/benchmarks/psse/DERA of that package, has time in s, voltage in pu and angle in degrees at bus 102: a resource
of 100 MVA at its full power there, an infinite bus 101 and a load at bus 103, which three equal lines connect; the line from 101 to 102
trips at 2 s. The parameters are those of the package's test (Ma, 2020), the load takes P with constant current and Q with constant
impedance, as the end of the response shows. PSS/E integrates with steps of 5 ms.
"""

from __future__ import annotations

import sys

import numpy as np

import hvdc_ident as hi
from hvdc_ident.model import parse_card

STEP = 0.005
CARD = """
schema = 1
name = "three-buses"
[inputs]
Pref = {value = 1.0, unit = "pu"}
Qref = {value = 0.37, unit = "pu"}
[components.gen]
source = "dera1"
[components.gen.parameters]
PQFlag = 0
FreqFlag = FREQFLAG
Kqv = 5.0
Pmax = 1.1
dPmax = 0.5
dPmin = -0.5
Tpfilt = 1e-3
rrpwr = 99.0
fl = 0.0
fh = 120.0
[components.load]
source = "load"
parameters = {P0 = 250.0, Q0 = 30.0, V0 = 0.9558911747872366, pz = 0.0, pc = 1.0, qz = 1.0}
[signals]
closed = "where(time < 2, 1, 0)"
[connections]
"gen.Vr" = {value = "(0.01*gen.Ir - 0.12*gen.Ii + load.Vr + closed)/(1 + closed)", start = 1.0}
"gen.Vi" = {value = "(0.01*gen.Ii + 0.12*gen.Ir + load.Vi)/(1 + closed)", start = 0.0}
"load.Vr" = {value = "(1 + gen.Vr + 0.01*load.Ir - 0.12*load.Ii)/2", start = 0.95}
"load.Vi" = {value = "(gen.Vi + 0.01*load.Ii + 0.12*load.Ir)/2", start = -0.15}
"load.dwn" = "0"
"gen.dwn" = "0"
"gen.Freq_ref" = "0"
"gen.Pref" = "Pref"
"gen.Qref" = "Qref"
[outputs]
P = "gen.Pe"
Vt = "gen.Vt"
theta = "atan2(gen.Vi, gen.Vr)*180/pi"
"""


def main(path: str) -> None:
    """Print how far voltage and angle are from PSS/E's: before the trip, right after it, at the end, and at most in between."""
    rows = np.loadtxt(path, delimiter=",")
    last = np.append(np.diff(rows[:, 0]) > 1e-9, True)  # of the two rows at the trip the one after it
    steps, known = np.round(rows[last, 0] / STEP), rows[last, 1:]
    for FreqFlag in (0, 1):
        model = parse_card(CARD.replace("FREQFLAG", str(FreqFlag)))
        point = hi.find_operating_point(model, outputs={"P": 1.0, "Vt": 1.0}, free=["Pref", "Qref"])
        times = np.where(steps == round(2.0 / STEP), 2.0 + 1e-9, steps * STEP)
        run = hi.simulate(model.with_values(point.inputs), times)
        after = steps >= round(2.0 / STEP)
        for column, name in enumerate(("Vt", "theta")):
            apart = run[name] - known[:, column]
            moved = np.ptp(known[after, column])
            shifted = np.interp(times[after] - STEP / 2, times[after], run[name][after]) - known[after, column]
            print(
                f"FreqFlag {FreqFlag}, {name}: before {apart[0]:.1e}, after the trip {apart[after][0]:.1e}, end {apart[-1]:.1e}; "
                f"at most {np.abs(apart[after]).max():.1e}, half a step later {np.abs(shifted).max():.1e}, of {moved:.1e}"
            )


if __name__ == "__main__":
    main(sys.argv[1])
