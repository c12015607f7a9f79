"""The records of the ten units by andes 2.0, and the files that a user has: recordings/NAME/{plant.dyr, grid.raw, event.csv}.

    python studies/units_by_andes/make.py [NAME ...]    # needs andes (pip install '.[bench]')

true.dyr is what the plant is (where andes has another model in a record's place, as a comment says); plant.dyr is the vendor's.
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import andes
import numpy as np

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from units import PLANTS, Plant, dyr  # noqa: E402

SEED = 7
STEPS_A_ROW = 5
"""Steps of andes from row to row of a record."""
BITS, ANGLE_BITS = 12, 16
"""Of a channel, and of an angle, which phasor measurement units send with 16."""
RANGES = {"V": (0.0, 1.5), "theta": (-np.pi, np.pi), "f": (-2.0, 2.0)}
"""Ranges of the recorder's channels, pu, rad and Hz (about the nominal frequency); of the powers, 1.5 times the base to either side."""
NOISE = 0.005
"""Standard deviation of the noise as a share of a channel's range in the record; of the angle (rad) it is that of the voltage (pu), as the
noise of a phasor has no direction."""
CLOCK, OFFSET, MISSING = 0.4, 0.006, 0.02
"""Of messy records: rows by which the powers are late, share of the base by which the reactive power is off, share of missing rows."""
ORDERS = {
    "AC8B": "TR KPR KIR KDR TDR VPIDMAX VPIDMIN VRMAX VRMIN VFEMAX VEMIN TA KA TE KC KD KE E1 SE1 E2 SE2",
    "ESST1A": "UEL VOS TR VIMAX VIMIN TB TC TB1 TC1 VAMAX VAMIN KA TA ILR KLR VRMAX VRMIN KF TF KC",
}
"""Order in which andes reads the values of a record, where it is not PSS/E's."""
OF_SYSTEM, SYSTEM = (("IEEEG1", "UO"), ("IEEEG1", "UC")), 100.0
"""Values that andes takes in pu of the system's base, where PSS/E has them in pu of the machine's, and that base, MVA."""
RAW = """0, 100.00, 32, 0, 1, {f0:.2f} / two buses
a unit and the grid

1,'UNIT        ', 20.0, 2, 1, 1, 1, 1.02, 10.0
2,'GRID        ', 20.0, 3, 1, 1, 1, 1.0, 0.0
0 / END OF BUS DATA
0 / END OF LOAD DATA
0 / END OF FIXED SHUNT DATA
1,'1', {P:.1f}, 0.0, 999.0, -999.0, 1.02, 0, {Sn:.1f}, 0.0, 0.3, 0.0, 0.0, 1.0, 1, 100.0, 999.0, -999.0, 1, 1.0
2,'1', 0.0, 0.0, 999.0, -999.0, 1.0, 0, 100.0, 0.0, 1.0, 0.0, 0.0, 1.0, 1, 100.0, 999.0, -999.0, 1, 1.0
0 / END OF GENERATOR DATA
1, 2, '1 ', 0.004, 0.1, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1, 1, 0.0, 1, 1.0
0 / END OF BRANCH DATA
0 / END OF TRANSFORMER DATA
0 / END OF AREA DATA
0 / END OF TWO-TERMINAL DC DATA
0 / END OF VSC DC LINE DATA
0 / END OF IMPEDANCE CORRECTION DATA
0 / END OF MULTI-TERMINAL DC DATA
0 / END OF MULTI-SECTION LINE DATA
0 / END OF ZONE DATA
0 / END OF INTER-AREA TRANSFER DATA
0 / END OF OWNER DATA
0 / END OF FACTS DEVICE DATA
Q
"""


ANDES_NAMES = {"TW": "Tw", "Dturb": "Dt"}
"""Names of HYGOV's values in andes where they differ: HYGOVDB is not read from a .dyr file."""


