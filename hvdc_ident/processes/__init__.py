"""Workers, processes for work that may crash, hang or take too much memory: started, limited, watched and ended here.

They are forked from a process that has loaded what they need (`Supervisor`), end with their owner, even where that is
killed, and it is said how they ended. FMUs' machine code and the work of pools run in them.
"""

import os

from hvdc_ident.processes.messages import Message, packed, unpacked
from hvdc_ident.processes.supervisor import MIB, Budget, ChildProcess, Ending, Supervisor, Watch

__all__ = [
    "MIB",
    "Budget",
    "ChildProcess",
    "Ending",
    "Message",
    "Supervisor",
    "Watch",
    "available_cores",
    "packed",
    "unpacked",
]


def available_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
