"""The build backend: setuptools, and before it the core in C, for any processor of its kind and for those with AVX2.

Built with the C compiler that is there (`CC`, cc), else with the `ziglang` package, which is asked for only then. A wheel for another
platform is built with zig too, where HVDC_IDENT_PLATFORM names it: HVDC_IDENT_PLATFORM=macosx_11_0_arm64 pip wheel . --no-deps
In a checkout `python build_backend.py` builds the core in place.
"""

from __future__ import annotations

import importlib.util
import os
import platform
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
PLATFORMS = {
    "manylinux2014_x86_64": "x86_64-linux-gnu.2.17",
    "manylinux2014_aarch64": "aarch64-linux-gnu.2.17",
    "macosx_11_0_x86_64": "x86_64-macos.11.0",
    "macosx_11_0_arm64": "aarch64-macos.11.0",
    "win_amd64": "x86_64-windows-gnu",
}
"""The platforms that a wheel can be built for from anywhere, with what zig calls them, and the oldest system of each."""


def asked_platform() -> str | None:
    """Return the platform that HVDC_IDENT_PLATFORM names; None for this machine. Raises ValueError for one that is not known."""
    asked = os.environ.get("HVDC_IDENT_PLATFORM")
    if asked and asked not in PLATFORMS:
        raise ValueError(f"HVDC_IDENT_PLATFORM: expected one of {', '.join(PLATFORMS)}; got {asked}")
    return asked or None


def compiler() -> list[str] | None:
    """Return the command of the C compiler, None where there is none."""
    asked = asked_platform()
    found = None if asked else shutil.which(os.environ.get("CC", "cc"))
    if found:
        return [found]
    if importlib.util.find_spec("ziglang") is None:
        return None
    oldest = [PLATFORMS[asked]] if asked else [t for p, t in PLATFORMS.items() if p == f"manylinux2014_{_machine()}"]
    return [sys.executable, "-m", "ziglang", "cc", *(f"--target={target}" for target in oldest)]


def _machine() -> str:
    return (asked_platform() or platform.machine()).lower()


def build_core() -> None:
    """Compile the core beside its sources. Raises CalledProcessError where the compiler refuses, RuntimeError without one."""
    command = compiler()
    if command is None:
        raise RuntimeError("the core in C needs a compiler: install one (cc), or pip install ziglang")
    builds: dict[str, tuple[str, ...]] = {"baseline": ()}
    if _machine().endswith(("x86_64", "amd64")):
        builds["avx2"] = ("-mavx2", "-mfma")
    for old in CORE.glob("core-*.so.1"):  # of another platform, perhaps
        old.unlink()
    for build, flags in builds.items():
        target = CORE / f"core-{build}.so.1"
        subprocess.run([*command, *FLAGS, *flags, str(CORE / "all.c"), "-o", str(target), "-lm"], check=True)


def get_requires_for_build_wheel(config_settings: Any = None) -> list[str]:
    """Return what a build needs: ziglang where there is no compiler for it."""
    return build_meta.get_requires_for_build_wheel(config_settings) + ([] if compiler() else ["ziglang>=0.13"])


get_requires_for_build_editable = get_requires_for_build_wheel


def build_wheel(wheel_directory: str, config_settings: Any = None, metadata_directory: str | None = None) -> str:
    """Compile the core, and build the wheel, whose name says for which platform it is."""
    build_core()
    # What setuptools has gathered for another platform would be taken along.
    shutil.rmtree(Path(__file__).parent / "build", ignore_errors=True)
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
