"""The words of the expression language, and text cut into tokens and trees; nothing here knows sympy.

comparison := sum [("<" | "<=" | ">" | ">=" | "==" | "!=") sum]        only as the condition of where
sum        := product (("+" | "-") product)*
product    := signed (("*" | "/") signed)*
signed     := ("+" | "-") signed | power
power      := primary ["**" signed]
primary    := number | name | function "(" comparison ("," comparison)* ")" | "(" comparison ")"
"""

from __future__ import annotations

import difflib
import re
from dataclasses import dataclass
from typing import NamedTuple, NoReturn

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression.functions import FUNCTIONS

MAX_LENGTH = 100_000
MAX_TOKENS = 10_000
MAX_DEPTH = 100
MAX_CALLS = 32
MAX_COMPARISONS = 1024
CONSTANTS = ("pi", "time")
COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*", re.ASCII)
# A quantifier that gives nothing back: no text makes the scan slower than linear.
_TOKEN = re.compile(
    r"(?P<space>[ \t\r\n]+)"
    r"|(?P<number>(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][+-]?[0-9]++)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*+)"
    r"|(?P<mark>\*\*|<=|>=|==|!=|[-+*/(),<>])",
    re.ASCII,
)


def is_identifier(name: object) -> bool:
    """True for a text that can name a variable: letters, digits and _, no digit first."""
    return isinstance(name, str) and IDENTIFIER.fullmatch(name) is not None


def is_reserved(name: object) -> bool:
    """True for the name of a function or a constant of the grammar, which no variable can have."""
    return name in FUNCTIONS or name in CONSTANTS


class Token(NamedTuple):
    kind: str
    text: str
    position: int


@dataclass(frozen=True)
class Number:
    text: str
    position: int


@dataclass(frozen=True)
class Name:
    name: str
    position: int


@dataclass(frozen=True)
class Negative:
    value: Node
    position: int


@dataclass(frozen=True)
class Chain:
    """Operands of + and -, or of * and /, each with the mark before it."""

    items: tuple[tuple[str, Node], ...]
    position: int


@dataclass(frozen=True)
class Power:
    base: Node
    exponent: Node
    position: int


@dataclass(frozen=True)
class Call:
    function: str
    arguments: tuple[Node, ...]
    position: int


@dataclass(frozen=True)
class Comparison:
    relation: str
    left: Node
    right: Node
    position: int


Node = Number | Name | Negative | Chain | Power | Call | Comparison


class Source:
    """The text under parse, and errors that point into it."""

    def __init__(self, text: str, where: str) -> None:
        self.text, self.where = text, where

    def fail(self, what: str, position: int) -> NoReturn:
        """Raise an ExpressionError that shows the place."""
        raise ExpressionError(f"{what}, at character {position + 1}:{self._excerpt(position)}", where=self.where)

    def _excerpt(self, position: int) -> str:
        low, high = max(0, position - 30), min(len(self.text), position + 28)
        head, tail = "…" * (low > 0), "…" * (high < len(self.text))
        part = "".join(c if c.isprintable() else " " for c in self.text[low:high])
        return f"\n    {head}{part}{tail}\n    {' ' * (len(head) + position - low)}^"


def tokens(source: Source) -> list[Token]:
    """The tokens of the text, closed by one of kind "end"."""
    text, found, at = source.text, list[Token](), 0
    if len(text) > MAX_LENGTH:
        got = f"{len(text)}"
        raise ExpressionError(
            "the expression is too long", where=source.where, expected=f"at most {MAX_LENGTH} characters", got=got
        )
    while at < len(text):
        match = _TOKEN.match(text, at)
        if match is None:
            source.fail(_stray(text, at), at)
        if match.lastgroup != "space":
            found.append(Token(str(match.lastgroup), match.group(), at))
        at = match.end()
        if match.lastgroup == "number" and at < len(text) and (text[at].isalnum() or text[at] in "_."):
            source.fail(f"'{text[at]}' cannot follow the number {match.group()[:30]}", at)
        if len(found) > MAX_TOKENS:
            source.fail(f"the expression has over {MAX_TOKENS} parts", at)
    found.append(Token("end", "the end", len(text)))
    return found


def _stray(text: str, at: int) -> str:
    character = text[at]
    if character in "'\"":
        return "texts are no part of an expression"
    if character in "[]{}":
        return f"'{character}' is no part of an expression; group with ( )"
    if character == ".":
        return "'.' is no part of an expression; names have letters, digits and _ only"
    if character == "^":
        return "'^' is no part of an expression; a power is written **"
    if character in "&|!~=":
        return f"'{character}' is no part of an expression; a condition is one of {' '.join(COMPARISONS)}"
    shown = character if character.isprintable() and character.isascii() else f"U+{ord(character):04X}"
    return f"the character {shown} is no part of an expression"


