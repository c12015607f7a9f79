"""The tables stages write: waveforms side by side, fitted values as CSV and as SSP parameter values."""

from __future__ import annotations

import csv
import io
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any
from xml.sax.saxutils import quoteattr

import numpy as np

from hvdc_ident.data import Experiment, Trajectory
from hvdc_ident.files import csv_cell
from hvdc_ident.fit.residual import compared_rows

if TYPE_CHECKING:
    from hvdc_ident.fit.assessment import Curve
    from hvdc_ident.study.study import Study

SSV = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
SSC = "http://ssp-standard.org/SSP1/SystemStructureCommon"


def candidate_lines(study: Study) -> dict[str, dict[str, Any]]:
    """By candidate its given value, where the search begins, its bounds, where starts are drawn from, its unit."""
    return {
        n: {
            "given": f.given,
            "start": f.start,
            "min": f.min,
            "max": f.max,
            "searched": f.drawn,
            "unit": study.model.parameters[n].unit,
        }
        for n, f in study.candidates.items()
    }


def rmse(experiment: Experiment, simulated: Trajectory, output: str) -> float:
    """The root mean square of measured - simulated over the rows that are compared, in the output's unit.

    Raises StudyError where there is none.
    """
    rows = compared_rows(experiment, output)
    assert experiment.measured is not None
    difference = experiment.measured[output][rows] - simulated[output][rows]
    return float(np.sqrt(np.mean(difference**2)))


def comparison_csv(experiment: Experiment, simulated: Trajectory) -> str:
    """CSV text: time, then for each measured output the simulated column OUTPUT and the recorded OUTPUT.measured."""
    assert experiment.measured is not None
    header, columns = ["time"], [experiment.time]
    for output in experiment.outputs:
        header += [output, f"{output}.measured"]
        columns += [simulated[output], experiment.measured[output]]
    return csv_text(header, np.column_stack(columns).tolist())


def curves_csv(experiment: Experiment, curves: Mapping[str, Curve]) -> str:
    """CSV text: time, then for each measured output OUTPUT, OUTPUT.measured and the ends of the 95 % band of a sample.

    The columns OUTPUT.low and OUTPUT.high are left out where no estimate has a standard deviation.
    """
    header, columns = ["time"], [experiment.time]
    for output, c in curves.items():
        header += [output, f"{output}.measured"]
        columns += [c.model, c.measured]
        if c.band is not None:
            header += [f"{output}.low", f"{output}.high"]
            columns += [c.model - c.band, c.model + c.band]
    return csv_text(header, np.column_stack(columns).tolist())


def values_csv(
    values: Mapping[str, float], units: Mapping[str, str], estimates: Mapping[str, Any], held: Mapping[str, str]
) -> str:
    """CSV text with a row for each fitted or held parameter: value, unit, std, interval, and why it is held."""
    rows: list[list[Any]] = []
    for name, value in values.items():
        e = estimates.get(name) or {}
        low, high = e.get("ci95") or (None, None)
        rows.append([name, value, units.get(name, ""), e.get("std"), low, high, held.get(name, "")])
    return csv_text(["parameter", "value", "unit", "std", "ci95_low", "ci95_high", "held"], rows)


def ssv(values: Mapping[str, float], name: str, note: str = "") -> str:
    """The values as an SSP 1.0 parameter value file (.ssv). note: its description."""
    rows = "".join(
        f"    <ssv:Parameter name={quoteattr(n)}><ssv:Real value={quoteattr(repr(float(v)))}/></ssv:Parameter>\n"
        for n, v in values.items()
    )
    about = f" description={quoteattr(' '.join(note.split()))}" if note else ""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<ssv:ParameterSet xmlns:ssv="{SSV}" xmlns:ssc="{SSC}" version="1.0" name={quoteattr(name)}{about}>\n'
        f"  <ssv:Parameters>\n{rows}  </ssv:Parameters>\n</ssv:ParameterSet>\n"
    )


def csv_text(header: list[str], rows: list[list[Any]]) -> str:
    """CSV text, every number with all its digits, nothing for None and NaN, no text that a spreadsheet takes for a formula."""
    stream = io.StringIO()
    writer = csv.writer(stream, lineterminator="\n")
    writer.writerow([csv_cell(h) for h in header])
    writer.writerows([[_cell(v) for v in row] for row in rows])
    return stream.getvalue()


def _cell(value: Any) -> Any:
    if isinstance(value, str):
        return csv_cell(value)
    if value is None or value != value:  # None, or NaN: not recorded
        return ""
    return repr(value) if isinstance(value, float) else value
