"""Export of a study's model with one of its sets of values, and the letter with the augmented model beside it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from datetime import date
from pathlib import Path
from typing import TYPE_CHECKING
from xml.sax.saxutils import quoteattr

from hvdc_ident.errors import ComputationError, LinearizationError, StudyError
from hvdc_ident.model import Model, is_white_box, read_card
from hvdc_ident.next_step import NextStep
from hvdc_ident.report.letter import STAGE, Letterhead, write_letter
from hvdc_ident.study.pipeline import Done, have_stage
from hvdc_ident.study.schema import LetterTable
from hvdc_ident.study.stages import StageOptions
from hvdc_ident.study.study import Study
from hvdc_ident.study.value_sets import ValueSet, value_set
from hvdc_ident.summary import Results

if TYPE_CHECKING:
    from hvdc_ident.linearize import LinearModel


SSV = "http://ssp-standard.org/SSP1/SystemStructureParameterValues"
SSC = "http://ssp-standard.org/SSP1/SystemStructureCommon"


@dataclass(frozen=True)
class FmuOptions:
    """Options of an FMU to write. kinds: "model-exchange", "co-simulation". binary: None compiles where there is a compiler."""

    version: str = "2.0"
    kinds: tuple[str, ...] = ("model-exchange", "co-simulation")
    binary: bool | None = None


@dataclass(frozen=True)
class Written:
    """A file that was written, and what is to be said of it.

    values, of: of a study, the name of the set of values that it holds, as it was asked for, and what they are: given, start,
    fit or effect. next: another set that may be meant.
    """

    path: Path
    note: str = ""
    values: str = ""
    of: str = ""
    next: tuple[NextStep, ...] = ()


def fmu_options(fmi: str | None, kind: str | None, source_only: bool) -> FmuOptions | None:
    """The options as the command line says them: "2" or "3", "me" or "cs"; None where nothing is said."""
    versions = {"2": "2.0", "2.0": "2.0", "3": "3.0", "3.0": "3.0"}
    kinds = {"me": ("model-exchange",), "cs": ("co-simulation",)}
    if fmi is None and kind is None and not source_only:
        return None
    if fmi is not None and fmi not in versions:
        raise StudyError(
            "no FMU is written in this version of FMI",
            where="fmi",
            expected="2 or 3",
            got=repr(fmi),
            next=(NextStep("option", "fmi = 2", "writes what most tools read"),),
        )
    if kind is not None and kind not in kinds:
        raise StudyError(
            "an FMU is of no such kind",
            where="kind",
            expected="me or cs",
            got=repr(kind),
            hint="me for model exchange, cs for co-simulation; without it the FMU has both",
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
    ending is one of the nonlinear model's. fmu: version and kinds of an FMU. values: of a study, a name of `value_sets`;
    left out, the fitted ones where they stand in its folder of results (folder, by default the study's own), else the given
    ones. Values with an effect are written with the effect in the model. reduced: the reduced linear model that a study's
    [linearize] asks for. The result says which values the file holds, and whether an FMU holds a binary. Raises StudyError for
    an ending that is not known, where the model is not of the kind that the ending needs, and where values are asked for that do
    not stand.
    """
    from hvdc_ident.linearize.export import FORMATS
    from hvdc_ident.linearize.export import write as write_linear

    path = Path(path)
    ending = path.suffix.lower()
    nonlinear = isinstance(source, Study | Model) and not linear and not reduced
    if fmu is not None and ending != ".fmu":
        raise StudyError(
            "options of an FMU are given, and this ending is another format's",
            where=str(path),
            expected="a file *.fmu",
            hint=f"{path.with_suffix('.fmu')}, or leave out the version, the kind and the sources",
        )
    if ending not in FORMATS and not (nonlinear and ending in _WRITERS):
        known = sorted({*FORMATS, *(_WRITERS if nonlinear else ())})
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
    told = () if written.note.startswith(selected.note) else (selected.note,)
    note = "; ".join(t for t in (written.note, *told) if t)
    return Written(written.path, note, selected.name, selected.of, selected.next)


def _reduced(source: Study | Model | LinearModel, whole: LinearModel) -> LinearModel:
    """The linear model reduced as the study's [linearize] says, in the units of the whole."""
    asked = source.settings.linearize if isinstance(source, Study) else None
    if asked is None or asked.reduce is None:
        hint = "reduce = {order = 4}, or {tolerance = 0.01}, in [linearize]"
        raise StudyError(
            "the study asks for no reduced model", where="reduced", expected="[linearize] reduce", hint=hint
        )
    r = asked.reduce
    small = whole.scaled(asked.scale).reduce(r.order, r.tolerance, match_dc=r.match_dc).model
    return small.scaled({n: 1.0 / size for n, size in asked.scale.items()})


