"""`check` of an FMU: its variables, what it offers, what a short run finds, and a binary compiled from its sources."""

from __future__ import annotations

import json
import re
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident import load_model, simulate
from hvdc_ident.cli import app
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.fmu import Capabilities, read_capabilities, read_fmu
from tests.fmu.c_fmu import SOURCE, Var, build, description, needs_compiler
from tests.fmu.c_models import BALL, CLOCK, begun, response, spring

pytestmark = needs_compiler


def run(*arguments):
    return CliRunner().invoke(app, ["check", *map(str, arguments)])


def test_the_list_of_variables_is_grouped_and_cut(tmp_path):
    plain = spring()
    many = tuple(Var(f"cell[{k}].i", 10, more=(("unit", "A"),)) for k in range(40))
    path = build(replace(plain, variables=(*plain.variables, *many)), tmp_path)
    whole = run(path).output
    assert "4 parameters" in whole and "model-exchange, co-simulation" in whole
    assert "cell[0].i" in whole and "cell[39].i" not in whole and "--all shows every variable, --find TEXT" in whole
    row = next(line for line in whole.splitlines() if line.startswith("  m "))
    assert row.split() == ["m", "parameter", "fixed", "kg", "2", "[0.1,", "inf]"]
    found = read_capabilities(path)
    assert "cell[39].i" in found.text(None) and "found:" in whole and "found:" not in str(found)
    some = found.matching("CELL[3").text(None)
    assert "cell[3].i" in some and "cell[39].i" in some and "cell[2].i" not in some and "4 parameters" in some


def test_json_has_every_variable_and_what_was_found(tmp_path):
    path = build(spring(), tmp_path)
    described = read_capabilities(path)
    assert Capabilities.from_dict(json.loads(json.dumps(described.to_dict(), allow_nan=False))) == described
    result = run(path, "--json")
    found = json.loads(result.stdout)
    assert list(found["variables"]["parameters"]) == ["m", "d", "k", "b"]
    assert found["variables"]["parameters"]["k"]["also"] == ["stiffness"]
    assert list(found["variables"]["states"]) == ["x", "v"] and found["sizes"]["outputs"] == 2
    assert found["found"]["two short runs"].startswith("equal")
    assert found["found"]["brought back to its start by"] == "reset"
    assert "agree with differences, for all 7" in found["found"]["derivatives at the start"]


@pytest.mark.parametrize("version", [2, 3])
@pytest.mark.parametrize("own", [True, False])
def test_directional_derivatives_that_the_description_states_are_told(tmp_path, version, own):
    """FMI 3.0 calls the attribute otherwise than FMI 2.0."""
    path = build(spring(own=own), tmp_path, version)
    assert ("providesDirectionalDerivative" in description(spring(own=own), version)) == own
    found = read_capabilities(path)
    assert {kind: said["directional derivatives"] for kind, said in found.interfaces.items()} == dict.fromkeys(
        ("model-exchange", "co-simulation"), own
    )
    told = run(path).output
    assert told.count(f"directional derivatives {'yes' if own else 'no'}") == 2
    assert ("directional ones agree" in told) == own


@pytest.mark.parametrize(
    ("stop", "told"), [("21", "equal, 2 s from 1 s"), ("1", "equal, 0.1 s from 1 s"), (None, "equal, 0.1 s from 1 s")]
)
def test_the_short_runs_are_a_tenth_of_the_default_experiment(tmp_path, stop, told):
    said = "" if stop is None else f' stopTime="{stop}"'
    text = description(spring(), 2).replace(
        "<ModelVariables>", f'<DefaultExperiment startTime="1"{said}/><ModelVariables>'
    )
    found = load_model(build(spring(), tmp_path, **{"modelDescription.xml": text.encode()}))
    assert found.capabilities.found["two short runs"] == told
    found.pool.close()


def test_an_output_that_no_run_repeats_is_told(tmp_path):
    """The second short run is run: the time that the computation took is another one."""
    found = read_fmu(build(begun("timed", more=(CLOCK,)), tmp_path), interface="co-simulation")
    assert "differ by up to" in found.capabilities.found["two short runs"]
    assert "in cpu, " in found.capabilities.found["two short runs"]
    found.pool.close()


def test_derivatives_that_are_wrong_are_found(fmu):
    words = fmu(spring("skew", wrong=1.5)).capabilities
    assert "differ from differences for" in words.found["derivatives at the start"]
    assert "skew2.fmu: model skew, FMI 2.0" in str(words)


def test_an_fmu_without_outputs_lists_its_states_once(tmp_path):
    quiet = replace(BALL, name="quiet", variables=tuple(v for v in BALL.variables if v.causality != "output"))
    found = json.loads(run(build(quiet, tmp_path), "--json").stdout)
    assert not found["variables"]["outputs"] and list(found["variables"]["states"]) == ["h", "v"]


@pytest.fixture
def foreign(tmp_path):
    """The spring with its C sources, and a binary for another machine."""
    model = replace(spring(), name="spring")
    defines = "".join(f"#define {d.replace('=', ' ')}\n" for d in model.defines)
    code = f'#define FMI 2\n#define NX 2\n#define NZ 0\n{defines}{model.code}\n#include "fmu.c"\n'
    path = tmp_path / "foreign.fmu"
    with zipfile.ZipFile(path, "w") as z:
        z.writestr("modelDescription.xml", description(model, 2))
        z.writestr("binaries/win64/spring.dll", b"MZ")
        z.writestr("sources/model.c", code)
        z.writestr("sources/fmu.c", SOURCE.read_text())
        z.writestr("resources/table.txt", "1 2 3")
    return path


