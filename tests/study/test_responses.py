"""Measured frequency responses in a study: check, linearize, identify, fit and report, against circuits by hand."""

import json
import pickle

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.effects import apply_effects
from hvdc_ident.fit.frequency_data import WithResponses, frequency_experiment
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import MeasuredResponse, Port
from hvdc_ident.models import load_model
from hvdc_ident.simulate import ModelSimulator

MOTOR = """schema = 1
name = "motor"
[parameters]
J = {value = 0.01, min = 0.001, max = 0.1}
b = {value = 0.1, min = 0.001, max = 1.0}
[inputs]
v = {value = 0.0}
[states]
w = {derivative = "(i/2 - b*w)/J"}
[signals]
i = "v - w/2"
[outputs]
w = "w"
i = "i"
"""
COIL = """schema = 1
name = "coil"
[parameters]
r = {value = 0.2, min = 0.01, max = 1.0}
x = {value = 0.3, min = 0.05, max = 2.0}
w0 = {value = 314.159265358979}
[inputs]
E = {value = 1.0}
[states]
d = {derivative = "w0/x*(ed - r*d + x*q)"}
q = {derivative = "w0/x*(eq - r*q - x*d)"}
[signals]
ed = "E*cos(0.3)"
eq = "-E*sin(0.3)"
[outputs]
d = "d"
"""


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def csv(path, f, channels):
    header = ",".join(["f", *(f"{n}_{p}" for n in channels for p in ("re", "im"))])
    columns = np.column_stack([f, *(p for v in channels.values() for p in (v.real, v.imag))])
    path.write_text(header + "\n" + "\n".join(",".join(map(repr, row)) for row in columns.tolist()) + "\n")


def noisy(values, share, seed=0):
    rng = np.random.default_rng(seed)
    draw = rng.normal(size=values.shape) + 1j * rng.normal(size=values.shape)
    return values * (1 + share * draw / np.sqrt(2))


F = np.geomspace(0.05, 50, 40)
TRUE = {"J": 0.013, "b": 0.08}


def motor_response():
    return 0.5 / (TRUE["J"] * 2j * np.pi * F + TRUE["b"] + 0.25)


@pytest.fixture
def motor(tmp_path):
    (tmp_path / "motor.toml").write_text(MOTOR)
    csv(tmp_path / "g.csv", F, {"G": noisy(motor_response(), 0.01)})
    path = tmp_path / "study.toml"
    path.write_text(
        'schema = 1\nname = "motor"\n[model]\nsource = "motor.toml"\n[parameters]\nJ = {start = 0.01, min = 0.001, max = 0.1}\n'
        "b = {start = 0.1, min = 0.01, max = 1.0}\n[fit]\nstarts = 2\n"
        '[[response]]\nname = "sweep"\ndata = "g.csv"\ninput = "v"\noutput = "w"\n'
    )
    return path


def step(folder, noise=0.01):
    rng = np.random.default_rng(5)
    t = np.arange(0, 1, 0.005)
    rate = (TRUE["b"] + 0.25) / TRUE["J"]
    y = np.where(t < 0.1, 0.0, 0.5 / (TRUE["b"] + 0.25) * (1 - np.exp(-rate * np.clip(t - 0.1, 0, None))))
    cells = zip(
        t.tolist(), (t >= 0.1).astype(float).tolist(), (y + noise * rng.normal(size=t.size)).tolist(), strict=True
    )
    (folder / "s.csv").write_text("time,v,w\n" + "\n".join(",".join(map(repr, c)) for c in cells) + "\n")
    return f'[[experiment]]\nname = "step"\ndata = "s.csv"\ninputs = ["v"]\noutputs = ["w"]\nevent = 0.1\nnoise = {{w = {noise}}}\n'


def fitted(study, tmp_path, command="fit"):
    result = run(command, study, "--out", tmp_path / "r", "--quiet")
    assert result.exit_code == 0, result.output
    return json.loads((tmp_path / "r/fit.json").read_text())


