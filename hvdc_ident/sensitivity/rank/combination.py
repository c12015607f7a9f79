"""What is seen of parameters that cannot be told apart, as a value and in words."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True)
class Combination:
    """Parameters that only together are seen.

    members: their names. seen: the combinations that hold all that is seen of them; empty where none is simple, or where
    nothing is seen of them at all. words: the sentence for the report. free: how many of the members can be given any
    value, the others then following. directions: (free, members) null directions at the model's values, the largest entry
    1: of the relative changes where `relative`, else of the changes themselves; empty where they are not known.
    """

    members: tuple[str, ...]
    seen: tuple[str, ...]
    words: str
    free: int
    directions: tuple[tuple[float, ...], ...] = ()
    relative: bool = False

    def to_dict(self) -> dict[str, Any]:
        """The combination as plain values."""
        return {
            "members": list(self.members),
            "seen": list(self.seen),
            "words": self.words,
            "free": self.free,
            "directions": [list(d) for d in self.directions],
            "relative": self.relative,
        }


def tied(names: Sequence[str], free: int) -> str:
    """The plain sentence for parameters whose combinations have no simple form."""
    k = len(names) - free
    number = "one combination" if k == 1 else f"{k} combinations"
    return f"only {number} of {listed(names)} {'is' if k == 1 else 'are'} seen"


def listed(words: Sequence[str]) -> str:
    """The words as a list in a sentence: a, b and c."""
    return words[0] if len(words) == 1 else f"{', '.join(words[:-1])} and {words[-1]}"
