"""Fig. 8: the error of Irorder1 over KIVDC from 550 to 950, with likelihood, verdicts and modes.

python studies/figure_8/run.py
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

HERE = Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent))
from kivdc_sweep import main as study  # noqa: E402
from kivdc_sweep import tell  # noqa: E402

AT = (550.0, 780.0, 815.0, 850.0, 950.0)
PAPER = {550.0: 0.0053, 780.0: 0.0033, 850.0: 0.0033, 950.0: 0.0036}


def main() -> dict[str, Any]:
    """Return the numbers of the README."""
    return study(HERE, "Fig. 8", AT, PAPER)


if __name__ == "__main__":
    tell(HERE, main())
