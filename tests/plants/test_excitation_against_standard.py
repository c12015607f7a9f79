"""Exciters and stabilisers by themselves, against the standard's transfer functions and against simulations by scipy.

Here stands what andes does not have: SCRX, PSS2B, STAB2A, limits without windup of proportional-integral regulators, gates, ceilings of
the exciter, cut-outs by the voltage, and values of a record that the start decides.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import hvdc_ident as hi
from hvdc_ident.model import Model, parse_card, shelf_model
from hvdc_ident.plants import parts_of, unit_card

TIMES = np.round(np.arange(0.0, 4.001, 0.02), 6)
OMEGA = np.logspace(-2, 2, 41)
MACHINE = {"GENROU": [7.0, 0.03, 0.75, 0.05, 3.0, 0.0, 2.1, 2.0, 0.2, 0.5, 0.18, 0.15, 0.05, 0.3]}


def component(name: str, **values: float) -> Model:
    """Return a component of the shelf with values."""
    return shelf_model(name).with_values(values)


def responses(model: Model, output: str) -> dict[str, np.ndarray]:
    """Return the frequency response of an output to each input, over OMEGA."""
    linear = hi.linearize(model, outputs=[output])
    found = linear.response(OMEGA)
    return {n: found[:, 0, k] for k, n in enumerate(linear.input_names)}


def lead_lag(s: np.ndarray, lead: float, lag: float) -> np.ndarray:
    """Return (1 + lead s)/(1 + lag s), 1 where there is no lag."""
    return (1 + lead * s) / (1 + lag * s) if lag else np.ones_like(s)


def washout(s: np.ndarray, time: float) -> np.ndarray:
    """Return time s/(1 + time s), 1 where the time is 0."""
    return time * s / (1 + time * s) if time else np.ones_like(s)


PSS2B = {
    "typical": {},
    "no ramp-tracking filter": {"M": 0.0, "N": 0.0},
    "stages of two lags": {"M": 2.0, "N": 4.0, "T8": 0.2},
    "eight single lead-lags": {"M": 1.0, "N": 8.0, "T8": 0.12},
    "all blocks": {"Tw4": 3.0, "T6": 0.02, "M": 4.0, "N": 2.0, "T8": 0.4, "T10": 0.1, "T11": 0.03, "KS3": 0.9},
    "codes 3 and 1": {"ICS1": 3.0, "ICS2": 1.0, "VS1MAX": 9.0, "VS2MIN": -9.0},
}


@pytest.mark.parametrize("values", PSS2B.values(), ids=PSS2B)
def test_pss2b_has_the_transfer_functions_of_the_standard(values) -> None:
    """IEEE 421.5-2005, figure 16."""
    model = component("pss2b", **values)
    v, s = model.values, 1j * OMEGA
    first = washout(s, v["Tw1"]) * washout(s, v["Tw2"]) / (1 + v["T6"] * s)
    second = v["KS2"] * washout(s, v["Tw3"]) * washout(s, v["Tw4"]) / (1 + v["T7"] * s)
    ramp = ((1 + v["T8"] * s) / (1 + v["T9"] * s) ** v["M"]) ** v["N"] if v["M"] * v["N"] else np.ones_like(s)
    lead = lead_lag(s, v["T1"], v["T2"]) * lead_lag(s, v["T3"], v["T4"]) * lead_lag(s, v["T10"], v["T11"])
    names = {1.0: "dw", 3.0: "Pe"}
    found = responses(model, "y9")
    by_first, by_second = v["KS1"] * lead * ramp * first, v["KS1"] * lead * (ramp * v["KS3"] - 1) * second
    np.testing.assert_allclose(found[names[v["ICS1"]]], by_first, rtol=1e-8, atol=1e-9)
    np.testing.assert_allclose(found[names[v["ICS2"]]], by_second, rtol=1e-8, atol=1e-9)
    np.testing.assert_array_equal(found["Vt"], 0)


def test_stab2a_has_the_transfer_function_of_the_library() -> None:
    for values in ({}, {"T3": 0.0, "T5": 0.0}):
        model = component("stab2a", **values)
        v, s = model.values, 1j * OMEGA
        washed = -((v["K2"] * washout(s, v["T2"])) ** 3)
        expected = washed * (v["K3"] / (1 + v["T3"] * s) + v["K4"]) * (v["K5"] / (1 + v["T5"] * s)) ** 2
        np.testing.assert_allclose(responses(model, "Vs")["Pe"], expected, rtol=1e-8, atol=1e-9)


FILTERS = {
    "none": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0),
    "first of second order": (0.05, 0.002, 0.0, 0.0, 0.03, 0.001),
    "first of first order": (0.05, 0.0, 0.0, 0.0, 0.0, 0.0),
    "second alone": (0.0, 0.0, 0.06, 0.003, 0.02, 0.001),
    "without damping": (0.0, 0.002, 0.0, 0.003, 0.02, 0.001),
    "both of first order": (0.05, 0.0, 0.04, 0.0, 0.02, 0.001),
    "both": (0.05, 0.002, 0.06, 0.003, 0.02, 0.001),
}


@pytest.mark.parametrize("filters", FILTERS.values(), ids=FILTERS)
def test_ieeest_has_the_transfer_function_of_the_standard(filters) -> None:
    """IEEE 421.5-2005, figure 15, with the filters of PSS/E's model; any of them may be bypassed."""
    a1, a2, a3, a4, a5, a6 = filters
    model = component("ieeest", A1=a1, A2=a2, A3=a3, A4=a4, A5=a5, A6=a6, T4=0.0)
    v, s = model.values, 1j * OMEGA
    expected = (1 + a5 * s + a6 * s**2) / ((1 + a1 * s + a2 * s**2) * (1 + a3 * s + a4 * s**2))
    expected = expected * lead_lag(s, v["T1"], v["T2"]) * v["KS"] * v["T5"] * s / (1 + v["T6"] * s)
    np.testing.assert_allclose(responses(model, "y5")["dw"], expected, rtol=1e-8, atol=1e-9)


