"""Saying that the integrators are being compiled, where that is so."""

from __future__ import annotations

import sys
from typing import Any

from numba.core.event import Listener


class Announcement(Listener):
    """Says so on stderr when the first compilation starts; loading what is compiled already says nothing."""

    def __init__(self) -> None:
        self._made = False

    def on_start(self, event: Any) -> None:
        """Called by numba where a compilation starts."""
        if not self._made:
            self._made = True
            print(
                "hvdc_ident: compiling the integrators, once for this installation (about half a minute) ...",
                file=sys.stderr,
                flush=True,
            )

    def on_end(self, event: Any) -> None:
        """Called by numba where a compilation ends."""
