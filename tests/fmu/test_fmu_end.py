"""An FMU that asks for the end of its run: the rows up to there are kept where they are asked for, and it is said."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
from typer.testing import CliRunner

from hvdc_ident import simulate
from hvdc_ident.cli import app
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import SimulationError
from tests.fmu.c_fmu import build, needs_compiler
from tests.fmu.c_models import response, spring

pytestmark = needs_compiler

TIME = np.linspace(0.0, 4.0, 41)
INPUT = InputSignal(
    np.array([0.0, 1.0, 1.0, 2.3, 2.3, 4.0]), np.array([0.0, 0.0, 1.0, 1.0, 2.0, 2.0]), np.array([1.0, 2.3])
)
STEP = experiment("step", TIME, {"u": INPUT})  # FMI 3.0 asks at events alone, as at the second step
END = 2.25


def ending():
    """The spring that wants no more from 2.25 s on."""
    plain = spring("ending")
    return replace(plain, code=f"#define ENDS(r, t) ((t) > {END} - 1e-9)\n{plain.code}")


@pytest.mark.parametrize(
    ("version", "interface"), [(2, "model-exchange"), (3, "model-exchange"), (2, "co-simulation"), (3, "co-simulation")]
)
def test_the_rows_up_to_the_end_are_kept(fmu, version, interface):
    model = fmu(ending(), version, interface)
    with pytest.raises(SimulationError, match="asked for the end of the run"):
        simulate(model, STEP)
    for _ in range(2):  # the instance goes on
        run = simulate(model, STEP, partial=True)
        rows = run.trajectory.time.size
        assert run.status == "ended" and np.array_equal(run.trajectory.time, TIME[:rows])
        assert TIME[rows - 1] <= END + 0.5 and rows >= 22 and "asked for the end of the run at 2." in run.notes["end"]
        if interface == "co-simulation":  # the step to 2.3 s is done, and says so
            assert rows == 24 and "at 2.3 s" in run.notes["end"]
        assert run["y"] == pytest.approx(response(TIME[:rows]), abs=1e-4)
    assert simulate(model, STEP.with_(time=TIME[:15]), partial=True).status == "converged"


def test_the_stage_keeps_its_rows_and_has_failed(tmp_path):
    y = response(TIME)
    table = np.column_stack([TIME, STEP.inputs["u"](TIME), y])
    np.savetxt(tmp_path / "step.csv", table, delimiter=",", header="time,u,y", comments="")
    path = tmp_path / "study.toml"
    source = build(ending(), tmp_path).name
    path.write_text(
        f'schema = 1\n[model]\nsource = "{source}"\n[[experiment]]\nname = "step"\ndata = "step.csv"\n'
        'inputs = ["u"]\noutputs = ["y"]\nnoise = {y = 1e-3}\n'
        "[parameters]\nd = {start = 0.5, min = 0.1, max = 2}\n[fit]\nstarts = 1\n"
    )
    result = CliRunner().invoke(app, ["simulate", str(path), "--json"])
    assert result.exit_code == 1 and "asked for the end of the run at 2." in result.stderr
    found = json.loads(result.stdout)
    assert found["experiments"]["step"]["status"] == "ended" and found["rmse"]["y"]["step"] < 1e-4
    rows = (tmp_path / "study-results" / "simulation.step.csv").read_text().splitlines()
    assert 20 < len(rows) < 30
    fitted = CliRunner().invoke(app, ["fit", str(path)])
    assert fitted.exit_code == 1 and "asked for the end of the run" in fitted.output.replace("\n", " ")
