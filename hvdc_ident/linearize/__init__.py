"""Operating points, linear models, modes, frequency responses and margins, on exact derivatives."""

from hvdc_ident.linearize.jacobian import jacobian_error, linearize, one_sided
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.operating_point import OperatingPoint, continuation, find_operating_point, point_at

__all__ = [
    "LinearModel",
    "OperatingPoint",
    "continuation",
    "find_operating_point",
    "jacobian_error",
    "linearize",
    "one_sided",
    "point_at",
]
