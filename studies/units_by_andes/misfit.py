"""What the model leaves of the records whose .dyr has a wrong card or value, in units of the noise: the table of the README.

python studies/units_by_andes/misfit.py [UNIT ...]    # default: all of them; renews `misfit` in expected.json
"""

from __future__ import annotations

import json
import re
import sys
import tempfile
from pathlib import Path

import numpy as np

HERE = Path(__file__).resolve().parent
if str(HERE) not in sys.path:
    sys.path.insert(0, str(HERE))

from run import write_study  # noqa: E402
from units import CARDS, PLANTS, VALUES, Card, Plant  # noqa: E402

import hvdc_ident as hi  # noqa: E402
from hvdc_ident.fit import Problem, fit  # noqa: E402
from hvdc_ident.study.fitting import problem_of  # noqa: E402

WHITE, WRONG = 1.3, 3.0
"""Most that the plant's own model leaves of an output, and least that the vendor's leaves of one, for the record to tell what is wrong."""
COLUMNS = ("plant", "vendor", "fitted", "part")


def problem(name: str, dyr: str, part: str = "") -> Problem:
    """Return the fit of a unit's study with one of its .dyr files. part: a part whose gains and time constants are all fitted."""
    with tempfile.TemporaryDirectory() as folder:
        study = write_study(name, Path(folder) / name, dyr)
        if part:
            text = study.read_text(encoding="utf-8")
            study.write_text(re.sub(rf'(?m)^# ("{part}\.\w+" = {{min)', r"\1", text), encoding="utf-8")
        return problem_of(hi.load_study(study))


def misfit(asked: Problem, theta: np.ndarray) -> dict[str, float]:
    """Return the root mean square of the residuals by output, whitened by the noise of the inputs."""
    return {b.output: float(np.sqrt(np.mean(b.residual**2))) for b in asked.blocks(theta, derivatives=False)}


def least(asked: Problem) -> dict[str, float]:
    """Return the misfit with the best values of what is asked about."""
    found = fit(asked, starts=1, assess=False, misfit_expected=True)
    return misfit(asked, np.array([found.estimates[n].value for n in asked.names]))


def misfits(name: str) -> dict[str, dict[str, float]]:
    """Return what is left of a unit's outputs: with the plant's own .dyr; the vendor's; that with the best values of what the study asks
    about; and, where the vendor's .dyr has the part, with those of all gains and time constants of it.

    What is asked about and the plant has too is right in the vendor's .dyr: its values are the true ones.
    """
    true, vendor = (problem(name, f"{which}.dyr") for which in ("true", "plant"))
    found = {"plant": misfit(true, true.given), "vendor": misfit(vendor, vendor.given), "fitted": least(vendor)}
    part = wrong_part(PLANTS[name])
    return found | {"part": least(problem(name, "plant.dyr", part))} if part else found


def wrong_part(plant: Plant) -> str:
    """Return the part of the unit whose card or value is wrong; "" where the vendor's .dyr lacks it."""
    if isinstance(plant.hidden, Card):
        return plant.hidden.component if plant.hidden.stated else ""
    return plant.wrong.partition(".")[0]


def table(found: dict[str, dict[str, dict[str, float]]]) -> str:
    """Return the table of the README: P and Q."""
    rows = ["| unit | the plant's own | the vendor's | asked about fitted | part fitted |", "|---|---|---|---|---|"]
    for name, sizes in found.items():
        pairs = [", ".join(f"{sizes[w][o]:.2f}" for o in ("P", "Q")) if w in sizes else "" for w in COLUMNS]
        rows.append(f"| {name} | {' | '.join(pairs)} |")
    return "\n".join(rows) + "\n"


def main(names: list[str]) -> None:
    """Compute the figures of the named units, and write them beside the others."""
    expected = HERE / "expected.json"
    found = json.loads(expected.read_text(encoding="utf-8"))
    known = found.setdefault("misfit", {})
    for name in names or [*CARDS, *VALUES]:
        known[name] = misfits(name)
        told = max(known[name]["plant"].values()) <= WHITE and max(known[name]["vendor"].values()) >= WRONG
        print(name, "tells" if told else "does not tell", known[name], flush=True)
    found["misfit"] = {n: known[n] for n in (*CARDS, *VALUES) if n in known}
    expected.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
    print(table(found["misfit"]))


if __name__ == "__main__":
    main(sys.argv[1:])
