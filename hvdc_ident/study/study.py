"""A study: the model, the candidates and the experiments, with every name looked up and every file read."""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hvdc_ident.data import Experiment
from hvdc_ident.display import Shown, Table, axes_of
from hvdc_ident.effects import apply_effects
from hvdc_ident.errors import StudyError, in_python, located, nearest, require_known, unknown_name
from hvdc_ident.expression import parse
from hvdc_ident.files import digest
from hvdc_ident.fit import FitParameter
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize import MeasuredResponse
from hvdc_ident.model import AnyModel, is_white_box, recording
from hvdc_ident.models import is_shipped, load_model, shipped_models
from hvdc_ident.next_step import NextStep
from hvdc_ident.study import schema
from hvdc_ident.study.checks import check_questions
from hvdc_ident.study.measured_responses import read_responses
from hvdc_ident.study.parse import parse_study
from hvdc_ident.study.recordings import Recordings, read_experiments
from hvdc_ident.summary.candidate import Candidate
from hvdc_ident.summary.levels import NoiseNote

if TYPE_CHECKING:
    from hvdc_ident.fit.likelihood import Prior
    from hvdc_ident.model import AnyModel


@dataclass(frozen=True, eq=False, repr=False)
class Study(Shown):
    """A study that holds together.

    model: with its parameterisation, effects, [model.values] and given values. candidates: what may be estimated, with
    given value, start and bounds. experiments: in the order of the file. noise: where each output's noise comes from, by experiment.
    settings: the study file's tables. sources: sha256 of every file that was read, by its name in the study; that of the study
    itself is of all but its [letter].
    against: the other model that sweeps are compared with, where they are; compared: that of the linear model.
    responses: the measured frequency responses.
    """

    name: str
    path: Path
    model: AnyModel
    candidates: FrozenMap[FitParameter]
    experiments: tuple[Experiment, ...]
    noise: FrozenMap[FrozenMap[NoiseNote]]
    settings: schema.StudyFile
    sources: FrozenMap[str]
    against: AnyModel | None = None
    compared: AnyModel | None = None
    responses: tuple[MeasuredResponse, ...] = ()

    @property
    def folder(self) -> Path:
        """Folder of the results unless --out names another: STUDY-results beside the study."""
        return self.path.with_name(f"{self.path.stem}-results")

    @property
    def given(self) -> FrozenMap[float]:
        """The values that the model came with, of the parameters listed in [parameters]: the vendor's.

        What `given` says there, else [model.values], else the model's own. Simulations, linear models and sweeps are made
        with them, parameters that cannot be estimated are held at them, and results are compared with them.
        """
        return FrozenMap({n: self.model.parameters[n].value for n in self._listed})

    @property
    def start(self) -> FrozenMap[float]:
        """Start of a search, of the same parameters: what `start` says, else the given value. Nothing else rests on it."""
        stated = {n: line.start for n, line in self._listed.items()}
        return FrozenMap({n: g if (s := stated[n]) is None else s for n, g in self.given.items()})

    def _screen(self) -> Iterator[str | Table]:
        yield f"Study {self.name}: model {self.model.name}, {len(self.experiments)} experiments, {len(self.responses)} responses"
        units = {n: self.model.parameters[n].unit for n in self.candidates}
        rows = [(n, f.given, f.start, f.min, f.max, units[n]) for n, f in self.candidates.items()]
        yield Table(("parameter", "given", "start", "min", "max", "unit"), tuple(rows)) if rows else ""
        records = []
        for e in self.experiments:
            span = (e.time.size, float(e.time[0]), float(e.time[-1]), e.event)
            records.append((e.name, e.role, *span, ", ".join(e.inputs), ", ".join(e.outputs)))
        header = ("experiment", "role", "rows", "from, s", "to, s", "event, s", "inputs", "outputs")
        yield Table(header, tuple(records)) if records else ""

    def plot(self, ax: Any = None) -> Any:
        """Draw the recorded outputs of every experiment, below each other, and return the axes."""
        axes = np.atleast_1d(axes_of(ax, 7.0, 2.5 * max(len(self.experiments), 1), rows=max(len(self.experiments), 1)))
        for one, experiment in zip(axes, self.experiments, strict=False):
            experiment.plot(one)
        return axes

    @property
    def _listed(self) -> dict[str, schema.ParameterTable]:
        """The lines of [parameters] that have a value of their own: all but ties."""
        return {n: line for n, line in self.settings.parameters.items() if line.tie is None}


