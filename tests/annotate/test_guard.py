"""Who is let in: this machine, by this page, with the token."""

from __future__ import annotations

import pytest

from intercap_core.annotate.server import MAX_BODY, TOKEN_HEADER, refusal

TOKEN = "a-token"
PAGE = {"host": "127.0.0.1:8123"}
GET_HEADERS = {**PAGE, TOKEN_HEADER: TOKEN, "sec-fetch-site": "same-origin"}
POST_HEADERS = {**GET_HEADERS, "origin": "http://127.0.0.1:8123", "content-length": "2"}


def _status(method: str, path: str, headers: dict[str, str]) -> int | None:
    refused = refusal(method, path, headers, TOKEN)
    return None if refused is None else refused[0]


def test_the_page_and_its_requests_are_answered() -> None:
    assert _status("GET", "/", PAGE) is None
    assert _status("GET", "/api/sequences", GET_HEADERS) is None
    assert _status("POST", "/api/sequences/a/save", POST_HEADERS) is None


def test_a_tunnel_may_have_another_port_and_name() -> None:
    tunnel = {**POST_HEADERS, "host": "localhost:9000", "origin": "http://localhost:9000"}
    assert _status("POST", "/api/sequences/a/save", tunnel) is None


@pytest.mark.parametrize("token", ["", "another", TOKEN + "x", "ä"])
def test_requests_without_the_token_are_refused(token: str) -> None:
    assert _status("GET", "/api/sequences", {**GET_HEADERS, TOKEN_HEADER: token}) == 401


@pytest.mark.parametrize(
    "host", ["", "evil.example", "127.0.0.1.evil.example:8123", "169.254.169.254", "[::"]
)
def test_another_host_is_refused(host: str) -> None:
    """As after DNS rebinding: the browser believes that the name is the page's own."""
    assert _status("GET", "/", {"host": host}) == 400
    assert _status("GET", "/api/sequences", {**GET_HEADERS, "host": host}) == 400


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:9999", "https://127.0.0.1:8123"]
)
def test_another_origin_is_refused(origin: str) -> None:
    assert _status("POST", "/api/sequences/a/save", {**POST_HEADERS, "origin": origin}) == 403


def test_changes_need_an_origin() -> None:
    headers = {k: v for k, v in POST_HEADERS.items() if k != "origin"}
    assert _status("POST", "/api/sequences/a/save", headers) == 403
    assert _status("GET", "/api/sequences", {**GET_HEADERS, "sec-fetch-site": "cross-site"}) == 403


def test_large_bodies_and_writes_to_pages_are_refused() -> None:
    assert _status("POST", "/api/x", {**POST_HEADERS, "content-length": str(MAX_BODY + 1)}) == 413
    assert _status("POST", "/", POST_HEADERS) == 405
