"""An immutable mapping that keeps its order, can be hashed and sent to another process; frozen results of parts as one."""

from __future__ import annotations

from collections.abc import ItemsView, Iterable, Iterator, KeysView, Mapping, Sequence, ValuesView
from dataclasses import fields, is_dataclass, replace
from typing import Any, TypeVar, cast

T = TypeVar("T")
V = TypeVar("V")


class FrozenMap(Mapping[str, V]):
    """A read-only `dict` from names to values; equal to any mapping with the same items, hashable if its values are."""

    __slots__ = ("_hash", "_items")

    def __init__(self, items: Mapping[str, V] | Iterable[tuple[str, V]] = ()) -> None:
        self._items: dict[str, V] = dict(items)
        self._hash: int | None = None

    def __getitem__(self, name: str) -> V:
        return self._items[name]

    def __iter__(self) -> Iterator[str]:
        return iter(self._items)

    def __len__(self) -> int:
        return len(self._items)

    def __contains__(self, name: object) -> bool:
        return name in self._items

    # The mixin's methods go through __iter__ and __getitem__ for every item.
    def __eq__(self, other: object) -> bool:
        if isinstance(other, FrozenMap):
            return self is other or self._items == other._items
        return super().__eq__(other)

    def keys(self) -> KeysView[str]:
        return self._items.keys()

    def values(self) -> ValuesView[V]:
        return self._items.values()

    def items(self) -> ItemsView[str, V]:
        return self._items.items()

    def __hash__(self) -> int:
        if self._hash is None:
            self._hash = hash(tuple(self._items.items()))
        return self._hash

    def __repr__(self) -> str:
        return repr(self._items)

    def __or__(self, other: Mapping[str, V]) -> FrozenMap[V]:
        """A copy in which the other's items are added or replace those of the same name."""
        return FrozenMap({**self._items, **other})

    def without(self, *names: str) -> FrozenMap[V]:
        """Return a copy that lacks the names."""
        return FrozenMap({k: v for k, v in self._items.items() if k not in names})

    def __reduce__(self) -> tuple[Any, ...]:
        return FrozenMap, (self._items,)


def joined(parts: Sequence[T]) -> T:
    """Return results of one kind as one.

    A mapping has the items of all, those of one name joined; a tuple or list the items of all, each once; a text those that
    differ, with semicolons between; a flag is true where one is; frozen values are joined field by field. Of anything else the
    first that is not None stands.
    """
    known = [p for p in parts if p is not None]
    if not known:
        return parts[0]
    one: Any = known[0]
    whole: Any = one
    if isinstance(one, Mapping):
        names = dict.fromkeys(n for p in known for n in cast("Mapping[str, Any]", p))
        items = {n: joined([p[n] for p in cast("list[Mapping[str, Any]]", known) if n in p]) for n in names}
        whole = FrozenMap(items) if isinstance(one, FrozenMap) else items
    elif isinstance(one, (tuple, list)):
        whole = type(one)(_each_once([item for p in cast("list[Sequence[Any]]", known) for item in p]))
    elif isinstance(one, str):
        whole = "; ".join(_each_once([p for p in known if p]))
    elif isinstance(one, bool):
        whole = any(known)
    elif is_dataclass(one) and not isinstance(one, type):
        whole = replace(one, **{f.name: joined([getattr(p, f.name) for p in known]) for f in fields(one)})
    return cast("T", whole)


def _each_once(items: Sequence[Any]) -> list[Any]:
    return [item for k, item in enumerate(items) if not any(item is other or item == other for other in items[:k])]