def holds(fit):
    for name, true in TRUE.items():
        low, high = fit["estimates"][name]["ci95"]
        assert low <= true <= high, name
    return fit


def test_a_response_alone_calibrates(motor, tmp_path):
    motor.write_text(motor.read_text() + "relative_noise = 0.01\n")
    assert "40 frequencies, 0.05 to 50 Hz; noise 1 % (given)" in run("check", motor).output
    fit = holds(fitted(motor, tmp_path))
    # Cramer and Rao by hand: G = 0.5/(J s + b + 1/4), every point with 1 % of its modulus.
    s = 2j * np.pi * F
    slope = np.column_stack([-s, -np.ones(s.size)]) / (TRUE["J"] * s + TRUE["b"] + 0.25)[:, None]  # of ln G
    information = 2 / 0.01**2 * (slope.conj().T @ slope).real
    bound = np.sqrt(np.diag(np.linalg.inv(information)))
    assert [fit["estimates"][n]["std_raw"] for n in TRUE] == pytest.approx(bound, rel=0.03)
    (r,) = fit["responses"]
    assert r["models"]["fitted"]["errors"][0]["chi2_per_point"] == pytest.approx(1.0, abs=0.35)
    assert r["models"]["given"]["errors"][0]["relative"] > 0.05


def test_noise_that_is_not_stated_is_the_misfit(motor, tmp_path):
    fit = holds(fitted(motor, tmp_path))
    assert all(s.startswith("misfit") for s in fit["noise_source"].values())
    assert "noise not given" in run("check", motor).output


@pytest.mark.parametrize(
    "line", ['whiten = "residual"', 'whiten = "pre-event"', 'residual = "frequency"', "guard = 0.02", 'loss = "huber"']
)
def test_beside_waveforms_with_every_treatment_of_these(motor, tmp_path, line):
    text = motor.read_text().replace("starts = 2", f"starts = 2\n{line}") + "relative_noise = 0.01\n" + step(tmp_path)
    motor.write_text(text)
    fit = fitted(motor, tmp_path)
    assert set(fit["rmse"]) == {"w", "sweep: re w from v", "sweep: im w from v"}
    for name, true in TRUE.items():
        assert fit["estimates"][name]["value"] == pytest.approx(true, rel=0.01)


def test_the_whole_run_and_its_report(motor, tmp_path):
    csv(tmp_path / "h.csv", F, {"w from v": noisy(motor_response(), 0.01, 7)})
    held_out = (
        '[[response]]\nname = "again"\ndata = "h.csv"\ninput = "v"\noutput = "w"\nrole = "holdout"\nrelative_noise = 0.01\n'
        'band = [0.1, 20]\nunit = "rad/s per V"\n'
    )
    motor.write_text(motor.read_text() + "relative_noise = 0.01\n" + held_out + step(tmp_path))
    result = run("run", motor, "--out", tmp_path / "r")
    assert result.exit_code == 0, result.output
    fit = holds(json.loads((tmp_path / "r/fit.json").read_text()))
    assert fit["validation"]["again"]["status"] == "done"
    shares = json.loads((tmp_path / "r/identifiability.json").read_text())["experiments"]
    assert set(shares) >= {"sweep", "step"} and "again" not in shares
    linear = json.loads((tmp_path / "r/linearization.json").read_text())
    assert [r["name"] for r in linear["responses"]] == ["sweep", "again"]
    page = (tmp_path / "r/report.html").read_text()
    assert "Measured frequency responses" in page and "rad/s per V, held out" in page


def test_groups_take_responses_by_name(motor, tmp_path):
    text = motor.read_text().replace(
        "starts = 2",
        'starts = 2\nmode = "individual"\ngroups = [{parameters = ["J"], experiments = ["sweep"]}, '
        '{parameters = ["b"], experiments = ["step"]}]',
    )
    motor.write_text(text + "relative_noise = 0.01\n" + step(tmp_path))
    fit = fitted(motor, tmp_path)
    assert fit["estimates"]["b"]["value"] == pytest.approx(TRUE["b"], rel=0.1)