def candidate_lines(study: Study) -> dict[str, Candidate]:
    """Return by candidate its given value, start, bounds, the range that starts are drawn from, and its unit."""

    def end(value: float) -> float | None:
        return value if math.isfinite(value) else None

    units = {n: study.model.parameters[n].unit for n in study.candidates}
    return {
        n: Candidate(f.given, f.start, end(f.min), end(f.max), (end(f.drawn[0]), end(f.drawn[1])), units[n])
        for n, f in study.candidates.items()
    }


def without_letter(content: bytes) -> bytes:
    """The text of a study without its table [letter], on which no result rests: results outlive a change of the addressee."""
    kept, inside = [], False
    for line in content.splitlines(keepends=True):
        if line.lstrip().startswith(b"["):
            inside = line.split(b"#")[0].strip() == b"[letter]"
        kept += [] if inside else [line]
    return b"".join(kept)


@in_python
def load_study(path: str | Path, trust: bool = False, limits: Mapping[str, float] | None = None) -> Study:
    """Return the study of a file, with its model and its recordings.

    Parameters
    ----------
    path : str or Path
        The study file (TOML).
    trust : bool, default False
        Whether a model that is Python code may be run.
    limits : dict of float, default None
        Of an FMU, by their keys in [model], where they differ from what stands there: deadline and load in s, memory in MiB.

    Returns
    -------
    Study
        `model`, `candidates` (the parameters that may be estimated), `experiments`, `responses` and `settings`.

    Raises
    ------
    InputError
        The file or what it names cannot be used: StudyError, ModelError, UnknownNameError or WaveformError, with the place in the file.

    Examples
    --------
    >>> import tempfile, hvdc_ident as hi
    >>> from pathlib import Path
    >>> from hvdc_ident.study import write_starter
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     study = hi.load_study(write_starter(Path(folder, "mine")))
    >>> study.model.name, list(study.candidates)
    ('vsc-hvdc-link', ['KPVDC', 'KIVDC'])
    """
    from hvdc_ident.study.stages.sweep import sweep_reference

    file = Path(path)
    content = _read(file)
    settings = parse_study(content, file)
    if limits:
        settings = settings.model_copy(update={"model": settings.model.model_copy(update=dict(limits))})
    where = file.name
    model, model_sources = _model(settings, file, trust)
    reference: str | None = sweep_reference(settings.sweep, f"{where}, sweep")
    reference = None if reference in ("data", "base") else reference
    compare = settings.linearize.compare if settings.linearize else None
    against, against_sources = _other_model(reference, settings, file, "sweep.against", trust)
    compared, compared_sources = _other_model(compare, settings, file, "linearize.compare", trust)
    recordings = Recordings(file.parent)
    model = with_unknowns(settings, model, where)
    candidates = candidates_of(settings, model, where)
    experiments, noise = read_experiments(settings.experiment, model, recordings, where)
    experiments = with_nuisances(settings, model, experiments, tuple(candidates), where)
    responses, response_sources = read_responses(settings, model, file.parent, where)
    study = Study(
        name=settings.name or file.stem,
        path=file,
        model=model,
        candidates=candidates,
        experiments=experiments,
        noise=noise,
        settings=settings,
        sources=FrozenMap(
            {
                where: digest(without_letter(content)),
                **model_sources,
                **against_sources,
                **compared_sources,
                **recordings.digests,
                **response_sources,
            }
        ),
        against=against,
        compared=compared,
        responses=responses,
    )
    check_questions(study, where)
    return study


def _read(file: Path) -> bytes:
    if file.is_dir():
        raise StudyError(
            "a folder is no study", where=str(file), expected="a study file (TOML)", hint=f"{file / 'study.toml'}"
        )
    try:
        return file.read_bytes()
    except FileNotFoundError:
        beside = [p.name for p in sorted(file.parent.glob("*.toml"))] if file.parent.is_dir() else []
        near = [str(file.with_name(n)) for n in nearest(file.name, beside)]
        hint, steps = (f"{' or '.join(near)}?", ()) if near else ("", (NextStep("new"),))
        raise StudyError("no such study file", where=str(file), hint=hint, next=steps) from None
    except OSError as e:
        raise StudyError(f"the study file cannot be read: {(e.strerror or str(e)).lower()}", where=str(file)) from None


