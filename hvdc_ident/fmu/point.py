"""An FMU at a point: derivatives, outputs and their Jacobian, as its worker gives them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array
from hvdc_ident.errors import ModelError
from hvdc_ident.fmu.model import FmuModel
from hvdc_ident.fmu.run import about, changed


@dataclass(frozen=True, eq=False)
class FmuPoint:
    """x (nx,), its derivatives (nx,), outputs (ny,), and the Jacobian of both by [x, u, p], (nx + ny, nx + nu + np).

    nominals: (nx,) sizes of the states. directional: which columns are the FMU's own. error: of the Jacobian, in shares
    of each row's largest entry. near: whether differences of two step sizes disagree, as beside a limit.
    """

    x: Array
    slopes: Array
    outputs: Array
    jacobian: Array
    nominals: Array
    directional: NDArray[np.bool_]
    error: float
    near: bool


def smooth_inputs(model: FmuModel) -> tuple[str, ...]:
    """The inputs that may change continuously: those a Jacobian has columns for."""
    return tuple(n for n, v in model.fmu.inputs.items() if v.continuous)


def at_point(
    model: FmuModel,
    values: Mapping[str, float],
    states: Array | None,
    outputs: Sequence[str],
    parameters: Sequence[str] = (),
    time: float = 0.0,
    *,
    check: bool = True,
) -> FmuPoint:
    """The FMU at values of parameters and inputs; states None: where its own initialisation puts them.

    parameters: those the Jacobian has columns for. check: whether directional derivatives that once agreed with
    differences are compared again. Raises ModelError where it has no equations, SimulationError where
    it cannot be evaluated.
    """
    if not model.has_equations:
        raise ModelError(
            "a co-simulation FMU shows no equations",
            where=f"model '{model.name}'",
            expected="model exchange",
            hint="export it with model exchange; simulate, sweep, identify and fit work on it as it is",
        )
    heading = {
        "do": "point",
        "values": changed(model, values),
        "time": time,
        "outputs": list(outputs),
        "jacobian": True,
        "check": check,
        "parameters": list(parameters),
        "sizes": about(model, parameters)["sizes"],
    }
    u = np.array([float(values.get(n, i.value)) for n, i in model.inputs.items()])
    answer, out = model.host.ask(heading, {"u": u, **({} if states is None else {"x": states})})
    return FmuPoint(
        out["x"],
        out["slopes"],
        out["outputs"],
        out["jacobian"],
        out["nominals"],
        out["directional"] > 0.5,
        float(answer["error"]),
        bool(answer["near"]),
    )
