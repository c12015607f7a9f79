"""The stage `linearize` and the command `export`, through the command line."""

import json

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app

SMIB = """schema = 1
name = "smib"
[parameters]
H = {value = 3.148}
D = {value = 2.0}
Pmax = {value = 2.98094}
wb = {value = 376.99111843}
[inputs]
Pm = {value = 0.5}
[states]
delta = {derivative = "wb*(w - 1)", start = 0.1}
w = {derivative = "(Pm - Pe - D*(w - 1))/(2*H)", start = 1.0}
[signals]
Pe = "Pmax*sin(delta)"
[outputs]
Pe = "Pe"
"""


@pytest.fixture
def study(tmp_path):
    (tmp_path / "smib.toml").write_text(SMIB)
    path = tmp_path / "study.toml"
    path.write_text(
        'schema = 1\nname = "smib"\n[model]\nsource = "smib.toml"\n'
        '[parameters]\nH = {start = 3.148, min = 1, max = 10}\n[linearize]\ninputs = ["Pm"]\noutputs = ["Pe"]\n'
    )
    return path


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def test_linearization_json_keeps_its_contract(study, tmp_path):
    result = run("linearize", study, "--out", tmp_path / "r", "--quiet")
    assert result.exit_code == 0, result.output
    data = json.loads((tmp_path / "r/linearization.json").read_text())
    for key in ("schema", "study", "model", "software", "seed", "A", "B", "C", "D", "method", "jacobian_error"):
        assert key in data, key
    assert {"states", "inputs", "outputs", "residual", "active_limits"} <= set(data["operating_point"])
    assert data["state_names"] == ["delta", "w"] and data["input_names"] == ["Pm"] and data["output_names"] == ["Pe"]
    assert data["method"] == "symbolic" and data["jacobian_error"] < 1e-14
    for mode in data["modes"]:
        assert {"eigenvalue", "frequency_hz", "damping", "participation"} <= set(mode)
    k = np.sqrt(2.98094**2 - 0.25)
    want = np.sort_complex(np.roots([1, 2 / 6.296, 376.99111843 * k / 6.296]))
    got = np.sort_complex([complex(*m["eigenvalue"]) for m in data["modes"]])
    np.testing.assert_allclose(got, want, atol=1e-10)
    (f,) = data["transfer_functions"]
    assert {"input", "output", "zeros", "poles", "gain"} <= set(f)
    assert set(data["modes"][0]["sensitivity"]) == {"H"}
    assert "null" not in json.dumps(data)


def test_at_start_uses_the_given_start(study, tmp_path):
    study.write_text(study.read_text() + 'at = "start"\n')
    assert run("linearize", study, "--out", tmp_path / "r", "--quiet").exit_code == 0
    point = json.loads((tmp_path / "r/linearization.json").read_text())["operating_point"]
    assert point["states"] == {"delta": 0.1, "w": 1.0} and point["at"] == "start"


@pytest.mark.parametrize("ending", ["mat", "json", "m", "mo", "csv", "toml"])
def test_export_by_ending(study, tmp_path, ending):
    path = tmp_path / f"out.{ending}"
    result = run("export", study, "--to", path)
    assert result.exit_code == 0, result.output
    assert path.stat().st_size > 50


def test_the_exported_card_is_the_model(study, tmp_path):
    from hvdc_ident import load_model

    run("export", study, "--to", tmp_path / "out.toml")
    assert load_model(tmp_path / "out.toml").states == load_model(tmp_path / "smib.toml").states


@pytest.mark.parametrize("to", ["out.xyz", "out", "out.docx"])
def test_an_unknown_ending_is_bad_input(study, tmp_path, to):
    result = run("export", study, "--to", tmp_path / to)
    assert result.exit_code == 2 and "expected one of" in result.output
    assert not (tmp_path / to).exists()


def test_a_model_without_rest_is_bad_input(study, tmp_path):
    (tmp_path / "smib.toml").write_text(SMIB.replace("value = 0.5", "value = 5.0"))
    result = run("linearize", study, "--out", tmp_path / "r")
    assert result.exit_code == 2 and "d(w)/dt" in result.output and "Traceback" not in result.output


# --- what [linearize] asks for beside the linear model ---

SERVO = """schema = 1
name = "servo"
[parameters]
K = {value = 25.0}
gain = {value = 1.0}
[inputs]
r = {value = 1.0}
d = {value = 0.0}
[states]
x1 = {derivative = "x2"}
x2 = {derivative = "x3"}
x3 = {derivative = "u + d - 10*x1 - 10*x2 - 10*x3"}
[signals]
e = "r - y"
u = "gain*e"
y = "K*x1"
[outputs]
y = "y"
e = "e"
"""


