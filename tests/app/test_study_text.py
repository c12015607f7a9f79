"""An experiment written into a study's text: it reads back, and nothing else of the file changes."""

from __future__ import annotations

import tomllib
from typing import Any

import pytest

pytest.importorskip("tomlkit", reason="the workbench needs: pip install 'hvdc_ident[app]'")

from hvdc_ident.app.study_text import with_experiment, with_parameters
from hvdc_ident.errors import StudyError

STUDY = """# the study of the spring campaign
schema = 1 # of the format

[model]
source = "vsc-hvdc-link"

# what may be estimated
[parameters]
KIVDC = {start = 700} # a comment # with two signs

# first recording
[[experiment]]
name = "up" # its name
data = "up.csv"
inputs = ["Vdcref1"]   # by their own names
noise = {Vdc1 = 1e-4}  # from the data sheet

[experiment.outputs]
Vdc1 = "V #1"  # the bus
Irorder1 = "I"

# second recording
[[experiment]]
name = "down"
data = "down.csv"
outputs = [
    "Vdc1", # in two
    "P2",   # lines
]

# how it is fitted
[fit]
starts = 2
"""


def keys(**changes: Any) -> dict[str, Any]:
    same = {"inputs": {"Vdcref1": "Vdcref1"}, "outputs": {"Vdc1": "V #1", "Irorder1": "I"}}
    return {
        "name": "up",
        "data": "up.csv",
        **same,
        "columns": {},
        "role": None,
        "event": None,
        "window": None,
        **changes,
    }


def test_what_says_the_same_stays_letter_for_letter() -> None:
    assert with_experiment(STUDY, "up", keys(), "study.toml") == STUDY


def test_only_the_lines_of_what_changed_are_others() -> None:
    outputs = {"Vdc1": "V2", "P2": "P"}
    new = with_experiment(STUDY, "up", keys(outputs=outputs, event=0.1, window=[0.0, 0.5]), "study.toml")
    left, right = set(STUDY.splitlines()), set(new.splitlines())
    assert left - right == {'Vdc1 = "V #1"  # the bus', 'Irorder1 = "I"'}
    assert right - left == {'Vdc1 = "V2"  # the bus', 'P2 = "P"', "event = 0.1", "window = [0.0, 0.5]"}
    experiment = tomllib.loads(new)["experiment"][0]
    assert experiment["outputs"] == outputs and experiment["noise"] == {"Vdc1": 1e-4} and experiment["event"] == 0.1


def test_a_list_of_names_becomes_a_table_and_a_key_goes() -> None:
    changed = {
        "name": "down",
        "data": "down.csv",
        "outputs": {"Vdc1": "Vdc1", "P2": "P_MW"},
        "columns": {"P2": {"base": 1000.0}},
    }
    new = with_experiment(STUDY, "down", changed, "study.toml")
    assert tomllib.loads(new)["experiment"][1] == changed
    assert new.partition("[[experiment]]")[0] == STUDY.partition("[[experiment]]")[0]
    assert new.endswith("# how it is fitted\n[fit]\nstarts = 2\n")
    back = with_experiment(new, "down", {**changed, "columns": {}}, "study.toml")
    assert "columns" not in tomllib.loads(back)["experiment"][1]


def test_an_experiment_is_renamed_and_another_added_behind_the_last() -> None:
    new = with_experiment(STUDY, "up", keys(name="first"), "study.toml")
    assert new == STUDY.replace('name = "up"', 'name = "first"')
    added = with_experiment(
        STUDY, "third", keys(name="third", columns={"Vdc1": {"unit": "kV", "base": 640.0}}), "study.toml"
    )
    assert [e["name"] for e in tomllib.loads(added)["experiment"]] == ["up", "down", "third"]
    assert added.index('"third"') < added.index("# how it is fitted")
    assert all(line in added.splitlines() for line in STUDY.splitlines())


@pytest.mark.parametrize("text", ['schema = 1\n[model]\nsource = "x"', 'schema = 1\n[model]\nsource = "x"\n\n\n', ""])
def test_the_first_experiment_stands_at_the_end(text: str) -> None:
    new = with_experiment(text, "up", keys(), "study.toml")
    assert tomllib.loads(new) == {
        **tomllib.loads(text),
        "experiment": [{k: v for k, v in keys().items() if v}],
    }


