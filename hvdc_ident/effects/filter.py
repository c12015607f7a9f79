"""A linear filter of second order: u plus k times a band around wn, with shares of that below and above the band."""

import math
from collections.abc import Mapping

import numpy as np
import sympy as sp

from hvdc_ident.data import Array
from hvdc_ident.effects.base import Additions, Effect, EffectParameter
from hvdc_ident.immutable import FrozenMap


def rewrite(u: sp.Expr, p: Mapping[str, sp.Expr], add: Additions) -> sp.Expr:
    """Return y = u + k (low x + 2 zeta v + high (u - x - 2 zeta v)) of x' = wn v, v' = wn (u - x - 2 zeta v).

    x is the low-pass part, 2 zeta v the band-pass part with gain 1 at wn, the rest of u the high-pass part.
    """
    wn, zeta = p["wn"], p["zeta"]
    x, v = add.states(("x", "v"), lambda s: (wn * s[1], wn * (u - s[0] - 2 * zeta * s[1])), rests=(u, sp.S.Zero))
    band = 2 * zeta * v
    return u + p["k"] * (p["low"] * x + band + p["high"] * (u - x - band))


LATE = -0.5
"""Real part of the zeros, from -1 (those of a filter that only delays, in place of its poles) to 1, from which they are a
notch's or a resonance's."""


def _polynomials(p: Mapping[str, float]) -> tuple[Array, Array]:
    """Return the numerator and the denominator, the highest power first."""
    band = 2.0 * p["zeta"] * p["wn"]
    above, below = 1.0 + p["k"] * p["high"], 1.0 + p["k"] * p["low"]
    return np.array([above, band * (1.0 + p["k"]), p["wn"] ** 2 * below]), np.array([1.0, band, p["wn"] ** 2])


def _rings(p: Mapping[str, float]) -> bool:
    """Return True where poles and zeros are complex, as of no chain of lags and lead-lags, and the zeros not a delay's."""
    zeros, poles = _polynomials(p)
    return _complex(zeros) and _complex(poles) and zeros[1] / zeros[0] > LATE * poles[1]


def _complex(quadratic: Array) -> bool:
    a, b, c = quadratic
    return bool(b**2 < 4.0 * a * c)


def _words(p: Mapping[str, float]) -> dict[str, str]:
    """Return the filter's shape, a notch or a resonance and its frequency, and its transfer function."""
    omega = p["wn"] * np.geomspace(0.1, 10.0, 2001)
    zeros, poles = _polynomials(p)
    level = np.log(np.abs(np.polyval(zeros, 1j * omega) / np.polyval(poles, 1j * omega)))
    most = np.argmax(np.abs(level))
    told = [" + ".join((f"{a:.4g} s^2", f"{b:.4g} s", f"{c:.4g}")) for a, b, c in (zeros, poles)]
    transfer = "/".join(f"({t.removeprefix('1 ').replace('+ -', '- ')})" for t in told)
    return {
        "shape": f"a {'notch' if level[most] < 0 else 'resonance'} around {omega[most]:.3g} rad/s", "transfer": transfer,
    }  # fmt: skip


EFFECT = Effect(
    name="filter",
    summary="linear filter of second order, y = u + k (low wn^2 + 2 zeta wn s + high s^2)/(s^2 + 2 zeta wn s + wn^2) u",
    parameters=FrozenMap(
        {
            "k": EffectParameter(
                -0.5,
                neutral=0.0,
                min=-math.inf,
                description="gain added at wn",
                probes=(0.3,),
                search=(-5.0, 5.0),
            ),
            "low": EffectParameter(0.0, min=-math.inf, description="share of k well below wn"),
            "high": EffectParameter(0.0, min=-math.inf, description="share of k well above wn"),
            "wn": EffectParameter(
                100.0,
                unit="rad/s",
                min=1e-9,
                description="middle of the band",
                measure="rate",
                probes=(0.9, 0.78, 0.67, 0.56, 0.44, 0.33, 0.22, 0.1),
            ),
            "zeta": EffectParameter(
                0.25, description="half the band's width, of wn", probes=(0.3,), search=(0.01, 5.0)
            ),
        }
    ),
    rewrite=rewrite,
    sentence="{at} passes {shape}, H(s) = {transfer}",
    excited_by="a multisine of the signal over the filter's band",
    example=FrozenMap({"k": -0.5, "low": 0.1, "high": -0.1, "wn": 60.0, "zeta": 0.25}),
    states="x and v = x'/wn, one pair per insertion point",
    tried_by_default=False,
    outside="filter",
    is_own=_rings,
    words=_words,
    confusable=FrozenMap(
        {
            "second-order": "a multisine from well below to well above wn: the second order lets nothing through above it",
            "lead-lag": "a multisine from well below to well above wn: a lead-lag's gain goes one way only",
            "lag": "a multisine from well below to well above wn: behind a lag nothing comes back above it",
        }
    ),
)
