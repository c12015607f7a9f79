"""What workers need, loaded once by the server that forks them: importing this is its whole work."""

import atexit
import importlib
import os

for _needed in (
    "pebble",
    "hvdc_ident.parallel.pool",
    "hvdc_ident.discrepancy",
):  # the last imports what nearly any work needs
    importlib.import_module(_needed)
# Who reads what a program prints waits for this process as well, and clearing its memory takes a second.
atexit.register(os._exit, 0)
