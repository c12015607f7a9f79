"""The matrix that a linear model is reduced from: equations, outputs and Pade states over states, inputs and unknowns."""

from __future__ import annotations

import numpy as np

from hvdc_ident.linearize.arrays import Array
from hvdc_ident.linearize.delays import Channel
from hvdc_ident.linearize.pade import pade
from hvdc_ident.linearize.system import System


class Blocks:
    """Where states, Pade states, inputs, unknowns and delayed values stand in the matrix that is reduced."""

    def __init__(self, s: System, found: tuple[Channel, ...], order: int) -> None:
        self.size, self.channels, self.order = s.layout, found, order
        self.pade = pade(order) if found else (np.zeros((0, 0)), np.zeros(0), np.zeros(0), 0.0)
        self.n_pade = order * len(found)
        self.n = self.size.nx + self.n_pade
        self.rows, self.columns = self.n + self.size.no, self.n + self.size.nu

    def spread(self, jac: Array) -> Array:
        """The Jacobian's rows f, outputs, g and columns [x, Pade, u, z, e] in place; Pade and delay rows are 0."""
        z, k = self.size, self.n_pade
        total = np.zeros((*jac.shape[:-2], z.nx + k + z.no + z.nz + z.ne, z.nx + k + z.nu + z.nz + z.ne))
        rows = [*range(z.nx), *range(z.n + z.ne, z.main), *range(z.nx, z.n)]
        to_rows = [*range(z.nx), *range(self.n, self.n + z.no + z.nz)]
        columns = [*range(z.nx), *range(z.n, z.n + z.nu), *range(z.nx, z.n), *range(z.n + z.nu, z.columns)]
        to_columns = [*range(z.nx), *range(self.n, self.n + z.nu + z.nz + z.ne)]
        total[..., np.array(to_rows)[:, None], to_columns] = jac[..., np.array(rows)[:, None], columns]
        return total

    def sources(self, jac: Array) -> Array:
        """The rows of what is delayed, over the columns [x, Pade, u, z, e]."""
        z = self.size
        total = np.zeros((*jac.shape[:-2], z.ne, z.nx + self.n_pade + z.nu + z.nz + z.ne))
        columns = [*range(z.nx), *range(z.n, z.n + z.nu), *range(z.nx, z.n), *range(z.n + z.nu, z.columns)]
        to_columns = [*range(z.nx), *range(self.n, self.n + z.nu + z.nz + z.ne)]
        total[..., to_columns] = jac[..., z.n : z.n + z.ne, columns]
        return total

    def matrix(self, jac: Array) -> Array:
        """The matrix to reduce: rows [x', Pade', outputs | g, delays], columns [x, Pade, u | z, e]."""
        total = self.spread(jac)
        if self.channels:
            a, _, c, through = self.pade
            z, sources = self.size, self.sources(jac)
            self._add_sources(total, sources, through)
            for i, channel in enumerate(self.channels):
                block = slice(z.nx + i * self.order, z.nx + (i + 1) * self.order)
                total[block, block] += a / channel.total
                total[-z.ne + i, block] += c
                total[-z.ne + i, -z.ne + i] -= 1.0
        return total

    def _add_sources(self, total: Array, sources: Array, through: float) -> None:
        z, b = self.size, self.pade[1]
        for i, channel in enumerate(self.channels):
            block = slice(z.nx + i * self.order, z.nx + (i + 1) * self.order)
            total[..., block, :] += b[:, None] / channel.total * sources[..., i : i + 1, :]
            total[..., total.shape[-2] - z.ne + i, :] += through * sources[..., i, :]

    def matrix_along(self, djac: Array, jac: Array, dtime: Array) -> Array:
        """(directions, ...) the derivative of `matrix`; djac: of the Jacobian; dtime: (channels, directions)."""
        total = self.spread(djac)
        if self.channels:
            a, b, _, through = self.pade
            z = self.size
            self._add_sources(total, self.sources(djac), through)
            sources = self.sources(jac)
            for i, channel in enumerate(self.channels):
                block = slice(z.nx + i * self.order, z.nx + (i + 1) * self.order)
                change = -dtime[i] / channel.total**2
                total[:, block, block] += change[:, None, None] * a
                total[:, block, :] += change[:, None, None] * b[:, None] * sources[i]
        return total

    def split(self, total: Array, inputs: list[int]) -> tuple[Array, Array, Array, Array]:
        """A, B, C, D of a reduced matrix for the chosen inputs."""
        n = self.n
        through = [n + k for k in inputs]
        return total[..., :n, :n], total[..., :n, through], total[..., n:, :n], total[..., n:, through]
