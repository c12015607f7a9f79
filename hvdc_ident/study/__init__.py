"""The study: one TOML file that says which model, which data and which questions; and the stages that answer them."""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.study.comparison import RunComparison, compare_runs
    from hvdc_ident.study.examples import (
        Campaign,
        Noise,
        experiments,
        recorded,
        write_demo,
        write_starter,
        write_waveforms,
    )
    from hvdc_ident.study.executors import LocalPool, open_executor
    from hvdc_ident.study.fitting import problem_of
    from hvdc_ident.study.new_study import NewStudy, new_study
    from hvdc_ident.study.pipeline import run_all, run_stage
    from hvdc_ident.study.stages import Stage, StageOptions, StageResult
    from hvdc_ident.study.study import Study, load_study
    from hvdc_ident.study.summary import Summary
else:
    __getattr__ = offered(
        __name__,
        {
            "comparison": "RunComparison compare_runs",
            "examples": "Campaign Noise experiments recorded write_demo write_starter write_waveforms",
            "executors": "LocalPool open_executor",
            "fitting": "problem_of",
            "new_study": "NewStudy new_study",
            "pipeline": "run_all run_stage",
            "stages": "Stage StageOptions StageResult",
            "study": "Study load_study",
            "summary": "Summary",
        },
    )

__all__ = [
    "Campaign",
    "LocalPool",
    "NewStudy",
    "Noise",
    "RunComparison",
    "Stage",
    "StageOptions",
    "StageResult",
    "Study",
    "Summary",
    "compare_runs",
    "experiments",
    "load_study",
    "new_study",
    "open_executor",
    "problem_of",
    "recorded",
    "run_all",
    "run_stage",
    "write_demo",
    "write_starter",
    "write_waveforms",
]
