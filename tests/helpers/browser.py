"""Pages in Chromium, in the window of a desktop or a phone.

Playwright drives the system's own Chromium. All visits of a process share one browser, each in its
own context.
"""

from __future__ import annotations

import atexit
import functools
import json
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

if TYPE_CHECKING:
    from playwright.sync_api import Browser, CDPSession, Page, Playwright

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")
needs_chromium = pytest.mark.skipif(
    CHROMIUM is None, reason="no Chromium here: install Debian's package chromium"
)
DESK, PHONE = (1240, 2400), (390, 844)
_OPTIONS = (
    "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist",
    "--disable-quic", "--no-first-run", "--disable-background-networking",
    "--disable-component-update", "--disable-sync",
)  # fmt: skip
_READY = "document.querySelector('.viewer')?.dataset.ready === 'yes'"
_PATIENCE_MS = 60_000  # on a busy machine without a GPU


@dataclass
class Visit:
    """An open page."""

    page: Page
    fingers: CDPSession
    console: list[str] = field(default_factory=list)
    """Messages of the console and errors so far."""

    def wait(self, condition: str = _READY) -> None:
        """Wait until a JavaScript expression is true; by default, that the viewer is ready.

        It is polled here, because the pages' content policy forbids Playwright's own wait.
        """
        end = time.monotonic() + _PATIENCE_MS / 1000
        while not self.page.evaluate(condition):
            if time.monotonic() > end:
                raise TimeoutError(f"{self.page.url}: was not reached: {condition}: {self.console}")
            self.page.wait_for_timeout(20)

    def picture(self) -> np.ndarray:
        """The window (H, W, 3), BGR."""
        return cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """Send ``touchStart``, ``touchMove`` or ``touchEnd`` of fingers at ``points``, CSS px."""
        touches = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(points)]
        self.fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": touches})


@contextmanager
def visit(
    shown: Path | str,
    *,
    size: tuple[int, int] = DESK,
    phone: bool = False,
    dark: bool = False,
    address: str = "",
    log: Path | None = None,
) -> Iterator[Visit]:
    """Open a page.

    Args:
        shown: file or address of the page.
        size: window, CSS pixels.
        phone: emulate a phone with a touch screen.
        address: suffix of the address.
        log: file for the browser's network log, which :func:`asked` reads after the visit.
    """
    browser = _shared_browser() if log is None else _launch(f"--log-net-log={log}")
    context = browser.new_context(
        viewport={"width": size[0], "height": size[1]},
        is_mobile=phone,
        has_touch=phone,
        color_scheme="dark" if dark else "light",
        reduced_motion="reduce",
    )
    try:
        page = context.new_page()
        visited = Visit(page, context.new_cdp_session(page))
        page.set_default_timeout(_PATIENCE_MS)
        page.on("console", lambda message: visited.console.append(message.text))
        page.on("pageerror", lambda error: visited.console.append(str(error)))
        page.goto((shown if isinstance(shown, str) else shown.resolve().as_uri()) + address)
        yield visited
    finally:
        context.close()
        if log is not None:
            browser.close()


@functools.cache
def _playwright() -> Playwright:
    from playwright.sync_api import sync_playwright

    playwright = sync_playwright().start()
    atexit.register(playwright.stop)
    return playwright


def _launch(*options: str) -> Browser:
    return _playwright().chromium.launch(
        executable_path=CHROMIUM, args=[*_OPTIONS, *options], chromium_sandbox=False
    )


@functools.cache
def _shared_browser() -> Browser:
    return _launch()


def asked(log: Path) -> set[str]:
    """Addresses that the page requested, from the browser's network log."""
    found = set()
    for event in json.loads(log.read_text())["events"]:
        values: dict[str, Any] = event.get("params", {})
        # requests of the browser itself have no origin as initiator
        if "url" in values and values.get("initiator", "not an origin") != "not an origin":
            found.add(values["url"])
    return found


def serious_faults(visited: Visit) -> list[str]:
    """Serious and critical findings of the accessibility checker axe: rule, element, reason."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(visited.page, options={"resultTypes": ["violations"]}).response
    return [
        f"{fault['id']} ({fault['impact']}): {node['target']} {node['html'][:160]} "
        f"{node['failureSummary']}"
        for fault in found["violations"]
        if fault["impact"] in ("serious", "critical")
        for node in fault["nodes"]
    ]
