"""The reference of keys, formats, commands and Python names, as Markdown."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from html import escape
from operator import attrgetter
from pathlib import Path
from typing import Any

import typer
from numpydoc.docscrape import FunctionDoc

import hvdc_ident
from hvdc_ident.cli import app
from hvdc_ident.expression import BLOCKS, FUNCTIONS
from hvdc_ident.fit.likelihood import LOSSES
from hvdc_ident.fit.optimisers import catalogue
from hvdc_ident.formats import formats
from hvdc_ident.study.json_schema import Key
from hvdc_ident.study.json_schema import reference as tables_of

HERE = Path(__file__).resolve().parent
EXAMPLE = re.compile(r"^### (\S+)\n```python\n(.*?)^```$", re.MULTILINE | re.DOTALL)

KINDS = {
    "Models and inputs": "Model Parameter Input load_model apply_effects step ramp multisine InputSignal",
    "Data": "Experiment read_waveforms Trajectory load_study Study new_study check",
    "Simulation and sweeps": "simulate Simulation sweep SweepResult sensitivities linear.linear_sensitivities sensitivity.morris "
    "sensitivity.sobol",
    "Estimation": "identify IdentifiabilityReport fit FitResult",
    "Diagnosis and comparison": "diagnose Diagnosis compare_runs RunComparison",
    "Operating points": "find_operating_point OperatingPoint linear.point_at linear.continuation",
    "Linear models": "linearize LinearModel bode linear.one_sided linear.symbolic_transfer linear.root_locus linear.balanced",
    "Loops and margins": "linear.loop linear.margins linear.loop_margins linear.plant_and_controller linear.ncf_margin",
    "Distances and norms": "linear.compare linear.nu_gap linear.h2_norm linear.hinf_norm linear.linf_norm",
    "Frequency responses": "linear.Port linear.port_impedance linear.port_admittance linear.MeasuredResponse linear.read_response "
    "linear.response_at_tones linear.response_from_record linear.simulated_response",
    "Export": "export __version__",
}


def study_file() -> str:
    """Return the page on every key of a study file."""
    lines = [
        "# Study file",
        "",
        "A study is one TOML file: the model, the parameters to be estimated, the recordings, and a table for each stage that",
        "`hvdc-ident run` is to run. Only `schema` and [model] are required. `hvdc-ident new DIR` writes a commented study and its",
        "[JSON Schema](../schema/study.json), by which editors such as VS Code with Even Better TOML complete and check keys.",
        "",
    ]
    tables = tables_of("study")
    for path, keys in tables.items():
        lines += [*_heading(path, tables), *_table(keys, path or "study"), ""]
        if path == "response.trim":
            lines += ["`trim` in [linearize] has the same keys.", ""]
        if path == "experiment.phasors.voltage":
            lines += ["`current` has the same keys.", ""]
        if path == "fit":
            lines += ["### Optimisers", "", *_catalogue({n: m.SUMMARY for n, m in catalogue().items()}), ""]
            lines += ["### Losses", "", *_catalogue({n: loss.summary for n, loss in LOSSES.items()}), ""]
    return "\n".join(lines)


def model_card() -> str:
    """Return the page on every key of a model card."""
    functions = ", ".join(f"`{name}`" for name in sorted(FUNCTIONS))
    lines = [
        "# Model card",
        "",
        "A model as TOML text: differential equations, named signals and outputs. Expressions are parsed, never executed. An editor",
        "completes and checks keys with the line `#:schema ./schema/model-card.json` at the top of the card; `hvdc-ident new DIR` writes",
        "this [JSON Schema](../schema/model-card.json).",
        "",
        "```toml",
        (HERE / "card.toml").read_text("utf-8").rstrip(),
        "```",
        "",
        "## Expressions",
        "",
        f"Numbers, names of the card, `time`, `pi`, `+ - * / **`, comparisons, and the functions {functions}. `H` of the component `gen` "
        "is `gen.H`.",
        "",
        "| block | value |",
        "|---|---|",
        *(f"| `{name}({', '.join(b.arguments)})` | {_cell(b.summary)} |" for name, b in BLOCKS.items()),
        "",
    ]
    for path, keys in tables_of("model-card").items():
        section = path.removesuffix(".NAME") or "card"
        title = f"## [{section}]" if path else "## Top level"
        lines += [f"{title} {{: #{section} }}", "", *_table(keys, section), ""]
    return "\n".join(lines)


def _heading(path: str, tables: Mapping[str, list[Key]]) -> list[str]:
    """Return the heading of a table as the file writes it: [[...]] where there may be several."""
    if not path:
        return ["## Top level {: #top }", ""]
    outer, _, own = path.rpartition(".")
    is_list = any(k.name == own and k.kind == "list of tables" for k in tables.get(outer, ()))
    depth = "###" if outer else "##"
    return [f"{depth} {f'[[{path}]]' if is_list else f'[{path}]'} {{: #{path.replace('.', '-')} }}", ""]


def _table(keys: list[Key], path: str) -> Iterator[str]:
    yield "| key | meaning |"
    yield "|---|---|"
    for k in keys:
        facts = [k.kind]
        facts += ["required"] if k.required else [f"default `{k.default}`"] if k.default else []
        facts += [f"unit: {k.unit}"] if k.unit else []
        anchor = f'<a id="{path.replace(".", "-")}-{k.name}"></a>'
        meaning = f'{_cell(k.text)}<br><span class="facts">{_cell("; ".join(facts))}</span><br>`{_cell(k.example)}`'
        yield f"| {anchor}`{k.name}` | {meaning} |"


def _cell(text: str) -> str:
    return text.replace("|", "\\|")


def _catalogue(entries: Mapping[str, str]) -> Iterator[str]:
    yield "| name | method |"
    yield "|---|---|"
    yield from (f"| `{name}` | {_cell(text)} |" for name, text in entries.items())


def waveform_formats() -> str:
    """Return the page on the waveform formats."""
    written = [f"{name} ({f.SUFFIXES[0]})" for name, f in formats().items() if hasattr(f, "write")]
    lines = [
        "# Waveform formats",
        "",
        "The format is recognised by the content of a file, not by its ending. `hvdc-ident convert FILE --list TEXT` searches its",
        f"signals, and `--to FILE` writes them: as {' or '.join(['CSV', *written])}.",
        "",
        "| format | endings | what it is |",
        "|---|---|---|",
    ]
    for name, f in formats().items():
        endings = ", ".join(f"`{s}`" for s in f.SUFFIXES)
        lines.append(f"| `{name}` | {endings} | {_cell(f.SUMMARY)} |")
    lines += ["", "In Python: [`read_waveforms`](python.md#read_waveforms).", ""]
    return "\n".join(lines)


def command_line() -> str:
    """Return the page on the commands with their options, and the exit codes."""
    group = typer.main.get_command(app)
    lines = ["# Command line", "", (HERE / "exit-codes.md").read_text("utf-8"), ""]
    context = group.make_context("hvdc-ident", [], resilient_parsing=True)
    for name in group.list_commands(context):  # type: ignore[attr-defined]
        command = group.get_command(context, name)  # type: ignore[attr-defined]
        inner = command.make_context(name, [], parent=context, resilient_parsing=True)
        lines += [f"## {name}", "", "```text", command.get_help(inner).strip(), "```", ""]
    return "\n".join(lines)


def examples() -> dict[str, str]:
    """Return the example of each public name, in the order in which they run."""
    text = (HERE / "examples.md").read_text("utf-8").replace("\\_", "_")
    return dict(EXAMPLE.findall(text))


def python_names() -> str:
    """Return the page on every public name: signature, text and example."""
    shown = examples()
    lines = [
        "# Python interface",
        "",
        "Everything in `hvdc_ident.__all__`, and what specialists use of `hi.linear`. The examples form one session, in the order of",
        "[this list](#session); each is run in the tests. A *model* is a `Model`, the name of a shipped model or a path; *data* are an",
        "`Experiment`, a table or path, or a `Study`.",
        "",
    ]
    for kind, names in KINDS.items():
        links = ", ".join(f"[`{n}`](#{n})" for n in names.split())
        lines += [f"**{kind}**: {links}", ""]
    for kind, names in KINDS.items():
        lines += [f"## {kind}", ""]
        for name in names.split():
            lines += _entry(name, attrgetter(name)(hvdc_ident), shown[name])
    order = ", ".join(f"[`{n}`](#{n})" for n in shown)
    lines += ["## Order of the examples {: #session }", "", order, ""]
    return "\n".join(lines)


def _entry(name: str, thing: Any, example: str) -> Iterator[str]:
    yield f'### <a id="{name}"></a>`{name}`'
    yield ""
    if callable(thing):
        yield from ("```python", signature(name, thing), "```", "")
        yield from (_sections(thing) if inspect.isfunction(thing) else _prose(thing), "")
    else:
        yield from ("The version of the installed package, as text.", "")
    if inspect.isclass(thing):
        yield from _members(thing)
    yield from ("```python", example.rstrip(), "```", "")


def signature(name: str, thing: Any) -> str:
    """Return the call of a public name with its arguments and their types, one to a line where it is long."""
    arguments = []
    star = False
    for p in inspect.signature(thing).parameters.values():
        if p.kind is p.KEYWORD_ONLY and not star:
            arguments.append("*")
        star = star or p.kind in (p.KEYWORD_ONLY, p.VAR_POSITIONAL)
        kind = f": {p.annotation}" if p.annotation is not p.empty else ""
        plain = p.default is p.empty or repr(p.default).startswith("<")
        default = "" if p.default is p.empty else " = ..." if plain else f" = {p.default!r}"
        arguments.append({p.VAR_KEYWORD: "**", p.VAR_POSITIONAL: "*"}.get(p.kind, "") + p.name + kind + default)
    returned = inspect.signature(thing).return_annotation
    arrow = "" if returned in (inspect.Signature.empty, "None", None) else f" -> {returned}"
    line = f"{name}({', '.join(arguments)}){arrow}"
    if len(line) <= 90:
        return line
    return f"{name}(\n" + "".join(f"    {a},\n" for a in arguments) + f"){arrow}"


SECTIONS = ("Parameters", "Returns", "Raises")
"""Sections of a function's docstring that the page shows; the example below them is the page's own."""


def _sections(function: Callable[..., Any]) -> str:
    """Return a docstring in numpydoc's sections as HTML: its text, and a list for each section."""
    doc = FunctionDoc(function)
    parts = [f"<p>{_marked(p)}</p>" for p in _paragraphs([*doc["Summary"], "", *doc["Extended Summary"]])]
    for title in SECTIONS:
        lines = "".join(_line(p.name, p.type, p.desc) for p in doc[title])
        parts.append(f'<p class="section">{title}</p><dl>{lines}</dl>')
    return f'<div class="docstring">{"".join(parts)}<p class="section">Example</p></div>'


