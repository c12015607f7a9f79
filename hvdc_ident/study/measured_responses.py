"""Measured frequency responses of a study: read from their files, compared with the model, told in lines."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from hvdc_ident.codec import read_fields
from hvdc_ident.data import Array
from hvdc_ident.errors import LinearizationError, SteadyStateError, StudyError, located, unknown_name
from hvdc_ident.files import digest
from hvdc_ident.formats import files_of, read_waveforms
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import (
    FrequencyResponse,
    MeasuredResponse,
    Port,
    ResponseFile,
    read_response,
    response_at_tones,
    response_from_record,
)
from hvdc_ident.model import AnyModel
from hvdc_ident.study import schema
from hvdc_ident.study.checks import names_of_model
from hvdc_ident.summary.compared_responses import (
    ChannelError,
    ComparedResponse,
    Curves,
    DescribedResponse,
    ModelResponse,
)
from hvdc_ident.toml_tables import check_names

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study


def port_of(table: schema.PortTable) -> Port:
    """Return the port that a table of the study describes."""
    source, voltage, current = (
        (v[0], v[1]) if len(v) == 2 else (v[0],) for v in (table.source, table.voltage, table.current)
    )
    return Port(source, voltage, current, table.angle)


def read_responses(
    settings: schema.StudyFile, model: AnyModel, folder: Path, where: str
) -> tuple[tuple[MeasuredResponse, ...], dict[str, str]]:
    """Return the measured responses of a study, and the sha256 of every file behind them by its name in the study.

    Raises StudyError, UnknownNameError or WaveformError with the response's place in the study.
    """
    responses: list[MeasuredResponse] = []
    sources: dict[str, str] = {}
    taken = {e.name.lower() for e in settings.experiment}
    for table in settings.response:
        place = f"{where}, response '{table.name}'"
        if table.name.lower() in taken:
            raise StudyError("two experiments or responses of one name", where=place, expected="a name of its own")
        taken.add(table.name.lower())
        port = _checked(table, settings, model, place)
        with located(place):
            responses.append(_response(table, port, folder / table.data))
        path = folder / table.data
        for file in files_of(path) if table.signals else (path,):
            name = table.data if file == path else f"{Path(table.data).parent / file.name}"
            sources[name] = digest(file.read_bytes())
    return tuple(responses), sources


def _checked(table: schema.ResponseTable, settings: schema.StudyFile, model: AnyModel, place: str) -> Port | None:
    """The port, where it is one. Raises where the table names what is not there."""
    ports = {p.name: p for p in (settings.linearize.port if settings.linearize else ())}
    check_names(table, {**names_of_model(model), "port of [[linearize.port]]": ports}, f"{place}.")
    return port_of(ports[table.port]) if table.port is not None else None


def _response(table: schema.ResponseTable, port: Port | None, path: Path) -> MeasuredResponse:
    if port is None:
        wanted = {"": (table.output or "", table.input or "")}
    else:
        axes = port.axes
        wanted = {"": ("dc", "dc")} if len(axes) == 1 else {f"{o}{i}": (o, i) for o in axes for i in axes}
    file = _waveforms(table, path) if table.frequencies is not None or table.signals else read_response(path)
    names = _channels(table, file, list(wanted), path.name)
    keep = np.ones(file.omega.size, dtype=bool)
    if table.band is not None:
        keep = (file.omega >= 2 * np.pi * table.band[0]) & (file.omega <= 2 * np.pi * table.band[1])
    if not keep.any():
        hertz = file.omega / (2 * np.pi)
        raise StudyError(
            "no frequency lies in the band", expected=f"{table.band} Hz", got=f"{hertz[0]:.4g} to {hertz[-1]:.4g} Hz"
        )
    values = table.scale * np.stack([file.channels[names[w]][keep] for w in wanted if w in names], axis=1)
    std, dof = _noise(table, file, [names[w] for w in wanted if w in names], keep, values)
    trim = table.trim
    return MeasuredResponse(
        table.name,
        "transfer" if port is None else table.kind,
        tuple(wanted[w] for w in wanted if w in names),
        file.omega[keep],
        values,
        std,
        dof,
        port,
        FrozenMap(table.values | (trim.inputs if trim else {})),
        FrozenMap(trim.outputs if trim else {}),
        tuple((trim.free or ()) if trim else ()),
        table.role,
        table.unit,
    )


def _noise(
    table: schema.ResponseTable, file: ResponseFile, names: Sequence[str], keep: Array, values: Array
) -> tuple[Array | None, float]:
    """(standard deviation of each value's modulus, independent numbers behind it): as stated, else as the file tells."""
    if table.noise is not None:
        return np.full(values.shape, table.noise), np.inf
    if table.relative_noise is not None:
        return table.relative_noise * np.abs(values), np.inf
    if all(n in file.std and (file.std[n][keep] > 0).all() for n in names):
        std = abs(table.scale) * np.stack([file.std[n][keep] for n in names], axis=1)
        return std, min((file.dof.get(n, np.inf) for n in names), default=np.inf)
    return None, np.inf


def _channels(table: schema.ResponseTable, file: ResponseFile, wanted: Sequence[str], where: str) -> dict[str, str]:
    """The file's channel for each wanted one: as `columns` says, or by its name's end (Zdd, Ydq, Z11, "d from q")."""
    known = list(file.channels)
    for key, name in table.columns.items():
        if key not in wanted and not (len(wanted) == 1 and len(table.columns) == 1):
            raise unknown_name("channel", key, wanted, where="columns")
        if name not in known:
            raise unknown_name("channel", name, known, where=f"{where}, columns")
    if len(wanted) == 1:
        if table.columns:
            return {wanted[0]: next(iter(table.columns.values()))}
        if len(known) == 1:
            return {wanted[0]: known[0]}
        expected = "one channel, or the key columns"
        hint = f'columns = {{value = "{known[0]}"}}'
        raise StudyError("which channel of the file?", where=where, expected=expected, got=", ".join(known), hint=hint)
    channels = dict(table.columns)
    for key in wanted if not channels else ():
        numbered = key.replace("d", "1").replace("q", "2")
        ends = (key, numbered, f"{key[0]}from{key[1]}")
        bare = {n: re.sub(r"[^a-z0-9]", "", n.lower()) for n in known}
        hits = [n for n, b in bare.items() if b.endswith(ends)]
        if len(hits) == 1:
            channels[key] = hits[0]
    other = "y" if table.kind == "impedance" else "z"
    turned = [n for n in channels.values() if re.fullmatch(rf"{other}\s?(\d\d|[dq][dq])", n.lower())]
    if turned and not table.columns:
        kind = "admittance" if table.kind == "impedance" else "impedance"
        raise StudyError(
            f"channel '{turned[0]}' is no {table.kind}", where=where, hint=f'kind = "{kind}", or name it in columns'
        )
    if not channels:
        raise StudyError(
            "no channel of the port is in the file",
            where=where,
            expected=f"channels that end in {', '.join(wanted)}, or the key columns",
            got=", ".join(known),
        )
    return channels


def _waveforms(table: schema.ResponseTable, path: Path) -> ResponseFile:
    """The response that a record in time shows: at the perturbation's frequencies, or by Welch's averages over all."""
    sent, seen = table.signals["input"], table.signals["output"]
    record = read_waveforms(path, [sent, seen])
    u, y = record[sent], record[seen]
    if table.frequencies is None:
        response: FrequencyResponse = response_from_record(record.time, u, y, input=sent, output=seen)
    else:
        omega = 2 * np.pi * np.array(table.frequencies)
        response = response_at_tones(record.time, u, y, omega, input=sent, output=seen)
    order = np.argsort(response.omega)
    assert response.std is not None
    name = f"{seen} from {sent}"
    channels = FrozenMap({name: response.values[order, 0, 0]})
    return ResponseFile(response.omega[order], channels, FrozenMap({name: response.std[order, 0, 0]}))


def compared(study: Study, sets: Mapping[str, Mapping[str, float]]) -> list[ComparedResponse]:
    """Return every measured response beside the model's at some sets of values, with the errors of each.

    sets: values of parameters by the set's name ("given", "fitted"). A set for which there is no response has the reason.
    Phases are degrees; the measured one has, as every other, the whole turns that bring it nearest to the first model's.
    """
    return [_compared(study, r, sets) for r in study.responses]


def _compared(study: Study, r: MeasuredResponse, sets: Mapping[str, Mapping[str, float]]) -> ComparedResponse:
    models: dict[str, ModelResponse] = {}
    first: Array | None = None
    for name, values in sets.items():
        try:
            linear = r.linear(study.model, values)
            curve = r.seen(linear)[0]
        except (SteadyStateError, LinearizationError) as e:
            models[name] = ModelResponse(reason=str(e))
            continue
        phase = r.phase(linear)
        first = phase if first is None else first
        phase = phase + _turns(first[:1] - phase[:1])
        errors = tuple(read_fields(ChannelError, e) for e in r.errors(curve))
        stable = linear.stability().verdict in ("stable", "on the limit of stability")
        models[name] = ModelResponse(curve.real, curve.imag, phase, errors, stable)
    angle = np.degrees(np.angle(r.values))
    phase = np.degrees(np.unwrap(np.radians(angle), axis=0)) if first is None else angle + _turns(first - angle)
    measured = Curves(r.values.real, r.values.imag, phase)
    return ComparedResponse(r.name, described(r), r.omega, measured, r.std, models)


def _turns(degrees: Array) -> Array:
    """Return the whole turns next to some angles, degrees."""
    return np.asarray(360.0 * np.round(degrees / 360.0))


def described(response: MeasuredResponse) -> DescribedResponse:
    """Return a measured response in short."""
    hertz = response.omega / (2 * np.pi)
    noise: float | None = None
    if response.std is not None:
        noise = float(np.sqrt(np.mean(response.std**2) / np.mean(np.abs(response.values) ** 2)))
    return DescribedResponse(
        response.role,
        response.kind,
        tuple(response.labels),
        int(hertz.size),
        (float(hertz[0]), float(hertz[-1])),
        response.unit,
        noise,
        "misfit" if response.std is None else "estimated" if np.isfinite(response.dof) else "given",
    )
