"""Models that pass signals to an FMU and from it, with the effects in them: u0, u1 ... come in, y0, y1 ... go out."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, Literal

from hvdc_ident.effects import EffectUse, effects, joined
from hvdc_ident.effects.placing import apply
from hvdc_ident.errors import InputError, ModelError, unknown_name
from hvdc_ident.expression import parse, symbol
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import Model, Output
from hvdc_ident.parameters import Input, Parameter

if TYPE_CHECKING:
    from hvdc_ident.fmu.model import FmuModel

End = Literal["input", "output"]
ALONG = "share_of_the_direction"
"""Parameter by which the FMU's outputs move along signals s0, s1 ...: its sensitivity passes theirs through the effects."""
NAME = re.compile(r"[A-Za-z_]\w*")


def end_of(model: FmuModel, place: str) -> tuple[End, int] | None:
    """On which side a slot lies and its number there; None for what is no slot."""
    name = place.removeprefix("outputs.")
    if place in model.inputs:
        return "input", list(model.inputs).index(place)
    return ("output", list(model.outputs).index(name)) if name in model.outputs else None


def entrance(model: FmuModel) -> Model:
    """Inputs u0, u1 ... that come out as y0, y1 ... after the effects at the FMU's inputs."""
    return _passage(len(model.inputs), _at(model, "input"), tuple(i.value for i in model.inputs.values()), False)


def exit_(model: FmuModel, *, along: bool = False) -> Model:
    """The FMU's outputs as u0, u1 ... that come out as y0, y1 ... after the effects at them.

    along: with inputs s0, s1 ... too, of which ALONG times are added to the outputs.
    """
    return _passage(len(model.outputs), _at(model, "output"), (0.0,) * len(model.outputs), along)


def added(model: FmuModel, use: EffectUse) -> dict[str, Parameter]:
    """The parameters that an effect brings; none where it is neutral.

    Raises UnknownNameError or ModelError where it cannot sit there: at what is no end, or reading what it cannot see.
    """
    _check(model, use)
    trial = replace(model, effects=(*model.effects, use))
    try:
        sides = entrance(trial), exit_(trial)
    except InputError as e:
        raise _in_own_names(model, use, e) from None
    return {n: p for side in sides for n, p in side.parameters.items() if n not in model.parameters}


def _check(model: FmuModel, use: EffectUse) -> None:
    """Check an effect; raises what `added` says of places, of the signal brought in, and of parameters that are given by name."""
    where = f"effect '{use.effect}' at {', '.join(use.at)}"
    for place in use.at:
        if end_of(model, place) is None:
            raise unknown_name("slot", place, model.slots, where=f"model '{model.name}', which is closed inside")
    for name, value in use.parameters.items():
        if isinstance(value, str):
            raise ModelError(
                "an effect at an end of an FMU cannot share a parameter with what is inside",
                where=f"{where}, parameter '{name}'",
                expected="a number",
                got=repr(value),
            )
    brought = use.sources
    read = []
    if use.expression:
        names = {s.name for s in parse(use.expression, where=f"{where}, expression").free_symbols}
        read = sorted(names - use.parameters.keys() - {"time"})
    for k, place in enumerate(use.at):
        for name, key in [*((n, "from") for n in brought[k : k + 1]), *((n, "expression") for n in read)]:
            _check_reading(model, place, name, f"{where}, {key}")


def _check_reading(model: FmuModel, place: str, name: str, where: str) -> None:
    """Raise where an effect at a place cannot see a signal."""
    here, there = end_of(model, place), end_of(model, name)
    assert here is not None
    if there is None:
        known = model.inputs if here[0] == "input" else [s for s in model.slots if s not in model.inputs]
        raise unknown_name("signal", name, known, where=f"{where} (the model is closed inside)")
    if here[0] == there[0]:
        return
    if here[0] == "input":
        raise ModelError(
            f"an effect at an input that reads the output '{name}' would close a loop around the FMU",
            where=where,
            expected=f"one of its inputs: {', '.join(model.inputs)}",
            hint="put the loop into the model before it becomes an FMU",
        )
    outputs = ", ".join(model.outputs)
    raise ModelError(
        f"an effect at an output cannot read the input '{name}'", where=where, expected=f"one of its outputs: {outputs}"
    )


def _at(model: FmuModel, end: End) -> tuple[EffectUse, ...]:
    """The effects with those of their places that lie at one end, in the passage's names."""
    found = []
    for use in model.effects:
        ends = [end_of(model, p) for p in use.at]
        here = [k for k, e in enumerate(ends) if e is not None and e[0] == end]
        places = [e for k in here if (e := ends[k]) is not None]
        letter = "u" if end == "input" else "y"
        if places:
            read = [e for k in here if use.source and (e := end_of(model, use.sources[k])) is not None]
            found.append(
                replace(
                    use,
                    at=tuple(f"{letter}{k}" for _, k in places),
                    source=joined(f"{letter}{k}" for _, k in read),
                    expression=_renamed(model, use),
                )
            )
    return tuple(found)


def _renamed(model: FmuModel, use: EffectUse) -> str:
    """A term's expression with the FMU's inputs, or its outputs as they come out of it, under the passage's names."""

    def name(match: re.Match[str]) -> str:
        word = match.group()
        place = None if word in use.parameters else end_of(model, word)
        return f"u{place[1]}" if place else word

    return NAME.sub(name, use.expression)


@lru_cache(maxsize=64)
def _passage(count: int, uses: tuple[EffectUse, ...], values: Sequence[float], along: bool) -> Model:
    inputs = {f"u{k}": Input(v) for k, v in enumerate(values)}
    passing = {f"y{k}": symbol(f"u{k}") for k in range(count)}
    if along:
        inputs |= {f"s{k}": Input(0.0) for k in range(count)}
        passing = {n: e + symbol(ALONG) * symbol(f"s{n[1:]}") for n, e in passing.items()}
    model = Model(
        name="ends",
        parameters=FrozenMap({ALONG: Parameter(0.0, scale=1.0)} if along else {}),
        inputs=FrozenMap(inputs),
        outputs=FrozenMap({n: Output(e) for n, e in passing.items()}),
    )
    for use in uses:
        model = apply(model, use, effects()[use.effect])
    return model


def _in_own_names(model: FmuModel, use: EffectUse, error: InputError) -> InputError:
    """The error with the FMU's names in the place of the passage's."""
    outputs = any((e := end_of(model, p)) is not None and e[0] == "output" for p in use.at)
    names = list(model.outputs if outputs else model.inputs)

    def own(text: str) -> str:
        return re.sub(r"\b[uy](\d+)\b", lambda m: names[int(m[1])] if int(m[1]) < len(names) else str(m[0]), text)

    parts = {k: own(getattr(error, k)) for k in ("where", "expected", "got", "hint")}
    return type(error)(own(error.what), **parts)
