"""Every format of a linear model read back to the last bit, and the figures."""

import json
import re
from dataclasses import replace

import matplotlib.pyplot as plt
import numpy as np
import pytest
from scipy.io import loadmat

from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import InputError, UnknownNameError
from hvdc_ident.linearize import LinearModel, find_operating_point, linearize, root_locus
from hvdc_ident.linearize.export import write
from hvdc_ident.models import load_model
from tests.linearize.helpers import linear

NAMES = [f"{k}_{w}" for k in ("state", "input", "output") for w in ("names", "units")]
DELAY = [{"effect": "delay", "at": "Ir1", "parameters": {"T": 0.002}}]


def models():
    link = load_model("vsc-hvdc-link")
    rng = np.random.default_rng(2)
    odd = linear(rng.normal(size=(3, 3)) * 1e-17, rng.normal(size=(3, 1)), rng.normal(size=(2, 3)) * 1e200)
    return {"link": linearize(link), "delayed": linearize(apply_effects(link, DELAY)), "odd": odd}


@pytest.fixture(scope="module")
def known():
    return models()


def of_json(path):
    return LinearModel.from_dict(json.loads(path.read_text()))


def of_mat(path):
    """As MATLAB reads it: cell arrays of names, columns of levels."""
    data = loadmat(path)
    names = {k: tuple(str(n[0]) if n.size else "" for n in data[k].ravel()) for k in NAMES}
    levels = {k: tuple(data[k].ravel().tolist()) for k in ("x0", "u0", "y0")}
    return LinearModel(**{k: data[k] for k in "ABCDE"}, **names, **levels, name=str(data["name"][0]))


def of_script(path):
    """As Octave runs it: rows parted by semicolons, quotes doubled."""
    found = dict(re.findall(r"^(\w+) = (.*);$", path.read_text(), flags=re.MULTILINE))
    numbers = {
        k: [[float(v) for v in r.split()] for r in found[k].strip("[]").split(";")]
        for k in (*"ABCDE", "x0", "u0", "y0")
    }
    names = {k: tuple(n.replace("''", "'") for n in re.findall(r"'((?:[^']|'')*)'", found[k])) for k in NAMES}
    levels = {k: tuple(v[0] for v in numbers[k]) for k in ("x0", "u0", "y0")}
    return LinearModel(**{k: np.array(numbers[k]) for k in "ABCDE"}, **names, **levels, name=found["name"].strip("'"))


def of_modelica(path):
    """As Modelica declares it: arrays in braces."""
    text = path.read_text()
    found = dict(
        re.findall(r"^  (?:parameter Real|constant String) (\w+)\[[^]]*\] = \{(.*)\};$", text, flags=re.MULTILINE)
    )
    numbers = {k: [[float(v) for v in r.split(",")] for r in re.findall(r"\{([^{}]+)\}", found[k])] for k in "ABCD"}
    names = {k: tuple(re.findall(r'"([^"]*)"', found[k])) for k in NAMES}
    levels = {k: tuple(float(v) for v in found[k].split(",")) for k in ("x0", "u0", "y0")}
    matrices = {k: np.array(v) for k, v in numbers.items()}
    name = re.search('"Linear model of (.*), deviations', text)[1]
    return LinearModel(**matrices, E=np.eye(len(matrices["A"])), **names, **levels, name=name)


READERS = {".json": of_json, ".mat": of_mat, ".m": of_script, ".mo": of_modelica}


@pytest.mark.parametrize("ending", READERS)
@pytest.mark.parametrize("which", ["link", "delayed", "odd"])
def test_state_spaces_come_back_to_the_last_bit(known, tmp_path, ending, which):
    model = known[which]
    back = READERS[ending](write(model, tmp_path / f"x{ending}"))
    for key in "ABCDE":
        np.testing.assert_array_equal(getattr(back, key), getattr(model, key))
    for key in (*NAMES, "x0", "u0", "y0", "name"):
        assert getattr(back, key) == getattr(model, key), key


