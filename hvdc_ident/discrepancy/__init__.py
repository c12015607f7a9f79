"""Find where simulation and data disagree, name the missing effect, add it, show the gap shrink."""

from hvdc_ident.discrepancy.diagnosis import diagnose
from hvdc_ident.discrepancy.findings.result import Diagnosis
from hvdc_ident.discrepancy.options import Options

__all__ = ["Diagnosis", "Options", "diagnose"]
