"""A slider of one parameter, with its value in words beside it."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from typing import Any

from nicegui import ui

from hvdc_ident.parameters import Parameter
from hvdc_ident.text import quantity

THROTTLE = 0.025
"""Least time between two values that a slider sends, s: a frame of a screen at 40 Hz."""
STEPS = 500
"""Positions of a slider."""


class Knob:
    """A slider between the ends of a span, in the parameter's unit, logarithmic where asked; `moved` takes each value.

    label: what stands before it (default: the name). began: called when it is seized with the mouse.
    """

    def __init__(
        self,
        name: str,
        parameter: Parameter,
        span: tuple[float, float],
        value: float,
        moved: Callable[[float], None],
        *,
        log: bool,
        label: str = "",
        began: Callable[[], None] | None = None,
    ) -> None:
        self._unit = parameter.unit
        self._to: Callable[[float], float] = math.log if log else float
        back: Callable[[float], float] = math.exp if log else float
        low, high = map(self._to, span)
        with ui.row().classes("w-full items-center no-wrap gap-2"):
            ui.label(label or name).classes("col-4 ellipsis").tooltip(parameter.description or name)
            self._slider = ui.slider(min=low, max=high, step=(high - low) / STEPS, value=self._to(value)).classes("col")
            self._slider.props(f'aria-label="{name}" dense')
            self._shown = ui.label(quantity(value, self._unit)).classes("col-3 text-right text-caption")

        def changed(event: Any) -> None:
            moved(back(float(event.args)))

        def seized(event: Any) -> None:
            if began is not None and event.args == "start":
                began()

        self._slider.on("update:model-value", changed, throttle=THROTTLE)
        self._slider.on("pan", seized)

    def tell(self, value: float) -> None:
        """Show the value where the slider stands: without a change of an element, which would draw the whole page anew."""
        text = json.dumps(quantity(value, self._unit))
        self._shown.client.run_javascript(f"getHtmlElement({self._shown.id}).textContent = {text}")

    def put(self, value: float) -> None:
        """Set the slider to a value, and show it."""
        self._shown.text = quantity(value, self._unit)
        if not math.isclose(self._slider.value, self._to(value), rel_tol=1e-9, abs_tol=1e-12):
            self._slider.value = self._to(value)
