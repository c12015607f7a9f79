"""The study file, table by table: types, ranges, and what each key means; names are looked up later.

A key may stand on a line longer than the formatter's: the tables are read like the reference that is made of them.
"""

# fmt: off
from __future__ import annotations

import math
from datetime import date
from typing import Annotated, Any, ClassVar, Literal

from pydantic import AfterValidator, BeforeValidator, Field, FiniteFloat, StringConstraints, model_validator

from hvdc_ident.toml_tables import ByName, Name, NotNegative, TomlTable, key, optional, with_dots, wrong


def _column_by_name(value: Any) -> Any:
    """A list of names as a table from each name to the column of the same name."""
    if not isinstance(value, list):
        return with_dots(value)
    doubled = sorted({str(v) for v in value if value.count(v) > 1})
    if doubled:
        raise ValueError(f"'{doubled[0]}' is listed twice")
    return {v if isinstance(v, str) else _not_text(v): v for v in value}


def _not_text(value: Any) -> str:
    raise ValueError(f"names are text in quotes, not {value!r}")


def _one_or_three(value: Any) -> Any:
    """The value as a list of one name, or of three."""
    names = [value] if isinstance(value, str) else value
    if not isinstance(names, list) or len(names) not in (1, 3) or not all(isinstance(n, str) and n for n in names):
        raise wrong("one column's name, or a list of three")
    return names


# A union of types says which of its branches failed, not what is expected: these validators say it before.

def _known_noise(value: Any) -> Any:
    """The value, once it is a number or names a column."""
    if isinstance(value, dict):
        right = set(value) == {"column"} and isinstance(value["column"], str) and value["column"] != ""
    else:
        right = isinstance(value, int | float) and not isinstance(value, bool) and 0 <= value < math.inf
    if not right:
        raise wrong('a finite number of at least 0, or {column = "name"}', "no standard deviation")
    return value


def _known_interpolation(value: Any) -> Any:
    """The value, once what is given per input is known to be right."""
    flat = with_dots(value)
    for name, kind in flat.items() if isinstance(flat, dict) else ():
        if kind not in ("hold", "linear"):
            raise ValueError(f"{name}: an unknown interpolation {kind!r}, neither 'hold' nor 'linear'")
    return flat


def _effect_names(value: Any) -> Any:
    """The value, once it is "all" or a list of names."""
    if value == "all" or (isinstance(value, list) and value and all(isinstance(v, str) for v in value)):
        return value
    raise wrong('"all", or a list of names')


def _as_list(value: Any) -> Any:
    """The value as a list, where it is one name."""
    return [value] if isinstance(value, str) else value


def _whitening(value: Any) -> Any:
    """The way of whitening; true and false are words for two of them."""
    return {True: "pre-event", False: "no"}[value] if isinstance(value, bool) else value


def _date_text(value: Any) -> Any:
    """A date of TOML as text."""
    return value.isoformat() if isinstance(value, date) else value


def _rising(ends: list[float]) -> list[float]:
    """The ends of a range, once the second is above the first."""
    if not ends[0] < ends[1]:
        raise wrong("[start, end]", "its end is not above its start", f"[{ends[1]:g}, {ends[0]:g}]" if ends[0] > ends[1] else "")
    return ends


def _not_falling(ends: list[float]) -> list[float]:
    """The ends of a span, which may be one instant."""
    return ends if ends[0] == ends[1] else _rising(ends)


def _check_spread(low: float, high: float, scale: str) -> None:
    """Raise ValueError where values cannot be spread from min to max."""
    if not low < high:
        raise ValueError(f"max is not above min. Try: min = {high:g}, max = {low:g}")
    if scale == "log" and low <= 0:
        raise ValueError("a log scale needs min above 0")


Line = Annotated[str, StringConstraints(max_length=300, pattern=r"^[^\x00-\x1f\x7f]*$")]
FileName = Annotated[str, StringConstraints(min_length=1, max_length=100, pattern=r"^\w[\w .+-]*$")]
Unit = Annotated[str, StringConstraints(max_length=50)]
Positive = Annotated[FiniteFloat, Field(gt=0)]
Names = Annotated[list[Name], Field(min_length=1)]
NameOrNames = Annotated[Names, BeforeValidator(_as_list, json_schema_input_type=Name | Names)]
NamesOrNone = Annotated[list[Name], BeforeValidator(_as_list, json_schema_input_type=Name | list[Name])]
OneOrThree = Annotated[list[Name], BeforeValidator(_one_or_three, json_schema_input_type=Name | Names)]
Axes = Annotated[list[Name], Field(min_length=1, max_length=2), BeforeValidator(_as_list, json_schema_input_type=Name | Names)]
Two = Annotated[list[Name], Field(min_length=2, max_length=2)]
Three = Annotated[list[Name], Field(min_length=3, max_length=3)]
Range = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2), AfterValidator(_rising)]
Span = Annotated[list[FiniteFloat], Field(min_length=2, max_length=2), AfterValidator(_not_falling)]
Band = Annotated[list[NotNegative], Field(min_length=2, max_length=2), AfterValidator(_rising)]
Texts = Annotated[dict[Name, Name], ByName()]
Columns = Annotated[dict[Name, Name], BeforeValidator(_column_by_name, json_schema_input_type=Names | Texts)]
Numbers = Annotated[dict[Name, FiniteFloat], ByName()]
Sizes = Annotated[dict[Name, Positive], ByName()]
Interpolation = Literal["hold", "linear"]
Role = Literal["fit", "holdout"]
Spacing = Literal["linear", "log"]


