"""Models of components: the same as the flat card that an engineer would write, and what is wrong is told with its line."""

from __future__ import annotations

import fmpy
import fmpy.validation
import numpy as np
import pytest

import hvdc_ident as hi
from hvdc_ident.errors import InputError
from hvdc_ident.fmu.export import export_fmu
from hvdc_ident.fmu.export.modelica_model import modelica
from hvdc_ident.model import parse_card, read_card, write_card
from hvdc_ident.model.transform import without_vanished

REGULATOR = """schema = 1
name = "regulator"
[parameters]
TR = {value = 0.02, unit = "s", min = 0}
K = {value = 50, min = 0}
TA = {value = 0.05, unit = "s", min = 0}
[inputs]
Vt = {value = 1.0, unit = "pu", description = "the terminal voltage"}
Vref = {value = 1.0, unit = "pu"}
[states]
Vm = {derivative = "(Vt - Vm)/TR", rest = "Vt", vanishes = "TR", unit = "pu"}
Efd = {derivative = "(K*err - Efd)/TA", rest = "K*err", vanishes = "TA", unit = "pu"}
[signals]
err = "Vref - Vm"
[outputs]
Efd = {value = "Efd", unit = "pu"}
"""
MACHINE = """schema = 1
name = "machine"
[parameters]
Td = {value = 5.0, unit = "s", min = 0}
G = {value = 0.8}
[inputs]
Efd = {value = 1.0, unit = "pu"}
[states]
E = {derivative = "(Efd - E)/Td", unit = "pu"}
[outputs]
V = {value = "G*E", unit = "pu"}
MW = {value = "250*E", unit = "MW"}
"""
UNIT = """schema = 1
name = "unit"
[parameters]
T0 = {value = 0.03, unit = "s"}
[inputs]
ref = {value = 1.0, unit = "pu"}

[components.gen]
source = "machine.toml"
parameters = {Td = 6.0}
[components.avr]
source = "regulator.toml"
parameters = {K = 80, TR = "T0"}

[connections]
"gen.Efd" = "avr.Efd"
"avr.Vt" = "gen.V"
"avr.Vref" = "ref"

[outputs]
V = {value = "gen.V", unit = "pu"}
"""
FLAT = """schema = 1
name = "flat"
[inputs]
ref = {value = 1.0, unit = "pu"}
[states]
E = {derivative = "(Efd - E)/6"}
Vm = {derivative = "(0.8*E - Vm)/0.03"}
Efd = {derivative = "(80*(ref - Vm) - Efd)/0.05"}
[outputs]
V = "0.8*E"
"""
TIMES = np.linspace(0.0, 3.0, 301)
STEP = {"ref": hi.step(1.0, 1.05, at=0.5)}


@pytest.fixture
def folder(tmp_path):
    for name, text in (("machine", MACHINE), ("regulator", REGULATOR), ("unit", UNIT)):
        (tmp_path / f"{name}.toml").write_text(text, encoding="utf-8")
    return tmp_path


def changed(folder, old: str, new: str, name: str = "unit"):
    text = (folder / f"{name}.toml").read_text(encoding="utf-8")
    assert old in text
    (folder / f"{name}.toml").write_text(text.replace(old, new), encoding="utf-8")
    return read_card(folder / "unit.toml")


def eigenvalues(model):
    return np.sort_complex(np.linalg.eigvals(hi.linearize(model).A))


def test_a_plant_of_components_is_the_flat_model(folder) -> None:
    unit, flat = read_card(folder / "unit.toml"), parse_card(FLAT)
    one, other = hi.simulate(unit, TIMES, inputs=STEP), hi.simulate(flat, TIMES, inputs=STEP)
    assert np.abs(one["V"] - other["V"]).max() < 1e-6
    assert eigenvalues(unit) == pytest.approx(eigenvalues(flat), rel=1e-9)


def test_names_begin_with_the_component(folder) -> None:
    unit = read_card(folder / "unit.toml")
    assert list(unit.states) == ["gen.E", "avr.Vm", "avr.Efd"]
    assert unit.values == {"gen.Td": 6.0, "gen.G": 0.8, "avr.K": 80.0, "avr.TA": 0.05, "T0": 0.03}
    assert {"avr.Vt", "avr.err", "gen.V", "gen.MW", "gen.Efd"} <= set(unit.insertion_points)
    assert unit.signals["avr.Vt"].description == "the terminal voltage"


NAMED = {
    'source = "machine.toml"': 'source = "machine.toml"\nnames = "*1"',
    'source = "regulator.toml"': 'source = "regulator.toml"\nnames = {"*" = "*_1", "V*" = "V*1", Vm = "V1_m"}',
    '"gen.Efd" = "avr.Efd"': '"Efd1" = "Efd_1"',
    '"avr.Vt" = "gen.V"': '"Vt1" = "V1"',
    '"avr.Vref" = "ref"': '"Vref1" = "ref"',
    'V = {value = "gen.V"': 'V = {value = "V1"',
}


