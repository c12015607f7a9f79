"""The units: what the plant is, what the vendor's .dyr says instead, and what the diagnosis should tell."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import hvdc_ident

SHELF = Path(hvdc_ident.__file__).parent / "shelf"

GENROU = (7.0, 0.03, 0.75, 0.05, 3.0, 0.0, 2.1, 2.0, 0.2, 0.5, 0.18, 0.15, 0.05, 0.3)
HYDRO = (6.0, 0.04, 0.5, 0.06, 4.0, 0.0, 1.1, 0.7, 0.3, 0.45, 0.2, 0.12, 0.1, 0.4)
SEXS = (0.1, 10.0, 100.0, 0.1, 0.0, 5.0)
AC8B = (
    0.02, 20.0, 5.0, 4.0, 0.1, 99.0, -99.0, 1.0, 0.02, 99.0, -99.0, 0.3, 0.5, 1.0, 1.2, 99.0, -99.0, 3.0, 0.1, 4.5, 0.5,
)  # fmt: skip
EXAC1 = (0.0, 1.0, 0.2, 150.0, 0.05, 99.0, -99.0, 0.8, 0.05, 1.0, 0.2, 0.38, 1.0, 3.0, 0.1, 4.5, 0.5)
TGOV1 = (0.05, 0.5, 1.2, 0.0, 2.0, 6.0, 0.0)
IEEEG1 = (0, 0, 20.0, 0.0, 0.0, 0.1, 99.0, -99.0, 1.2, 0.0, 0.3, 0.3, 0.0, 8.0, 0.4, 0.0, 0.5, 0.3, 0.0, 0.0, 0.0, 0.0)
GAST = (0.05, 0.4, 0.1, 3.0, 0.82, 2.0, 1.2, -0.05, 0.0)
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
ST2CUT = (
    1.0, 0.0, 3.0, 0.0, 8.0, -0.6, 0.02, 0.02, 5.0, 5.0, 0.2, 0.05, 0.2, 0.05, 0.0, 0.0, 0.2, -0.2, 0.0, 0.0,
)  # fmt: skip
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
class Card:
    """The card that the plant has and the vendor's .dyr lacks. model: its record's; component: the part of the unit that it is;
    stated: the records that the vendor's .dyr has in its place, none where it has no such part; also: other cards that do the same, with
    the values with which they do."""

    model: str
    component: str
    stated: Mapping[str, tuple[float, ...]]
    also: Mapping[str, tuple[float, ...]] = field(default_factory=dict)

    def right(self, card: str, component: str) -> bool:
        """Return True if a card, upper or lower case, at a part of the unit is this one."""
        return component == self.component and card.upper() in (self.model, *self.also)


@dataclass(frozen=True)
class Plant:
    """One unit. records: of its .dyr; hidden: what the vendor's .dyr lacks, None where a value alone is wrong; true: values of the plant
    that differ from the records, by MODEL.NAME; vendor: values of the vendor's .dyr that differ from the plant's; wrong: the parameter, of
    these, that the diagnosis should estimate, by its name in the unit, "" where a card is wrong; instead: models of andes that take the
    places of records, with the values that those lack.

    f0: Hz; Sn: MVA of the machine; P: MW; frequency, voltage: corners (s, Hz) and (s, pu) of the deviations of the grid;
    channel: what the recorder has, the angle or the frequency; rate: rows a second; end: s. mess: what is untidy in the record.
    """

    records: Mapping[str, tuple[float, ...]]
    hidden: Hidden | Card | None
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

    def values(self, vendor: bool, also: str = "") -> dict[str, dict[str, float]]:
        """Return the values of the plant's records, or of the vendor's, by model and name, in the record's order.

        also: the card that does the same, in the place of the plant's.
        """
        records = self.records
        if isinstance(self.hidden, Card) and (vendor or also):
            records = self._with({also: self.hidden.also[also]} if also else self.hidden.stated)
        found = {model: dict(zip(names(model), values, strict=True)) for model, values in records.items()}
        for name, value in {**self.true, **(self.vendor if vendor else {})}.items():
            model, _, parameter = name.partition(".")
            if model in self.records and model not in records:
                continue  # a value of the card that the vendor's .dyr lacks
            if parameter not in found[model]:
                raise KeyError(f"{model} has no {parameter}")
            found[model][parameter] = value
        return found

    def _with(self, others: Mapping[str, tuple[float, ...]]) -> dict[str, tuple[float, ...]]:
        """Return the records with others in the place of the card that the vendor's .dyr lacks."""
        found: dict[str, tuple[float, ...]] = {}
        for model, values in self.records.items():
            found |= others if isinstance(self.hidden, Card) and model == self.hidden.model else {model: values}
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