class TreeBuilder:
    """Precedence climbing over the tokens; depth is counted, so no text can exhaust the stack."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self.tokens = tokens(source)
        self.next = 0
        self.depth = 0
        self.calls = 0

    def tree(self) -> Node:
        """The tree of the whole text."""
        if self._peek().kind == "end":
            raise ExpressionError("the expression is empty", where=self.source.where)
        root = self._comparison()
        if self._peek().kind != "end":
            self._unexpected("an operator or the end")
        return root

    def _peek(self) -> Token:
        return self.tokens[self.next]

    def _take(self) -> Token:
        token = self.tokens[self.next]
        self.next += 1
        return token

    def _accept(self, *marks: str) -> Token | None:
        token = self._peek()
        return self._take() if token.kind == "mark" and token.text in marks else None

    def _expect(self, mark: str, expected: str) -> None:
        if self._accept(mark) is None:
            self._unexpected(expected)

    def _unexpected(self, expected: str) -> NoReturn:
        token = self._peek()
        shown = token.text if token.kind == "end" else f"'{token.text[:30]}'"
        self.source.fail(f"unexpected {shown}, expected {expected}", token.position)

    def _deeper(self, position: int) -> None:
        self.depth += 1
        if self.depth > MAX_DEPTH:
            self.source.fail(f"the expression is nested over {MAX_DEPTH} deep; name parts of it as signals", position)

    def _deeper_call(self, position: int) -> None:
        self._deeper(position)
        self.calls += 1
        if self.calls > MAX_CALLS:
            what = f"functions and powers are nested over {MAX_CALLS} deep; name parts of it as signals"
            self.source.fail(what, position)

    def _leave_call(self) -> None:
        self.depth -= 1
        self.calls -= 1

    def _comparison(self) -> Node:
        left = self._sum()
        mark = self._accept(*COMPARISONS)
        if mark is None:
            return left
        right = self._sum()
        second = self._peek()
        if second.kind == "mark" and second.text in COMPARISONS:
            self.source.fail("comparisons cannot be chained; nest two where", second.position)
        return Comparison(mark.text, left, right, mark.position)

    def _sum(self) -> Node:
        first = self._product()
        items = [("+", first)]
        while mark := self._accept("+", "-"):
            items.append((mark.text, self._product()))
        return first if len(items) == 1 else Chain(tuple(items), first.position)

    def _product(self) -> Node:
        first = self._signed()
        items = [("*", first)]
        while mark := self._accept("*", "/"):
            items.append((mark.text, self._signed()))
        if len(items) == 1:
            return first
        signs = sum(isinstance(node, Negative) for _, node in items)
        bare = [(mark, node.value if isinstance(node, Negative) else node) for mark, node in items]
        chain = Chain(tuple(bare), first.position)
        return Negative(chain, first.position) if signs % 2 else chain

    def _signed(self) -> Node:
        mark = self._accept("+", "-")
        if mark is None:
            return self._power()
        self._deeper(mark.position)
        value = self._signed()
        self.depth -= 1
        return Negative(value, mark.position) if mark.text == "-" else value

    def _power(self) -> Node:
        base = self._primary()
        mark = self._accept("**")
        if mark is None:
            return base
        self._deeper_call(mark.position)
        exponent = self._signed()
        self._leave_call()
        return Power(base, exponent, mark.position)

    def _primary(self) -> Node:
        token = self._peek()
        if token.kind == "number":
            return Number(self._take().text, token.position)
        if token.kind == "name":
            self._take()
            return self._call(token) if self._accept("(") else self._name(token)
        self._expect("(", "a number, a name or '('")
        self._deeper(token.position)
        inside = self._comparison()
        self._expect(")", "')'")
        self.depth -= 1
        return inside

    def _name(self, token: Token) -> Node:
        if token.text in FUNCTIONS:
            self.source.fail(f"'{token.text}' is a function and cannot stand alone", token.position)
        return Name(token.text, token.position)

    def _call(self, token: Token) -> Node:
        if token.text not in FUNCTIONS:
            near = difflib.get_close_matches(token.text, FUNCTIONS, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(FUNCTIONS)}"
            self.source.fail(f"no function '{token.text[:40]}' ({hint})", token.position)
        self._deeper_call(token.position)
        arguments: list[Node] = []
        if self._accept(")") is None:
            arguments.append(self._comparison())
            while self._accept(","):
                arguments.append(self._comparison())
            self._expect(")", "',' or ')'")
        self._leave_call()
        low, high = FUNCTIONS[token.text].arity
        if not low <= len(arguments) <= high:
            counts = f"{low}" if low == high else f"{low} to {high}"
            self.source.fail(f"'{token.text}' takes {counts} arguments, got {len(arguments)}", token.position)
        return Call(token.text, tuple(arguments), token.position)
