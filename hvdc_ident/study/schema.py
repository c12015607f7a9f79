"""The study file, table by table, as it is written: types, ranges and known keys; names are looked up later."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    StringConstraints,
    WithJsonSchema,
    model_validator,
)


def _column_by_name(value: Any) -> Any:
    """A list of names as a table from each name to the column of the same name."""
    if not isinstance(value, list):
        return _values_with_dots(value)
    doubled = sorted({str(v) for v in value if value.count(v) > 1})
    if doubled:
        raise ValueError(f"'{doubled[0]}' is listed twice")
    return {v if isinstance(v, str) else _not_text(v): v for v in value}


def _with_dots(value: Any, nests: Callable[[dict[Any, Any]], bool]) -> Any:
    """The table with a key a name, where TOML nests the names of a component: gen.H in a table gen. nests: whether a table does."""
    if not isinstance(value, dict):
        return value
    flat: dict[Any, Any] = {}
    for name, item in value.items():
        inner = _with_dots(item, nests)
        nested = isinstance(inner, dict) and bool(inner) and nests(inner)
        flat |= {f"{name}.{n}": v for n, v in inner.items()} if nested else {name: item}
    return flat


def _tables_with_dots(value: Any) -> Any:
    """The same of a table of tables: one nests names where it holds tables alone; `prior` is a key of a parameter's table."""
    return _with_dots(value, lambda t: "prior" not in t and all(isinstance(v, dict) for v in t.values()))


def _values_with_dots(value: Any) -> Any:
    """The same of a table of numbers or texts, in which every table nests names."""
    return _with_dots(value, lambda t: True)


def _one_or_three(value: Any) -> Any:
    """The value as a list of one name, or of three."""
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or len(names) not in (1, 3) or not all(isinstance(n, str) and n for n in names):
        raise ValueError(f"one column's name, or a list of three, is expected, not {value!r}")
    return names


def _known_noise(value: Any) -> Any:
    """The value, once it is a number or names a column (a union of types could not say which is wrong)."""
    if isinstance(value, dict):
        if set(value) != {"column"} or not isinstance(value["column"], str) or not value["column"]:
            raise ValueError('noise: neither a number nor {column = "name"}')
    elif isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f'noise: neither a number nor {{column = "name"}}: {value!r}')
    elif not (math.isfinite(value) and value >= 0):
        raise ValueError(f"noise: a finite number of at least 0 is expected, not {value}")
    return value


def _known_interpolation(value: Any) -> Any:
    """The value, once what is given per input is known to be right (a union of types could not say which is wrong)."""
    for name, kind in value.items() if isinstance(value, dict) else ():
        if kind not in ("hold", "linear"):
            raise ValueError(f"{name}: an unknown interpolation {kind!r}, neither 'hold' nor 'linear'")
    return value


def _effect_names(value: Any) -> Any:
    """The value, once it is "all" or a list of names."""
    if value == "all" or (isinstance(value, list) and value and all(isinstance(v, str) for v in value)):
        return value
    raise ValueError(f'effects: neither "all" nor a list of names: {value!r}')


def _as_list(value: Any) -> Any:
    """The value as a list, where it is one name."""
    return [value] if isinstance(value, str) else value


def _whitening(value: Any) -> Any:
    """The way of whitening; true and false are words for two of them."""
    return {True: "pre-event", False: "no"}[value] if isinstance(value, bool) else value


def _not_text(value: Any) -> str:
    raise ValueError(f"names are text in quotes, not {value!r}")


def _rising(ends: list[float]) -> list[float]:
    """The ends of a range, once the second is above the first."""
    if not ends[0] < ends[1]:
        raise ValueError("its end is not above its start")
    return ends


def _check_spread(low: float, high: float, scale: str) -> None:
    """Raise ValueError where values cannot be spread from min to max."""
    if not low < high:
        raise ValueError("max is not above min")
    if scale == "log" and low <= 0:
        raise ValueError("a log scale needs min above 0")


