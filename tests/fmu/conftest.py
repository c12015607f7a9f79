"""FMUs that many tests share, built once."""

from __future__ import annotations

import pytest

from hvdc_ident.fmu import Limits, read_fmu
from tests.fmu.c_fmu import COMPILER, build


@pytest.fixture(scope="module")
def fmu(tmp_path_factory):
    """load(model, version=2, interface=None, limits=None): the model of an FMU written in C, loaded once a file of tests."""
    if COMPILER is None:
        pytest.skip("no C compiler here: FMUs written in C cannot be built")
    folder, kept = tmp_path_factory.mktemp("fmus"), {}

    def load(model, version=2, interface=None, limits=None):
        key = (model.name, version, interface, limits)
        if key not in kept:
            kept[key] = read_fmu(build(model, folder, version), interface=interface, limits=limits or Limits())
        return kept[key]

    yield load
    for model in kept.values():
        model.pool.close()
