"""A record with what a diagnosis found, at a size that a slider sets."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from nicegui import run, ui

import hvdc_ident as hi
from hvdc_ident.app.knob import Knob
from hvdc_ident.app.latest import Latest
from hvdc_ident.app.plot import EFFECT, NOW, RECORDED, Grid, Plot, Trace, thinned
from hvdc_ident.app.setting import Setting, span_of
from hvdc_ident.app.supposed import Supposition, refitted
from hvdc_ident.data import Array
from hvdc_ident.errors import HvdcIdentError
from hvdc_ident.text import with_unit

TALL = 150


@dataclass(frozen=True)
class SizedRun:
    """The runs over a record: before, without what was found, and now. Each by output, (n,). trouble: why there are none."""

    setting: Setting
    before: Mapping[str, Array]
    now: Mapping[str, Array]
    trouble: str = ""

    def signals(self, output: str) -> tuple[Array, Array, Array]:
        """Return recorded, before and now of an output, (n,) each."""
        return self.setting.recorded(output), self.before[output], self.now[output]

    def errors(self, output: str) -> tuple[Array, Array, Array]:
        """Return nothing in place of the recorded signal, and recorded less simulated before and now, (n,) each."""
        recorded, before, now = self.signals(output)
        return np.full(recorded.size, np.nan), recorded - before, recorded - now


def sized_run(before: Setting, now: Setting) -> SizedRun:
    """Return the runs of both settings; where one fails, why."""
    try:
        runs = [s.run() for s in (before, now)]
    except HvdcIdentError as error:
        return SizedRun(now, {}, {}, str(error))
    first, second = ({o: r[o] for o in now.outputs} for r in runs)
    return SizedRun(now, first, second)


class WhatIf:
    """Sliders of the sizes, beginning where they were found; recorded, before and now.

    before: values without the effect. experiment: the one that tells most of it, where that is known.
    """

    def __init__(
        self, study: hi.Study, models: tuple[Supposition, ...], before: Mapping[str, float], experiment: str = ""
    ) -> None:
        self._study, self._models = study, list(models)
        known = {n: v for n, v in before.items() if n in study.model.parameters}
        self._without = study.model.with_values(known)
        self._chosen = models[0]
        self._record = next((e for e in study.experiments if e.name == experiment), study.experiments[0])
        self._errors = False
        self._last: SizedRun | None = None
        self._sizes: dict[str, float] = {}
        self._latest = Latest(lambda pair: sized_run(*pair), self._show)

    def build(self) -> None:
        """Build the choices, the sliders and the plot."""
        with ui.row().classes("w-full items-center gap-3"):
            ui.label("With what was found:").classes("text-subtitle2")
            ui.select(
                {k: m.name for k, m in enumerate(self._models)},
                value=0,
                label="effect and place",
                on_change=self._choose,
            ).props("dense options-dense").style("min-width: 18rem")
            ui.select(
                [e.name for e in self._study.experiments],
                value=self._record.name,
                label="experiment",
                on_change=self._choose_record,
            ).props("dense options-dense").style("min-width: 10rem")
            kind = ui.toggle(["signals", "errors"], value="signals").props("dense no-caps")
            kind.on_value_change(lambda event: self._choose_kind(event.value == "errors"))
            ui.button("As found", on_click=self._restore).props("flat dense no-caps")
        self._knobs = ui.column().classes("w-full gap-0").style("max-width: 46rem")
        self._trouble = ui.label("").classes("text-negative").props('role="alert"')
        self._place = ui.column().classes("w-full gap-0")
        self._restore()
        self._build_plot()

    async def _choose(self, event: Any) -> None:
        which = int(event.value)

        def fitted() -> Supposition | HvdcIdentError:
            try:
                return refitted(self._study, self._models[which])
            except HvdcIdentError as error:
                return error

        found = await run.io_bound(fitted)
        if isinstance(found, Supposition):
            self._models[which] = self._chosen = found
            self._restore()
        elif found is not None:  # None: the server is ending
            self._trouble.text = str(found)

    def _choose_record(self, event: Any) -> None:
        self._record = next(e for e in self._study.experiments if e.name == event.value)
        self._build_plot()
        self._ask()

    def _choose_kind(self, errors: bool) -> None:
        self._errors = errors
        if self._last is not None:
            self._show(self._last)

    def _restore(self) -> None:
        """Set every size to what was found."""
        model = self._chosen.model
        self._sizes = {n: model.parameters[n].value for n in self._chosen.sizes}
        self._knobs.clear()
        with self._knobs:
            for name in self._sizes:
                self._knob(name)
        self._ask()

    def _knob(self, name: str) -> None:
        model = self._chosen.model
        q, span = model.parameters[name], span_of(model, name, {})

        def moved(value: float) -> None:
            self._sizes[name] = value
            knob.tell(value)
            self._ask()

        label = f"{q.description}, {name}" if q.description else name
        knob = Knob(name, q, span, q.value, moved, log=span[0] > 0, label=label)

    def _build_plot(self) -> None:
        outputs = tuple(self._record.outputs)
        self._place.clear()
        curves = (
            Trace("recorded", RECORDED),
            Trace("refitted without it", NOW, dashed=True),
            Trace("with it", EFFECT),
        )
        with self._place:
            units = {o: self._study.model.outputs[o].unit for o in outputs}
            grids = [Grid(with_unit(o, u), curves) for o, u in units.items()]
            self._plot = Plot(grids, "time, s", TALL * len(grids) + 30, "Record with what was found").classes("w-full")

    def _ask(self) -> None:
        outputs = tuple(self._record.outputs)
        without = replace(Setting.of(self._without, self._record), outputs=outputs)
        now = replace(Setting.of(self._chosen.model, self._record), outputs=outputs)
        for name, value in self._sizes.items():
            now = now.with_value(name, value)
        self._latest.ask((without, now))

    def _show(self, found: SizedRun) -> None:
        self._trouble.text = found.trouble
        if found.setting.record is not self._record or found.trouble:
            return  # another experiment has been chosen since
        self._last = found
        for k, output in enumerate(found.setting.outputs):
            columns = found.errors(output) if self._errors else found.signals(output)
            self._plot.whole(k, thinned(np.asarray(found.setting.time), *columns))