@pytest.fixture
def servo(tmp_path):
    """25/(s^3 + 10 s^2 + 10 s + 10) with unit feedback: the example of Seiler, Packard and Gahinet."""
    (tmp_path / "servo.toml").write_text(SERVO)
    (tmp_path / "other.toml").write_text(SERVO.replace("value = 25.0", "value = 20.0").replace('"servo"', '"other"'))
    path = tmp_path / "study.toml"
    path.write_text(
        'schema = 1\nname = "servo"\n[model]\nsource = "servo.toml"\n[linearize]\ninputs = ["r"]\noutputs = ["y"]\n'
    )
    return path


def linearization(study, tmp_path, text):
    study.write_text(study.read_text() + text)
    result = run("linearize", study, "--out", tmp_path / "r")
    assert result.exit_code == 0, result.output
    return json.loads((tmp_path / "r/linearization.json").read_text()), result.output


def test_every_key_of_linearize_is_answered(servo, tmp_path):
    data, shown = linearization(
        servo,
        tmp_path,
        'break_at = "u"\nplant = {inputs = "u", outputs = "y"}\nreduce = {order = 2, match_dc = true}\n'
        'compare = "other.toml"\nscale = {y = 2.0}\nformula = ["K"]\nlocus = {parameter = "K", min = 10, max = 200, points = 20}\n'
        'trim = {outputs = {y = 0.5}, free = ["r"]}\n'
        '[[linearize.port]]\nname = "shaft"\nsource = "d"\nvoltage = "y"\ncurrent = "d"\nband = [0.01, 1]\n',
    )
    margins = data["margins"]["loops"]["u"]
    assert margins["disk_margin"]["gain"] == pytest.approx(1.5942, abs=5e-5)  # published
    assert margins["gain_margin"]["value"] == pytest.approx(3.6, rel=1e-9)  # 10 x 10 - 10 over 25
    (limit,) = data["locus"]["limits"]  # Routh: 10 x 10 = 10 + K, at sqrt(10) rad/s
    assert limit["value"] == pytest.approx(90, rel=1e-9) and limit["direction"] == "lost"
    assert limit["eigenvalue"][1] == pytest.approx(np.sqrt(10), rel=1e-6)
    ncf = data["margins"]["ncf_margin"]
    w = np.logspace(-3, 3, 20001) * 1j
    p = 25 / (w**3 + 10 * w**2 + 10 * w + 10)
    assert ncf["value"] == pytest.approx((np.abs(1 + p) / np.sqrt(2 * (1 + np.abs(p) ** 2))).min(), rel=1e-5)
    assert ncf["value"] <= ncf["attainable"]
    closed, other = p / (1 + p) / 2, 0.8 * p / (1 + 0.8 * p) / 2
    chordal = np.abs(closed - other) / np.sqrt((1 + np.abs(closed) ** 2) * (1 + np.abs(other) ** 2))
    assert data["comparison"]["nu_gap"] == pytest.approx(chordal.max(), rel=1e-5)
    assert data["norms"]["whole"]["hinf"]["value"] == pytest.approx(np.abs(closed).max(), rel=1e-5)
    assert data["reduced"]["order"] == 2 and data["reduced"]["error"]["value"] <= data["reduced"]["bound"] * (1 + 1e-9)
    assert data["trim"]["found"]["r"] == pytest.approx(0.5 * (10 + 25) / 25)
    assert data["operating_point"]["outputs"]["y"] == pytest.approx(0.5)
    assert "K" in data["formulas"][0]["numerator"]
    rows = (tmp_path / "r/impedance.shaft.csv").read_text().splitlines()
    f, re, im = (float(v) for v in rows[1].split(","))
    assert complex(re, im) == pytest.approx(25 / ((1j * f) ** 3 + 10 * (1j * f) ** 2 + 10j * f + 35))
    for words in (
        "loop at u",
        "coprime factor margin",
        "nu-gap",
        "reduced from 3 to 2",
        "port shaft",
        "stability is lost at 90",
        "trimmed to y = 0.5",
    ):
        assert words in shown
    page = run("report", servo, "--out", tmp_path / "r")
    assert page.exit_code == 0, page.output
    text = (tmp_path / "r/report.html").read_text()
    assert "Margins" in text and "nu-gap" in text and "Impedance at ports" in text and "Reduced from 3" in text