_TEXT: dict[str, Any] = {"type": "string", "minLength": 1}
_TEXTS: dict[str, Any] = {"type": "array", "items": _TEXT, "minItems": 1}
_NAME_OR_NAMES = WithJsonSchema({"anyOf": [_TEXT, _TEXTS]})  # what the validators before the types also take

Name = Annotated[str, StringConstraints(min_length=1, max_length=200, pattern=r"^[^\x00-\x1f\x7f]*$")]
Line = Annotated[str, StringConstraints(max_length=300, pattern=r"^[^\x00-\x1f\x7f]*$")]
FileName = Annotated[str, StringConstraints(min_length=1, max_length=100, pattern=r"^\w[\w .+-]*$")]
Positive = Annotated[FiniteFloat, Field(gt=0)]
NotNegative = Annotated[FiniteFloat, Field(ge=0)]
Names = Annotated[list[Name], Field(min_length=1)]
NameOrNames = Annotated[Names, BeforeValidator(_as_list), _NAME_OR_NAMES]
OneOrThree = Annotated[list[Name], BeforeValidator(_one_or_three), _NAME_OR_NAMES]
Axes = Annotated[list[Name], BeforeValidator(_as_list), Field(min_length=1, max_length=2), _NAME_OR_NAMES]
Three = Annotated[list[Name], Field(min_length=3, max_length=3)]
Band = Annotated[list[NotNegative], Field(min_length=2, max_length=2), AfterValidator(_rising)]
Columns = Annotated[
    dict[Name, Name],
    BeforeValidator(_column_by_name),
    WithJsonSchema({"anyOf": [_TEXTS, {"type": "object", "additionalProperties": _TEXT}]}),
]
Numbers = Annotated[dict[Name, FiniteFloat], BeforeValidator(_values_with_dots)]
Interpolation = Literal["hold", "linear"]


class TomlTable(BaseModel):
    """A table of the study file: an unknown key, a text for a number and a number that is not finite are refused."""

    model_config = ConfigDict(extra="forbid", strict=True, frozen=True, populate_by_name=False, protected_namespaces=())


class EffectTable(TomlTable):
    """[[model.effect]]: an effect that the model has from the start."""

    effect: Name
    at: NameOrNames
    parameters: dict[Name, FiniteFloat | Name] = {}
    source: Name | Names | None = Field(default=None, alias="from")
    expression: Annotated[str, StringConstraints(max_length=2000)] | None = None


class DyrTable(TomlTable):
    """[model] dyr: the .dyr file that the unit is from, its bus and the machine's identifier."""

    file: Name
    bus: int
    machine: Name


class ModelTable(TomlTable):
    """[model]: where the model comes from and what differs from it.

    deadline: s that one run of an FMU may take; load: s that it may take to begin; memory: MiB that it may take.
    """

    source: Name
    parameterisation: Name | None = None
    interface: Literal["model-exchange", "co-simulation"] | None = None
    deadline: Positive | None = None
    load: Positive | None = None
    memory: Positive | None = None
    values: Numbers = {}
    effect: list[EffectTable] = []
    dyr: DyrTable | None = None


class PriorTable(TomlTable):
    """Prior knowledge of a candidate: a normal distribution in the parameter's unit."""

    mean: FiniteFloat
    std: Positive


class ParameterTable(TomlTable):
    """One line of [parameters]: a parameter that may be estimated; what is left out is the model's own.

    given: the value that the model came with, the vendor's; start: where the search begins, else the given value.
    prior: what is known beforehand. tie: an expression of other parameters that this one follows; it is then no
    candidate. per-experiment: it has a value of its own in every experiment, as a nuisance.
    """

    given: FiniteFloat | None = None
    start: FiniteFloat | None = None
    min: FiniteFloat | None = None
    max: FiniteFloat | None = None
    prior: PriorTable | None = None
    tie: Annotated[str, StringConstraints(min_length=1, max_length=1000)] | None = None
    per_experiment: bool = Field(default=False, alias="per-experiment")

    @model_validator(mode="after")
    def _tie_alone(self) -> ParameterTable:
        others = (self.given, self.start, self.min, self.max, self.prior)
        if self.tie is not None and (self.per_experiment or any(v is not None for v in others)):
            raise ValueError("tie: a tied parameter has neither start, bounds nor prior of its own, nor a given value")
        return self


