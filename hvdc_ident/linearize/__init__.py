"""Operating points, linear models, modes, frequency responses and margins, on exact derivatives."""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.linearize.distance import ModelDistance, NuGap, compare, gap, ncf_margin, nu_gap
    from hvdc_ident.linearize.frequency import FrequencyResponse, frequency_response
    from hvdc_ident.linearize.impedance import (
        MeasuredResponse,
        Port,
        port_admittance,
        port_impedance,
        response_at_tones,
        response_from_record,
        simulated_response,
    )
    from hvdc_ident.linearize.jacobian import jacobian_error, linearize, one_sided
    from hvdc_ident.linearize.linear_model import LinearModel
    from hvdc_ident.linearize.locus import RootLocus, root_locus
    from hvdc_ident.linearize.modal import Mode, TransferFunction
    from hvdc_ident.linearize.norms import h2_norm, hinf_norm, linf_norm
    from hvdc_ident.linearize.open_loop import Loop, loop, plant_and_controller
    from hvdc_ident.linearize.operating_point import OperatingPoint, continuation, find_operating_point, point_at
    from hvdc_ident.linearize.reduce import Reduction, balanced
    from hvdc_ident.linearize.response_file import ResponseFile, read_response
    from hvdc_ident.linearize.stability_margins import LoopMargins, Margins, loop_margins, margins
    from hvdc_ident.linearize.symbolic import symbolic_transfer
else:
    __getattr__ = offered(
        __name__,
        {
            "distance": "ModelDistance NuGap compare gap ncf_margin nu_gap",
            "frequency": "FrequencyResponse frequency_response",
            "impedance": "MeasuredResponse Port port_admittance port_impedance response_at_tones response_from_record "
            "simulated_response",
            "jacobian": "jacobian_error linearize one_sided",
            "linear_model": "LinearModel",
            "locus": "RootLocus root_locus",
            "modal": "Mode TransferFunction",
            "norms": "h2_norm hinf_norm linf_norm",
            "open_loop": "Loop loop plant_and_controller",
            "operating_point": "OperatingPoint continuation find_operating_point point_at",
            "reduce": "Reduction balanced",
            "response_file": "ResponseFile read_response",
            "stability_margins": "LoopMargins Margins loop_margins margins",
            "symbolic": "symbolic_transfer",
        },
    )

__all__ = [
    "FrequencyResponse",
    "LinearModel",
    "Loop",
    "LoopMargins",
    "Margins",
    "MeasuredResponse",
    "Mode",
    "ModelDistance",
    "NuGap",
    "OperatingPoint",
    "Port",
    "Reduction",
    "ResponseFile",
    "RootLocus",
    "TransferFunction",
    "balanced",
    "compare",
    "continuation",
    "find_operating_point",
    "frequency_response",
    "gap",
    "h2_norm",
    "hinf_norm",
    "jacobian_error",
    "linearize",
    "linf_norm",
    "loop",
    "loop_margins",
    "margins",
    "ncf_margin",
    "nu_gap",
    "one_sided",
    "plant_and_controller",
    "point_at",
    "port_admittance",
    "port_impedance",
    "read_response",
    "response_at_tones",
    "response_from_record",
    "root_locus",
    "simulated_response",
    "symbolic_transfer",
]
