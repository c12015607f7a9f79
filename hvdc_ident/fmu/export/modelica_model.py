"""Any sympy model as Modelica text: flat, without libraries, with its steady start as initial equations."""

from __future__ import annotations

import itertools
import re
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import sympy as sp
from sympy.logic.boolalg import And, Not, Or

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression import clip, elementary, symbol
from hvdc_ident.files import write_text
from hvdc_ident.fmu.export.c_model import CModel
from hvdc_ident.fmu.export.model_description import SI
from hvdc_ident.model import Model


def save_modelica(model: Model, path: str | Path) -> Path:
    """Write a model's Modelica text; return the path. The Modelica model has the file's name."""
    path = Path(path)
    return write_text(path, modelica(model, path.stem))


def modelica(model: Model, name: str = "", steady: bool | None = None) -> str:
    """Return the Modelica text of a model, each signal under its own name.

    name: of the Modelica model (default: the model's own, as an identifier). steady: True writes the steady start as
    initial equations, so that parameters and inputs move it; False writes its numbers, which every tool can start
    from; None is True but for a model with sampled values, for tools seldom solve for discrete values. Raises
    ExpressionError for an expression that Modelica cannot state.
    """
    numbers = bool(model.sampled) if steady is None else not steady
    return "\n".join(_Writer(model, name, numbers).lines()) + "\n"


def output_name(model: Model, name: str) -> str:
    """Return the name of an output in the Modelica text: NAME_output where NAME is another variable."""
    variable = name in model.states or name in model.signals or name in model.algebraic
    same = variable and model.outputs[name].value == symbol(name)
    return name if same or name not in model.names else f"{name}_output"


class _Writer:
    """The declarations and equations of one model."""

    def __init__(self, model: Model, name: str, numbers: bool) -> None:
        self.model = model
        self.name = re.sub(r"[^A-Za-z0-9_]", "_", name or model.name)
        if not re.match(r"[A-Za-z]", self.name):
            self.name = f"M_{self.name}"
        taken = {*model.names, *model.outputs, self.name, "time"}
        free = (n for k in itertools.count(1) if (n := f"helper_{k}") not in taken)
        self.text = ModelicaPrinter(lambda: next(free))
        self.start = CModel(model)
        # An output that shows the variable of its name is that variable.
        self.shown = {n for n in model.outputs if output_name(model, n) == n and n in model.names}
        self.numbers = numbers

    def lines(self) -> Iterator[str]:
        """Yield the lines of the text."""
        m = self.model
        equations = list(self._equations())
        initial = list(self._initial())
        yield f"model {self.name} {_string(m.description or m.name)}"
        yield from (f"  {line}" for line in self._declarations())
        yield from (f"  Real {n};" for n in self.text.helpers)
        if initial:
            yield "initial equation"
            yield from (f"  {line}" for line in initial)
        yield "equation"
        yield from (f"  {line}" for line in equations)
        yield from (f"  {n} = {value};" for n, value in self.text.helpers.items())
        yield f"end {self.name};"

    def _declarations(self) -> Iterator[str]:
        m, rest = self.model, self.start.rest
        for n, q in m.parameters.items():
            bounds = {"min": q.min, "max": q.max}
            given = [f"{k} = {v!r}" for k, v in bounds.items() if abs(v) < float("inf")]
            yield _declared("parameter Real", n, [*_unit(q.unit), *given], q.unit, q.description, repr(q.value))
        for n, i in m.inputs.items():
            yield _declared("input Real", n, [*_unit(i.unit), f"start = {i.value!r}"], i.unit, i.description)
        for k, (n, s) in enumerate(m.states.items()):
            start = [f"start = {float(rest[k])!r}", *(["fixed = true"] if self.numbers and s.start is None else [])]
            yield _declared(self._kind(n), n, [*_unit(s.unit), *start], s.unit, s.description)
        known = {n: float(rest[len(m.states) + k]) for k, n in enumerate(self.start.structure.unknowns)}
        for n, z in m.algebraic.items():
            start = [f"start = {known[n]!r}"] if n in known else []
            yield _declared(self._kind(n), n, [*_unit(z.unit), *start], z.unit, z.description)
        for n, g in m.signals.items():
            yield _declared(self._kind(n), n, _unit(g.unit), g.unit, g.description)
        for n in m.delays:
            yield f"Real {identifier(n)};"
        at = len(rest) - len(m.sampled)
        for k, n in enumerate(m.sampled):
            held = f"(start = {float(rest[at + k])!r}, fixed = true)"
            yield f"discrete Real {identifier(f'{n}_taken')}{held};"
            yield f"discrete Real {identifier(n)}{held};"
        for n, o in m.outputs.items():
            if n not in self.shown:
                yield _declared("output Real", output_name(m, n), _unit(o.unit), o.unit, o.description)

    def _kind(self, name: str) -> str:
        return "output Real" if name in self.shown else "Real"

    def _equations(self) -> Iterator[str]:
        m, text = self.model, self.text
        for n, s in m.states.items():
            yield f"der({identifier(n)}) = {text(s.derivative)};"
        for n, z in m.algebraic.items():
            yield f"{identifier(n)} = {text(z.equation)};"
        for n, g in m.signals.items():
            yield f"{identifier(n)} = {text(g.value)};"
        for n, d in m.delays.items():
            yield f"{identifier(n)} = delay({text(d.of)}, {text(d.time)});"
        for n, q in m.sampled.items():
            taken, period, compute = identifier(f"{n}_taken"), text(q.period), text(q.compute)
            yield f"when sample(0, {period}) then {taken} = {text(q.value)}; end when;"
            if q.compute == 0:
                yield f"when sample(0, {period}) then {identifier(n)} = {text(q.value)}; end when;"
            else:
                yield f"when sample({compute}, {period}) then {identifier(n)} = pre({taken}); end when;"
        for n, o in m.outputs.items():
            if n not in self.shown:
                yield f"{identifier(output_name(m, n))} = {text(o.value)};"

    def _initial(self) -> Iterator[str]:
        for n, s in self.model.states.items():
            if s.start == "free":
                yield f"{identifier(n)} = {identifier(f'{n}_start')};"
            elif s.start is not None:
                yield f"{identifier(n)} = {self.text(s.start)};"
            elif not self.numbers:
                yield f"{identifier(n)} = {self.text(s.rest)};" if s.rest is not None else f"der({identifier(n)}) = 0;"


