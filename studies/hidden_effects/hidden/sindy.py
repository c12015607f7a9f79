"""A baseline that names nothing: a sparse equation for what the refitted model leaves (needs pysindy, the extra `bench`).

The residual of the refitted nominal model is taken for a state of its own, driven by the model's outputs and the inputs;
pysindy finds a sparse polynomial law for it on the fitted records, and the law is run along the held-out one.
"""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp

Array = NDArray[np.float64]
DEGREE = 2
THRESHOLD = 0.05
"""Of coefficients with every signal scaled to spread 1."""


def predicted(residuals: Sequence[Array], drivers: Sequence[Array], times: Array) -> tuple[Array | None, int]:
    """(the residual of the last experiment as the law of the others predicts it, terms in the law).

    residuals, drivers: (rows, n) in each experiment, the held-out one last; of its residual only the first row is used.
    None where the law runs away.
    """
    import pysindy

    size = np.maximum(np.std(np.concatenate(residuals[:-1]), axis=0), 1e-12)
    middle = np.mean(np.concatenate(drivers[:-1]), axis=0)
    spread = np.maximum(np.std(np.concatenate(drivers[:-1]), axis=0), 1e-12)
    x = [r / size for r in residuals]
    u = [(d - middle) / spread for d in drivers]
    step = float(times[1] - times[0])
    law = pysindy.SINDy(
        optimizer=pysindy.STLSQ(threshold=THRESHOLD, alpha=1e-3),
        feature_library=pysindy.PolynomialLibrary(degree=DEGREE),
        differentiation_method=pysindy.SmoothedFiniteDifference(),
    )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of an ill-conditioned regression: its outcome is what is judged
        law.fit(x[:-1], t=step, u=u[:-1])
        terms = int(np.count_nonzero(law.coefficients()))

        def rate(t: float, state: Array) -> Any:
            now = np.array([np.interp(t, times, column) for column in u[-1].T])
            return np.ravel(law.predict(np.clip(state, -1e3, 1e3)[None], u=now[None]))

        run = solve_ivp(
            rate,
            (times[0], times[-1]),
            np.zeros(x[-1].shape[1]),
            "LSODA",
            times,
            rtol=1e-4,
            atol=1e-4,
            max_step=10 * step,
        )
    found = run.y.T * size
    if not run.success or found.shape != residuals[-1].shape or not np.abs(run.y).max() < 1e2:
        return None, terms
    return found, terms
