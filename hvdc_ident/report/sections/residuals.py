"""Section on the residuals: the share of the variance explained, whiteness, correlation with the inputs."""

from __future__ import annotations

from typing import Any

from hvdc_ident.report.html import Section, number, table, text
from hvdc_ident.summary import Results

LOW = 0.01
"""A p below this is marked."""


def _render(results: Results) -> str:
    fit = results.get("fit")
    tests = fit.get("residual_tests") or {}
    if not tests:
        return ""
    head = [
        "output",
        "experiment",
        "rows",
        "variance explained",
        "whiteness p",
        "runs p",
        "least p with an input",
        "which input",
    ]
    told = (
        f"<p class='small'>p: the chance of such a value from white noise (Ljung and Box; Wald and Wolfowitz; cross-"
        f"correlation with inputs, each filtered by itself). Below {LOW:g} it is marked: something is left over.</p>"
    )

    def tested(by_output: dict[str, Any], of: dict[str, Any]) -> str:
        rows = [_row(o, e, line, of) for o, by_name in by_output.items() for e, line in by_name.items()]
        return table(head, rows, words=(0, 1, 7))

    diagnosis = results.get("discrepancy")
    with_effect = diagnosis.get("residual_tests_after") or {}
    if not with_effect or results.summary.counting.name != "effect":
        return tested(tests, fit) + told
    return (
        f"<h3>With the effect, at the values that count</h3>{tested(with_effect, {})}"
        f"<h3>Fitted without it</h3>{tested(tests, fit)}{told}"
    )


def _row(output: str, experiment: str, line: dict[str, Any], fit: dict[str, Any]) -> list[str]:
    quality = ((((fit.get("goodness") or {}).get("outputs") or {}).get(output)) or {}).get(experiment) or {}
    inputs = {n: i.get("p") for n, i in (line.get("inputs") or {}).items() if i.get("p") is not None}
    least = min(inputs, key=lambda n: inputs[n], default=None)
    share = quality.get("r2")
    return [
        text(output),
        text(experiment),
        number(line.get("n")),
        f"{number(100.0 * share, 5 if share > 0.9 else 3)} %" if share is not None else "–",
        _p((line.get("ljung_box") or {}).get("p")),
        _p((line.get("runs") or {}).get("p")),
        _p(inputs[least]) if least is not None else "–",
        text(least or ""),
    ]


def _p(value: float | None) -> str:
    if value is None:
        return "–"
    shown = number(value, 2) if value > 0 else "&lt;10<sup>−300</sup>"
    return f"<strong>{shown}</strong>" if value < LOW else shown


SECTION = Section(
    order=65,
    title="Residual tests",
    about="For specialists: whether what the fitted model leaves is white noise.",
    render=_render,
)
