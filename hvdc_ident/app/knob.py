"""One parameter on the page: its slider, its value and the ends of its span to be typed, and whether it is fitted."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from nicegui import ui

from hvdc_ident.parameters import Parameter

THROTTLE = 0.025
"""Least time between two values that a slider sends, s: a frame of a screen at 40 Hz."""


class Knob(ui.element, component="knob.js"):  # type: ignore[call-arg]
    """A slider between the ends of a span, in the parameter's unit, logarithmic where that is above 0 and wide.

    moved: takes each value; began: called when a change by hand begins; spanned: takes another span. fitted: whether the parameter is
    one of those to estimate, which `chosen` takes when it changes; None offers no choice. title: what it is called where not by its name.
    """

    def __init__(
        self,
        name: str,
        parameter: Parameter,
        span: tuple[float, float],
        value: float,
        moved: Callable[[float], None],
        *,
        began: Callable[[], None],
        spanned: Callable[[tuple[float, float]], None],
        fitted: bool | None = None,
        chosen: Callable[[bool], None] | None = None,
        title: str = "",
    ) -> None:
        super().__init__()
        self._value = value
        self._props.update(
            name=title or name, title=parameter.description or name, unit=parameter.unit, low=span[0], high=span[1]
        )
        self._props.update(value=value, fit=fitted)

        def changed(event: Any) -> None:
            self._value = float(event.args)
            moved(self._value)

        self.on("moved", changed, throttle=THROTTLE)
        self.on("began", began)
        self.on("spanned", lambda event: spanned((float(event.args[0]), float(event.args[1]))))
        if chosen is not None:
            self.on("chosen", lambda event: chosen(bool(event.args)))

    def put(self, value: float) -> None:
        """Set the slider to a value, and show it; what a user has set stands there already."""
        if value != self._value:
            self._value = self._props["value"] = value
            self.run_method("put", value)