class InputsTable(TomlTable):
    """[inputs]: what a person can do with the model's inputs."""

    settable: NamesOrNone | None = optional(
        "The inputs that a person can move for an experiment; what to record next moves no other. [] for none. If left out, those that "
        "the model does not declare otherwise: of shipped models all but grid voltages, grid frequencies and measured signals.",
        'settable = ["Vdcref1", "Pref2"]', of="input")


class EffectTable(TomlTable):
    """[[model.effect]]: an effect that the model has from the start."""

    effect: Name = key("Name of an effect of the catalogue.", 'effect = "lag"')
    at: NameOrNames = key(
        "The insertion points: inputs, signals, algebraic unknowns, states or outputs. One effect at several of them has one set of "
        "parameters.",
        'at = ["Ir1", "Ir2"]')
    parameters: dict[Name, FiniteFloat | Name] = optional(
        "Values of the effect's parameters. A text names a parameter of the model that the value follows.",
        "parameters = {T = 0.0016}", "the effect's", default={})
    source: Name | Names | None = optional(
        "The other signal that the effect brings in (coupling, droop, loss, conductance), or one for each insertion point.",
        'from = "Vdc1"', alias="from")
    expression: Annotated[str, StringConstraints(max_length=2000)] | None = optional(
        "The added expression of the effect `term`, in signals of the model and own coefficients.", 'expression = "a*Vdc1**2"')


class DyrTable(TomlTable):
    """[model] dyr: the .dyr file that the unit is from, its bus and the machine's identifier."""

    file: Name = key("Path of the .dyr file, relative to the study.", 'file = "plant.dyr"')
    bus: int = key("Number of the unit's bus.", "bus = 101")
    machine: Name = key("Identifier of the machine at the bus.", 'machine = "1"')


class ModelTable(TomlTable):
    """[model]: where the model comes from and what differs from it."""

    source: Name = key(
        "A shipped model (`hvdc-ident models`), or the path of a model card (.toml), an FMU (.fmu) or a Python file (.py, only with "
        "`--trust`).",
        'source = "vsc-hvdc-link"')
    parameterisation: Name | None = optional(
        "One of the model's own other sets of parameters. The link has \"gains\" and \"physical\" (J and Ts).",
        'parameterisation = "physical"')
    interface: Literal["model-exchange", "co-simulation"] | None = optional(
        "Which interface of an FMU is used. If left out, model exchange where the FMU has it.", 'interface = "co-simulation"')
    deadline: Positive | None = optional("Time that one run of an FMU may take. If left out, 60 s.", "deadline = 300", "s")
    load: Positive | None = optional("Time that loading and instantiating an FMU may take. If left out, 60 s.", "load = 120", "s")
    memory: Positive | None = optional("Memory that the process of an FMU may take beyond that at its start. If left out, 2048 MiB.",
        "memory = 4096", "MiB")
    values: Numbers = optional("Values of parameters and inputs that differ from the model's.",
        "values = {KPQ = 0.0}", "the model's", default={})
    effect: list[EffectTable] = optional("Effects that the plant is known to have: one table for each.", "[[model.effect]]", default=[])
    dyr: DyrTable | None = optional(
        "The .dyr file that the unit is from: `export --to FILE.dyr` writes the fitted values into its records.",
        'dyr = {file = "plant.dyr", bus = 101, machine = "1"}')


class PriorTable(TomlTable):
    """Prior knowledge of a candidate: a normal distribution in the parameter's unit."""

    mean: FiniteFloat = key("Mean of the prior distribution.", "prior = {mean = 730, std = 40}", "the parameter's")
    std: Positive = key("Standard deviation of the prior distribution.", "prior = {mean = 730, std = 40}", "the parameter's")


