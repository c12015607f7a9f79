"""Search for operating points: any state, unknown, input, output or parameter fixed, free or bounded; exact Jacobians; trim."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

import numpy as np

from hvdc_ident.errors import SteadyStateError, require_known, unknown_name
from hvdc_ident.linearize.equilibrium import At, PointOptions
from hvdc_ident.linearize.jacobian import EquationModel
from hvdc_ident.linearize.kinds import Kind, LinearOptions
from hvdc_ident.linearize.point import OperatingPoint
from hvdc_ident.linearize.system import Array, system
from hvdc_ident.model import AnyModel, Model, is_white_box

Bounds = Mapping[str, tuple[float, float]]


def kind_of(model: AnyModel) -> Kind:
    """Return what finds a model's points and linearises it there. Raises ModelError for one that shows no derivatives."""
    if is_white_box(model):
        return EquationModel(model)
    from hvdc_ident.linearize.fmu_linear import LinearFmu

    return LinearFmu.of(model)


def find_operating_point(
    model: AnyModel,
    fixed: Mapping[str, float] | None = None,
    free: Collection[str] = (),
    bounds: Bounds | None = None,
    guess: Mapping[str, float] | None = None,
    *,
    inputs: Mapping[str, float] | None = None,
    outputs: Mapping[str, float] | None = None,
    at: At = "steady",
    moving: Collection[str] = (),
    time: float = 0.0,
) -> OperatingPoint:
    """Return the operating point at which every derivative is 0 and the fixed values hold.

    With inputs and parameters alone it is the steady state that a simulation starts from.

    fixed: values of inputs, parameters, states, unknowns, signals or outputs. free: inputs and parameters to be found.
    inputs: values of inputs. outputs: values that outputs are to have (a trimmed point); where nothing is free the inputs
    that move these outputs at rest are, if they are as many.
    bounds: (low, high) of anything but a fixed name. guess: where the search begins. moving: states whose derivative
    need not be 0. at="start": states with a given start stand there instead, and only the rest is solved.
    All in the model's units; an input that is not named keeps the model's value.

    Raises UnknownNameError for a name the model lacks; SteadyStateError, with the worst equation, where there is none.

    >>> from hvdc_ident import find_operating_point, load_model
    >>> rest = find_operating_point(load_model("vsc-hvdc-link"), {"Pref2": 0.5})
    >>> round(rest.outputs["P2"], 9), round(rest.outputs["Irorder1"], 3)
    (0.5, -0.5)
    >>> trimmed = find_operating_point(load_model("vsc-hvdc-link"), outputs={"P2": 0.6})
    >>> round(trimmed.inputs["Pref2"], 9)
    0.6
    """
    if inputs or outputs:
        require_known("input", inputs or {}, model.inputs, f"operating point of model '{model.name}'")
        fixed = {**(fixed or {}), **(inputs or {})}
        if outputs and not free:
            base = find_operating_point(model, fixed, (), bounds, guess, at=at, moving=moving, time=time)
            free = freed_inputs(model, base, outputs, fixed)
            guess = {**base.states, **base.unknowns, **base.extras, **(guess or {})}
        fixed = {**fixed, **(outputs or {})}
    return kind_of(model).point(PointOptions(fixed or {}, free, bounds or {}, guess or {}, at, moving, time))


def point_at(
    model: AnyModel,
    states: Mapping[str, float],
    inputs: Mapping[str, float] | None = None,
    parameters: Mapping[str, float] | None = None,
    *,
    time: float = 0.0,
) -> OperatingPoint:
    """Return the operating point at given states, which need not be at rest; unknowns are solved for.

    Parameters
    ----------
    model : Model
        The model, or an FMU.
    states : dict of float
        The value of every state by name, in the model's units.
    inputs : dict of float, default None
        Values of inputs by name, in the model's units. An input that is not named keeps the model's value.
    parameters : dict of float, default None
        Values of parameters by name, in the model's units, where they differ from the model's.
    time : float, default 0.0
        The instant, s.

    Returns
    -------
    OperatingPoint
        The values of states, unknowns, inputs, outputs and parameters by name, in the model's units.

    Raises
    ------
    UnknownNameError
        A name that is not a state, input or parameter, or a state left out.
    SteadyStateError
        The unknowns have no solution.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 0.5, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> hi.linear.point_at(lag, {"x": 0.7}, {"u": 1.0}).outputs["y"]  # on the way to 2
    0.7
    """
    missing = [n for n in model.states if n not in states]
    if missing:
        raise unknown_name("value given for state", missing[0], list(states), where=f"model '{model.name}'")
    fixed = {**(inputs or {}), **(parameters or {}), **states}
    return find_operating_point(model, fixed, moving=tuple(model.states), time=time)


