"""The model card, table by table: types, and what each key means. Expressions, names and bounds are the model's to check.

A key may stand on a line longer than the formatter's: the tables are read like the reference that is made of them.
"""

# fmt: off
from __future__ import annotations

from typing import Annotated, Any, ClassVar, Literal

from pydantic import BeforeValidator, Field

from hvdc_ident.toml_tables import Name, TomlTable, key, optional, wrong


def _text_or_number(value: Any) -> Any:
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise wrong("a number or text")
    _number(value)
    return value


def _number(value: Any) -> Any:
    """The value, a whole number as one with a point: a double holds it."""
    try:
        return value if isinstance(value, bool) or not isinstance(value, int) else float(value)
    except OverflowError:
        raise wrong("a number that a double holds", "a value that is too large") from None


def _entry(value: Any) -> Any:
    """A text or number as the table that it stands for."""
    if isinstance(value, dict):
        return value
    if isinstance(value, bool) or not isinstance(value, str | int | float):
        raise wrong("an expression, as text or number, or a table: {value = ...}")
    return {"value": value}


def _several(value: Any) -> Any:
    """One expression as the list that it stands for."""
    return value if isinstance(value, list) else [value]


def _pattern(value: Any) -> Any:
    """One pattern of names as the table that it stands for."""
    return {"*": value} if isinstance(value, str) else value


Expression = Annotated[Any, BeforeValidator(_text_or_number, json_schema_input_type=str | float)]
Number = Annotated[float, BeforeValidator(_number, json_schema_input_type=float)]


class ParameterEntry(TomlTable):
    """One line of [parameters], here or in a parameterisation."""

    value: Number = key("The model's own value.", 'J = {value = 0.01, unit = "kg.m2"}', "that of `unit`")
    unit: str = optional("Unit, as text.", 'J = {value = 0.01, unit = "kg.m2"}', default="")
    min: Number | None = optional("Lower bound that the physics sets.", "J = {value = 0.01, min = 0.001, max = 0.1}", "that of `unit`")
    max: Number | None = optional("Upper bound that the physics sets.", "J = {value = 0.01, min = 0.001, max = 0.1}", "that of `unit`")
    scale: Number = optional("A typical size, by which parameters are compared. 0: the value's modulus, or 1 where that is 0.",
        "bias = {value = 0.0, scale = 0.1}", "that of `unit`", default=0.0)
    usual: Annotated[list[Number], Field(min_length=2, max_length=2)] | None = optional(
        "Lowest and highest of the values that plants have.", "R = {value = 0.05, usual = [0.02, 0.08]}", "that of `unit`")
    description: str = optional("What the parameter is.", 'b = {value = 0.1, description = "viscous friction"}', default="")


class InputEntry(TomlTable):
    """One line of [inputs]."""

    value: Number = optional("Value where an experiment does not set the input.", 'v = {value = 0.0, unit = "V"}', "that of `unit`",
        default=0.0)
    unit: str = optional("Unit, as text.", 'v = {value = 0.0, unit = "V"}', default="")
    description: str = optional("What the input is.", 'v = {value = 0.0, description = "armature voltage"}', default="")
    settable: bool = optional(
        "False for an input that no person can move for an experiment, such as the voltage of a grid: no recording that moves it is "
        "advised.",
        'E = {value = 1.0, unit = "pu", settable = false}', default=True)


class StateEntry(TomlTable):
    """One line of [states]."""

    ELSEWHERE: ClassVar = {"der": 'derivative = "..."', "init": "start = ..."}

    derivative: Expression = key("Expression of the time derivative.", 'w = {derivative = "(torque - b*w) / J"}')
    start: Expression = optional(
        'Value at the start: a number, an expression of parameters, or "free" (unknown, estimated). If left out, the steady state of '
        "the inputs at the first row.",
        'w = {derivative = "-w", start = 1.0}', "that of `unit`")
    guess: Number | None = optional("Where the search for the steady state begins.",
        'Vdc = {derivative = "(P/Vdc - Idc) / C", guess = 1.0}', "that of `unit`")
    rest: Expression = optional("Expression of the steady state where the derivative leaves it open or hides it.",
        'y = {derivative = "(u - past) / T", rest = "u"}')
    vanishes: Expression = optional(
        "Expression of parameters, a time constant. Where it is 0 the state is a signal that equals its rest.",
        'y = {derivative = "(u - y) / T", rest = "u", vanishes = "T"}', "s")
    unit: str = optional("Unit, as text.", 'w = {derivative = "-w", unit = "rad/s"}', default="")
    description: str = optional("What the state is.", 'w = {derivative = "-w", description = "speed"}', default="")