def coil(f, r, x):
    s = 2j * np.pi * f / 314.159265358979
    return {"Zdd": r + x * s, "Zdq": -x + 0 * s, "Zqd": x + 0 * s, "Zqq": r + x * s}


@pytest.mark.parametrize("kind", ["impedance", "admittance"])
def test_a_port_s_impedance_calibrates_the_coil(tmp_path, kind):
    (tmp_path / "coil.toml").write_text(COIL)
    f = np.geomspace(1, 1000, 15)
    z = coil(f, 0.1, 0.5)
    if kind == "admittance":
        inverse = np.linalg.inv(np.array([[z["Zdd"], z["Zdq"]], [z["Zqd"], z["Zqq"]]]).transpose(2, 0, 1))
        z = {f"Y{a}{b}": inverse[:, i, j] for i, a in enumerate("dq") for j, b in enumerate("dq")}
    csv(tmp_path / "z.csv", f, {n: noisy(v, 0.005, k) for k, (n, v) in enumerate(z.items())})
    study = tmp_path / "study.toml"
    study.write_text(
        'schema = 1\nname = "coil"\n[model]\nsource = "coil.toml"\n[parameters]\nr = {start = 0.2}\nx = {start = 0.3}\n[fit]\n'
        'starts = 2\n[linearize]\noutputs = ["d"]\n[[linearize.port]]\nname = "grid"\nsource = ["ed", "eq"]\n'
        'voltage = ["ed", "eq"]\ncurrent = ["d", "q"]\nangle = "0.3"\n'
        f'[[response]]\nname = "scan"\ndata = "z.csv"\nport = "grid"\nkind = "{kind}"\nrelative_noise = 0.005\n'
    )
    fit = fitted(study, tmp_path)
    for name, true in (("r", 0.1), ("x", 0.5)):
        low, high = fit["estimates"][name]["ci95"]
        assert low <= true <= high
    if kind == "admittance":
        study.write_text(study.read_text().replace('kind = "admittance"\n', ""))
        refused = run("check", study)
        assert refused.exit_code == 2 and "no impedance" in refused.output and "admittance" in refused.output


PENDULUM = """schema = 1
name = "machine"
[parameters]
H = {value = 3.0}
K = {value = 2.0}
T = {value = 0.02}
[inputs]
P = {value = 0.8}
[states]
delta = {derivative = "300*w", start = 0.3}
w = {derivative = "(P - Pe - 2*w)/(2*H)"}
[signals]
Pe = "K*sin(delta)"
[outputs]
Pe = "Pe"
delta = "delta"
"""


@pytest.mark.parametrize("kind", ["at rest", "delayed", "trimmed", "port"])
def test_derivatives_are_those_of_differences(tmp_path, kind):
    """The operating point moves with the parameters, and its shift is part of the derivative."""
    (tmp_path / "m.toml").write_text(PENDULUM)
    model = load_model(tmp_path / "m.toml")
    names = ["H", "K"]
    if kind == "delayed":
        model = apply_effects(model, [{"effect": "delay", "at": "Pe", "parameters": {"T": 0.02}}])
        names += [n for n in model.parameters if n not in ("H", "K", "T")]
    w = np.array([1.0, 8.0, 30.0])
    port = Port(("Pe",), ("w",), ("Pe",)) if kind == "port" else None
    channels = (("dc", "dc"),) if port else (("Pe", "P"), ("delta", "P"))
    r = MeasuredResponse(
        "r", "impedance" if port else "transfer", channels, w, np.zeros((3, len(channels)), complex), port=port,
        trim=FrozenMap({"delta": 0.5} if kind == "trimmed" else {}), free=("P",) if kind == "trimmed" else (),
    )  # fmt: skip
    at = {n: model.parameters[n].value for n in names}
    _, slopes = r.of_model(model, at, names)
    for k, name in enumerate(names):
        h = 1e-4 * at[name]
        up, down = (r.of_model(model, {**at, name: at[name] + d})[0] for d in (h, -h))
        np.testing.assert_allclose(slopes[..., k], (up - down) / (2 * h), rtol=2e-6, atol=1e-7)


