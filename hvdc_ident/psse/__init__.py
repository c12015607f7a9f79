"""Files of PSS/E: dynamic data (.dyr) read and written back to the byte, the machines of power-flow data (.raw) of versions 24 to 36."""

from __future__ import annotations

from hvdc_ident.psse.dyr import DyrFile, DyrRecord, UserModel, read_dyr
from hvdc_ident.psse.raw import Bus, Generator, RawFile, read_raw

__all__ = [
    "Bus",
    "DyrFile",
    "DyrRecord",
    "Generator",
    "RawFile",
    "UserModel",
    "read_dyr",
    "read_raw",
]
