from .decisions import summarise as summarise
from .results import Results as Results
from .run_summary import RunSummary as RunSummary