def test_a_simulator_with_responses_travels_to_another_process(tmp_path):
    (tmp_path / "motor.toml").write_text(MOTOR)
    r = MeasuredResponse("r", "transfer", (("w", "v"),), 2 * np.pi * F, motor_response()[:, None])
    e = frequency_experiment(r)
    simulator = WithResponses(ModelSimulator(load_model(tmp_path / "motor.toml")), FrozenMap({"r": r}))
    there = pickle.loads(pickle.dumps(simulator))
    run_ = there.simulate(pickle.loads(pickle.dumps(e)), TRUE, ["J"])
    want = np.column_stack([motor_response().real, motor_response().imag])
    np.testing.assert_allclose(run_.trajectory.values, want, rtol=1e-12)
    np.testing.assert_allclose(e.measured.values, want)


def test_touchstone_and_records_in_time(motor, tmp_path):
    """The motor's admittance i/v by Touchstone, and its response from a record of a multisine."""
    z = 1 / ((TRUE["J"] * 2j * np.pi * F + TRUE["b"]) * motor_response() * 2)
    text = "# Hz Z RI R 1\n" + "\n".join(
        f"{a!r} {b.real!r} {b.imag!r}" for a, b in zip(F.tolist(), z.tolist(), strict=True)
    )
    (tmp_path / "z.s1p").write_text(text + "\n")
    t = np.arange(0, 4, 2e-3)
    tones = np.array([0.5, 2.0, 8.0])
    g = 0.5 / (TRUE["J"] * 2j * np.pi * tones + TRUE["b"] + 0.25)
    u = sum(np.sin(2 * np.pi * k * t) for k in tones)
    y = sum(abs(v) * np.sin(2 * np.pi * k * t + np.angle(v)) for k, v in zip(tones, g, strict=True))
    y = y + 1e-3 * np.random.default_rng(2).normal(size=t.size)
    rows = zip(t.tolist(), u.tolist(), y.tolist(), strict=True)
    (tmp_path / "tones.csv").write_text("time,u,y\n" + "\n".join(",".join(map(repr, c)) for c in rows) + "\n")
    text = motor.read_text()
    motor.write_text(
        text[: text.index("[[response]]")]
        + '[linearize]\n[[linearize.port]]\nname = "terminal"\nsource = "v"\nvoltage = "v"\ncurrent = "i"\n'
        '[[response]]\nname = "touchstone"\ndata = "z.s1p"\nport = "terminal"\nrelative_noise = 0.01\n'
        '[[response]]\nname = "tones"\ndata = "tones.csv"\ninput = "v"\noutput = "w"\nfrequencies = [0.5, 2.0, 8.0]\n'
        'signals = {input = "u", output = "y"}\n'
    )
    fit = fitted(motor, tmp_path)
    for name, true in TRUE.items():
        assert fit["estimates"][name]["value"] == pytest.approx(true, rel=2e-3)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('input = "v"\n', "", "either input and output, or port"),
        ('input = "v"', 'input = "nothing"', "response 'sweep'.input"),
        ('output = "w"', 'output = "nothing"', "response 'sweep'.output"),
        ('output = "w"', 'output = "w"\nport = "p"', "either input and output, or port"),
        ('output = "w"', 'output = "w"\nband = [60, 70]', "no frequency lies in the band"),
        ('output = "w"', 'output = "w"\ncolumns = {value = "H"}', "no channel 'H'"),
        ('output = "w"', 'output = "w"\nvalues = {w = 1}', "values"),
        ('output = "w"', 'output = "w"\nnoise = 1\nrelative_noise = 1', "either noise"),
        ('data = "g.csv"', 'data = "none.csv"', "no such file"),
        ('input = "v"\noutput = "w"', 'port = "p"', "no port"),
    ],
)
def test_what_a_response_cannot_be_is_said(motor, old, new, words):
    motor.write_text(motor.read_text().replace(old, new))
    result = run("check", motor)
    assert result.exit_code == 2 and words in result.output and "Traceback" not in result.output


