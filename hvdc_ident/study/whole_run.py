"""A whole run of a study: every stage that it asks for, what the run did, and the report."""

from __future__ import annotations

from pathlib import Path

from hvdc_ident.report.page import write_report
from hvdc_ident.study.pipeline import Done, heading_of, run_all, write_run
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.study import Study


def run_study(study: Study, folder: Path, options: StageOptions) -> list[Done]:
    """Run every stage that the study asks for and return them, with `run.json` and the report written to the folder.

    Raises as `run_all`.
    """
    done = run_all(study, folder, options)
    write_run(folder, heading_of(study, options.seed), done)
    options.progress(0, 1, "report: writing the page")
    write_report(folder)
    return done
