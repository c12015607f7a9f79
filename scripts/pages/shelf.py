"""The page of the shelf: every standard component with its signal flow, parameters and equations."""

from __future__ import annotations

import math

from hvdc_ident.expression import to_text
from hvdc_ident.model import Model, read_card
from hvdc_ident.shelf import card_of, components, record_of
from pages.diagram import diagram


def page() -> str:
    """Return the page."""
    lines = [
        "# Standard components",
        "",
        "Components of plants, each a model card with the names of its standard. `[components.NAME]` of a card takes one by",
        "`source`; a unit of a `.dyr` file is put together from them, and the shipped phasor links from those that begin with `vsc-`.",
        "`H` of the component `gen` is `gen.H`, or what [`names`](model-card.md#components-names) say. Parameters that a record of PSS/E",
        "has stand in its order.",
        "",
        "| component | |",
        "|---|---|",
    ]
    models = {name: read_card(card_of(name)) for name in components()}
    lines += [f"| [`{name}`](#{name}) | {_cell(m.description.split('.')[0])} |" for name, m in models.items()]
    for name, model in models.items():
        lines += ["", *_entry(name, model)]
    return "\n".join(lines) + "\n"


def _entry(name: str, model: Model) -> list[str]:
    lines = [f"## `{name}` {{: #{name} }}", "", model.description, ""]
    if model.inputs:  # else it computes parameters from parameters: nothing flows
        caption = f"Signal flow of {name}: ∫ marks a state, dashes lead back"
        lines += [f"<figure>{diagram(model)}<figcaption>{caption}</figcaption></figure>", ""]
    for title, items in (("input", model.inputs), ("output", model.outputs)):
        if not items:
            continue
        lines += [f"| {title} | unit | |", "|---|---|---|"]
        lines += [f"| `{n}` | {q.unit} | {_cell(_about(model, n, q.description))} |" for n, q in items.items()] + [""]
    if model.parameters:
        in_record = record_of(name)
        lines += ["| parameter | typical | bounds | unit | |", "|---|---|---|---|---|"]
        for n, p in model.parameters.items():
            bounds = f"{p.min:g} to {p.max:g}" if math.isfinite(p.min) or math.isfinite(p.max) else ""
            note = "" if not in_record or n in in_record else " (not in the record)"
            lines.append(f"| `{n}` | {p.value:g} | {bounds} | {p.unit} | {_cell(p.description)}{note} |")
        lines.append("")
    equations = [f"{n}' = {to_text(s.derivative)}" for n, s in model.states.items()]
    equations += [f"{n} = {to_text(a.equation)}" for n, a in model.algebraic.items()]
    equations += [f"{n} = {to_text(s.value)}" for n, s in model.signals.items()]
    equations += [f"{n} = {to_text(o.value)}" for n, o in model.outputs.items() if n not in model.names]
    return [*lines, "```text", *equations, "```"]


def _about(model: Model, name: str, description: str) -> str:
    """Return the description of an output, or of the signal that it shows."""
    if description:
        return description
    found = next((getattr(model, s)[name] for s in ("signals", "states") if name in getattr(model, s)), None)
    return found.description if found is not None else ""


def _cell(text: str) -> str:
    return text.replace("|", "\\|")
