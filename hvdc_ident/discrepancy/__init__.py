"""Find where simulation and data disagree, name the missing effect, add it, show the gap shrink."""

from hvdc_ident.discrepancy.diagnosis import diagnose
from hvdc_ident.discrepancy.findings.conclusion import Diagnosis
from hvdc_ident.discrepancy.options import DiagnosisOptions

__all__ = ["Diagnosis", "DiagnosisOptions", "diagnose"]