class ParameterTable(TomlTable):
    """One line of [parameters]: a parameter that may be estimated; what is left out is the model's own."""

    given: FiniteFloat | None = optional(
        "The vendor's value, with which letter and report compare. If left out, that of [model.values], else the model's.",
        "KIVDC = {given = 734.7}", "the parameter's")
    start: FiniteFloat | None = optional("Where the search begins. If left out, the given value.",
        "KIVDC = {start = 750}", "the parameter's")
    min: FiniteFloat | None = optional("Lower bound of the estimation. If left out, the model's.", "KIVDC = {min = 550}", "the parameter's")
    max: FiniteFloat | None = optional("Upper bound of the estimation. If left out, the model's.", "KIVDC = {max = 950}", "the parameter's")
    prior: PriorTable | None = optional("Prior knowledge, a normal distribution, which enters the estimate.",
        "KIVDC = {prior = {mean = 730, std = 40}}")
    tie: Annotated[str, StringConstraints(min_length=1, max_length=1000)] | None = optional(
        "An expression of other parameters that this one follows. It is then not estimated.", 'KPQ = {tie = "0.5*KIQ"}')
    per_experiment: bool = optional("True gives the parameter its own value in every experiment.",
        "Zg = {min = 0.01, max = 0.1, per-experiment = true}", default=False, alias="per-experiment")

    ELSEWHERE: ClassVar = {
        "value": "given = ... for the value that the model came with, start = ... for where the search begins",
        "init": "start = ..., where the search begins", "initial": "start = ..., where the search begins",
        "vary": "vary = false: leave the parameter out of [parameters]; it keeps the model's value, or that of [model.values]",
        "expr": "tie = ..., an expression of other parameters that this one follows",
        "bounds": "min = ... and max = ...", "lower": "min = ...", "upper": "max = ...", "lb": "min = ...", "ub": "max = ...",
    }

    @model_validator(mode="before")
    @classmethod
    def _is_table(cls, value: Any) -> Any:
        numbers = value if isinstance(value, list) else [value]
        if len(numbers) in (1, 2) and all(isinstance(v, int | float) and not isinstance(v, bool) for v in numbers):
            keys = ("min", "max") if len(numbers) == 2 else ("start",)
            line = ", ".join(f"{k} = {v}" for k, v in zip(keys, numbers, strict=True))
            raise wrong("a table: {start = ..., min = ..., max = ...}", hint=f"{{{line}}}")
        return value

    @model_validator(mode="after")
    def _consistent(self) -> ParameterTable:
        others = (self.given, self.start, self.min, self.max, self.prior)
        if self.tie is not None and (self.per_experiment or any(v is not None for v in others)):
            raise ValueError("tie: a tied parameter has neither start, bounds nor prior of its own, nor a given value")
        if self.min is not None and self.max is not None and self.min >= self.max:
            low, high = f"{self.max:g}", f"{self.min:g}"
            hint = f"min = {low}, max = {high}" if low != high else f"[model.values] with {low}, if it is not to move"
            raise ValueError(f"min is not below max: min = {high}, max = {low}. Try: {hint}")
        return self


class ColumnTable(TomlTable):
    """One line of an experiment's `columns`: the recorded column of a signal and how it gets the model's unit.

    model = scale x recorded + offset, or (recorded / base) + offset; the offset is in the model's unit. An angle is unwrapped.
    """

    name: Name | None = optional("The column in the file. If left out, the signal's own name.", 'columns = {P2 = {name = "P_MW"}}')
    unit: Unit | None = optional(
        "Unit of the recorded values. If left out, as in the file, else the model's.", 'columns = {P2 = {unit = "MW", base = 1000}}')
    scale: FiniteFloat | None = optional("Factor: model = scale x recorded + offset.", "columns = {T = {scale = 0.1, offset = -20}}")
    base: Positive | None = optional("The value of 1 pu, instead of scale: model = recorded / base + offset.",
        'columns = {P2 = {unit = "MW", base = 1000}}', "that of the column")
    offset: FiniteFloat | None = optional("What is added after scaling.", "columns = {T = {scale = 0.1, offset = -20}}", "the model's")
    turn: FiniteFloat | None = optional(
        "Of an angle: the frequency with which it turns before the event. That course is taken out, for the frame of the model turns with "
        "it, which its frequency says.", "columns = {theta = {turn = 0.012}}", "Hz")

    @model_validator(mode="after")
    def _one_factor(self) -> ColumnTable:
        if self.scale is not None and self.base is not None:
            raise ValueError("give either scale (model = scale x recorded) or base (model = recorded / base)")
        return self


class PhasesTable(TomlTable):
    """One line of an experiment's `phases`: quantities made of three recorded phases; they are named like recorded ones."""

    voltage: Three = key("The columns of the three phase-to-ground voltages.", 'voltage = ["VA", "VB", "VC"]')
    current: Three | None = optional("The columns of the three phase currents, for powers and currents.", 'current = ["IA", "IB", "IC"]')
    frequency: Positive = key("Nominal frequency.", "frequency = 50", "Hz")
    filter: Literal["mean", "lowpass", "none"] = optional("Filter of the computed quantities: trailing mean, first-order low pass or none.",
        'filter = "lowpass"', default="mean")
    window: NotNegative | None = optional("Length of the mean, or time constant of the low pass. If left out, one cycle.",
        "window = 0.02", "s")
    gives: Annotated[dict[Name, Name], Field(min_length=1)] = key(
        "Names of the new columns and their quantities: p, q, v, v-rms, i, i-rms, vd, vq, id, iq, f, v2, i2.", 'gives = {P_MW = "p"}')


