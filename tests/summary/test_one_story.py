"""Every quantity has one value and every model one verdict, wherever a run of a study tells it.

Six small plants, whose recordings scipy makes, play the parts of plants whose results were told wrongly: one with a wrong gain beside
a missing delay, one whose missing lag may be at either of two places, one with a signal in MW that no profile has limits for, one
that lacks nothing, a turbine whose gate is late, and a machine of wrong damping. What was made by `new` and results as large as the
demo's are read too.
"""

from __future__ import annotations

import csv
import html
import json
import re
import tomllib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.signal import lsim
from typer.testing import CliRunner

from hvdc_ident.cli import app
from hvdc_ident.report.letter import write_letter
from hvdc_ident.report.page import write_report
from hvdc_ident.summary import Results, RunSummary, summarise
from hvdc_ident.summary.run_summary import ParameterSummary
from tests.report.demo_like import demo_like

TIME = np.arange(0.0, 3.0, 0.01)
STEP = np.where(TIME >= 0.5, 1.0, 0.0)
NOISE = 0.002
CARD = """schema = 1
name = "two-lags"
[parameters]
Ta = {value = 0.1, unit = "s", min = 0.01, max = 3}
Kb = {value = 1.0, unit = "pu", min = 0.1, max = 5}
[inputs]
u = {value = 0.0, unit = "pu"}
[states]
a = {derivative = "(u - a)/Ta", unit = "pu"}
b = {derivative = "(Kb*u - b)/0.3", unit = "pu"}
[outputs]
ya = {value = "a", unit = "pu"}
yb = {value = "b", unit = "UNIT"}
"""
STUDY = """schema = 1
name = "NAME"
[model]
source = "m.toml"
[parameters]
Ta = {min = 0.01, max = 3}
Kb = {min = 0.1, max = 5}
[[experiment]]
name = "step"
data = "step.csv"
inputs = ["u"]
outputs = ["ya", "yb"]
interpolation = "hold"
noise = {ya = 0.002, yb = 0.002}
[fit]
starts = 2
[diagnose]
effects = EFFECTS
"""


TW = 0.8
TURBINE = """schema = 1
name = "turbine"
[parameters]
Tg = {value = 0.2, unit = "s", min = 0.02, max = 2}
Tw = {value = 1.0, unit = "s", min = 0.1, max = 4}
[inputs]
u = {value = 0.0, unit = "pu"}
[states]
g = {derivative = "(u - g)/Tg", unit = "pu"}
x = {derivative = "2*(g - x)/Tw", unit = "pu"}
[outputs]
P = {value = "3*x - 2*g", unit = "pu"}
"""
MACHINE = """schema = 1
name = "machine"
[parameters]
H = {value = 3.5, unit = "s", min = 1, max = 10}
D = {value = 8.0, unit = "pu", min = 1, max = 50}
[inputs]
u = {value = 0.0, unit = "pu"}
[states]
d = {derivative = "314.159*w", unit = "rad", guess = 0.28}
w = {derivative = "(0.5 + 0.1*u - Pe - D*w)/(2*H)", unit = "pu"}
[signals]
Pe = "1.8*sin(d)"
[outputs]
Pe = {value = "Pe", unit = "pu"}
"""


def lagged(signal: np.ndarray, *constants: float) -> np.ndarray:
    """The signal behind lags in a row, by scipy; it is held between its rows."""
    for constant in constants:
        signal = lsim(([1.0], [constant, 1.0]), signal, TIME, interp=False)[1]
    return signal


def late(signal: np.ndarray, rows: int) -> np.ndarray:
    return np.concatenate([np.zeros(rows), signal[:-rows]])


PLANTS: dict[str, tuple[np.ndarray, np.ndarray, str, str]] = {
    "wrong-gain": (late(lagged(STEP, 0.1), 15), 1.5 * lagged(STEP, 0.3), "pu", '["delay"]'),
    "two-places": (lagged(STEP, 0.1, 0.3), 1.5 * lagged(STEP, 0.3), "pu", '["lag"]'),
    "mixed-units": (lagged(STEP, 0.1), 1.5 * lagged(STEP, 0.3), "MW", '["gain"]'),
    "right": (lagged(STEP, 0.1), lagged(STEP, 0.3), "pu", '["gain", "lag"]'),
}
"""By name: what is recorded of both outputs without noise, the unit of the second, and the effects that are tried."""


@dataclass(frozen=True)
class Told:
    """A folder of results with all that is told of it: the screen of its run, empty where it was not run here, and its pages."""

    folder: Path
    screen: str
    report: str
    letter: str
    summary: RunSummary

    @property
    def texts(self) -> Mapping[str, str]:
        """Each text by its name."""
        return {
            "screen": self.screen,
            "report": self.report,
            "letter": self.letter,
            "notebook": _words(self.summary._repr_html_()),
            "python": str(self.summary),
        }


