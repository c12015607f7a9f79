"""What cards say of their parameters: each in itself, and of two that are the same transfer function."""

from __future__ import annotations

import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.model import Model, shelf_model
from hvdc_ident.plants.meaning import Said, meaning_of, of_class, said_by, taken
from hvdc_ident.shelf import components, exchange_of, outputs_of

CARDS = [n for n in components() if meaning_of(n).klass]
OMEGA = np.logspace(-2, 2, 41)


@pytest.mark.parametrize("card", CARDS)
def test_the_table_of_a_card_is_about_its_parameters(card: str) -> None:
    model, meaning = shelf_model(card), meaning_of(card)
    known = {q for n in components() for q in meaning_of(n).says}
    assert known.isdisjoint(p for n in CARDS for p in shelf_model(n).parameters), "a quantity has a name of its own"
    assert {s.name for e in meaning.says.values() for s in e.free_symbols} <= set(model.parameters)
    asked = {s.name for of in meaning.takes.values() for e in of for s in e.free_symbols}
    assert asked <= known | set(model.parameters)
    assert len({outputs_of(n) & {"Efd", "Pm", "Vs", "Ipcmd", "Qext", "Pref"} for n in of_class(meaning.klass)}) == 1
    assert exchange_of(card)["ranges"] and 0 < len(meaning.free) <= 6
    times = {s.name for state in model.states.values() if state.vanishes for s in state.vanishes.free_symbols}
    for n, (low, high) in meaning.free.items():
        p = model.parameters[n]
        assert p.min <= low < high <= p.max, n
        assert low > 0 or n not in times, f"{n} = 0 takes a block out, which no fit brings back"
        assert low <= p.value <= high or p.value == 0, n


@pytest.mark.parametrize("card", CARDS)
def test_a_card_takes_what_it_says(card: str) -> None:
    """At its own values, and at others, where the quantities count: shares of steam are of their sum."""
    own = shelf_model(card).values
    parameters = taken(card, said_by(card, own, "x"))
    rest = {"Fflag"} if card == "repca1" else set()  # with which it is added
    assert {n: s.value for n, s in parameters.items() if n not in rest} == pytest.approx(
        {n: own[n] for n in parameters if n not in rest}
    )
    rng, free = np.random.default_rng(1), meaning_of(card).free
    moved = own | {n: low + (high - low) * rng.random() for n, (low, high) in free.items()}
    said = said_by(card, moved, "x")
    again = said_by(card, own | {n: s.value for n, s in taken(card, said).items()}, "x")
    asked = {s.name for of in meaning_of(card).takes.values() for s in of[0].free_symbols}
    assert {q: again[q].value for q in said if q in asked} == pytest.approx(
        {q: said[q].value for q in said if q in asked}
    )


def test_a_quantity_that_is_no_number_is_not_said_and_a_value_that_is_excluded_not_taken() -> None:
    isochronous = said_by("ggov1", shelf_model("ggov1").values | {"Rselect": 0.0}, "gov")
    assert "droop" not in isochronous and "servo" in isochronous
    assert "R" not in taken("tgov1", isochronous) and "R" not in taken("tgov1", {"droop": Said(0.0)})


def response(card: str, given: dict[str, float], u: str, output: str) -> np.ndarray:
    """Return the frequency response of a component at values."""
    model: Model = shelf_model(card).with_values(given)
    linear = hi.linearize(model, outputs=[output])
    return np.asarray(linear.response(OMEGA)[:, 0, linear.input_names.index(u)])


WIDE = {"VIMAX": 9.0, "VIMIN": -9.0}
STEAM = {"K": 22.0, "T1": 0.2, "T2": 0.05, "T3": 0.15, "T4": 0.3, "K1": 0.2, "T5": 7.0, "K3": 0.5, "T6": 0.4, "K5": 0.3}
COMPOUND = {"T1": 0.2, "T2": 0.1, "T3": 0.3, "T4": 0.2, "T5": 6.0, "T6": 0.5, "K1": 17.0, "K2": 0.7, "K3": 0.4}
SAME = [
    ("tgov1", {"R": 0.04, "T1": 0.3, "T2": 2.1, "T3": 7.0}, "ieeeg1", {}),
    ("tgov1", {"R": 0.04, "T1": 0.3, "T2": 2.1, "T3": 7.0}, "ieesgo", {}),
    ("tgov1", {"R": 0.04, "T1": 0.3, "T2": 0.0, "T3": 0.0}, "ieeeg1", {}),
    ("ieeeg1", STEAM, "ieesgo", {}),
    ("ieesgo", COMPOUND, "ieeeg1", {}),
    ("ieeeg1", {**STEAM, "T1": 0.0, "T2": 0.0, "T4": 0.0, "K3": 0.8, "K5": 0.0}, "tgov1", {}),
    ("sexs", {"K": 150.0, "TAoTB": 0.2, "TB": 8.0, "TE": 0.04}, "exst1", WIDE),
    ("sexs", {"K": 150.0, "TAoTB": 0.2, "TB": 8.0, "TE": 0.04}, "esst1a", WIDE),
    ("sexs", {"K": 90.0, "TB": 0.0, "TE": 0.04}, "exst1", WIDE),
    ("sexs", {"K": 150.0, "TAoTB": 0.2, "TB": 8.0, "TE": 0.04}, "scrx", {"CSWITCH": 1.0}),
    ("exst1", {"TR": 0.0, "TC": 2.0, "TB": 9.0, "KA": 180.0, "KF": 0.0, **WIDE}, "sexs", {}),
    ("exst1", {"TC": 2.0, "TB": 9.0, "KA": 180.0, "KF": 0.02, "KC": 0.0, **WIDE}, "esst1a", {}),
    ("ieeet1", {"KA": 70.0, "TA": 0.03, "TE": 0.7, "KF": 0.05, "SE1": 0.1}, "ieeex1", {}),
    ("ieeex1", {"KA": 70.0, "TB": 4.0, "TC": 1.0, "TE": 0.7, "KF": 0.05, "SE1": 0.1}, "esdc2a", {}),
    ("exac1", {"KA": 120.0, "TB": 4.0, "TC": 1.0, "KD": 0.3, "KC": 0.1}, "esac1a", {}),
    ("ieeest", {"KS": 6.0, "T1": 0.3, "T2": 0.04, "T3": 0.25, "T4": 0.06, "T5": 8.0, "T6": 10.0}, "st2cut", {}),
    ("ieeest", {"IC": 3.0, "KS": -2.0, "T5": 5.0, "T6": 5.0}, "st2cut", {}),
    ("st2cut", {"K1": 6.0, "K2": 0.0, "T1": 0.0, "T2": 0.0, "T5": 0.3}, "ieeest", {}),
]
"""Two cards of one transfer function at these values of the first; of the second those that the first does not say."""
PATHS = {"governor": ("dw", "Pm"), "exciter": ("Vt", "Efd"), "stabiliser": ("dw", "Vs")}


@pytest.mark.parametrize(
    ("card", "given", "other", "rest"), SAME, ids=[f"{a}-{b}-{k}" for k, (a, _, b, _) in enumerate(SAME)]
)
def test_two_cards_of_one_transfer_function_carry_it_over(card, given, other, rest) -> None:
    u, output = PATHS[meaning_of(card).klass]
    u = "Pe" if given.get("IC") == 3.0 else u
    said = said_by(card, shelf_model(card).values | given, "x")
    carried = {n: s.value for n, s in taken(other, said).items()}
    expected = response(card, given, u, output)
    assert np.abs(expected).max() > 1.0
    np.testing.assert_allclose(response(other, rest | carried, u, output), expected, rtol=1e-6)
