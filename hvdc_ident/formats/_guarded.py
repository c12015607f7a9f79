"""Guarded reading in a process of its own, for libraries that damaged files can hang or crash.

The HDF5 library believes what a file says of itself: some spoilt files end the process or never end. Here that costs
one error message. As a program: `python -m hvdc_ident.formats._guarded MODULE PATH` writes what it read to stdout.
"""

from __future__ import annotations

import importlib
import io
import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import numpy as np

from hvdc_ident.data import Origin, Trajectory
from hvdc_ident.errors import WaveformError
from hvdc_ident.formats._columns import damaged

START = 20.0  # s for a process to begin and a small file to be read
RATE = 5e6  # bytes a second, at least


def read_guarded(module: str, path: Path) -> Trajectory:
    """Return the result of `waveforms_unguarded(path)` of a module of this folder, run in a process of its own.

    Raises WaveformError: its own, or where the process ends or hangs.
    """
    deadline = START + path.stat().st_size / RATE
    command = [sys.executable, "-m", __name__, module, str(path.resolve())]
    try:
        done = subprocess.run(command, capture_output=True, timeout=deadline, check=False)
    except subprocess.TimeoutExpired:
        raise damaged(path, f"the file could not be read within {deadline:.0f} s") from None
    if done.returncode != 0:
        said = done.stderr.decode("utf-8", "replace").strip().splitlines()
        raise damaged(
            path, "reading the file ended the reader", got=said[-1][:200] if said else f"exit {done.returncode}"
        )
    stream = io.BytesIO(done.stdout)
    heading = json.loads(stream.readline())
    if "what" in heading:
        raise WaveformError(**{**heading, "where": str(path)})
    time, values = np.load(stream, allow_pickle=False), np.load(stream, allow_pickle=False)
    origin = Origin(**heading["origin"])
    return Trajectory(time, values, tuple(heading["names"]), tuple(heading["units"]), origin)


def _main(module: str, path: str) -> None:
    out = sys.stdout.buffer
    try:
        found = importlib.import_module(f"hvdc_ident.formats.{module}").waveforms_unguarded(Path(path))
    except WaveformError as error:
        said = {"what": error.what, "expected": error.expected, "got": error.got, "hint": error.hint}
        out.write(json.dumps(said).encode() + b"\n")
        return
    reply = io.BytesIO()  # numpy writes to a buffered file by its position, and a pipe has none
    heading = {"names": found.names, "units": found.units, "origin": asdict(found.origin)}
    reply.write(json.dumps(heading).encode() + b"\n")
    np.save(reply, found.time, allow_pickle=False)
    np.save(reply, found.values, allow_pickle=False)
    out.write(reply.getbuffer())


if __name__ == "__main__":
    _main(sys.argv[1], sys.argv[2])
