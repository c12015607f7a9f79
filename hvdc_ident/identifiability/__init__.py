"""What the data tell about the parameters, and the fit that obeys it."""

from hvdc_ident.identifiability.assess import identifiability
from hvdc_ident.identifiability.gate import Gate, gate, gated, gated_fit
from hvdc_ident.identifiability.groups import identifiability_by_group
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
