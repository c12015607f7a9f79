"""Files of measured frequency responses: columns of text, and Touchstone."""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from hvdc_ident.errors import WaveformError
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.linearize.system import Array

FILE_BYTES = 50_000_000  # bytes
_HERTZ = {"hz": 1.0, "khz": 1e3, "mhz": 1e6, "ghz": 1e9}
_PARTS = {
    "re": "re", "real": "re", "im": "im", "imag": "im", "imaginary": "im",
    "mag": "mag", "magnitude": "mag", "abs": "mag", "modulus": "mag", "gain": "mag", "db": "db",
    "phase": "deg", "ang": "deg", "angle": "deg", "arg": "deg", "deg": "deg", "degree": "deg", "degrees": "deg", "°": "deg",
    "rad": "rad", "std": "std", "sigma": "std",
}  # fmt: skip
"""The meaning of the words in a column's title. A phase is in degrees unless its title says rad."""
_FREQUENCY = ("f", "freq", "frequency", "omega", "w", "ω", *_HERTZ)


@dataclass(frozen=True, eq=False)
class ResponseFile:
    """A measured frequency response as its file holds it.

    omega: (n,) rad/s, rising. channels: (n,) complex by name; "" is the name of one that has none. std: (n,) standard
    deviation of the error's modulus by channel, of the mean where a frequency was measured several times, where known.
    repeats: how often each frequency was measured, at least. dof: how many independent numbers a standard deviation was
    estimated from, by channel, where it was.
    """

    omega: Array
    channels: FrozenMap[Array]
    std: FrozenMap[Array] = field(default_factory=FrozenMap)
    repeats: int = 1
    dof: FrozenMap[float] = field(default_factory=FrozenMap)


def read_response(path: str | Path) -> ResponseFile:
    """Return the frequency response of a file.

    Text: a titled column of frequencies (Hz; kHz, omega or rad/s where the title says so), and for each channel one column of complex
    numbers ("1.2-0.3j"), or two: re and im, or mag (or dB) and phase (degrees, or rad); std for its standard deviation. Frequencies that
    stand several times are repeated sweeps: the mean counts, and its scatter. Touchstone (.s1p, .s2p, .sNp): S, Y or Z parameters; S are
    turned into Z.

    Parameters
    ----------
    path : str or Path
        The file.

    Returns
    -------
    ResponseFile
        omega (n,) in rad/s, rising; `channels`, (n,) complex by name, in the file's units; `std`, (n,) by name where it is known.

    Raises
    ------
    WaveformError
        A file that is neither, or has a number missing.

    Examples
    --------
    >>> import tempfile, hvdc_ident as hi
    >>> from pathlib import Path
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     scan = Path(folder, "scan.csv")
    ...     _ = scan.write_text("f_Hz,Z_re,Z_im\\n1,0.1,0.2\\n10,0.1,2.0\\n")
    ...     response = hi.linear.read_response(scan)
    >>> list(response.channels), response.channels["Z"].tolist()
    (['Z'], [(0.1+0.2j), (0.1+2j)])
    """
    file = Path(path)
    try:
        if file.stat().st_size > FILE_BYTES:
            raise WaveformError("the file is too large for a frequency response", where=str(file))
        text = file.read_text(encoding="utf-8-sig", errors="strict")
    except FileNotFoundError:
        raise WaveformError("no such file", where=str(file)) from None
    except (OSError, UnicodeDecodeError) as e:
        raise WaveformError("the file cannot be read as text", where=str(file), got=str(e)[:100]) from None
    ports = re.fullmatch(r"\.s(\d+)p", file.suffix.lower())
    response = _touchstone(text, int(ports[1]), file.name) if ports else _columns(text, file.name)
    return _averaged(response, file.name)


# --- columns of text ---


def _columns(text: str, where: str) -> ResponseFile:
    lines = [s for s in text.splitlines() if s.strip() and s.lstrip()[0] not in "#%!"]
    if len(lines) < 2:
        raise WaveformError("no rows", where=where, expected="a line of titles and rows of numbers")
    separator = max(";\t,", key=lambda c: (lines[0].count(c) > 0, c == ";", c == "\t", lines[0].count(c)))
    rows = [[c.strip() for c in row] for row in csv.reader(io.StringIO("\n".join(lines)), delimiter=separator)]
    titles, body = rows[0], rows[1:]
    if any(_complex(c, separator) is not None for c in titles):
        raise WaveformError(
            "the columns have no titles",
            where=where,
            expected="a first line such as frequency,Zdd_re,Zdd_im",
            got=lines[0],
        )
    for k, row in enumerate(body, start=2):
        if len(row) != len(titles):
            raise WaveformError(
                "a row of another length", where=f"{where}, row {k}", expected=f"{len(titles)} cells", got=f"{len(row)}"
            )
    values = np.array([[_cell(c, separator, f"{where}, row {k}") for c in row] for k, row in enumerate(body, start=2)])
    place, factor = _frequency_column(titles, where)
    parts: dict[str, dict[str, Array]] = {}
    for k, title in enumerate(titles):
        if k != place:
            name, part = _meaning(title)
            if part in parts.setdefault(name, {}):
                raise WaveformError("two columns of one meaning", where=where, got=f"'{title}' and another")
            parts[name][part] = values[:, k]
    channels = {n: _joined(p, n, where) for n, p in parts.items()}
    std = {n: p["std"].real for n, p in parts.items() if "std" in p}
    return ResponseFile(factor * values[:, place].real, FrozenMap(channels), FrozenMap(std))


