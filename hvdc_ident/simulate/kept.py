"""Cache of what is compiled for a model's equations, for every model that has the same."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, TypeVar

from hvdc_ident.model import Model

T = TypeVar("T")


@dataclass(frozen=True, eq=False)
class _Key:
    """Key of the machine code: the equations and the other arguments, not the values of parameters and inputs."""

    model: Model
    others: tuple[Any, ...]

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, _Key) or self.others != other.others:
            return False
        return self.model is other.model or self.model.structure == other.model.structure

    def __hash__(self) -> int:
        return hash((self.model.structure, self.others))


def by_structure(make: Callable[..., T], room: int) -> Callable[..., T]:
    """The maker, called with a model and hashable arguments, with its last `room` results kept."""

    @lru_cache(maxsize=room)
    def kept(key: _Key) -> T:
        return make(key.model, *key.others)

    return lambda model, *others: kept(_Key(model, others))
