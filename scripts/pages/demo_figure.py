"""The figure of the landing page and the picture of the report's first screen, from the results of the demo.

hvdc-ident demo --out DIR && python scripts/pages/demo_figure.py DIR [CHROMIUM]     # writes docs/images/demo.svg and report.png
CHROMIUM: the browser's program, if it is not where playwright puts one.
"""

from __future__ import annotations

import csv
import json
import sys
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

import hvdc_ident as hi
from hvdc_ident.colours import EFFECT, FITTED, GIVEN, RECORDED
from pages.svg import HEIGHT, WIDTH, Curve, drawing

EXPERIMENT, OUTPUT = "vdc-03-step", "Irorder1"
WINDOW = (0.08, 0.3)  # s: the step and its recovery
TARGET = Path(__file__).resolve().parents[2] / "docs" / "images"
STYLE = (
    "<style>text{font:12px sans-serif;fill:#444}.frame{fill:none;stroke:#bbb}.grid{stroke:#eee}"
    f".curve{{fill:none;stroke-width:2}}.recorded{{stroke:{RECORDED}}}.given{{stroke:{GIVEN};stroke-dasharray:6 3}}"
    f".fitted{{stroke:{FITTED}}}.effect{{stroke:{EFFECT}}}</style>"
)


def _columns(path: Path) -> dict[str, Any]:
    with path.open(newline="", encoding="utf-8") as stream:
        rows = list(csv.reader(stream))
    table = np.array(rows[1:], float)
    return dict(zip(rows[0], table.T, strict=True))


def figure(folder: Path) -> str:
    """Return the SVG text: recorded, given, fitted and with the effect, and the errors of the latter three."""
    fitted, given = (_columns(folder / f"{kind}.{EXPERIMENT}.csv") for kind in ("fit", "simulation"))
    study = hi.load_study(folder / "study.toml")
    experiment = next(e for e in study.experiments if e.name == EXPERIMENT)
    found = json.loads((folder / "discrepancy.json").read_text("utf-8"))
    with_effect = hi.simulate(hi.load_model(folder / found["augmented_model"]), experiment)[OUTPUT]
    time, recorded = fitted["time"], fitted[f"{OUTPUT}.measured"]
    rows = (time >= WINDOW[0]) & (time <= WINDOW[1])
    runs = {"given gains": given[OUTPUT], "fitted gains": fitted[OUTPUT], "fitted, with the effect": with_effect}
    styles = dict(zip(runs, ("given", "fitted", "effect"), strict=True))
    above = [Curve("recorded", "recorded", 1e3 * time[rows], recorded[rows])]
    above += [Curve(n, styles[n], 1e3 * time[rows], v[rows]) for n, v in runs.items()]
    below = [Curve(n, styles[n], 1e3 * time[rows], 1e3 * (v - recorded)[rows]) for n, v in runs.items()]
    said = f"{OUTPUT} of the demo's held-out step {EXPERIMENT}"
    parts = [
        drawing(above, "time, ms", f"{OUTPUT}, pu", said).replace("<svg ", '<svg y="0" ', 1),
        drawing(below, "time, ms", "error, 0.001 pu", f"errors of {said}").replace("<svg ", f'<svg y="{HEIGHT}" ', 1),
    ]
    parts = [p.replace("<svg ", f'<svg width="{WIDTH}" height="{HEIGHT}" ', 1) for p in parts]
    head = f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {WIDTH} {2 * HEIGHT}" role="img" aria-label="{said}">'
    return f'{head}{STYLE}<rect width="100%" height="100%" fill="#fff"/>{"".join(parts)}</svg>\n'


def picture(folder: Path, to: Path, browser: str | None) -> None:
    """Write the first screen of the report, as a browser shows it, with 256 colours."""
    from io import BytesIO

    from PIL import Image
    from playwright.sync_api import sync_playwright

    with sync_playwright() as p:
        chromium = p.chromium.launch(executable_path=browser, args=["--no-sandbox"])
        page = chromium.new_page(viewport={"width": 1400, "height": 800})
        page.goto((folder / "report.html").resolve().as_uri())
        shown = Image.open(BytesIO(page.screenshot()))
        chromium.close()
    shown.convert("RGB").quantize(256, kmeans=1).save(to, optimize=True)


if __name__ == "__main__":
    TARGET.mkdir(exist_ok=True)
    (TARGET / "demo.svg").write_text(figure(Path(sys.argv[1])), "utf-8")
    picture(Path(sys.argv[1]), TARGET / "report.png", sys.argv[2] if len(sys.argv) > 2 else None)