def _frequency_column(titles: Sequence[str], where: str) -> tuple[int, float]:
    """Return (place, factor to rad/s) of the column of frequencies: the one that is titled so, else the first."""
    for k, title in enumerate(titles):
        words = _words(title)
        if words and words[0].lower() in _FREQUENCY:
            return k, _to_omega(title)
    raise WaveformError(
        "no column of frequencies", where=where, expected="one titled f, frequency, Hz or omega", got=", ".join(titles)
    )


def _to_omega(title: str) -> float:
    low = title.lower()
    for unit, factor in _HERTZ.items():
        if unit in [w.lower() for w in _words(title)]:
            return 2 * math.pi * factor
    radians = "rad" in low or _words(title)[0].lower() in ("omega", "w", "ω")
    return 1.0 if radians else 2 * math.pi


def _words(title: str) -> list[str]:
    return [w for w in re.split(r"[^\w°ω]+|_+", title) if w]


def _meaning(title: str) -> tuple[str, str]:
    """Return (channel, part) that a column's title names; part "" is the complex number itself."""
    bracket = re.search(r"[\[(]([^\])]*)[\])]", title)
    outside = title[: bracket.start()] + title[bracket.end() :] if bracket else title
    inside = _words(bracket[1]) if bracket else []
    words = _words(re.sub(r"^(Re|Im)(?=[A-Z])", r"\1 ", outside).replace("|", " "))
    known = [_PARTS[w.lower()] for w in words if w.lower() in _PARTS]
    name = " ".join(w for w in words if w.lower() not in _PARTS)
    if name:
        known += [_PARTS[w.lower()] for w in inside if w.lower() in _PARTS]  # a unit such as [dB]
    else:
        name = " ".join(w for w in inside if w.lower() not in _PARTS)  # re(Zdd)
        known += [_PARTS[w.lower()] for w in inside if w.lower() in _PARTS]
    if "|" in title and not known:
        known = ["mag"]
    for first in ("std", "db", "rad", "deg"):  # the more telling word of several: "mag dB", "phase rad"
        if first in known:
            return name, first
    return name, known[0] if known else ""


def _joined(parts: Mapping[str, Array], name: str, where: str) -> Array:
    """Return the complex numbers of a channel from its columns."""
    have = set(parts) - {"std"}
    phase = next((p for p in ("deg", "rad") if p in have), None)
    size = next((p for p in ("mag", "db") if p in have), None)
    if have == {""} and np.iscomplexobj(parts[""]) and (parts[""].imag != 0).any():
        return parts[""]
    if have == {"re", "im"}:
        return np.asarray(parts["re"].real + 1j * parts["im"].real)
    if size and phase and len(have) == 2:
        modulus = parts["mag"].real if size == "mag" else 10 ** (parts["db"].real / 20)
        angle = parts["rad"].real if phase == "rad" else np.radians(parts["deg"].real)
        return np.asarray(modulus * np.exp(1j * angle))
    raise WaveformError(
        f"the columns of channel '{name}' do not make complex numbers"
        if name
        else "the columns make no complex numbers",
        where=where,
        expected='text such as 1.2-0.3j, or columns re and im, or mag (or dB) and phase (titles such as "Zdd_re")',
        got=", ".join(sorted(p or "plain numbers" for p in have)) or "only std",
    )


def _cell(text: str, separator: str, where: str) -> complex:
    number = _complex(text, separator)
    if number is None or not np.isfinite(number):
        raise WaveformError("a cell is no number", where=where, got=repr(text))
    return number


def _complex(text: str, separator: str) -> complex | None:
    """Return the number of a cell: real, or complex as 1.2-0.3j, 1.2 - 0.3i, (1.2-0.3j) or 1.2-j0.3; None where it is none."""
    bare = text.strip().strip("()").replace(" ", "").replace("*", "")
    if separator == ";":
        bare = bare.replace(",", ".")
    bare = re.sub(r"([+-]?)[ij]([\d.]+(?:[eE][+-]?\d+)?)$", r"\1\2j", bare)
    try:
        return complex(re.sub(r"i$", "j", bare))
    except ValueError:
        return None