def continuation(
    model: AnyModel, name: str, values: Sequence[float], fixed: Mapping[str, float] | None = None
) -> tuple[OperatingPoint, ...]:
    """Return the operating points along values of one parameter or input, each searched from the one before.

    A step that fails is halved up to ten times on the way.

    Parameters
    ----------
    model : Model
        The model, or an FMU.
    name : str
        The parameter or input that moves.
    values : list of float
        Its values, in its unit, in the order in which they are gone through.
    fixed : dict of float, default None
        Values of other parameters and inputs (or of states and signals that are to hold), in the model's units.

    Returns
    -------
    tuple of OperatingPoint
        One for each value.

    Raises
    ------
    UnknownNameError
        A name that the model lacks.
    SteadyStateError
        There is no operating point at a value; the error names the last value reached.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> points = hi.linear.continuation(hi.load_model("vsc-hvdc-link"), "Pref2", [0.2, 0.4, 0.6])
    >>> [round(point.outputs["P2"], 9) for point in points]
    [0.2, 0.4, 0.6]
    """
    if name not in model.parameters and name not in model.inputs:
        raise unknown_name("parameter or input", name, (*model.parameters, *model.inputs), where="continuation")
    points: list[OperatingPoint] = []
    guess: dict[str, float] = {}
    last: float | None = None
    for value in values:
        point = _step_to(model, name, last, float(value), {**(fixed or {})}, guess, 0)
        points.append(point)
        guess = {**point.states, **point.unknowns, **point.extras}
        last = float(value)
    return tuple(points)


def _step_to(
    model: AnyModel,
    name: str,
    last: float | None,
    value: float,
    fixed: dict[str, float],
    guess: dict[str, float],
    depth: int,
) -> OperatingPoint:
    try:
        return find_operating_point(model, {**fixed, name: value}, guess=guess)
    except SteadyStateError as e:
        if last is None or depth == 10:
            reached = f", reached {last:g}" if last is not None else ""
            raise e.at(f"continuation along '{name}' at {value:g}{reached}") from None
        half = _step_to(model, name, last, 0.5 * (last + value), fixed, guess, depth + 1)
        return _step_to(
            model, name, 0.5 * (last + value), value, fixed, {**half.states, **half.unknowns, **half.extras}, depth + 1
        )


def signal_values(model: Model, point: OperatingPoint, names: Sequence[str]) -> dict[str, float]:
    """Return the values of any names at an operating point."""
    known = {**point.states, **point.unknowns, **point.extras, **point.inputs, **point.parameters}
    asked = tuple(n for n in names if n not in known)
    values = {n: float(known[n]) for n in names if n in known}
    if asked:
        s = system(model, asked)
        shown = s.values(point.y, point.w, point.p, s.modes(point.y, point.w, point.p))[s.layout.n + s.layout.ne :]
        values |= {n: float(v) for n, v in zip(s.outputs, shown, strict=False)}
    return values


# --- trim: inputs that are set so that outputs have given values ---


DEPENDENT = 1e-8
"""Share of its length that is left of an output's row of gains, below which it follows from other outputs': gains are sums
of products that rounding changes by 1e-16 of their terms, and these may be a hundred million times what is left."""
NEGLIGIBLE = 1e-9
"""Share of the largest gain below which an input is taken for without effect: it would have to move a billion times as far
as the other one, in their units, and rounding leaves about 1e-16."""


