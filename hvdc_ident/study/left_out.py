"""Rows of an experiment that are left out: as the study states, or else those that cannot be right; and what to write about these."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from hvdc_ident.data import Array, BadRows, Contradiction, bad_rows, gaps
from hvdc_ident.data.bad_rows import stretches
from hvdc_ident.data.signals import HOLD_SHARE
from hvdc_ident.model.card import toml_key, toml_table
from hvdc_ident.study import schema


class RowsLeftOut:
    """The rows of one experiment that are left out, by signal, and the contradictions that were found in the others.

    rows: (n,) by signal. contradictions: of the recording, each with what to write. unrecorded: (n,) by input the rows in which it has
    no number although the study does not leave them out. write: the line that leaves out all that can be.
    """

    def __init__(
        self,
        table: schema.ExperimentTable,
        time: Array,
        columns: Mapping[str, Array],
        angles: Mapping[str, float],
        own: Mapping[str, NDArray[np.bool_]],
        unrecorded: Mapping[str, NDArray[np.bool_]],
    ) -> None:
        """Find the rows. columns: (n,) by signal, as recorded. angles: a whole turn in the units of those that are angles. own: (n,) by
        input, the rows of its record; unrecorded: (n,) those among them in which it has no number, where there are some.
        """
        stated = table.leave_out
        self.rows = {s: _inside(time, (stated or {}).get(s, ())) for s in columns}
        compared = _inside(time, [table.window] if table.window is not None else [[-np.inf, np.inf]])
        needed = time <= (table.window[1] if table.window is not None else np.inf)  # an input is, from the first row on
        asked = {
            s: np.where((compared if s in table.outputs else needed) & ~self.rows[s], v, np.nan)
            for s, v in columns.items()
        }
        bad = list(bad_rows(time, asked, table.event, angles))
        self.unrecorded = {s: open_ for s, rows in unrecorded.items() if (open_ := rows & ~self.rows[s] & needed).any()}
        for signal, rows in unrecorded.items():
            self.rows[signal] = self.rows[signal] | (rows & ~needed)
        self.write = leave_out_line(_all_spans(bad, self.unrecorded, table, time))
        inputs = [asked[s] for s in (*table.inputs, *table.drive)]
        if any(
            np.mean(v[1:] == v[:-1]) < HOLD_SHARE for v in inputs if v.size > 1
        ):  # one that is held is known in a gap too
            bad += [b for b in gaps(time) if needed[b.last]]
        contradictions = (_contradiction(b, self.write, table, time, asked, applied=stated is None) for b in bad)
        self.contradictions = (*contradictions, *_stated(table, time, columns))
        if stated is None:
            for b in (b for b in bad if b.can_be_left_out):
                for s in b.columns:
                    self.rows[s][b.first : b.last + 1] = True
        # Where an input is not known, what the model answers to it is not either.
        for s, rows in own.items():
            unknown = _between_kept(self.rows[s], rows & ~self.rows[s])
            for o in table.outputs:
                self.rows[o] = self.rows[o] | unknown

    def without(self, signal: str, time: Array, values: Array, *, bridged: bool) -> Array:
        """Return the values without the rows that are left out: NaN, or bridged by the line between the rows beside them."""
        out = self.rows[signal]
        kept = ~out & np.isfinite(values)
        if not out.any() or (bridged and not kept.any()):
            return values
        return np.where(out, np.interp(time, time[kept], values[kept]) if bridged else np.nan, values)


def _inside(time: Array, spans: Iterable[Sequence[float]]) -> NDArray[np.bool_]:
    """Return (n,) which rows lie in one of some spans, whose ends may be rounded as text rounds them."""
    slack = 1e-6 * float(np.median(np.diff(time))) if time.size > 1 else 0.0
    inside = np.zeros(time.size, dtype=bool)
    for low, high in spans:
        inside |= (time >= low - slack) & (time <= high + slack)
    return inside


def _between_kept(out: NDArray[np.bool_], kept: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return (n,) the rows between two that are kept, or beyond the last, among which some are left out: rows of other records too."""
    stands = np.concatenate([[-1], np.flatnonzero(kept), [kept.size]])
    lost = np.unique(np.searchsorted(stands, np.flatnonzero(out)))  # a line from one row that stands to the next
    between = np.zeros(kept.size, dtype=bool)
    for k in lost.tolist():
        between[stands[k - 1] + 1 : stands[k]] = True
    return between


