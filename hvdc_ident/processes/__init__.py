"""Workers, processes for work that may crash, hang or take too much memory: started, limited, watched and ended here.

They are forked from a process that has loaded what they need (`Supervisor`), end with their owner, even where that is
killed, and it is said how they ended. FMUs' machine code and the work of pools run in them.
"""

from hvdc_ident.processes.messages import Message, packed, unpacked
from hvdc_ident.processes.supervisor import MIB, Budget, ChildProcess, Ending, Supervisor, Watch

__all__ = ["MIB", "Budget", "ChildProcess", "Ending", "Message", "Supervisor", "Watch", "packed", "unpacked"]
