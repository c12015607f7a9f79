"""Find where simulation and data disagree, name the missing effect, add it, show the gap shrink."""

from hvdc_ident.discrepancy.diagnosis import diagnose
from hvdc_ident.discrepancy.options import Options
from hvdc_ident.discrepancy.result import Diagnosis

__all__ = ["Diagnosis", "Options", "diagnose"]