class ColumnTable(TomlTable):
    """One line of an experiment's `columns`: the recorded column of a signal and how it gets the model's unit.

    model = scale x recorded + offset, or (recorded / base) + offset; the offset is in the model's unit.
    """

    name: Name | None = None
    unit: Annotated[str, StringConstraints(max_length=50)] | None = None
    scale: FiniteFloat | None = None
    base: Positive | None = None
    offset: FiniteFloat | None = None

    @model_validator(mode="after")
    def _one_factor(self) -> ColumnTable:
        if self.scale is not None and self.base is not None:
            raise ValueError("give either scale (model = scale x recorded) or base (model = recorded / base)")
        return self


class PhasesTable(TomlTable):
    """One line of an experiment's `phases`: quantities made of three recorded phases.

    gives: the quantity of each new column, to be named in inputs, outputs, drive or columns like a recorded one.
    """

    voltage: Three
    current: Three | None = None
    frequency: Positive
    filter: Literal["mean", "lowpass", "none"] = "mean"
    window: NotNegative | None = None
    gives: Annotated[dict[Name, Name], Field(min_length=1)]


class PhasorTable(TomlTable):
    """Magnitude and angle of a quantity: one column each, or three in the order of rotation; unit: deg or rad, of the angles."""

    magnitude: OneOrThree
    angle: OneOrThree
    unit: Literal["deg", "rad"] | None = None

    @model_validator(mode="after")
    def _as_many(self) -> PhasorTable:
        if len(self.magnitude) != len(self.angle):
            raise ValueError("angle: as many columns as magnitude are needed")
        return self


class PhasorsTable(TomlTable):
    """One line of an experiment's `phasors`: quantities made of recorded magnitudes and angles (`hvdc_ident.data.three_phase`).

    magnitudes: how they are counted, for powers. window: s, over which the frequency is the angle's mean slope.
    reference: "start", or the column of angles that angles are counted from; left out: as recorded.
    gives: the quantity of each new column, to be named in inputs, outputs, drive or columns like a recorded one.
    """

    voltage: PhasorTable
    current: PhasorTable | None = None
    frequency: Positive | None = None
    window: Positive = 0.1
    magnitudes: Literal["phase-rms", "line-rms", "phase-peak", "pu"] | None = None
    reference: Name | None = None
    gives: Annotated[dict[Name, Name], Field(min_length=1)]


class InstrumentTable(TomlTable):
    """One line of an experiment's `instrument`: the recording chain of an output."""

    window_mean: NotNegative | None = Field(default=None, alias="window-mean")
    delay: NotNegative | None = None
    accuracy_class: Positive | None = Field(default=None, alias="class")


class NoiseTable(TomlTable):
    """One line of an experiment's `noise`, where every row has a standard deviation of its own, in the output's unit."""

    column: Name


