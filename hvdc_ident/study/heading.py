"""The heading of every JSON that a study gives."""

from __future__ import annotations

from importlib import metadata
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hvdc_ident.study.study import Study

SCHEMA = 1


def heading_of(study: Study, seed: int) -> dict[str, Any]:
    """Return the heading of every JSON: schema, study, model, software, seed, and the hashes of the files read."""
    return {
        "schema": SCHEMA,
        "study": study.name,
        "model": study.model.name,
        "software": f"hvdc_ident {version()}",
        "seed": seed,
        "sources": dict(study.sources),
    }


def version() -> str:
    """Return the version of the installed package, or "0+unknown"."""
    try:
        return metadata.version("hvdc_ident")
    except metadata.PackageNotFoundError:
        return "0+unknown"