def test_what_cannot_run_here_is_listed_and_refused(foreign):
    result = run(foreign)
    assert result.exit_code == 2 and "parameters, which can be estimated (4)" in result.output
    assert "`hvdc-ident check foreign.fmu --compile`" in result.output.replace("\n", " ")


def test_sources_are_compiled_with_consent_into_a_new_file(foreign):
    before = foreign.read_bytes()
    result = run(foreign, "--compile")
    assert result.exit_code == 0, result.output
    new = foreign.with_name("foreign-compiled.fmu")
    assert foreign.read_bytes() == before and sorted(p.name for p in foreign.parent.iterdir()) == [
        new.name,
        foreign.name,
    ]
    with zipfile.ZipFile(new) as z:
        assert z.read("resources/table.txt") == b"1 2 3" and "binaries/win64/spring.dll" in z.namelist()
    time = np.linspace(0.0, 4.0, 41)
    step = experiment("step", time, {"u": InputSignal.step(1.0, 0.0, 1.0)})
    assert simulate(load_model(new), step)["y"] == pytest.approx(response(time), abs=1e-4)
    again = run(foreign, "--compile")
    assert again.exit_code == 2 and "there already" in again.output


PREFIXED = """
#define PASTE(a, b) a ## b
#define JOINED(a, b) PASTE(a, b)
#if defined(FMI2_FUNCTION_PREFIX)
#define NAMED(f) JOINED(FMI2_FUNCTION_PREFIX, f)
#else
#define NAMED(f) f
#endif
"""
"""Names of functions as the header of FMI 2.0 makes them: with the model's before them where sources ask for it."""
PREFIX = "#define FMI2_FUNCTION_PREFIX spring_"


def with_source(path, name, change):
    """The path of a copy of an FMU whose fmu.c is changed."""
    copy = path.with_name(name)
    with zipfile.ZipFile(path) as old, zipfile.ZipFile(copy, "w") as z:
        for entry in old.namelist():
            text = old.read(entry)
            z.writestr(entry, change(text.decode()) if entry == "sources/fmu.c" else text)
    return copy


@pytest.mark.parametrize("asked", [f"#ifndef FMI2_FUNCTION_PREFIX\n{PREFIX}\n#endif", PREFIX], ids=["default", "set"])
def test_functions_whose_names_begin_with_the_models_are_compiled_under_their_own(foreign, asked):
    """Sources are meant to be linked with others too: the prefix is theirs where nobody sets it, or always."""
    names = sorted(set(re.findall(r"\bfmi2[A-Z]\w+", SOURCE.read_text())))
    head = "\n".join([asked, PREFIXED, *(f"#define {n} NAMED({n})" for n in names), ""])
    result = run(with_source(foreign, "prefixed.fmu", lambda text: head + text), "--compile")
    assert result.exit_code == 0 and "two short runs: equal" in result.output, result.output
    new = foreign.with_name("prefixed-compiled.fmu")
    time = np.linspace(0.0, 4.0, 41)
    step = experiment("step", time, {"u": InputSignal.step(1.0, 0.0, 1.0)})
    assert simulate(load_model(new), step)["y"] == pytest.approx(response(time), abs=1e-4)


@pytest.mark.parametrize(
    ("change", "lacks"),
    [
        (lambda text: text.replace("UNUSED(fmi2CancelStep)", ""), "without fmi2CancelStep."),
        (lambda text: text.replace("int fmi2Terminate(", "static int fmi2Terminate("), "without fmi2Terminate."),
        (lambda text: f"double elsewhere(double);\n{text.replace('m->t = 0;', 'm->t = elsewhere(0);')}", "elsewhere"),
    ],
    ids=["missing", "static", "elsewhere"],
)
def test_a_binary_that_lacks_functions_is_not_done(foreign, change, lacks):
    result = run(with_source(foreign, "lacking.fmu", change), "--compile")
    words = " ".join(result.output.split())
    assert result.exit_code == 1 and "cannot be loaded" in words and lacks in words, words
    assert not foreign.with_name("lacking-compiled.fmu").exists()


def test_what_cannot_be_compiled_is_one_message(foreign, monkeypatch):
    broken = foreign.with_name("broken.fmu")
    with zipfile.ZipFile(foreign) as old, zipfile.ZipFile(broken, "w") as z:
        for name in old.namelist():
            z.writestr(name, old.read(name) if name != "sources/fmu.c" else b'#include "windows.h"')
    result = run(broken, "--compile")
    assert result.exit_code == 1 and "refuses the FMU's sources" in result.output and "windows.h" in result.output
    monkeypatch.setenv("CC", "/no/compiler")
    none = run(foreign, "--compile")
    assert none.exit_code == 2 and "no C compiler is here" in none.output and "install gcc" in none.output
    assert not list(Path(foreign.parent).glob("*compiled*"))


def test_options_about_an_fmu_are_refused_for_a_study(tmp_path):
    study = tmp_path / "study.toml"
    study.write_text("schema = 1\n")
    result = run(study, "--find", "x")
    assert result.exit_code == 2 and "are about an FMU" in result.output