# --- Touchstone ---


def _touchstone(text: str, ports: int, where: str) -> ResponseFile:
    """Touchstone 1.x: the option line `# unit parameter format R n`; Y and Z are normalised by R there."""
    factor, kind, form, reference = 2 * math.pi * 1e9, "s", "ma", 50.0
    numbers: list[float] = []
    for k, line in enumerate(text.splitlines(), start=1):
        bare = line.split("!")[0].strip()
        if bare.startswith("["):
            raise WaveformError("Touchstone 2 is not read", where=f"{where}, line {k}", hint="save it as version 1")
        if bare.startswith("#"):
            words = bare[1:].lower().split()
            for i, w in enumerate(words):
                if w in _HERTZ:
                    factor = 2 * math.pi * _HERTZ[w]
                elif w in ("s", "y", "z", "g", "h"):
                    kind = w
                elif w in ("db", "ma", "ri"):
                    form = w
                elif w == "r" and i + 1 < len(words):
                    reference = float(words[i + 1])
            continue
        try:
            numbers += [float(w) for w in bare.split()]
        except ValueError:
            raise WaveformError("a cell is no number", where=f"{where}, line {k}", got=bare[:60]) from None
    width = 1 + 2 * ports**2
    if kind in ("g", "h") or not numbers or len(numbers) % width:
        raise WaveformError(
            "the Touchstone file does not fit",
            where=where,
            expected=f"S, Y or Z parameters and {width} numbers a frequency for {ports} ports",
            got=f"{kind.upper()} parameters, {len(numbers)} numbers",
        )
    table = np.array(numbers).reshape(-1, width)
    first, second = table[:, 1::2], table[:, 2::2]
    angle = np.exp(1j * np.radians(second))
    values = first + 1j * second if form == "ri" else (first if form == "ma" else 10 ** (first / 20)) * angle
    matrix = values.reshape(-1, ports, ports)
    if ports == 2:  # the standard's own order: 11 21 12 22
        matrix = np.swapaxes(matrix, 1, 2)
    eye = np.eye(ports)
    if kind == "s":
        matrix = reference * np.linalg.solve(np.swapaxes(eye - matrix, 1, 2), np.swapaxes(eye + matrix, 1, 2)).swapaxes(
            1, 2
        )
    else:
        matrix = matrix * reference if kind == "z" else matrix / reference
    letter = "Y" if kind == "y" else "Z"
    channels = {f"{letter}{i + 1}{j + 1}": matrix[:, i, j] for i in range(ports) for j in range(ports)}
    return ResponseFile(factor * table[:, 0], FrozenMap(channels))


# --- repeated sweeps ---


def _averaged(response: ResponseFile, where: str) -> ResponseFile:
    """Return the response in the order of its frequencies, repeated ones by their mean with the mean's standard deviation."""
    if not (np.isfinite(response.omega).all() and (response.omega >= 0).all()):
        raise WaveformError("a frequency is not a number of at least 0", where=where)
    omega, place, counts = np.unique(response.omega, return_inverse=True, return_counts=True)
    least = int(counts.min())
    channels, std, dof = {}, {}, {}
    for name, values in response.channels.items():
        if not np.isfinite(values).all():
            raise WaveformError("a value is not finite", where=where, got=f"channel '{name}'")
        mean = np.zeros(omega.size, dtype=complex)
        np.add.at(mean, place, values)
        mean /= counts
        channels[name] = mean
        if name in response.std:
            power = np.zeros(omega.size)
            np.add.at(power, place, response.std[name] ** 2)
            std[name] = np.sqrt(power) / counts
        elif (counts > 1).any():
            std[name] = _scatter(values - mean[place], mean, place, counts)
            dof[name] = 2.0 * float((counts - 1).sum())
    return ResponseFile(omega, FrozenMap(channels), FrozenMap(std), least, FrozenMap(dof))


MANY = 10
"""From so many sweeps on each frequency has its own standard deviation: that of so many is good to a sixth."""


def _scatter(deviation: Array, mean: Array, place: Array, counts: Array) -> Array:
    """Return (n,) standard deviation of the mean of repeated sweeps; from few of them one share of the modulus for all frequencies.

    A standard deviation from two or three numbers is too often far too small, and would weigh its frequency too much.
    """
    if counts.min() >= MANY:
        power = np.zeros(mean.size)
        np.add.at(power, place, np.abs(deviation) ** 2)
        return np.asarray(np.sqrt(power / (counts - 1) / counts))
    size = np.maximum(np.abs(mean), 1e-300)
    share = np.sqrt(np.sum(np.abs(deviation / size[place]) ** 2) / (counts - 1).sum())
    return np.asarray(share * size / np.sqrt(counts))