def test_the_reduced_model_is_exported_in_the_units_of_the_whole(servo, tmp_path):
    from hvdc_ident.linearize import LinearModel

    servo.write_text(servo.read_text() + "scale = {y = 2.0}\nreduce = {order = 2, match_dc = true}\n")
    for name, more in (("whole.json", ()), ("small.json", ("--reduced",))):
        result = run("export", servo, "--to", tmp_path / name, *more)
        assert result.exit_code == 0, result.output
    whole, small = (
        LinearModel.from_dict(json.loads((tmp_path / name).read_text())) for name in ("whole.json", "small.json")
    )
    assert small.A.shape == (2, 2)
    np.testing.assert_allclose(small.response([0.0]), whole.response([0.0]), rtol=1e-9)
    servo.write_text(servo.read_text().replace("reduce = {order = 2, match_dc = true}\n", ""))
    refused = run("export", servo, "--to", tmp_path / "s.json", "--reduced")
    assert refused.exit_code == 2 and "asks for no reduced model" in refused.output


@pytest.mark.parametrize(
    ("line", "words"),
    [
        ('break_at = "nothing"', "break_at"),
        ('break_at = "r"', "break_at"),
        ('plant = {inputs = "u", outputs = "nothing"}', "plant"),
        ("reduce = {order = 2, tolerance = 0.1}", "either order"),
        ("reduce = {order = 9}", "out of range"),
        ('compare = "nowhere.toml"', "nowhere.toml"),
        ("scale = {x1 = 2.0}", "scale"),
        ('locus = {parameter = "x1", min = 1, max = 2}', "locus"),
        ('formula = ["r"]', "formula"),
        ("trim = {outputs = {y = 0.5}}", "free="),
        ("trim = {outputs = {x1 = 0.5}}", "trim.outputs"),
        ('port = [{name = "p", source = ["d"], voltage = ["y", "e"], current = ["d"]}]', "as many signals"),
        ('port = [{name = "p", source = ["d"], voltage = ["nothing"], current = ["d"]}]', "voltage"),
    ],
)
def test_what_linearize_cannot_do_is_said(servo, tmp_path, line, words):
    servo.write_text(servo.read_text() + line + "\n")
    result = run("linearize", servo, "--out", tmp_path / "r")
    assert result.exit_code in (1, 2) and words in result.output and "Traceback" not in result.output


def test_an_unstable_loop_has_no_margins(servo, tmp_path):
    card = tmp_path / "servo.toml"
    card.write_text(card.read_text().replace("gain = {value = 1.0}", "gain = {value = 4.0}"))
    data, shown = linearization(servo, tmp_path, 'break_at = "u"\nplant = {inputs = "u", outputs = "y"}\n')
    assert not data["margins"]["stable"] and data["margins"]["ncf_margin"]["value"] == 0.0
    assert "not stable: they have no margins" in shown and data["norms"]["whole"]["hinf"] is None


def test_screen_ranks_the_candidates(tmp_path):
    """y = a u + 0.01 b: only a matters."""
    pytest.importorskip("SALib")
    (tmp_path / "m.toml").write_text(
        'schema = 1\nname = "m"\n[parameters]\na = {value = 1.0}\nb = {value = 1.0}\n[inputs]\nu = {value = 0.0}\n'
        '[states]\nx = {derivative = "a*u + 0.01*b - x"}\n[outputs]\ny = "x"\n'
    )
    t = np.linspace(0, 5, 51)
    rows = "\n".join(
        f"{a},{b},{c}" for a, b, c in zip(t, np.where(t < 1, 0.0, 1.0), 1.5 - 1.5 * np.exp(-t), strict=True)
    )
    (tmp_path / "d.csv").write_text("time,u,y\n" + rows + "\n")
    path = tmp_path / "study.toml"
    path.write_text(
        'schema = 1\nname = "s"\n[model]\nsource = "m.toml"\n[parameters]\na = {min = 0.5, max = 2.5}\n'
        'b = {min = 0.5, max = 2.5}\n[[experiment]]\nname = "step"\ndata = "d.csv"\ninputs = ["u"]\noutputs = ["y"]\n'
        "noise = {y = 0.01}\n[screening]\ntrajectories = 6\n"
    )
    result = run("screen", path, "--out", tmp_path / "r")
    assert result.exit_code == 0, result.output
    measures = json.loads((tmp_path / "r/screening.json").read_text())["measures"]["y"]["step"]
    assert measures["a"]["mu_star"] > 20 * measures["b"]["mu_star"]
    path.write_text(path.read_text().replace("b = {min = 0.5, max = 2.5}", "b = {start = 1.0}"))
    refused = run("screen", path, "--out", tmp_path / "q")
    assert refused.exit_code == 2 and "no range" in refused.output


