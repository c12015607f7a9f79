"""Export of a study's model with one of its sets of values, and the letter with the augmented model beside it.

given: the values the model came with, the vendor's; everything is simulated with them and compared with them.
start: where a search begins. fitted: what a fit in the folder of results estimated, with what it held.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args
from xml.sax.saxutils import quoteattr

from hvdc_ident.errors import ComputationError, StudyError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, read_card
from hvdc_ident.report.letter import STAGE, Letterhead, write_letter
from hvdc_ident.report.results import Results
from hvdc_ident.study.pipeline import Done, have_stage
from hvdc_ident.study.schema import LetterTable
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.study import Study

if TYPE_CHECKING:
    from hvdc_ident.linearize import LinearModel


SSV = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
SSC = "http://ssp-standard.org/SSP1/SystemStructureCommon"

SetName = Literal["given", "start", "fitted"]
SETS: tuple[SetName, ...] = get_args(SetName)

NO_ESTIMATES = ("failed", "not-converged")
"""Ends of a fit whose numbers are no estimates: they are never the fitted values."""
NOT_BY_ITSELF = ("two-optima",)
"""Ends of a fit that gives several answers that are as good: its best one is taken only where it is asked for."""


@dataclass(frozen=True)
class ValueSet:
    """Values of a study's parameters, in their units.

    name: given, start or fitted. note: what is to be said of them, in words that stand alone: where they come from, and
    why they are not the fitted ones where those might be expected. fit: the fingerprint of the fit, of fitted ones.
    """

    name: SetName
    values: FrozenMap[float]
    note: str
    fit: str = ""


def value_set(study: Study, wanted: str | None, folder: Path | None = None) -> ValueSet:
    """The set of that name; None: the fitted values where a fit stands in the folder, else the given ones.

    folder: of results, by default the study's own. A fit stands where it came to an end on the study, the files and the
    software as they are now. Raises StudyError for another name, and where fitted values are asked for and none stand.
    """
    if wanted is not None and wanted not in SETS:
        raise StudyError(
            "no such set of values",
            where="--values",
            expected=", ".join(SETS),
            got=repr(wanted),
            hint="--values given: those the model came with; start: where a search begins; fitted: those of a fit",
        )
    if wanted == "given":
        return _given(study)
    if wanted == "start":
        return ValueSet("start", study.start, f"start values of study '{study.name}', where a search begins")
    found, why = fitted_values(study, folder or study.folder)
    if found is not None and (wanted == "fitted" or not why):
        return found
    if wanted == "fitted":
        raise StudyError(
            f"there are no fitted values: {why}",
            where=study.path.name,
            expected=f"a finished fit of the study and its files as they are now, in {folder or study.folder}",
            hint=f"hvdc-ident fit {study.path}, or --values given",
        )
    return _given(study, "" if why == NONE else why)


NONE = "no fit has run"


def fitted_values(study: Study, folder: Path) -> tuple[ValueSet | None, str]:
    """The fitted values of the folder; and why they are not to be taken unasked, "" where they are.

    None where there are none to take at all: no fit, one of another state of the study, or one that failed.
    """
    from hvdc_ident.study.pipeline import standing

    data, why = standing(study, "fit", folder)
    if why or data.get("status") in NO_ESTIMATES:
        return None, why or f"the fit in {folder} ended as {data['status']}: {data.get('message', '')}"
    values = study.given | {n: float(data["values"][n]) for n in study.candidates if n in data["values"]}
    found = ValueSet("fitted", values, f"fitted values of study '{study.name}' ({_outcome(data)})", data["fingerprint"])
    if data["status"] in NOT_BY_ITSELF:
        return (
            found,
            f"the fit in {folder} ended as {data['status']}: {data['message']}; --values fitted takes the best",
        )
    return found, ""


def _given(study: Study, why: str = "") -> ValueSet:
    return ValueSet("given", study.given, f"given values of study '{study.name}'" + (f"; {why}" if why else ""))


def _outcome(fit: Mapping[str, Any]) -> str:
    """Return how a fit ended, and how far above the noise: what a reader has to know of its values."""
    held = [n for n in fit.get("candidates", {}) if n not in (fit.get("fitted") or [])]
    chi = fit.get("chi2_per_dof")
    verdict = str((fit.get("adequacy") or {}).get("verdict", ""))
    parts = [f"fit {fit['status']}", *(["the model does not fit these records"] if verdict == "does-not-fit" else [])]
    parts += [f"chi2/dof {chi:.3g}"] if isinstance(chi, int | float) else []
    parts += [f"held: {', '.join(held)}"] if held else []
    return ", ".join(parts)


@dataclass(frozen=True)
class FmuOptions:
    """Options of an FMU to write. kinds: "model-exchange", "co-simulation". binary: None compiles where there is a compiler."""

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
        raise StudyError(
            "no FMU is written in this version of FMI",
            where="--fmi",
            expected="2 or 3",
            got=repr(fmi),
            hint="--fmi 2, which most tools read",
        )
    if kind is not None and kind not in kinds:
        raise StudyError(
            "an FMU is of no such kind",
            where="--kind",
            expected="me or cs",
            got=repr(kind),
            hint="--kind me for model exchange, --kind cs for co-simulation; without it the FMU has both",
        )
    default = FmuOptions()
    return FmuOptions(
        versions[fmi] if fmi else default.version,
        kinds[kind] if kind else default.kinds,
        False if source_only else None,
    )


def write(
    source: Study | Model | LinearModel,
    path: str | Path,
    linear: bool = False,
    fmu: FmuOptions | None = None,
    values: str | None = None,
    folder: str | Path | None = None,
    reduced: bool = False,
) -> Written:
    """Write a file in the format of its ending: .toml, .fmu and .mo are the model, .ssv its parameters, the others its linear model.

    source: a study, a model (linearised at its steady state) or a linear model. linear: the linear model even where the
    ending is one of the nonlinear model's. fmu: version and kinds of an FMU. values: of a study, "given", "start" or
    "fitted"; left out, the fitted ones where a fit stands in its folder of results (folder, by default the study's own),
    else the given ones. reduced: the reduced linear model that a study's [linearize] asks for. The result says which values
    the file holds, and whether an FMU holds a binary. Raises StudyError for an ending that is not known, where the model is
    not of the kind that the ending needs, and where fitted values are asked for and none stand.
    """
    from hvdc_ident.linearize.export import formats
    from hvdc_ident.linearize.export import write as write_linear

    path = Path(path)
    ending = path.suffix.lower()
    nonlinear = isinstance(source, Study | Model) and not linear and not reduced
    if fmu is not None and ending != ".fmu":
        raise StudyError(
            "--fmi, --kind and --source-only are about an FMU, and this ending is another format's",
            where=str(path),
            expected="a file *.fmu",
            hint=f"--to {path.with_suffix('.fmu')}, or leave them out",
        )
    if ending not in formats() and not (nonlinear and ending in _WRITERS):
        known = sorted({*formats(), *(_WRITERS if nonlinear else ())})
        raise StudyError(
            "no export has this ending",
            where=str(path),
            expected=f"one of {', '.join(known)}",
            got=f"'{ending}'" if ending else "no ending",
            hint=f"{path.stem or 'model'}{'.fmu' if nonlinear else '.mat'}, or the file with another of these endings",
        )
    if values is not None and not isinstance(source, Study):
        raise StudyError("a model has one set of values: its own", where="values", expected="a study", got=repr(values))
    selected = (
        value_set(source, values, None if folder is None else Path(folder)) if isinstance(source, Study) else None
    )
    if nonlinear and ending in _WRITERS:
        assert isinstance(source, Study | Model)
        written = _WRITERS[ending](source, selected, path, fmu or FmuOptions())
    else:
        model = _linear(source, selected)
        written = Written(write_linear(_reduced(source, model) if reduced else model, path))
    if selected is None:
        return written
    return Written(written.path, "; ".join(t for t in (written.note, selected.note) if t), selected.name)


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


def _card(source: Study | Model, selected: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    from hvdc_ident.files import write_text
    from hvdc_ident.model import write_card

    head = f"# {' '.join(selected.note.split())}\n" if selected else ""
    return Written(write_text(path, head + write_card(_model(source, selected))))


def _fmu(source: Study | Model, selected: ValueSet | None, path: Path, options: FmuOptions) -> Written:
    from hvdc_ident.fmu.export import export_fmu

    ends = [float(e.time[-1]) for e in source.experiments] if isinstance(source, Study) else []
    stop = max((t for t in ends if t > 0.0), default=1.0)
    found = export_fmu(
        _described(source, selected),
        path,
        version=options.version,
        kinds=options.kinds,
        binary=options.binary,
        stop=stop,
    )
    return Written(found.path, f"FMI {found.version}, {' and '.join(found.kinds)}; {found.note}")


def _modelica(source: Study | Model, selected: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    from hvdc_ident.fmu.export.modelica_model import save_modelica

    return Written(save_modelica(_described(source, selected), path))


def _parameters(source: Study | Model, selected: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    from hvdc_ident.files import write_text

    model = source.model if isinstance(source, Study) else source
    values = {n: q.value for n, q in model.parameters.items()} | (dict(selected.values) if selected else {})
    return Written(write_text(path, ssv(values, source.name, selected.note if selected else "")))


_WRITERS: dict[str, Callable[[Study | Model, ValueSet | None, Path, FmuOptions], Written]] = {
    ".toml": _card,
    ".fmu": _fmu,
    ".mo": _modelica,
    ".ssv": _parameters,
}


def _model(source: Study | Model, selected: ValueSet | None) -> Model:
    """The model with the selected values."""
    if isinstance(source, Model):
        return source
    if not isinstance(source.model, Model):
        raise StudyError("the model's equations are not here to be written", where=source.path.name, got="an FMU")
    return source.model.with_values(dict(selected.values)) if selected and selected.values else source.model


def _described(source: Study | Model, selected: ValueSet | None) -> Model:
    """Return the model with the selected values, which its description names, for formats without comments."""
    model = _model(source, selected)
    if selected is None:
        return model
    return replace(model, description=f"{(model.description or model.name).rstrip('. ')}; {selected.note}")


def _linear(source: Study | Model | LinearModel, selected: ValueSet | None) -> LinearModel:
    from hvdc_ident.linearize import linearize
    from hvdc_ident.study.stages.linearize import linear_model

    if isinstance(source, Study):
        assert selected is not None
        return linear_model(source, selected)
    return linearize(source) if isinstance(source, Model) else source


def letter(study: Study, folder: Path, options: StageOptions) -> tuple[Path, Done]:
    """The path of the letter in the folder, and the diagnosis it tells of, which is run where the folder has none.

    Raises ComputationError with the reason where the diagnosis fails.
    """
    done = have_stage(study, "diagnose", folder, options)
    if done.failed:
        raise ComputationError("there is no diagnosis to write a letter about", where="letter", got=done.failed)
    attach(folder)
    said = (study.settings.letter or LetterTable()).model_dump()
    return write_letter(folder, Letterhead(**{**said, "date": said["date"] or date.today().isoformat()})), done


def attach(folder: Path) -> Path | None:
    """The augmented model as an FMU beside its card; None where nothing was added to the model."""
    name = Results(folder).get(STAGE).get("augmented_model")
    card = folder / Path(str(name)).name
    if not name or not card.is_file():
        return None
    return write(read_card(card), card.with_suffix(".fmu")).path


def ssv(values: Mapping[str, float], name: str, note: str = "") -> str:
    """The values as an SSP 1.0 parameter value file (.ssv). note: its description."""
    rows = "".join(
        f"    <ssv:Parameter name={quoteattr(n)}><ssv:Real value={quoteattr(repr(float(v)))}/></ssv:Parameter>\n"
        for n, v in values.items()
    )
    about = f" description={quoteattr(' '.join(note.split()))}" if note else ""
    return (
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f'<ssv:ParameterSet xmlns:ssv="{SSV}" xmlns:ssc="{SSC}" version="1.0" name={quoteattr(name)}{about}>\n'
        f"  <ssv:Parameters>\n{rows}  </ssv:Parameters>\n</ssv:ParameterSet>\n"
    )
