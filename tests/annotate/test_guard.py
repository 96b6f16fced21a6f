"""Who is let in: this machine, by this page, with the token."""

from __future__ import annotations

import pytest

from intercap_core.annotate.server import MAX_BODY, TOKEN_HEADER, refusal

TOKEN = "a-token"
PAGE = {"host": "127.0.0.1:8123"}
GET_HEADERS = {**PAGE, TOKEN_HEADER: TOKEN, "sec-fetch-site": "same-origin"}
POST_HEADERS = {**GET_HEADERS, "origin": "http://127.0.0.1:8123", "content-length": "2"}


OTHER_HOSTS = ("", "evil.example", "127.0.0.1.evil.example:8123", "169.254.169.254", "[::")
OTHER_ORIGINS = (
    "http://evil.example", "null", "http://127.0.0.1:9999", "https://127.0.0.1:8123",
)  # fmt: skip
LIST, SAVE = ("GET", "/api/sequences"), ("POST", "/api/sequences/a/save")


@pytest.mark.parametrize(
    ("request_", "headers", "status"),
    [
        (("GET", "/"), PAGE, None),
        (LIST, GET_HEADERS, None),
        (SAVE, POST_HEADERS, None),
        # a tunnel may have another port and name
        (SAVE, {**POST_HEADERS, "host": "localhost:9000", "origin": "http://localhost:9000"}, None),
        *((LIST, {**GET_HEADERS, TOKEN_HEADER: t}, 401) for t in ("", "another", TOKEN + "x", "ä")),
        # as after DNS rebinding: the browser believes that the name is the page's own
        *((("GET", "/"), {"host": host}, 400) for host in OTHER_HOSTS),
        *((LIST, {**GET_HEADERS, "host": host}, 400) for host in OTHER_HOSTS),
        *((SAVE, {**POST_HEADERS, "origin": origin}, 403) for origin in OTHER_ORIGINS),
        (SAVE, GET_HEADERS, 403),  # changes need an origin
        (LIST, {**GET_HEADERS, "sec-fetch-site": "cross-site"}, 403),
        (("POST", "/api/x"), {**POST_HEADERS, "content-length": str(MAX_BODY + 1)}, 413),
        (SAVE, {**POST_HEADERS, "transfer-encoding": "chunked"}, 413),
        (("POST", "/"), POST_HEADERS, 405),
    ],
)
def test_only_this_machine_and_page_with_the_token_are_answered(
    request_: tuple[str, str], headers: dict[str, str], status: int | None
) -> None:
    refused = refusal(*request_, headers, TOKEN)
    assert (None if refused is None else refused[0]) == status
