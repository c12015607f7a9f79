"""The summary of a folder of results: everything that is decided about them, once, and the words and tables that tell it.

`summarise` decides; a `RunSummary` holds what was decided and is written as `summary.json`; `phrases` and `tables` are its views, from
which terminal, report, letter, notebook and workbench are made.
"""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.summary.decisions import summarise
    from hvdc_ident.summary.results import Results
    from hvdc_ident.summary.run_summary import RunSummary
else:
    __getattr__ = offered(__name__, {"results": "Results", "run_summary": "RunSummary", "decisions": "summarise"})

__all__ = ["Results", "RunSummary", "summarise"]