def _declared(kind: str, name: str, attributes: Iterable[str], unit: str, description: str, value: str = "") -> str:
    listed = ", ".join(attributes)
    words = " ".join(description.split())
    note = " ".join(t for t in (words, f"[{unit}]" if unit and unit not in SI else "") if t)
    return (
        f"{kind} {identifier(name)}"
        + (f"({listed})" if listed else "")
        + (f" = {value}" if value else "")
        + (f" {_string(note)}" if note else "")
        + ";"
    )


def _unit(unit: str) -> list[str]:
    """Return the unit attribute, for units of Modelica's grammar; others are put into the description."""
    return [f'unit = "{unit}"'] if unit in SI else []


def _string(text: str) -> str:
    escaped = " ".join(text.split()).replace("\\", "\\\\").replace('"', '\\"')
    return f'"{escaped}"'


KEYWORDS = frozenset(
    """algorithm and annotation assert block break class connect connector constant constrainedby der discrete each else
    elseif elsewhen encapsulated end enumeration equation expandable extends external false final flow for function if
    import impure in initial inner input loop model not operator or outer output package parameter partial protected
    public pure record redeclare replaceable return stream then true type when while within
    abs sign sqrt div mod rem ceil floor integer sin cos tan asin acos atan atan2 sinh cosh tanh exp log log10 semiLinear
    homotopy delay cardinality terminal smooth noEvent sample pre edge change reinit time max min sum product Real Integer
    Boolean String""".split()  # noqa: SIM905 - one list of words, read as such
)


def identifier(name: str) -> str:
    """Return a variable's name in Modelica, quoted where it is a keyword, a built-in function or that of a component's part."""
    return f"'{name}'" if name in KEYWORDS or "." in name else name


