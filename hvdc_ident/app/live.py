"""HTML on the page that follows a slider."""

from __future__ import annotations

from nicegui import ui


class Live(ui.element, component="live.js"):  # type: ignore[call-arg]
    """An element whose HTML is replaced without drawing the page anew."""

    def __init__(self) -> None:
        super().__init__()
        self._html = ""
        self.on("ready", lambda: self.put(self._html))

    def put(self, html: str) -> None:
        """Replace what it shows. html: escaped already."""
        self._html = html
        self.run_method("put", html)