def simulated(model: Model, output: str, steps: Mapping[str, tuple[float, float]]) -> np.ndarray:
    """Return an output over TIMES; inputs step from the first to the second value at 0.5 s."""
    given = {n: hi.step(before, after, at=0.5) for n, (before, after) in steps.items()}
    model = model.with_values({n: before for n, (before, _) in steps.items()})
    return np.asarray(hi.simulate(model, TIMES, inputs=given)[output])


def integrated(rate: Callable[[np.ndarray, float], np.ndarray], start: np.ndarray) -> np.ndarray:
    """Return the states over TIMES, (times, states). rate(x, after): after is 0 before 0.5 s and 1 from there on."""
    before = np.searchsorted(TIMES, 0.5)
    found = [np.repeat(start[None, :], before, axis=0)]
    run = solve_ivp(
        lambda _, x: rate(x, 1.0), (0.5, TIMES[-1]), start, t_eval=TIMES[before:], max_step=1e-3, rtol=1e-8, atol=1e-10
    )
    return np.concatenate([*found, run.y.T])


def held(rate: float, x: float, low: float, high: float) -> float:
    """Return the rate of an integral that is held at its limits."""
    return 0.0 if (x >= high and rate > 0) or (x <= low and rate < 0) else rate


def test_scrx_is_driven_by_the_terminals_and_blocks_a_negative_field_current() -> None:
    """A dip of the voltage, in which the bridge goes to its ceiling, with a field current that turns negative or not."""
    for switch, rc, current in ((0.0, 0.0, 2.0), (1.0, 10.0, 2.0), (0.0, 10.0, -0.2), (0.0, 0.0, -0.2)):
        model = component("scrx", CSWITCH=switch, rcrfd=rc, EMAX=4.0)
        v = model.values

        def rate(x: np.ndarray, after: float, v: Mapping[str, float] = v) -> np.ndarray:
            error = 1.02 - (1.0 - 0.1 * after)
            lead = x[0] + v["TAoTB"] * (error - x[0])
            return np.array(
                [(error - x[0]) / v["TB"], held((v["K"] * lead - x[1]) / v["TE"], x[1], v["EMIN"], v["EMAX"])]
            )

        bridge = np.clip(integrated(rate, np.array([0.02, 2.0]))[:, 1], 0, v["EMAX"])
        voltage = np.where(TIMES < 0.5, 1.0, 0.9)
        expected = bridge if switch else bridge * voltage
        if rc and current < 0:
            expected = np.where(TIMES < 0.5, expected, -rc * current)
        found = simulated(model, "Efd", {"Vt": (1.0, 0.9), "Ifd": (2.0, current), "Vref": (1.02, 1.02)})
        np.testing.assert_allclose(found, expected, atol=1e-3 * max(np.ptp(expected), 1))


