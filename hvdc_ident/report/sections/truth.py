"""The truth beside what was found, where the recordings were made by a model that is known (`hvdc-ident demo`)."""

from __future__ import annotations

from hvdc_ident.report.html import Section, table_of, text
from hvdc_ident.summary import Results
from hvdc_ident.summary.phrases import condition
from hvdc_ident.summary.truth import found_effect, true_effect, truth_table


def _render(results: Results) -> str:
    truth = results.get("truth")
    if not truth:
        return ""
    s = results.summary
    lead = f"<p>The recordings were made by {text(truth['plant'])}, so that the truth is known.</p>"
    after = any(p.effect is not None for p in s.parameters)
    told = f"<p class='small'>With the effect: {text(condition(s))}</p>" if after and condition(s) else ""
    missing = f"<p>Missing, found: {text(found_effect(s))}.</p><p>Missing, true: {text(true_effect(truth))}.</p>"
    about = (
        "<p class='small'>True delay: the phase between the open-loop transfers of both models at the frequency where that of the "
        "fitted one has the gain 1, over that frequency; from their linear models at the start values.</p>"
    )
    return lead + table_of(truth_table(s, truth["parameters"])) + told + missing + (about if truth["delays"] else "")


SECTION = Section(
    order=15,
    title="The truth",
    about="The values and delays that the recordings were made with, beside those found.",
    render=_render,
)
