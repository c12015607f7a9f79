"""What lies on the desk when the workbench opens: a model, a study, or a recording."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import hvdc_ident as hi
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.models import is_shipped
from hvdc_ident.study.measured_responses import port_of

DEFAULT = "vsc-hvdc-link"


@dataclass(frozen=True)
class Desk:
    """title: of the page. model: to explore. study: where one is open. spans: the sliders' ends that the study states.
    ports: at which it asks for impedances, by name."""

    title: str
    model: AnyModel
    study: hi.Study | None = None
    spans: FrozenMap[tuple[float, float]] = field(default_factory=FrozenMap)
    ports: FrozenMap[hi.Port] = field(default_factory=FrozenMap)


def opened(source: str | None = None, *, trust: bool = False) -> Desk:
    """Return the desk with a study file, a model (shipped, card or FMU), or, left out, the phasor link.

    Raises InputError for what is none of these.
    """
    if source is None or is_shipped(source):
        return Desk(source or DEFAULT, hi.load_model(source or DEFAULT))
    path = Path(source)
    if path.suffix == ".toml" and _is_study(path):
        study = hi.load_study(path, trust=trust)
        spans = {n: (p.min, p.max) for n, p in study.candidates.items()}
        asked = study.settings.linearize
        ports = {p.name: port_of(p) for p in asked.port} if asked else {}
        return Desk(study.name, study.model.with_values(study.given), study, FrozenMap(spans), FrozenMap(ports))
    return Desk(path.name, hi.load_model(path, trust=trust))


def _is_study(path: Path) -> bool:
    """Return True for a TOML file with a table [model], which a card has not."""
    import tomllib

    try:
        return isinstance(tomllib.loads(path.read_text("utf-8")).get("model"), dict)
    except (OSError, ValueError):
        return False  # the reader of cards says what is wrong