def unit(records: Mapping[str, list[float]], point: Mapping[str, float] | None = None) -> Model:
    """Return a unit at an infinite bus at its power flow."""
    model = parse_card(unit_card(parts_of(MACHINE | records), f0=60.0, R=0.01, X=0.3))
    wanted = dict(point or {"P": 80.0, "Vt": 1.02})
    free = [n for n in ("Vref", "Pref", "Pm") if n in model.inputs]
    return model.with_values(hi.find_operating_point(model, outputs=wanted, free=free).inputs)


def test_esst4b_holds_its_integral_while_the_regulator_is_beyond_its_limit() -> None:
    """IEEE 421.5-2005, annex E: there the integral neither grows nor is led back; by the error that the unit has."""
    gains, limits = (3.0, 2.0), (0.5, -0.2)
    model = unit({"ESST4B": [0.0, *gains, *limits, 0.02, 1.0, 0.0, 99.0, -99.0, 0.0, 5.0, 0.0, 9.0, 0.1, 0.0, 0.0]})
    times = np.round(np.arange(0.0, 3.0001, 0.001), 6)
    reference = model.inputs["Vref"].value
    steps = hi.step(reference, reference + 0.15, at=0.5)
    grid = hi.step(1.0, 1.2, at=1.5)
    run = hi.simulate(model, times, inputs={"Vref": steps, "E": grid}, outputs=["avr.err", "avr.xr", "avr.VR"])
    error, integral = np.asarray(run["avr.err"]), np.asarray(run["avr.xr"])
    x, expected = integral[0], []
    for e, following in zip(error, [*error[1:], error[-1]], strict=True):
        expected.append(x)
        output = gains[0] * e + x
        if not (output >= limits[0] and e > 0) and not (output <= limits[1] and e < 0):
            jumps = abs(following - e) > 0.05
            x += gains[1] * 0.001 * (e if jumps else 0.5 * (e + following))
    assert np.max(run["avr.VR"]) == limits[0]
    np.testing.assert_allclose(integral, expected, atol=1e-3 * np.ptp(integral))


def test_ac8b_limits_the_field_current_of_its_exciter() -> None:
    """The step reaches 99 pu where there is no limit, VFEMAX where there is one."""

    def highest(limit: float) -> float:
        pid = [0.0, 80.0, 5.0, 0.0, 0.0, 35.0, -35.0, 1.0, 0.01, 35.0, -10.0]
        exciter = [0.3, 0.5, 1.0, 0.6, limit, 0.0, 3.0, 0.1, 4.5, 0.5]
        model = unit({"AC8B": pid + exciter})
        before = model.inputs["Vref"].value
        run = hi.simulate(model, TIMES, inputs={"Vref": hi.step(before, before + 0.1, at=0.5)}, outputs=["avr.VFE"])
        return float(np.max(run["avr.VFE"]))

    assert highest(99.0) > 6.5
    assert highest(6.0) == pytest.approx(6.0, abs=2e-3)


def test_values_of_the_record_that_the_start_decides() -> None:
    """KE = 0: the start's regulator output is VRMAX/10. VRMAX = 0: the ceiling is what holds E2 (PSS/E model library)."""
    for model_name, lags in (("IEEET1", []), ("IEEEX1", [0.0, 0.0]), ("ESDC2A", [0.0, 0.0])):
        head = [0.0, 50.0, 0.05, *lags]
        tail = [0.5, 0.08, 1.0, 0.0, 2.0, 0.05, 3.0, 0.3]
        model = unit({model_name: [*head, 5.0, -5.0, 0.0, *tail]})
        point = hi.find_operating_point(model, outputs={"P": 80.0, "Vt": 1.02}, free=["Vref", "Pm"])
        assert point.states["avr.VR"] == pytest.approx(0.5, rel=1e-9)
        before = model.inputs["Vref"].value
        run = hi.simulate(model, TIMES, inputs={"Vref": hi.step(before, before + 0.02, at=0.5)}, outputs=["avr.KEs"])
        assert np.ptp(run["avr.KEs"]) == 0
        for ke, ceiling in ((0.9, 3 * 1.2), (-0.1, 3 * 0.3)):
            v = component(model_name.lower(), VRMAX=0.0, VRMIN=-1.0, KE=ke, E1=2.0, SE1=0.05, E2=3.0, SE2=0.3, TR=0.0)
            run = hi.simulate(v, TIMES[:2], inputs={"Vref": 1.0, "Vt": 1.0}, outputs=["VRhigh", "VRlow"])
            np.testing.assert_allclose([run["VRhigh"][0], run["VRlow"][0]], [ceiling, -ceiling])


