"""Explore: sliders of the parameters and of effects' sizes; waveforms, errors, Bode and poles answer while one is dragged."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from nicegui import run, ui

import hvdc_ident as hi
from hvdc_ident.app.knob import Knob
from hvdc_ident.app.latest import Latest
from hvdc_ident.app.live import Live
from hvdc_ident.app.page import Page, Tab
from hvdc_ident.app.plot import GIVEN, NOW, RECORDED, Grid, Plot, Trace, scattered, thinned
from hvdc_ident.app.results import FoundResults
from hvdc_ident.app.runs import StudyRun
from hvdc_ident.app.setting import (
    KINDS,
    InputCourse,
    Setting,
    equations_of,
    near,
    of_model,
    span_of,
    with_effects,
)
from hvdc_ident.app.slider_values import slider_values, write_slider_values
from hvdc_ident.app.supposed import Supposition, refitted
from hvdc_ident.data import Array
from hvdc_ident.display import Table
from hvdc_ident.effects import effects
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.fit.judgement import Judgement
from hvdc_ident.report.html import table_of, text, typeset
from hvdc_ident.study.fitting import Yardsticks, curves_of_run
from hvdc_ident.summary.tables import count_text
from hvdc_ident.text import factor_text, figures, listed, quantity, with_unit

FIRST = 8
"""Parameters that stand open where no study says which matter."""
LOCUS = 41
"""Points of a root locus."""
TALL = 130
"""Height of one output's picture, px."""
SIGNALS, ERRORS = "signals", "errors"
NOTHING_CHANGED = (
    "Nothing was changed here that the study does not state: move a slider, type a bound, or tick a parameter first."
)
NONE = np.empty(0, complex)


@dataclass(frozen=True)
class Answer:
    """Waveforms, their judgement, operating point, response and poles of one setting; None and empty for what cannot be had.

    trouble: by part of the page why.
    """

    run: hi.Simulation | None
    judged: Judgement | None
    point: hi.OperatingPoint | None
    bode: Any
    poles: Array
    trouble: Mapping[str, str]


def answered(setting: Setting, omega: Array | None = None, by: Yardsticks | None = None) -> Answer:
    """Return the answers of a setting; a part that cannot be had is told, and the others stand.

    omega: of the response, rad/s. by: what a recorded run is judged by.
    """
    trouble: dict[str, str] = {}

    def part(name: str, make: Callable[[], Any]) -> Any:
        try:
            return make()
        except HvdcIdentError as error:
            trouble[name] = str(error)
            return None

    ran = part("waveforms", setting.run)
    record = setting.record
    judged = None
    if by is not None and record is not None and ran is not None:
        judged = by.judge({record.name: curves_of_run(record, ran.trajectory)})
    point = part("operating point", setting.point)
    bode = poles = None
    if point is not None:
        bode = part("frequency response", lambda: setting.response(point, omega))
        poles = part("poles", lambda: setting.poles(point))
    return Answer(ran, judged, point, bode, NONE if poles is None else poles, trouble)


