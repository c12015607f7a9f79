"""What `export` writes: the model itself or its linear model, in the format of the file's ending."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from hvdc_ident.errors import StudyError
from hvdc_ident.model import Model
from hvdc_ident.study.study import Study
from hvdc_ident.study.values import ValueSet, value_set

if TYPE_CHECKING:
    from hvdc_ident.linearize import LinearModel


@dataclass(frozen=True)
class FmuOptions:
    """How an FMU is written. kinds: "model-exchange", "co-simulation". binary: None compiles where there is a compiler."""

    version: str = "2.0"
    kinds: tuple[str, ...] = ("model-exchange", "co-simulation")
    binary: bool | None = None


@dataclass(frozen=True)
class Written:
    """A file that was written, what is to be said of it, and the name of the set of values that it holds, of a study."""

    path: Path
    note: str = ""
    values: str = ""


def fmu_options(fmi: str | None, kind: str | None, source_only: bool) -> FmuOptions | None:
    """The options as the command line says them: "2" or "3", "me" or "cs"; None where nothing is said."""
    versions = {"2": "2.0", "2.0": "2.0", "3": "3.0", "3.0": "3.0"}
    kinds = {"me": ("model-exchange",), "cs": ("co-simulation",)}
    if fmi is None and kind is None and not source_only:
        return None
    if fmi is not None and fmi not in versions:
        raise StudyError("this version of FMI cannot be written", where="--fmi", expected="2 or 3", got=repr(fmi))
    if kind is not None and kind not in kinds:
        raise StudyError("this kind of FMU is not known", where="--kind", expected="me or cs", got=repr(kind))
    default = FmuOptions()
    return FmuOptions(
        versions[fmi] if fmi else default.version,
        kinds[kind] if kind else default.kinds,
        False if source_only else None,
    )


def export(
    source: Study | Model | LinearModel,
    path: str | Path,
    linear: bool = False,
    fmu: FmuOptions | None = None,
    values: str | None = None,
    folder: str | Path | None = None,
) -> Path:
    """The path, written in the format of its ending: .toml, .fmu and .mo are the model, .ssv its parameters, the others its linear model.

    source: a study, a model (linearised at its steady state) or a linear model. linear: the linear model even where the
    ending is one of the nonlinear model's. fmu: version and kinds of an FMU. values: of a study, "given", "start" or
    "fitted"; left out, the fitted ones where a fit stands in its folder of results (folder, by default the study's own),
    else the given ones. The file says which it holds. Raises StudyError for an ending that is not known, where the model
    is not of the kind that the ending needs, and where fitted values are asked for and none stand.

    >>> import tempfile
    >>> from hvdc_ident import export, load_model
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     export(load_model("vsc-hvdc-link"), f"{folder}/link.mat").name
    'link.mat'
    """
    return write(source, path, linear, fmu, values, folder).path


def write(
    source: Study | Model | LinearModel,
    path: str | Path,
    linear: bool = False,
    fmu: FmuOptions | None = None,
    values: str | None = None,
    folder: str | Path | None = None,
    reduced: bool = False,
) -> Written:
    """The same, with what is to be said of the file: which values it holds, whether an FMU holds a binary.

    reduced: the reduced linear model that a study's [linearize] asks for.
    """
    from hvdc_ident.linearize.export import formats
    from hvdc_ident.linearize.export import write as write_linear

    path = Path(path)
    ending = path.suffix.lower()
    nonlinear = isinstance(source, Study | Model) and not linear and not reduced
    if fmu is not None and ending != ".fmu":
        raise StudyError("options of an FMU do not go with this ending", where=str(path), expected="a file *.fmu")
    if ending not in formats() and not (nonlinear and ending in _WRITERS):
        known = sorted({*formats(), *(_WRITERS if nonlinear else ())})
        raise StudyError("no export has this ending", where=str(path), expected=f"one of {', '.join(known)}")
    if values is not None and not isinstance(source, Study):
        raise StudyError("a model has one set of values: its own", where="values", expected="a study", got=repr(values))
    chosen = value_set(source, values, None if folder is None else Path(folder)) if isinstance(source, Study) else None
    if nonlinear and ending in _WRITERS:
        assert isinstance(source, Study | Model)
        written = _WRITERS[ending](source, chosen, path, fmu or FmuOptions())
    else:
        model = _linear(source, chosen)
        written = Written(write_linear(_reduced(source, model) if reduced else model, path))
    if chosen is None:
        return written
    return Written(written.path, "; ".join(t for t in (written.note, chosen.note) if t), chosen.name)


def _reduced(source: Study | Model | LinearModel, whole: LinearModel) -> LinearModel:
    """The linear model reduced as the study's [linearize] says, in the units of the whole."""
    asked = source.settings.linearize if isinstance(source, Study) else None
    if asked is None or asked.reduce is None:
        hint = "reduce = {order = 4}, or {tolerance = 0.01}, in [linearize]"
        raise StudyError(
            "the study asks for no reduced model", where="--reduced", expected="[linearize] reduce", hint=hint
        )
    r = asked.reduce
    small = whole.scaled(asked.scale).reduce(r.order, r.tolerance, match_dc=r.match_dc).model
    return small.scaled({n: 1.0 / size for n, size in asked.scale.items()})


def _card(source: Study | Model, chosen: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    from hvdc_ident.files import write_text
    from hvdc_ident.model import write_card

    head = f"# {' '.join(chosen.note.split())}\n" if chosen else ""
    return Written(write_text(path, head + write_card(_model(source, chosen))))


def _fmu(source: Study | Model, chosen: ValueSet | None, path: Path, options: FmuOptions) -> Written:
    from hvdc_ident.fmu.export import export_fmu

    ends = [float(e.time[-1]) for e in source.experiments] if isinstance(source, Study) else []
    stop = max((t for t in ends if t > 0.0), default=1.0)
    found = export_fmu(
        _described(source, chosen), path, version=options.version, kinds=options.kinds, binary=options.binary, stop=stop
    )
    return Written(found.path, f"FMI {found.version}, {' and '.join(found.kinds)}; {found.note}")


def _modelica(source: Study | Model, chosen: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    from hvdc_ident.fmu.export.modelica import save_modelica

    return Written(save_modelica(_described(source, chosen), path))


def _parameters(source: Study | Model, chosen: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    from hvdc_ident.files import write_text
    from hvdc_ident.study.tables import ssv

    model = source.model if isinstance(source, Study) else source
    values = {n: q.value for n, q in model.parameters.items()} | (dict(chosen.values) if chosen else {})
    return Written(write_text(path, ssv(values, source.name, chosen.note if chosen else "")))


_WRITERS: dict[str, Callable[[Study | Model, ValueSet | None, Path, FmuOptions], Written]] = {
    ".toml": _card,
    ".fmu": _fmu,
    ".mo": _modelica,
    ".ssv": _parameters,
}


def _model(source: Study | Model, chosen: ValueSet | None) -> Model:
    """The model with the chosen values."""
    if isinstance(source, Model):
        return source
    if not isinstance(source.model, Model):
        raise StudyError("the model's equations are not here to be written", where=source.path.name, got="an FMU")
    return source.model.with_values(dict(chosen.values)) if chosen and chosen.values else source.model


def _described(source: Study | Model, chosen: ValueSet | None) -> Model:
    """The same, with a description that says which values they are, for formats without comments."""
    model = _model(source, chosen)
    if chosen is None:
        return model
    return replace(model, description=f"{(model.description or model.name).rstrip('. ')}; {chosen.note}")


def _linear(source: Study | Model | LinearModel, chosen: ValueSet | None) -> LinearModel:
    from hvdc_ident.linearize import linearize
    from hvdc_ident.study.stages.linearize import linear_model

    if isinstance(source, Study):
        assert chosen is not None
        return linear_model(source, chosen)
    return linearize(source) if isinstance(source, Model) else source
