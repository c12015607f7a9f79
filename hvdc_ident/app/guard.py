"""The door of the workbench's server: who has no token, or comes from another page or by another name, gets nothing."""

from __future__ import annotations

import hmac
from collections.abc import Awaitable, Callable, Mapping, MutableMapping
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
Application = Callable[[Scope, Receive, Send], Awaitable[None]]

LOOPBACK = ("127.0.0.1", "localhost", "[::1]")
REFUSED = b"hvdc-ident: wrong or missing token. Open the address that `hvdc-ident app` printed."
TOO_LARGE = b"hvdc-ident: the upload is too large, or does not state its size. Put the file into the study's folder and choose it there."


class Guard:
    """An ASGI application around another that lets requests through which carry the token, and no body beyond `most` bytes.

    The address with the token is answered by a cookie that pages of other sites do not send, and by the address without
    it, so that it stands in no history of links. The host has to be a name of this machine that was asked for, lest a
    foreign name that points here (DNS rebinding) reads the page; an origin, where one is told, has to be the page's own.
    """

    def __init__(self, inner: Application, token: str, hosts: tuple[str, ...] = LOOPBACK, most: int = 1024**2) -> None:
        self._inner, self._token, self._hosts, self._most = inner, token, hosts, most

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer a request, or hand it on."""
        if scope["type"] not in ("http", "websocket"):
            return await self._inner(scope, receive, send)
        headers = {k.decode("latin-1").lower(): v.decode("latin-1") for k, v in scope["headers"]}
        host = headers.get("host", "")
        own = _without_port(host) in self._hosts
        origin = headers.get("origin")
        if not own or (origin is not None and urlsplit(origin).netloc != host):
            return await _refuse(scope, receive, send)
        name = f"hvdc_ident_{host.rpartition(':')[2]}"
        if self._is_token(_cookie(headers.get("cookie", ""), name)):
            if not self._is_short(headers):
                return await _refuse(scope, receive, send, 413, TOO_LARGE)
            return await self._inner(scope, receive, send)
        given = parse_qs(scope.get("query_string", b"").decode("latin-1")).get("token", [""])[0]
        if scope["type"] == "http" and scope["method"] == "GET" and self._is_token(given):
            cookie = f"{name}={self._token}; HttpOnly; SameSite=Strict; Path=/"
            there = [(b"location", scope["path"].encode()), (b"set-cookie", cookie.encode())]
            await send({"type": "http.response.start", "status": 303, "headers": there})
            return await send({"type": "http.response.body", "body": b""})
        return await _refuse(scope, receive, send)

    def _is_short(self, headers: Mapping[str, str]) -> bool:
        """Return whether the body is stated to be short enough; the server below reads no more than what is stated."""
        length = headers.get("content-length", "0")
        return length.isdigit() and int(length) <= self._most and "transfer-encoding" not in headers

    def _is_token(self, given: str) -> bool:
        return hmac.compare_digest(given.encode(), self._token.encode())


def _without_port(host: str) -> str:
    name, colon, port = host.rpartition(":")
    return name if colon and port.isdigit() else host


def _cookie(text: str, name: str) -> str:
    try:
        return SimpleCookie(text)[name].value
    except (CookieError, KeyError):
        return ""


async def _refuse(scope: Scope, receive: Receive, send: Send, status: int = 403, why: bytes = REFUSED) -> None:
    if scope["type"] == "websocket":
        await receive()
        return await send({"type": "websocket.close", "code": 1008})
    headers = [(b"content-type", b"text/plain; charset=utf-8")]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    return await send({"type": "http.response.body", "body": why})
