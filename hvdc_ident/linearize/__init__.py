"""Operating points, linear models, modes, frequency responses and margins, on exact derivatives."""

from typing import TYPE_CHECKING

from hvdc_ident.lazy import offered

if TYPE_CHECKING:
    from hvdc_ident.linearize.jacobian import jacobian_error, linearize, one_sided
    from hvdc_ident.linearize.linear_model import LinearModel
    from hvdc_ident.linearize.operating_point import OperatingPoint, continuation, find_operating_point, point_at
else:
    __getattr__ = offered(
        __name__,
        {
            "jacobian": "jacobian_error linearize one_sided",
            "linear_model": "LinearModel",
            "operating_point": "OperatingPoint continuation find_operating_point point_at",
        },
    )

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
