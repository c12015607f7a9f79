"""Work on a study in a process of the workbench's own, which tells what happens on stdout in lines of JSON.

A process and not a thread: the page stays alive while it computes, and cancelling ends it at once. It ends with the server
too, even where that is killed, because its stdin closes then. The store keeps what was finished.
"""

from __future__ import annotations

import json
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

EVERYTHING, LETTER = "run", "letter"
"""Names of work beside those of the stages: every stage that the study asks for, and the letter."""
OFTEN = 0.1
"""Seconds between two lines of progress: the eye reads no more."""
GRACE = 3.0
"""Seconds that work may take to end by itself once nobody waits for it; machine code answers no sooner."""

Tell = Callable[[dict[str, Any]], None]


class ToldProgress:
    """Progress that is told as it comes, but not more often than `OFTEN`."""

    def __init__(self, tell: Tell) -> None:
        self._tell, self._last = tell, -OFTEN

    def __call__(self, done: int, total: int, text: str) -> None:
        """Tell that so much is done."""
        now = time.monotonic()
        if now - self._last >= OFTEN:
            self._last = now
            self._tell({"done": done, "total": total, "text": text})


def work(study_file: Path, folder: Path, what: str, trust: bool, tell: Tell) -> str:
    """Do the work and return why it did not come to its end, "" where it did. what: a stage, `EVERYTHING` or `LETTER`.

    Raises as the study's reader, `run_stage`, `run_all` and `letter`.
    """
    from hvdc_ident.study.export import letter
    from hvdc_ident.study.pipeline import run_stage, run_study
    from hvdc_ident.study.stages import StageOptions
    from hvdc_ident.study.study import load_study

    def announce(lines: Sequence[str]) -> None:
        tell({"say": list(lines)})

    options = StageOptions(progress=ToldProgress(tell), announce=announce)
    study = load_study(study_file, trust)
    if what == EVERYTHING:
        done = run_study(study, folder, options)
    elif what == LETTER:
        done = [letter(study, folder, options)[1]]
    else:
        done = [run_stage(study, what, folder, options)]
    return "; ".join(f"{d.stage.name}: {d.failed}" for d in done if d.failed)


def end_with_owner() -> None:
    """Interrupt the work when stdin closes, which it does when the work is cancelled and when its owner ends."""
    sys.stdin.buffer.read()
    os.kill(os.getpid(), signal.SIGINT)
    time.sleep(GRACE)
    os._exit(130)


def main() -> None:
    """Do the work that the arguments name: the study's file, the folder of results, what to do, and 1 to trust its code."""
    from hvdc_ident.errors import HvdcIdentError

    out = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # what a library prints is no line of ours

    def tell(message: dict[str, Any]) -> None:
        out.write(json.dumps(message) + "\n")
        out.flush()

    study_file, folder, what, trust = sys.argv[1:]
    threading.Thread(target=end_with_owner, daemon=True).start()
    try:
        tell({"end": work(Path(study_file), Path(folder), what, trust == "1", tell)})
    except HvdcIdentError as error:
        tell({"end": str(error)})
    except (KeyboardInterrupt, BrokenPipeError):
        sys.exit(130)
    except MemoryError:
        tell({"end": "not enough memory for this study"})


if __name__ == "__main__":
    main()