def _model(settings: schema.StudyFile, file: Path, trust: bool) -> tuple[AnyModel, dict[str, str]]:
    """Return the model as the study wants it, and the hash of the file it comes from."""
    table, place = settings.model, f"{file.name}, model"
    source, sources = _source(table.source, file, "model.source")
    with located(f"{place}.source"):
        model = load_model(source, trust=trust, interface=table.interface, limits=_limits(table))
    if table.parameterisation is not None:
        with located(f"{place}.parameterisation"):
            model = model.parameterised(table.parameterisation)
    for table_name, outputs in _recorded(settings):  # before the effects, which may sit at what is recorded
        with located(f"{file.name}, {table_name}"):
            model = recording(model, outputs)
    if table.effect:
        with located(f"{place}.effect"):
            model = apply_effects(model, [e.model_dump(by_alias=True, exclude_none=True) for e in table.effect])
    with located(f"{place}.values"):
        return (model.with_values(table.values) if table.values else model), sources


def _limits(table: schema.ModelTable) -> dict[str, float] | None:
    """Return the limits of an FMU that are stated, by their keys."""
    stated = {n: v for n in ("deadline", "load", "memory") if (v := getattr(table, n)) is not None}
    return stated or None


def _recorded(settings: schema.StudyFile) -> Iterable[tuple[str, Iterable[str]]]:
    """Yield the place and the names of the outputs that each of a study's tables asks for."""
    for e in settings.experiment:
        yield f"experiment '{e.name}'.outputs", e.outputs
    for r in settings.response:
        yield f"response '{r.name}'.output", [r.output] if r.output else []
        yield f"response '{r.name}'.trim.outputs", r.trim.outputs if r.trim else []
    if settings.linearize is not None:
        yield "linearize.outputs", settings.linearize.outputs or []
        yield "linearize.trim.outputs", settings.linearize.trim.outputs if settings.linearize.trim else []


def _source(name: str, file: Path, place: str) -> tuple[str | Path, dict[str, str]]:
    """Return a shipped model's name, or a file's path from the study's folder, with that file's hash."""
    is_path = "/" in name or "\\" in name or Path(name).suffix in (".toml", ".fmu", ".py")
    if is_shipped(name) or not is_path:
        return name, {}
    source = file.parent / name
    if not source.is_file():
        raise StudyError(
            f"no model file '{name}'",
            where=f"{file.name}, {place}",
            expected="a path from the study's folder, or a shipped model: " + ", ".join(shipped_models()),
            hint=f"a path as seen from {file.parent}, or one of these names",
        )
    return source, {name: digest(source.read_bytes())}


def _other_model(
    name: str | None, settings: schema.StudyFile, file: Path, place: str, trust: bool
) -> tuple[AnyModel | None, dict[str, str]]:
    """Return a model that a study names beside its own, None where it names none, and its file's hash."""
    if name is None:
        return None, {}
    source, sources = _source(name, file, place)
    with located(f"{file.name}, {place}"):
        model = load_model(source, trust=trust, limits=_limits(settings.model) if name.endswith(".fmu") else None)
    if not is_white_box(model):  # it is compared where it has the same variables
        model = model.recording([n for _, names in _recorded(settings) for n in names if model.records(n)])
    return model, sources


def candidates_of(settings: schema.StudyFile, model: AnyModel, where: str) -> FrozenMap[FitParameter]:
    """Return the parameters that may be estimated. Raises StudyError or UnknownNameError."""
    candidates = {}
    for name, line in settings.parameters.items():
        place = f"{where}, parameters.{name}"
        if line.tie is not None or line.per_experiment:
            continue
        if name not in model.parameters:
            if name in model.inputs:
                hint = "an experiment's inputs, or its values"
                raise StudyError(f"'{name}' is an input, not a parameter", where=f"{where}, parameters", hint=hint)
            raise unknown_name("parameter", name, model.parameters, where=f"{where}, parameters")
        parameter = model.parameters[name]
        with located(place):
            free = free_of(name, line, model)
        if free.min < parameter.min or free.max > parameter.max:
            raise StudyError(
                "the bounds go beyond the model's own",
                where=place,
                expected=f"bounds within [{parameter.min:g}, {parameter.max:g}]",
                got=f"[{free.min:g}, {free.max:g}]",
            )
        candidates[name] = free
    return FrozenMap(candidates)


