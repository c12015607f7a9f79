"""FMUs that crash, hang, leave, lie or eat: each is one clear error, and a sweep keeps every other point."""

from __future__ import annotations

import os
import re
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from hvdc_ident import load_model, simulate
from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.errors import ComputationError, InputError, ModelError, SimulationError
from hvdc_ident.fmu import read_fmu
from hvdc_ident.sensitivity import sweep
from tests.fmu.c_fmu import COMPILER, FOLDER, build, needs_compiler
from tests.fmu.c_models import FAULTS, FAULTY, FAULTY_CODE, FAULTY_VARIABLES, broken
from tests.fmu.fmu_limits import PATIENT, QUICK

pytestmark = needs_compiler

TIME = np.linspace(0.0, 0.5, 26)
STEP = experiment("step", TIME, {"u": InputSignal.step(0.1, 0.0, 1.0)})
REASONS = {
    1: r"crashed in the run, in fmi2\w+: its process was ended by SIGSEGV",
    2: r"hangs: no result of the run after 1 s",
    3: r"crashed in the run, in fmi2\w+: it ended itself with exit code 0 and no result",
    4: r"used 1\d\d of its 128 MiB of memory",
    5: r"output 'out' is not finite",
    6: r"(fmi2DoStep|fmi2GetDerivatives) returned error",
    7: r"crashed in the run, in fmi2\w+: its process was ended by SIGABRT",
    8: r"(fmi2DoStep|fmi2GetDerivatives) returned fatal",
}


def answer(t, lag=0.1):
    return np.where(t < 0.1, 0.0, 1.0 - np.exp(-(t - 0.1) / lag))


@pytest.mark.parametrize(
    ("fault", "interface"),
    [(f, "model-exchange") for f in FAULTS] + [(f, "co-simulation") for f in (1, 5, 6)],  # the sweep below has the rest
    ids=lambda x: FAULTS.get(x, x),
)
def test_a_run_that_goes_wrong_says_why_and_the_next_goes_right(fmu, fault, interface):
    model = fmu(FAULTY, 2, interface, QUICK if FAULTS[fault] == "hang" else PATIENT)
    with pytest.raises(SimulationError, match=REASONS[fault]) as told:
        simulate(model, STEP, {"fault": fault})
    assert "faulty2.fmu" in str(told.value) and "\n" not in str(told.value)
    assert np.abs(simulate(model, STEP)["out"] - answer(TIME)).max() < 1e-6


def test_a_sweep_over_faults_keeps_every_other_point(fmu):
    model = fmu(FAULTY, 2, "co-simulation", QUICK)
    lags = [0.05, 0.1]
    found = sweep(model, [STEP], {"fault": range(9), "T": lags}, against="base", outputs=["out"])
    rows = list(found.rows())
    assert len(rows) == 18
    for row in rows:
        fault, lag = int(row["values"]["fault"]), row["values"]["T"]
        if fault:
            assert row["status"] == "failed" and row["reason"]
        else:
            expected = np.sqrt(np.mean((answer(TIME, lag) - answer(TIME)) ** 2))
            assert row["rmse"]["out"]["step"] == pytest.approx(expected, abs=1e-6)
    reasons = {int(r["values"]["fault"]): r["reason"] for r in rows if r["values"]["T"] == 0.05}
    for fault in FAULTS:  # on a busy computer the memory may not be full before the deadline
        wanted = REASONS[fault] + (f"|{REASONS[2]}" if FAULTS[fault] == "endless memory" else "")
        assert re.search(wanted, reasons[fault])


def test_the_call_is_told_of_an_fmu_that_takes_its_time_to_end(tmp_path):
    code = FAULTY_CODE + "__attribute__((destructor)) static void late(void) { usleep(300000); }\n"
    model = read_fmu(
        build(replace(FAULTY, name="late", code=code), tmp_path), interface="co-simulation", limits=PATIENT
    )
    with pytest.raises(SimulationError, match=r"in fmi2DoStep: it ended itself with exit code 0 and no result"):
        simulate(model, STEP, {"fault": 3})
    model.pool.close()


