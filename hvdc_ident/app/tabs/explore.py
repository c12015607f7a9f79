"""Explore: sliders of the parameters and of effects' sizes; waveforms, Bode and poles answer while one is dragged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from nicegui import run, ui

import hvdc_ident as hi
from hvdc_ident.app.desk import Desk
from hvdc_ident.app.knob import Knob
from hvdc_ident.app.latest import Latest
from hvdc_ident.app.plot import GIVEN, NOW, RECORDED, Grid, Plot, Trace, scattered, thinned
from hvdc_ident.app.server import Tab
from hvdc_ident.app.setting import KINDS, InputCourse, Setting, equations_of, near, span_of, with_effect
from hvdc_ident.data import Array
from hvdc_ident.effects import effects
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.text import quantity, with_unit

FIRST = 8
"""Parameters that stand open where no study says which matter."""
PARAMETER = "parameter (RMS of the derivative times the value)"
LOCUS = 41
"""Points of a root locus."""


NONE = np.empty(0, complex)


@dataclass(frozen=True)
class Answer:
    """Waveforms, operating point, response and poles of one setting; None and empty for what cannot be had.

    trouble: by part of the page why.
    """

    run: hi.Simulation | None
    point: hi.OperatingPoint | None
    bode: Any
    poles: Array
    trouble: Mapping[str, str]


def answered(setting: Setting, omega: Array | None = None) -> Answer:
    """Return the answers of a setting; a part that cannot be had is told, and the others stand. omega: of the response, rad/s."""
    trouble: dict[str, str] = {}

    def part(name: str, make: Callable[[], Any]) -> Any:
        try:
            return make()
        except HvdcIdentError as error:
            trouble[name] = str(error)
            return None

    ran = part("waveforms", setting.run)
    point = part("operating point", setting.point)
    bode = poles = None
    if point is not None:
        bode = part("frequency response", lambda: setting.response(point, omega))
        poles = part("poles", lambda: setting.poles(point))
    return Answer(ran, point, bode, NONE if poles is None else poles, trouble)


def _both(asked: tuple[Setting | None, Setting, Array | None]) -> tuple[Answer | None, Setting, Answer]:
    """Return the answers of the setting as given, where it is asked for, and of the one as it is now, at the same frequencies."""
    given, setting, omega = asked
    first = None if given is None else answered(given)
    if first is not None:
        omega = None if first.bode is None else first.bode.omega
    return first, setting, answered(setting, omega)


class Explorer:
    """The tab in one browser: its setting, those before it, and the elements that show the answer."""

    def __init__(self, desk: Desk) -> None:
        record = next(iter(desk.study.experiments), None) if desk.study else None
        self._desk, self._setting = desk, Setting.of(desk.model, record)
        self._given = self._setting
        self._past: list[Setting] = []
        self._latest = Latest(_both, self._take, self._show_slow)
        self._stale = True  # what the page began with is to be drawn anew
        self._moving = ""
        self._omega: Array | None = None
        self._ringed = self._locus = self._now = NONE
        self._sliders: dict[str, Knob] = {}

    # --- the page ---

    def build(self) -> None:
        """Build the tab's elements and ask for the first answer."""
        with ui.row().classes("w-full no-wrap items-start"):
            with ui.column().classes("gap-0").style("width: 21rem; flex: none"):
                self._build_bar()
                self._knobs = ui.column().classes("w-full gap-0")
                self._build_knobs()
                self._build_effects()
                self._build_inputs()
            with ui.column().classes("col gap-0").style("min-width: 0"):
                self._trouble = ui.label("").classes("text-negative").props('role="alert"')
                self._build_choices()
                self._waves = ui.element("div").classes("w-full")
                with ui.row().classes("w-full no-wrap gap-0"):
                    two = (Trace("given", GIVEN, dashed=True), Trace("now", NOW))
                    grids = [Grid("gain, dB", two), Grid("phase, degrees", two)]
                    self._bode = Plot(grids, "frequency, Hz", 350, "Frequency response", log=True).classes("col-7")
                    marks = (
                        Trace("locus", GIVEN, mark="dot", size=3),
                        Trace("given", GIVEN, mark="ring", size=9),
                        Trace("now", NOW, mark="cross"),
                    )
                    plane = [Grid("imaginary part, rad/s", marks)]
                    self._poles = Plot(plane, "real part, 1/s", 350, "Poles", plane=True).classes("col-5")
                with ui.row().classes("w-full items-center text-caption"):
                    self._limits = ui.label("").props('aria-live="polite"')
                    self._margins = ui.label("")
                if equations_of(self._setting.model) is not None:
                    with ui.expansion("Sensitivities of the waveforms").classes("w-full"):
                        self._table = ui.table(rows=[], row_key=PARAMETER).props("dense flat").classes("w-full")
        self._build_waves()
        self._ask()

    def _build_choices(self) -> None:
        """Build the line that chooses what is shown: outputs, how long, and of what the frequency response is."""
        model, setting = self._setting.model, self._setting
        with ui.row().classes("w-full items-center gap-3"):
            if self._desk.study is not None and setting.record is not None:
                records = [e.name for e in self._desk.study.experiments]
                self._choice("experiment", records, setting.record.name, self._choose_record)
            self._choice(
                "waveforms of", list(model.outputs), list(setting.outputs), self._choose_outputs, multiple=True
            )
            if setting.record is None:
                ui.number("up to, s", value=setting.end, min=1e-6, on_change=self._choose_end).props("dense").style(
                    "width: 5rem"
                )
            from_, to = setting.channel
            self._choice("response from", list(model.inputs), from_, lambda v: self._look_into(source=v))
            self._choice("to", list(model.outputs), to, lambda v: self._look_into(output=v))
            if equations_of(model) is not None:
                opened = ["", *(n for n in model.insertion_points if n in model.signals or n in model.states)]
                self._choice("or loop opened at", opened, "", lambda v: self._look(opened=v or "", port=None))
            if ports := self._desk.ports:
                self._choice("or impedance at", ["", *ports], "", lambda v: self._look(port=ports.get(v), opened=""))

    def _choice(
        self, label: str, options: list[str], value: Any, chosen: Callable[[Any], None], *, multiple: bool = False
    ) -> None:
        def changed(event: Any) -> None:
            chosen(event.value)

        ui.select(
            options, value=value, label=label, multiple=multiple, with_input=not multiple, on_change=changed
        ).props("dense options-dense").style("min-width: 9rem; max-width: 18rem")

    def _look(self, **changes: Any) -> None:
        """Change what is looked at, of the setting as it is now and of the one as given."""
        self._given = replace(self._given, **changes)
        self._stale = True
        self._set(replace(self._setting, **changes))

    def _look_into(self, source: str = "", output: str = "") -> None:
        now = self._setting.channel
        self._look(channel=(source or now[0], output or now[1]), opened="", port=None)

    def _choose_outputs(self, names: list[str]) -> None:
        if names:
            self._look(outputs=tuple(names))
            self._build_waves()

    def _choose_record(self, name: str) -> None:
        record = next((e for e in (self._desk.study.experiments if self._desk.study else ()) if e.name == name), None)
        if record is not None:
            self._look(record=record)

    def _choose_end(self, event: Any) -> None:
        if event.value and event.value > 0:
            self._look(end=float(event.value))

    def _build_bar(self) -> None:
        with ui.row().classes("w-full items-center"):
            self._undo = ui.button("Undo", on_click=self._back).props("flat dense")
            ui.button("As given", on_click=lambda: self._set(self._given)).props("flat dense")
        ui.keyboard(on_key=self._on_key)

    def _build_knobs(self) -> None:
        self._knobs.clear()
        self._sliders = {}
        names = list(self._setting.model.parameters)
        added = [n for n in names if n not in self._given.model.parameters]
        first = [*added, *([n for n in names if n in self._desk.spans] or names[:FIRST])]
        with self._knobs:
            for name in first:
                self._knob(name)
            if rest := [n for n in names if n not in first]:
                with ui.expansion(f"{len(rest)} more parameters").classes("w-full"):
                    for name in rest:
                        self._knob(name)

    def _knob(self, name: str) -> None:
        low, high = span = span_of(self._setting.model, name, self._desk.spans)

        def moved(value: float) -> None:
            self._set(self._setting.with_value(name, value), moving=name)

        self._sliders[name] = Knob(
            name, self._setting.model.parameters[name], span, self._setting.parameters[name], moved,
            log=low > 0 and high > 20.0 * low, began=self._remember,
        )  # fmt: skip

    def _build_effects(self) -> None:
        with ui.expansion("Add an effect").classes("w-full"):
            kind = ui.select(
                [n for n, e in effects().items() if not e.needs_expression], value="lag", label="effect"
            ).classes("w-full")
            place = ui.select(list(self._setting.model.insertion_points), label="at", with_input=True).classes("w-full")
            source = ui.select([""], value="", label="from", with_input=True).classes("w-full")
            source.set_options(["", *self._setting.model.insertion_points])

            def add() -> None:
                use: dict[str, object] = {
                    "effect": kind.value,
                    "at": place.value,
                    "parameters": dict(effects()[kind.value].example),
                }
                if source.value:
                    use["from"] = source.value
                try:
                    self._set(with_effect(self._setting, use), rebuilt=True)
                except HvdcIdentError as error:
                    ui.notify(str(error), type="negative", multi_line=True)

            ui.button("Add", on_click=add).props("flat dense")

    def _build_inputs(self) -> None:
        if self._setting.record is not None:
            return
        with ui.expansion("Inputs", value=True).classes("w-full").props("dense"):
            for name, course in self._setting.courses.items():
                unit = self._setting.model.inputs[name].unit
                with ui.row().classes("w-full items-center no-wrap gap-1"):
                    ui.label(name).classes("col-3 ellipsis text-caption").tooltip(f"{name}, {unit}")
                    for key, options in (("kind", KINDS), ("level", None), ("size", None)):
                        self._course_field(name, key, getattr(course, key), options)

    def _course_field(self, name: str, key: str, value: Any, options: Any) -> None:
        def changed(event: Any) -> None:
            if event.value is not None:
                course: InputCourse = replace(self._setting.courses[name], **{key: event.value})
                self._set(self._setting.with_course(name, course))

        if options:
            ui.select(list(options), value=value, on_change=changed).props(
                f'dense aria-label="{name}: course"'
            ).classes("col")
        else:
            ui.number(key, value=value, on_change=changed, format="%.6g").props(
                f'dense aria-label="{name}: {key}"'
            ).classes("col")

    def _build_waves(self) -> None:
        self._waves.clear()
        units = {n: self._setting.model.outputs[n].unit for n in self._setting.outputs}
        curves = [Trace("given", GIVEN, dashed=True), Trace("now", NOW)]
        curves += [Trace("recorded", RECORDED)] if self._setting.record else []
        grids = [Grid(with_unit(n, u), tuple(curves)) for n, u in units.items()]
        with self._waves:
            self._wave = Plot(grids, "time, s", 400, "Waveforms").classes("w-full")

    # --- changes ---

    def _set(self, setting: Setting, *, moving: str = "", rebuilt: bool = False) -> None:
        if not moving:
            self._remember()
        before, self._setting, self._moving = self._setting, setting, moving
        if rebuilt or before.model is not setting.model:
            self._build_knobs()
        for name, knob in ({} if moving else self._sliders).items():
            knob.put(setting.parameters[name])
        self._ask()

    def _remember(self) -> None:
        if not self._past or self._past[-1] is not self._setting:
            self._past.append(self._setting)

    def _back(self) -> None:
        while self._past and self._past[-1] is self._setting:
            self._past.pop()
        if self._past:
            before = self._past.pop()
            self._set(before)
            self._past.pop()

    def _on_key(self, event: Any) -> None:
        if event.action.keydown and event.key == "z" and (event.modifiers.ctrl or event.modifiers.meta):
            self._back()

    # --- answers ---

    def _ask(self) -> None:
        self._latest.ask((self._given if self._stale else None, self._setting, self._omega))

    def _take(self, found: tuple[Answer | None, Setting, Answer]) -> None:
        given, setting, answer = found
        if given is not None:
            self._stale = False
            self._show_given(given)
        self._show(setting, answer)

    def _show(self, setting: Setting, answer: Answer) -> None:
        """Replace what is drawn of the setting as it is now, all in one message."""
        if knob := self._sliders.get(self._moving):
            knob.tell(setting.parameters[self._moving])
        self._trouble.text = "; ".join(answer.trouble.values())
        if answer.run is not None:
            for k, name in enumerate(setting.outputs):
                self._wave.put(k, 2, thinned(setting.time, answer.run[name])[1])
        if answer.bode is not None:
            for k, column in enumerate(_gain_and_phase(answer.bode)):
                self._bode.put(k, 2, column)
        self._now = near(answer.poles)
        self._poles.whole(0, scattered(self._locus, self._ringed, self._now))
        if answer.point is not None:
            active = answer.point.active_limits
            text = f"On a limit: {', '.join(map(str, active))}" if active else "No limit is active."
            if text != self._limits.text:
                self._limits.text = text
                self._limits.classes(replace="text-negative text-bold" if active else "")

    def _show_given(self, answer: Answer) -> None:
        """Draw what the page began with, beside which the rest is seen; of the setting now the same, until that is known."""
        setting = self._given
        if answer.run is not None:
            for k, name in enumerate(setting.outputs):
                given = answer.run[name]
                beside = [setting.recorded(name)] if setting.record else []
                self._wave.whole(k, thinned(setting.time, given, given, *beside))
        self._omega = None
        if answer.bode is not None:
            self._omega = answer.bode.omega
            for k, column in enumerate(_gain_and_phase(answer.bode)):
                self._bode.whole(k, [answer.bode.frequency_hz, column, column])
        self._ringed, self._locus = near(answer.poles), NONE

    async def _show_slow(self) -> None:
        """Show the margins, the locus of the parameter that was moved, and the sensitivities."""
        setting, name = self._setting, self._moving

        def slow() -> tuple[str, Array]:
            try:
                text = setting.margins(setting.point())
            except HvdcIdentError as error:
                text = str(error)
            model = equations_of(setting.model)
            if not name or model is None:
                return text, NONE
            low, high = span_of(setting.model, name, self._desk.spans)
            fixed = {n: v for n, v in setting.values.items() if n != name}
            try:
                locus = hi.linear.root_locus(model, name, np.linspace(low, high, LOCUS), fixed)
            except HvdcIdentError as error:
                return f"{text} No locus of {name}: {error}", NONE
            return text, near(locus.eigenvalues.ravel())

        found = await run.io_bound(slow)
        if found is not None and setting is self._setting:
            self._margins.text, self._locus = found
            self._poles.whole(0, scattered(self._locus, self._ringed, self._now))
        if equations_of(setting.model) is not None:
            rows = await run.io_bound(_sensitivity_rows, setting)
            if rows is not None and setting is self._setting:
                names = [PARAMETER, *setting.outputs]
                self._table.columns = [{"name": n, "label": n, "field": n, "align": "left"} for n in names]
                self._table.rows = rows


def _sensitivity_rows(setting: Setting) -> list[dict[str, str]]:
    """Return the rows of the table of sensitivities, the largest first; none where they cannot be had."""
    try:
        found = setting.sensitivities()
    except HvdcIdentError:
        return []  # the page says already why the model does not run
    units = {n: setting.model.outputs[n].unit for n in setting.outputs}
    order = sorted(found, key=lambda n: -max(found[n].values(), default=0.0))
    return [{PARAMETER: n, **{o: quantity(v, units[o]) for o, v in found[n].items()}} for n in order]


def _gain_and_phase(response: Any) -> tuple[Array, Array]:
    """Return (n,) dB and (n,) degrees of the response's one channel."""
    return response.magnitude_db[:, 0, 0], response.phase_deg[:, 0, 0]


TAB = Tab(order=10, title="Explore", build=lambda desk: Explorer(desk).build())