def simulated(plant: Plant, folder: Path) -> tuple[np.ndarray, dict[str, np.ndarray]]:
    """Return times and V (pu), theta (rad), f (Hz), P (MW), Q (Mvar) at the unit's terminals, as andes has them at each of its steps."""
    records = plant.values(vendor=False)
    for model, name in OF_SYSTEM:
        if model in records:
            records[model][name] *= plant.Sn / SYSTEM
    read = {m: v for m, v in records.items() if m not in plant.instead}
    (folder / "grid.raw").write_text(RAW.format(f0=plant.f0, P=plant.P, Sn=plant.Sn), encoding="utf-8")
    (folder / "true.dyr").write_text(dyr(read, ORDERS), encoding="utf-8")
    system = andes.load(
        str(folder / "grid.raw"), addfile=str(folder / "true.dyr"), no_output=True, default_config=True, setup=False
    )
    for model, (other, more) in plant.instead.items():
        machine = next(m for m in system.groups["SynGen"].models.values() if m.n)
        known = set(getattr(system, other).params)
        own = {ANDES_NAMES.get(n, n): v for n, v in records[model].items()}
        missing = set(own) - known
        if missing:
            raise KeyError(f"{other} has no {', '.join(sorted(missing))}: {sorted(known)}")
        system.add(other, {"syn": machine.idx.v[0], **own, **more})
    system.config.freq = plant.f0
    for model in system.groups["SynGen"].models.values():
        if model.n:
            model.fn.v[:] = [plant.f0] * model.n
    system.setup()
    system.PFlow.config.tol = 1e-10
    system.PFlow.run()
    tds = system.TDS.config
    tds.fixt, tds.shrinkt, tds.criteria, tds.tf = 1, 0, 0, plant.end + 0.1
    tds.tstep = 1.0 / (plant.rate * STEPS_A_ROW)
    v0, a0 = float(system.Slack.v0.v[0]), float(system.Slack.a0.v[0])
    fine = np.arange(0.0, plant.end + 1.0, 1e-3)
    df = np.interp(fine, *zip(*plant.frequency, strict=True))
    turned = 2.0 * np.pi * np.concatenate([[0.0], np.cumsum((df[1:] + df[:-1]) / 2.0 * 1e-3)])

    def moved(t: float, system: Any) -> None:
        """Set voltage and angle of the grid at the end t of the next step."""
        system.Slack.v0.v[:] = v0 + np.interp(t, *zip(*plant.voltage, strict=True))
        system.Slack.a0.v[:] = a0 + np.interp(t, fine, turned)

    system.TDS.callpert = moved
    system.TDS.init()
    if not system.TDS.run() or system.exit_code:
        raise RuntimeError("andes did not come to the end")
    series = system.dae.ts
    machine = next(m for g in ("SynGen", "RenGen") for m in system.groups[g].models.values() if m.n)
    y = {n: series.y[:, v.a[0]] for n, v in (("V", system.Bus.v), ("theta", system.Bus.a))}
    P, Q = (100.0 * series.y[:, getattr(machine, n).a[0]] for n in ("Pe", "Qe"))
    t = np.array(series.t)
    at_grid = series.y[:, system.Bus.a.a[1]] - a0 - np.interp(t, fine, turned)
    if np.abs(at_grid).max() > 1e-4:
        raise RuntimeError(f"the grid's angle is up to {np.abs(at_grid).max():.2g} rad off what it was set to")
    theta = np.unwrap(y["theta"])
    return t, {"V": y["V"], "theta": theta, "P": P, "Q": Q}


def recorded(plant: Plant, t: np.ndarray, signals: dict[str, np.ndarray], seed: int) -> tuple[str, np.ndarray]:
    """Return header and rows of the record: sampled, untidy as the plant says, noisy, of 12 bits."""
    rng = np.random.default_rng(seed)
    rows = np.arange(0.0, plant.end, 1.0 / plant.rate)
    late = CLOCK / plant.rate if "clock" in plant.mess else 0.0
    channels = {"V": 0.0, plant.channel: 0.0, "P": late, "Q": late}
    columns = []
    for name, lag in channels.items():
        clean = _at(rows - lag, name, t, signals, 1.0 / plant.rate)
        spread = np.ptp(signals["V"]) if name == "theta" else np.ptp(clean)
        values = clean + NOISE * spread * rng.standard_normal(rows.size)
        if "offset" in plant.mess and name == "Q":
            values = values + OFFSET * plant.Sn
        low, high = RANGES.get(name, (-1.5 * plant.Sn, 1.5 * plant.Sn))
        step = (high - low) / 2 ** (ANGLE_BITS if name == "theta" else BITS)
        columns.append(np.round(values / step) * step + (plant.f0 if name == "f" else 0.0))
    kept = rng.random(rows.size) >= MISSING if "missing" in plant.mess else np.ones(rows.size, bool)
    kept[0] = True
    return ",".join(["time", *channels]), np.column_stack([rows, *columns])[kept]


def _at(rows: np.ndarray, name: str, t: np.ndarray, signals: dict[str, np.ndarray], dt: float) -> np.ndarray:
    """Return a signal at the rows: the frequency as the turn of the angle over the time of a row, the angle from its start on."""
    if name == "f":
        ahead, behind = (np.interp(np.maximum(rows + h, 0.0), t, signals["theta"]) for h in (dt / 2.0, -dt / 2.0))
        return np.asarray((ahead - behind) / (2.0 * np.pi * dt))
    values = np.interp(np.maximum(rows, 0.0), t, signals[name])
    return np.asarray(values - signals["theta"][0] if name == "theta" else values)


def make(name: str) -> None:
    """Write the files of one unit."""
    plant, folder = PLANTS[name], HERE / "recordings" / name
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as temporary:
        t, signals = simulated(plant, Path(temporary))
    header, rows = recorded(plant, t, signals, SEED + list(PLANTS).index(name))
    (folder / "plant.dyr").write_text(dyr(plant.values(vendor=True)), encoding="utf-8")
    notes = [f"// {m} is {o} of andes: {json.dumps(more)}\n" for m, (o, more) in plant.instead.items()]
    (folder / "true.dyr").write_text("".join(notes) + dyr(plant.values(vendor=False)), encoding="utf-8")
    (folder / "grid.raw").write_text(RAW.format(f0=plant.f0, P=plant.P, Sn=plant.Sn), encoding="utf-8")
    formats = ["%.2f" if plant.rate == 50.0 else "%.4f", "%.4f", "%.4f", "%.2f", "%.2f"]
    np.savetxt(folder / "event.csv", rows, delimiter=",", header=header, comments="", fmt=formats)
    ranges = {n: f"{s.min():.4g} to {s.max():.4g}" for n, s in signals.items()}
    print(name, ranges, flush=True)


if __name__ == "__main__":
    for asked in sys.argv[1:] or PLANTS:
        make(asked)
