"""Every format of a linear model read back to the last bit, and the figures."""

import matplotlib.pyplot as plt
import numpy as np
import pytest
from helpers import linear

from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import InputError, UnknownNameError
from hvdc_ident.linearize import LinearModel, find_operating_point, linearize, root_locus
from hvdc_ident.linearize.export import formats, read, write
from hvdc_ident.linearize.export.sections import sections
from hvdc_ident.models import load_model

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


@pytest.mark.parametrize("ending", [".json", ".mat", ".m", ".mo"])
@pytest.mark.parametrize("which", ["link", "delayed", "odd"])
def test_state_spaces_come_back_to_the_last_bit(known, tmp_path, ending, which):
    model = known[which]
    back = read(write(model, tmp_path / f"x{ending}"))
    assert isinstance(back, LinearModel)
    for key in "ABCDE":
        np.testing.assert_array_equal(getattr(back, key), getattr(model, key))
    for key in (*NAMES, "x0", "u0", "y0", "name"):
        assert getattr(back, key) == getattr(model, key), key


def test_a_descriptor_comes_back_too(tmp_path):
    model = linearize(load_model("vsc-hvdc-link"), descriptor=True)
    for ending in (".json", ".mat", ".m"):
        np.testing.assert_array_equal(read(write(model, tmp_path / f"d{ending}")).E, model.E)


def test_frequency_response_and_zeros_come_back(known, tmp_path):
    model = known["link"].channel(["Vdcref1", "Pref2"], ["Vdc1", "P2"])
    back, own = read(write(model, tmp_path / "x.csv")), model.bode()
    np.testing.assert_array_equal(back.values, own.values)
    np.testing.assert_array_equal(back.omega, own.omega)
    assert (back.output_names, back.input_names) == (own.output_names, own.input_names)
    for f in read(write(model, tmp_path / "x.zpk")):
        want = model.transfer_function(f.input, f.output)
        np.testing.assert_array_equal(f.poles, want.poles)
        np.testing.assert_array_equal(f.zeros, want.zeros)
        assert f.gain == want.gain


def test_sections_multiply_to_the_transfer_function(known):
    f = known["link"].transfer_function("Vdcref1", "Irorder1")
    s = 3.0 + 4j
    got = np.prod([np.polyval(r[:3], s) / np.polyval(r[3:], s) for r in sections(f)])
    assert got == pytest.approx(complex(f(s)), rel=1e-12)


def test_latex_has_an_equation_for_each_channel(known, tmp_path):
    text = write(known["link"].channel(["Vdcref1"], ["Vdc1", "P2"]), tmp_path / "x.tex").read_text()
    assert text.count(r"\begin{equation}") == 2 and "(s + 30.6125)" in text
    with pytest.raises(InputError, match="cannot be read back"):
        read(tmp_path / "x.tex")


def test_matlab_reads_the_script_s_syntax(known, tmp_path):
    text = write(known["odd"], tmp_path / "x.m").read_text()
    assert "ss(A, B, C, D" in text and "\t" not in text


@pytest.mark.parametrize("ending", [".json", ".mat", ".m", ".mo", ".csv", ".zpk"])
def test_files_that_are_none_are_refused(tmp_path, ending):
    path = tmp_path / f"x{ending}"
    for content in (b"", b"\x00\x01\x02", b"{}", b"model x end x;", b"a,b\n1,2\n"):
        path.write_bytes(content)
        with pytest.raises(InputError):
            read(path)
    with pytest.raises(InputError, match="ending"):
        write(linear([[-1.0]], [[1.0]], [[1.0]]), tmp_path / "x.xyz")
    assert ending in formats()


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
