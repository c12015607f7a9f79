"""Comparison with other packages: the same model, data and machine, in one run; the figures are ratios.

    python benchmarks/peers.py                     (needs the extra `bench`; writes its table into README.md of this folder)
    python benchmarks/peers.py --only simulation sensitivities linearisation fit profile     (prints)

The model is the smooth link (lags on currents, measurements and the dc line: 15 states, no fast mode), because every package
can integrate it; engine.py compares the stiff link with CasADi. The packages get our compiled right-hand side and our initial
state, so that the methods are compared and not an interpreter; CasADi, libroadrunner and AMICI generate their own machine
code. Where a package gets better code than its users would write, the ratio is in its favour. A package with a different
result stops the run; one that is not installed is named and left out. Times are processor time, the least of several runs.
"""

from __future__ import annotations

import argparse
import datetime
import os
import platform
import sys
import time
from importlib import metadata
from pathlib import Path

from against import fit, linearisation, profile, simulation

from hvdc_ident.files import write_text

GROUPS = {
    "simulation": simulation.simulation,
    "sensitivities": simulation.derivatives,
    "linearisation": linearisation.linearisation,
    "fit": fit.fits,
    "profile": profile.profiling,
}
PEERS = (
    "scipy",
    "scikit-sundae",
    "libroadrunner",
    "amici",
    "casadi",
    "control",
    "lmfit",
    "fmpy",
    "pypesto",
    "numba",
    "numpy",
)
README = Path(__file__).with_name("README.md")
BEGIN, END = "<!-- peers: written by peers.py -->", "<!-- peers: end -->"
HEAD = "| what | peer | here, ms | there, ms | there / here | |\n|---|---|---|---|---|---|"


def machine() -> str:
    """Return the processor, its cores, their load, and the system, as text."""
    names = [line.split(":", 1)[1].strip() for line in _text("/proc/cpuinfo") if line.startswith("model name")]
    load = ", ".join(f"{v:.1f}" for v in os.getloadavg()) if hasattr(os, "getloadavg") else "not known"
    return (
        f"{names[0] if names else platform.processor()}, {os.cpu_count()} cores, load {load} (1, 5, 15 min), "
        f"{platform.system()}, Python {platform.python_version()}"
    )


def _text(path: str) -> list[str]:
    return Path(path).read_text().splitlines() if Path(path).exists() else []


def versions() -> str:
    """Return the installed packages with their versions, as text."""
    found = {d.metadata["Name"].lower(): d.version for d in metadata.distributions() if d.metadata["Name"]}
    return ", ".join(f"{name} {found[name]}" for name in PEERS if name in found)


def pinned(readme: str, text: str) -> str:
    """Return the README with the text between its two marks. Raises ValueError where a mark is missing."""
    begin, end = readme.index(BEGIN) + len(BEGIN), readme.index(END)
    return f"{readme[:begin]}\n{text}\n{readme[end:]}"


def main() -> None:
    """Prints the table; the whole table is put into the readme as well."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=tuple(GROUPS))
    asked = parser.parse_args().only
    before, begin = machine(), time.process_time()
    print(HEAD, flush=True)
    lines = [HEAD]
    for name in asked or GROUPS:
        for line in GROUPS[name]():
            lines.append(str(line))
            print(line, flush=True)
    spent = time.process_time() - begin
    about = f"{datetime.datetime.now(datetime.UTC):%Y-%m-%d}; {before}; {versions()}; {spent:.0f} s of processor time."
    print(about, file=sys.stderr)
    if asked is None:
        table = "\n".join(lines)
        write_text(README, pinned(README.read_text("utf-8"), f"{about}\n\n{table}"))


if __name__ == "__main__":
    main()
