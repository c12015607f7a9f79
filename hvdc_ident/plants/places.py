"""The signals of a unit's block diagram: what of its insertion points carries a moving quantity to the outputs."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from fnmatch import fnmatchcase

import sympy as sp

from hvdc_ident.expression import at_values, symbol
from hvdc_ident.model import Model, insertion_point, reached


def block_signals(
    model: Model, patterns: Sequence[str], moving: Collection[str], outputs: Collection[str]
) -> tuple[str, ...]:
    """Return the insertion points that one of the patterns matches and that are signals of the block diagram.

    moving: inputs that move; outputs: that are seen. With the parameters at their values, so that the flags choose branches, a signal
    depends on an input that moves or on a state that does, and an output depends on it. It is a quantity: saturation, flags and
    factors, which have no unit, are part of a block. Of two names of one signal, one of which is used by the other alone, the first
    counts: it is the same place.
    """
    diagram = _Diagram(model)
    live = diagram.reached_from(moving) & diagram.leading_to(outputs)
    places = []
    for place in model.insertion_points:
        kind, name = insertion_point(model, place)
        if not any(fnmatchcase(place, p) for p in patterns):
            continue
        if kind == "output":
            if name in outputs:
                places.append(place)
        elif name in live and diagram.unit(name) and not diagram.is_other_name(name, patterns, live):
            places.append(place)
    return tuple(places)


class _Diagram:
    """Dependences of the signals, states and outputs of a model on each other, with the parameters at their values."""

    def __init__(self, model: Model) -> None:
        self._model = model
        known = {symbol(n): sp.Float(p.value) for n, p in model.parameters.items()}
        self._own = {
            **{n: s.value for n, s in model.signals.items()},
            **{n: s.derivative for n, s in model.states.items()},
            **{n: a.equation for n, a in model.algebraic.items()},
        }
        outputs = {n: o.value for n, o in model.outputs.items() if n not in self._own}
        constants: dict[sp.Symbol, sp.Expr] = dict(known)
        size = 0
        while len(constants) > size:  # what is made of constants is one: a flag may hang on several
            size = len(constants)
            self._own = {n: at_values(e, constants) for n, e in self._own.items()}
            constants |= {symbol(n): e for n in model.signals if not (e := self._own[n]).free_symbols}
        self._own |= {n: at_values(e, constants) for n, e in outputs.items()}
        self._uses = {n: {s.name for s in e.free_symbols} for n, e in self._own.items()}

    def reached_from(self, inputs: Iterable[str]) -> set[str]:
        """Return what moves: the inputs, the states with a derivative that is not 0, and what depends on them."""
        states = {n for n in self._model.states if self._own[n] != 0} | set(self._model.algebraic)
        users = self._users()
        return set(
            reached([*inputs, *states], lambda name: [n for n in users.get(name, ()) if n not in self._model.states])
        )

    def leading_to(self, outputs: Iterable[str]) -> set[str]:
        """Return what the outputs depend on."""
        return set(reached(outputs, lambda name: self._uses.get(name, ())))

    def unit(self, name: str) -> str:
        """Return the unit of a signal, a state or an unknown; empty where it has none."""
        for table in (self._model.signals, self._model.states, self._model.algebraic, self._model.inputs):
            if name in table:
                return str(table[name].unit)
        return ""

    def is_other_name(self, name: str, patterns: Sequence[str], live: Collection[str]) -> bool:
        """Return whether a signal is another one of the patterns', which nothing else uses of what is live."""
        source = self._own.get(name)
        if name not in self._model.signals or not isinstance(source, sp.Symbol):
            return False
        known = source.name in self._model.insertion_points and any(fnmatchcase(source.name, p) for p in patterns)
        return known and [n for n in self._users()[source.name] if n in live] == [name]

    def _users(self) -> dict[str, list[str]]:
        users: dict[str, list[str]] = {}
        for n, used in self._uses.items():
            for name in used:
                users.setdefault(name, []).append(n)
        return users
