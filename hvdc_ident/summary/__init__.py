"""The summary of a folder of results: everything that is decided about them, once, and the words and tables that tell it.

`summarise` decides; a `RunSummary` holds what was decided and is written as `summary.json`; `phrases` and `tables` are its views, from
which terminal, report, letter, notebook and workbench are made.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