def _words(page: str) -> str:
    """The text of a page, a line for each row of a table and each paragraph, its cells between bars; numbers as on a terminal."""
    page = re.sub(r"<(svg|script|style).*?</\1>", "", page, flags=re.DOTALL)
    page = re.sub(r"·10<sup>(.*?)</sup>", r"e\1", page)
    page = re.sub(r"</t[dh]>", "|", re.sub(r"</(tr|p|li|h\d|section|summary)>|<br>", "\n", page))
    return html.unescape(re.sub(r"<[^>]+>", "", page)).replace("−", "-")


def call(*arguments: object) -> str:
    done = CliRunner().invoke(app, [str(a) for a in arguments])
    assert done.exit_code in (0, 1), done.output
    return done.output


def told(folder: Path, screen: str) -> Told:
    report, letter = write_report(folder), write_letter(folder)
    return Told(
        folder, screen, _words(report.read_text("utf-8")), _words(letter.read_text("utf-8")), Results(folder).summary
    )


def of_plant(folder: Path, name: str) -> Told:
    ya, yb, unit, effects = PLANTS[name]
    study = STUDY.replace("NAME", name).replace("EFFECTS", effects)
    return made(folder, CARD.replace("UNIT", unit), study, {"ya": ya, "yb": yb})


def made(folder: Path, card: str, study: str, outputs: Mapping[str, np.ndarray]) -> Told:
    """Run a study of a step of u, of which each output is recorded with noise."""
    random = np.random.default_rng(5)
    noisy = [y + NOISE * random.standard_normal(TIME.size) for y in outputs.values()]
    header = ",".join(["time", "u", *outputs])
    np.savetxt(folder / "step.csv", np.column_stack([TIME, STEP, *noisy]), delimiter=",", header=header, comments="")
    (folder / "m.toml").write_text(card, "utf-8")
    (folder / "study.toml").write_text(study, "utf-8")
    return told(folder / "study-results", call("run", folder / "study.toml"))


def of_turbine(folder: Path) -> Told:
    """A gate and its penstock: the plant's gate is late too, and a fit without that finds another time of the water."""
    gate = late(lagged(STEP, 0.2), 10)
    power = lsim(([-TW, 1.0], [0.5 * TW, 1.0]), gate, TIME)[1]
    study = _study("turbine", "Tg = {min = 0.02, max = 2}\nTw = {min = 0.1, max = 4}", ["P"], '["delay"]')
    return made(folder, TURBINE, study, {"P": power})


def of_machine(folder: Path) -> Told:
    """A machine at an infinite bus whose damping is given wrongly, and that lacks nothing."""

    def swing(t: float, x: np.ndarray) -> list[float]:
        power = 0.5 + 0.1 * (t >= 0.5)
        return [314.159 * x[1], (power - 1.8 * np.sin(x[0]) - 12.0 * x[1]) / (2 * 3.5)]

    rest = [np.arcsin(0.5 / 1.8), 0.0]
    run = solve_ivp(swing, (0.0, TIME[-1]), rest, t_eval=TIME, rtol=1e-9, atol=1e-12, max_step=0.01)
    study = _study("machine", "H = {min = 1, max = 10}\nD = {min = 1, max = 50}", ["Pe"], '["lag"]')
    return made(folder, MACHINE, study, {"Pe": 1.8 * np.sin(run.y[0])})


def _study(name: str, parameters: str, outputs: list[str], effects: str) -> str:
    """The study of another model and these outputs."""
    text = STUDY.replace("NAME", name).replace("EFFECTS", effects)
    text = text.replace("Ta = {min = 0.01, max = 3}\nKb = {min = 0.1, max = 5}", parameters)
    noise = ", ".join(f"{o} = {NOISE}" for o in outputs)
    return text.replace('["ya", "yb"]', json.dumps(outputs)).replace("{ya = 0.002, yb = 0.002}", f"{{{noise}}}")


def of_new(folder: Path) -> Told:
    call("new", folder / "own")
    text = (folder / "own" / "study.toml").read_text("utf-8")
    (folder / "own" / "study.toml").write_text(
        text + '\n[diagnose]\neffects = ["lag"]\n' * ("[diagnose]" not in text), "utf-8"
    )
    return told(folder / "own" / "study-results", call("run", folder / "own" / "study.toml"))


MAKERS: dict[str, Callable[[Path], Told]] = {
    **{name: lambda folder, name=name: of_plant(folder, name) for name in PLANTS},  # type: ignore[misc]
    "turbine": of_turbine,
    "machine": of_machine,
    "new": of_new,
    "demo-like": lambda folder: told(demo_like(folder / "demo"), ""),
}