def dyr(records: Mapping[str, Mapping[str, float]], order: Mapping[str, str] | None = None) -> str:
    """Return the text of a .dyr file. order: of the values, by model, where it is not PSS/E's."""
    orders = {m: o.split() for m, o in (order or {}).items()}
    rows = ((m, [v[n] for n in orders.get(m, v)]) for m, v in records.items())
    return "".join(f"1 '{m}' 1 {' '.join(f'{v:g}' for v in values)} /\n" for m, values in rows)


def names(model: str) -> list[str]:
    """Return the names of the values of a record; a value that is not read has the name of its position."""
    record = tomllib.loads((SHELF / f"{model.lower()}.toml").read_text(encoding="utf-8"))["record"]
    return [n if n != "-" else f"-{k}" for k, n in enumerate(record)]


FALL = ((2.0, 0.0), (4.0, -0.2), (8.0, -0.08), (11.0, 0.12), (15.0, 0.0))
DIP = ((1.0, 0.0), (1.04, -0.06), (1.16, -0.06), (1.2, -0.01), (9.0, -0.01), (9.04, 0.02), (13.0, 0.02), (13.5, 0.0))
DEADBAND = ("deadband",)
LAG = ("lag", "second-order", "delay", "window-mean", "inner-loop", "filter", "lead-lag")
UPPER = ("limit", "saturation", "non-windup-limit")

