"""The ten units: what the plant is, what the vendor's .dyr says instead, and what the diagnosis should tell."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import hvdc_ident

SHELF = Path(hvdc_ident.__file__).parent / "shelf"

GENROU = (7.0, 0.03, 0.75, 0.05, 3.0, 0.0, 2.1, 2.0, 0.2, 0.5, 0.18, 0.15, 0.05, 0.3)
HYDRO = (6.0, 0.04, 0.5, 0.06, 4.0, 0.0, 1.1, 0.7, 0.3, 0.45, 0.2, 0.12, 0.1, 0.4)
SEXS = (0.1, 10.0, 100.0, 0.1, 0.0, 5.0)
TGOV1 = (0.05, 0.5, 1.2, 0.0, 2.0, 6.0, 0.0)
IEEEG1 = (0, 0, 20.0, 0.0, 0.0, 0.1, 99.0, -99.0, 1.2, 0.0, 0.3, 0.3, 0.0, 8.0, 0.4, 0.0, 0.5, 0.3, 0.0, 0.0, 0.0, 0.0)
HYGOV = (0.05, 0.4, 2.5, 0.05, 0.5, 9.0, 1.2, 0.0, 1.3, 1.2, 0.2, 0.08)
IEEET1 = (0.0, 50.0, 0.05, 9.0, -9.0, 1.0, 0.5, 0.08, 1.0, 0.0, 3.0, 0.05, 4.0, 0.3)
EXST1 = (0.02, 9.0, -9.0, 1.0, 10.0, 200.0, 0.02, 99.0, -99.0, 0.0, 0.0, 1.0)
ESST1A = (
    1.0,
    1.0,
    0.01,
    99.0,
    -99.0,
    1.0,
    8.0,
    0.0,
    0.0,
    200.0,
    0.02,
    99.0,
    -99.0,
    99.0,
    -99.0,
    0.0,
    0.0,
    1.0,
    0.0,
    5.0,
)
IEEEST = (1.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.2, 0.05, 0.25, 0.04, 5.0, 5.0, 5.0, 0.2, -0.2, 0.0, 0.0)
REGCA1 = (0, 0.02, 10.0, 0.9, 0.4, 1.22, 1.2, 0.8, 0.4, -1.3, 0.02, 0.7, 99.0, -99.0, 0.7)
REECA1 = (
    0, 0, 0, 1, 0, 1, 0.5, 1.3, 0.0, -0.9, 0.9, 0.0, 1.05, -1.05, 1.0, 0.0, 0.0, 0.0, 0.05, 0.8, -0.8, 1.3, -1.3, 0.0, 0.1,
    1.0, 10.0, 1.02, 0.02, 99.0, -99.0, 1.2, 0.0, 1.5, 0.05, 0.0, 1.5, 0.2, 1.5, 0.5, 1.5, 1.0, 1.5, 0.0, 1.5, 0.2, 1.5,
    0.5, 1.5, 1.0, 1.5,
)  # fmt: skip
REECB1 = (
    0, 0, 0, 0, 1, 0.5, 1.3, 0.0, -0.02, 0.02, 2.0, 1.05, -1.05, 1.02, 0.05, 0.8, -0.8, 1.3, -1.3, 0.0, 0.1, 1.0, 10.0,
    0.02, 99.0, -99.0, 1.2, 0.0, 1.5, 0.05,
)  # fmt: skip
REPCA1 = (
    0, 1, 2, 1, 0, 1, 0, 0.02, 2.0, 3.0, 0.0, 0.1, 0.5, 0.0, 0.0, 0.02, 0.5, -0.5, 0.0, 0.0, 0.8, -0.8, 0.1, 0.5, 0.25, 0.0,
    0.0, 99.0, -99.0, 9.0, -9.0, 0.1, 20.0, 20.0,
)  # fmt: skip
"""Values of the records, in the order of the .dyr file: what the plant has unless a unit says otherwise."""


@dataclass(frozen=True)
class Hidden:
    """The effect that the vendor's .dyr lacks. told: what a reader calls it; effects and places: names that are right in a report, each of
    those at each of these; also: other pairs that are the same equation."""

    told: str
    effects: tuple[str, ...]
    places: tuple[str, ...]
    also: tuple[tuple[str, str], ...] = ()

    def right(self, effect: str, place: str) -> bool:
        """Return True if an effect at a place is this one."""
        return (effect in self.effects and place in self.places) or (effect, place) in self.also


@dataclass(frozen=True)
class Plant:
    """One unit. records: of its .dyr; true: values of the plant that differ from them, by MODEL.NAME; vendor: values of the vendor's
    .dyr that differ from the plant's; wrong: the parameter, of these, that the diagnosis should estimate, by its name in the unit;
    instead: models of andes that take the places of records, with the values that those lack.

    f0: Hz; Sn: MVA of the machine; P: MW; frequency, voltage: corners (s, Hz) and (s, pu) of the deviations of the grid;
    channel: what the recorder has, the angle or the frequency; rate: rows a second; end: s. mess: what is untidy in the record.
    """

    records: Mapping[str, tuple[float, ...]]
    hidden: Hidden
    wrong: str
    true: Mapping[str, float]
    vendor: Mapping[str, float]
    frequency: tuple[tuple[float, float], ...]
    voltage: tuple[tuple[float, float], ...]
    instead: Mapping[str, tuple[str, Mapping[str, float]]] = field(default_factory=dict)
    f0: float = 60.0
    Sn: float = 250.0
    P: float = 200.0
    channel: str = "theta"
    rate: float = 50.0
    end: float = 18.0
    mess: tuple[str, ...] = ()

    def values(self, vendor: bool) -> dict[str, dict[str, float]]:
        """Return the values of the plant's records, or of the vendor's, by model and name, in the record's order."""
        found = {model: dict(zip(names(model), values, strict=True)) for model, values in self.records.items()}
        for name, value in {**self.true, **(self.vendor if vendor else {})}.items():
            model, _, parameter = name.partition(".")
            if parameter not in found[model]:
                raise KeyError(f"{model} has no {parameter}")
            found[model][parameter] = value
        return found

    def truth(self) -> float:
        """Return the wrong parameter's value in the plant."""
        return self._of(self.true)

    def said(self) -> float:
        """Return the wrong parameter's value in the vendor's .dyr."""
        return self._of({**self.true, **self.vendor})

    def _of(self, changes: Mapping[str, float]) -> float:
        parameter = self.wrong.partition(".")[2]
        return next(v for n, v in changes.items() if n.partition(".")[2] == parameter)


