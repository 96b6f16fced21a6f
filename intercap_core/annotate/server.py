"""HTTP server of the annotation page, and its protection.

On shared login nodes, other users can reach ports of the loopback address, and web pages can send
requests to them from the annotator's browser. Each request therefore carries a token in a header,
which other pages cannot set. Requests to another host or from another origin are refused.
"""

from __future__ import annotations

import asyncio
import base64
import json
import secrets
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

from starlette.applications import Starlette
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import Headers
from starlette.exceptions import HTTPException
from starlette.middleware import Middleware
from starlette.middleware.gzip import GZipMiddleware
from starlette.requests import Request
from starlette.responses import FileResponse, JSONResponse, PlainTextResponse, Response
from starlette.routing import Mount, Route
from starlette.staticfiles import StaticFiles
from starlette.types import ASGIApp, Message, Receive, Scope, Send
from uvicorn.protocols.http.h11_impl import H11Protocol

from intercap_core.annotate import document, result, sides
from intercap_core.annotate.annotator import Annotator
from intercap_core.annotate.opened import Opened, read_jpeg
from intercap_core.errors import UserError
from intercap_core.output.viewer.page import DATA as VIEWER

PAGE = Path(__file__).parent / "page"
# Headers of addresses that contain a stamp
_CACHED = {"cache-control": "private, max-age=86400, immutable"}


def application(annotator: Annotator, token: str) -> ASGIApp:
    """Return the server of a project; every request under /api/ must carry the ``token``."""

    def page(_: Request) -> Response:
        return FileResponse(PAGE / "index.html", headers={"cache-control": "no-cache"})

    def image(request: Request) -> Response:
        at = request.path_params
        width = int(request.query_params.get("width", "0") or 0)
        opened = annotator.opened(at["name"])
        data = read_jpeg(opened, at["camera"], at["frame"], width or 1 << 20)
        if data is None:
            raise HTTPException(404, "there is no image")
        kind = "image/png" if data[:4] == b"\x89PNG" else "image/jpeg"
        return Response(data, media_type=kind, headers=_CACHED)

    def arrays(make: Callable[[Opened], str]) -> Callable[[Request], Response]:
        def endpoint(request: Request) -> Response:
            version = request.query_params.get("version", "now")
            data = base64.b64decode(make(annotator.opened(request.path_params["name"], version)))
            return Response(data, media_type="application/octet-stream", headers=_CACHED)

        return endpoint

    def read(function: Callable[[str], Any]) -> Callable[[Request], Response]:
        def endpoint(request: Request) -> Response:
            name = request.path_params["name"]
            annotator.opened(name)
            return _json(function(name))

        return endpoint

    def change(function: Callable[[str, dict[str, Any]], Any]) -> Callable[..., Any]:
        async def endpoint(request: Request) -> Response:
            name = request.path_params["name"]
            annotator.opened(name)
            try:
                content = json.loads(await request.body())
            except (ValueError, RecursionError):
                content = None
            if not isinstance(content, dict):
                raise HTTPException(400, "expected a JSON object")
            return _json(await run_in_threadpool(function, name, content))

        return endpoint

    of = "/api/sequences/{name}"
    compressed = [Middleware(GZipMiddleware, compresslevel=6)]
    routes = [
        Route("/", page),
        Route("/sequence/{name}", page),
        Mount("/page", GZipMiddleware(StaticFiles(directory=PAGE), compresslevel=6)),
        Mount("/viewer", GZipMiddleware(StaticFiles(directory=VIEWER), compresslevel=6)),
        Route("/api/sequences", lambda _: _json(annotator.sequences()), middleware=compressed),
        Route(of, read(annotator.sequence), middleware=compressed),
        Route(f"{of}/annotation", read(annotator.annotation)),
        Route(f"{of}/state", read(annotator.state)),
        Route(f"{of}/questions", read(annotator.questions)),
        Route(f"{of}/run", read(annotator.run_state), methods=["GET"]),
        Route(f"{of}/comparison", read(annotator.compare)),
        Route(f"{of}/surface", read(annotator.read_surface), methods=["GET"]),
        Route(f"{of}/symmetry", read(annotator.read_symmetry), methods=["GET"]),
        Route(f"{of}/image/{{camera}}/{{frame:int}}", image),
        Route(f"{of}/viewer", arrays(result.viewer_payload)),
        Route(f"{of}/object", arrays(result.object_payload)),
        Route(f"{of}/sides", arrays(sides.sides_payload)),
        *(
            Route(f"{of}/{verb}", change(getattr(annotator, verb)), methods=["POST"])
            for verb in ("check", "save", "answer", "snap", "point", "surface", "symmetry", "run")
        ),
    ]
    handlers: Any = {
        document.Changed: lambda _, error: _json(error.to_json(), 409),
        UserError: lambda _, error: _json({"error": str(error)}, 422),
        HTTPException: lambda _, error: _json({"error": error.detail}, error.status_code),
        KeyError: lambda _, error: _json({"error": f"{error} is missing"}, 400),
        ValueError: lambda _, error: _json({"error": f"not a number: {error}"}, 400),
        OSError: lambda _, error: _json({"error": str(error)}, 500),
        Exception: lambda _, error: _json({"error": f"unexpected {type(error).__name__}"}, 500),
    }
    return Guard(Starlette(routes=routes, exception_handlers=handlers), token)