class Explorer:
    """The tab in one browser: its setting, those before it, and the elements that show the answer."""

    def __init__(self, page: Page) -> None:
        self._page, desk = page, page.desk
        record = next(iter(desk.study.experiments), None) if desk.study else None
        self._by = Yardsticks.of(desk.study) if desk.study and record else None
        self._setting = Setting.of(desk.model, record)
        self._given = self._shown = self._setting
        self._past: list[Setting] = []
        self._latest = Latest(self._both, self._take, self._show_slow)
        self._stale = True  # what the page began with is to be drawn anew
        self._moving = ""
        self._omega: Array | None = None
        self._ringed = self._locus = self._now = NONE
        self._knobs: dict[str, Knob] = {}
        self._spans = dict(desk.spans)
        self._stretched: set[str] = set()
        self._fitted = set(desk.study.candidates) if desk.study else set()
        self._kind = SIGNALS
        self._answers: tuple[Answer | None, Answer | None] = (None, None)
        self._starts: dict[str, Supposition] = {}
        self._began = self._setting
        self._awaits_fit = False

    def _both(self, asked: tuple[Setting | None, Setting, Array | None]) -> tuple[Answer | None, Setting, Answer]:
        """Return the answers of the setting as given, where it is asked for, and of the one as it is now, at the same frequencies."""
        given, setting, omega = asked
        first = None if given is None else answered(given, by=self._by)
        if first is not None:
            omega = None if first.bode is None else first.bode.omega
        return first, setting, answered(setting, omega, self._by)

    # --- the page ---

    def build(self) -> None:
        """Build the tab's elements and ask for the first answer."""
        with ui.element("div").classes("bench"):
            with ui.element("div").classes("rail tile"):
                self._build_bar()
                self._errors = Live().classes("live")
                self._rail = ui.element("div")
                self._build_knobs()
                self._build_effects()
                self._build_inputs()
                self._build_writing()
            with ui.element("div").classes("stack"):
                self._trouble = ui.label("").classes("alert").props('role="alert"')
                with ui.element("div").classes("tile"):
                    self._build_choices()
                    self._waves = ui.element("div").classes("w-full")
                with ui.element("div").classes("two"):
                    with ui.element("div").classes("tile"):
                        self._channel = ui.label("").classes("small")
                        two = (Trace("given", GIVEN, dashed=True), Trace("now", NOW))
                        grids = [Grid("gain, dB", two), Grid("phase, degrees", two)]
                        self._bode = Plot(grids, "frequency, Hz", 340, "Frequency response", log=True)
                        self._margins = ui.label("").classes("small")
                    with ui.element("div").classes("tile"):
                        marks = (
                            Trace("locus", GIVEN, mark="dot", size=3),
                            Trace("given", GIVEN, mark="ring", size=9),
                            Trace("now", NOW, mark="cross"),
                        )
                        plane = [Grid("imaginary part, rad/s", marks)]
                        self._poles = Plot(plane, "real part, 1/s", 340, "Poles", plane=True)
                        self._limits = ui.label("").classes("small").props('aria-live="polite"')
                if equations_of(self._setting.model) is not None:
                    with (
                        ui.element("div").classes("tile"),
                        ui.expansion("Sensitivities of the waveforms").props("dense").classes("w-full"),
                    ):
                        self._sensitivities = ui.html("", sanitize=False)
        self._build_waves()
        self._page.on_results(self._offer_starts)
        self._page.on_run(self._take_run)
        self._page.explore = self._open
        self._ask()

    def _build_choices(self) -> None:
        """Build the line that chooses what is shown: outputs, how long, and of what the frequency response is."""
        model, setting, study = self._setting.model, self._setting, self._page.desk.study
        with ui.element("div").classes("choices"):
            if study is not None and setting.record is not None:
                records = [e.name for e in study.experiments]
                self._choice("experiment", records, setting.record.name, self._choose_record)
            self._of = self._choice("waveforms of", list(model.outputs), list(setting.outputs), self._choose_outputs)
            if setting.record is None:
                ui.number("up to, s", value=setting.end, min=1e-6, on_change=self._choose_end).props("dense")
            else:
                self._choice("drawn", [SIGNALS, ERRORS], SIGNALS, self._choose_kind)
            from_, to = setting.channel
            self._from = self._choice("response from", list(model.inputs), from_, lambda v: self._look_into(source=v))
            self._to = self._choice("to", list(model.outputs), to, lambda v: self._look_into(output=v))
            if equations_of(model) is not None:
                opened = ["", *(n for n in model.insertion_points if n in model.signals or n in model.states)]
                self._choice("or loop opened at", opened, "", lambda v: self._look(opened=v or "", port=None))
            if ports := self._page.desk.ports:
                self._choice("or impedance at", ["", *ports], "", lambda v: self._look(port=ports.get(v), opened=""))

    def _choice(self, label: str, options: list[str], value: Any, chosen: Callable[[Any], None]) -> ui.select:
        several = isinstance(value, list)
        field = ui.select(options, value=value, label=label, multiple=several, with_input=not several)
        field.on_value_change(lambda event: chosen(event.value))
        field.props("dense options-dense stack-label")
        return field

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
        study = self._page.desk.study
        record = next((e for e in (study.experiments if study else ()) if e.name == name), None)
        before = self._setting.record
        if record is None or before is None:
            return
        now, own = self._setting.of_record(record), self._setting.of_record(before)
        self._look(record=record, end=now.end)
        if (now.outputs, now.channel) != (own.outputs, own.channel):  # another test: what was looked at is not of it
            self._of.value = list(now.outputs)
            self._from.value, self._to.value = now.channel

    def _choose_kind(self, kind: str) -> None:
        self._kind = kind or SIGNALS
        self._build_waves()
        self._draw_waves()

    def _choose_end(self, event: Any) -> None:
        if event.value and event.value > 0:
            self._look(end=float(event.value))

    def _build_bar(self) -> None:
        with ui.element("div").classes("line"):
            ui.button("Undo", on_click=self._back).props("flat dense").tooltip("Ctrl-Z")
            ui.button("As given", on_click=lambda: self._set(replace(self._given, **self._looks()))).props("flat dense")
            ui.space()
            if self._page.desk.study is not None:
                self._fit_button = ui.button("Fit", on_click=self._fit).props("unelevated dense").classes("q-px-md")
                self._fit_button.tooltip(
                    "Writes what was set here to the study, fits the ticked parameters within their bounds to its recordings, and "
                    "shows the fitted values."
                )
        self._progress = ui.label("").classes("small").props('aria-live="polite"').style("overflow-wrap: anywhere")
        self._start = ui.select({"": "given values"}, value="", label="model with").props("dense options-dense")
        self._start.classes("w-full").on_value_change(lambda event: self._choose_start(event.value))
        self._start.visible = self._progress.visible = False
        ui.keyboard(on_key=self._on_key)

    def _offer_starts(self, results: FoundResults) -> None:
        """Offer the models that the results come to: the fitted one, and those with what a diagnosis found."""
        self._starts = {m.name: m for m in results.models}
        names = {"": "given values", **{n: n for n in self._starts}}
        self._start.set_options(names, value=self._setting.start if self._setting.start in names else "")
        self._start.visible = len(names) > 1
        waited = self._awaits_fit or self._setting is self._began  # what somebody has set by hand since is left alone
        if results.fitted is None or not results.is_of_the_study("fit") or not waited:
            return
        again = results.fitted.name == self._setting.start and results.fitted.model.values == self._setting.base.values
        if self._awaits_fit or not again:
            self._begin_with(results.fitted)
        self._began, self._awaits_fit = self._setting, False

    def _open(self, name: str) -> None:
        """Open the tab with a model that the results come to."""
        self._page.open(TAB.title)
        self._start.value = name

    async def _choose_start(self, name: str | None) -> None:
        study = self._page.desk.study
        if (name or "") == self._setting.start:
            return  # the choice follows what is shown
        if not name or study is None:
            self._set(replace(self._given, **self._looks()))
            return
        supposition = await run.io_bound(refitted, study, self._starts[name])
        if supposition is not None:  # None: the server is ending
            self._starts[name] = supposition
            self._begin_with(supposition)

    def _begin_with(self, supposition: Supposition) -> None:
        """Show a model that the results come to, with its values."""
        shown = of_model(replace(self._given, **self._looks()), supposition.model)
        self._set(replace(shown, start=supposition.name, titles=supposition.titles))

    async def _fit(self) -> None:
        """Write what was set here to the study and run its fit; the page is told when that ends."""
        if await self._write(quiet=True):
            self._awaits_fit = self._page.start("fit") is not None

    def _take_run(self, study_run: StudyRun | None) -> None:
        """Show how the run stands, and why a fit that was asked for here has none."""
        if self._page.desk.study is None:
            return
        working = study_run is not None and study_run.outcome == "running"
        self._fit_button.set_enabled(not working)
        ended = self._awaits_fit and study_run is not None and not working
        if ended and study_run is not None and study_run.outcome != "done":
            self._awaits_fit = False
            ui.notify(
                study_run.message or "The fit was cancelled.",
                type="negative",
                multi_line=True,
                timeout=0,
                close_button="Close",
            )
        self._progress.visible = working
        if study_run is not None and working:
            self._progress.text = study_run.text

    def _looks(self) -> dict[str, Any]:
        return {
            n: getattr(self._setting, n) for n in ("courses", "end", "outputs", "channel", "opened", "port", "record")
        }

    def _build_knobs(self) -> None:
        self._rail.clear()
        self._knobs = {}
        names = list(self._setting.model.parameters)
        added = [n for n in names if n not in self._given.model.parameters]
        first = [*added, *([n for n in names if n in self._page.desk.spans] or names[:FIRST])]
        with self._rail:
            for name in first:
                self._build_knob(name)
            if rest := [n for n in names if n not in first]:
                with ui.expansion(f"{len(rest)} more parameters").props("dense").classes("w-full"):
                    for name in rest:
                        self._build_knob(name)

    def _build_knob(self, name: str) -> None:
        study, model = self._page.desk.study, self._setting.model

        def moved(value: float) -> None:
            self._set(self._setting.with_value(name, value), moving=name)

        def spanned(span: tuple[float, float]) -> None:
            self._spans[name] = span
            self._stretched.add(name)

        def chosen(fitted: bool) -> None:
            (self._fitted.add if fitted else self._fitted.discard)(name)

        self._knobs[name] = Knob(
            name, model.parameters[name], span_of(model, name, self._spans), self._setting.parameters[name], moved,
            began=self._remember, spanned=spanned, chosen=chosen,
            fitted=None if study is None or name not in study.model.parameters else name in self._fitted,
            title=self._setting.titles.get(name, ""),
        )  # fmt: skip

    def _build_effects(self) -> None:
        with ui.expansion("Effects").props("dense").classes("w-full"):
            self._effects = ui.element("div").classes("w-full")
            named = [n for n, e in effects().items() if not e.needs_expression]
            places = list(self._setting.model.insertion_points)
            kind = ui.select(named, value="lag", label="effect").classes("w-full")
            place = ui.select(places, value=places[0] if places else None, label="at", with_input=True)
            source = ui.select(["", *places], value="", label="from", with_input=True).classes("w-full")
            for field in (kind, place.classes("w-full"), source):
                field.props("dense options-dense")

            def add() -> None:
                use = {"effect": kind.value, "at": place.value, "parameters": dict(effects()[kind.value].example)}
                self._put_effects([*self._setting.effects, use | ({"from": source.value} if source.value else {})])

            ui.button("Add", on_click=add).props("flat dense")

    def _put_effects(self, uses: list[Mapping[str, Any]]) -> None:
        try:
            self._set(with_effects(self._setting, uses))
        except HvdcIdentError as error:
            ui.notify(str(error), type="negative", multi_line=True)

    def _show_effects(self) -> None:
        """List the effects that were added, each with a button that takes it out."""
        self._effects.clear()
        with self._effects:
            for k, use in enumerate(self._setting.effects):
                rest = [*self._setting.effects[:k], *self._setting.effects[k + 1 :]]
                at = use["at"] if isinstance(use["at"], str) else listed(use["at"])
                with ui.element("div").classes("line"):
                    ui.label(f"{use['effect']} at {at}").classes("col")
                    remove = ui.button("Remove", on_click=lambda rest=rest: self._put_effects(rest))
                    remove.props(f'flat dense aria-label="Remove {use["effect"]} at {at}"')

    def _build_inputs(self) -> None:
        if self._setting.record is not None:
            return
        with ui.expansion("Inputs", value=True).classes("w-full").props("dense"):
            for name, course in self._setting.courses.items():
                unit = self._setting.model.inputs[name].unit
                with ui.row().classes("w-full items-center no-wrap gap-1"):
                    ui.label(name).classes("col-3 ellipsis text-caption").tooltip(f"{name}, {unit}")
                    for key in ("kind", "level", "size"):
                        self._course_field(name, key, getattr(course, key))

    def _course_field(self, name: str, key: str, value: Any) -> None:
        def changed(event: Any) -> None:
            if event.value is not None:
                course: InputCourse = replace(self._setting.courses[name], **{key: event.value})
                self._set(self._setting.with_course(name, course))

        field = ui.select(list(KINDS), value=value) if key == "kind" else ui.number(key, value=value, format="%.6g")
        field.on_value_change(changed)
        field.props(f'dense options-dense aria-label="{name}: {"course" if key == "kind" else key}"').classes("col")

    def _build_writing(self) -> None:
        if self._page.desk.study is not None:
            button = (
                ui.button("Write to the study", on_click=lambda: self._write())
                .props("outline")
                .classes("w-full q-mt-sm")
            )
            button.tooltip(
                "Writes what was changed here: which parameters are fitted, their bounds, and the sliders' values, "
                "of fitted parameters as starts, of others as values of the model; effects that were added."
            )

    async def _write(self, *, quiet: bool = False) -> bool:
        """Write what was set here to the study, and return whether it states it then. quiet: says nothing where nothing was changed."""
        desk = self._page.desk
        assert desk.study is not None
        asked = slider_values(desk.study, self._setting, self._fitted, {n: self._spans[n] for n in self._stretched})
        try:
            said = await run.io_bound(write_slider_values, desk.file, asked)
        except HvdcIdentError as error:
            ui.notify(str(error), type="negative", multi_line=True)
            return False
        if said is None:
            return False  # the server is ending
        if said:
            self._page.desk = await run.io_bound(desk.renewed) or desk
            ui.notify(said, type="positive", multi_line=True)
        elif not quiet:
            ui.notify(NOTHING_CHANGED, type="info", multi_line=True)
        return True

    @property
    def _draws_recorded(self) -> bool:
        """True where the recorded signal is drawn, below the others."""
        return self._setting.record is not None and self._kind == SIGNALS

    def _build_waves(self) -> None:
        self._waves.clear()
        units = {n: self._setting.model.outputs[n].unit for n in self._setting.outputs}
        recorded = [Trace("recorded", RECORDED)] if self._draws_recorded else []
        curves = (
            *recorded,
            Trace("given", GIVEN, dashed=True),
            Trace("now", NOW),
        )  # the last one lies above the others
        grids = [Grid(with_unit(n, u), curves) for n, u in units.items()]
        with self._waves:
            self._wave = Plot(grids, "time, s", max(260, TALL * len(grids)), "Waveforms").classes("w-full")

    # --- changes ---

    def _set(self, setting: Setting, *, moving: str = "") -> None:
        if not moving:
            self._remember()
        before, self._setting, self._moving = self._setting, setting, moving
        if before.model is not setting.model:
            self._build_knobs()
            self._show_effects()
        for name, knob in ({} if moving else self._knobs).items():
            knob.put(setting.parameters[name])
        if self._start.value != setting.start and setting.start in ("", *self._starts):
            self._start.value = setting.start
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

    def _take(self, answers: tuple[Answer | None, Setting, Answer]) -> None:
        given, setting, answer = answers
        if given is not None:
            self._stale = False
            self._omega = None if given.bode is None else given.bode.omega
            self._ringed, self._locus = near(given.poles), NONE
        self._answers, self._shown = (given or self._answers[0], answer), setting
        trouble = "; ".join(answer.trouble.values())
        if trouble != self._trouble.text:
            self._trouble.text = trouble
        if given is None:
            ran = answer.run is not None and setting.outputs == self._setting.outputs
            for k, name in enumerate(setting.outputs if ran else ()):
                self._wave.put(
                    k, 3 if self._draws_recorded else 2, thinned(setting.time, self._drawn(setting, answer, name))[1]
                )
            for k, column in enumerate(() if answer.bode is None else _gain_and_phase(answer.bode)):
                self._bode.put(k, 2, column)
        else:
            self._draw_waves()
            self._draw_bode()
        self._show_errors()
        self._now = near(answer.poles)
        self._poles.whole(0, scattered(self._locus, self._ringed, self._now))
        if answer.point is not None:
            active = answer.point.active_limits
            said = f"On a limit: {', '.join(map(str, active))}" if active else "No limit is active."
            if said != self._limits.text:
                self._limits.text = said
                self._limits.classes(replace="alert" if active else "small")

    def _drawn(self, setting: Setting, answer: Answer | None, name: str) -> Array:
        """Return what is drawn of an answer's output: the signal, or recorded less simulated; nan where there is none."""
        if answer is None or answer.run is None:
            return np.full(setting.time.size, np.nan)
        return setting.recorded(name) - answer.run[name] if self._kind == ERRORS else answer.run[name]

    def _draw_waves(self) -> None:
        setting, (given, now) = self._shown, self._answers
        if setting.outputs != self._setting.outputs:
            return  # the answer to what is looked at now is on its way
        for k, name in enumerate(setting.outputs):
            columns = [self._drawn(setting, given, name), self._drawn(setting, now, name)]
            if self._draws_recorded:
                columns.insert(0, setting.recorded(name))
            self._wave.whole(k, thinned(setting.time, *columns))
            self._wave.shade(k, setting.bad(name))

    def _draw_bode(self) -> None:
        given, now = (None if a is None else a.bode for a in self._answers)
        first = given or now
        if first is not None:
            pairs = zip(_gain_and_phase(given or now), _gain_and_phase(now or given), strict=True)
            for k, (one, other) in enumerate(pairs):
                self._bode.whole(k, [first.frequency_hz, one, other])
        self._channel.text = self._shown.response_text

    def _show_errors(self, verdicts: Judgement | None = None) -> None:
        """Show the error of every recorded signal of the experiment; the verdicts once all recordings are judged.

        The verdict on a signal depends on how many are judged, so that one recording alone has none.
        """
        record = self._shown.record
        given, now = (None if a is None else a.judged for a in self._answers)
        if record is None or now is None:
            self._errors.put("")
            return
        rows = []
        for output, line in now.signals.items():
            e = line[record.name]
            before = given.signals[output][record.name].rmse if given is not None and output in given.signals else None
            follows = None if verdicts is None else verdicts.signals[output][record.name].follows[verdicts.by]
            rows.append(
                (
                    with_unit(output, self._setting.model.outputs[output].unit),
                    "" if before is None else figures(before, 2),
                    figures(e.rmse, 2),
                    factor_text(e.rmse / e.noise) if e.noise else "",
                    {None: "", True: "PASS", False: "FAIL"}[follows],
                )
            )
        table = Table(("RMSE", "given", "now", "× noise", ""), tuple(rows))
        told = "" if verdicts is None else count_text(verdicts.count(verdicts.by)) or "not judged"
        rest = f"; {typeset(told)} in all recordings, by the {verdicts.by}" if verdicts is not None else ""
        self._errors.put(f"{table_of(table)}<p class='small'>In {text(record.name)}{rest}</p>")

    async def _show_slow(self) -> None:
        """Show the verdicts, the margins, the locus of the parameter that was moved, and the sensitivities."""
        setting, name = self._setting, self._moving
        study, by = self._page.desk.study, self._by

        def slow() -> tuple[Judgement | None, str, Array]:
            verdicts = None
            try:
                if by is not None and study is not None:
                    runs = {e.name: replace(setting, record=e).run().trajectory for e in study.experiments}
                    verdicts = by.judge({e.name: curves_of_run(e, runs[e.name]) for e in study.experiments})
                words = setting.margins(setting.point())
            except HvdcIdentError as error:
                words = str(error)
            model = equations_of(setting.model)
            if not name or model is None:
                return verdicts, words, NONE
            low, high = span_of(setting.model, name, self._spans)
            fixed = {n: v for n, v in setting.values.items() if n != name}
            try:
                locus = hi.linear.root_locus(model, name, np.linspace(low, high, LOCUS), fixed)
            except HvdcIdentError as error:
                return verdicts, f"{words} No locus of {name}: {error}", NONE
            return verdicts, words, np.concatenate([near(poles) for poles in locus.eigenvalues])

        results = await run.io_bound(slow)
        if results is not None and setting is self._setting:
            verdicts, self._margins.text, self._locus = results
            self._show_errors(verdicts)
            self._poles.whole(0, scattered(self._locus, self._ringed, self._now))
        if equations_of(setting.model) is not None:
            table = await run.io_bound(_sensitivity_table, setting)
            if table is not None and setting is self._setting:
                self._sensitivities.content = table_of(table)


def _sensitivity_table(setting: Setting) -> Table:
    """Return the table of sensitivities, the largest first; without rows where they cannot be had."""
    header = ("parameter (RMS of the derivative times the value)", *setting.outputs)
    try:
        derivatives = setting.sensitivities()
    except HvdcIdentError:
        return Table(header, ())  # the page says already why the model does not run
    units = {n: setting.model.outputs[n].unit for n in setting.outputs}
    order = sorted(derivatives, key=lambda n: -max(derivatives[n].values(), default=0.0))
    return Table(
        header, tuple((n, *(quantity(derivatives[n].get(o, 0.0), units[o]) for o in setting.outputs)) for n in order)
    )


def _gain_and_phase(response: Any) -> tuple[Array, Array]:
    """Return (n,) dB and (n,) degrees of the response's one channel."""
    return response.magnitude_db[:, 0, 0], response.phase_deg[:, 0, 0]


TAB = Tab(order=10, title="Explore", build=lambda page: Explorer(page).build())