class ExperimentTable(TomlTable):
    """[[experiment]]: one recording and what to make of it.

    trim: by input, the recorded output at whose level before the event it stands, in the model's unit.
    noise: the standard deviation of an output in the model's unit, or the column that holds it in that of the output's.
    """

    name: FileName
    data: Name
    role: Literal["fit", "holdout"] = "fit"
    inputs: Columns = {}
    outputs: Columns
    noise: dict[Name, Annotated[float | NoiseTable, BeforeValidator(_known_noise)]] = {}
    event: FiniteFloat | None = None
    window: Annotated[list[FiniteFloat], Field(min_length=2, max_length=2), AfterValidator(_rising)] | None = None
    values: Numbers = {}
    trim: Columns = {}
    columns: Annotated[dict[Name, ColumnTable], BeforeValidator(_tables_with_dots)] = {}
    nuisance: list[Name] = []
    drive: Columns = {}
    instrument: dict[Name, InstrumentTable] = {}
    phases: list[PhasesTable] = []
    phasors: list[PhasorsTable] = []
    interpolation: Annotated[
        Interpolation | dict[Name, Interpolation] | None, BeforeValidator(_known_interpolation)
    ] = None

    @model_validator(mode="after")
    def _recorded(self) -> ExperimentTable:
        if not self.outputs:
            raise ValueError("outputs: at least one recorded output is needed")
        return self


class TrimTable(TomlTable):
    """[linearize] trim: the values that outputs are to have at the operating point, and the inputs that are set for it.

    inputs: values of other inputs. free: inputs or parameters to be found; left out, the inputs that move the outputs.
    """

    outputs: Annotated[Numbers, Field(min_length=1)]
    inputs: Numbers = {}
    free: Names | None = None


class ReduceTable(TomlTable):
    """[linearize] reduce: a model of fewer states, so many or as few as keep the error within a tolerance."""

    order: Annotated[int, Field(ge=0)] | None = None
    tolerance: Positive | None = None
    match_dc: bool = False

    @model_validator(mode="after")
    def _one_way(self) -> ReduceTable:
        if (self.order is None) == (self.tolerance is None):
            raise ValueError("give either order (states that stay) or tolerance (largest error of the gain)")
        return self


class PlantTable(TomlTable):
    """[linearize] plant: the signals that go into the plant and those the controller measures on it."""

    inputs: NameOrNames
    outputs: NameOrNames


class PortTable(TomlTable):
    """[[linearize.port]]: where an impedance is seen, d and q or one dc signal each; band: Hz."""

    name: FileName
    source: Axes
    voltage: Axes
    current: Axes
    angle: Name = "0"
    band: Annotated[list[Positive], Field(min_length=2, max_length=2), AfterValidator(_rising)] = [0.1, 1000.0]
    points: Annotated[int, Field(ge=2, le=100_000)] = 200

    @model_validator(mode="after")
    def _as_many(self) -> PortTable:
        if not len(self.source) == len(self.voltage) == len(self.current):
            raise ValueError("source, voltage and current need as many signals each: two (d, q), or one (dc)")
        if len(self.source) == 1 and self.angle != "0":
            raise ValueError("angle: a dc port has none")
        return self


class LocusTable(TomlTable):
    """[linearize] locus: the eigenvalues along values of one parameter or input, each at its own operating point."""

    parameter: Name
    min: FiniteFloat
    max: FiniteFloat
    points: Annotated[int, Field(ge=2, le=100_000)] = 60
    scale: Literal["linear", "log"] = "linear"

    @model_validator(mode="after")
    def _ordered(self) -> LocusTable:
        _check_spread(self.min, self.max, self.scale)
        return self


class LinearizeTable(TomlTable):
    """[linearize]: between which inputs and outputs, where, and what is wanted of the linear model.

    side: of a limit that the operating point lies on, which derivative is taken; left out, such a point is refused.
    break_at: signals at which loops are opened for their margins. plant: where plant and controller meet, for the
    coprime factor margin. compare: another model, a shipped one or a path. scale: the size of an input or output that
    counts as 1 in norms, gaps and the reduction. formula: parameters to be shown as symbols in the transfer functions.
    """

    inputs: Names | None = None
    outputs: Names | None = None
    at: Literal["steady", "start"] = "steady"
    side: Literal["refuse", "below", "above"] = "refuse"
    trim: TrimTable | None = None
    break_at: NameOrNames | None = None
    plant: PlantTable | None = None
    reduce: ReduceTable | None = None
    compare: Name | None = None
    scale: dict[Name, Positive] = {}
    formula: Names | None = None
    locus: LocusTable | None = None
    port: list[PortTable] = []


