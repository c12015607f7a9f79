"""One export of each model for all tests, compiled quickly instead of well, and with every warning an error."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path

import pytest

from hvdc_ident.fmu.compile import compiler
from tests.fmu_export import cases, driver


@pytest.fixture(scope="session")
def fmu(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., driver.Exported]:
    """Gives the unpacked FMU of one of the cases by name, and version."""
    if compiler() is None:
        pytest.skip("there is no C compiler: nothing to run")
    folder: Path = tmp_path_factory.mktemp("fmu")

    @cache
    def made(name: str, version: str = "2.0") -> driver.Exported:
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("CFLAGS", "-O0 -Wall -Wextra -pedantic -Werror")
            return driver.exported(getattr(cases, name)(), folder / f"{name}-{version[0]}.fmu", version)

    return made