def with_unknowns(settings: schema.StudyFile, model: AnyModel, where: str) -> AnyModel:
    """Return the model with its ties, its given values, and what is said of its inputs.

    Raises StudyError or UnknownNameError for a tie, an input, or a parameter of each experiment, that does not fit the model.
    """
    settable = settings.inputs.settable if settings.inputs else None
    if settable is not None:
        require_known("input", settable, model.inputs, f"{where}, inputs.settable")
        inputs = {n: replace(i, settable=n in settable) for n, i in model.inputs.items()}
        model = replace(model, inputs=FrozenMap(inputs))  # type: ignore[type-var]
    for name, line in settings.parameters.items():
        if line.given is not None and name in model.parameters:
            with located(f"{where}, parameters.{name}.given"):
                model = model.with_values({name: line.given})
    ties = {n: line.tie for n, line in settings.parameters.items() if line.tie is not None}
    local = [n for n, line in settings.parameters.items() if line.per_experiment]
    require_known("parameter", (*ties, *local), model.parameters, f"{where}, parameters")
    if not ties and not local:
        return model
    if not is_white_box(model):
        first = [*ties, *local][0]
        raise StudyError(
            f"'{first}' cannot be tied or given to each experiment",
            where=f"{where}, parameters.{first}",
            expected="a model with equations",
            got="an FMU",
        )
    if not ties:
        return model
    expressions = {}
    for name, tie in ties.items():
        with located(f"{where}, parameters.{name}.tie"):
            expressions[name] = parse(tie)
    with located(f"{where}, parameters"):
        return model.tied(expressions)


def with_nuisances(
    settings: schema.StudyFile,
    model: AnyModel,
    experiments: Sequence[Experiment],
    candidates: Sequence[str],
    where: str,
) -> tuple[Experiment, ...]:
    """Return the experiments with the parameters each has for itself: those asked for, and the free starts of states.

    A start that is "free" is unknown: it is estimated in every experiment unless it is a candidate, one for all. Raises StudyError
    where the bounds of one do not hold its start.
    """
    local = [n for n, line in settings.parameters.items() if line.per_experiment]
    if is_white_box(model):
        free = [f"{n}_start" for n, s in model.states.items() if s.start == "free"]
        local += [n for n in free if n not in candidates and n not in local]
    if not local:
        return tuple(experiments)
    search = {}
    for name in (n for n in local if n in settings.parameters):
        with located(f"{where}, parameters.{name}"):
            parameter = free_of(name, settings.parameters[name], model)
        search[name] = (parameter.start, parameter.min, parameter.max)
    return tuple(e.with_(nuisance=tuple(dict.fromkeys((*e.nuisance, *local))), search=search) for e in experiments)


def free_of(name: str, line: schema.ParameterTable, model: AnyModel) -> FitParameter:
    """Return the unknown of a fit that a line of [parameters] describes; what it leaves out is the model's, its given value too.

    Raises StudyError where the bounds do not hold the start.
    """
    stated = {k: v for k in ("start", "min", "max") if (v := getattr(line, k)) is not None}
    return FitParameter.of(name, model.parameters[name], **stated)


def priors(settings: schema.StudyFile, experiments: Sequence[Experiment]) -> FrozenMap[Prior]:
    """Return the priors by unknown of a fit; one of a parameter that each experiment has for itself holds in every experiment."""
    from hvdc_ident.fit.likelihood import Prior
    from hvdc_ident.fit.simulator import unknown_of

    by_unknown: dict[str, Prior] = {}
    for name, line in settings.parameters.items():
        if line.prior is None:
            continue
        prior = Prior(line.prior.mean, line.prior.std)
        if line.per_experiment:
            by_unknown |= {unknown_of(e.name, name): prior for e in experiments if e.role == "fit"}
        else:
            by_unknown[name] = prior
    return FrozenMap(by_unknown)