def test_line_ends_and_the_byte_order_mark_stay() -> None:
    text = "\ufeff" + STUDY.replace("\n", "\r\n")
    new = with_experiment(text, "up", keys(event=0.25), "study.toml")
    assert new.startswith("\ufeff# the study") and "\n" not in new.replace("\r\n", "")
    assert new.replace("event = 0.25\r\n", "") == text


@pytest.mark.parametrize(
    "layout",
    [
        'name = "up"\ndata = "up.csv"\ninputs.Vdcref1 = "Vdcref1"\noutputs.Vdc1 = "V #1"\noutputs.Irorder1 = "I"\n',
        'name = "up"\ndata = "up.csv"\ninputs = ["Vdcref1"]\noutputs = {Vdc1 = "V #1"}\n[experiment.columns.Vdc1]\nbase = 2.0\n',
        '"name" = \'up\'\ndata = """\nup.csv"""\ninputs = ["Vdcref1"]\n[ experiment . outputs ]\n"Vdc1" = "V #1"\nIrorder1 = "I"\n',
        'outputs = ["Vdc1"]\nname = "up"\ndata = "up.csv"\n[[experiment.phases]]\nvoltage = ["a", "b", "c"]\ngives = {V = "v"}\n',
    ],
)
def test_every_layout_of_one_experiment_is_changed(layout: str) -> None:
    text = f"schema = 1\n[[experiment]]\n{layout}# end\n[fit]\nstarts = 3\n"
    wanted = keys(outputs={"Vdc1": "other", "P2": 'with "quotes" and # sign'}, columns={"Vdc1": {"base": 3.0}})
    new = tomllib.loads(with_experiment(text, "up", wanted, "study.toml"))
    assert new["fit"] == {"starts": 3}
    found = new["experiment"][0]
    assert found["outputs"] == wanted["outputs"] and found["columns"] == wanted["columns"]
    assert found.get("phases") == tomllib.loads(text)["experiment"][0].get("phases")


APART = """[[experiment]]
name = "first" # of two
data = "first.csv"
[experiment.inputs] # played
Pref2 = "P"
# Vdcref1 = "V" may be one, too

# what is compared
[experiment.outputs]
gen.P = "P" # active
gen.Q = "Q" # reactive
# for the outputs
[experiment.columns.gen]
P.base = 500.0 # MVA
# how it is fitted
[fit]
starts = 2
# a later one
[[experiment]]
name = "second"
data = "second.csv"
outputs.gen.P = "P" # active
outputs.V = "V" # voltage
# the end
"""


def test_comments_stay_with_what_they_are_about() -> None:
    first = {
        "inputs": {"Pref2": "P", "Vdcref1": "V"},
        "outputs": {"gen.P": "P", "gen.Q": "Q2", "V": "U"},
        "columns": {"gen.P": {"base": 600.0}, "gen.Q": {"unit": "MW"}},
        "event": 0.1,
    }
    new = with_experiment(APART, "first", first, "study.toml")
    assert new == (
        APART.replace('data = "first.csv"\n', 'data = "first.csv"\nevent = 0.1\n\n')
        .replace('Pref2 = "P"\n', 'Pref2 = "P"\nVdcref1 = "V"\n')
        .replace('gen.Q = "Q" # reactive\n', 'gen.Q = "Q2" # reactive\nV = "U"\n')
        .replace("P.base = 500.0 # MVA\n", 'P.base = 600.0 # MVA\nQ = {unit = "MW"}\n')
    )
    second = {"outputs": {"gen.P": "P", "V": "U"}, "window": [0.0, 1.0]}
    new = with_experiment(APART, "second", second, "study.toml")
    assert new == APART.replace('V = "V" # voltage\n', 'V = "U" # voltage\nwindow = [0.0, 1.0]\n')


