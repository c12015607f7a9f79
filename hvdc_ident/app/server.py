"""The workbench's server: on this machine alone, at an address with a token, until Ctrl-C."""

from __future__ import annotations

import importlib
import os
import pkgutil
import secrets
import socket
import tempfile
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from typing import TYPE_CHECKING

from hvdc_ident.app.desk import opened
from hvdc_ident.app.guard import LOOPBACK, Guard
from hvdc_ident.app.study_folder import MOST_BYTES
from hvdc_ident.errors import InputError

if TYPE_CHECKING:
    from hvdc_ident.app.page import Tab

RECONNECT = 120.0
"""Seconds for which a page that lost its connection keeps what it shows: a busy machine and a closed lid are no reason to forget."""


def serve(
    source: str | None = None,
    *,
    host: str = "127.0.0.1",
    port: int = 0,
    trust: bool = False,
    ready: Callable[[str], None] = print,
) -> None:
    """Serve the workbench until it is interrupted.

    source: a study file, a recording, a shipped model, a card or an FMU (default: the phasor link). port: 0 for any that is free. trust:
    whether a model that is Python code may be run. ready: called with the address, token included, when the server listens.

    Raises InputError for a source that cannot be opened, a port that is taken, and where the extra `app` is not installed.
    """
    desk = opened(source, trust=trust)
    with tempfile.TemporaryDirectory() as folder:
        # The framework keeps files of its own in the working folder otherwise; the workbench has nothing for them.
        os.environ.setdefault("NICEGUI_STORAGE_PATH", folder)
        try:
            import uvicorn
            from fastapi import FastAPI
            from fastapi.staticfiles import StaticFiles
            from nicegui import ui

            from hvdc_ident.app.page import Page
            from hvdc_ident.app.plot import ASSETS

            tabs()  # what they import is of the extra, too
        except ImportError as error:
            raise InputError(
                "the workbench's framework is not installed",
                where="hvdc-ident app",
                got=str(error),
                hint="pip install 'hvdc_ident[app]'",
            ) from None
        listening = _listening(host, port)
        token = secrets.token_urlsafe(24)
        outer = FastAPI(docs_url=None, redoc_url=None, openapi_url=None)
        outer.mount("/assets", StaticFiles(directory=ASSETS))
        lying = [desk]

        def page() -> None:
            lying[0] = lying[0].renewed()
            Page(lying[0]).build(tabs())

        ui.run_with(
            outer,
            root=page,
            reconnect_timeout=RECONNECT,
            title=f"{desk.title} · hvdc-ident",
            dark=None,
            show_welcome_message=False,
        )
        here = (*LOOPBACK, host)
        server = uvicorn.Server(
            uvicorn.Config(
                Guard(outer, token, here, MOST_BYTES),
                log_level="warning",
                timeout_graceful_shutdown=1,
                ws_per_message_deflate=False,
            )
        )
        ready(f"http://{host}:{listening.getsockname()[1]}/?token={token}")
        with suppress(KeyboardInterrupt):  # the way in which it is meant to end
            server.run(sockets=[listening])


def _listening(host: str, port: int) -> socket.socket:
    listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen()  # who opens the address at once waits, and is not refused
    except OSError as error:
        listener.close()
        raise InputError(
            "the server cannot listen there",
            where=f"{host}, port {port}",
            got=error.strerror or str(error),
            hint="--port 0 takes any that is free",
        ) from None
    return listener


@cache
def tabs() -> tuple[Tab, ...]:
    """Return every tab, in order, found by walking `tabs/`."""
    from hvdc_ident.app import tabs as folder

    every = [importlib.import_module(f"{folder.__name__}.{m.name}").TAB for m in pkgutil.iter_modules(folder.__path__)]
    return tuple(sorted(every, key=lambda t: t.order))
