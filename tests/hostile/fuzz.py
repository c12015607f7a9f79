"""Files and texts spoilt at random: each ends well or in an InputError, never in anything else.

As a test, 500 of every kind (test_fuzz.py). As a program, as many as asked for, where over 5 s or 1 GB is wrong too:

    python -m tests.hostile.fuzz --runs 10000 [--only csv]

Deterministic for a seed; a case that fails is printed with its kind, seed and number, and can be run alone.
"""

from __future__ import annotations

import argparse
import io
import resource
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from hvdc_ident.errors import InputError
from hvdc_ident.expression import parse
from hvdc_ident.formats import read_waveforms
from hvdc_ident.model import read_card, write_card
from hvdc_ident.models import load_model
from hvdc_ident.study.study import load_study
from tests.formats.samples import SAMPLES

Rng = np.random.Generator
LONGEST = 5.0  # s a case may take
MOST_MEMORY = 1024  # MiB of this process
LIBRARY = b"\x7fELF\x02\x01" + bytes(12) + b"\x3e" + bytes(85)  # a header of 64 bits for x86_64, and nothing in it

WORDS = [
    b"nan", b"inf", b"-", b"1e999", b"1e-999", b"0", b"-1", b"99999999999999999999", b"\x00", b"\xff", b"\xef\xbb\xbf",
    b"=cmd|' /C calc'!A1", b"__import__", b"../../canary", b"[[", b"]]", b'"""', b"'", b"\\", b"\r", b"\n\n", b"\t", b",",
    b";", b"{", b"}", b"(" * 50, b"**", b"<!DOCTYPE x [<!ENTITY a 'b'>]>", b"&a;", b"<", b"/>", b"\x1a", b"1_0", b"0x1",
]  # fmt: skip


@dataclass(frozen=True)
class Kind:
    """One kind of input. good: whole examples, as bytes. use: what a user does with it, in a folder.

    slow: each takes a process of its own.
    """

    good: Callable[[Path], list[bytes]]
    use: Callable[[bytes, Path], object]
    slow: bool = False


def spoilt(content: bytes, rng: Rng) -> bytes:
    """The content after one to six random injuries."""
    data = bytearray(content)
    for _ in range(int(rng.integers(1, 7))):
        _injure(data, rng)
    return bytes(data)


def _injure(data: bytearray, rng: Rng) -> None:
    size = len(data)
    at = int(rng.integers(0, size + 1))
    end = min(size, at + int(rng.integers(1, 64)))
    kind = int(rng.integers(0, 9))
    if kind == 0 and size:
        data[min(at, size - 1)] ^= 1 << int(rng.integers(0, 8))
    elif kind == 1 and size:
        data[min(at, size - 1)] = int(rng.integers(0, 256))
    elif kind == 2:
        del data[at:]
    elif kind == 3:
        del data[at:end]
    elif kind == 4:
        data[at:at] = data[at:end] * int(rng.integers(1, 20))
    elif kind == 5:
        data[at:at] = rng.integers(0, 256, int(rng.integers(1, 40)), dtype=np.uint8).tobytes()
    elif kind == 6:
        data[at:at] = WORDS[int(rng.integers(0, len(WORDS)))]
    elif kind == 7:
        data[at:end] = WORDS[int(rng.integers(0, len(WORDS)))]
    else:
        other = int(rng.integers(0, size + 1))
        data[at:end] = data[other : other + end - at]


def _file_of(name: str, suffix: str) -> Kind:
    """A waveform format: its sample file, spoilt; a companion file stays whole."""

    def good(folder: Path) -> list[bytes]:
        path = folder / f"sample{suffix}"
        SAMPLES[name](path)
        return [path.read_bytes()]

    def use(content: bytes, folder: Path) -> object:
        path = folder / f"sample{suffix}"
        path.write_bytes(content)
        return read_waveforms(path)

    return Kind(good, use)


def _companion(name: str, suffix: str, companion: str) -> Kind:
    """A format of two files, of which the second is spoilt."""

    def good(folder: Path) -> list[bytes]:
        SAMPLES[name](folder / f"sample{suffix}")
        return [(folder / companion).read_bytes()]

    def use(content: bytes, folder: Path) -> object:
        (folder / companion).write_bytes(content)
        return read_waveforms(folder / f"sample{suffix}")

    return Kind(good, use)


def _good_card(folder: Path) -> list[bytes]:
    return [write_card(load_model("vsc-hvdc-link")).encode(), CARD.encode()]


def _use_card(content: bytes, folder: Path) -> object:
    path = folder / "model.toml"
    path.write_bytes(content)
    return read_card(path)


CARD = """schema = 1
name = "dc-motor"
[parameters]
J = {value = 0.01, unit = "kg.m2", min = 0.001, max = 0.1}
k = {value = 0.5}
[inputs]
v = {value = 0.0, unit = "V"}
[states]
w = {derivative = "torque / J", unit = "rad/s", start = "free"}
[signals]
torque = "k*where(v > 0, clip(v, -1, 1), sin(w)**2)"
[outputs]
w = "w"
"""
STUDY = """schema = 1
name = "b"
[model]
source = "model.toml"
[model.values]
k = 0.4
[[model.effect]]
effect = "lag"
at = ["torque"]
parameters = {T = 0.01}
[parameters]
J = {start = 0.01, min = 0.005, max = 0.05}
[[experiment]]
name = "e"
data = "e.csv"
inputs = ["v"]
outputs = {w = "w"}
noise = {w = 1e-3}
nuisance = ["time-shift"]
instrument = {w = {window-mean = 0.02, delay = 0.001}}
[[sweep]]
parameter = "J"
min = 0.005
max = 0.05
points = 3
[fit]
[diagnose]
effects = ["lag", "limit"]
"""


