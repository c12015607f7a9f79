"""LaTeX of the transfer functions, in zeros and poles."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from hvdc_ident.files import write_text
from hvdc_ident.linearize.linear_model import LinearModel
from hvdc_ident.linearize.system import Array
from hvdc_ident.linearize.transfer_function import TransferFunction

SUFFIX = ".tex"
SUMMARY = "the transfer functions in LaTeX, zeros and poles with six digits"


def write(model: LinearModel, path: Path) -> Path:
    """Write the provenance as comments and one displayed equation a channel, and return the path."""
    functions = [model.transfer_function(i, o) for o in model.output_names for i in model.input_names]
    head = "".join(f"% {' '.join(f'{k}: {v}'.split())}\n" for k, v in model.provenance.items())
    return write_text(path, head + "\n".join(text(f) for f in functions))


def text(f: TransferFunction, digits: int = 6) -> str:
    """Return the transfer function as an equation; conjugate pairs as quadratic factors."""
    top, bottom = factors(f.zeros, digits), factors(f.poles, digits)
    gain = number(f.gain, digits)
    fraction = f"{gain} \\, \\frac{{{top or '1'}}}{{{bottom}}}" if bottom else f"{gain} \\, {top}" if top else gain
    label = f"G_{{\\mathrm{{{escape(f.input)}}} \\to \\mathrm{{{escape(f.output)}}}}}(s)"
    return f"\\begin{{equation}}\n  {label} = {fraction}\n\\end{{equation}}\n"


def escape(name: str) -> str:
    """Return a name as LaTeX text."""
    return name.replace("\\", r"\backslash ").replace("_", r"\_").replace("%", r"\%").replace("#", r"\#")


def number(value: float, digits: int = 6) -> str:
    """Return a number as LaTeX math."""
    text = f"{value:.{digits}g}"
    if "e" not in text:
        return text
    mantissa, exponent = text.split("e")
    return f"{mantissa} \\times 10^{{{int(exponent)}}}"


def factors(roots: Array, digits: int) -> str:
    """Return (s + a)(s^2 + b s + c)... of roots whose complex ones come in pairs."""
    parts = []
    for r in roots:
        if abs(r.imag) <= 1e-12 * max(1.0, abs(r)):
            parts.append("s" if r.real == 0 else f"(s {_signed(-r.real, digits)})")
        elif r.imag > 0:
            parts.append(f"(s^2 {_signed(-2 * r.real, digits)} s {_signed(float(np.abs(r) ** 2), digits)})")
    return " ".join(parts)


def _signed(value: float, digits: int) -> str:
    return f"{'-' if value < 0 else '+'} {number(abs(value), digits)}"
