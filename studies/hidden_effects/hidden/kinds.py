"""The names of the hidden effects that change how a state moves, as the truth of a case has them."""

from __future__ import annotations

SLOW_STATE = "state-rate-limit"
"""x' = clip(f, -down, up) instead of x' = f."""
HELD_STATE = "non-windup-limit"
"""x' = 0 instead of x' = f where x is at its limit, low or high, and f leads beyond it."""
OF_STATES = (SLOW_STATE, HELD_STATE)