def test_a_new_experiment_is_laid_out_as_in_a_new_study() -> None:
    new = {
        "name": "third",
        "outputs": {"gen.P": "P"},
        "inputs": {},
        "columns": {"gen.P": {"base": 2.0}},
        "role": "holdout",
    }
    assert with_experiment(APART, "third", new, "study.toml") == APART.replace(
        "# the end\n",
        """
[[experiment]]
name = "third"
role = "holdout"

[experiment.outputs]   # signal of the model = column
"gen.P" = "P"

[experiment.columns]
"gen.P" = {base = 2.0}
# the end
""",
    )


def test_an_experiment_in_one_line_is_changed_there() -> None:
    text = 'experiment = [{name = "up", data = "up.csv", outputs = ["Vdc1"]}] # one\n'
    new = with_experiment(text, "up", {"outputs": {"Vdc1": "V"}}, "study.toml")
    assert new == text.replace('["Vdc1"]', '{Vdc1 = "V"}')


def test_a_layout_that_cannot_be_changed_is_refused() -> None:
    inside_a_text = '[[experiment]]\nname = "up"\nnote = """\n[[experiment]]\n"""\n'
    out_of_order = '[[experiment]]\nname = "up"\n[fit]\n[experiment.outputs]\nVdc1 = "V"\n'
    for text in (inside_a_text, out_of_order):
        with pytest.raises(StudyError, match="as it was"):
            with_experiment(text, "up", keys(), "study.toml")
    with pytest.raises(StudyError, match="not valid TOML"):
        with_experiment("schema = = 1", "up", keys(), "study.toml")


def test_values_bounds_and_effects_are_written_and_the_rest_stays_letter_for_letter() -> None:
    lag = {"effect": "lag", "at": "Ir1", "parameters": {"T": 0.01}}
    candidates = {"KIVDC": {"start": 800.0, "max": 2e3}, "KIP": {"start": 1.0, "min": 0.5}}
    new = with_parameters(STUDY, candidates, {"KPQ": 0.5}, [lag], "study.toml")
    left, right = STUDY.splitlines(), new.splitlines()
    assert [line for line in left if line not in right] == ["KIVDC = {start = 700} # a comment # with two signs"]
    assert (
        new.index("[[model.effect]]")
        < new.index("# what may be estimated")
        < new.index("KIP =")
        < new.index("# first recording")
    )
    found = tomllib.loads(new)
    assert found["parameters"] == candidates and found["model"] == {
        "source": "vsc-hvdc-link",
        "values": {"KPQ": 0.5},
        "effect": [lag],
    }
    assert "# a comment # with two signs" in new
    twice = tomllib.loads(with_parameters(new, {}, {"KPQ": 0.25}, [lag], "study.toml"))
    assert twice["model"]["values"] == {"KPQ": 0.25} and twice["model"]["effect"] == [lag, lag]


def test_a_parameter_that_is_fitted_no_longer_goes() -> None:
    new = with_parameters(STUDY, {"KIVDC": None, "KIP": None}, {}, [], "study.toml")
    assert new == STUDY.replace("KIVDC = {start = 700} # a comment # with two signs\n", "")


def test_a_parameter_of_a_component_is_changed_where_it_stands() -> None:
    text = 'schema = 1\n[model]\nsource = "unit.toml"\n[parameters.gen]\nH = {start = 3} # inertia\n[fit]\nstarts = 2\n'
    new = with_parameters(text, {"gen.H": {"start": 4.0}, "gen.D": {"min": 0.0}}, {"avr.K": 2.0}, [], "study.toml")
    found = tomllib.loads(new)
    assert found["parameters"] == {"gen": {"H": {"start": 4.0}, "D": {"min": 0.0}}} or found["parameters"] == {
        "gen": {"H": {"start": 4.0}},
        "gen.D": {"min": 0.0},
    }
    assert found["model"]["values"] == {"avr.K": 2.0} and "# inertia" in new


def test_a_layout_in_which_values_cannot_be_changed_is_refused() -> None:
    text = 'schema = 1\nname = """\n[[experiment]]\n"""\n[model]\nsource = "x"\n'
    with pytest.raises(StudyError, match="as it was"):
        with_parameters(text, {"k": {"start": 1.0}}, {}, [], "study.toml")
