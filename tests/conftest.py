"""Settings of all tests: `tests` is importable by its own name, and no property test depends on the clock.

The first holds wherever pytest is started and whichever copy of the package is tested.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from types import ModuleType

from hypothesis import HealthCheck, settings

# One thread of linear algebra a process: several test processes on as many cores hinder each other otherwise.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(name, "1")

tests = ModuleType("tests")
tests.__path__ = [str(Path(__file__).parent)]
sys.modules["tests"] = tests

# The deadline of an example and the health check of slow data measure the machine's load.
settings.register_profile("clockless", deadline=None, suppress_health_check=[HealthCheck.too_slow])
settings.load_profile("clockless")