def named(folder, old: str = "", new: str = ""):
    for before, after in NAMED.items():
        text = (folder / "unit.toml").read_text(encoding="utf-8")
        assert before in text
        (folder / "unit.toml").write_text(text.replace(before, after), encoding="utf-8")
    return changed(folder, old, new)


def test_names_of_a_component_follow_its_patterns(folder) -> None:
    """The longest pattern that fits, a name before all; the model is the same but for its names."""
    unit = read_card(folder / "unit.toml")
    other = named(folder)
    assert list(other.states) == ["E1", "V1_m", "Efd_1"]
    assert list(other.parameters) == ["T0", "Td1", "G1", "K_1", "TA_1"]
    assert list(other.signals) == ["V1", "MW1", "err_1", "Efd1", "Vt1", "Vref1"]
    one, two = hi.simulate(unit, TIMES, inputs=STEP), hi.simulate(other, TIMES, inputs=STEP)
    assert (one["V"] == two["V"]).all()


def test_an_input_with_the_name_of_a_variable_is_that_variable(folder) -> None:
    """Of another component or of the plant: no connection, no signal and no insertion point is added."""
    unit = read_card(folder / "unit.toml")
    text = (folder / "unit.toml").read_text(encoding="utf-8")
    text = text[: text.index("[connections]")] + text[text.index("[outputs]") :]
    text = text.replace('source = "machine.toml"', 'source = "machine.toml"\nnames = {Efd = "avr.Efd"}')
    text = text.replace('source = "regulator.toml"', 'source = "regulator.toml"\nnames = {Vt = "gen.V", Vref = "ref"}')
    (folder / "unit.toml").write_text(text, encoding="utf-8")
    joined = read_card(folder / "unit.toml")
    assert set(unit.insertion_points) - set(joined.insertion_points) == {"gen.Efd", "avr.Vt", "avr.Vref"}
    one, other = hi.simulate(unit, TIMES, inputs=STEP), hi.simulate(joined, TIMES, inputs=STEP)
    np.testing.assert_allclose(one["V"], other["V"], rtol=0, atol=1e-12)
    with pytest.raises(InputError, match=r"line 12: \[components\.avr\]: 'Vt' is in pu and 'gen\.MW' in MW"):
        changed(folder, 'Vt = "gen.V"', 'Vt = "gen.MW"')


def test_a_parameter_that_is_one_of_the_plant_has_no_name_of_its_own(folder) -> None:
    unit = read_card(folder / "unit.toml")
    assert "avr.TR" not in unit.names and unit.states["avr.Vm"].vanishes == unit["T0"]
    assert "avr.TR" in changed(folder, 'TR = "T0"', 'TR = "2*T0"').signals


def test_a_free_start_goes_by_the_name_of_its_state(folder) -> None:
    changed(folder, '"(Efd - E)/Td"', '"(Efd - E)/Td", start = "free"', "machine")
    assert list(named(folder).parameters) == ["T0", "Td1", "G1", "E1_start", "K_1", "TA_1"]


def test_parameterisations_have_names_of_their_component(folder) -> None:
    text = MACHINE + '[parameterisations.rate]\nparameters = {a = {value = 0.2}}\nreplaces = {Td = "1/a"}\n'
    (folder / "machine.toml").write_text(text, encoding="utf-8")
    unit = changed(folder, "parameters = {Td = 6.0}", 'names = "gen.*"')
    assert list(unit.parameterised("gen.rate").parameters) == ["T0", "gen.a", "gen.G", "avr.K", "avr.TA"]


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('names = "*1"', 'names = {"*" = "*1", G = "K_1"}', 12, "the name 'K_1' is taken: [components.gen] has it"),
        ('names = "*1"', 'names = {"*" = "*1", Td = "T0"}', 8, "the name 'T0' is taken: the model itself has it"),
        ('names = "*1"', 'names = {"*" = "*1", E = "ref"}', 8, "the name 'ref' is taken: the model itself has it"),
        ('names = "*1"', 'names = {"*" = "*1", G = "Td1"}', 8, "the name 'Td1' is taken: [components.gen] has it"),
        ('names = "*1"', 'names = {"*" = "*1", Tq = "T"}', 8, "no variable 'Tq'"),
        ('names = "*1"', 'names = {"*" = "G1"}', 8, "no pattern of names"),
        ('names = "*1"', 'names = "1*"', 8, "'1Td' cannot name a variable"),
        ('TR = "T0"', 'TR = "T1"', 12, "no variable 'T1'"),
        ('"Vt1" = "V1"', '"Vt1" = "V2"', 19, "no variable 'V2'"),
        ('names = "*1"', "names = 1", 8, "components.gen.names: a value of the wrong kind"),
        (
            'names = "*1"',
            'names = {"*" = 1}',
            8,
            "components.gen.names.*: a value of the wrong kind; expected text in quotes, got 1",
        ),
        ('T0 = {value = 0.03, unit = "s"}', 'T0 = {value = 0.03, unit = "1/s"}', 12, "'TR' is in s and 'T0' in 1/s"),
    ],
)
def test_what_is_wrong_with_names_is_told_with_its_line(folder, old: str, new: str, line: int, words: str) -> None:
    with pytest.raises(InputError) as caught:
        named(folder, old, new)
    assert f"unit.toml, line {line}: " in str(caught.value) and words in str(caught.value)


