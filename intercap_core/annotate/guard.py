"""Who may talk to the page's server: a browser that came by the address with the token.

Login nodes are shared: other users reach the loopback's ports, and a page of the web can send
requests to them from the annotator's own browser. So the token goes with each request in a header,
which no other page can set; requests that name another host, or come from another origin, are
refused.
"""

from __future__ import annotations

import secrets
from collections.abc import Awaitable, Callable, MutableMapping
from typing import Any
from urllib.parse import urlsplit

TOKEN_HEADER = "x-intercap-token"
HOSTS = ("127.0.0.1", "localhost", "::1")  # any port: a tunnel's own end may have another
MAX_BODY = 1 << 20
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; "
    "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
_HEADERS = (
    (b"content-security-policy", POLICY.encode()),
    (b"x-content-type-options", b"nosniff"),
    (b"referrer-policy", b"no-referrer"),
    (b"cross-origin-resource-policy", b"same-origin"),
    (b"cross-origin-opener-policy", b"same-origin"),
)
Scope = MutableMapping[str, Any]
Message = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[Message]]
Send = Callable[[Message], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]


class Guard:
    """Refuses what does not come from the page, and adds the headers that bind the page itself."""

    def __init__(self, app: App, token: str) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one request, as ASGI has it."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return
        headers = {
            key.decode("latin-1"): value.decode("latin-1") for key, value in scope["headers"]
        }
        fault = refusal(scope["method"], scope["path"], headers, self._token)
        if fault is not None:
            await _refuse(send, *fault)
            return

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *_HEADERS]
            await send(message)

        await self._app(scope, receive, sent)


def refusal(method: str, path: str, headers: dict[str, str], token: str) -> tuple[int, str] | None:
    """Status and reason for which a request is refused, None = it is answered."""
    host = headers.get("host", "")
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:
        name = None
    if name not in HOSTS:
        return 400, "this server answers on the loopback alone: use 127.0.0.1 or localhost"
    origin = headers.get("origin")
    if origin is not None and origin != f"http://{host}":
        return 403, "the request comes from another page"
    if not path.startswith("/api/"):
        return None if method in ("GET", "HEAD") else (405, "only what is under /api/ is changed")
    if headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return 403, "the request comes from another page"
    given = headers.get(TOKEN_HEADER, "")
    if not secrets.compare_digest(given.encode(), token.encode()):
        return 401, "the token is missing or another one: open the address that was printed"
    if method not in ("GET", "HEAD"):
        if origin is None:
            return 403, "the request does not say which page it comes from"
        length = headers.get("content-length", "")
        if not length.isdigit() or int(length) > MAX_BODY:
            return 413, f"a request holds at most {MAX_BODY} bytes"
    return None


async def _refuse(send: Send, status: int, reason: str) -> None:
    headers = [(b"content-type", b"text/plain; charset=utf-8"), *_HEADERS]
    await send({"type": "http.response.start", "status": status, "headers": headers})
    await send({"type": "http.response.body", "body": f"{reason}\n".encode()})