class SignalEntry(TomlTable):
    """One line of [signals]."""

    value: Expression = key("Expression of the signal.", 'i = "(v - k*w) / R"')
    unit: str = optional("Unit, as text.", 'i = {value = "(v - k*w) / R", unit = "A"}', default="")
    description: str = optional("What the signal is.", 'i = {value = "(v - k*w) / R", description = "armature current"}', default="")


class AlgebraicEntry(TomlTable):
    """One line of [algebraic]."""

    equation: Expression = key("Expression that the unknown equals. It may lead back to the unknown.",
        'I = {equation = "P / (V0 - R*I)", start = 1.0}')
    start: Number = optional("Where the solution of the equations begins.", 'I = {equation = "P / (V0 - R*I)", start = 1.0}',
        "that of `unit`", default=0.0)
    unit: str = optional("Unit, as text.", 'I = {equation = "P / (V0 - R*I)", unit = "A"}', default="")
    description: str = optional("What the unknown is.", 'I = {equation = "P / (V0 - R*I)", description = "line current"}', default="")


class OutputEntry(TomlTable):
    """One line of [outputs]."""

    value: Expression = key("Expression of the output.", 'w = "w"')
    unit: str = optional("Unit, as text.", 'w = {value = "w", unit = "rad/s"}', default="")
    description: str = optional("What the output is.", 'w = {value = "w", description = "measured speed"}', default="")


class DelayEntry(TomlTable):
    """One line of [delays]."""

    of: Expression = key("Expression that is delayed.", 'i_late = {of = "i", time = "T"}')
    time: Expression = key("Expression of the delay, of parameters only, 0 or more: at 0 the delayed signal is the signal itself.",
        'i_late = {of = "i", time = "T"}', "s")


class SampledEntry(TomlTable):
    """One line of [sampled]."""

    value: Expression = key("Expression that is sampled.", 'u_held = {value = "u", period = "Ts"}')
    period: Expression = key("Expression of the sampling period, of parameters only.", 'u_held = {value = "u", period = "Ts"}', "s")
    compute: Expression = optional("Expression of the time from a sample to its effect.",
        'u_held = {value = "u", period = "Ts", compute = "Ts/2"}', "s", default=0)


class ParameterisationEntry(TomlTable):
    """[parameterisations.NAME]: other parameters for some of the model's."""

    parameters: dict[str, ParameterEntry] = key("The new parameters, by name, with the keys of [parameters].",
        "[parameterisations.physical.parameters]")
    replaces: dict[str, Expression] = key("By replaced parameter: its expression in the new ones.",
        "[parameterisations.physical.replaces]")
    description: str = optional("What this set of parameters is.", 'description = "inertia and settling time"', default="")


class ComponentEntry(TomlTable):
    """[components.NAME]: a model that this one is made of."""

    source: Name = key("A component of the shelf, or the path of a model card.", 'source = "genrou"')
    parameters: dict[str, Expression] = optional(
        "Values of the component's parameters that differ from its card's: numbers, or expressions of this model's names. A name "
        'alone, as in R = "Rg", makes it that parameter of this model: components share it.',
        'parameters = {H = 4.2, Xd = "Xbase*1.8"}', "the component's", default={})
    names: Annotated[dict[str, str], BeforeValidator(_pattern, json_schema_input_type=str | dict[str, str])] = optional(
        "What the component's variables are called in this model: a pattern in which * stands for the name, or a table of names and "
        "patterns, the longest that fits first. If left out, H of the component gen is gen.H. An input that gets the name of a variable "
        "of this model or of another component is that variable and is not connected; any other name that is taken is an error.",
        'names = {"*" = "*1", "*_m" = "*1_m", V = "Vbus"}', default={})


class ConnectionEntry(TomlTable):
    """One line of [connections]."""

    value: Expression = key("Expression that the input follows.", '"avr.Vt" = {value = "bus.V"}')
    start: Number | None = optional("Where the search for the input begins, where it is an unknown of a circle of signals.",
        '"bus.I" = {value = "gen.I", start = 1.0}', "that of the input")


Several = Annotated[list[Expression], BeforeValidator(_several, json_schema_input_type=str | float | list[str | float])]


