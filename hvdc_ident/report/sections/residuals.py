"""Section on the residuals: the share of the variance explained, whiteness, correlation with the inputs."""

from __future__ import annotations

from hvdc_ident.fit.adequacy import ResidualTest, ResidualTests
from hvdc_ident.fit.result import Goodness
from hvdc_ident.report.html import Section, number, table, text
from hvdc_ident.summary import Results

LOW = 0.01
"""A p below this is marked."""


def _render(results: Results) -> str:
    fit = results.objects.fit
    if fit is None or not fit.residual_tests:
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

    def tested(by_output: ResidualTests, of: Goodness) -> str:
        rows = [_row(o, e, line, of) for o, by_name in by_output.items() for e, line in by_name.items()]
        return table(head, rows, words=(0, 1, 7))

    diagnosis = results.objects.diagnosis
    with_effect = {} if diagnosis is None else diagnosis.residual_tests_after
    if not with_effect or results.summary.counting.name != "effect":
        return tested(fit.residual_tests, fit.goodness) + told
    return (
        f"<h3>With the effect, at the values that count</h3>{tested(with_effect, Goodness())}"
        f"<h3>Fitted without it</h3>{tested(fit.residual_tests, fit.goodness)}{told}"
    )


def _row(output: str, experiment: str, line: ResidualTest, of: Goodness) -> list[str]:
    quality = of.outputs.get(output, {}).get(experiment)
    inputs = {n: i.p for n, i in line.inputs.items() if i.p is not None}
    least = min(inputs, key=lambda n: inputs[n], default=None)
    share = None if quality is None else quality.r2
    return [
        text(output),
        text(experiment),
        number(line.n),
        f"{number(100.0 * share, 5 if share > 0.9 else 3)} %" if share is not None else "–",
        _p(line.ljung_box.p),
        _p(line.runs.p),
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
