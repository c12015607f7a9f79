"""Operating points, linear models, modes, frequency responses and margins, on exact derivatives."""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.linearize.derivatives import Side
    from hvdc_ident.linearize.distance import ModelDistance, NuGap, compare, ncf_margin, nu_gap
    from hvdc_ident.linearize.formula import symbolic_transfer
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
    from hvdc_ident.linearize.linear_model import LinearModel
    from hvdc_ident.linearize.linearisation import jacobian_error, linearize, one_sided
    from hvdc_ident.linearize.loops import (
        Loop,
        LoopMargins,
        Margins,
        loop,
        loop_margins,
        margins,
        plant_and_controller,
    )
    from hvdc_ident.linearize.modal import named, named_modes, parts_of
    from hvdc_ident.linearize.mode import Mode
    from hvdc_ident.linearize.norms import h2_norm, hinf_norm, linf_norm
    from hvdc_ident.linearize.operating_point import continuation, find_operating_point, point_at
    from hvdc_ident.linearize.point import OperatingPoint
    from hvdc_ident.linearize.reduction import Reduction, balanced
    from hvdc_ident.linearize.response_file import ResponseFile, read_response
    from hvdc_ident.linearize.root_loci import RootLocus, root_locus
    from hvdc_ident.linearize.transfer_function import TransferFunction
else:
    __getattr__ = offered(
        __name__,
        {
            "distance": "ModelDistance NuGap compare ncf_margin nu_gap",
            "frequency": "FrequencyResponse frequency_response",
            "impedance": "MeasuredResponse Port port_admittance port_impedance response_at_tones response_from_record "
            "simulated_response",
            "derivatives": "Side",
            "formula": "symbolic_transfer",
            "linearisation": "jacobian_error linearize one_sided",
            "linear_model": "LinearModel",
            "loops": "Loop LoopMargins Margins loop loop_margins margins plant_and_controller",
            "mode": "Mode",
            "modal": "named named_modes parts_of",
            "point": "OperatingPoint",
            "operating_point": "continuation find_operating_point point_at",
            "norms": "h2_norm hinf_norm linf_norm",
            "reduction": "Reduction balanced",
            "response_file": "ResponseFile read_response",
            "root_loci": "RootLocus root_locus",
            "transfer_function": "TransferFunction",
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
    "Side",
    "TransferFunction",
    "balanced",
    "compare",
    "continuation",
    "find_operating_point",
    "frequency_response",
    "h2_norm",
    "hinf_norm",
    "jacobian_error",
    "linearize",
    "linf_norm",
    "loop",
    "loop_margins",
    "margins",
    "named",
    "named_modes",
    "ncf_margin",
    "nu_gap",
    "one_sided",
    "parts_of",
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
