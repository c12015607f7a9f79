"""The wheel's name: for any Python 3 on one platform, for it holds the core in C. All else is in pyproject.toml."""

import os

from setuptools import Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel


class WithCore(Distribution):
    """A distribution with machine code."""

    def has_ext_modules(self) -> bool:
        return True


class PlatformWheel(bdist_wheel):
    """A wheel that suits any Python 3, and one platform."""

    def get_tag(self) -> tuple[str, str, str]:
        return "py3", "none", os.environ.get("HVDC_IDENT_PLATFORM") or super().get_tag()[2]


setup(distclass=WithCore, cmdclass={"bdist_wheel": PlatformWheel})
