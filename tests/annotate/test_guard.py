"""Who is let in: this machine, by this page, with the token."""

from __future__ import annotations

import pytest

from intercap_core.annotate.server import MAX_BODY, TOKEN_HEADER, refusal

TOKEN = "a-token"
PAGE = {"host": "127.0.0.1:8123"}
ASKED = {**PAGE, TOKEN_HEADER: TOKEN, "sec-fetch-site": "same-origin"}
SENT = {**ASKED, "origin": "http://127.0.0.1:8123", "content-length": "2"}


def _status(method: str, path: str, headers: dict[str, str]) -> int | None:
    found = refusal(method, path, headers, TOKEN)
    return None if found is None else found[0]


def test_the_page_and_its_requests_are_answered() -> None:
    assert _status("GET", "/", PAGE) is None
    assert _status("GET", "/api/sequences", ASKED) is None
    assert _status("POST", "/api/sequences/a/save", SENT) is None


def test_a_tunnel_may_have_another_port_and_name() -> None:
    tunnel = {**SENT, "host": "localhost:9000", "origin": "http://localhost:9000"}
    assert _status("POST", "/api/sequences/a/save", tunnel) is None


@pytest.mark.parametrize("token", ["", "another", TOKEN + "x", "ä"])
def test_without_the_token_nothing_is_told(token: str) -> None:
    assert _status("GET", "/api/sequences", {**ASKED, TOKEN_HEADER: token}) == 401


@pytest.mark.parametrize(
    "host", ["", "evil.example", "127.0.0.1.evil.example:8123", "169.254.169.254", "[::"]
)
def test_another_host_is_refused(host: str) -> None:
    """As after DNS rebinding: the browser believes that the name is the page's own."""
    assert _status("GET", "/", {"host": host}) == 400
    assert _status("GET", "/api/sequences", {**ASKED, "host": host}) == 400


@pytest.mark.parametrize(
    "origin", ["http://evil.example", "null", "http://127.0.0.1:9999", "https://127.0.0.1:8123"]
)
def test_another_origin_is_refused(origin: str) -> None:
    assert _status("POST", "/api/sequences/a/save", {**SENT, "origin": origin}) == 403


def test_a_change_says_where_it_comes_from() -> None:
    told = {k: v for k, v in SENT.items() if k != "origin"}
    assert _status("POST", "/api/sequences/a/save", told) == 403
    assert _status("GET", "/api/sequences", {**ASKED, "sec-fetch-site": "cross-site"}) == 403


def test_bodies_are_bounded_and_pages_are_not_written_to() -> None:
    assert _status("POST", "/api/x", {**SENT, "content-length": str(MAX_BODY + 1)}) == 413
    assert _status("POST", "/", SENT) == 405