class ExchangeEntry(TomlTable):
    """[exchange]: how a card of the shelf stands in for another one of its class: what its parameters mean, as quantities that cards of
    any class share by name, and what a fit frees."""

    klass: str = optional("Class of the card: the cards of one class stand in for each other. Empty: its parameters alone have a meaning.",
        'class = "governor"', default="", alias="class")
    free: dict[str, Annotated[list[Number], Field(min_length=2, max_length=2)]] = optional(
        "Parameters that a fit frees where the card stands in, with their usual range. A time constant's begins above 0, where its block "
        "would be gone.", "free = {K = [5.0, 50.0]}", "that of the parameter", default={})
    ranges: str = optional("Where the ranges are from.", 'ranges = "IEEE PES-TR1, 2013"', default="")
    means: dict[str, str] = optional("By parameter: the quantity that it is.", 'means = {T3 = "servo"}', default={})
    says: dict[str, Expression] = optional(
        "By quantity: what it is, as an expression of the parameters. One that is no finite number, as 1/K where K is 0, is not said.",
        'says = {droop = "1/K"}', default={})
    takes: dict[str, Several] = optional(
        "By parameter: what it is, as an expression of quantities and of parameters before it; of several the first whose quantities are "
        "said.", 'takes = {K = "1/droop"}', default={})


Signals = dict[str, Annotated[SignalEntry, BeforeValidator(_entry, json_schema_input_type=str | float | SignalEntry)]]
Outputs = dict[str, Annotated[OutputEntry, BeforeValidator(_entry, json_schema_input_type=str | float | OutputEntry)]]
Connections = dict[str, Annotated[ConnectionEntry, BeforeValidator(_entry, json_schema_input_type=str | float | ConnectionEntry)]]


class CardFile(TomlTable):
    """The whole model card."""

    version: Literal[1] = key("Version of this format.", "schema = 1", alias="schema")
    name: str = key("Name of the model.", 'name = "dc-motor"')
    description: str = optional("What the model describes.", 'description = "a dc motor with viscous friction"', default="")
    record: list[str] = optional(
        'Parameters in the order of the values of the .dyr record of this model; "-" for a value that no parameter has.',
        'record = ["K", "T"]', default=[])
    also: list[str] = optional("Other models of .dyr files that this card stands for: their records and equations are the same.",
        'also = ["EXDC2"]', default=[])
    power_flow: dict[str, Literal["ZR", "ZX", "QG"]] = optional(
        "Parameters that PSS/E's power flow (.raw) states, by the name of the field there. Where the record has the parameter too, the "
        "record counts and the two are compared.", 'power_flow = {Xpd = "ZX", Ra = "ZR"}', default={})
    asked: list[str] = optional(
        "Parameters of the record that a study of a unit asks about, the first that is not 0 and that no flag switches off: inertia, "
        "gain, droop.", 'asked = ["KPR", "KIR"]', default=[])
    exchange: ExchangeEntry | None = optional("How the card stands in for another one of its class, and what its parameters mean.",
        "[exchange]", default=None)
    parameters: dict[str, ParameterEntry] = optional("Constants that may be estimated, by name.", "[parameters]", default={})
    inputs: dict[str, InputEntry] = optional("Signals that enter the model from outside, by name.", "[inputs]", default={})
    states: dict[str, StateEntry] = optional("Differential equations, by state.", "[states]", default={})
    signals: Signals = optional(
        "Named intermediate signals: the places where an effect can be inserted. Their order is free. A text is the expression.",
        "[signals]", default={})
    algebraic: dict[str, AlgebraicEntry] = optional(
        "Unknowns of algebraic equations: each equals an expression that may lead back to it.", "[algebraic]", default={})
    outputs: Outputs = optional("What is compared with recordings, by name. A text is the expression.", "[outputs]", default={})
    delays: dict[str, DelayEntry] = optional("Delayed signals, by the name of the delayed one.", "[delays]", default={})
    sampled: dict[str, SampledEntry] = optional("Values that are sampled and held, by name.", "[sampled]", default={})
    parameterisations: dict[str, ParameterisationEntry] = optional("Other sets of parameters of the same model, by name.",
        "[parameterisations.physical]", default={})
    components: dict[str, ComponentEntry] = optional(
        "Models that this one is made of, by name. H of the component gen is gen.H, or what its `names` say.", "[components.gen]",
        default={})
    connections: Connections = optional("What each input of the components follows. A text is the expression.", "[connections]",
        default={})