def freed_inputs(model: AnyModel, point: OperatingPoint, outputs: Collection[str], held: Collection[str]) -> list[str]:
    """Return the inputs that set some outputs at rest, where these are as many as the outputs; else SteadyStateError.

    point: where the dc gains are taken. held: inputs that stay. An input counts where its gain on one of the outputs
    is above NEGLIGIBLE of the largest that an input has on it.
    """
    gains = _dc_gains(model, point, outputs)
    names = [n for n in model.inputs if n not in held]
    columns = [list(model.inputs).index(n) for n in names]
    _independent(model, list(outputs), gains[:, columns])
    sizes = np.abs(gains[:, columns])
    effective = sizes > NEGLIGIBLE * sizes.max(axis=1, initial=0.0)[:, None]
    moving = [n for n, hit in zip(names, effective.any(axis=0), strict=True) if hit]
    if len(moving) == len(outputs):
        return moving
    listed = "; ".join(
        f"{n} moves {', '.join(f'{o} by {gains[i, k]:.3g}' for i, o in enumerate(outputs) if effective[i, j])}"
        for j, (n, k) in enumerate(zip(names, columns, strict=True))
        if n in moving
    )
    first = [moving[k] for k in np.argsort([-sizes[:, names.index(n)].max() for n in moving], kind="stable")]
    raise SteadyStateError(
        f"which inputs are to set {', '.join(outputs)}?",
        where=f"operating point of model '{model.name}'",
        expected=f"{len(outputs)} input{'s' if len(outputs) > 1 else ''} that can",
        got=listed or "no input moves them at rest",
        hint=f"name them: free={first[: len(outputs)]!r}" if moving else "free a parameter: free=[...]",
    )


def _independent(model: AnyModel, outputs: list[str], gains: Array) -> None:
    """Raise SteadyStateError where outputs move together at rest, so that no inputs give all of them values of their own.

    gains: (outputs, inputs). Each row is compared with what the rows before it make of it (modified Gram-Schmidt, with
    the inputs as they are).
    """
    lengths = np.linalg.norm(gains, axis=1)
    chosen: list[int] = []
    for i in (k for k in range(len(outputs)) if lengths[k] > 0.0):
        others = gains[chosen] / lengths[chosen, None]
        row = gains[i] / lengths[i]
        share = np.linalg.lstsq(others.T, row, rcond=DEPENDENT)[0] if chosen else np.zeros(0)
        if np.linalg.norm(row - share @ others) > DEPENDENT:
            chosen.append(i)
            continue
        parts = [
            (chosen[k], share[k] * lengths[i] / lengths[chosen[k]])
            for k in range(len(chosen))
            if abs(share[k]) > DEPENDENT
        ]
        rule = " + ".join(f"{factor:.4g} d({outputs[k]})" for k, factor in parts).replace("+ -", "- ")
        names = [outputs[i], *(outputs[k] for k, _ in parts)]
        raise SteadyStateError(
            f"{', '.join(outputs)} cannot all be set: at rest {outputs[i]} moves only with {' and '.join(names[1:])}",
            where=f"operating point of model '{model.name}'",
            expected="outputs that inputs can set one by one",
            got=f"d({outputs[i]}) = {rule}, whichever inputs move them",
            hint=f"leave out {' or '.join(names)}, or free a parameter: free=[...]",
        )


def _dc_gains(model: AnyModel, point: OperatingPoint, outputs: Collection[str]) -> Array:
    """Return (outputs, all inputs) gains at rest; 0 for an input that drives an integrator: there is no rest with another value."""
    a, b, c, d = kind_of(model).linear(point, LinearOptions(outputs=list(outputs))).standard()
    if not a.shape[0]:
        return d
    x = np.linalg.lstsq(a, -b, rcond=1e-13)[0]
    rest = np.linalg.norm(a @ x + b, axis=0) <= 1e-8 * np.maximum(np.linalg.norm(b, axis=0), 1e-300)
    return np.asarray(np.where(rest, d + c @ x, 0.0))
