"""The gap metric between two linear models: how far apart two plants are for feedback (Georgiou 1988)."""

from __future__ import annotations

import numpy as np
import scipy.linalg
from numpy.typing import NDArray

from hvdc_ident.errors import LinearizationError
from hvdc_ident.linearize.arrays import Array
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.reduce import without_sliding_means

Complex = NDArray[np.complex128]
Graph = tuple[Array, Array, Array, Array]
LARGEST = 512  # coefficients of the truncated operator


def gap(first: LinearModel, second: LinearModel, tolerance: float = 1e-4) -> float:
    """The gap, in [0, 1]: 0 for equal plants, 1 where no controller of one need suit the other; never below the nu-gap.

    The graph of a plant is the range of G = [M; N], its normalised right coprime factors. The directed gap is
    sqrt(1 - s^2) with s the smallest singular value of the Toeplitz operator of G2* G1, here truncated and enlarged until
    the gap moves by less than the tolerance. Raises LinearizationError for models of other sizes, or where it does not settle.
    """
    if first.B.shape[1] != second.B.shape[1] or first.C.shape[0] != second.C.shape[0]:
        raise LinearizationError(
            "the models have other sizes",
            where=f"'{first.name}' against '{second.name}'",
            expected=f"{first.C.shape[0]} outputs and {first.B.shape[1]} inputs",
            got=f"{second.C.shape[0]} and {second.B.shape[1]}",
        )
    graphs = [_graph(m) for m in (first, second)]
    scale = _scale(graphs)
    return max(_directed(graphs[0], graphs[1], scale, tolerance), _directed(graphs[1], graphs[0], scale, tolerance))


def _graph(model: LinearModel) -> Graph:
    """A, B, C, D of the normalised right coprime factors [M; N], from the Riccati equation (Vidyasagar 1988)."""
    a, b, c, d = without_sliding_means(model)
    m = b.shape[1]
    r = np.eye(m) + d.T @ d
    root = np.linalg.inv(np.real(scipy.linalg.sqrtm(r)))
    if a.shape[0] == 0:
        return a, b @ root, np.zeros((m + c.shape[0], 0)), np.vstack([root, d @ root])
    try:
        x = scipy.linalg.solve_continuous_are(a, b, c.T @ c, r, s=c.T @ d)
    except np.linalg.LinAlgError as e:
        raise LinearizationError(
            "the plant has no normalised coprime factors",
            where=f"linear model '{model.name}'",
            got=str(e),
            hint="remove modes that the inputs cannot move or the outputs cannot see: minimal_realisation",
        ) from None
    f = -np.linalg.solve(r, d.T @ c + b.T @ x)
    return a + b @ f, b @ root, np.vstack([f, c + d @ f]), np.vstack([root, d @ root])


def _scale(graphs: list[Graph]) -> float:
    """The frequency that the bilinear map sends to the middle of the circle: between the graphs' poles, rad/s."""
    poles = np.concatenate([np.abs(np.linalg.eigvals(a)) for a, _, _, _ in graphs if a.shape[0]] or [np.ones(1)])
    poles = poles[poles > 0]
    return float(np.exp(np.mean(np.log(poles)))) if poles.size else 1.0


def _response(graph: Graph, omega: Array) -> Complex:
    """(frequency, rows, inputs) of [M; N]."""
    a, b, c, d = graph
    if a.shape[0] == 0:
        return np.broadcast_to(d.astype(complex), (omega.size, *d.shape))
    inner = 1j * omega[:, None, None] * np.eye(a.shape[0]) - a
    return c @ np.linalg.solve(inner, np.broadcast_to(b, (omega.size, *b.shape))) + d


def _directed(graph: Graph, other: Graph, scale: float, tolerance: float) -> float:
    points = 16 * LARGEST
    theta = (np.arange(points) + 0.5) * 2 * np.pi / points - np.pi
    omega = scale * np.tan(theta / 2)
    product = np.conj(np.swapaxes(_response(other, omega), 1, 2)) @ _response(graph, omega)
    m = product.shape[1]
    # Fourier coefficients over the circle; s = scale (1 - z)/(1 + z) makes stable factors power series in z.
    orders = np.arange(-LARGEST + 1, LARGEST)
    kernel = np.exp(1j * np.outer(orders, theta)) / points
    coefficients = np.real(np.tensordot(kernel, product, axes=(1, 0)))
    found = np.inf
    size = 16
    while size <= LARGEST:
        index = LARGEST - 1 + np.subtract.outer(np.arange(size), np.arange(size))
        matrix = coefficients[index].transpose(0, 2, 1, 3).reshape(size * m, size * m)
        smallest = float(np.linalg.svd(matrix, compute_uv=False)[-1])
        before, found = found, float(np.sqrt(max(0.0, 1.0 - min(smallest, 1.0) ** 2)))
        if abs(found - before) < tolerance:
            return found
        size *= 2
    raise LinearizationError(
        "the gap does not settle",
        expected=f"a value that stands still with {LARGEST} coefficients",
        got=f"{found:.6g}, {abs(found - before):.2g} from the one before",
        hint="ask for a coarser tolerance, compare reduced models, or use nu_gap",
    )
