"""The distance of two linear models, the nu-gap, their largest difference of gain, and the coprime factor margin."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import scipy.linalg

from hvdc_ident.codec import INLINE, Coded, stored_as
from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.frequency import followed, transfer, wide_omega
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.realisation import on_axis, visible
from hvdc_ident.linearize.reduction import Peak, difference, hankel, linf_norm, peak_over, same_channels
from hvdc_ident.linearize.stability import ZERO, Characteristic, Stability, sliding_means, stability
from hvdc_ident.linearize.system import Array

StateSpace = tuple[Array, Array, Array, Array]


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

    Scale inputs and outputs first so that 1 has equal weight in each (`LinearModel.scaled`). Raises LinearizationError
    where the numbers of channels differ.
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
    one, two = _equation(first), _equation(second)
    through = np.eye(one.through.shape[1]) + two.through.T @ one.through
    if np.linalg.cond(through) > 1e12:
        return 1_000_000
    (right1, axis1), (right2, axis2) = (_poles_of(e, m) for e, m in ((one, first), (two, second)))
    if one.channels or two.channels:
        winding = _wound(one, two, through, np.concatenate([axis1, axis2]).imag)
    else:
        winding = _zeros_less_poles(one, two, through)
    return winding + right1 - right2 - axis2.size


def _poles_of(equation: Characteristic, model: LinearModel) -> tuple[int, Array]:
    """Return the number of poles right of the axis and those on it, sliding means left out."""
    if not equation.channels:
        return _right_and_on_axis(equation.matrix)
    roots = equation.roots
    if roots.unstable is None or np.isinf(roots.unstable):
        raise LinearizationError(
            "the number of unstable poles is not known", where=f"linear model '{model.name}'", got=roots.reason
        )
    nearest = roots.values[np.argsort(np.abs(roots.values.real), kind="stable")[: roots.axis]]
    return int(roots.unstable), nearest[np.argsort(np.abs(nearest), kind="stable")[sliding_means(equation) :]]


def _zeros_less_poles(one: Characteristic, two: Characteristic, through: Array) -> int:
    """Return the zeros less the poles of det(1 + P2~ P1) right of the axis, without delays: from eigenvalues."""
    # P2~(s) = P2(-s)^T, in series behind P1, with unit negative feedback.
    at, bt, ct, dt = -two.matrix.T, -two.read.T, two.given.T, two.through.T
    series_a = np.block([[one.matrix, np.zeros((one.nx, two.nx))], [bt @ one.read, at]])
    series_b = np.concatenate([one.given, bt @ one.through])
    series_c = np.concatenate([dt @ one.read, ct], axis=1)
    closed = series_a - series_b @ np.linalg.solve(through, series_c)
    right = [_right_and_on_axis(a)[0] for a in (closed, one.matrix, at)]
    return right[0] - right[1] - right[2]


def _right_and_on_axis(a: Array) -> tuple[int, Array]:
    """Return the number of eigenvalues right of the imaginary axis, and those on it."""
    values = np.linalg.eigvals(a).astype(complex)
    axis = on_axis(values, a)
    return int(((values.real > 0) & ~axis).sum()), values[axis]


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
    sizes = sizes[sizes > ZERO * max(1.0, float(sizes.max(initial=0.0)))] if sizes.size else np.ones(1)
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


def _graph(model: LinearModel) -> StateSpace:
    """A, B, C, D of the normalised right coprime factors [M; N], from the Riccati equation (Vidyasagar 1988)."""
    a, b, c, d = visible(model)
    m = b.shape[1]
    r = np.eye(m) + d.T @ d
    root = np.linalg.inv(np.real(scipy.linalg.sqrtm(r)))
    if a.shape[0] == 0:
        return a, b @ root, np.zeros((m + c.shape[0], 0)), np.vstack([root, d @ root])
    try:
        x = scipy.linalg.solve_continuous_are(a, b, c.T @ c, r, s=c.T @ d)
    except np.linalg.LinAlgError as e:
        raise LinearizationError(
            "the Riccati equation of the plant's normalised coprime factors has no solution",
            where=f"linear model '{model.name}'",
            got=str(e),
            hint="reduce the model first (`reduce`), or scale its inputs and outputs",
        ) from None
    f = -np.linalg.solve(r, d.T @ c + b.T @ x)
    return a + b @ f, b @ root, np.vstack([f, c + d @ f]), np.vstack([root, d @ root])


# --- the margin ---


def ncf_margin(plant: LinearModel, controller: LinearModel | None = None) -> Peak:
    """Return the normalised coprime factor margin b(P, C) of a negative feedback loop, in [0, 1], and where it is least.

    1/b is the H-infinity norm of [I; C] (I + P C)^-1 [I, P]; b is 0 where the loop is not stable. A controller with
    margin b suits every plant within a nu-gap below b of P. Without a controller: the largest margin that any
    controller attains, sqrt(1 - |[M; N]|_H^2) (Glover and McFarlane 1989), whose omega is nan. Scale first, as for
    `nu_gap`. Raises LinearizationError where the sizes do not fit, or the loop is ill-posed.
    """
    if controller is None:
        a, b, c, _ = _graph(plant)
        values = hankel(a, b, c)[0] if a.shape[0] else np.zeros(1)
        return Peak(float(np.sqrt(max(1.0 - float(values[0]) ** 2, 0.0))), float("nan"))
    outputs, inputs = len(plant.output_names), len(plant.input_names)
    if (len(controller.output_names), len(controller.input_names)) != (inputs, outputs):
        raise LinearizationError(
            "the controller does not fit the plant",
            where=f"'{plant.name}' with '{controller.name}'",
            expected=f"a controller of {outputs} inputs and {inputs} outputs",
            got=f"{len(controller.input_names)} inputs and {len(controller.output_names)} outputs",
        )
    closed = _four_blocks(plant, controller)
    if plant.exact is None and controller.exact is None:
        poles = closed.poles()
        if (poles.real >= 0).any():
            return Peak(0.0, float(abs(poles[np.argmax(poles.real)].imag)))
        peak = linf_norm(closed)
    else:
        found = _closed_with_delays(plant, controller)
        if found.verdict != "stable":
            return Peak(0.0, float("nan") if found.rightmost is None else abs(found.rightmost.imag))
        peak = _exact_peak(plant, controller)
    return Peak(1.0 / peak.value, peak.omega)


def _four_blocks(plant: LinearModel, controller: LinearModel) -> LinearModel:
    """[I; C] (I + P C)^-1 [I, P] in state space: v = w1 + P (w2 - C v), seen as v and C v."""
    a1, b1, c1, d1 = visible(plant)
    a2, b2, c2, d2 = visible(controller)
    p, m, n1, n2 = c1.shape[0], b1.shape[1], a1.shape[0], a2.shape[0]
    loop = np.block([[np.eye(p), d1], [-d2, np.eye(m)]])
    if np.linalg.cond(loop) > 1e12:
        raise LinearizationError("the loop is ill-posed: I + D_P D_C is singular", where=f"'{plant.name}'")
    # [v; C v] from the states and [w1; w2].
    right = np.block([[c1, np.zeros((p, n2)), np.eye(p), d1], [np.zeros((m, n1)), c2, np.zeros((m, p + m))]])
    seen = np.linalg.solve(loop, right)
    v, cv = seen[:p], seen[p:]
    drive = np.concatenate([np.zeros((m, n1 + n2 + p)), np.eye(m)], axis=1) - cv
    rates = np.concatenate([b1 @ drive, b2 @ v])
    rates[:n1, :n1] += a1
    rates[n1:, n1 : n1 + n2] += a2
    n = n1 + n2
    return plant.with_matrices(
        rates[:, :n], rates[:, n:], seen[:, :n], seen[:, n:],
        input_names=tuple(f"w{k + 1}" for k in range(p + m)), input_units=(), u0=(0.0,) * (p + m),
        output_names=tuple(f"z{k + 1}" for k in range(p + m)), output_units=(), y0=(0.0,) * (p + m),
        point=None, name=f"loop of {plant.name} and {controller.name}",
    )  # fmt: skip


def _closed_with_delays(plant: LinearModel, controller: LinearModel) -> Stability:
    """Return whether plant and controller are stable together, delays exact. Raises LinearizationError where it cannot be told."""
    both = _equation(plant).beside(_equation(controller))
    p, m = len(plant.output_names), len(plant.input_names)
    # The plant's inputs are the controller's outputs with a negative sign, and the controller's inputs the plant's outputs.
    feedback = np.block([[np.zeros((m, p)), -np.eye(m)], [np.eye(p), np.zeros((p, m))]])
    found = stability(both.fed_back(feedback))
    if found.verdict == "not decided":
        raise LinearizationError(
            "whether the loop is stable cannot be told",
            where=f"'{plant.name}' with '{controller.name}'",
            got=found.reason,
        )
    return found


def _equation(model: LinearModel) -> Characteristic:
    if model.exact is not None:
        return model.characteristic.visible()
    a, b, c, d = visible(model)
    return Characteristic(a, a.shape[0], (), b, c, d)


def _exact_peak(plant: LinearModel, controller: LinearModel) -> Peak:
    """Return the peak of the four blocks on a grid and beside its maximum, delays exact."""

    def blocks(w: Array) -> Array:
        p, c = transfer(plant, 1j * w), transfer(controller, 1j * w)
        eye = np.broadcast_to(np.eye(p.shape[1]), (w.size, p.shape[1], p.shape[1]))
        middle = np.linalg.solve(eye + p @ c, np.concatenate([eye, p], axis=2))
        return np.linalg.svd(np.concatenate([middle, c @ middle], axis=1), compute_uv=False)[:, 0]

    return peak_over(blocks, np.unique(np.concatenate([wide_omega(m, 4000) for m in (plant, controller)])))


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

    Every number depends on units: scale both first (`LinearModel.scaled`) so that 1 matters equally in each channel.
    Raises LinearizationError where the numbers of inputs or outputs differ.

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
