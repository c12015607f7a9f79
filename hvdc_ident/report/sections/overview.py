"""The first lines of the page: what was asked and what came out, in sentences."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.html import number, text
from hvdc_ident.report.results import Results
from hvdc_ident.report.section import Section


def _render(results: Results) -> str:
    heading, fit, simulation = results.heading, results.get("fit"), results.get("simulation")
    experiments = {**(simulation.get("experiments") or {}), **(fit.get("experiments") or {})}
    held_out = sum(1 for e in experiments.values() if e.get("role") == "holdout")
    lines = [f"Model <strong>{text(heading.get('model', ''))}</strong>"]
    if experiments:
        kept = f", {held_out} of them held out" if held_out else ""
        lines[0] += f" against {_count(len(experiments), 'experiment')}{kept}"
    lines[0] += "."
    fitted = fit.get("fitted") or []
    if fitted and fit.get("status") != "failed":
        lines.append(f"{_count(len(fitted), 'parameter')} estimated: {text(', '.join(map(str, fitted)))}.")
        ratios = _ratios(fit)
        if ratios:
            low, high = min(ratios), max(ratios)
            lines.append(
                f"After the fit the RMSE is {number(100 * low, 3)} to {number(100 * high, 3)} % of what it was before."
            )
    if fit.get("chi2_per_dof") is not None and not any(
        "misfit" in str(s) for s in (fit.get("noise_source") or {}).values()
    ):
        chi = fit["chi2_per_dof"]
        verdict = (
            "the model explains the recordings down to their noise"
            if chi < 1.5
            else "more than noise is left over: the model lacks something"
        )
        lines.append(f"χ² per degree of freedom {number(chi, 3)}: {verdict}.")
    failed = (results.get("run").get("stages")) or {}
    lines += [f"<strong>{text(n)} failed</strong>: {text(s['failed'])}." for n, s in failed.items() if s.get("failed")]
    for name, data in results.stages.items():
        if data.get("sources") != heading.get("sources"):
            lines.append(f"{text(name)}.json comes from an earlier state of the study: run it again.")
    return "".join(f"<p>{line}</p>" for line in lines)


def _count(n: int, word: str) -> str:
    return f"{n} {word}{'' if n == 1 else 's'}"


def _ratios(fit: dict[str, Any]) -> list[float]:
    """RMSE after over before for each output and experiment that the fit used and that moved at all."""
    before, found = fit.get("rmse_start") or {}, []
    for output, line in (fit.get("rmse") or {}).items():
        for name, after in line.items():
            first = (before.get(output) or {}).get(name)
            if first and after is not None:
                found.append(after / first)
    return found


SECTION = Section(order=10, title="Summary", render=_render)
