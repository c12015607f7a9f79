"""Files of PSS/E, versions 32 to 36: dynamic data (.dyr) read and written back to the byte, power-flow data (.raw) read."""

from __future__ import annotations

from hvdc_ident.psse.dyr import DyrFile, DyrRecord, UserModel, read_dyr
from hvdc_ident.psse.raw import Branch, Bus, Generator, Load, RawFile, Transformer, read_raw

__all__ = [
    "Branch",
    "Bus",
    "DyrFile",
    "DyrRecord",
    "Generator",
    "Load",
    "RawFile",
    "Transformer",
    "UserModel",
    "read_dyr",
    "read_raw",
]