GATES = {
    "esst1a, error": ("esst1a", {"UEL": 2.0, "KA": 200.0}, {"Vuel_gate": 0.02}, 4.0),
    "esst1a, output": ("esst1a", {"UEL": 3.0}, {"Vuel_gate": 3.0}, 3.0),
    "esst1a, other code": ("esst1a", {"UEL": 1.0, "KA": 200.0}, {"Vuel_gate": 3.0, "Vuel": 0.005}, 1.0),
    "esst1a, overexcitation": ("esst1a", {"UEL": 3.0}, {"Vuel_gate": 3.0, "Voel_gate": 2.0}, 2.0),
    "esst1a, stabiliser at the output": ("esst1a", {"VOS": 2.0}, {"Vs": 0.5}, 0.5),
    "esst4b, overexcitation": (
        "esst4b",
        {"KC": 0.0, "KP": 5.0, "XL": 0.0, "KIR": 0.0, "KPR": 9.0},
        {"Voel_gate": 0.2, "Vref": 2.0},
        1.0,
    ),
    "esac1a, underexcitation": ("esac1a", {"KC": 0.0, "KD": 0.0, "SE2": 0.0}, {"Vuel_gate": 1.5}, 1.5),
    "esac1a, overexcitation": ("esac1a", {"KC": 0.0, "KD": 0.0, "SE2": 0.0}, {"Voel_gate": 1.2, "Vref": 2.0}, 1.2),
    "esdc2a, underexcitation": ("esdc2a", {"KA": 100.0, "SE2": 0.0}, {"Vuel_gate": 0.012}, 1.2),
    "esst3a, underexcitation": (
        "esst3a",
        {"KA": 100.0, "KG": 0.0, "KM": 1.0, "KC": 0.0, "KP": 5.0, "XL": 0.0},
        {"Vuel_gate": 0.002},
        1.0,
    ),
}


@pytest.mark.parametrize(("name", "values", "inputs", "expected"), GATES.values(), ids=GATES)
def test_gates_of_the_limiters(name, values, inputs, expected) -> None:
    """No error of the voltage but what a case says; a gate that nothing drives stays open."""
    model = component(name, **values)
    at = {"Vref": 1.0, "Vt": 1.0} | {n: v for n, v in (("Ifd", 2.0),) if n in model.inputs} | inputs
    assert hi.find_operating_point(model, at).outputs["Efd"] == pytest.approx(expected, abs=1e-6)


def test_stabilisers_are_cut_out_by_the_voltage() -> None:
    """IEEEST by the voltage, ST2CUT by its change from the start; the step of the speed alone gives a signal."""
    cases = [("ieeest", {"VCU": 1.05, "VCL": 0.95}), ("st2cut", {"VCU": 0.03, "VCL": -0.07, "K2": 0.0})]
    for (name, values), low in zip(cases, (0.94, 0.94), strict=True):
        for voltage, cut in ((1.02, False), (1.06, True), (low, True)):
            found = simulated(component(name, **values), "Vs", {"dw": (0.0, 0.005), "Vt": (1.02, voltage)})
            after = found[(TIMES > 0.5) & (TIMES < 1.5)]
            assert np.all(after == 0) if cut else np.all(after > 0), (name, voltage)


def test_limits_of_pss2b() -> None:
    """A jump of the speed by 0.2 is one by VS1MAX = 0.08, and the signal is cut at VSTMAX."""
    model = component("pss2b", KS1=3.0)
    times = TIMES[:100]
    large, small = (
        hi.simulate(model, times, inputs={"dw": hi.step(0.0, size, at=0.5)}, outputs=["Vs", "y9"])
        for size in (0.2, 0.08)
    )
    np.testing.assert_array_equal(large["y9"], small["y9"])
    assert np.max(large["y9"]) > 0.3
    np.testing.assert_allclose(large["Vs"], np.clip(large["y9"], -0.1, 0.1), atol=1e-12)