@pytest.fixture(scope="module")
def study_of(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Told]:
    """What is told of a study by its name, each run once."""
    return cache(lambda name: MAKERS[name](tmp_path_factory.mktemp(name)))


@pytest.fixture(params=MAKERS)
def study(request: pytest.FixtureRequest, study_of: Callable[[str], Told]) -> Told:
    return study_of(request.param)


NUMBER = r"-?\d[\d,]*(?:\.\d+)?(?:e[-+]?\d+)?"
SMALLER = {"ms": 1e-3, "µs": 1e-6}


def shows(shown: str, unit: str, value: float | None) -> bool:
    """Whether text is that number, rounded to the digits that it has."""
    if value is None:
        return False
    mantissa, _, exponent = shown.replace(",", "").partition("e")
    decimals = len(mantissa.partition(".")[2])
    last = 10.0 ** (int(exponent or 0) - decimals) * SMALLER.get(unit, 1.0)
    return abs(float(shown.replace(",", "")) * SMALLER.get(unit, 1.0) - value) <= 0.5001 * last + 1e-12 * abs(value)


def known(study: Told, p: ParameterSummary) -> list[float | None]:
    """Every number that a text may say of a parameter: its values by name, the ends of their intervals, and its values by place."""
    judged = (Results(study.folder).get("identifiability").get("parameters") or {}).get(p.name) or {}
    found = [p.given, p.fitted, p.effect, p.refitted, p.value, judged.get("value"), *(judged.get("ci95") or ())]
    found += [end for ends in (p.interval, p.fitted_interval, p.effect_interval) for end in ends or ()]
    return [*found, *(v.value for v in p.by_place)]


def rows_of(text: str, name: str) -> Iterator[dict[str, str]]:
    """The rows of tables of values that begin with a name, as cells by their headings; by their place where one is empty."""
    header: list[str] = []
    for line in text.splitlines():
        cells = [c.strip() for c in (line.split("|") if "|" in line else re.split(r"  +", line))]
        if cells[0].startswith("parameter"):
            header = cells if "given" in cells else []
        elif header and cells[0].split(",")[0] == name:
            names = header if len(cells) == len(header) else map(str, range(len(cells)))
            yield dict(list(zip(names, cells, strict=False))[1:])


@pytest.mark.parametrize("where", ["screen", "report", "letter", "notebook", "python"])
def test_every_number_beside_a_parameter_is_one_that_the_summary_has(study: Told, where: str) -> None:
    text, rows = study.texts[where], 0
    for p in study.summary.parameters:
        numbers = [(n, u) for n, u in re.findall(rf"\b{p.name} (?:=|is|at) ({NUMBER})(?: (ms|µs))?\b", text)]
        for cells in rows_of(text, p.name):
            rows += 1
            for heading, value in (("given", p.given), ("fitted", p.fitted), ("with the effect", p.effect)):
                shown = cells.get(heading, "")
                assert shows(shown, "", value) if re.fullmatch(NUMBER, shown) else value is None or heading not in cells
            for cell in (c for c in cells.values() if "%" not in c and " if " not in c):
                numbers += [(n, "") for n in re.findall(rf"(?<![\w/]){NUMBER}(?![\w/])", cell)]
        strange = [n for n in numbers if not any(shows(*n, value) for value in known(study, p))]
        assert not strange, (where, p.name, strange)
    assert rows or not text or where == "letter"


def test_every_parameter_has_one_value(study: Told, tmp_path: Path) -> None:
    """The value that counts: in the summary's JSON, the report's first screen, the files of fitted values, exports and comparisons."""
    s = study.summary
    assert RunSummary.from_dict(json.loads(json.dumps(s.to_dict()))) == s
    tile = study.report.split("The values")[1].split("What does the model lack?")[0]
    for p in s.parameters:
        (cells,) = rows_of(tile, p.name)
        shown = cells.get("value") or cells["2"]
        assert shown == "by place" if p.by_place else shows(shown, "", p.value), (p.name, cells)
    if not study.screen:
        return
    written = RunSummary.from_dict(json.loads((study.folder / "summary.json").read_text("utf-8")))
    assert written == s
    compared = json.loads(call("compare", study.folder, study.folder, "--json"))["values"]
    assert {v["parameter"]: v["values"][0] for v in compared} == {p.name: p.value for p in s.parameters}
    if not s.counting.name:
        return
    source = next(p for p in study.folder.parent.glob("*.toml") if "[[experiment]]" in p.read_text("utf-8"))
    call("export", source, "--to", tmp_path / "x.toml")
    card = tomllib.loads((tmp_path / "x.toml").read_text("utf-8"))["parameters"]
    with (study.folder / "fitted-values.csv").open(encoding="utf-8", newline="") as file:
        table = {r["parameter"]: float(r["value"]) for r in csv.DictReader(file)}
    for p in s.parameters:
        if p.value is not None:
            assert table[p.name] == p.value
            # a card has a value only with its interval, and else the given one
            assert card[p.name]["value"] == p.value or (p.interval is None and card[p.name]["value"] == p.given)


