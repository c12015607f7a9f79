"""Grammar of the expression language: text cut into tokens, and the syntax tree that Python makes of them.

comparison := sum [("<" | "<=" | ">" | ">=" | "==" | "!=") sum]        only as the condition of where
sum        := product (("+" | "-") product)*
product    := signed (("*" | "/") signed)*
signed     := ("+" | "-") signed | power
power      := primary ["**" signed]
primary    := number | name | function "(" argument ("," argument)* ")" | "(" comparison ")"
argument   := comparison | "[" sum ("," sum)* "]"                      lists only in table

A name may have parts with dots between: `gen.H` is H of the component gen.
"""

from __future__ import annotations

import ast
import difflib
import re
from itertools import accumulate, pairwise
from typing import NamedTuple, NoReturn

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression.blocks import BLOCKS
from hvdc_ident.expression.functions import FUNCTIONS

MAX_LENGTH = 100_000
MAX_TOKENS = 10_000
MAX_DEPTH = 100
MAX_CALLS = 32
MAX_POINTS = 64
CONSTANTS = ("pi", "time")
COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
_OPERATORS = ("+", "-", "*", "/", *COMPARISONS)
IDENTIFIER = re.compile(r"[A-Za-z_][A-Za-z0-9_]*(?:\.[A-Za-z][A-Za-z0-9_]*)*", re.ASCII)
# A quantifier that gives nothing back: no text makes the scan slower than linear.
_TOKEN = re.compile(
    r"(?P<space>[ \t\r\n]+)"
    r"|(?P<number>(?:[0-9]++(?:\.[0-9]*+)?|\.[0-9]++)(?:[eE][+-]?[0-9]++)?)"
    r"|(?P<name>[A-Za-z_][A-Za-z0-9_]*+(?:\.[A-Za-z][A-Za-z0-9_]*+)*+)"
    r"|(?P<mark>\*\*|<=|>=|==|!=|[-+*/(),<>\[\]])",
    re.ASCII,
)


def is_identifier(name: object) -> bool:
    """True for a text that can name a variable: letters, digits and _, no digit first; parts with dots between."""
    return isinstance(name, str) and IDENTIFIER.fullmatch(name) is not None


def is_reserved(name: object) -> bool:
    """True for the name of a function or a constant of the grammar, which no variable can have."""
    return name in FUNCTIONS or name in CONSTANTS


class Token(NamedTuple):
    kind: str
    text: str
    position: int


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
    """Return the tokens of the text, closed by one of kind "end"."""
    text, parts, at = source.text, list[Token](), 0
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
            parts.append(Token(str(match.lastgroup), match.group(), at))
        at = match.end()
        if match.lastgroup == "number" and at < len(text) and (text[at].isalnum() or text[at] in "_."):
            source.fail(f"'{text[at]}' cannot follow the number {match.group()[:30]}", at)
        if len(parts) > MAX_TOKENS:
            source.fail(f"the expression has over {MAX_TOKENS} parts", at)
    parts.append(Token("end", "the end", len(text)))
    return parts


def _stray(text: str, at: int) -> str:
    character = text[at]
    if character in "'\"":
        return "texts are no part of an expression"
    if character in "{}":
        return f"'{character}' is no part of an expression; group with ( )"
    if character == ".":
        return "'.' stands between the parts of a name only, as in gen.H"
    if character == "^":
        return "'^' is no part of an expression; a power is written **"
    if character in "?&|!~":
        return f"'{character}' is no part of an expression; {_instead(character, text)}"
    if character == "=":
        return f"'{character}' is no part of an expression; a condition is one of {' '.join(COMPARISONS)}"
    shown = character if character.isprintable() and character.isascii() else f"U+{ord(character):04X}"
    return f"the character {shown} is no part of an expression"


_WORDS = {
    "if": "a if c else b is written where(c, a, b)",
    "else": "a if c else b is written where(c, a, b)",
    "?": "c ? a : b is written where(c, a, b)",
    "and": "where(c and d, a, b) is written where(c, where(d, a, b), b)",
    "or": "where(c or d, a, b) is written where(c, a, where(d, a, b))",
    "not": "where(not c, a, b) is written where(c, b, a)",
}
"""Choices as other languages write them, and how they are written here."""
_MARKS = {"?": "?", "&": "and", "|": "or", "!": "not", "~": "not"}
_CHOICES = (r"(?P<a>.+?)\bif\b(?P<c>.+?)\belse\b(?P<b>.+)", r"(?P<c>.+?)\?(?P<a>.+?):(?P<b>.+)")


def _instead(word: str, text: str) -> str:
    """Return how a choice of another language is written: this one, where it is the whole text."""
    for pattern in _CHOICES if len(text) <= 200 else ():
        match = re.fullmatch(pattern, text.strip())
        if match and not re.search(r"\b(if|and|or|not)\b|[?&|!]", "".join(match.groups())):
            return f"write where({match['c'].strip()}, {match['a'].strip()}, {match['b'].strip()})"
    return _WORDS[_MARKS.get(word, word)]