class PhasorTable(TomlTable):
    """Magnitude and angle of a quantity."""

    magnitude: OneOrThree = key(
        "The column of the magnitude, or three columns in the order of rotation, of which the positive sequence is taken.",
        'magnitude = ["VA mag", "VB mag", "VC mag"]')
    angle: OneOrThree = key("The column of the angle, or three.", 'angle = "V1 ang"')
    unit: Literal["deg", "rad"] | None = optional("Unit of the angles. If left out, as in the file's header.", 'unit = "deg"')

    @model_validator(mode="after")
    def _as_many(self) -> PhasorTable:
        if len(self.magnitude) != len(self.angle):
            raise ValueError("angle: as many columns as magnitude are needed")
        return self


class PhasorsTable(TomlTable):
    """One line of an experiment's `phasors`: quantities made of recorded magnitudes and angles, named like recorded ones."""

    voltage: PhasorTable = key("The columns of the voltage phasor.", 'voltage = {magnitude = "V1 mag", angle = "V1 ang"}')
    current: PhasorTable | None = optional("The columns of the current phasor, for powers and currents.",
        'current = {magnitude = "I1 mag", angle = "I1 ang"}')
    frequency: Positive | None = optional("Nominal frequency, needed for f.", "frequency = 50", "Hz")
    window: Positive = optional("Time over which the frequency is the mean slope of the angle.", "window = 0.1", "s", default=0.1)
    magnitudes: Literal["phase-rms", "line-rms", "phase-peak", "pu"] | None = optional("Convention of the magnitudes, needed for powers.",
        'magnitudes = "line-rms"')
    reference: Name | None = optional('Zero of the angles: "start" for the first angle, or a column of angles. If left out, as recorded.',
        'reference = "start"')
    gives: Annotated[dict[Name, Name], Field(min_length=1)] = key(
        "Names of the new columns and their quantities: v, angle, real, imag, f, i, i-angle, i-real, i-imag, id, iq, p, q.",
        'gives = {delta = "angle", F = "f"}')


class InstrumentTable(TomlTable):
    """One line of an experiment's `instrument`: the recording chain of an output."""

    window_mean: NotNegative | None = optional("Length of the mean that a measuring device takes.",
        "instrument = {P2 = {window-mean = 0.02}}", "s", alias="window-mean")
    delay: NotNegative | None = optional("Delay of the recording.", "instrument = {P2 = {delay = 0.001}}", "s")
    accuracy_class: Positive | None = optional("Accuracy class of the transducer.", "instrument = {P2 = {class = 0.5}}", "%", alias="class")


class NoiseTable(TomlTable):
    """One line of an experiment's `noise`, where every row has a standard deviation of its own, in the output's unit."""

    column: Name = key("The column with the standard deviation of each row, in the unit of the output's column.",
        'noise = {P = {column = "sd_P"}}')


Noise = Annotated[float | NoiseTable, BeforeValidator(_known_noise)]
Interpolations = Annotated[Interpolation | dict[Name, Interpolation],
    BeforeValidator(_known_interpolation, json_schema_input_type=Interpolation | Annotated[dict[Name, Interpolation], ByName()])]


