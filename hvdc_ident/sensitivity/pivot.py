"""Which entry of a direction is made 1: the choice that rounding, another on every machine, must not make."""

from __future__ import annotations

import numpy as np

from hvdc_ident.trajectory import Array

TIE = 1e-9
"""Share of the largest magnitude by which two entries differ and are still equal."""


def leading(direction: Array) -> int:
    """The place of the first entry that is as large in magnitude as any, to rounding. direction: (n,)."""
    size = np.abs(direction)
    return int(np.argmax(size >= (1.0 - TIE) * size.max()))