def test_a_descriptor_comes_back_too(tmp_path):
    model = linearize(load_model("vsc-hvdc-link"), descriptor=True)
    for ending in (".json", ".mat", ".m"):
        np.testing.assert_array_equal(READERS[ending](write(model, tmp_path / f"d{ending}")).E, model.E)
    assert "dss(A, B, C, D, E" in (tmp_path / "d.m").read_text()


def test_the_frequency_response_as_csv(known, tmp_path):
    model = known["link"].channel(["Vdcref1", "Pref2"], ["Vdc1", "P2"])
    path, own = write(model, tmp_path / "x.csv"), model.bode()
    table = np.genfromtxt(path, delimiter=",", names=True)
    np.testing.assert_array_equal(table["omega"], own.omega)
    for i, o in enumerate(own.output_names):
        for j, u in enumerate(own.input_names):
            np.testing.assert_array_equal(
                table[f"re_{o}_from_{u}"] + 1j * table[f"im_{o}_from_{u}"], own.values[:, i, j]
            )
    assert "# method: symbolic" in path.read_text()


def test_names_with_quotes_and_lines_stay_names(tmp_path):
    plain = linear([[-1.0]], [[1.0]], [[1.0]])
    model = replace(plain, input_names=("it's \n late",), name='a "model"')
    assert of_script(write(model, tmp_path / "x.m")).input_names == ("it's late",)
    text = write(model, tmp_path / "2x.mo").read_text()
    assert text.startswith('model m_2x "Linear model of a \\"model\\", deviations') and '{"it\'s late"}' in text


def test_what_is_no_linear_model_or_no_ending_is_refused(tmp_path):
    for data in ({}, {"schema": 1, "A": [[1.0]]}, []):
        with pytest.raises(InputError):
            LinearModel.from_dict(data)
    with pytest.raises(InputError, match="ending"):
        write(linear([[-1.0]], [[1.0]], [[1.0]]), tmp_path / "x.tex")
    with pytest.raises(InputError, match="no Modelica"):
        write(linear(np.zeros((0, 0)), np.zeros((0, 1)), np.zeros((1, 0)), [[2.0]]), tmp_path / "x.mo")


def test_sizes_and_values_of_a_linear_model_are_checked():
    with pytest.raises(InputError, match="does not fit"):
        LinearModel(np.eye(2), np.ones((2, 1)), np.ones((1, 2)), [[0.0]], np.eye(2), ("a",), ("u",), ("y",))
    with pytest.raises(InputError, match="not finite"):
        linear([[np.nan]], [[1.0]], [[1.0]])
    with pytest.raises(UnknownNameError):
        linear([[-1.0]], [[1.0]], [[1.0]]).transfer_function("nothing", "y0")


@pytest.mark.parametrize("kind", ["bode", "nyquist", "poles", "participation"])
def test_figures_of_a_model(known, kind, tmp_path):
    drawn = np.atleast_1d(known["link"].channel("Vdcref1", "Vdc1").plot(kind))
    for axes in drawn:
        assert axes.get_xlabel() or axes.get_ylabel()
    drawn[0].figure.savefig(tmp_path / "x.png")
    plt.close(drawn[0].figure)


def test_figures_are_drawn_where_asked(known):
    figure, (gain, phase) = plt.subplots(2, 1)
    channel = known["link"].channel("Vdcref1", "Vdc1")
    assert channel.plot(ax=(gain, phase)) == (gain, phase) and gain.lines and phase.lines
    assert channel.plot("poles", ax=gain) is gain
    plt.close(figure)


def test_values_show_themselves_in_notebooks(known):
    model = load_model("vsc-hvdc-link")
    shown = [known["link"], model, find_operating_point(model)]
    for value, word in zip(shown, ["-30", "KIVDC", "Vdcref1"], strict=True):
        assert "<table>" in value._repr_html_() and word in value._repr_html_()


def test_other_figures(known, tmp_path):
    from hvdc_ident.linearize.plot import shapes

    locus = root_locus(load_model("vsc-hvdc-link"), "KIVDC", np.linspace(250, 1500, 5)).plot()
    assert "rad/s" in locus.get_xlabel()
    drawn = shapes(known["link"].modes()[4])
    drawn.figure.savefig(tmp_path / "x.png")
    plt.close("all")
    with pytest.raises(UnknownNameError):
        known["link"].plot("pie")