def test_a_sign_or_a_unit_is_named_and_a_gain_is_not(motor, tmp_path):
    text = motor.read_text()
    for scale, said in ((-1000.0, True), (1.2, False)):
        motor.write_text(text + f"relative_noise = 0.01\nscale = {scale}\n")
        result = run("linearize", motor, "--out", tmp_path / "r")
        assert result.exit_code == 0, result.output
        assert ("sign, unit or base?" in result.output) == said
        (r,) = json.loads((tmp_path / "r/linearization.json").read_text())["responses"]
        factor = r["models"]["given"]["errors"][0]["factor"]
        assert factor is None if not said else factor == pytest.approx(scale, rel=0.2)


def test_a_model_without_states_has_a_response_too(tmp_path):
    (tmp_path / "m.toml").write_text(
        'schema = 1\nname = "m"\n[parameters]\na = {value = 1.0, min = 0.1, max = 10}\n[inputs]\nu = {value = 0.0}\n'
        '[states]\n[outputs]\ny = "a*u"\n'
    )
    csv(tmp_path / "g.csv", F, {"G": noisy(3.0 + 0j * F, 0.01)})
    study = tmp_path / "study.toml"
    study.write_text(
        'schema = 1\nname = "s"\n[model]\nsource = "m.toml"\n[parameters]\na = {start = 1}\n[fit]\nstarts = 2\n'
        '[[response]]\nname = "g"\ndata = "g.csv"\ninput = "u"\noutput = "y"\nrelative_noise = 0.01\n'
    )
    low, high = fitted(study, tmp_path)["estimates"]["a"]["ci95"]
    assert low <= 3.0 <= high


def test_phases_of_a_response_through_a_delay_count_their_turns(motor, tmp_path):
    """Measured at 6 frequencies with up to 20 turns between them: the dots lie on the model's curve, not some turns above it."""
    (tmp_path / "motor.toml").write_text(
        MOTOR.replace("[outputs]", '[delays]\nlate = {of = "w", time = "0.4"}\n[outputs]').replace(
            'w = "w"', 'w = "late"'
        )
    )
    f = np.geomspace(0.05, 50, 6)
    g = 0.5 / (0.01 * 2j * np.pi * f + 0.1 + 0.25) * np.exp(-0.8j * np.pi * f)
    csv(tmp_path / "g.csv", f, {"G": g})
    result = run("linearize", motor, "--out", tmp_path / "r")
    assert result.exit_code == 0, result.output
    (found,) = json.loads((tmp_path / "r/linearization.json").read_text())["responses"]
    want = -np.degrees(np.arctan(2 * np.pi * f * 0.01 / 0.35) + 0.8 * np.pi * f)
    for shown in (found["measured"], *found["models"].values()):
        np.testing.assert_allclose(np.array(shown["phase_deg"])[:, 0], want, atol=0.1)


def test_a_model_that_is_unstable_where_it_was_measured_says_so(motor, tmp_path):
    card = tmp_path / "motor.toml"
    card.write_text(card.read_text().replace("b = {value = 0.1, min = 0.001", "b = {value = -0.5, min = -1.0"))
    motor.write_text(motor.read_text().replace("b = {start = 0.1, min = 0.01", "b = {min = -1.0"))
    result = run("linearize", motor, "--out", tmp_path / "r")
    assert result.exit_code == 0 and "unstable where it was measured" in result.output