class ResponseTable(TomlTable):
    """[[response]]: a measured frequency response, from an input to an output, or at a port of [[linearize.port]].

    columns: the file's channel of each measured one (dd, dq, qd, qq at a port of two axes). signals: where data is a record
    in time, its columns {input, output}; frequencies: of the perturbation there, Hz. scale: model = scale x recorded.
    noise: standard deviation of the error's modulus, in the model's unit; relative_noise: as a share of the modulus.
    values, trim: the operating point it was measured at. band: Hz.
    """

    name: FileName
    data: Name
    role: Literal["fit", "holdout"] = "fit"
    input: Name | None = None
    output: Name | None = None
    port: Name | None = None
    kind: Literal["impedance", "admittance"] = "impedance"
    columns: dict[Name, Name] = {}
    signals: dict[Literal["input", "output"], Name] = {}
    frequencies: Annotated[list[Positive], Field(min_length=1)] | None = None
    scale: FiniteFloat = 1.0
    unit: Annotated[str, StringConstraints(max_length=50)] = ""
    noise: Positive | None = None
    relative_noise: Positive | None = None
    band: Band | None = None
    values: Numbers = {}
    trim: TrimTable | None = None

    @model_validator(mode="after")
    def _one_place(self) -> ResponseTable:
        named = (self.input is not None, self.output is not None, self.port is not None)
        if named not in ((True, True, False), (False, False, True)):
            raise ValueError("give either input and output, or port")
        if self.noise is not None and self.relative_noise is not None:
            raise ValueError("give either noise or relative_noise")
        if (self.signals or self.frequencies) and set(self.signals) != {"input", "output"}:
            raise ValueError("signals: a record in time needs the columns of its input and output")
        return self


class SweepTable(TomlTable):
    """[[sweep]]: the values of one parameter, listed or spread over a range.

    against: "data", "base", or another model, a shipped one or a path.
    """

    parameter: Name
    min: FiniteFloat | None = None
    max: FiniteFloat | None = None
    points: Annotated[int, Field(ge=2, le=1_000_000)] | None = None
    scale: Literal["linear", "log"] = "linear"
    sampling: Literal["grid", "latin-hypercube"] = "grid"
    against: Name | None = None
    want: Annotated[list[Literal["rmse", "poles", "bode"]], Field(min_length=1)] = ["rmse"]
    values: Annotated[list[FiniteFloat], Field(min_length=1)] | None = None

    @model_validator(mode="after")
    def _one_way(self) -> SweepTable:
        spread = (self.min, self.max, self.points)
        if self.values is not None and any(v is not None for v in spread):
            raise ValueError("give either values or min, max and points")
        if self.values is not None and self.sampling == "latin-hypercube":
            raise ValueError("a Latin hypercube needs min, max and points, not values")
        if self.values is None:
            if self.min is None or self.max is None or self.points is None:
                raise ValueError("min, max and points are needed, or values")
            _check_spread(self.min, self.max, self.scale)
        return self


class ScreeningTable(TomlTable):
    """[screening]: which parameters matter over their whole ranges, by Morris' elementary effects or Sobol's indices.

    parameters: default, all candidates; each over its bounds. trajectories: of Morris; samples: of Sobol, a power of 2.
    against: "data", or "base", the model's own run.
    """

    method: Literal["morris", "sobol"] = "morris"
    parameters: Names | None = None
    trajectories: Annotated[int, Field(ge=2, le=100_000)] = 20
    samples: Annotated[int, Field(ge=2, le=1_048_576)] = 256
    against: Literal["data", "base"] = "data"


