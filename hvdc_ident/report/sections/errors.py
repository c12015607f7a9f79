"""The table of RMSE before and after the fit, by output and experiment."""

from __future__ import annotations

from hvdc_ident.report.html import number, share, table, text
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section


def _render(results: Results) -> str:
    fit, simulation = results.get("fit"), results.get("simulation")
    after = fit.get("rmse") or {}
    before = fit.get("rmse_start") or simulation.get("rmse") or {}
    if not before and not after:
        return ""
    roles = {**(simulation.get("experiments") or {}), **(fit.get("experiments") or {})}
    units = {**(simulation.get("units") or {}), **(fit.get("units") or {})}
    rows = []
    for output, line in (after or before).items():
        for name in line:
            b, a = (before.get(output) or {}).get(name), (after.get(output) or {}).get(name)
            noise = (((fit.get("noise") or {}).get(name) or {}).get(output) or {}).get("std")
            role = "held out" if (roles.get(name) or {}).get("role") == "holdout" else "fit"
            rows.append(
                [
                    text(output),
                    text(name),
                    role,
                    number(b, 3),
                    number(a, 3),
                    share(a, b),
                    number(noise, 2),
                    text(units.get(output, "")),
                ]
            )
    header = ["output", "experiment", "role", "RMSE before", "RMSE after", "change", "noise", "unit"]
    failed = [(n, e) for n, e in roles.items() if e.get("status") == "failed"]
    told = "".join(
        f"<p>Experiment <strong>{text(n)}</strong> could not be simulated: {text(e.get('reason', ''))}</p>"
        for n, e in failed
    )
    return table(header, rows, words=(0, 1, 2, 7)) + told


SECTION = Section(order=30, title="Error before and after", render=_render)
