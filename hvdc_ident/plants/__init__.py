"""Plants of standard components: units at an infinite bus or at a recorded voltage, wired by the names of their signals."""

from hvdc_ident.model import shelf_model
from hvdc_ident.plants.exchange import CardChange, exchanges
from hvdc_ident.plants.places import block_signals
from hvdc_ident.plants.records import RecordedUnit, machine_records, recorded_unit, with_unit_values
from hvdc_ident.plants.unit import (
    AHEAD,
    LEVELS,
    MACHINE,
    SET_POINTS,
    STEP_UP,
    UNCONNECTED,
    UnitPart,
    idle_parts,
    part_name,
    parts_of,
    unit_card,
)

__all__ = [
    "AHEAD",
    "LEVELS",
    "MACHINE",
    "SET_POINTS",
    "STEP_UP",
    "UNCONNECTED",
    "CardChange",
    "RecordedUnit",
    "UnitPart",
    "block_signals",
    "exchanges",
    "idle_parts",
    "machine_records",
    "part_name",
    "parts_of",
    "recorded_unit",
    "shelf_model",
    "unit_card",
    "with_unit_values",
]