class ExperimentTable(TomlTable):
    """[[experiment]]: one recording and what to make of it."""

    name: FileName = key("Name of the experiment in results and file names.", 'name = "step-up"')
    data: Name = key("The recording, in any format that `hvdc-ident formats` lists, relative to the study.", 'data = "step-up.csv"')
    role: Role = optional('"fit" to estimate from it; "holdout" to validate the estimates with it.',
        'role = "holdout"', default="fit")
    inputs: Columns = optional(
        "The model's inputs that the recording holds: a list of names, or a table from names to columns. Other inputs keep their values.",
        'inputs = ["Vdcref1", "Pref2"]', default={}, of="input")
    outputs: Columns = key("The model's outputs that are compared: a list of names, or a table from names to columns.",
        'outputs = {Irorder1 = "I:REG:1"}', of="output")
    noise: Annotated[dict[Name, Noise], ByName(own=("column",))] = optional(
        "Standard deviation of the noise of an output, or the column that holds one for each row. If left out, estimated before the event.",
        "noise = {Irorder1 = 1e-4}", "the model's", default={}, of="measured output")
    event: FiniteFloat | None = optional("Instant at which an input first moves. If left out, found from the inputs.", "event = 0.1", "s")
    window: Range | None = optional(
        "First and last instant that are compared. If left out, the whole recording.", "window = [0.0, 0.8]", "s")
    leave_out: Annotated[dict[Name, list[Span]], ByName()] | None = optional(
        "By signal: spans of time whose rows are no measurement. Those of an output are not compared; over those of an input it follows "
        "the line between the rows beside them, and no output is compared there. If left out, the rows that cannot be right, which `check` "
        "names. {} leaves out none.", "leave_out = {P = [[1.65, 1.72]]}", "s", of="signal of the experiment")
    values: Numbers = optional("Inputs that are constant in this experiment at other than the model's values.",
        "values = {Pref2 = 0.5}", "the model's", default={}, of="input")
    trim: Columns = optional(
        "Inputs that stand at the level of a recorded output before the event: the references of a plant that is played back are "
        "found from them.",
        'trim = {P0 = "P", Q0 = "Q"}', default={}, of="input")
    columns: Annotated[dict[Name, ColumnTable], ByName(tables=True)] = optional(
        "By signal of the model: its column in the file and the conversion to the model's unit.",
        'columns = {Irorder1 = {name = "I:REG:1", unit = "kA", scale = 5.54}}', default={}, of="signal of the experiment")
    nuisance: list[Name] = optional(
        "Unknowns of this recording that are estimated beside the parameters: \"time-shift\" is a clock offset, an input's name the "
        "offset of that input, a state's name its start value.",
        'nuisance = ["time-shift", "Pref2"]', default=[], of="nuisance")
    drive: Columns = optional("Play-in: signals that follow their recorded columns instead of their equations.",
        'drive = {Vac1 = "V1"}', default={}, of="insertion point")
    instrument: Annotated[dict[Name, InstrumentTable], ByName(tables=True)] = optional(
        "By output: the recording chain, applied to the simulated output.",
        "instrument = {P2 = {window-mean = 0.02, delay = 0.001}}", default={}, of="measured output")
    phases: list[PhasesTable] = optional("Quantities that are computed from recorded phases: one table for each set.",
        "[[experiment.phases]]", default=[])
    phasors: list[PhasorsTable] = optional("Quantities that are computed from recorded magnitudes and angles: one table for each set.",
        "[[experiment.phasors]]", default=[])
    interpolation: Interpolations | None = optional(
        'Between rows: "hold" keeps a value until the next row, "linear" joins the rows by lines; one for all inputs or a table by '
        'input. If left out, "hold" where at least 90 % of successive rows are equal.',
        'interpolation = "linear"')

    @model_validator(mode="after")
    def _recorded(self) -> ExperimentTable:
        if not self.outputs:
            raise ValueError("outputs: at least one recorded output is needed")
        return self


class TrimTable(TomlTable):
    """[linearize] trim: the values that outputs are to have at the operating point, and the inputs that are set for it."""

    outputs: Annotated[dict[Name, FiniteFloat], Field(min_length=1), ByName()] = key(
        "Values that outputs are to have at the operating point.",
        "trim = {outputs = {P2 = 0.6}}", "the model's", of="output")
    inputs: Numbers = optional("Values of other inputs at the operating point.",
        "trim = {outputs = {P2 = 0.6}, inputs = {Qref1 = 0.1}}", "the model's", default={}, of="input")
    free: Names | None = optional("Inputs or parameters that are adjusted. If left out, the inputs that affect the outputs.",
        'trim = {outputs = {P2 = 0.6}, free = ["Pref2"]}', of="input or parameter")


class ReduceTable(TomlTable):
    """[linearize] reduce: a model of fewer states, so many or as few as keep the error within a tolerance."""

    order: Annotated[int, Field(ge=0)] | None = optional("Number of states that stay.", "reduce = {order = 2}")
    tolerance: Positive | None = optional("Instead of order: largest error of the gain.",
        "reduce = {tolerance = 0.01}", "the outputs' per the inputs'")
    match_dc: bool = optional("True keeps the dc gain.", "reduce = {order = 2, match_dc = true}", default=False)

    @model_validator(mode="after")
    def _one_way(self) -> ReduceTable:
        if (self.order is None) == (self.tolerance is None):
            raise ValueError("give either order (states that stay) or tolerance (largest error of the gain)")
        return self


class PlantTable(TomlTable):
    """[linearize] plant: the signals that go into the plant and those the controller measures on it."""

    inputs: NameOrNames = key("The signals that enter the plant.", 'plant = {inputs = "Irorder1", outputs = "Vdc1_m"}', of="signal")
    outputs: NameOrNames = key("The signals of the plant that the controller measures.",
        'plant = {inputs = "Irorder1", outputs = "Vdc1_m"}', of="signal")


class PortTable(TomlTable):
    """[[linearize.port]]: where an impedance is seen, d and q or one dc signal each; band: Hz."""

    name: FileName = key("Name of the port in results and file names.", 'name = "dc-1"')
    source: Axes = key("The signal that is perturbed; two for d and q.", 'source = "Iload1"', of="insertion point")
    voltage: Axes = key("Expression of the voltage; two for d and q.", 'voltage = "Vdc1"')
    current: Axes = key("Expression of the current towards the part whose impedance is wanted; two for d and q.", 'current = "-Iload1"')
    angle: Name = optional("Expression of the angle of the model's frame ahead of the network's.", 'angle = "theta1"', "rad", default="0")
    band: Annotated[list[Positive], Field(min_length=2, max_length=2), AfterValidator(_rising)] = optional("Lowest and highest frequency.",
        "band = [0.1, 500]", "Hz", default=[0.1, 1000.0])
    points: Annotated[int, Field(ge=2, le=100_000)] = optional("Number of frequencies, spaced logarithmically.",
        "points = 200", default=200)

    @model_validator(mode="after")
    def _as_many(self) -> PortTable:
        if not len(self.source) == len(self.voltage) == len(self.current):
            raise ValueError("source, voltage and current need as many signals each: two (d, q), or one (dc)")
        if len(self.source) == 1 and self.angle != "0":
            raise ValueError("angle: a dc port has none")
        return self