class SyntaxTree:
    """Structure of an expression as Python's own parser sees it, with the tokens behind its nodes.

    Python parses nothing but the marks, with the name `_` for every number and name of the text, and only where the
    grammar allows each: no word of the text reaches it. root: a tree of Name, Call, UnaryOp, BinOp and Compare nodes.
    """

    def __init__(self, source: Source) -> None:
        parts = tokens(source)
        if len(parts) == 1:
            raise ExpressionError("the expression is empty", where=source.where)
        _Scan(source).run(parts)
        marks = [t.text if t.kind == "mark" else "_" for t in parts[:-1]]
        starts = accumulate((len(m) + 1 for m in marks), initial=0)
        self._begins = dict(zip(starts, parts, strict=True))
        self.root: ast.expr = ast.parse(" ".join(marks), mode="eval").body

    def token(self, node: ast.expr) -> Token:
        """Token at which a node begins."""
        return self._begins[node.col_offset]


class _Level(NamedTuple):
    """An open parenthesis or list: whether arguments stand in it and may be lists, what closes it, and the counts before it."""

    call: bool
    lists: bool
    close: str
    depth: int
    calls: int
    compared: bool


class _Scan:
    """One pass over the tokens that refuses each one the grammar has no place for, and counts depth before Python parses.

    depth: parentheses, signs, functions and powers around the next token; calls: functions and powers alone. compared:
    True where a comparison stands before it in the same argument or parenthesis.
    """

    def __init__(self, source: Source) -> None:
        self.source = source
        self.open: list[_Level] = []
        self.depth = self.calls = 0
        self.compared = False
        self.before = ""

    def run(self, parts: list[Token]) -> None:
        """Raise an ExpressionError at the first token that cannot stand where it does."""
        before, value_due = Token("start", "", 0), True
        for token, following in pairwise((*parts, parts[-1])):
            self.before = before.text
            if token.text == "(" and before.kind == "name":
                self._open(token, call=True, lists=before.text == "table")
                value_due = True
            elif value_due and not (token.text == ")" and before.text == "(" and self.open[-1].call):
                value_due = self._begin(token, following)
            else:
                value_due = self._continue(token)
            before = token

    def _begin(self, token: Token, following: Token) -> bool:
        """Take a token where a value begins; True where the value is still to come."""
        if token.kind == "name":
            self._check_name(token, called=following.text == "(")
        elif token.text in ("+", "-"):
            self._deeper(token)
        elif token.text == "(":
            self._open(token, call=False)
        elif token.text == "[" and self.open and self.open[-1].lists:
            self._open(token, call=True)
        elif token.kind != "number":
            self._unexpected(token, "a number, a name or '('")
        return token.kind == "mark"

    def _continue(self, token: Token) -> bool:
        """Take a token where a value has ended; True where another one must follow."""
        if token.text == "**":
            self._deeper(token, call=True)
        elif self.open and token.text == self.open[-1].close:
            *_, self.depth, self.calls, self.compared = self.open.pop()
        elif token.text in _OPERATORS or (token.text == "," and self.open and self.open[-1].call):
            if token.text in COMPARISONS and self.compared:
                self.source.fail("comparisons cannot be chained; nest two where", token.position)
            self.compared = token.text in COMPARISONS or (self.compared and token.text != ",")
            self._leave_signs_and_powers()
        elif token.kind != "end" or self.open:
            close = f"'{self.open[-1].close}'" if self.open else ""
            inside = f"',' or {close}" if self.open and self.open[-1].call else close
            self._unexpected(token, inside if self.open else "an operator or the end")
        return token.text not in (")", "]", "the end")

    def _open(self, token: Token, call: bool, lists: bool = False) -> None:
        close = "]" if token.text == "[" else ")"
        self.open.append(_Level(call, lists, close, self.depth, self.calls, self.compared))
        self._deeper(token, call)
        self.compared = False

    def _deeper(self, token: Token, call: bool = False) -> None:
        self.depth, self.calls = self.depth + 1, self.calls + call
        if self.depth > MAX_DEPTH:
            what = f"the expression is nested over {MAX_DEPTH} deep; name parts of it as signals"
            self.source.fail(what, token.position)
        if self.calls > MAX_CALLS:
            what = f"functions and powers are nested over {MAX_CALLS} deep; name parts of it as signals"
            self.source.fail(what, token.position)

    def _leave_signs_and_powers(self) -> None:
        level = self.open[-1] if self.open else _Level(False, False, "", -1, 0, False)
        self.depth, self.calls = level.depth + 1, level.calls + level.call

    def _check_name(self, token: Token, called: bool) -> None:
        known = (*FUNCTIONS, *BLOCKS)
        if called and token.text not in known:
            near = difflib.get_close_matches(token.text, known, n=1)
            hint = f"did you mean '{near[0]}'?" if near else f"there are {', '.join(known)}"
            self.source.fail(f"no function '{token.text[:40]}' ({hint})", token.position)
        if not called and token.text in FUNCTIONS:
            self.source.fail(f"'{token.text}' is a function and cannot stand alone", token.position)

    def _unexpected(self, token: Token, expected: str) -> NoReturn:
        if token.text in ("[", "]"):
            self.source.fail(
                f"a list stands in table only, as in table(x, [0, 1], [0, 2]), not '{token.text}'", token.position
            )
        word = "not" if self.before == "not" else token.text
        if word in _WORDS:
            self.source.fail(
                f"'{word}' is no part of an expression; {_instead(word, self.source.text)}", token.position
            )
        shown = token.text if token.kind == "end" else f"'{token.text[:30]}'"
        self.source.fail(f"unexpected {shown}, expected {expected}", token.position)
