"""The stage `screen`: the candidates that matter over their whole ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stages import Stage, StageOptions, StageResult

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


def run(study: Study, options: StageOptions, earlier: Mapping[str, Any]) -> StageResult:
    """Morris' elementary effects or Sobol's indices of each output's RMSE in each experiment."""
    import math

    from hvdc_ident.errors import StudyError
    from hvdc_ident.sensitivity import morris, sobol
    from hvdc_ident.study.checks import need_candidates, need_experiments
    from hvdc_ident.study.pipeline import workers_of
    from hvdc_ident.study.schema import ScreeningTable

    need_experiments(study, "screen")
    need_candidates(study, "screen")
    asked = study.settings.screening or ScreeningTable()
    names = asked.parameters or list(study.candidates)
    ranges = {n: (study.candidates[n].min, study.candidates[n].max) for n in names}
    open_ended = [n for n, r in ranges.items() if not (math.isfinite(r[0]) and math.isfinite(r[1]))]
    if open_ended:
        raise StudyError(
            f"'{open_ended[0]}' has no range to be screened over",
            where=f"{study.path.name}, parameters.{open_ended[0]}",
            expected="min and max",
            hint=f"{open_ended[0]} = {{min = ..., max = ...}}, or leave it out of [screening] parameters",
        )
    with workers_of(study, options) as pool:
        common: dict[str, Any] = {
            "against": asked.against,
            "values": study.given,
            "seed": options.seed,
            "executor": pool,
            "progress": options.progress,
        }
        asked_for = (study.model, study.experiments, ranges)
        if asked.method == "morris":
            screening = morris(*asked_for, trajectories=asked.trajectories, **common)
        else:
            screening = sobol(*asked_for, samples=asked.samples, **common)
    data = {
        **screening.to_dict(),
        "against": asked.against,
        "ranges": {n: list(r) for n, r in ranges.items()},
        "units": {o: study.model.outputs[o].unit for o, _ in screening.series},
    }
    return StageResult(data)


def lines_of(data: Mapping[str, Any]) -> Sequence[str]:
    """The parameters of each output and experiment, the one that matters most first."""
    from hvdc_ident.sensitivity import ScreeningResult

    screening = ScreeningResult.from_dict(data)
    words = "mean effect" if screening.method == "morris" else "total share"
    lines = [f"{screening.evaluations} runs, {screening.failed} failed"]
    for output, experiment in screening.series:
        unit = f" {data['units'][output]}".rstrip() if screening.method == "morris" else ""
        each = ", ".join(f"{p} {m[screening.measure]:.3g}{unit}" for p, m in screening.of(output, experiment).items())
        lines.append(f"{output} in {experiment}, {words} on the RMSE: {each}")
    return lines


def verdict(data: Mapping[str, Any]) -> str:
    """Return the parameter that matters most to each output, by its mean over the experiments."""
    from hvdc_ident.sensitivity import ScreeningResult

    screening = ScreeningResult.from_dict(data)
    total = {
        o: {p: sum(m[p][screening.measure] for m in line.values()) for p in screening.parameters}
        for o, line in screening.measures.items()
    }
    return ", ".join(f"{max(each, key=lambda p: each[p])} moves {o} most" for o, each in total.items())


STAGE = Stage(
    name="screen",
    file="screening.json",
    summary="Rank the candidates by their effect over their whole ranges.",
    run=run,
    wanted=lambda study: study.settings.screening is not None,
    order=27,
    tell=lines_of,
    verdict=verdict,
)