class LocusTable(TomlTable):
    """[linearize] locus: the eigenvalues along values of one parameter or input, each at its own operating point."""

    parameter: Name = key("The parameter or input that is varied.", 'locus = {parameter = "KPVDC", min = 1, max = 100}',
        of="input or parameter")
    min: FiniteFloat = key("Lowest value.", 'locus = {parameter = "KPVDC", min = 1, max = 100}', "the parameter's")
    max: FiniteFloat = key("Highest value.", 'locus = {parameter = "KPVDC", min = 1, max = 100}', "the parameter's")
    points: Annotated[int, Field(ge=2, le=100_000)] = optional("Number of values.",
        'locus = {parameter = "KPVDC", min = 1, max = 100, points = 40}', default=60)
    scale: Spacing = optional("Spacing of the values.",
        'locus = {parameter = "KPVDC", min = 1, max = 100, scale = "log"}', default="linear")

    @model_validator(mode="after")
    def _ordered(self) -> LocusTable:
        _check_spread(self.min, self.max, self.scale)
        return self


class LinearizeTable(TomlTable):
    """[linearize]: between which inputs and outputs, where, and what is wanted of the linear model."""

    inputs: Names | None = optional("Inputs of the linear model. If left out, all.", 'inputs = ["Vdcref1"]', of="input")
    outputs: Names | None = optional("Outputs of the linear model. If left out, all.", 'outputs = ["Irorder1"]', of="output")
    at: Literal["steady", "start"] = optional("Where: the steady state, or the start values of the states as they stand.",
        'at = "start"', default="steady")
    side: Literal["refuse", "below", "above"] = optional(
        "Of a limit that the operating point lies on: the derivative below or above it. Such a point is refused unless one is named.",
        'side = "below"', default="refuse")
    trim: TrimTable | None = optional("The operating point by values of outputs.", "trim = {outputs = {P2 = 0.6}}")
    break_at: NameOrNames | None = optional("Signals at which loops are opened for their margins.", 'break_at = ["Irorder1"]', of="signal")
    plant: PlantTable | None = optional("The signals between plant and controller, for the coprime factor margin.",
        'plant = {inputs = "Irorder1", outputs = "Vdc1_m"}')
    reduce: ReduceTable | None = optional("A model of lower order by balanced truncation.", "reduce = {order = 2}")
    compare: Name | None = optional("Another model, shipped or a path, to which the nu-gap is computed.", 'compare = "vsc-hvdc-avm"')
    scale: Sizes = optional("By input or output: the size that counts as 1 in norms, gaps and the reduction.",
        "scale = {Vdcref1 = 0.02}", "the signal's", default={}, of="input or output of [linearize]")
    formula: Names | None = optional("Parameters that stay symbols in the transfer functions.", 'formula = ["KPVDC", "KIVDC"]',
        of="parameter")
    locus: LocusTable | None = optional("Eigenvalues along values of a parameter or input.",
        'locus = {parameter = "KPVDC", min = 1, max = 100}')
    port: list[PortTable] = optional("Where impedances are seen: one table for each.", "[[linearize.port]]", default=[])


