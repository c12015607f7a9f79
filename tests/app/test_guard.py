"""Who has no token, or comes from elsewhere, gets nothing of the workbench."""

from __future__ import annotations

import asyncio
from typing import Any

import pytest

from hvdc_ident.app.guard import Guard

TOKEN = "a-token"
COOKIE = f"hvdc_ident_8000={TOKEN}"
HOST = "127.0.0.1:8000"


def asked(kind: str = "http", path: str = "/", query: str = "", method: str = "GET", **headers: str) -> dict[str, Any]:
    """Return how a request is answered: inside True where it reached the workbench, and the messages sent otherwise."""
    answer: dict[str, Any] = {"inside": False, "sent": []}

    async def inner(scope: Any, receive: Any, send: Any) -> None:
        answer["inside"] = True

    async def receive() -> Any:
        return {"type": "websocket.connect"}

    async def send(message: Any) -> None:
        answer["sent"].append(message)

    lines = [(k.replace("_", "-").encode(), v.encode()) for k, v in {"host": HOST, **headers}.items()]
    scope = {"type": kind, "path": path, "query_string": query.encode(), "headers": lines, "method": method}
    asyncio.run(Guard(inner, TOKEN)(scope, receive, send))
    return answer


def refused(answer: dict[str, Any]) -> bool:
    first = answer["sent"][0] if answer["sent"] else {}
    return not answer["inside"] and (first.get("status") == 403 or first.get("type") == "websocket.close")


def test_the_address_with_the_token_gives_a_cookie_and_the_address_without_it() -> None:
    answer = asked(query=f"token={TOKEN}")
    start = answer["sent"][0]
    headers = dict(start["headers"])
    assert not answer["inside"] and start["status"] == 303 and headers[b"location"] == b"/"
    cookie = headers[b"set-cookie"].decode()
    assert cookie.startswith(COOKIE) and "HttpOnly" in cookie and "SameSite=Strict" in cookie


@pytest.mark.parametrize("kind", ["http", "websocket"])
def test_the_cookie_opens_the_door(kind: str) -> None:
    assert asked(kind, path="/anything", cookie=COOKIE)["inside"]
    assert asked(kind, cookie=f"other=1; {COOKIE}", origin=f"http://{HOST}")["inside"]


@pytest.mark.parametrize("kind", ["http", "websocket"])
@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"cookie": "hvdc_ident_8000=another"},
        {"cookie": f"hvdc_ident_9000={TOKEN}"},
        {"cookie": COOKIE, "origin": "http://elsewhere.example"},
        {"cookie": COOKIE, "origin": "http://127.0.0.1:9999"},
        {"cookie": COOKIE, "origin": "null"},
        {"cookie": COOKIE, "host": "elsewhere.example:8000"},
        {"cookie": COOKIE, "host": ""},
    ],
)
def test_everything_else_is_refused(kind: str, headers: dict[str, str]) -> None:
    assert refused(asked(kind, **headers))


def test_a_wrong_token_and_one_that_is_posted_are_refused() -> None:
    assert refused(asked(query="token=wrong"))
    assert refused(asked(query=f"token={TOKEN}", method="POST"))
    assert refused(asked("websocket", query=f"token={TOKEN}"))
    assert refused(asked(query=f"token={TOKEN}", host="elsewhere.example:8000"))


@pytest.mark.parametrize(
    ("headers", "inside"),
    [
        ({"content_length": "1048576"}, True),
        ({"content_length": "1048577"}, False),
        ({"content_length": "-1"}, False),
        ({"transfer_encoding": "chunked"}, False),
    ],
)
def test_an_upload_has_a_limit_and_states_its_size(headers: dict[str, str], inside: bool) -> None:
    answer = asked(method="POST", path="/upload", cookie=COOKIE, **headers)
    assert answer["inside"] is inside
    assert inside or answer["sent"][0]["status"] == 413
