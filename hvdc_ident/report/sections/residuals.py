"""Section on the residuals: the share of the variance explained, whiteness, correlation with the inputs."""

from __future__ import annotations

from typing import Any

from markupsafe import Markup

from hvdc_ident.fit.adequacy import ResidualTest, ResidualTests
from hvdc_ident.fit.result import Goodness
from hvdc_ident.report.html import Section, number, rows_of, typeset
from hvdc_ident.summary import Results
from hvdc_ident.text import figures

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
        return rows_of(head, (_row(o, e, line, of) for o, by_name in by_output.items() for e, line in by_name.items()))

    diagnosis = results.objects.diagnosis
    with_effect = {} if diagnosis is None else diagnosis.residual_tests_after
    if not with_effect or results.summary.counting.name != "effect":
        return tested(fit.residual_tests, fit.goodness) + told
    return (
        f"<h3>With the effect, at the values that count</h3>{tested(with_effect, Goodness())}"
        f"<h3>Fitted without it</h3>{tested(fit.residual_tests, fit.goodness)}{told}"
    )


def _row(output: str, experiment: str, line: ResidualTest, of: Goodness) -> tuple[Any, ...]:
    quality = of.outputs.get(output, {}).get(experiment)
    inputs = {n: i.p for n, i in line.inputs.items() if i.p is not None}
    least = min(inputs, key=lambda n: inputs[n], default=None)
    share = None if quality is None else quality.r2
    explained = f"{figures(100.0 * share, 5 if share > 0.9 else 3)} %" if share is not None else "–"
    tests = (line.ljung_box.p, line.runs.p, None if least is None else inputs[least])
    return output, experiment, line.n, explained, *map(_p, tests), least or ""


def _p(value: float | None) -> Markup:
    p = Markup(typeset("<1e-300") if value == 0.0 else number(value, 2))
    return Markup(f"<strong>{p}</strong>") if value is not None and value < LOW else p


SECTION = Section(
    order=65,
    title="Residual tests",
    about="For specialists: whether what the fitted model leaves is white noise.",
    render=_render,
)
