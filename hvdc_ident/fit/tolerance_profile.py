"""Tolerance profiles: the windows around an event and the limits of the errors in them, a data file each in `tolerances/`.

Kinds of error and windows after IEC 61400-27-2.
"""

from __future__ import annotations

from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path

from hvdc_ident.errors import StudyError, require_known
from hvdc_ident.immutable import FrozenMap

WINDOWS = ("before", "during", "after")
DEFAULT = "set-point-step-simulation"
FILE_BYTES = 1_000_000  # bytes of a file


@dataclass(frozen=True)
class ToleranceProfile:
    """A tolerance profile.

    windows: lengths in s by name, settling as a share. limits: by window and kind of error, in `unit`.
    version, source, notes: where the numbers come from.
    """

    name: str
    version: str
    title: str
    source: str
    notes: str
    windows: FrozenMap[float]
    limits: FrozenMap[FrozenMap[float]]
    unit: str


def shipped() -> tuple[str, ...]:
    """Return the names of the profiles that come with the package."""
    folder = files("hvdc_ident.fit") / "tolerances"
    return tuple(sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml")))


def tolerance(name: str = DEFAULT, folder: Path | None = None) -> ToleranceProfile:
    """Return the profile of a name, or of a TOML file at a path from `folder`.

    Raises UnknownNameError for a name that is not shipped, StudyError for a file that is missing or wrong.
    """
    if not name.endswith(".toml"):
        require_known("tolerance profile", [name], shipped(), "")
        return _profile((files("hvdc_ident.fit") / "tolerances" / f"{name}.toml").read_bytes(), f"{name}.toml")
    path = (folder or Path()) / name
    try:
        return _profile(path.read_bytes(), name)
    except OSError as e:
        raise StudyError(
            "the tolerance profile cannot be read",
            where=name,
            got=(e.strerror or str(e)).lower(),
            hint=f"one of the shipped profiles: {', '.join(shipped())}",
        ) from None


def _profile(content: bytes, where: str) -> ToleranceProfile:
    from hvdc_ident.fit.tolerance_file import ProfileFile
    from hvdc_ident.toml_tables import decoded, parsed, require_schema, validated

    what = "the tolerance profile"
    table = parsed(decoded(content, what, where, FILE_BYTES, StudyError), what, where, StudyError)
    require_schema(table, 1, what, where, StudyError)
    file = validated(ProfileFile, table, where, StudyError)
    return ToleranceProfile(
        **{k: getattr(file, k) for k in ("name", "version", "title", "source", "notes")},
        windows=FrozenMap(file.windows.model_dump()),
        limits=FrozenMap({n: FrozenMap(getattr(file.limits, n).model_dump()) for n in WINDOWS}),
        unit=file.limits.unit,
    )
