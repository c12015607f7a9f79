"""Fig. 9: the error of Irorder1 over KIVDC from 250 to 1500, with likelihood, verdicts and modes.

python studies/figure_9/run.py
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from kivdc_sweep import main as study  # noqa: E402
from kivdc_sweep import tell  # noqa: E402

AT = (250.0, 400.0, 550.0, 850.0, 1200.0, 1500.0)


def main() -> dict[str, Any]:
    """Return the numbers of the README."""
    return study(HERE, "Fig. 9", AT, {})


if __name__ == "__main__":
    tell(HERE, main())
