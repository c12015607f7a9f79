"""Object code on disk: what is there is used as it is, what is not whole is made anew, and a folder may be of no use."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from hvdc_ident.data import InputSignal, experiment
from hvdc_ident.model import parse_card
from hvdc_ident.models import load_model
from hvdc_ident.simulate import Engine, Tolerance, object_code, simulate

CARD = """
schema = 1
name = "pendulum"
[parameters]
g = {value = 9.81}
c = {value = 0.2}
[inputs]
torque = {value = 0.0}
[states]
angle = {derivative = "speed", guess = 0.1}
speed = {derivative = "torque - g*sin(angle) - c*speed", guess = 0.1}
[outputs]
angle = "angle"
height = "1 - cos(angle)"
"""
PUSH = experiment("push", np.linspace(0.0, 2.0, 201), {"torque": InputSignal.step(0.1, 0.0, 2.0)})


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """An empty folder for object code."""
    monkeypatch.setenv("HVDC_IDENT_CACHE", str(tmp_path / "code"))
    return tmp_path / "code"


def run(card=CARD, method="explicit"):
    """Outputs and derivatives of a run with machine code that this process has not yet."""
    code = Engine(parse_card(card), ("g", "c"))
    out, statistics = code.run(np.array([9.81, 0.2]), [PUSH.inputs["torque"]], PUSH.time, Tolerance(), method)
    assert statistics.status == "converged"
    return out


def files(folder):
    return {p.name: p.read_bytes() for p in folder.iterdir()}


def made_by_nobody():
    raise AssertionError("compiled again")


@pytest.mark.parametrize("method", ["explicit", "rosenbrock"])
def test_code_from_disk_gives_the_same_bits_and_is_not_compiled(folder, monkeypatch, method):
    first, made = run(method=method), files(folder)
    monkeypatch.setattr(object_code, "compiled", lambda *a, **k: made_by_nobody())
    assert np.array_equal(run(method=method), first)
    assert files(folder) == made


def test_a_model_with_another_equation_has_files_of_its_own(folder):
    first, before = run(), files(folder)
    other = run(CARD.replace("c*speed", "c*speed*abs(speed)"))
    after = files(folder)
    assert before.items() < after.items()
    assert not np.array_equal(first, other)


def test_values_names_and_guesses_are_not_part_of_the_code(folder):
    run()
    before = files(folder)
    run(CARD.replace("9.81", "1.62").replace("pendulum", "on the moon").replace("guess = 0.1", "guess = 0.2"))
    assert files(folder) == before


@pytest.mark.parametrize(
    "damage",
    [
        lambda content: content[:-1],
        lambda content: content[:10],
        lambda content: b"",
        lambda content: content[:-5] + bytes([content[-5] ^ 1]) + content[-4:],
        lambda content: bytes([content[0] ^ 1]) + content[1:],
    ],
    ids=["short", "very short", "empty", "a bit of the code", "a bit of the digest"],
)
def test_a_damaged_file_is_made_anew(folder, damage):
    first, made = run(), files(folder)
    for path in folder.iterdir():
        path.write_bytes(damage(path.read_bytes()))
    assert files(folder) != made
    assert np.array_equal(run(), first)
    assert files(folder) == made


def test_a_file_under_another_files_name_is_not_used(folder):
    first, made = run(), files(folder)
    names = sorted(made)
    for name, other in zip(names, names[1:] + names[:1], strict=True):
        (folder / name).write_bytes(made[other])
    assert np.array_equal(run(), first)
    assert files(folder) == made


def test_a_folder_that_cannot_be_made_costs_nothing_but_time(folder, monkeypatch, tmp_path):
    first = run()
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("HVDC_IDENT_CACHE", str(tmp_path / "file" / "code"))
    assert np.array_equal(run(), first)
    assert (tmp_path / "file").read_text() == "in the way"


def test_a_folder_that_can_only_be_read_is_read(folder, monkeypatch):
    first, made = run(), files(folder)

    def refuse(*arguments, **named):
        raise PermissionError(13, "Permission denied")

    with monkeypatch.context() as m:
        m.setattr(object_code.Path, "write_bytes", refuse)
        m.setattr(os, "utime", refuse)
        run(CARD.replace("c*speed", "2*c*speed"))
        m.setattr(object_code, "compiled", lambda *a, **k: made_by_nobody())
        assert np.array_equal(run(), first)
    assert files(folder) == made


def test_beside_a_folder_of_no_use_the_users_caches_serve(folder, monkeypatch, tmp_path):
    monkeypatch.delenv("HVDC_IDENT_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "home"))
    beside, own = object_code.folders()
    assert beside.name == "__pycache__" and own == tmp_path / "home" / "hvdc_ident"
    (tmp_path / "file").touch()
    monkeypatch.setattr(object_code, "folders", lambda: iter([tmp_path / "file" / "code", own]))
    assert object_code.kept("facts", lambda: b"code") == b"code"
    assert object_code.kept("facts", made_by_nobody) == b"code"
    assert len(files(own)) == 1


def test_of_too_much_code_what_was_not_used_for_longest_goes(folder, monkeypatch):
    monkeypatch.setattr(object_code, "ROOM", 3500)
    monkeypatch.setattr(object_code, "LOOK", 1)
    for k in range(3):
        object_code.kept(f"facts {k}", lambda: bytes(1000))
        for age, path in enumerate(sorted(folder.iterdir(), key=lambda p: p.stat().st_mtime, reverse=True)):
            os.utime(path, (1e9 - age, 1e9 - age))
    (folder / "another's").write_bytes(bytes(5000))
    assert object_code.kept("facts 0", made_by_nobody) == bytes(1000)  # used: the newest now
    object_code.kept("facts 3", lambda: bytes(1000))
    assert len(files(folder)) == 1 + 1
    assert "another's" in files(folder)
    object_code.kept("facts 3", made_by_nobody)


def test_a_folder_is_looked_at_often_enough_to_stay_small(folder, monkeypatch):
    monkeypatch.setattr(object_code, "_surroundings", lambda: ("the same names on every machine",))
    monkeypatch.setattr(object_code, "ROOM", 20_000)
    most = 0
    for k in range(1000):
        object_code.kept(f"facts {k}", lambda: bytes(1000))
        most = max(most, len(list(folder.iterdir())))
    assert 20 < most < 20 + 8 * object_code.LOOK


def test_a_full_folder_is_not_listed_for_every_file(folder, monkeypatch):
    monkeypatch.setattr(object_code, "_surroundings", lambda: ("the same names on every machine",))
    looks, clear = [], object_code._clear
    monkeypatch.setattr(object_code, "_clear", lambda at: (looks.append(at), clear(at)))
    for k in range(640):
        object_code.kept(f"facts {k}", lambda: b"code")
    assert 1 <= len(looks) <= 30


def test_a_process_that_finds_its_code_loads_little():
    case = experiment("short", np.linspace(0.0, 0.01, 11))
    simulate(load_model("vsc-hvdc-link"), case, sensitivities=("KIP",))
    code = (
        "import sys, numpy as np\n"
        "from hvdc_ident import load_model, simulate\n"
        "from hvdc_ident.data import experiment\n"
        "case = experiment('short', np.linspace(0.0, 0.01, 11))\n"
        "simulate(load_model('vsc-hvdc-link'), case, sensitivities=('KIP',))\n"
        "print(*sys.modules)"
    )
    found = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert found.stderr == ""
    unwanted = {"scipy.linalg", "hvdc_ident.effects"}
    assert sorted(unwanted & set(found.stdout.split())) == []