class ModelicaPrinter:
    """Writes expressions. An operand that a conditional expression uses several times becomes a variable in `helpers`."""

    def __init__(self, fresh: Callable[[], str]) -> None:
        self._fresh = fresh
        self._named: dict[Any, str] = {}
        self.helpers: dict[str, str] = {}

    def __call__(self, e: Any) -> str:
        """Return the text of an expression, in parentheses unless it is an atom or a call."""
        if isinstance(e, sp.Symbol):
            return "time" if e.name == "time" else identifier(e.name)
        if e.is_Rational and not e.is_Integer:
            return f"({e.p}/{e.q})"
        if e.is_Number or e is sp.pi or e is sp.E:
            return _number(e)
        if isinstance(e, sp.Add):
            return f"({' + '.join(map(self, e.args))})"
        if isinstance(e, sp.Mul):
            return self._product(e)
        if isinstance(e, sp.Pow):
            return self._power(e)
        if function := elementary(e.func):
            return f"{function.name}({', '.join(map(self, e.args))})"
        return self._choice(e)

    def _product(self, e: Any) -> str:
        top, bottom = [], []
        for f in e.args:
            if f.is_Pow and f.exp.is_number and f.exp.is_negative:
                bottom.append(self(sp.Pow(f.base, -f.exp, evaluate=False) if f.exp != -1 else f.base))
            else:
                top.append(self(f))
        text = "*".join(top) or "1"
        return f"({text})" if not bottom else f"({text}/({'*'.join(bottom)}))"

    def _power(self, e: Any) -> str:
        if e.base is sp.E:
            return f"exp({self(e.exp)})"
        if e.exp == sp.Rational(1, 2):
            return f"sqrt({self(e.base)})"
        if e.exp.is_number and e.exp.is_negative:
            rest = e.base if e.exp == -1 else sp.Pow(e.base, -e.exp, evaluate=False)
            return f"(1/{self(rest)})"
        return f"({self(e.base)}^{self(e.exp)})"

    def _choice(self, e: Any) -> str:
        kind = e.func
        if kind is sp.Abs:
            x = self._name(e.args[0])
            return f"(if {x} < 0 then -{x} else {x})"
        if kind is sp.sign:
            x = self._name(e.args[0])
            return f"(if {x} < 0 then -1 elseif {x} > 0 then 1 else 0)"
        if kind is clip:
            x, low, high = map(self._name, e.args)
            return f"(if {x} < {low} then {low} elseif {x} > {high} then {high} else {x})"
        if isinstance(e, sp.Min | sp.Max):
            return self._extremum(e)
        if kind is sp.Piecewise and e.args[-1].cond == True:  # noqa: E712 - a sympy condition
            pieces = [f"if {self._condition(c)} then {self(v)}" for v, c in e.args[:-1]]
            return f"({' else'.join(pieces)} else {self(e.args[-1].expr)})"
        raise ExpressionError(
            f"Modelica text has no word for '{getattr(kind, '__name__', kind)}'",
            hint="write it with the functions of the grammar",
        )

    def _extremum(self, e: Any) -> str:
        sign = "<" if isinstance(e, sp.Min) else ">"
        text = self._name(e.args[0])
        for k, argument in enumerate(e.args[1:]):
            first = text if k == 0 else self._helper(text)
            second = self._name(argument)
            text = f"(if {first} {sign} {second} then {first} else {second})"
        return text

    def _condition(self, c: Any) -> str:
        if isinstance(c, And | Or):
            return f"({(' and ' if isinstance(c, And) else ' or ').join(map(self._condition, c.args))})"
        if isinstance(c, Not):
            return f"(not {self._condition(c.args[0])})"
        word = {sp.Lt: "<", sp.Le: "<=", sp.Gt: ">", sp.Ge: ">="}.get(c.func)
        if word:
            return f"{self(c.args[0])} {word} {self(c.args[1])}"
        if c.func in (sp.Eq, sp.Ne):  # two Reals are not compared for equality in Modelica
            a, b = map(self._name, c.args)
            return f"({a} <= {b} and {a} >= {b})" if c.func is sp.Eq else f"({a} < {b} or {a} > {b})"
        raise ExpressionError(f"Modelica text has no word for the condition '{c}'", expected="a comparison")

    def _name(self, e: Any) -> str:
        """Return the text of an expression that is used several times: an atom, or the name of a helper."""
        if isinstance(e, sp.Symbol) or e.is_Number:
            return self(e)
        if e not in self._named:
            self._named[e] = self._helper(self(e))
        return self._named[e]

    def _helper(self, text: str) -> str:
        name = self._fresh()
        self.helpers[name] = text
        return name


def _number(e: Any) -> str:
    text = str(e.p) if e.is_Integer and abs(e.p) < 2**31 else repr(float(e))
    return f"({text})" if text.startswith("-") else text
