"""Errors of the page's handlers, shown on the page: what nobody expected must not look as if nothing had happened."""

from __future__ import annotations

from nicegui import ui

from hvdc_ident.errors import HvdcIdentError


def show_errors() -> None:
    """Show on the page that is being built what its handlers, timers and background tasks raise, until it is closed there."""
    ui.on_exception(_shown)


def _shown(error: Exception) -> None:
    ui.notify(words_of(error), type="negative", timeout=0, close_button="Close", multi_line=True, position="bottom")


def words_of(error: Exception) -> str:
    """Return an error in words: one of the package's as it stands; of another one its kind, and where to read more."""
    if isinstance(error, HvdcIdentError):
        return str(error)
    text = f"{type(error).__name__}: {error}" if str(error) else type(error).__name__
    return f"The workbench failed, and what was asked for is not done. {text}. Where hvdc-ident app was started stands more."
