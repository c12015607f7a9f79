"""Map a recording: its signals become inputs and outputs of the model, with units, event and window; writes the study file."""

from __future__ import annotations

import asyncio
import os
import tempfile
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from nicegui import background_tasks, run, ui

import hvdc_ident as hi
from hvdc_ident.app.desk import Desk, opened
from hvdc_ident.app.mapping import (
    Draft,
    RecordingMap,
    SignalLine,
    columns_with_derived,
    drafted,
    experiments_in,
    proposed,
    write_mapping,
)
from hvdc_ident.app.page import Tab
from hvdc_ident.app.plot import NOW, RECORDED, Grid, Marker, Plot, Trace, focused, sketch, thinned
from hvdc_ident.app.study_folder import (
    MOST_BYTES,
    Seen,
    chosen_recording,
    keep_recordings,
    recordings_in,
    safe_name,
    stamp,
)
from hvdc_ident.data import Array, Trajectory, bands, event_time
from hvdc_ident.errors import HvdcIdentError, StudyError
from hvdc_ident.model import AnyModel
from hvdc_ident.models import shipped_models
from hvdc_ident.study.column_matching import Column, Kind, Matching, columns_of
from hvdc_ident.study.parse import parse_study

REST = 0.3
"""Seconds that a mapping has to stand before it is checked."""
POLL = 1.0
"""Seconds between two looks at the study file."""
MOST_ROWS = 40
"""Signals of the list that are shown at once; the search finds the others."""
MOST_GRIDS = 8
"""Signals that are drawn below each other."""
THUMBNAIL = (110, 34)
"""Width and height of a signal's small picture, px."""
HEIGHT = 470
"""Of the plot, px, where its grids fit in."""
EVENT_COLOR, DOUBT = "var(--fail)", "var(--focus)"
NOTHING = (
    "<p><strong>Drop a recording above</strong>, anywhere on this page, or choose one of the study's folder.</p><p>COMTRADE (.cfg and "
    ".dat together), MATLAB, PSCAD, CSV and other formats are read. Its columns become inputs and outputs of the model, the event and the "
    "window are dragged on the plot, and all of it becomes a study file.</p>"
)
DROP_ANYWHERE = """
document.addEventListener("dragover", (e) => e.preventDefault());
document.addEventListener("drop", (e) => {
  const upload = getElement(%d);
  if (upload.$el.contains(e.target)) return;
  e.preventDefault();  // else the browser leaves the page for the file
  if (upload.$el.offsetParent) upload.$refs.qRef.addFiles(e.dataTransfer.files);
});
"""
"""A file that is dropped beside the place for it goes there all the same."""


