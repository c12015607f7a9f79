"""What compiled code takes of numba, llvmlite, NumPy and Python beyond their documented interfaces still is as it was tested."""

from __future__ import annotations

import tomllib
from importlib.metadata import version
from pathlib import Path

import llvmlite.binding as llvm
import numpy as np
import pytest
from numba import cfunc, njit, types

from hvdc_ident.simulate.native import address_of, indices, integers, matrix_of, numbers, table, vector
from hvdc_ident.simulate.object_code import entry
from hvdc_ident.simulate.simd import column_sums, elementwise


@pytest.mark.parametrize("package", ["numba", "llvmlite"])
def test_the_installed_version_is_the_one_that_the_package_asks_for(package):
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    [asked] = [d for d in project["dependencies"] if d.startswith(package)]
    least, below = (tuple(map(int, part.lstrip("<>=").split("."))) for part in asked[len(package) :].split(","))
    assert least <= tuple(map(int, version(package).split(".")[:2])) < below


def test_a_tuple_holds_arrays_where_an_entry_looks_for_them():
    @njit
    def read(a):
        m = matrix_of(a, 2)
        return numbers(a, 0).sum() + integers(a, 1)[1] + m[1, 2] + m.shape[0] * 1000

    arguments = (np.array([0.5, 0.25]), np.array([7, 30], dtype=np.int64), np.arange(6.0).reshape(2, 3))
    assert read(id(arguments)) == 0.75 + 30 + 5.0 + 2000


def test_views_of_an_address_are_the_array_that_lies_there():
    @njit
    def write(a, k):
        v, m, i = vector(address_of(a), 6), table(address_of(a), 2, 3), indices(address_of(k), 2)
        v[1], m[1, 0], i[1] = 10.0, 30.0, 5
        return m[0, 1]

    a, k = np.zeros(6), np.zeros(2, dtype=np.int64)
    assert write(a, k) == 10.0
    assert a.tolist() == [0.0, 10.0, 0.0, 30.0, 0.0, 0.0] and k.tolist() == [0, 5]


def test_loops_by_four_write_what_numpy_does():
    product = elementwise(lambda x, y, s: (x * y + s, abs(x - y)))

    @njit
    def run(x, y, out, e, floors, sums):
        product(8, (address_of(x), address_of(y)), (address_of(out), address_of(out) + 64), (0.5,))
        column_sums(2, 4, address_of(e), address_of(x), address_of(y), address_of(floors), 0.1, address_of(sums))

    x, y, e, floors = np.arange(8.0) - 3.0, np.linspace(0.1, 2.0, 8), np.linspace(1.0, 3.0, 8), np.full(4, 0.2)
    out, sums = np.zeros(16), np.zeros(4)
    run(x, y, out, e, floors, sums)
    assert np.allclose(out, [*(x * y + 0.5), *abs(x - y)], rtol=1e-15)
    shares = e / (np.tile(floors, 2) + 0.1 * np.maximum(abs(x), abs(y)))
    assert np.allclose(sums, (shares**2).reshape(2, 4).sum(axis=0), rtol=1e-14)


def test_the_text_of_a_c_function_defines_its_native_name():
    made = cfunc(types.int64(types.int64), error_model="numpy")(lambda a: a + 1)
    assert f"@{made.native_name}(" in str(made.inspect_llvm())


def test_the_runtime_of_compiled_code_is_known_by_name():
    entry("room")
    assert all(llvm.address_of_symbol(name) for name in ("NRT_Allocate", "NRT_Free", "numba_ez_gelsd"))
