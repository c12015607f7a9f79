"""Linearisation of a model at an operating point: A, B, C, D with exact derivatives, below and above a limit, and a check."""

from __future__ import annotations

from collections.abc import Sequence

from hvdc_ident.linearize.derivatives import Side
from hvdc_ident.linearize.equilibrium import PointOptions
from hvdc_ident.linearize.kinds import LinearOptions
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.operating_point import kind_of
from hvdc_ident.linearize.point import OperatingPoint
from hvdc_ident.model import AnyModel, Model


def linearize(
    model: AnyModel,
    point: OperatingPoint | None = None,
    *,
    inputs: Sequence[str] | str | None = None,
    outputs: Sequence[str] | str | None = None,
    pade_order: int | None = None,
    sensitivities: Sequence[str] = (),
    side: Side = "refuse",
    descriptor: bool = False,
) -> LinearModel:
    """Return the linear model between inputs and outputs (of outputs or named signals; default all) at an operating point.

    point: default, the steady state found from the model's values. pade_order: of every delay in the state space, 5 where
    none is given (the frequency response takes the delays exactly). sensitivities: parameters whose exact total derivatives of A, B, C, D
    come along, the shift of the operating point included. side: what to do where the point lies on a kink: "refuse",
    or the Jacobian "below" or "above" the limit. descriptor: keep the algebraic unknowns as states, with E.

    Raises UnknownNameError, and LinearizationError on a kink, for an ill-posed loop, Jacobian entries not finite, or an option
    that an FMU cannot answer: it shows neither delays nor limits nor algebraic unknowns.

    >>> from hvdc_ident import linearize, load_model
    >>> linear = linearize(load_model("vsc-hvdc-link"), inputs="Vdcref1", outputs="Irorder1")
    >>> linear.A.shape, linear.D.shape
    ((6, 6), (1, 1))
    >>> [round(mode.frequency_hz, 2) for mode in linear.modes() if mode.frequency_hz > 0.1]
    [4.87, 4.87]
    """
    inputs = [inputs] if isinstance(inputs, str) else inputs
    outputs = [outputs] if isinstance(outputs, str) else outputs
    kind = kind_of(model)
    at = kind.point(PointOptions()) if point is None else point
    return kind.linear(at, LinearOptions(inputs, outputs, pade_order, sensitivities, side, descriptor))


def one_sided(
    model: Model,
    point: OperatingPoint,
    *,
    inputs: Sequence[str] | None = None,
    outputs: Sequence[str] | None = None,
    pade_order: int | None = None,
    sensitivities: Sequence[str] = (),
    descriptor: bool = False,
) -> tuple[LinearModel, LinearModel]:
    """Return the linear models below and above the limit on which a point lies; equal where it lies on none.

    Parameters
    ----------
    model : Model
        The model.
    point : OperatingPoint
        Where it is linearised.
    inputs : list of str, default None
        Names of inputs. None: all.
    outputs : list of str, default None
        Names of outputs or signals. None: all outputs.
    pade_order : int, default None
        Order of the Pade approximant of every delay in the state space. None: 5. Frequency responses take delays exactly.
    sensitivities : list of str, default ()
        Parameters whose exact derivatives of A, B, C, D come along, the shift of the operating point included.
    descriptor : bool, default False
        True keeps the algebraic unknowns as states, with E.

    Returns
    -------
    tuple of LinearModel
        (below, above), in the model's units, time in s.

    Raises
    ------
    UnknownNameError
        A name that the model lacks.
    LinearizationError
        An algebraic loop is ill-posed, or an entry is not finite.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> limited = hi.Model("limited", inputs={"u": 1.0}, states={"x": "clip(u, -1, 1) - x"}, outputs={"y": "x"})
    >>> below, above = hi.linear.one_sided(limited, hi.find_operating_point(limited))
    >>> below.B.tolist(), above.B.tolist()
    ([[1.0]], [[0.0]])
    """

    def at(side: Side) -> LinearModel:
        return linearize(
            model,
            point,
            inputs=inputs,
            outputs=outputs,
            pade_order=pade_order,
            sensitivities=sensitivities,
            side=side,
            descriptor=descriptor,
        )

    return at("below"), at("above")


def jacobian_error(model: AnyModel, point: OperatingPoint, outputs: Sequence[str] | None = None) -> float:
    """Return the largest difference between the Jacobian and an independent one, relative to each row's largest entry.

    Of a model with equations that is one by complex steps; of an FMU one by central differences, or where differences are the
    Jacobian one by differences of another step.
    """
    return kind_of(model).jacobian_error(point, outputs)