def test_a_crash_in_a_trial_tells_nothing_about_the_run_after_it(tmp_path):
    model = read_fmu(build(broken("resets", defines=("AT_RESET=abort()",)), tmp_path), interface="co-simulation")
    assert np.abs(simulate(model, STEP)["out"] - answer(TIME)).max() < 1e-6
    with pytest.raises(SimulationError, match=r"crashed in the run, in fmi2DoStep: its process was ended by SIGSEGV"):
        simulate(model, STEP, {"fault": 1})
    assert model.pool.learned["restart"] == "instance" and model.pool.started == 1
    model.pool.close()


def bad_files(folder: Path) -> dict[str, tuple[Path, str]]:
    """Files that cannot be loaded: by name the path and what the error says."""
    whole = build(FAULTY, folder)
    library = f"binaries__{FOLDER[2]}__"

    def made(name, model, **files):
        return build(model, folder, 2, **files)

    good = broken("whole")
    from tests.fmu.c_fmu import library as compiled

    code = compiled(good.code, 2, 1, 0, ())
    return {
        "segfault": (made("segfault", broken("segfault", "*(volatile int *)0 = 1")), "SIGSEGV"),
        "hang": (made("hang", broken("hang", "for (;;) usleep(1000)")), "hangs: no result of the loading"),
        "exit": (made("exit", broken("leaves", "exit(0)")), "exit code 0 and no result"),
        "abort": (made("abort", broken("aborts", "abort()")), "SIGABRT"),
        "memory": (made("memory", broken("eats", "eat()")), r"used 1\d\d of its 128 MiB of memory"),
        "guid": (
            made("guid", broken("foreign", token="{other}")),
            "no instance: the GUID is not that of this model.*one export",
        ),
        "truncated": (
            made("cut", broken("cut"), **{f"{library}cut.so": code[: len(code) // 3]}),
            "cannot be loaded|SIGBUS",
        ),
        "no library": (
            made("text", broken("text"), **{f"{library}text.so": b"no library"}),
            "cannot be loaded: file too short",
        ),
        "no functions": (
            made("empty", broken("empty"), **{f"{library}empty.so": compiled("", 0, 0, 0, ())}),
            "lacks the function fmi2",
        ),
        "null": (made("null", broken("null", "return 0")), "gave no instance"),
    } | {"good": (whole, "")}


def test_every_bad_file_is_one_error_and_those_after_it_run(tmp_path):
    """A campaign over files, the good one last: what went before has left nothing behind."""
    for name, (path, message) in bad_files(tmp_path).items():
        model = read_fmu(path, interface="co-simulation", limits=replace(PATIENT, load=1.0 if name == "hang" else 60.0))
        if name == "good":
            assert np.abs(simulate(model, STEP)["out"] - answer(TIME)).max() < 1e-6
            continue
        with pytest.raises(ComputationError, match=message) as told:
            simulate(model, STEP)
        assert path.name in str(told.value)
        with pytest.raises(ComputationError) as again:  # known by now: no second process is spent on it
            simulate(model, STEP)
        assert str(again.value) == str(told.value) and model.pool.started == 1


def test_a_cause_that_the_fmu_reports_before_its_consequence_is_told(tmp_path):
    said = "the license file was not found: /opt/tool/license.dat", "the core was not made", "Instantiation failed"
    calls = "".join(f'f->logger(f->env, name, 3, "error", "{text}"); ' for text in said)
    unlicensed = broken("unlicensed", f"{{ {calls}return 0; }}")
    model = read_fmu(build(unlicensed, tmp_path), interface="co-simulation", limits=PATIENT)
    with pytest.raises(ComputationError, match=f"no instance: {'; '.join(said)}.*the licence that it asks for"):
        simulate(model, STEP)
    model.pool.close()


def test_messages_of_a_run_that_repeat_are_told_once(tmp_path):
    said = "the table ends at 0.2 s", "the equations have no solution", "the step failed"
    order = said[0], *([said[1]] * 40), said[2]
    calls = "".join(f'm->log(m->env, "", 3, "error", "{text}"); ' for text in order)
    code = (
        FAULTY.code + f"#undef AT_STEP\n#define AT_STEP(r) do {{ if (m->t > 0.2) {{ {calls}return 3; }} }} while (0)\n"
    )
    model = read_fmu(
        build(replace(FAULTY, name="ends", code=code), tmp_path), interface="co-simulation", limits=PATIENT
    )
    with pytest.raises(SimulationError, match=f"the FMU said: {'; '.join(said)}"):
        simulate(model, STEP)
    model.pool.close()


def test_wrong_names_and_values_are_wrong_input(fmu):
    model = fmu(FAULTY, 2, "co-simulation", QUICK)
    with pytest.raises(InputError, match=r"no parameter or input 'TT'.*did you mean 'T'"):
        simulate(model, STEP, {"TT": 1.0})
    with pytest.raises(InputError, match="no output 'nothing'"):
        simulate(model, STEP, outputs=["nothing"])
    with pytest.raises(ModelError, match="not finite"):
        simulate(model, STEP, {"T": np.inf})
    with pytest.raises(ModelError, match="outside its own bounds"):
        model.with_values({"T": 0.0})
    with pytest.raises(InputError, match="no parameterisation"):
        model.parameterised("physical")
    with pytest.raises(ModelError, match="begins where its own initialisation"):
        simulate(model, STEP.with_(starts={"y": 0.5}))
    with pytest.raises(InputError, match="cannot be driven"):
        simulate(model, STEP.with_(drive=("out",)))
    assert FAULTY_VARIABLES[2].name == "T"


def test_nothing_of_a_worker_stays(tmp_path):
    """Its process, its folder and its pipes go with the model."""
    model = load_model(build(FAULTY, tmp_path))
    simulate(model, STEP)
    host = model.pool
    process, folder = host._processes.workers[0].process.guard, host._processes.folder.path
    assert folder.is_dir() and process.poll() is None
    before = len(os.listdir("/proc/self/fd"))
    del model, host
    import gc

    gc.collect()
    assert process.poll() is not None and not folder.exists()
    assert len(os.listdir("/proc/self/fd")) < before


def test_an_fmu_that_gives_one_instance_a_process_gets_a_new_process_for_each_run(tmp_path):
    """Its reset fails too, so that every run but the first needs what the process cannot give again."""
    for name, refusal in {"once": "return 0", "crash": "abort()"}.items():
        once = broken(name, f"{{ static int made; if (made++) {refusal}; }}", defines=("AT_RESET=return 3",))
        model = read_fmu(build(once, tmp_path), interface="co-simulation", limits=PATIENT)
        for lag in (0.1, 0.05, 0.1):
            assert np.abs(simulate(model, STEP, {"T": lag})["out"] - answer(TIME, lag)).max() < 1e-6
        assert model.pool.learned["restart"] == "process" and model.pool.started == 1
        model.pool.close()


def test_shared_libraries_that_are_missing_are_named(tmp_path):
    (tmp_path / "needed.c").write_text("int needed(void) { return 1; }")
    (tmp_path / "user.c").write_text("int needed(void); int user(void) { return needed(); }")
    flags = [COMPILER, "-shared", "-fPIC", "-L.", "-o"]
    subprocess.run([*flags, "libneeded7.so", "needed.c"], cwd=tmp_path, check=True)
    subprocess.run([*flags, "user.so", "user.c", "-lneeded7"], cwd=tmp_path, check=True)
    library = f"binaries__{FOLDER[2]}__needy.so"
    path = build(broken("needy"), tmp_path, **{library: (tmp_path / "user.so").read_bytes()})
    with pytest.raises(ComputationError, match=r"not here: libneeded7.so\. Try: install them") as told:
        simulate(read_fmu(path, interface="co-simulation"), STEP)
    assert "hvdc_ident_fmu" not in str(told.value)