class Mapper:
    """The tab in one browser: the study file as it was seen, the recording, its mapping, and the elements that show them."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._with_study = desk, desk.study is not None
        self._source = desk.source
        self._seen = Seen(desk.file, None)
        self._stamp = desk.read_at
        self._turn = asyncio.Lock()  # reading and writing the study file follow one another, as they were asked for
        self._raw: Trajectory | None = None
        self._record: Trajectory | None = None  # with what its phases give
        self._columns: tuple[Column, ...] = ()
        self._matching: Matching | None = None
        self._map: RecordingMap | None = None
        self._was = ""
        self._changed = self._edited = False
        self._draft: Draft | None = None
        self._asked = self._working = 0
        self._view: tuple[float, float] | None = None
        self._rows: dict[str, Callable[[], None]] = {}
        self._sketches: dict[str, str] = {}
        self._levels: dict[str, ui.label] = {}
        self._rested_at: float | None = None
        self._showing = False
        self._plot: Plot | None = None

    # --- the page ---

    def build(self) -> None:
        """Build the tab's elements; what is on the desk is read when the tab is looked at for the first time."""
        self._place = ui.element("div")
        with ui.element("div").classes("stack"):
            with ui.element("div").classes("tile"):
                self._build_files()
            self._banner = ui.element("div").classes("tile line").props('role="status"')
            self._banner.visible = False
            self._trouble = ui.label("").classes("alert").props('role="alert"')
            self._nothing = ui.html(NOTHING, sanitize=False).classes("tile empty")
            with ui.element("div").classes("bench wide-rail") as self._open:
                with ui.element("div").classes("tile"):
                    self._search = ui.input(placeholder="search signals", on_change=lambda: self._build_rows())
                    self._search.props('dense clearable aria-label="search signals"').classes("w-full")
                    self._list = ui.element("div").classes("signals")
                with ui.element("div").classes("stack"):
                    with ui.element("div").classes("tile"):
                        with ui.element("div").classes("choices"):
                            self._build_fields()
                        self._plots = ui.element("div").classes("w-full")
                    with ui.element("div").classes("tile"):
                        ui.html("<h2>What hvdc-ident check says</h2>", sanitize=False)
                        self._said = ui.column().classes("w-full gap-0 small").props('aria-live="polite"')
        self._open.visible = False
        with self._place:
            Plot([], "time, s", 10, "No recording").on("ready", lambda: self._in_background(self._start))

    def _build_files(self) -> None:
        """Build the line with the study's experiments, its files, the place for dropped ones, and the button that writes."""
        with ui.element("div").classes("choices"):
            self._build_choices()
        with ui.element("div").classes("line q-mt-xs"):
            self._write = ui.button("Write the study", on_click=lambda: self._in_background(self._save))
            self._write.props("dense unelevated").classes("q-px-md")
            self._reopen = (
                ui.button("Open the study", on_click=ui.navigate.reload).props("outline dense").classes("q-px-md")
            )
            self._reopen.tooltip("Loads the page anew, with the recording under the curves and the stages to run")
            self._reopen.visible = False
            self._status = ui.label("").classes("small").style("overflow-wrap: anywhere")
            self._busy = ui.spinner(size="1.3em").props('aria-label="at work"')
            self._busy.visible = False

    def _build_choices(self) -> None:
        self._experiment = ui.select(
            [], label="experiment", on_change=lambda e: self._choose(e.value, self._open_experiment)
        )
        self._files = ui.select([], label="in the study's folder", with_input=True)
        self._files.on_value_change(lambda e: self._choose(e.value, self._open_file))
        self._upload = ui.upload(
            multiple=True,
            auto_upload=True,
            max_file_size=MOST_BYTES,
            label="Drop a recording, or choose a file",
            on_multi_upload=self._arrived,
            on_rejected=lambda: self._tell(
                f"The file is larger than {MOST_BYTES // 1024**2} MiB: put it into the study's folder."
            ),
        ).props("flat bordered dense")
        self._upload.on(
            "failed", lambda: self._tell("The upload failed: the file is too large, or the server has ended.")
        )
        self._upload.classes("upload")
        self._model = ui.select(self._models(), value=self._source, label="model")
        self._model.on_value_change(lambda e: self._choose(e.value, self._choose_model))
        for field in (self._experiment, self._files, self._model):
            field.props("dense options-dense")

    def _build_fields(self) -> None:
        self._name = ui.input("name", on_change=lambda e: self._edit(name=e.value or "")).props("dense")
        self._role = ui.select(
            ["fit", "holdout"], value="fit", label="role", on_change=lambda e: self._edit(role=e.value)
        )
        self._role.props("dense options-dense")
        self._event = ui.number("event, s", on_change=lambda e: self._edit(event=e.value))
        self._from = ui.number("window from, s", on_change=lambda e: self._edit_window(e.value, None))
        self._to = ui.number("to, s", on_change=lambda e: self._edit_window(None, e.value))
        self._event.props["aria-label"] = "event, s"
        for field in (self._event, self._from, self._to):
            field.props("dense clearable stack-label step=any")

    def _models(self) -> list[str]:
        """Return the models that can be chosen: the shipped ones, those beside the recording, and the desk's own."""
        beside = [self._desk.recording.parent] if self._desk.recording else []
        files = [str(f) for folder in beside for f in sorted(folder.iterdir()) if f.suffix in (".toml", ".fmu")]
        return list(dict.fromkeys([self._source, *shipped_models(), *files]))

    # --- what is open ---

    async def _start(self) -> None:
        self._place.clear()
        ui.timer(POLL, self._look)
        ui.run_javascript(DROP_ANYWHERE % self._upload.id)
        desk = self._desk
        self._seen = await run.io_bound(Seen.now, desk.file)
        self._show_files()
        if desk.recording is not None:
            await self._propose(desk.recording, os.path.relpath(desk.recording.resolve(), desk.file.parent.resolve()))
        elif desk.study is not None and desk.study.experiments:
            await self._open_experiment(desk.study.experiments[0].name)
        else:
            self._show()

    async def _open_experiment(self, name: str) -> None:
        """Open an experiment of the study file."""
        study = self._desk.study
        mapping = experiments_in(study.settings).get(name) if study else None
        if mapping is None:
            raise StudyError(f"no experiment '{name}'", where=self._desk.file.name, hint="choose another one")
        record = await run.io_bound(hi.read_waveforms, self._desk.file.parent / mapping.data)
        await self._take(record, mapping, None, name)

    async def _open_file(self, data: str) -> None:
        """Open a recording of the study's folder: as its experiment, where the study has one, else proposed."""
        study = self._desk.study
        own = next((m for m in experiments_in(study.settings).values() if m.data == data), None) if study else None
        if own is not None:
            await self._open_experiment(own.name)
        else:
            await self._propose(chosen_recording(self._desk.file.parent, data), data)

    async def _propose(self, path: Path, data: str, record: Trajectory | None = None) -> None:
        record = record or await run.io_bound(hi.read_waveforms, path)
        taken = {e.name.lower() for e in self._desk.study.experiments} if self._desk.study else set()
        name, number = safe_name(f"{path.stem}.x").removesuffix(".x"), 2
        while name.lower() in taken:
            name, number = f"{path.stem}-{number}", number + 1
        mapping, matching = await run.io_bound(proposed, record, self._plant, name, Path(data).as_posix())
        await self._take(record, mapping, matching, "")
        self._changed = True
        self._show_status()

    async def _take(self, raw: Trajectory, mapping: RecordingMap, matching: Matching | None, was: str) -> None:
        record = await run.io_bound(columns_with_derived, mapping, raw, self._desk.file.name)
        self._raw, self._record, self._map, self._matching, self._was = raw, record, mapping, matching, was
        self._changed, self._draft, self._view, self._sketches = False, None, None, {}
        self._edited = False
        self._columns, self._rested_at = await run.io_bound(columns_of, record, mapping.event), mapping.event
        self._show()

    async def _arrived(self, event: Any) -> None:
        """Keep the files that were dropped, and open the first recording."""
        self._upload.reset()

        async def keep() -> None:
            with tempfile.TemporaryDirectory(prefix="hvdc-ident-") as place:
                for file in event.files:
                    await file.save(Path(place, safe_name(file.name)))
                kept, record = await run.io_bound(keep_recordings, self._desk.file.parent, Path(place))
            self._show_files()
            self._leave(lambda: self._propose(self._desk.file.parent / kept[0], kept[0], record))

        await self._guarded(keep)

    async def _choose_model(self, source: str) -> None:
        """Map the recording to another model; where that fails, the one before stays, and is the one that is shown."""
        before = self._desk, self._source
        try:
            model = await run.io_bound(hi.load_model, source, trust=self._desk.trust)
            self._desk, self._source = replace(self._desk, model=model, source=source), source
            if self._map is not None and self._raw is not None:
                await self._propose(Path(self._map.data), self._map.data, self._raw)
        except Exception:
            self._desk, self._source = before
            self._show_files()
            raise

    # --- the file ---

    async def _save(self) -> None:
        async with self._turn:
            await self._write_mapping()

    async def _renew_in_turn(self, *, keep: bool) -> None:
        async with self._turn:
            await self._renew(keep=keep)

    async def _write_mapping(self) -> None:
        if self._map is None:
            return
        was = self._was or self._map.name
        try:
            self._seen = await run.io_bound(
                write_mapping, self._seen, self._map, was, self._source, trust=self._desk.trust
            )
        except StudyError as error:
            if self._seen == await run.io_bound(Seen.now, self._desk.file):
                raise
            self._ask_which(str(error))
            return
        self._was = self._map.name
        await self._renew(keep=True)
        self._changed = self._edited = False
        self._show_status()
        ui.notify(f"{self._desk.file} is written.", type="positive")
        self._reopen.visible = not self._with_study

    async def _renew(self, *, keep: bool) -> None:
        """Read the study file anew. keep: the mapping that is on the page; left out, that of the file."""
        self._stamp = stamp(self._desk.file)
        seen = await run.io_bound(Seen.now, self._desk.file)
        parse_study((seen.text or "").encode(), self._desk.file)  # what is no TOML is a broken study, and no model card
        desk = await run.io_bound(opened, str(self._desk.file), trust=self._desk.trust)
        self._seen, self._source = seen, desk.source
        self._desk = replace(desk, recording=self._desk.recording)
        self._banner.visible = False
        names = [e.name for e in desk.study.experiments] if desk.study else []
        if keep:
            self._was = self._was if self._was in names else ""
        elif names:
            await self._open_experiment(self._was if self._was in names else names[0])
        self._show_files()
        self._ask()

    async def _look(self) -> None:
        """See whether the study file is another one than the page knows; take it over where nothing was changed here."""
        async with self._turn:
            await self._look_at_file()

    async def _look_at_file(self) -> None:
        now = stamp(self._desk.file)
        if now == self._stamp or self._banner.visible:
            return
        self._stamp = now
        if now is None:
            return
        if self._seen == await run.io_bound(Seen.now, self._desk.file):
            self._tell("")  # what was wrong with it is mended
            return
        if self._changed:
            self._ask_which(f"{self._desk.file.name} was changed on the disk, and this page holds changes of its own.")
        else:
            await self._guarded(lambda: self._renew(keep=False))

    def _ask_which(self, text: str, ways: Mapping[str, Callable[[], Awaitable[None]]] | None = None) -> None:
        """Ask what is to be done; left out, with a study file that is another one than the page read."""

        def chosen(way: Callable[[], Awaitable[None]]) -> None:
            self._banner.visible = False
            self._in_background(way)

        file = {
            "Keep mine": lambda: self._renew_in_turn(keep=True),
            "Show the file's": lambda: self._renew_in_turn(keep=False),
        }
        self._banner.clear()
        with self._banner:
            ui.label(text)
            for name, way in (ways or file).items():
                ui.button(name, on_click=lambda way=way: chosen(way)).props("flat dense")
        self._banner.visible = True

    # --- changes ---

    def _edit(self, **changes: Any) -> None:
        if self._map is not None and not self._showing and any(getattr(self._map, k) != v for k, v in changes.items()):
            self._set(replace(self._map, **changes))

    def _edit_window(self, start: float | None, end: float | None) -> None:
        if self._map is None or self._record is None or self._showing:
            return
        first, last = float(self._time[0]), float(self._time[-1])
        low = start if start is not None else self._from.value
        high = end if end is not None else self._to.value
        window = (first if low is None else low, last if high is None else high)
        self._edit(window=None if window == (first, last) else window)

    def _set(self, mapping: RecordingMap) -> None:
        before, self._map = self._map, mapping
        self._changed = self._edited = True
        if before is not None and _columns_in(before) != _columns_in(mapping):
            for refresh in self._rows.values():
                refresh()
            self._build_plot()
        self._show_marks()
        self._show_status()
        self._ask()

    def _marked(self, event: Any) -> None:
        """Take over where a marker was left: at the row next to it."""
        key, at = event.args["key"], float(event.args["at"])
        value = float(self._time[int(np.argmin(np.abs(self._time - at)))])
        field = {"event": self._event, "from": self._from, "to": self._to}[key]
        field.value = value  # the field tells the mapping
        self._show_marks()

    # --- what is shown ---

    @property
    def _plant(self) -> AnyModel:
        """The model of the study, or the one that was chosen."""
        return self._desk.study.model if self._desk.study else self._desk.model

    @property
    def _time(self) -> Array:
        """The rows' instants, s, as the study counts them."""
        if self._draft is not None:
            return self._draft.experiment.time
        return self._record.time if self._record is not None else np.zeros(1)

    def _show_files(self) -> None:
        study = self._desk.study
        self._experiment.set_options([e.name for e in study.experiments] if study else [], value=self._was or None)
        self._experiment.visible = bool(study and study.experiments)
        files = recordings_in(self._desk.file.parent) if self._desk.file.parent.is_dir() else []
        self._files.set_options(files, value=self._map.data if self._map and self._map.data in files else None)
        self._files.visible = bool(files)
        self._model.visible = study is None
        if study is None:
            self._model.value = self._source

    def _show(self) -> None:
        """Show all of what is open."""
        mapping = self._map
        self._nothing.visible, self._open.visible = mapping is None, mapping is not None
        self._show_files()
        self._showing = True
        if mapping is not None:
            self._name.value, self._role.value, self._event.value = mapping.name, mapping.role, mapping.event
            self._from.value, self._to.value = mapping.window or (None, None)
        self._showing = False
        self._changed = False
        self._build_rows()
        self._build_plot()
        self._show_status()
        self._ask()

    def _show_status(self) -> None:
        self._write.visible = self._map is not None
        self._write.set_enabled(self._map is not None and self._changed)
        where = self._desk.file
        self._status.text = f"{'not written yet: ' if self._changed else ''}{where}" if self._map else ""

    def _build_rows(self) -> None:
        self._list.clear()
        self._rows, self._levels = {}, {}
        wanted = (self._search.value or "").casefold()
        fitting = [c for c in self._columns if wanted in c.name.casefold()]
        if self._map is not None:  # those that are in use first
            used = _columns_in(self._map)
            fitting.sort(key=lambda c: c.name not in used)
        with self._list:
            for column in fitting[:MOST_ROWS]:
                self._build_row(column)
            if len(fitting) > MOST_ROWS:
                ui.label(f"{len(fitting) - MOST_ROWS} more: search for a part of their names.").classes("small")

    def _build_row(self, column: Column) -> None:
        assert self._record is not None
        model = self._plant
        signals: dict[str, tuple[Kind, str]] = {f"input {n}": ("input", n) for n in model.inputs}
        signals |= {f"output {n}": ("output", n) for n in model.outputs}
        options = {"": "not used", **{name: name for name in signals}}
        with ui.element("div").classes("signal"):
            ui.html(self._sketch(column.name), sanitize=False)
            with ui.element("div"):
                ui.label(column.name).classes("ellipsis text-bold w-full").tooltip(column.name)
                self._levels[column.name] = ui.label(_about(column)).classes("small")
            with ui.element("div"):
                chosen = ui.select(options, with_input=True).props("dense options-dense").classes("w-full")
                chosen.props["aria-label"] = f"{column.name} is"
                details = ui.column().classes("w-full gap-0")

        def refresh() -> None:
            lines = self._map.of_column(column.name) if self._map else ()
            chosen.value = f"{lines[0].kind} {lines[0].signal}" if lines else ""
            details.clear()
            with details:
                for line in lines:
                    self._build_line(line, column)
                if not lines:
                    self._build_candidates(column)

        def assign(event: Any) -> None:
            if self._map is None:
                return
            kind, signal = signals.get(event.value, ("input", ""))  # "": of no kind
            lines = self._map.of_column(column.name)
            if signal != lines[0].signal or kind != lines[0].kind if lines else signal:
                self._set(self._map.assigned(column.name, signal, kind))

        refresh()
        chosen.on_value_change(assign)
        self._rows[column.name] = refresh

    def _sketch(self, name: str) -> str:
        """Return the small picture of a column."""
        assert self._record is not None
        if name not in self._sketches:
            self._sketches[name] = sketch(self._record.time, self._record[name], *THUMBNAIL)
        return self._sketches[name]

    def _build_line(self, line: SignalLine, column: Column) -> None:
        """Build the fields of one signal's conversion, and why it was proposed."""
        with ui.row().classes("w-full items-center no-wrap gap-1"):
            if not column.unit:
                unit = ui.input("unit", value=line.unit or "").classes("col")
                unit.on_value_change(lambda e: self._state(line.signal, "unit", e.value or None))
                unit.props(f'dense aria-label="{line.signal}: unit"')
            for key in ("base", "scale", "offset"):
                number = ui.number(key, value=getattr(line, key)).classes("col")
                number.on_value_change(lambda e, key=key: self._state(line.signal, key, e.value))
                number.props["aria-label"] = f"{line.signal}: {key}"
                number.props("dense step=any")
        if line.why:
            ui.label(f"proposed: {line.why}").classes("small")

    def _build_candidates(self, column: Column) -> None:
        """Build a button for each signal that the column may be."""
        candidates = self._matching.proposed if self._matching else ()
        with ui.row().classes("w-full gap-0"):
            for match in (m for m in candidates if m.column.name == column.name):
                target = match.target

                def take(signal: str = target.name, kind: Any = target.kind, base: float | None = match.base) -> None:
                    if self._map is not None:
                        self._set(self._map.assigned(column.name, signal, kind).stated(signal, "base", base))

                base = "" if match.base is None else f", base {match.base:g} {column.unit}"
                button = ui.button(f"take as {target.kind} {target.name}{base}", on_click=lambda take=take: take())
                button.props("flat dense no-caps size=12px").tooltip(match.reason)

    def _state(self, signal: str, key: str, value: Any) -> None:
        if self._map is not None:
            self._set(self._map.stated(signal, key, value))

    def _build_plot(self) -> None:
        self._plots.clear()
        self._plot = None
        if self._record is None or self._map is None:
            return
        grids = [
            Grid(
                f"{name}, {unit}" if (unit := self._record.unit(name)) else name, (Trace(self._roles(name), RECORDED),)
            )
            for name in self._drawn()
        ]
        markers = [
            Marker(key, label, color, self._marks()[key])
            for key, label, color in (("event", "event", EVENT_COLOR), ("from", "from", NOW), ("to", "to", NOW))
        ]
        height = max(HEIGHT, 105 * len(grids))
        with self._plots:
            plot = Plot(grids, "time, s", height, "The recording", markers=markers).classes("w-full")
        plot.on("ready", self._draw)
        plot.on("marked", self._marked)
        plot.on("viewed", self._viewed)
        self._plot = plot

    def _drawn(self) -> Sequence[str]:
        """Return the columns that are drawn: those in use, else the first."""
        assert self._record is not None and self._map is not None
        used = [n for n in _columns_in(self._map) if n in self._record.names]
        return used[:MOST_GRIDS] or [c.name for c in self._columns[:3]]

    def _roles(self, column: str) -> str:
        """Return what a column is, for the legend."""
        lines = self._map.of_column(column) if self._map else ()
        return ", ".join(f"{line.kind} {line.signal}" for line in lines) or "recorded"

    def _draw(self) -> None:
        if self._record is not None and self._plot is not None:
            for k, name in enumerate(self._drawn()):
                self._plot.whole(k, thinned(self._time, self._record[name]))
            self._shade()

    def _shade(self) -> None:
        """Shade each column's rows that cannot be right or were left out, once `check` has found them."""
        if self._map is None or self._plot is None or self._draft is None:
            return
        e = self._draft.experiment
        for k, name in enumerate(self._drawn()):
            own = {line.signal for line in self._map.of_column(name)}
            self._plot.shade(k, bands(e.recording, {*e.inputs, *e.outputs} - own))

    def _viewed(self, event: Any) -> None:
        """Draw closely what is looked at."""
        view = (float(event.args["from"]), float(event.args["to"]))
        if self._record is not None and self._plot is not None and view != self._view:
            self._view = view
            for k, name in enumerate(self._drawn()):
                self._plot.refine(k, focused(self._time, *view, self._record[name]))

    def _marks(self) -> dict[str, float]:
        """Return where the markers stand, s: as stated, else as found, else at the ends."""
        first, last = float(self._time[0]), float(self._time[-1])
        mapping = self._map
        draft_event = self._draft.experiment.event if self._draft else None
        event = mapping.event if mapping and mapping.event is not None else draft_event
        window = (mapping.window if mapping else None) or (first, last)
        return {"event": first if event is None else event, "from": window[0], "to": window[1]}

    def _show_marks(self) -> None:
        if self._plot is not None:
            for key, at in self._marks().items():
                self._plot.mark(key, at)

    # --- what check says ---

    def _ask(self) -> None:
        self._asked += 1
        self._in_background(self._check)

    async def _check(self) -> None:
        number = self._asked
        await asyncio.sleep(REST)
        mapping, raw, record, desk = self._map, self._raw, self._record, self._desk
        if number != self._asked or mapping is None or raw is None or record is None:
            return
        draft, text = None, ""
        try:
            draft = await run.io_bound(drafted, mapping, raw, self._plant, desk.study, self._was, desk.file.name)
        except HvdcIdentError as error:
            text = str(error)
        if number == self._asked:
            self._draft = draft
            self._show_said(draft, text)
            self._show_marks()
            self._shade()
            await self._show_found(record, draft)

    def _show_said(self, draft: Draft | None, text: str) -> None:
        self._said.clear()
        with self._said:
            if draft is None:
                ui.label(text).classes("alert")
                return
            summary = draft.summary
            doubts = {*summary.rest_lines, *(f"steady state, {line}" for line in summary.steady_state)}
            lines = str(summary).splitlines()
            own = [line for line in lines[1:] if line.startswith(f"experiment {draft.experiment.name}")]
            told = [lines[0], *(line for line in lines if line in doubts), *own]
            moved = event_time(draft.experiment.inputs)
            if moved is not None and draft.experiment.event is not None and moved < draft.experiment.event:
                doubt = f"an input moves at {moved:g} s, before the event: levels and noise before the event are not those at rest"
                told.insert(1, doubt)
                doubts.add(doubt)
            for line in told:
                ui.label(line).style(f"color: {DOUBT}; font-weight: 600" if line in doubts else "")
            with ui.expansion("and of the rest of the study").props("dense").classes("w-full"):
                for line in (line for line in lines if line not in told):
                    ui.label(line)

    async def _show_found(self, record: Trajectory, draft: Draft | None) -> None:
        """Show what was found in the recording where it is not stated: the event, the ends, and the levels before the event."""
        event = draft.experiment.event if draft else None
        self._event.props["placeholder"] = "none found" if event is None else f"{event:g}, as found"
        for field, row in ((self._from, 0), (self._to, -1)):
            field.props["placeholder"] = f"{self._time[row]:g}"
        if draft is not None and event != self._rested_at:
            columns = await run.io_bound(columns_of, record, event)
            if record is self._record:
                self._columns, self._rested_at = columns, event
                for column in columns:
                    if column.name in self._levels:
                        self._levels[column.name].text = _about(column)

    # --- running ---

    def _choose(self, value: Any, opening: Callable[[Any], Awaitable[None]]) -> None:
        """Open what was chosen, where it is not what is open already."""
        now = (self._was, self._map.data if self._map else "", self._source)
        if value and value not in now:
            self._leave(lambda: opening(value))

    def _leave(self, opening: Callable[[], Awaitable[None]]) -> None:
        """Open something else; where changes made by hand would be lost, ask first."""
        if not self._edited or self._map is None:
            self._in_background(opening)
            return

        async def written() -> None:
            await self._save()
            if not self._edited:
                await opening()

        async def stay() -> None:
            self._show_files()

        ways = {"Write them first": written, "Drop them": opening, "Stay": stay}
        self._ask_which(f"Changes to '{self._map.name}' are not written.", ways)

    def _in_background(self, work: Callable[[], Awaitable[None]]) -> None:
        background_tasks.create(self._guarded(work), context=self._place)

    async def _guarded(self, work: Callable[[], Awaitable[None]]) -> None:
        """Do some work; an error of the package is told beside the fields, any other as `page_errors` shows it."""
        with self._place:
            self._trouble.text = ""
            self._working += 1
            self._busy.visible = True
            try:
                await work()
            except HvdcIdentError as error:
                self._tell(str(error))
            finally:
                self._working -= 1
                self._busy.visible = self._working > 0

    def _tell(self, text: str) -> None:
        self._trouble.text = text


def _columns_in(mapping: RecordingMap) -> list[str]:
    return list(dict.fromkeys(line.column for line in mapping.lines))


def _about(column: Column) -> str:
    """Return the level of a column in words."""
    if column.level is None:
        return f"{column.unit}, not recorded"
    noise = f" ± {column.noise:.2g}" if column.noise else ""
    return f"{'at rest' if column.quiet else 'first'} {column.level:.4g}{noise} {column.unit}"


TAB = Tab(order=20, title="Recording", build=lambda page: Mapper(page.desk).build(), maps=True)