EFFECTS = {
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
"""Units whose .dyr has one wrong parameter and lacks one effect."""

STEAM = {"GENROU": GENROU, "SEXS": SEXS, "TGOV1": TGOV1}
HYDRO_FREQUENCY = ((2.0, 0.0), (5.0, -0.25), (12.0, -0.25), (14.0, 0.1), (20.0, 0.1), (22.0, 0.0))


def _changed(model: str, values: tuple[float, ...], **changes: float) -> tuple[float, ...]:
    """Return the values of a record with some of them changed."""
    return tuple({**dict(zip(names(model), values, strict=True)), **changes}.values())


IEESGO = (0.1, 1.0, 0.1, 0.3, 10.0, 0.5, 20.0, 0.8, 0.625, 1.2, 0.0)
IEEEX1 = (0.0, 100.0, 0.2, 0.0, 0.0, 9.0, -9.0, 1.0, 1.0, 0.05, 1.0, 0.0, 3.0, 0.05, 4.0, 0.3)
ESAC1A = (
    0.0, 1.0, 0.2, 150.0, 0.05, 99.0, -99.0, 0.8, 0.05, 1.0, 0.2, 0.38, 1.0, 3.0, 0.1, 4.5, 0.5, 99.0, -99.0,
)  # fmt: skip
ONE_INPUT = (
    1.0, 0.0, 0.0, 0.0, 8.0, 0.0, 0.0, 0.0, 5.0, 5.0, 0.2, 0.05, 0.25, 0.04, 0.0, 0.0, 0.2, -0.2, 0.0, 0.0,
)  # fmt: skip
PSS2B = (
    1, 0, 3, 0, 0, 0, 5.0, 0.0, 0.0, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 8.0, 0.2, 0.05, 0.25, 0.04, 0.0, 0.0, 99.0, -99.0,
    99.0, -99.0, 0.2, -0.2,
)  # fmt: skip
"""Values with which cards do what another one does in the plant."""


def _carded(records: Mapping[str, tuple[float, ...]], card: Card, **more: Any) -> Plant:
    """Return a unit with a card that the vendor's .dyr lacks."""
    return Plant(records, card, "", more.pop("true", {}), {}, more.pop("frequency", FALL), DIP, **more)


CARDS = {
    "steam_stages": _carded(
        {"GENROU": GENROU, "SEXS": SEXS, "IEEEG1": IEEEG1},
        Card("IEEEG1", "gov", {"TGOV1": (0.05, 0.3, 1.2, 0.0, 2.4, 8.0, 0.0)}, {"IEESGO": IEESGO}),
        true={
            "IEEEG1.T1": 0.1,
            "IEEEG1.T2": 1.0,
            "IEEEG1.K1": 0.2,
            "IEEEG1.K3": 0.3,
            "IEEEG1.T5": 10.0,
            "IEEEG1.K5": 0.5,
        },
    ),
    "hydro_as_steam": _carded(
        {"GENROU": HYDRO, "EXST1": EXST1, "HYGOV": HYGOV},
        Card("HYGOV", "gov", {"TGOV1": TGOV1}),
        frequency=HYDRO_FREQUENCY,
        Sn=100.0,
        P=80.0,
        f0=50.0,
        end=26.0,
    ),
    "gas_as_steam": _carded(
        {"GENROU": GENROU, "SEXS": SEXS, "GAST": GAST},
        Card("GAST", "gov", {"TGOV1": (0.05, 0.4, 1.2, 0.0, 2.0, 6.0, 0.0)}),
    ),
    "static_exciter_simplified": _carded(
        {"GENROU": GENROU, "EXST1": EXST1, "TGOV1": TGOV1},
        Card(
            "EXST1",
            "avr",
            {"SEXS": (0.1, 10.0, 200.0, 0.05, -5.0, 8.0)},
            {"ESST1A": _changed("ESST1A", ESST1A, TR=0.05, VIMAX=0.015, VIMIN=-0.015, TC=1.0, TB=10.0, TA=0.02)},
        ),
        true={"EXST1.TR": 0.05, "EXST1.VIMAX": 0.015, "EXST1.VIMIN": -0.015},
    ),
    "dc_exciter_simplified": _carded(
        {"GENROU": GENROU, "IEEET1": IEEET1, "TGOV1": TGOV1},
        Card("IEEET1", "avr", {"SEXS": SEXS}, {"IEEEX1": IEEEX1, "ESDC2A": IEEEX1}),
        true={"IEEET1.KA": 100.0, "IEEET1.TA": 0.2, "IEEET1.TE": 1.0, "IEEET1.KF": 0.05},
    ),
    "ac_exciter_as_static": _carded(
        {"GENROU": GENROU, "EXAC1": EXAC1, "TGOV1": TGOV1},
        Card("EXAC1", "avr", {"EXST1": EXST1}, {"ESAC1A": ESAC1A}),
    ),
    "stabiliser_missing": _carded(
        {"GENROU": GENROU, "EXST1": EXST1, "IEEEST": IEEEST, "TGOV1": TGOV1},
        Card("IEEEST", "pss", {}, {"ST2CUT": ONE_INPUT, "PSS2B": PSS2B}),
        true={"IEEEST.KS": 8.0},
    ),
    "stabiliser_of_one_input": _carded(
        {"GENROU": GENROU, "EXST1": EXST1, "ST2CUT": ST2CUT, "TGOV1": TGOV1},
        Card(
            "ST2CUT",
            "pss",
            {"IEEEST": IEEEST},
            {"PSS2B": _changed("PSS2B", PSS2B, T6=0.02, T7=0.02, KS2=0.075, T3=0.2, T4=0.05)},
        ),
    ),
    "wind_as_solar": _carded(
        {"REGCA1": REGCA1, "REECA1": REECA1, "REPCA1": REPCA1},
        Card("REECA1", "elec", {"REECB1": _changed("REECB1", REECB1, Vdip=0.985)}),
        true={"REECA1.QFLAG": 0.0, "REECA1.Kqv": 2.0, "REECA1.Vdip": 0.985, "REECA1.Iqfrz": 0.1, "REECA1.Thld": 1.0},
        Sn=100.0,
        P=80.0,
    ),
    "plant_controller_missing": _carded(
        {"REGCA1": REGCA1, "REECB1": REECB1, "REPCA1": REPCA1},
        Card("REPCA1", "plant", {}),
        true={"REPCA1.Fflag": 1.0},
        Sn=100.0,
        P=80.0,
    ),
}
"""Units whose .dyr has another card than the plant, with values that are usual for it, or lacks one."""

VALUES = {
    "reheater": Plant(STEAM, None, "gov.T3", {"TGOV1.T3": 14.0}, {"TGOV1.T3": 8.0}, FALL, DIP),
    "regulator_integral": Plant(
        {"GENROU": GENROU, "AC8B": AC8B, "TGOV1": TGOV1},
        None,
        "avr.KIR",
        {"AC8B.KIR": 7.5},
        {"AC8B.KIR": 5.0},
        FALL,
        DIP,
    ),
    "field_time_constant": Plant(STEAM, None, "gen.Tpdo", {"GENROU.Tpdo": 8.0}, {"GENROU.Tpdo": 5.0}, FALL, DIP),
    "droop_of_another_base": Plant(
        {"REGCA1": REGCA1, "REECB1": REECB1, "REPCA1": REPCA1},
        None,
        "plant.Kc",
        {"REPCA1.Kc": 0.05},
        {"REPCA1.Kc": 0.125},
        FALL,
        DIP,
        Sn=100.0,
        P=80.0,
    ),
}
"""Units whose .dyr has a wrong value of a parameter that the study does not ask about."""

SETS: Mapping[str, Mapping[str, Plant]] = {"effects": EFFECTS, "cards": CARDS, "values": VALUES}
PLANTS = {name: plant for units in SETS.values() for name, plant in units.items()}
"""All of them."""
