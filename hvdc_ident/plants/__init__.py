"""Plants of standard components: units at an infinite bus or at a recorded voltage, wired by the names of their signals."""

from hvdc_ident.plants.unit import Part, parts_of, unit_card

__all__ = ["Part", "parts_of", "unit_card"]
