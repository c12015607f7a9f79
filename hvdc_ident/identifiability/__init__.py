"""Identifiability of parameters from given data, the next experiment to make, and the fit of the identifiable set alone."""

from hvdc_ident.identifiability.assess import identifiability, identifiability_by_group
from hvdc_ident.identifiability.gate import Gate, gate, gated, gated_fit
from hvdc_ident.identifiability.report import IdentifiabilityReport
from hvdc_ident.identifiability.verdicts import Verdict

__all__ = [
    "Gate",
    "IdentifiabilityReport",
    "Verdict",
    "gate",
    "gated",
    "gated_fit",
    "identifiability",
    "identifiability_by_group",
]