def names(model: str) -> list[str]:
    """Return the names of the values of a record; a value that is not read has the name of its position."""
    record = tomllib.loads((SHELF / f"{model.lower()}.toml").read_text(encoding="utf-8"))["record"]
    return [n if n != "-" else f"-{k}" for k, n in enumerate(record)]


FALL = ((2.0, 0.0), (4.0, -0.2), (8.0, -0.08), (11.0, 0.12), (15.0, 0.0))
DIP = ((1.0, 0.0), (1.04, -0.06), (1.16, -0.06), (1.2, -0.01), (9.0, -0.01), (9.04, 0.02), (13.0, 0.02), (13.5, 0.0))
DEADBAND = ("deadband",)
LAG = ("lag", "second-order", "delay", "window-mean", "inner-loop", "filter", "lead-lag")
UPPER = ("limit", "saturation", "non-windup-limit")

PLANTS = {
    "steam_dead_band": Plant(
        {"GENROU": GENROU, "SEXS": SEXS, "TGOV1": TGOV1},
        Hidden("dead band of the governor, ±36 mHz", DEADBAND, ("gov.dw", "gen.dw")),
        "avr.K",
        {"SEXS.K": 140.0},
        {"SEXS.K": 100.0},
        FALL,
        DIP,
        instead={"TGOV1": ("TGOV1DB", {"dbL": -0.0006, "dbU": 0.0006})},
    ),
    "steam_transducer": Plant(
        {"GENROU": GENROU, "IEEET1": IEEET1, "TGOV1": TGOV1},
        Hidden("transducer of the exciter, 0.12 s", ("lag",), ("avr.Vt", "avr.err", "avr.Vc")),
        "gen.H",
        {"GENROU.H": 3.8, "IEEET1.TR": 0.12},
        {"GENROU.H": 3.0, "IEEET1.TR": 0.0},
        FALL,
        DIP,
        channel="f",
        rate=60.0,
        mess=("clock",),
    ),
    "steam_valve_rate": Plant(
        {"GENROU": GENROU, "SEXS": SEXS, "IEEEG1": IEEEG1},
        Hidden(
            "rate of the valve, ±0.02 pu/s",
            ("rate-limit", "state-rate-limit", "servo"),
            ("gov.valve", "gov.demand"),
            (("limit", "gov.rate"), ("saturation", "gov.rate")),
        ),
        "avr.K",
        {"SEXS.K": 75.0, "IEEEG1.UO": 0.02, "IEEEG1.UC": -0.02},
        {"SEXS.K": 100.0, "IEEEG1.UO": 99.0, "IEEEG1.UC": -99.0},
        FALL,
        DIP,
        f0=50.0,
    ),
    "hydro_dead_band": Plant(
        {"GENROU": HYDRO, "EXST1": EXST1, "HYGOV": HYGOV},
        Hidden("dead band of the governor, ±30 mHz", DEADBAND, ("gov.dw", "gen.dw", "gov.dw_used")),
        "avr.KA",
        {"EXST1.KA": 150.0},
        {"EXST1.KA": 200.0},
        ((2.0, 0.0), (5.0, -0.25), (12.0, -0.25), (14.0, 0.1), (20.0, 0.1), (22.0, 0.0)),
        DIP,
        instead={"HYGOV": ("HYGOVDB", {"dbL": -0.0006, "dbU": 0.0006})},
        Sn=100.0,
        P=80.0,
        f0=50.0,
        end=26.0,
        mess=("missing",),
    ),
    "gas_load_limit": Plant(
        {"GENROU": GENROU, "ESST1A": ESST1A, "TGOV1": TGOV1},
        Hidden("highest position of the valve, 0.84 pu", UPPER, ("gov.valve", "gov.demand")),
        "gov.R",
        {"TGOV1.R": 0.04, "TGOV1.VMAX": 0.84},
        {"TGOV1.R": 0.055, "TGOV1.VMAX": 1.2},
        FALL,
        DIP,
        channel="f",
        rate=60.0,
    ),
    "steam_regulator_limit": Plant(
        {"GENROU": GENROU, "IEEET1": IEEET1, "TGOV1": TGOV1},
        Hidden("highest output of the regulator, 3.2 pu", UPPER, ("avr.VR", "avr.err")),
        "avr.KA",
        {"IEEET1.KA": 70.0, "IEEET1.VRMAX": 3.2},
        {"IEEET1.KA": 50.0, "IEEET1.VRMAX": 9.0},
        FALL,
        ((1.0, 0.0), (1.04, -0.06), (1.4, -0.06), (1.44, -0.03), (8.0, -0.03), (8.04, 0.01), (13.0, 0.01), (13.5, 0.0)),
        mess=("offset",),
    ),
    "park_measurement": Plant(
        {"REGCA1": REGCA1, "REECB1": REECB1, "REPCA1": REPCA1},
        Hidden(
            "measurement of the plant controller, 0.3 s",
            LAG,
            ("plant.Vt", "plant.Vmeas", "plant.Vcontrol", "plant.err"),
        ),
        "plant.Kp",
        {"REPCA1.Kp": 3.0, "REPCA1.Tfltr": 0.3},
        {"REPCA1.Kp": 2.0, "REPCA1.Tfltr": 0.02},
        FALL,
        DIP,
        Sn=100.0,
        P=80.0,
    ),
    "converter_voltage_filter": Plant(
        {"REGCA1": REGCA1, "REECA1": REECA1, "REPCA1": REPCA1},
        Hidden("filter of the voltage, 0.1 s", LAG, ("elec.Vt", "elec.Vmeas", "elec.Verr")),
        "elec.Kvp",
        {"REECA1.Kvp": 1.5, "REECA1.Trv": 0.1, "REPCA1.Kp": 0.5, "REPCA1.Ki": 1.0, "REPCA1.Kc": 0.1},
        {"REECA1.Kvp": 1.0, "REECA1.Trv": 0.0},
        FALL,
        DIP,
        Sn=100.0,
        P=80.0,
        f0=50.0,
        channel="f",
        mess=("clock", "missing"),
    ),
    "steam_stabiliser_limit": Plant(
        {"GENROU": GENROU, "EXST1": EXST1, "IEEEST": IEEEST, "TGOV1": TGOV1},
        Hidden("limits of the stabiliser, ±0.01 pu", UPPER, ("pss.VSS", "pss.y5", "avr.Vs")),
        "pss.KS",
        {"IEEEST.KS": 8.0, "IEEEST.LSMAX": 0.01, "IEEEST.LSMIN": -0.01},
        {"IEEEST.KS": 5.0, "IEEEST.LSMAX": 0.2, "IEEEST.LSMIN": -0.2},
        FALL,
        DIP,
        rate=60.0,
    ),
    "park_frequency_dead_band": Plant(
        {"REGCA1": REGCA1, "REECB1": REECB1, "REPCA1": REPCA1},
        Hidden(
            "dead band of the plant controller's frequency, ±36 mHz",
            DEADBAND,
            ("plant.dwn", "plant.ferr", "plant.ferr_in"),
        ),
        "plant.Kp",
        {"REPCA1.Fflag": 1.0, "REPCA1.Kp": 1.5, "REPCA1.fdbd1": -0.0006, "REPCA1.fdbd2": 0.0006},
        {"REPCA1.Kp": 2.0, "REPCA1.fdbd1": 0.0, "REPCA1.fdbd2": 0.0},
        FALL,
        DIP,
        Sn=100.0,
        P=80.0,
        mess=("offset",),
    ),
}