def _card(source: Study | Model, selected: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    from hvdc_ident.files import write_text
    from hvdc_ident.model import write_card

    # With an effect the values hold together; without one each is determined by itself, or the given one stands.
    if isinstance(source, Study) and selected is not None and selected.of == "fit" and selected.name == "fitted":
        selected = selected.determined(source.given)
    head = "".join(f"# {line}\n" for line in _about(selected))
    written = Written(write_text(path, head + write_card(_model(source, selected))))
    return written if selected is None else replace(written, note=selected.note)


def _about(selected: ValueSet | None) -> list[str]:
    """Return the lines of a comment on values: where they are from, and of each estimate the interval."""
    if selected is None:
        return []
    each = [f"{n}: {selected.values[n]:.7g} ({told})" for n, told in selected.told.items() if n in selected.values]
    return [" ".join(selected.note.split()), *each]


def _fmu(source: Study | Model, selected: ValueSet | None, path: Path, options: FmuOptions) -> Written:
    from hvdc_ident.fmu.export import export_fmu

    experiments = source.experiments if isinstance(source, Study) else ()
    stop = max((t for e in experiments if (t := float(e.time[-1])) > 0.0), default=1.0)
    exported = export_fmu(
        _described(source, selected),
        path,
        version=options.version,
        kinds=options.kinds,
        binary=options.binary,
        stop=stop,
        experiments=experiments,
    )
    return Written(exported.path, f"FMI {exported.version}, {' and '.join(exported.kinds)}; {exported.note}")


def _modelica(source: Study | Model, selected: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    from hvdc_ident.fmu.export.modelica_model import save_modelica

    return Written(save_modelica(_described(source, selected), path))


def _parameters(source: Study | Model, selected: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    from hvdc_ident.files import write_text

    model = source.model if isinstance(source, Study) else source
    if selected is not None and selected.model is not None:
        model = selected.model
    values = {n: q.value for n, q in model.parameters.items()} | (dict(selected.values) if selected else {})
    return Written(write_text(path, ssv(values, source.name, selected.note if selected else "")))


def _dyr(source: Study | Model, selected: ValueSet | None, path: Path, _: FmuOptions) -> Written:
    """Write the .dyr file that the study's unit is from, with the selected values in its records."""
    from hvdc_ident.plants import part_name, with_unit_values
    from hvdc_ident.psse import read_dyr
    from hvdc_ident.shelf import source_of

    asked = source.settings.model.dyr if isinstance(source, Study) else None
    if asked is None or not isinstance(source, Study):
        raise StudyError(
            "the study does not say which .dyr file its unit is from",
            where=f"{source.path.name}, model.dyr" if isinstance(source, Study) else "",
            expected='dyr = {file = "plant.dyr", bus = 101, machine = "1"} in [model]',
            next=(NextStep("new-unit"),),
        )
    file = read_dyr(source.path.parent / asked.file)
    values = {n: selected.values[n] for n in source.candidates if n in selected.values} if selected else {}
    if selected is not None and selected.of in ("fit", "effect"):
        values = {n: v for n, v in values.items() if n in selected.intervals}  # what has none stays as the file has it
    records = file.at(asked.bus, asked.machine)
    changed, left = with_unit_values(file, records, values)
    for record in records:
        part = source_of(record.model)
        if selected is not None and part is not None and changed.records[record.number].values != record.values:
            told = [
                f"{n} {values[n]:.7g} ({t})"
                for n, t in selected.told.items()
                if n.startswith(f"{part_name(part)}.") and n in values
            ]
            changed = changed.with_comment(record, "; ".join(told)) if told else changed
    notes = [
        selected.determined(source.given).note if selected else "",
        f"no record has {', '.join(left)}" if left else "",
    ]
    if selected is not None and selected.of == "effect":
        notes.append("a .dyr file has no place for the effect that the values hold with")
    return Written(changed.write(path), "; ".join(filter(None, notes)))


_WRITERS: dict[str, Callable[[Study | Model, ValueSet | None, Path, FmuOptions], Written]] = {
    ".toml": _card,
    ".fmu": _fmu,
    ".mo": _modelica,
    ".ssv": _parameters,
    ".dyr": _dyr,
}


def _model(source: Study | Model, selected: ValueSet | None) -> Model:
    """The model with the selected values, and with the effect that they hold with."""
    if is_white_box(source):
        return source
    if not is_white_box(source.model):
        raise StudyError("the model's equations are not here to be written", where=source.path.name, got="an FMU")
    if selected is not None and is_white_box(selected.model):
        return selected.model
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
        try:
            return linear_model(source, selected)
        except LinearizationError as e:
            if selected.model is None:
                raise
            raise LinearizationError(
                f"with the effect that counts {e.what}",
                where=e.where,
                expected=e.expected,
                got=e.got,
                next=(NextStep("values", "fit"),),
            ) from None
    return linearize(source) if is_white_box(source) else source


def letter(study: Study, folder: Path, options: StageOptions) -> tuple[Path, Done]:
    """The path of the letter in the folder, and the diagnosis it is about.

    The diagnosis is read as it stands in the folder, whatever its options were, and run only where there is none of this study; so is
    the comparison at the given values: the letter draws the model before and after. Raises ComputationError, with its reason, where
    the diagnosis came to no end.
    """
    have_stage(study, "simulate", folder, options)
    done = have_stage(study, "diagnose", folder, options)
    if done.failed:
        goes_on = (NextStep("diagnose"),) if done.unfinished else ()
        raise ComputationError(
            "there is no diagnosis to write a letter about", where="letter", got=done.failed, next=goes_on
        )
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
