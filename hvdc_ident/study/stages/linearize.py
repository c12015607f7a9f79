"""The stage `linearize`: the operating point, the linear model and its modes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stages import Stage, StageOptions, StageResult

if TYPE_CHECKING:
    from hvdc_ident.linearize import LinearModel
    from hvdc_ident.linearize.modal import NamedMode
    from hvdc_ident.study.study import Study
    from hvdc_ident.study.value_sets import ValueSet

CHECKS = {
    "symbolic": "complex step of 1e-30 through the equations, relative to each row's largest entry",
    "directional": "central differences of the FMU's derivatives, relative to each row's largest entry",
    "finite-difference": "two step sizes of central differences, relative to each row's largest entry",
}


def run(study: Study, options: StageOptions, earlier: Mapping[str, Any]) -> StageResult:
    """The operating point, A, B, C, D, the modes with their derivatives, and every transfer function asked for.

    All of it at the given values, and under `fitted` at the fitted ones where they stand in the folder: of the model with the
    effect where a diagnosis named one.
    """
    from hvdc_ident.errors import HvdcIdentError
    from hvdc_ident.study.checks import at_given
    from hvdc_ident.study.value_sets import fitted_values, value_set
    from hvdc_ident.summary.linear import FittedLinear, Linearisation, LinearResult, NoLinearModel

    selected = value_set(study, "given")
    with at_given(study):
        model = linear_model(study, selected)
    fields, files = _described(study, model, selected, options)
    given = LinearResult(**fields)
    estimated, why = (None, "") if options.folder is None else fitted_values(study, options.folder)
    if estimated is None or why:
        return StageResult(Linearisation(given, None, why).to_dict(), files)
    fitted: FittedLinear | NoLinearModel
    try:
        fields, more = _described(study, linear_model(study, estimated), estimated, options, like=given.modes)
        fitted = FittedLinear(**fields, fit=estimated.fit, diagnosis=estimated.diagnosis)
        files |= {f"fitted.{name}": text for name, text in more.items()}
    except HvdcIdentError as e:  # the given model is the answer all the same
        message = f"no linear model: {e}"
        fitted = NoLinearModel(
            message, estimated.name, estimated.of, dict(estimated.values), estimated.fit, estimated.diagnosis
        )
    return StageResult(Linearisation(given, fitted, estimated.note).to_dict(), files)


def _described(
    study: Study, model: LinearModel, selected: ValueSet, options: StageOptions, like: Sequence[NamedMode] = ()
) -> tuple[dict[str, Any], dict[str, str]]:
    """The fields of the result on one linear model, and its files. like: modes of another one, in whose order its own are listed."""
    from hvdc_ident.linearize import jacobian_error
    from hvdc_ident.study.linear_analysis import MOST_CHANNELS, analyses, modes_of
    from hvdc_ident.study.measured_responses import compared

    study = with_model(study, selected)
    point = model.point
    assert point is not None
    options.progress(0, 1, "modes and transfer functions")
    functions = [model.transfer_function(i, o) for o in model.output_names for i in model.input_names]
    fields = {
        "linear": model,
        "values": selected.name,
        "set": selected.of,
        "parameters": dict(selected.values),
        "stable": point.stable,
        "stability": model.stability(),
        "branch": point.branch,
        "notes": tuple(point.notes),
        "modes": tuple(_ordered(modes_of(study, model), like)),
        "transfer_functions": tuple(functions),
        "method": model.provenance["method"],
        "jacobian_error": jacobian_error(study.model, point, model.output_names),
        "jacobian_check": CHECKS[model.provenance["method"]],
        "frequency_response": model.bode() if len(functions) <= MOST_CHANNELS else None,
    }
    options.progress(0, 1, "norms, margins, ports and comparisons")
    more, files = analyses(study, model)
    return {**fields, **more, "responses": tuple(compared(study, {selected.name: selected.values}))}, files


def _ordered(modes: list[NamedMode], like: Sequence[NamedMode]) -> list[NamedMode]:
    """The modes, each at the place of the nearest of the others (relative, all together); as they are where counts differ."""
    import numpy as np
    from scipy.optimize import linear_sum_assignment

    if len(modes) != len(like) or not modes:
        return modes
    eigenvalues, others = (np.array([m.mode.eigenvalue for m in some]) for some in (modes, like))
    size = np.maximum(np.maximum(np.abs(eigenvalues)[None, :], np.abs(others)[:, None]), np.finfo(float).tiny)
    return [modes[k] for k in linear_sum_assignment(np.abs(others[:, None] - eigenvalues[None, :]) / size)[1]]


def linear_model(study: Study, selected: ValueSet) -> LinearModel:
    """The linear model that a study's [linearize] asks for, at these values; without that table between all inputs and outputs.

    Of values that hold with an effect it is the linear model of the model with that effect.
    """
    from hvdc_ident.linearize import linearize
    from hvdc_ident.study.linear_analysis import operating_point

    asked, study = study.settings.linearize, with_model(study, selected)
    model = linearize(
        study.model,
        operating_point(study, selected.values),
        inputs=asked.inputs if asked else None,
        outputs=asked.outputs if asked else None,
        side=asked.side if asked else "refuse",
        sensitivities=list(study.candidates),
    )
    return replace(model, provenance=model.provenance | {"values": selected.note})


def with_model(study: Study, selected: ValueSet) -> Study:
    """The study with the model that the values hold in."""
    return study if selected.model is None else replace(study, model=selected.model)


def lines_of(data: Mapping[str, Any]) -> list[str]:
    """At which values the linear models stand; then of each the point, the oscillating modes, margins, ports and the rest."""
    from hvdc_ident.summary.linear import Linearisation, NoLinearModel
    from hvdc_ident.text import listed

    both = Linearisation.from_dict(data)
    model = both.given.linear
    ends = f"from {listed(model.input_names)} to {listed(model.output_names)}"
    lines = [f"{model.name}, linear model of {len(model.state_names)} states {ends}", "at the given values:"]
    lines += both.given.lines
    if both.at_fitted is not None:
        return [*lines, f"at the {both.fitted_note}:", *both.at_fitted.lines]
    why = both.why_none
    if isinstance(both.fitted, NoLinearModel):
        return [*lines, f"At the fitted values there is {why}."]
    lines += [f"There is no linear model at fitted values: {why}. `hvdc-ident fit STUDY` fits it."] if why else []
    return [*lines, "Next: `hvdc-ident export STUDY --to FILE.mat` (.json, .csv, .m) writes A, B, C and D."]


_AT = {
    "given": "at the given values",
    "start": "at the start values",
    "fit": "at the fitted values",
    "effect": "with the effect",
}


def verdict(data: Mapping[str, Any]) -> str:
    """Return the stability of the operating point at the values that count, and the least damped mode there."""
    from hvdc_ident.summary.linear import Linearisation

    both = Linearisation.from_dict(data)
    model = both.at_fitted or both.given
    least = next(
        (f"; least damped mode {m.mode.frequency_hz:.4g} Hz, {100 * m.mode.damping:.3g} %" for m in model.swinging), ""
    )
    return f"{_AT[model.set]}: {model.verdict or 'no states'}{least}"


STAGE = Stage(
    name="linearize",
    file="linearization.json",
    summary="Linearise the model; compute its modes and transfer functions.",
    run=run,
    wanted=lambda study: study.settings.linearize is not None or bool(study.responses),
    order=55,
    uses=("fit", "diagnose"),
    tell=lines_of,
    verdict=verdict,
)
