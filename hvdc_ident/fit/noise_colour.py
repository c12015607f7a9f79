"""Correlation of noise from row to row: the likelihood of AR(1) noise in short records, of one output and of several.

The standard deviation and the coefficient of a short record are uncertain together: what is sure is the size of the
steps from row to row, sigma^2 (1 - rho^2). Each is therefore told with the other, and a standard deviation that is known
sharpens the coefficient: 150 rows of rho = 0.9 give it to within 0.05, with the standard deviation to within 0.01.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from hvdc_ident.data import Array
from hvdc_ident.fit.noise_model import whitened

TANH = np.linspace(-0.55, 3.0, 72)
"""artanh of the coefficients that are tried: from -0.5 to 0.995."""
RHO = np.tanh(TANH)
SPREADS = (0.0, 0.1, 0.2, 0.4, 0.8, 1.6)
"""By how much the outputs' artanh(rho) may differ among each other, as a standard deviation."""
COLOURED = 1.645
"""Standard errors that a coefficient has to lie off 0 to be one."""
IN_COMMON = 11.5
"""Twice the log-likelihood by which the records' sum has to differ from their differences to hold something in common."""
LONGEST = 500
"""Rows of a record that are taken as one; a longer one is cut."""


@dataclass(frozen=True, eq=False)
class Likelihood:
    """The log-likelihood of AR(1) noise in some records of one output, over a grid.

    values: (G, V), up to a constant, for the coefficients RHO and the standard deviations std (V,), in the output's unit.
    """

    values: Array
    std: Array

    @property
    def profile(self) -> Array:
        """(G,) the largest over all standard deviations."""
        return np.asarray(self.values.max(axis=1))

    def at(self, std: float) -> Array:
        """(G,) at a standard deviation."""
        known = np.log(self.std)
        return np.array([np.interp(np.log(std), known, row) for row in self.values])

    def best_std(self, tanh: float) -> float:
        """The standard deviation that goes with a coefficient, given by its artanh."""
        k = int(np.argmin(np.abs(TANH - tanh)))
        return float(self.std[int(np.argmax(self.values[k]))])


@dataclass(frozen=True)
class Colour:
    """artanh of a coefficient, with its standard error; 0 with error 0 is white."""

    tanh: float = 0.0
    error: float = 0.0

    @property
    def rho(self) -> float:
        """The coefficient."""
        return float(np.tanh(self.tanh))


def likelihood(records: Sequence[Array], degree: int = 1) -> Likelihood:
    """The likelihood of AR(1) noise beside a polynomial of its own in each record (restricted: freed of its bias).

    records: (n,) each, evenly sampled, at least one longer than degree + 1. Source: Patterson and Thompson 1971.
    """
    usable = [p for r in records if r.size > degree + 2 for p in np.array_split(r, -(-r.size // LONGEST))]
    power = sum(float(r @ r) for r in usable) / sum(r.size for r in usable)
    log_variance = np.log(power) + np.linspace(-2.5, 4.0, 131)
    values = np.zeros((RHO.size, log_variance.size))
    for n in sorted({r.size for r in usable}):
        same = np.column_stack([r for r in usable if r.size == n])
        free, size, squares = _squares(same, degree)
        values -= 0.5 * (
            same.shape[1] * (free * log_variance[None, :] + size[:, None])
            + squares[:, None] * np.exp(-log_variance)[None, :]
        )
    return Likelihood(values, np.exp(0.5 * log_variance))


def without_common(records: Sequence[Array]) -> list[Array]:
    """The differences of the records, as records of the same noise, where what they have in common is no noise; else all.

    A model at rest may ripple (a quantiser or a backlash in its loop), in every record alike. Orthonormal combinations
    of records of independent noise are such records too: their sum, which holds the ripple, and their differences.
    """
    lengths = {r.size for r in records}
    if len(records) < 2 or len(lengths) > 1 or min(lengths) < 8 or not any(np.any(r) for r in records):
        return list(records)
    count = len(records)
    turn = np.linalg.qr(np.column_stack([np.ones(count), np.eye(count)[:, 1:]]))[0]
    turned = list((np.column_stack(records) @ turn).T)
    if not all(np.any(r) for r in turned):
        return list(records)
    parts = [float(likelihood(r).values.max()) for r in (turned[:1], turned[1:], turned)]
    return turned[1:] if 2.0 * (parts[0] + parts[1] - parts[2]) > IN_COMMON else list(records)


def _squares(same: Array, degree: int) -> tuple[int, Array, Array]:
    """(rows left beside the polynomial, (G,) log-determinants of one record, (G,) sums of squares of all, whitened)."""
    n = same.shape[0]
    bases, size = _bases(n, degree)
    squares = np.empty(RHO.size)
    for k, rho in enumerate(RHO):
        white = whitened(same, (float(rho),))
        squares[k] = float(np.sum(white**2) - np.sum((bases[k].T @ white) ** 2))
    return n - degree - 1, size, squares


@lru_cache(maxsize=16)
def _bases(n: int, degree: int) -> tuple[tuple[Array, ...], Array]:
    """For each coefficient an orthonormal basis of the whitened polynomials, and log det S + log det X'S^-1 X."""
    x = np.linalg.qr(np.vander(np.linspace(-1.0, 1.0, n), degree + 1))[0]
    bases, size = [], []
    for rho in RHO:
        q, r = np.linalg.qr(whitened(x, (float(rho),)))
        bases.append(q)
        size.append((n - 1) * np.log1p(-(rho**2)) + 2.0 * np.sum(np.log(np.abs(np.diag(r)))))
    return tuple(bases), np.array(size)


def together(profiles: Array) -> list[Colour]:
    """The coefficient of each output, drawn to what they have in common as far as they agree (empirical Bayes).

    profiles: (O, G) log-likelihoods. artanh(rho) of the outputs scatters normally about a common one, of which any rho is
    as likely; by how much is what makes the data likeliest. Each is the mean of what is then likely.
    """
    likely = np.exp(profiles - profiles.max(axis=1, keepdims=True))
    prior = 1.0 - RHO**2
    best, chosen = -np.inf, likely
    for spread in SPREADS if len(likely) > 1 else (0.0,):
        about = np.exp(-0.5 * ((TANH[:, None] - TANH[None, :]) / spread) ** 2) if spread else np.eye(TANH.size)
        about /= about.sum(axis=1, keepdims=True)
        seen = likely @ about.T
        evidence = float(prior @ np.prod(seen, axis=0))
        if evidence > best:
            best = evidence
            others = np.array([np.prod(np.delete(seen, k, axis=0), axis=0) for k in range(len(seen))])
            chosen = likely * ((others * prior) @ about)
    chosen = chosen / chosen.sum(axis=1, keepdims=True)
    means = chosen @ TANH
    errors = np.sqrt(np.maximum(chosen @ TANH**2 - means**2, 0.0))
    return [
        Colour(float(m), float(e)) if abs(m) > COLOURED * e else Colour() for m, e in zip(means, errors, strict=True)
    ]
