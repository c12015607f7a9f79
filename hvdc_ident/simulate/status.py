"""Statuses with which a run ends."""

NAMES = ("converged", "step-limit", "not-finite", "chatter", "inconsistent", "stiff")
CONVERGED, STEP_LIMIT, NOT_FINITE, CHATTER, INCONSISTENT, STIFF = range(6)
HINTS = {
    "step-limit": "look for a very fast part of the model, or for a jump (`where`) that the state's own derivative turns back: "
    "give it a width, as clip((a - b)/width, 0, 1); from Python, Tolerance(max_steps=..., rtol=...)",
    "not-finite": "a value grew without bound or left a function's domain: check parameter values and limits",
    "chatter": "a limit switches on and off without end: add a hysteresis or a small lag where it acts",
    "inconsistent": "no solution of the algebraic loop was found there: check the operating point, or give the unknown another start",
    "stiff": "use the Rosenbrock method",
}