def _good_study(folder: Path) -> list[bytes]:
    (folder / "model.toml").write_text(CARD, "utf-8")
    (folder / "e.csv").write_text("time,v,w\n" + "".join(f"{n / 10},{n // 5},{n * n}\n" for n in range(10)), "utf-8")
    return [STUDY.encode()]


def _use_study(content: bytes, folder: Path) -> object:
    path = folder / "study.toml"
    path.write_bytes(content)
    return load_study(path)


def _good_expressions(folder: Path) -> list[bytes]:
    return [
        b"(Pdc1/Vdc1 + Idc - Iload1) / C1",
        b"clip(yq1 / clip(Vac1, 0.01, 2), -m1, m1)",
        b"where(a > 1e-3, sqrt(abs(x))**2, -atan2(y, min(u, v, w)))",
    ]


def _use_expression(content: bytes, folder: Path) -> object:
    return parse(content.decode("utf-8", "surrogateescape" if len(content) % 2 else "replace"))


def _good_fmu(folder: Path) -> list[bytes]:
    description = b"""<?xml version="1.0" encoding="UTF-8"?>
<fmiModelDescription fmiVersion="2.0" modelName="m" guid="{1}" numberOfEventIndicators="0">
<ModelExchange modelIdentifier="m"/><CoSimulation modelIdentifier="m"/>
<ModelVariables>
<ScalarVariable name="x" valueReference="0" causality="local" initial="exact"><Real start="1"/></ScalarVariable>
<ScalarVariable name="der(x)" valueReference="1"><Real derivative="1"/></ScalarVariable>
<ScalarVariable name="k" valueReference="2" causality="parameter" variability="tunable"><Real start="2"/></ScalarVariable>
</ModelVariables>
<ModelStructure><Derivatives><Unknown index="2"/></Derivatives></ModelStructure>
</fmiModelDescription>"""
    return [description]


def _use_fmu_description(content: bytes, folder: Path) -> object:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("modelDescription.xml", content)
        archive.writestr("binaries/linux64/m.so", LIBRARY)
    return _use_fmu(buffer.getvalue(), folder)


def _good_zip(folder: Path) -> list[bytes]:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr("modelDescription.xml", _good_fmu(folder)[0])
        archive.writestr("binaries/linux64/m.so", LIBRARY)
    return [buffer.getvalue()]


def _use_fmu(content: bytes, folder: Path) -> object:
    """What is done with an FMU before its code is run: the archive's checks and the description."""
    from hvdc_ident.fmu import read_description
    from hvdc_ident.fmu.archive import check_archive

    path = folder / "m.fmu"
    path.write_bytes(content)
    check_archive(path)
    return read_description(path)


KINDS: dict[str, Kind] = {
    "expression": Kind(_good_expressions, _use_expression),
    "card": Kind(_good_card, _use_card),
    "study": Kind(_good_study, _use_study),
    "csv": _file_of("csv", ".csv"),
    "comtrade-header": _file_of("comtrade", ".cfg"),
    "comtrade-data": _companion("comtrade", ".cfg", "sample.dat"),
    "comtrade-one-file": _file_of("comtrade", ".cff"),
    "matlab": replace(_file_of("matlab", ".mat"), slow=True),
    "dymola": _file_of("dymola-mat", ".mat"),
    "pscad-header": _file_of("pscad", ".inf"),
    "pscad-data": _companion("pscad", ".inf", "sample_01.out"),
    "hdf5": replace(_file_of("hdf5", ".h5"), slow=True),
    "parquet": _file_of("parquet", ".parquet"),
    "fmu-zip": Kind(_good_zip, _use_fmu),
    "fmu-description": Kind(_good_fmu, _use_fmu_description),
}


def cases(kind: Kind, folder: Path, seed: int, runs: int) -> Iterator[tuple[int, bytes]]:
    """Number and content of each spoilt case; each depends on the seed and its number alone."""
    examples = kind.good(folder)
    for number in range(runs):
        rng = np.random.default_rng([seed, number])
        yield number, spoilt(examples[number % len(examples)], rng)


def outcome(kind: Kind, content: bytes, folder: Path) -> str:
    """ "" where the case ended well or was refused as it should be; else what went wrong."""
    try:
        kind.use(content, folder)
    except InputError as error:
        return "" if str(error).strip() else "an empty message"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return ""


def main() -> int:
    """How many cases went wrong."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--runs", type=int, default=10_000)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=sorted(KINDS))
    asked = parser.parse_args()
    wrong = 0
    for name in [asked.only] if asked.only else KINDS:
        longest = 0.0
        with tempfile.TemporaryDirectory() as text:
            folder = Path(text)
            for number, content in cases(KINDS[name], folder, asked.seed, asked.runs):
                begin = time.perf_counter()
                bad = outcome(KINDS[name], content, folder)
                longest = max(longest, time.perf_counter() - begin)
                if not bad and time.perf_counter() - begin > LONGEST:
                    bad = f"took over {LONGEST:g} s"
                if bad:
                    wrong += 1
                    print(f"{name}, seed {asked.seed}, case {number}: {bad}", file=sys.stderr)
        memory = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
        if memory > MOST_MEMORY:
            wrong += 1
            print(f"{name}: {memory:.0f} MiB by now, over {MOST_MEMORY}", file=sys.stderr)
        print(f"{name}: {asked.runs} cases, longest {longest:.3f} s, {memory:.0f} MiB so far", flush=True)
    print(f"{wrong} went wrong")
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
