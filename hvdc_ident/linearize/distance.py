"""The distance of two linear models, the nu-gap, their largest difference of gain, and the coprime factor margin."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.linalg

from hvdc_ident.codec import INLINE, Coded, stored_as
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.frequency import followed, transfer, wide_omega
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.norms import Peak, largest_gain, linf_norm, peak_over
from hvdc_ident.linearize.realisation import approximate_visible, difference, same_channels, visible
from hvdc_ident.linearize.reduction import hankel
from hvdc_ident.linearize.stability import Characteristic, poles_of_transfer, stability
from hvdc_ident.linearize.system import Array


@dataclass(frozen=True)
class NuGap(Coded):
    """The nu-gap between two models: value in [0, 1], where the largest chordal distance is, and the winding condition.

    winding: the count that must be 0; where it is not, no controller that suits one model is sure to suit the other
    and the value is 1. distance: the largest chordal distance between the frequency responses.
    """

    value: float = field(metadata=stored_as("nu_gap"))
    omega: float
    winding: int
    distance: float = field(metadata=stored_as("chordal_distance"))


def nu_gap(first: LinearModel, second: LinearModel) -> NuGap:
    """Return the nu-gap metric with its winding condition (Vinnicombe 1993, doi 10.1109/9.231459); delays exact on the axis.

    Parameters
    ----------
    first : LinearModel
        A model, its inputs and outputs scaled so that 1 has equal weight in each (`LinearModel.scaled`).
    second : LinearModel
        The other one, with as many inputs and outputs, scaled alike.

    Returns
    -------
    NuGap
        `value` in [0, 1]; `omega` in rad/s, where the chordal distance of the frequency responses is largest; that `distance`; `winding`,
        the count that must be 0; where it is not, the value is 1.

    Raises
    ------
    LinearizationError
        The numbers of channels differ, the number of a model's unstable poles is not known, or there is no limit at high frequency.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> lag = hi.Model("lag", parameters={"T": 0.5, "k": 2.0}, inputs={"u": 0.0}, states={"x": "(k*u - x)/T"}, outputs={"y": "x"})
    >>> gap = hi.linear.nu_gap(hi.linearize(lag), hi.linearize(lag, values={"k": 1.0}))
    >>> round(gap.value, 3), gap.winding
    (0.333, 0)
    """
    same_channels(first, second)
    grid = np.unique(np.concatenate([wide_omega(first, 2000), wide_omega(second, 2000)]))
    far = 1e6 * grid[-1]
    grid = np.concatenate([grid[0] * np.logspace(-8, -0.01, 100), grid, [far]])

    def distances(w: Array) -> Array:
        return _chordal(transfer(first, 1j * w), transfer(second, 1j * w))

    peak = peak_over(distances, grid)
    winding = winding_count(first, second)
    value = min(peak.value, 1.0)
    return NuGap(1.0 if winding else value, peak.omega, winding, value)


def _chordal(p1: Array, p2: Array) -> Array:
    """Return (points,) largest singular value of (1 + P2 P2*)^-1/2 (P1 - P2) (1 + P1* P1)^-1/2."""
    u, s2, _ = np.linalg.svd(p2)
    _, s1, v = np.linalg.svd(p1)
    inner = np.conj(np.swapaxes(u, 1, 2)) @ (p1 - p2) @ np.conj(np.swapaxes(v, 1, 2))
    inner = inner / np.sqrt(1.0 + _padded(s2, u.shape[1]) ** 2)[:, :, None]
    inner = inner / np.sqrt(1.0 + _padded(s1, v.shape[1]) ** 2)[:, None, :]
    return np.asarray(np.linalg.svd(inner, compute_uv=False)[:, 0])


def _padded(values: Array, size: int) -> Array:
    """Singular values with the zeros of a matrix that is not square."""
    return np.concatenate([values, np.zeros((values.shape[0], size - values.shape[1]))], axis=1)


def winding_count(first: LinearModel, second: LinearModel) -> int:
    """Return wno det(1 + P2~ P1) + eta(P1) - eta(P2) - eta0(P2), the count that must be 0; delays exact.

    The contour passes poles on the axis on their right, so that wno counts zeros less poles right of it; modes that are
    hidden from inputs or outputs do not belong to the transfer functions and are left out. Raises LinearizationError
    where the number of a model's unstable poles is not known or infinite, or the determinant has no limit at high frequency.
    """
    one, two = visible(first), visible(second)
    through = np.eye(one.through.shape[1]) + two.through.T @ one.through
    if np.linalg.cond(through) > 1e12:
        return 1_000_000
    right1, axis1 = poles_of_transfer(one, f"linear model '{first.name}'")
    right2, axis2 = poles_of_transfer(two, f"linear model '{second.name}'")
    return _wound(one, two, through, np.concatenate([axis1, axis2]).imag) + right1 - right2 - axis2.size


BESIDE = 1e-4
"""Distance from a pole on the axis, as a share of its size and of that of the slowest pole, at which the contour passes it."""


def _wound(one: Characteristic, two: Characteristic, through: Array, axis: Array) -> int:
    """Return the zeros less the poles of f = det(1 + P2~ P1) right of the axis, by the turns of f along it, delays exact.

    axis: frequencies of the poles on it, rad/s.

    From a point right of 0 up the axis, round the poles on it; f is real at the first point, and at infinity. Raises
    LinearizationError where the turns do not close.
    """

    def determinant(s: Array) -> tuple[Array, Array, Array]:
        (p1, d1), (p2, d2) = one.response_by_s(s), two.response_by_s(-s)
        mirrored, slope = np.swapaxes(p2, 1, 2), -np.swapaxes(d2, 1, 2)
        inner = np.eye(p1.shape[2]) + mirrored @ p1
        value = np.linalg.det(inner)[:, None, None]
        turned = np.trace(np.linalg.solve(inner, slope @ p1 + mirrored @ d1), axis1=1, axis2=2)[:, None, None]
        return value, turned * value, np.zeros(value.shape)

    sizes = np.abs(np.concatenate([one.roots.values, two.roots.values]))
    sizes = sizes[sizes > 0.0]
    near, far = BESIDE * float(sizes.min(initial=1.0)), 1e9 * float(sizes.max(initial=1.0))
    path = [near + 0j, 1j * near]
    axis = np.unique(axis[axis > near])
    for w in axis:
        path += [1j * w * (1.0 - BESIDE), w * (BESIDE + 1j), 1j * w * (1.0 + BESIDE)]
    resonant = np.abs(np.concatenate([one.roots.values.imag, two.roots.values.imag]))
    for w in resonant[(resonant > near) & (resonant < far)]:
        if (np.abs(w - axis) > 2.0 * BESIDE * w).all():
            path.append(1j * w)
    path = [*path[:2], *sorted(path[2:], key=lambda s: s.imag), 1j * far]
    _, change = followed(determinant, np.array(path))
    end = complex(determinant(np.array([1j * far]))[0][0, 0, 0])
    left = np.angle(np.linalg.det(through) / end)
    turns = -(float(change.imag.sum()) + left) / np.pi
    if abs(left) > 0.1 or abs(turns - round(turns)) > 1e-3:
        raise LinearizationError(
            "the winding of the nu-gap cannot be counted: its determinant has no limit at high frequency",
            got=f"{turns:.6g} half turns up to {far:.3g} rad/s",
            hint="add the lag that is there to the way through the delay",
        )
    return round(turns)


# --- the margin ---


def ncf_margin(plant: LinearModel, controller: LinearModel | None = None) -> Peak:
    """Return the normalised coprime factor margin b(P, C) of a negative feedback loop, in [0, 1], and where it is least.

    1/b is the H-infinity norm of [I; C] (I + P C)^-1 [I, P]; b is 0 where the loop is not stable. A controller with margin b suits every
    plant within a nu-gap below b of P.

    Parameters
    ----------
    plant : LinearModel
        P, its inputs and outputs scaled so that 1 has equal weight in each (`LinearModel.scaled`).
    controller : LinearModel, default None
        C, from the plant's outputs to its inputs, with the sign of negative feedback, scaled alike. None: the largest margin that any
        controller attains, sqrt(1 - |[M; N]|_H^2) (Glover and McFarlane 1989).

    Returns
    -------
    Peak
        `value`, b, and `omega` in rad/s, where it is least; nan without a controller.

    Raises
    ------
    LinearizationError
        The sizes do not fit, the loop is ill-posed, or whether it is stable cannot be told.

    Examples
    --------
    >>> import hvdc_ident as hi
    >>> plant, controller = hi.linear.plant_and_controller(hi.load_model("vsc-hvdc-link"), ["Irorder1"], ["Vdc1_m"])
    >>> hi.linear.ncf_margin(plant, controller).value <= hi.linear.ncf_margin(plant).value
    True
    """
    if controller is None:
        return Peak(_attainable(plant), float("nan"))
    outputs, inputs = len(plant.output_names), len(plant.input_names)
    if (len(controller.output_names), len(controller.input_names)) != (inputs, outputs):
        raise LinearizationError(
            "the controller does not fit the plant",
            where=f"'{plant.name}' with '{controller.name}'",
            expected=f"a controller of {outputs} inputs and {inputs} outputs",
            got=f"{len(controller.input_names)} inputs and {len(controller.output_names)} outputs",
        )
    closed = _four_blocks(visible(plant), visible(controller), f"'{plant.name}' with '{controller.name}'")
    judged = stability(closed)
    if judged.verdict == "not decided":
        raise LinearizationError(
            "whether the loop is stable cannot be told",
            where=f"'{plant.name}' with '{controller.name}'",
            got=judged.reason,
        )
    if judged.verdict != "stable":
        return Peak(0.0, float("nan") if judged.rightmost is None else abs(judged.rightmost.imag))
    grid = np.unique(np.concatenate([wide_omega(m, 4000 if closed.channels else 400) for m in (plant, controller)]))
    peak = largest_gain(closed, grid)
    return Peak(1.0 / peak.value, peak.omega)


def _attainable(plant: LinearModel) -> float:
    """Return the largest margin of any controller: from the Hankel norm of the normalised right coprime factors [M; N].

    The factors are those of the Riccati equation (Vidyasagar 1988), delays in their Pade form.
    """
    equation = approximate_visible(plant)
    a, b, c, d = equation.matrices
    if equation.nx == 0:
        return 1.0
    m = b.shape[1]
    r = np.eye(m) + d.T @ d
    try:
        x = scipy.linalg.solve_continuous_are(a, b, c.T @ c, r, s=c.T @ d)
        f = -np.linalg.solve(r, d.T @ c + b.T @ x)
        root = np.linalg.inv(np.real(scipy.linalg.sqrtm(r)))
        norm = float(hankel(a + b @ f, b @ root, np.vstack([f, c + d @ f]))[0][0])
        if not norm <= 1.0:
            raise np.linalg.LinAlgError(f"the Hankel norm of the factors, below 1, comes out as {norm:.6g}")
    except np.linalg.LinAlgError as e:
        raise LinearizationError(
            "the Riccati equation of the plant's normalised coprime factors is not solved",
            where=f"linear model '{plant.name}'",
            got=str(e),
            hint="reduce the model first (`reduce`), or scale its inputs and outputs",
        ) from None
    return float(np.sqrt(1.0 - norm**2))


def _four_blocks(plant: Characteristic, controller: Characteristic, where: str) -> Characteristic:
    """Return [I; C] (I + P C)^-1 [I, P]: v = w1 + P (w2 - C v), seen as v and C v. Raises LinearizationError for an ill-posed loop."""
    p, m = plant.through.shape
    both = plant.beside(controller)
    # The plant's inputs are w2 less the controller's outputs, the controller's inputs w1 and the plant's outputs.
    feedback = np.block([[np.zeros((m, p)), -np.eye(m)], [np.eye(p), np.zeros((p, m))]])
    if np.linalg.cond(np.eye(p + m) - both.through @ feedback) > 1e12:
        raise LinearizationError("the loop is ill-posed: I + D_P D_C is singular", where=where)
    swapped = np.block([[np.zeros((m, p)), np.eye(m)], [np.eye(p), np.zeros((p, m))]])
    closed = both.fed_back(feedback).between(swapped, np.eye(p + m))
    through = closed.through.copy()
    through[:p, :p] += np.eye(p)  # v is the plant's output and w1
    return replace(closed, through=through)


@dataclass(frozen=True)
class ModelDistance(Coded):
    """Distance of a second model from a first one, between the same inputs and outputs.

    nu_gap: in [0, 1], with its winding condition. attainable: the largest
    normalised coprime factor margin that any controller of the first attains: where the nu-gap is below it, one
    controller can suit both. difference: L-infinity norm of first - second, in output per input units, None where it is
    infinite. relative: that over the norm of the first, None where there is none. notes: why a number is missing.
    """

    first: str = field(metadata=stored_as("model"))
    second: str = field(metadata=stored_as("other"))
    nu_gap: NuGap = field(metadata=INLINE)
    attainable: float | None = field(metadata=stored_as("attainable_margin"))
    difference: Peak | None
    relative: float | None = field(metadata=stored_as("relative_difference"))
    notes: tuple[str, ...] = ()

    def __str__(self) -> str:
        far = self.nu_gap
        verdict = (
            "no controller of one need suit the other"
            if far.value >= 1.0
            else f"largest at {far.omega / (2 * np.pi):.4g} Hz"
        )
        lines = [f"{self.first} against {self.second}: nu-gap {far.value:.4g}, {verdict}"]
        if self.attainable is not None:
            lines.append(f"largest margin that a controller of {self.first} attains: {self.attainable:.4g}")
        if self.difference is not None:
            share = "" if self.relative is None else f", {100 * self.relative:.3g} % of the largest gain"
            where = self.difference.omega / (2 * np.pi)
            lines.append(f"largest difference of gain {self.difference.value:.4g} at {where:.4g} Hz{share}")
        return "\n".join([*lines, *self.notes])


def compare(first: LinearModel, second: LinearModel) -> ModelDistance:
    """Return how far two models with the same inputs and outputs are apart.

    Parameters
    ----------
    first : LinearModel
        A model. Every number depends on units: scale both first (`LinearModel.scaled`) so that 1 matters equally in each channel.
    second : LinearModel
        The other one, with as many inputs and outputs, scaled alike.

    Returns
    -------
    ModelDistance
        `nu_gap` in [0, 1]; `attainable`, the largest margin that a controller of the first attains; `difference`, the L-infinity norm of
        first - second in output per input units; `relative`, that over the norm of the first. What cannot be computed is None, and
        `notes` say why.

    Raises
    ------
    LinearizationError
        The numbers of inputs or outputs differ, or the nu-gap cannot be told.

    Examples
    --------
    >>> from hvdc_ident import linearize, load_model
    >>> from hvdc_ident.linear import compare
    >>> link = load_model("vsc-hvdc-link")
    >>> channel = {"inputs": "Vdcref1", "outputs": "Vdc1"}
    >>> other = linearize(link.with_values({"KIVDC": 500.0}), **channel)
    >>> round(compare(linearize(link, **channel), other).nu_gap.value, 2)
    0.07
    """
    far = nu_gap(first, second)
    notes: list[str] = []
    attainable: float | None = None
    try:
        attainable = ncf_margin(first).value
    except LinearizationError as e:
        notes.append(f"attainable margin: {e.what}")
    apart, relative = None, None
    try:
        apart = linf_norm(difference(first, second))
        size = linf_norm(first).value
        relative = apart.value / size if size > 0 else None
    except LinearizationError as e:
        notes.append(f"difference: {e.what}")
    return ModelDistance(first.name, second.name, far, attainable, apart, relative, tuple(notes))
