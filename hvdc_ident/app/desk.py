"""The desk of the workbench when it opens: a model, a study, or a recording lies on it."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from pathlib import Path

import hvdc_ident as hi
from hvdc_ident.app.study_folder import stamp
from hvdc_ident.errors import InputError
from hvdc_ident.formats import formats, list_signals
from hvdc_ident.immutable import FrozenMap
from hvdc_ident.model import AnyModel
from hvdc_ident.models import is_shipped
from hvdc_ident.study.measured_responses import port_of
from hvdc_ident.study.parse import is_study_file

DEFAULT = "vsc-hvdc-link"


@dataclass(frozen=True)
class Desk:
    """title: of the page. model: to explore. study: where one is open. spans: the sliders' ends that the study states.
    ports: at which it asks for impedances, by name.

    source: of the model, a shipped name or a path. file: the study file, which is made by writing a study where there is none.
    recording: to be mapped, where the desk was opened with one. trust: whether a model that is Python code may be run.
    read_at: the stamp of the study file that was read. why: what is wrong with the study file, where it cannot be read.
    """

    title: str
    model: AnyModel
    study: hi.Study | None = None
    spans: FrozenMap[tuple[float, float]] = field(default_factory=FrozenMap)
    ports: FrozenMap[hi.linear.Port] = field(default_factory=FrozenMap)
    source: str = DEFAULT
    file: Path = Path("study.toml")
    recording: Path | None = None
    trust: bool = False
    read_at: tuple[int, int, int] | None = None
    why: str = ""

    def renewed(self) -> Desk:
        """Return the desk with the study as its file is now; the same where there is none, or one that cannot be read."""
        if stamp(self.file) in (None, self.read_at):
            return self
        try:
            return opened(str(self.file), trust=self.trust)
        except InputError as error:
            return replace(self, why=str(error))  # until it is mended the page shows what it had


def opened(source: str | None = None, *, trust: bool = False) -> Desk:
    """Return the desk with a study file, a recording, a model (shipped, card or FMU), or, left out, the phasor link.

    A recording is mapped to the phasor link until another model is chosen. Raises InputError for what is none of these.
    """
    if source is None or is_shipped(source):
        name = source or DEFAULT
        return Desk(name, hi.load_model(name), source=name, file=_new_file(Path(), name), trust=trust)
    path = Path(source)
    if path.suffix == ".toml" and is_study_file(path):
        read_at = stamp(path)
        study = hi.load_study(path, trust=trust)
        spans = {n: (p.min, p.max) for n, p in study.candidates.items()}
        asked = study.settings.linearize
        ports = {p.name: port_of(p) for p in asked.port} if asked else {}
        return Desk(
            study.name,
            study.model.with_values(study.given),
            study,
            FrozenMap(spans),
            FrozenMap(ports),
            study.settings.model.source,
            path,
            trust=trust,
            read_at=read_at,
        )
    new = _new_file(path.parent, path.stem)
    if path.suffix.lower() in (ending for f in formats().values() for ending in f.SUFFIXES):
        list_signals(path)  # what is wrong with its head is said at once
        return Desk(path.name, hi.load_model(DEFAULT), file=new, recording=path, trust=trust)
    return Desk(path.name, hi.load_model(path, trust=trust), source=str(path), file=new, trust=trust)


def _new_file(folder: Path, name: str) -> Path:
    """Return the path of a study in a folder that does not hold one."""
    number, file = 1, folder / f"{name}-study" / "study.toml"
    while file.parent.exists():
        number += 1
        file = folder / f"{name}-study-{number}" / "study.toml"
    return file