def test_the_model_has_one_verdict(study: Told) -> None:
    s = study.summary
    word = s.verdict.upper()
    for where in ("screen", "notebook", "python"):
        first = re.search(r"\b(PASS|FAIL|NOT JUDGED)\. The", study.texts[where])
        assert (first is not None and first[1] == word) or not study.texts[where]
    tile = study.report.split("Does the model follow the recordings?")[1]
    assert tile.strip().startswith(word) or (s.verdict == "not judged" and tile.strip().startswith("The"))
    given = s.sets["given"].verdict.upper()
    assert f"{given if given != 'NOT JUDGED' else '–'} With the values it came with" in study.letter
    for name, found in s.sets.items():
        counted = sum(x.errors[name].on_noise == "fail" for x in s.signals if name in x.errors)
        assert counted == found.on_noise.failed
    fits = ("does not explain these data", "does not fit these records", "hold only if nothing else is missing")
    if s.verdict == "pass" and not s.findings:
        assert not [(w, said) for w, text in study.texts.items() for said in fits if said in text]
    told_all = {w: "not all" in text.lower() for w, text in study.texts.items() if text}
    assert set(told_all.values()) <= {s.remainder.more_than_noise and bool(s.counting.kind)}, told_all


def test_a_multiple_of_the_noise_is_that_of_a_signal_or_of_all_of_them(study: Told) -> None:
    s, gap = study.summary, Results(study.folder).get("discrepancy").get("gap") or {}
    factors = [e.times_noise for x in s.signals for e in x.errors.values()] + [
        s.remainder.record_times,
        s.remainder.times,
    ]
    factors += [v for line in (gap.get("pooled") or {}).values() for v in line.values()]
    for where in ("screen", "letter", "notebook", "python"):
        for shown in re.findall(rf"({NUMBER}) times the noise", study.texts[where]):
            assert any(shows(shown, "", f) for f in factors), (where, shown)


def test_what_is_recorded_next_is_said_alike(study: Told) -> None:
    for step in study.summary.next:
        for where in ("screen", "report", "notebook", "python") if step.text else ():
            assert step.text in " ".join(study.texts[where].split()) or not study.texts[where]
    tile = study.report.split("What to record next")[1].split("Contents")[0]
    assert study.summary.next or "Nothing" in tile or "No " in tile


def test_the_parts_that_were_told_wrongly(study_of: Callable[[str], Told]) -> None:
    """The wrong gain is blamed and the right constant is not; a value that depends on the place stands nowhere alone; a signal
    without limits has not passed; where nothing is missing nothing is claimed."""
    found = {name: study_of(name) for name in PLANTS}
    gain = found["wrong-gain"].summary
    assert gain.counting.name == "effect" and [p.name for p in gain.moved] == ["Kb"]
    assert "ask for other values than you gave: Kb = 1.50" in found["wrong-gain"].letter
    assert "Your value of Ta lies within its" in found["wrong-gain"].letter
    places = found["two-places"]
    ta, kb = places.summary.parameters
    assert ta.by_place and ta.value is None and kb.moved
    assert {round(v.value, 1) for v in ta.by_place} == {0.1, 0.4} and "Your value of Ta" not in places.letter
    assert "wherever it is, the recordings ask for other values than you gave: Kb = 1.50" in places.letter
    assert "The fitted values hold only if nothing else is missing: without lag at y" in places.letter
    mixed = found["mixed-units"]
    assert mixed.summary.sets["given"].in_limits.not_judged == 1 and "every signal it is less" not in mixed.letter
    assert "1 signal not judged: yb" in mixed.report
    alone = summarise({"discrepancy": Results(mixed.folder).get("discrepancy")})
    assert {x.output: x.unit for x in alone.signals} == {"ya": "pu", "yb": "MW"}, "as told after `diagnose` alone"
    right = found["right"].summary
    assert right.verdict == "pass" and not right.findings and not right.moved and not right.counting.kind
    turbine = study_of("turbine").summary
    water = next(p for p in turbine.parameters if p.name == "Tw")
    assert (
        turbine.counting.name == "effect"
        and water.interval[0] < TW < water.interval[1]
        and abs(water.fitted - TW) > 0.03
    )
    machine = study_of("machine").summary
    assert machine.verdict == "pass" and not machine.counting.kind and [p.name for p in machine.moved] == ["D"]
    assert machine.moved[0].value == pytest.approx(12.0, rel=0.03)