class IdentifiabilityTable(TomlTable):
    """[identifiability]: asks for the stage. pair: two candidates whose common profile is wanted, on a grid."""

    pair: Annotated[list[Name], Field(min_length=2, max_length=2)] | None = None


class GroupTable(TomlTable):
    """One group of [fit] groups: these parameters against these outputs of these experiments (all where left out)."""

    parameters: Names
    outputs: Names | None = None
    experiments: Names | None = None


class FitTable(TomlTable):
    """[fit]: how the candidates are estimated.

    starts: left out, 8, and up to 64 as long as they leave a doubt. whiten: true is "pre-event".
    guard: s on either side of an input's break that are not compared. band: Hz, of the frequency-domain residual (left
    out: all). tolerance: profile of the windowed errors, shipped or a TOML file beside the study.
    """

    mode: Literal["simultaneous", "individual"] = "simultaneous"
    groups: list[GroupTable] = []
    optimiser: Name = "trust-region"
    loss: Name = "linear"
    starts: Annotated[int, Field(ge=1, le=10_000)] | None = None
    whiten: Annotated[
        Literal["no", "pre-event", "residual"],
        BeforeValidator(_whitening),
        WithJsonSchema({"enum": ["no", "pre-event", "residual", True, False]}),
    ] = "no"
    guard: NotNegative = 0.0
    residual: Literal["time", "frequency"] = "time"
    band: Band | None = None
    tolerance: Name = "set-point-step-simulation"

    @model_validator(mode="after")
    def _groups_fit_the_mode(self) -> FitTable:
        if self.mode == "individual" and not self.groups:
            raise ValueError('mode "individual" needs groups, one a controller')
        if self.groups and self.mode != "individual":
            raise ValueError('groups belong to mode "individual"')
        if self.band is not None and self.residual != "frequency":
            raise ValueError('band belongs to residual "frequency"')
        return self


class DiagnoseTable(TomlTable):
    """[diagnose]: which effects to try ("all" may stand beside others), by output the error below which a gap is of no interest
    (`tolerance`; `material` is its earlier name), how many effects may be missing at most, whether what promises little is
    refitted too where nothing comes near the noise, the seconds after which nothing further is looked for, and the insertion points
    that are tried, by name or pattern (avr.*), left out all."""

    effects: Annotated[Literal["all"] | list[Name], BeforeValidator(_effect_names)] = "all"
    places: Names | None = None
    tolerance: dict[Name, Positive] = {}
    material: dict[Name, Positive] = {}
    most: Annotated[int, Field(ge=1)] = 3
    thorough: bool = False
    budget: Positive | None = None

    @model_validator(mode="after")
    def _one_name(self) -> DiagnoseTable:
        if self.tolerance and self.material:
            raise ValueError("material: it is the earlier name of tolerance, which is given too. Try: tolerance alone")
        return self

    @property
    def tolerances(self) -> dict[str, float]:
        """By output, the error below which a gap is of no interest, in its unit."""
        return self.tolerance or self.material


class LetterTable(TomlTable):
    """[letter]: who writes to whom about what, for `hvdc-ident letter`; no result rests on it.

    author, to: with what belongs to an address. plant: what was recorded. version: of the model. date: left out, today.
    """

    author: Line = ""
    to: Line = ""
    plant: Line = ""
    version: Line = ""
    date: Line = ""


class StudyFile(TomlTable):
    """The whole study file."""

    version: Literal[1] = Field(alias="schema")
    name: Name | None = None
    model: ModelTable
    parameters: Annotated[dict[Name, ParameterTable], BeforeValidator(_tables_with_dots)] = {}
    experiment: list[ExperimentTable] = []
    response: list[ResponseTable] = []
    linearize: LinearizeTable | None = None
    sweep: list[SweepTable] = []
    screening: ScreeningTable | None = None
    identifiability: IdentifiabilityTable | None = None
    fit: FitTable | None = None
    diagnose: DiagnoseTable | None = None
    letter: LetterTable | None = None
