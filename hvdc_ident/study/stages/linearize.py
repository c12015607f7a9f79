"""The stage `linearize`: the operating point, the linear model and its modes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stage import Options, Outcome, Stage

if TYPE_CHECKING:
    from hvdc_ident.linearize import LinearModel
    from hvdc_ident.study.study import Study

CHECKS = {
    "symbolic": "complex step of 1e-30 through the equations, relative to each row's largest entry",
    "directional": "central differences of the FMU's derivatives, relative to each row's largest entry",
    "finite-difference": "two step sizes of central differences, relative to each row's largest entry",
}
MOST_DRAWN = 12
"""Channels up to which the frequency response is written too, for the report to draw."""


def run(study: Study, options: Options, earlier: Mapping[str, Any]) -> Outcome:
    """The operating point, A, B, C, D, the modes with their derivatives, and every transfer function asked for."""
    from hvdc_ident.linearize import jacobian_error
    from hvdc_ident.study.linear import analyses, modes_of

    model = linear_model(study)
    point = model.point
    assert point is not None
    options.progress(1, 3, "modes and transfer functions")
    functions = [model.transfer_function(i, o) for o in model.output_names for i in model.input_names]
    data = {
        **model.to_dict(),
        "operating_point": point.to_dict(),
        "modes": modes_of(study, model),
        "transfer_functions": [f.to_dict() for f in functions],
        "method": model.provenance["method"],
        "jacobian_error": jacobian_error(point.model, point, model.output_names),
        "jacobian_check": CHECKS[model.provenance["method"]],
    }
    if len(functions) <= MOST_DRAWN:
        data["frequency_response"] = model.bode().to_dict()
    options.progress(2, 3, "norms, margins, ports and comparisons")
    more, files = analyses(study, model)
    data |= more
    for key in ("schema", "kind", "model"):
        data.pop(key, None)
    return Outcome(data, files)


def linear_model(study: Study) -> LinearModel:
    """The linear model that a study's [linearize] asks for; without that table between all inputs and outputs."""
    from hvdc_ident.linearize import linearize
    from hvdc_ident.study.linear import operating_point

    asked = study.settings.linearize
    return linearize(
        study.model,
        operating_point(study),
        inputs=asked.inputs if asked else None,
        outputs=asked.outputs if asked else None,
        sensitivities=list(study.candidates),
    )


def told(data: Mapping[str, Any]) -> list[str]:
    """The operating point, the modes that oscillate, then margins, ports, comparison and reduction."""
    from hvdc_ident.study.linear import lines

    return lines(data)


STAGE = Stage(
    name="linearize",
    file="linearization.json",
    summary="The operating point, linear model, modes and transfer functions.",
    run=run,
    wanted=lambda study: study.settings.linearize is not None,
    order=20,
    tell=told,
)
