"""Small linear models for tests."""

import numpy as np

from hvdc_ident.linearize import LinearModel


def linear(a, b, c, d=None):
    a, b, c = (np.atleast_2d(np.asarray(m, dtype=float)) for m in (a, b, c))
    d = np.zeros((c.shape[0], b.shape[1])) if d is None else np.atleast_2d(np.asarray(d, dtype=float))
    n, m, o = a.shape[0], b.shape[1], c.shape[0]
    names = (tuple(f"x{k}" for k in range(n)), tuple(f"u{k}" for k in range(m)), tuple(f"y{k}" for k in range(o)))
    return LinearModel(a, b, c, d, np.eye(n), *names)


def stable(seed, n=5, m=2, o=2, through=False):
    rng = np.random.default_rng(seed)
    a = rng.normal(size=(n, n))
    a -= (np.linalg.eigvals(a).real.max() + 0.3) * np.eye(n)
    return linear(a, rng.normal(size=(n, m)), rng.normal(size=(o, n)), rng.normal(size=(o, m)) if through else None)
