"""Expressions that attack: each is refused at once, and nothing of it runs."""

from __future__ import annotations

from pathlib import Path

import pytest

from hvdc_ident.errors import ExpressionError
from hvdc_ident.expression import parse
from tests.effort import calls

BIG = "9007199254740991"

REFUSED = [
    "__import__('os').system('touch canary')",
    '__import__("os").system("touch canary")',
    "open('canary','w')",
    "open(canary, w)",
    "exec('1')",
    "eval(a)",
    "compile(a, b, c)",
    "getattr(x,'y')",
    "globals()",
    "print(x)",
    "x.__class__",
    "().__class__.__bases__",
    "x[0]",
    "{x}",
    "[x for x in y]",
    "'a'*9",
    "b'a'",
    "f'{x}'",
    "r'x'",
    "x; a",
    "x\nimport os",
    "x:=1",
    "x = 1",
    "lambda: 0",
    "lambda x: x",
    "a if x else a",
    "x and y",
    "not x",
    "~x",
    "x @ y",
    "x % y",
    "x // y",
    "x << 2",
    "x`y`",
    "$x",
    "x\\",
    "x # comment",
    "\x00",
    "\u0430 + x",
    "x\u00b2",
    "\u0661 + x",
    "\uff58 + 1",
    "0x10",
    "1_000",
    "1j*x",
    "1..2",
    "*x",
    "**x",
    "f(*x)",
    "sin(x=1)",
    "...",
    "9**9**9**9",
    "9**9**9",
    "10**400",
    "(-9)**999999999",
    "2**-" + "9" * 400,
    "x**1e999",
    "1e999",
    "-1e999",
    "9" * 5000,
    "1/0",
    "0**-1",
    "1/(x - x)",
    "log(0)",
    "log(-1)",
    "sqrt(-1)",
    "sqrt(-x**2)",
    "asin(2)",
    "(-8)**(1/3)",
    "exp(1000)",
    "exp(exp(exp(9)))",
    "99**(99*x/x)**(99*x/x)",
    f"(2**(x*{BIG}))**(1/x)",
    f"exp(x + {BIG}*log(2))",
    f"(x + 1)**({BIG}*log(2)/log(x + 1))",
    "((x*9)**999999)**999999",
    "(" * 99 + "9" + ")**9" * 99,
    "(" * 3000 + "x" + ")" * 3000,
    "-" * 5000 + "x",
    "sin(" * 3000 + "x" + ")" * 3000,
    "x**" * 5000 + "x",
    "abs(x+" * 90 + "x" + ")" * 90,
    "x" * 100_001,
    "x+" * 9_999 + "x",
    "(" * 20_000,
    "max(" + ",".join(f"a{i}" for i in range(3000)) + ")",
    "where(x > 0, 1",
    "import os",
    "nan(",
]

HARMLESS = [
    f"2**x*2**({BIG} - x)",
    f"3**(99999*x)*3**({BIG} - 99999*x)",
    f"2**(-{BIG})",
    f"exp(-{BIG}*log(2))",
    f"x**{BIG}",
    f"{BIG}*{BIG}*x",
    "sin(1e300)",
    "1/(1 + " * 30 + "x" + ")" * 30,
    "tanh(1 + " * 30 + "x" + ")" * 30,
    "max(" + ",".join(f"a{i}" for i in range(16)) + ")",
    "+".join(f"max({','.join(f'a{i}_{j}' for j in range(16))})" for i in range(100)),
    "max(" * 20 + "x" + "".join(f",{','.join(f'a{i}_{j}' for j in range(30))})" for i in range(20)),
    "+".join(f"a{i}*b{i}" for i in range(1000)),
    "0.1e-5000",
    "1" + "0" * 300,
]


MOST_CALLS = 6_000_000  # about two seconds; the dearest of these takes half of it


def short(text: str) -> str:
    return repr(text[:30])


def test_there_are_forty_and_more() -> None:
    assert len(set(REFUSED)) >= 40


@pytest.mark.parametrize("text", REFUSED, ids=short)
def test_a_hostile_expression_is_refused_at_once(text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)

    def refused() -> str:
        with pytest.raises(ExpressionError) as caught:
            parse(text)
        return str(caught.value)

    assert calls(refused) < MOST_CALLS
    assert list(tmp_path.iterdir()) == []
    assert all(len(line) < 250 for line in refused().splitlines())


@pytest.mark.parametrize("text", HARMLESS, ids=short)
def test_an_odd_but_lawful_expression_does_not_hold_the_parser_up(text: str) -> None:
    assert calls(lambda: parse(text)) < MOST_CALLS


@pytest.mark.parametrize("thing", [None, 1, 1.5, b"x", ["x"]])
def test_only_text_is_parsed(thing: object) -> None:
    with pytest.raises(ExpressionError):
        parse(thing)  # type: ignore[arg-type]