def test_a_flattened_plant_is_a_card(folder) -> None:
    unit = read_card(folder / "unit.toml")
    assert parse_card(write_card(unit)) == unit


def test_components_nest(folder) -> None:
    (folder / "park.toml").write_text(
        """schema = 1
name = "park"
components = {one = {source = "unit.toml"}, two = {source = "unit.toml", parameters = {"gen.Td" = 7.0}}}
connections = {"one.ref" = "1.0", "two.ref" = "one.V"}
outputs = {V = "two.V"}
""",
        encoding="utf-8",
    )
    park = read_card(folder / "park.toml")
    assert park.values["one.gen.Td"] == 6.0 and park.values["two.gen.Td"] == 7.0
    assert len(park.states) == 6 and max(e.real for e in eigenvalues(park)) < 0


@pytest.mark.parametrize("value", ["0.0", "1e-5"])
def test_a_lag_of_0_s_is_a_wire(folder, value: str) -> None:
    """At 0 the state is gone; at 10 us the model is nearly the same."""
    unit = changed(folder, "T0 = {value = 0.03", f"T0 = {{value = {value}")
    assert ("avr.Vm" in unit.states) == (value != "0.0")
    flat = parse_card(FLAT.replace('Vm = {derivative = "(0.8*E - Vm)/0.03"}\n', "").replace("ref - Vm", "ref - 0.8*E"))
    one, other = hi.simulate(unit, TIMES, inputs=STEP), hi.simulate(flat, TIMES, inputs=STEP)
    assert np.abs(one["V"] - other["V"]).max() < 1e-5


def test_a_time_constant_that_is_gone_does_not_come_back(folder) -> None:
    unit = read_card(folder / "unit.toml").with_values({"avr.TA": 0.0})
    assert "avr.Efd" in unit.signals
    with pytest.raises(InputError, match=r"avr\.TA.*\[0, 0\]"):
        unit.with_values({"avr.TA": 0.1})


def test_states_that_are_gone_are_signals_in_their_order() -> None:
    """So that a card has one text, whatever a process's hashes are."""
    states = {f"x{k}": f'{{derivative = "(u - x{k})/T", rest = "u", vanishes = "T"}}' for k in range(8)}
    head = [
        "schema = 1",
        'name = "lags"',
        "parameters = {T = {value = 0.0, min = 0.0}}",
        "inputs = {u = {value = 1.0}}",
    ]
    lines = [*head, 'outputs = {y = "x7"}', "[states]", *(f"{n} = {s}" for n, s in states.items())]
    assert list(without_vanished(parse_card("\n".join(lines))).signals) == list(states)


def test_conditions_that_a_gone_time_constant_decides_open_circles(folder) -> None:
    """x follows y, which uses x only where T is not 0: at 0 there is no circle of wires."""
    text = """
schema = 1
name = "held"
parameters = {T = {value = 0.5, min = 0.0}}
inputs = {u = {value = 1.0}}
signals = {y = {value = "where(T > 0, 0.5*x, 0) + u"}}
states = {x = {derivative = "(y - x)/T", rest = "y", vanishes = "T"}}
outputs = {y = "y"}
"""
    held = parse_card(text)
    assert hi.simulate(held, [0.0, 1.0])["y"] == pytest.approx([2.0, 2.0])
    assert hi.simulate(held.with_values({"T": 0.0}), [0.0, 1.0])["y"] == pytest.approx([1.0, 1.0])


