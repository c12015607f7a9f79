"""The parameters that matter over their whole ranges: a table of the screening's measures."""

from __future__ import annotations

from hvdc_ident.report.html import Section, rows_of, shown
from hvdc_ident.sensitivity import ScreeningResult
from hvdc_ident.summary import Results

COLUMNS = {
    "morris": {"mu_star": "mean size of the effect", "mu": "mean effect", "sigma": "spread of the effect"},
    "sobol": {"S1": "share by itself", "ST": "share with the others"},
}


def _render(results: Results) -> str:
    data = results.get("screening")
    if not data.get("measures"):
        return ""
    screening = ScreeningResult.from_dict(data)
    columns = COLUMNS[screening.method]
    rows = [
        (o, e, p, *(shown(m[n], 3) for n in columns))
        for o, e in screening.series
        for p, m in screening.of(o, e).items()
    ]
    method = "Morris' elementary effects" if screening.method == "morris" else "Sobol's indices"
    against = "the recordings" if data["against"] == "data" else "the model's own run"
    head = (
        f"<p>{method} of the RMSE against {against}, every parameter over its whole range; {screening.evaluations} runs, "
        f"{screening.failed} failed.</p>"
    )
    return head + rows_of(["output", "experiment", "parameter", *columns.values()], rows)


SECTION = Section(
    order=80,
    title="Global sensitivity",
    about="Which parameters matter over their whole ranges.",
    render=_render,
)