class ResponseTable(TomlTable):
    """[[response]]: a measured frequency response, from an input to an output, or at a port of [[linearize.port]]."""

    name: FileName = key("Name of the response in results and file names.", 'name = "dc-scan"')
    data: Name = key("The measured response: a text table, a Touchstone file, or a recording in time.", 'data = "scan.csv"')
    role: Role = optional('"fit" to estimate from it; "holdout" to validate the estimates with it.',
        'role = "holdout"', default="fit")
    input: Name | None = optional("The input of the model that was perturbed.", 'input = "Vdcref1"', of="input")
    output: Name | None = optional("The output of the model that responded.", 'output = "Vdc1"', of="output or signal")
    port: Name | None = optional("Instead of input and output: the port of [[linearize.port]] at which it was measured.", 'port = "dc-1"',
        of="port of [[linearize.port]]")
    kind: Literal["impedance", "admittance"] = optional("Whether a port's response is its impedance or its admittance.",
        'kind = "admittance"', default="impedance")
    columns: dict[Name, Name] = optional("By channel (dd, dq, qd, qq at a port of two axes): its column in the file.",
        'columns = {dd = "Zdd"}', default={})
    signals: dict[Literal["input", "output"], Name] = optional(
        "Where the data are a recording in time: the columns of its input and output.", 'signals = {input = "u", output = "y"}', default={})
    frequencies: Annotated[list[Positive], Field(min_length=1)] | None = optional(
        "Perturbed frequencies of a recording in time. If left out, Welch's estimate at all frequencies.",
        "frequencies = [1, 2, 5, 10]", "Hz")
    scale: FiniteFloat = optional("Factor: model = scale x measured.", "scale = 0.001", default=1.0)
    unit: Unit = optional("Unit of the response after scaling.", 'unit = "pu"', default="")
    noise: Positive | None = optional(
        "Standard deviation of the modulus of the error. If both are left out, from repeated sweeps, else from the misfit.",
        "noise = 0.002", "the model's")
    relative_noise: Positive | None = optional("The same as a share of the modulus.", "relative_noise = 0.01")
    band: Band | None = optional("Lowest and highest frequency that are compared.", "band = [0.5, 200]", "Hz")
    values: Numbers = optional("Values of inputs at the operating point of the measurement.",
        "values = {Pref2 = 0.5}", "the model's", default={}, of="input")
    trim: TrimTable | None = optional("The operating point of the measurement by values of outputs.", "trim = {outputs = {P2 = 0.6}}")

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
    """[[sweep]]: the values of one parameter, listed or spread over a range."""

    parameter: Name = key("The parameter that is varied. Bounds in [parameters] do not limit it.", 'parameter = "KIVDC"', of="parameter")
    min: FiniteFloat | None = optional("Lowest value.", "min = 250", "the parameter's")
    max: FiniteFloat | None = optional("Highest value.", "max = 1500", "the parameter's")
    points: Annotated[int, Field(ge=2, le=1_000_000)] | None = optional("Number of values.", "points = 51")
    scale: Spacing = optional("Spacing of the values.", 'scale = "log"', default="linear")
    sampling: Literal["grid", "latin-hypercube"] = optional("With several tables: all combinations, or a Latin hypercube of `points` runs.",
        'sampling = "latin-hypercube"', default="grid")
    against: Name | None = optional(
        "What the runs are compared with: \"data\" (the recordings), \"base\" (the model's own run), or another model, shipped or a "
        "path. If left out, the recordings.",
        'against = "base"')
    want: Annotated[list[Literal["rmse", "poles", "bode"]], Field(min_length=1)] = optional("What is computed at each point.",
        'want = ["rmse", "poles"]', default=["rmse"])
    values: Annotated[list[FiniteFloat], Field(min_length=1)] | None = optional("Instead of min, max and points: the values.",
        "values = [500, 700, 900]", "the parameter's")

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
    """[screening]: which parameters matter over their whole ranges, by Morris' elementary effects or Sobol's indices."""

    method: Literal["morris", "sobol"] = optional("Elementary effects of Morris, or indices of Sobol.",
        'method = "sobol"', default="morris")
    parameters: Names | None = optional("Parameters that are screened over their bounds. If left out, all in [parameters].",
        'parameters = ["KPVDC", "KIVDC"]', of="candidate")
    trajectories: Annotated[int, Field(ge=2, le=100_000)] = optional("Number of trajectories of Morris.", "trajectories = 20", default=20)
    samples: Annotated[int, Field(ge=2, le=1_048_576)] = optional("Number of base samples of Sobol, a power of 2.",
        "samples = 256", default=256)
    against: Literal["data", "base"] = optional("What the runs are compared with: the recordings, or the model's own run.",
        'against = "base"', default="data")


class IdentifiabilityTable(TomlTable):
    """[identifiability]: asks for the stage. pair: two candidates whose common profile is wanted, on a grid."""

    pair: Two | None = optional(
        "Two parameters whose joint profile likelihood is computed on a grid.", 'pair = ["KPVDC", "KIVDC"]', of="candidate")


class GroupTable(TomlTable):
    """One group of [fit] groups: these parameters against these outputs of these experiments (all where left out)."""

    parameters: Names = key("Parameters that this group estimates.", 'parameters = ["KPVDC", "KIVDC"]', of="candidate")
    outputs: Names | None = optional("Outputs that it compares. If left out, all.", 'outputs = ["Irorder1"]', of="measured output")
    experiments: Names | None = optional("Experiments that it uses. If left out, all.", 'experiments = ["step-up"]', of="experiment")


Whitening = Annotated[Literal["no", "pre-event", "residual"],
    BeforeValidator(_whitening, json_schema_input_type=Literal["no", "pre-event", "residual", True, False])]