def _line(name: str, kind: str, text: Sequence[str]) -> str:
    """Return an argument with its type and meaning; a result or an error has a type alone."""
    facts = f'<span class="facts">{_marked(kind)}</span>' if name and kind else ""
    meaning = "".join(f"<p>{_marked(p)}</p>" for p in _paragraphs(text))
    return f"<dt><code>{escape(name or kind)}</code>{facts}</dt><dd>{meaning}</dd>"


def _prose(thing: Any) -> str:
    """Return the paragraphs of a docstring in prose as HTML, without examples; an explanation of a field begins a line."""
    any_name = "|".join(sorted(map(re.escape, inspect.signature(thing).parameters), key=len, reverse=True)) or "(?!)"
    explained = re.compile(rf"(^|(?<=[.;)]\s))((?:{any_name})(?:, (?:{any_name}))*):(?=\s)")
    paragraphs = _paragraphs((inspect.getdoc(thing) or "").splitlines())
    marked = (_marked(p) for p in paragraphs if ">>>" not in p)
    lines = (re.sub(r"^<br>", "", explained.sub(r"<br><b>\2</b>:", p)) for p in marked)
    return '<div class="docstring">' + "".join(f"<p>{p}</p>" for p in lines) + "</div>"


def _paragraphs(lines: Sequence[str]) -> list[str]:
    return [p for p in re.split(r"\n\s*\n", "\n".join(lines).strip()) if p]


def _marked(text: str) -> str:
    """Return a paragraph of a docstring as HTML: its text is not Markdown, but for code."""
    return re.sub(r"`([^`]+)`", r"<code>\1</code>", escape(" ".join(text.split()), quote=False))


def _members(kind: type) -> Iterator[str]:
    """Yield a table of the public methods and properties of a class, with the first line of each."""
    rows = []
    for name in sorted(dir(kind)):
        doc = inspect.getdoc(getattr(kind, name, None)) or ""
        member = inspect.getattr_static(kind, name)  # a method that is bound when it is asked for is there by now
        if name.startswith("_") or (
            not isinstance(member, property | classmethod | staticmethod) and not callable(member)
        ):
            continue
        call = "" if isinstance(member, property) else "()"
        rows.append(f"| `{name}{call}` | {_cell(escape(doc.splitlines()[0] if doc else '', quote=False))} |")
    if rows:
        yield from ("| member | gives |", "|---|---|", *rows, "")
