"""FMUs made from sympy models."""

from hvdc_ident.fmu.export.fmu import FmuFile, export_fmu

__all__ = ["FmuFile", "export_fmu"]