def test_a_circle_of_wires_needs_an_unknown(folder) -> None:
    """Without a lag in it y = k (1 - y) is a circle, with an unknown it has the solution k/(1 + k)."""
    gain = 'schema = 1\nname = "gain"\nparameters = {k = {value = 4.0}}\n'
    gain += 'inputs = {u = {value = 0.0}}\noutputs = {y = "k*u"}\n'
    (folder / "gain.toml").write_text(gain, encoding="utf-8")
    loop = 'schema = 1\nname = "loop"\ncomponents = {a = {source = "gain.toml"}}\n'
    loop += 'connections = {"a.u" = CONNECTION}\noutputs = {y = "a.y"}\n'
    path = folder / "loop.toml"
    path.write_text(loop.replace("CONNECTION", '"1 - a.y"'), encoding="utf-8")
    with pytest.raises(InputError, match=r"circle: a\.y -> a\.u -> a\.y.*give a connection a start"):
        read_card(path)
    path.write_text(loop.replace("CONNECTION", '{value = "1 - a.y", start = 0.5}'), encoding="utf-8")
    assert hi.simulate(path, [0.0, 1.0])["y"] == pytest.approx([0.8, 0.8])


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ('"avr.Vref" = "ref"', "", 11, "[components.avr]: the input 'avr.Vref' is not connected"),
        ('"avr.Vt" = "gen.V"', '"avr.Vx" = "gen.V"', 17, "no input of a component 'avr.Vx'"),
        ('source = "regulator.toml"', 'source = "regulatr"', 11, "no shipped component 'regulatr'"),
        ('source = "regulator.toml"', 'source = "gone.toml"', 11, "cannot be read"),
        ('source = "regulator.toml"', 'source = "unit.toml"', 11, "a component of itself"),
        ("{Td = 6.0}", "{Tq = 6.0}", 8, "no parameter or input 'Tq'"),
        ("K = 80", "K = -80", 11, "outside its own bounds"),
        ('K = 80, TR = "T0"', 'TX = "T0"', 11, "no parameter 'TX'"),
        ('"avr.Vt" = "gen.V"', '"avr.Vt" = "gen.MW"', 17, "'avr.Vt' is in pu and 'gen.MW' in MW"),
        (
            '"avr.Vt" = "gen.V"',
            '"avr.Vt" = ["gen.V"]',
            17,
            "connections.avr.Vt: a value of the wrong kind; expected an expression",
        ),
        ('"avr.Vt" = "gen.V"', '"avr.Vt" = "gen.V +"', 17, "unexpected the end"),
        ("[components.avr]", "[components.outputs]", 11, "a component cannot have this name"),
    ],
)
def test_what_is_wrong_is_told_with_its_line(folder, old: str, new: str, line: int, words: str) -> None:
    with pytest.raises(InputError) as caught:
        changed(folder, old, new)
    assert f"unit.toml, line {line}: " in str(caught.value) and words in str(caught.value)


def test_an_effect_sits_at_a_place_of_a_component(folder) -> None:
    unit = hi.apply_effects(
        read_card(folder / "unit.toml"), [{"effect": "lag", "at": "avr.Vt", "parameters": {"T": 0.07}}]
    )
    flat = parse_card(
        FLAT.replace("(0.8*E - Vm)", "(x - Vm)").replace("[states]", '[states]\nx = {derivative = "(0.8*E - x)/0.07"}')
    )
    one, other = hi.simulate(unit, TIMES, inputs=STEP), hi.simulate(flat, TIMES, inputs=STEP)
    assert np.abs(one["V"] - other["V"]).max() < 1e-6


def test_a_plant_of_components_leaves_as_fmu_and_modelica(folder) -> None:
    unit = read_card(folder / "unit.toml")
    path = export_fmu(unit, folder / "unit.fmu").path
    assert not fmpy.validation.validate_fmu(str(path))
    given = np.array([(0.0, 1.0), (0.5, 1.0), (0.5, 1.05), (3.0, 1.05)], dtype=[("time", float), ("ref", float)])
    run = fmpy.simulate_fmu(str(path), fmi_type="ModelExchange", stop_time=3.0, output_interval=0.01, input=given)
    expected = hi.simulate(unit, TIMES, inputs=STEP)
    assert np.abs(np.interp(TIMES, run["time"], run["V"]) - expected["V"]).max() < 1e-4
    text = modelica(unit)
    assert "der('gen.E') = " in text and "parameter Real 'avr.K'(min = 0.0) = 80.0;" in text


def test_a_condition_on_a_time_constant_that_vanishes_opens_a_circle() -> None:
    """An integral that its limits hold rests where it has led to; without its gain it is 0."""
    card = """schema = 1
name = "integral"
[parameters]
KI = {value = 2.0, unit = "1/s", min = 0}
[inputs]
ref = {value = 0.3, unit = "pu"}
[states]
x = {derivative = "KI*e", rest = "where(KI > 0, clip(x + e, -1, 1), 0)", vanishes = "KI", unit = "pu"}
[signals]
e = "ref - x"
[outputs]
x = {value = "x", unit = "pu"}
e = {value = "e", unit = "pu"}
"""
    model = parse_card(card)
    assert hi.find_operating_point(model).outputs["x"] == pytest.approx(0.3)
    without = model.with_values({"KI": 0.0})
    assert not without.states
    assert hi.find_operating_point(without).outputs["e"] == pytest.approx(0.3)