def _contradiction(
    b: BadRows,
    leave_out: str,
    table: schema.ExperimentTable,
    time: Array,
    columns: Mapping[str, Array],
    *,
    applied: bool,
) -> Contradiction:
    """Return what is said of a stretch. leave_out: the line that leaves out all that can be; columns: (n,) by signal; applied: whether
    its rows are left out already, without the study saying so.
    """
    first, last = float(time[b.first]), float(time[b.last])
    if b.kind == "constant":
        return Contradiction(b.kind, table.name, b.what, b.columns, write=_without_column(b, table))
    what = f"{_where(b.first, b.last, time)}: {b.what}"
    if b.kind == "spike" and applied:  # one to three rows less: nothing that the reader has to decide
        rows = (b.first + 1, b.last + 1)
        return Contradiction(b.kind, table.name, what, b.columns, rows, (first, last), done="left out")
    if b.can_be_left_out and applied:
        what += "; left out here, though the study does not say so"
    write = _window(b, table, time, columns) if b.cuts else leave_out
    return Contradiction(b.kind, table.name, what, b.columns, (b.first + 1, b.last + 1), (first, last), write)


def _stated(table: schema.ExperimentTable, time: Array, columns: Iterable[str]) -> Iterator[Contradiction]:
    """Yield the stretches that the study itself leaves out, of the signals that it has, as findings that are mended."""
    for signal in (s for s in table.leave_out or {} if s in columns):
        for span in (table.leave_out or {})[signal]:
            rows = np.flatnonzero(_inside(time, [span]))
            if rows.size:
                times = float(time[rows[0]]), float(time[rows[-1]])
                what = f"{_where(int(rows[0]), int(rows[-1]), time)} of {signal}"
                ends = int(rows[0]) + 1, int(rows[-1]) + 1
                yield Contradiction(
                    "left out", table.name, what, (signal,), ends, times, done="left out, as the study says"
                )


def _where(first: int, last: int, time: Array) -> str:
    """Return the rows of a stretch in words, counted from 1, with their instants."""
    if last == first:
        return f"row {first + 1} ({float(time[first]):.6g} s)"
    return f"rows {first + 1} to {last + 1} ({float(time[first]):.6g} to {float(time[last]):.6g} s)"


Spans = dict[str, list[tuple[float, float]]]


def spans_of(rows: NDArray[np.bool_], time: Array) -> list[tuple[float, float]]:
    """Return the first and the last instant of each stretch of rows."""
    return [(float(time[first]), float(time[last])) for first, last in stretches(rows)]


def leave_out_line(spans: Mapping[str, Iterable[tuple[float, float]]]) -> str:
    """Return the line of a study that leaves out spans of time in s, by signal."""
    lines = (f"{toml_key(s)} = [{', '.join(f'[{a:.12g}, {b:.12g}]' for a, b in pairs)}]" for s, pairs in spans.items())
    return f"leave_out = {{{', '.join(lines)}}}"


def _all_spans(
    bad: Sequence[BadRows], unrecorded: Mapping[str, NDArray[np.bool_]], table: schema.ExperimentTable, time: Array
) -> Spans:
    """Return what the study leaves out, and every other stretch that can be."""
    spans: Spans = {s: [(v[0], v[1]) for v in spans] for s, spans in (table.leave_out or {}).items()}
    for b in (b for b in bad if b.can_be_left_out):
        for s in b.columns:
            spans.setdefault(s, []).append((float(time[b.first]), float(time[b.last])))
    for s, rows in unrecorded.items():
        spans.setdefault(s, []).extend(spans_of(rows, time))
    return spans


def _window(b: BadRows, table: schema.ExperimentTable, time: Array, columns: Mapping[str, Array]) -> str:
    """Return the line that ends the comparison before a stretch, or begins it after, where more moves; "" where nothing would be left."""
    start, end = table.window if table.window is not None else (float(time[0]), float(time[-1]))
    parts = [(start, float(time[b.first])), (float(time[b.last]), end)]
    others = [v for s, v in columns.items() if s not in b.columns]
    moved = [sum(_moves(v, _inside(time, [part])) for v in others) for part in parts]
    low, high = parts[1] if moved[1] > moved[0] else parts[0]
    return f"window = [{low:.12g}, {high:.12g}]" if _inside(time, [(low, high)]).sum() > 2 else ""


def _moves(values: Array, rows: NDArray[np.bool_]) -> float:
    """Return how much of the range that a column moves over it moves over in some rows."""
    known, inside = values[np.isfinite(values)], values[rows & np.isfinite(values)]
    return float(np.ptp(inside) / np.ptp(known)) if inside.size and np.ptp(known) > 0.0 else 0.0


def _without_column(b: BadRows, table: schema.ExperimentTable) -> str:
    """Return the line of the outputs without a column that says nothing; "" where it is an input, or no output is left."""
    left = {o: c for o, c in table.outputs.items() if o not in b.columns}
    if b.columns[0] not in table.outputs or not left:
        return ""
    return f"outputs = {toml_table(left)}"
