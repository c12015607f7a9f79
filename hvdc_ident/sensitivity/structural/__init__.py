"""Structural identifiability: the parameters that outputs can tell at all, whatever the data's quality."""

from hvdc_ident.sensitivity.structural.combinations import Combination
from hvdc_ident.sensitivity.structural.local_identifiability import (
    StructuralResult,
    identifiable_subset,
    structural_identifiability,
)

__all__ = ["Combination", "StructuralResult", "identifiable_subset", "structural_identifiability"]
