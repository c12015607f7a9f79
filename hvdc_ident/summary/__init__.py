"""The summary of a folder of results: everything that is decided about them, once, and the words and tables that tell it.

`summarise` decides; a `RunSummary` holds what was decided and is written as `summary.json`; `phrases` and `tables` are its views, from
which terminal, report, letter, notebook and workbench are made.
"""

from hvdc_ident.summary.results import Results
from hvdc_ident.summary.run_summary import RunSummary
from hvdc_ident.summary.summarise import summarise

__all__ = ["Results", "RunSummary", "summarise"]