class FitTable(TomlTable):
    """[fit]: how the candidates are estimated."""

    mode: Literal["simultaneous", "individual"] = optional("All parameters together, or one group after another.",
        'mode = "individual"', default="simultaneous")
    groups: list[GroupTable] = optional('The groups of mode "individual": one controller each.', "[[fit.groups]]", default=[])
    optimiser: Name = optional("Name of the method by which each search goes down.", 'optimiser = "least-squares"', default="trust-region",
        of="optimiser")
    loss: Name = optional("Weight of large residuals: linear (least squares), or a robust loss such as huber.",
        'loss = "huber"', default="linear", of="loss")
    starts: Annotated[int, Field(ge=1, le=10_000)] | None = optional(
        "Runs of the optimiser from different starts. If left out, 8; more follow, up to 64, where one start alone reached the "
        "lowest cost, and as long as the lowest leaves more than noise and others may still end elsewhere.",
        "starts = 4")
    whiten: Whitening = optional(
        "Model of correlated noise: none, from the rows before the event, or from the residuals of a first fit. true is "
        '"pre-event", false is "no".',
        'whiten = "residual"', default="no")
    guard: NotNegative = optional("Time on either side of a jump of an input that is not compared.", "guard = 0.002", "s", default=0.0)
    residual: Literal["time", "frequency"] = optional("Compare in time or in frequency.", 'residual = "frequency"', default="time")
    band: Band | None = optional('Lowest and highest frequency of residual "frequency". If left out, all.', "band = [0.5, 50]", "Hz")
    tolerance: Name = optional("Profile of the limits of model validation: a shipped one, or a TOML file beside the study.",
        'tolerance = "set-point-step-simulation"', default="set-point-step-simulation")

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
    """[diagnose]: which effects to try and where, and what is of no interest."""

    effects: Annotated[Literal["all"] | list[Name], BeforeValidator(_effect_names)] = optional(
        'The effects that are tried: "all", or a list of names of the catalogue.', 'effects = ["lag", "delay", "limit"]', default="all",
        of="effect")
    places: Names | None = optional("The insertion points that are tried, by name or pattern. If left out, all.",
        'places = ["avr.*", "gov.*"]')
    tolerance: Sizes = optional(
        "By output: the error below which a gap is of no interest. If left out, a tenth of the noise or a hundredth of the range, "
        "whichever is larger.",
        "tolerance = {Vm = 0.002}", "the output's", default={}, of="measured output")
    material: Sizes = optional("Earlier name of `tolerance`.", "material = {P2 = 0.005}", "the output's", default={}, of="measured output")
    most: Annotated[int, Field(ge=1)] = optional("Largest number of effects that are sought beside each other.", "most = 1", default=3)
    thorough: bool = optional("True refits also the effects that promise little, if no other comes near the noise.",
        "thorough = true", default=False)
    budget: Positive | None = optional(
        "Time after which nothing further is sought. If left out, 60 s of the processor; with `thorough` no limit.",
        "budget = 60",
        "s",
    )

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
    """[letter]: who writes to whom about what, for `hvdc-ident letter`; no result rests on it."""

    author: Line = optional("Author of the letter, with the organisation.", 'author = "A. Engineer, System Studies, TSO"', default="")
    to: Line = optional("Addressee: the owner of the model.", 'to = "Converter Works, Modelling"', default="")
    plant: Line = optional("The plant that was recorded.", 'plant = "Link North, station 1"', default="")
    version: Line = optional("Version of the model.", 'version = "3.2"', default="")
    date: Annotated[Line, BeforeValidator(_date_text, json_schema_input_type=str)] = optional(
        "Date of the letter. If left out, today.", 'date = "2026-11-25"', default="")


class StudyFile(TomlTable):
    """The whole study file."""

    version: Literal[1] = key("Version of this format.", "schema = 1", alias="schema")
    name: Name | None = optional("Name of the study in the report and the results. If left out, the name of the file.",
        'name = "vdc-steps"')
    model: ModelTable = key("The model and what differs from it.", 'model = {source = "vsc-hvdc-link"}')
    parameters: Annotated[dict[Name, ParameterTable], ByName(own=("prior",), tables=True)] = optional(
        "The parameters that may be estimated, by name. All others keep the model's values.", "[parameters]", default={})
    inputs: InputsTable | None = optional("What a person can do with the model's inputs.", "[inputs]")
    experiment: list[ExperimentTable] = optional("The recordings: one table for each.", "[[experiment]]", default=[])
    response: list[ResponseTable] = optional("Measured frequency responses: one table for each.", "[[response]]", default=[])
    linearize: LinearizeTable | None = optional("The linear model at an operating point.", "[linearize]")
    sweep: list[SweepTable] = optional("Runs over values of a parameter. Several tables give all combinations.", "[[sweep]]", default=[])
    screening: ScreeningTable | None = optional("Which parameters affect the error at all, over their whole ranges.", "[screening]")
    identifiability: IdentifiabilityTable | None = optional("Asks `run` for the identifiability analysis. `fit` performs it in any case.",
        "[identifiability]")
    fit: FitTable | None = optional("How the parameters are estimated.", "[fit]")
    diagnose: DiagnoseTable | None = optional("How the effects that the model lacks are searched for.", "[diagnose]")
    letter: LetterTable | None = optional("Author, addressee and plant of the letter. No result depends on it.", "[letter]")


TABLES: dict[str, type[TomlTable]] = {"identifiability": IdentifiabilityTable, "fit": FitTable, "diagnose": DiagnoseTable}
"""Tables of stages whose keys a call in Python may give."""