def _json(value: Any, status: int = 200) -> Response:
    return JSONResponse(value, status, headers={"cache-control": "no-store"})


TOKEN_HEADER = "x-intercap-token"
HOSTS = ("127.0.0.1", "localhost", "::1")  # with any port, as a tunnel may use another
MAX_BODY = 1 << 20  # bytes of a request
MAX_WAITING = 64  # connections without a request; a browser has up to 6
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


class Guard:
    """Refuse requests that do not come from the page; add security headers to responses."""

    def __init__(self, app: ASGIApp, token: str) -> None:
        self._app, self._token = app, token

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Answer one ASGI request."""
        if scope["type"] != "http":
            if scope["type"] == "lifespan":
                await self._app(scope, receive, send)
            return

        async def sent(message: Message) -> None:
            if message["type"] == "http.response.start":
                message["headers"] = [*message.get("headers", []), *_HEADERS]
            await send(message)

        fault = refusal(scope["method"], scope["path"], Headers(scope=scope), self._token)
        refused = None if fault is None else PlainTextResponse(f"{fault[1]}\n", fault[0])
        await (refused or self._app)(scope, receive, sent)


def refusal(
    method: str, path: str, headers: Mapping[str, str], token: str
) -> tuple[int, str] | None:
    """Return status and reason if a request is refused, else None."""
    host = headers.get("host", "")
    try:
        name = urlsplit(f"//{host}").hostname
    except ValueError:
        name = None
    if name not in HOSTS:
        return 400, "this server answers on the loopback address only: use 127.0.0.1 or localhost"
    origin = headers.get("origin")
    if origin is not None and origin != f"http://{host}":
        return 403, "the request comes from another page"
    if not path.startswith("/api/"):
        return (
            None
            if method in ("GET", "HEAD")
            else (405, "only addresses under /api/ accept this method")
        )
    if headers.get("sec-fetch-site", "same-origin") != "same-origin":
        return 403, "the request comes from another page"
    given = headers.get(TOKEN_HEADER, "")
    if not secrets.compare_digest(given.encode(), token.encode()):
        return 401, "the token is missing or wrong: open the address that was printed"
    if method not in ("GET", "HEAD"):
        if origin is None:
            return 403, "the request has no origin"
        length = headers.get("content-length", "")
        if "transfer-encoding" in headers or not length.isdigit() or int(length) > MAX_BODY:
            return 413, f"a request may have at most {MAX_BODY} bytes"
    return None


class LimitedProtocol(H11Protocol):
    """HTTP/1.1 with a limit of the connections that have sent no complete request.

    Above ``MAX_WAITING``, the oldest is closed, so that others on this machine cannot use up the
    server's connections.
    """

    def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]
        super().connection_made(transport)
        self.opened = time.monotonic()
        others = [other for other in self.connections if isinstance(other, LimitedProtocol)]
        waiting = [other for other in others if other.is_waiting()]
        if len(waiting) > MAX_WAITING:
            min(waiting, key=lambda other: other.opened).transport.abort()

    def is_waiting(self) -> bool:
        """Whether the connection is open and has no request that is being answered."""
        answered = self.cycle is None or self.cycle.response_complete
        return answered and not self.transport.is_closing()
