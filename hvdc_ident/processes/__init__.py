"""Every process that the package starts to work in: started, limited, watched and ended here, which says how it ended.

An FMU's workers, the workers of a pool and the reader of a file that may be damaged are forked from a process that has
loaded what they need (`Supervisor`). They end with their owner, even where that is killed.
"""

from hvdc_ident.processes.endings import MIB, Budget, Ending
from hvdc_ident.processes.messages import Message, packed, unpacked
from hvdc_ident.processes.supervisor import ChildProcess, Lost, Overdue, Supervisor, Watch, done_apart

__all__ = [
    "MIB",
    "Budget",
    "ChildProcess",
    "Ending",
    "Lost",
    "Message",
    "Overdue",
    "Supervisor",
    "Watch",
    "done_apart",
    "packed",
    "unpacked",
]