# --- verdicts on stability, and margins below 1 ---

LATE = """schema = 1
name = "late-damping"
[parameters]
T = {value = 2.2, unit = "s"}
[inputs]
r = {value = 0.0}
[states]
x = {derivative = "v"}
v = {derivative = "49*(e - x) - 0.14*v"}
[signals]
e = "r - 0.02*late"
[delays]
late = {of = "v", time = "T"}
[outputs]
x = "x"
"""

LEAN = """schema = 1
name = "leaning"
[inputs]
r = {value = 0.0}
[states]
x = {derivative = "1.5*x + 6*e"}
[signals]
e = "r - x"
[outputs]
x = "x"
"""


def answered(tmp_path, card, more=""):
    (tmp_path / "plant.toml").write_text(card)
    study = tmp_path / "study.toml"
    study.write_text(
        'schema = 1\nname = "s"\n[model]\nsource = "plant.toml"\n[linearize]\ninputs = ["r"]\noutputs = ["x"]\n'
        f'break_at = ["e"]\n{more}'
    )
    result = run("linearize", study, "--out", tmp_path / "r")
    assert result.exit_code == 0 and run("report", tmp_path / "r").exit_code == 0, result.output
    data = json.loads((tmp_path / "r/linearization.json").read_text())
    return data, result.output, (tmp_path / "r/report.html").read_text()


def test_a_late_loop_is_unstable_on_the_screen_in_the_json_and_in_the_report(tmp_path):
    """Of s^2 + 0.14 s + 49 + 0.98 s exp(-2.2 s) two roots grow; with a Pade approximant of order 5 all decay."""
    s = 7j
    for _ in range(60):
        z = 0.98 * np.exp(-2.2 * s)
        s -= (s * s + 0.14 * s + 49 + s * z) / (2 * s + 0.14 + z * (1 - 2.2 * s))
    data, shown, page = answered(tmp_path, LATE, 'locus = {parameter = "T", min = 0.1, max = 2.2, points = 4}\n')
    assert s.real > 0.1 and np.linalg.eigvals(np.array(data["A"])).real.max() < -0.1
    found = data["stability"]
    assert data["stable"] is False and found["verdict"] == "unstable" and found["unstable_roots"] == 2
    assert found["rightmost"] == pytest.approx([s.real, s.imag], rel=1e-9)
    assert data["modes"][0]["eigenvalue"] == found["rightmost"] and set(data["modes"][0]["participation"]) == {
        "x",
        "v",
        "late",
    }
    assert data["margins"]["stable"] is False and data["margins"]["loops"]["e"]["phase_margin_deg"]["value"] is None
    assert data["locus"]["unstable_roots"][-1] == 2 and data["norms"]["whole"]["hinf"] is None
    roots = "2 roots right of the imaginary axis"
    assert f"operating point: unstable, rightmost eigenvalue {s.real:.4g} 1/s ({roots}, delays exact)" in shown
    assert f"the closed loops are not stable: they have no margins ({roots})" in shown
    assert "phase margin" not in shown
    assert "operating point <strong>unstable" in page and f"({roots}, delays exact)" in page
    assert f"The closed loops are not stable: they have no margins ({roots})" in page
    assert "mathdefault" not in page  # ticks of the locus are plain numbers


def test_a_lower_gain_margin_is_shown(tmp_path):
    """6/(s - 1.5): closed at 1.5 - 6 k, so that the gain must not fall to a quarter; |L| = 1 at sqrt(36 - 2.25) rad/s."""
    data, shown, page = answered(tmp_path, LEAN)
    m = data["margins"]["loops"]["e"]
    assert m["lower_gain_margin"] == {"value": pytest.approx(0.25, rel=1e-12), "omega": 0.0}
    assert m["gain_margin"] == {"value": None, "omega": None}
    w = np.sqrt(36 - 2.25)
    assert m["phase_margin_deg"] == {"value": pytest.approx(np.degrees(np.arctan(w / 1.5))), "omega": pytest.approx(w)}
    assert (
        "loop at e: gain margin unlimited, lower gain margin 0.25 at 0 Hz, phase margin 75.52 degrees at 0.9246 Hz"
        in shown
    )
    assert "lower gain" in page and "unlimited" in page
