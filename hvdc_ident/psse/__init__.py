"""Files of PSS/E: dynamic data (.dyr), read and written back to the byte, and what a unit needs of a power flow (.raw)."""

from hvdc_ident.psse.dyr import DyrFile, DyrRecord, read_dyr
from hvdc_ident.psse.raw import RawFile, RawGenerator, read_raw

__all__ = ["DyrFile", "DyrRecord", "RawFile", "RawGenerator", "read_dyr", "read_raw"]
