"""The stage `identify`: what the recordings tell about the candidates."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hvdc_ident.study.stage import Options, Outcome, Stage

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study

FEWEST_STARTS = 4
"""The pilot fit is a multistart of its own, however few starts the fit has."""


def run(study: Study, options: Options, earlier: Mapping[str, Any]) -> Outcome:
    """A verdict on each candidate with its evidence, the set a fit may use, and what to measure next."""
    from hvdc_ident.identifiability import identifiability
    from hvdc_ident.study.executor import processes
    from hvdc_ident.study.needs import need_candidates, need_experiments, need_start

    need_experiments(study, "identify", role="fit")
    need_candidates(study, "identify")
    need_start(study)
    starts = max(study.settings.fit.starts, FEWEST_STARTS) if study.settings.fit else 8
    pair = study.settings.identifiability.pair if study.settings.identifiability else None
    with processes(options.workers) as executor:
        report = identifiability(
            study.model,
            study.experiments,
            tuple(study.candidates.values()),
            starts=starts,
            seed=options.seed,
            executor=executor,
            progress=options.progress,
            pair=(pair[0], pair[1]) if pair else None,
        )
    bounds = {n: {"start": f.start, "min": f.min, "max": f.max} for n, f in study.candidates.items()}
    return Outcome({**report.to_dict(), "candidates": bounds})


STAGE = Stage(
    name="identify",
    file="identifiability.json",
    summary="What the recordings tell about the candidates.",
    run=run,
    wanted=lambda study: study.settings.identifiability is not None or study.settings.fit is not None,
    order=30,
)
