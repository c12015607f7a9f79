"""The build backend: setuptools, and before it the core in C, for any processor and for those with AVX2.

Built with the C compiler that is there (`CC`, cc), else with the `ziglang` package, which is asked for only then.
In a checkout `python build_backend.py` builds the core in place.
"""

from __future__ import annotations

import importlib.util
import os
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

from setuptools import build_meta

CORE = Path(__file__).parent / "hvdc_ident" / "simulate" / "core"
FLAGS = (
    "-std=c99", "-O3", "-ffp-contract=fast", "-fno-math-errno", "-fno-trapping-math",
    "-fopenmp-simd", '-DINDEPENDENT=_Pragma("omp simd")',
    "-fPIC", "-shared", "-Wall", "-Wextra",
)  # fmt: skip
BUILDS = {"baseline": (), "avx2": ("-mavx2", "-mfma")}
OLDEST = "x86_64-linux-gnu.2.17"
"""The C library that a wheel runs with at least, where zig builds it."""


def compiler() -> list[str] | None:
    """Return the command of the C compiler, None where there is none."""
    found = shutil.which(os.environ.get("CC", "cc"))
    if found:
        return [found]
    return [sys.executable, "-m", "ziglang", "cc", "-target", OLDEST] if importlib.util.find_spec("ziglang") else None


def build_core() -> None:
    """Compile the core beside its sources. Raises CalledProcessError where the compiler refuses, RuntimeError without one."""
    command = compiler()
    if command is None:
        raise RuntimeError("the core in C needs a compiler: install one (cc), or pip install ziglang")
    for build, flags in BUILDS.items():
        target = CORE / f"core-{build}.so.1"
        subprocess.run([*command, *FLAGS, *flags, str(CORE / "all.c"), "-o", str(target), "-lm"], check=True)


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """Return what a build needs: ziglang where there is no compiler."""
    return build_meta.get_requires_for_build_wheel(config_settings) + ([] if compiler() else ["ziglang>=0.13"])


get_requires_for_build_editable = get_requires_for_build_wheel


def build_wheel(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """Compile the core, and build the wheel, whose name says for which platform it is."""
    build_core()
    return build_meta.build_wheel(wheel_directory, config_settings, metadata_directory)


def build_editable(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """Compile the core in place, and build the wheel that points there."""
    build_core()
    return build_meta.build_editable(wheel_directory, config_settings, metadata_directory)


build_sdist = build_meta.build_sdist
get_requires_for_build_sdist = build_meta.get_requires_for_build_sdist
prepare_metadata_for_build_wheel = build_meta.prepare_metadata_for_build_wheel

if __name__ == "__main__":
    build_core()
