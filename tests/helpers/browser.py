"""Pages from disk in a real Chromium, as somebody at a desk or with a phone meets them.

Playwright drives the system's own Chromium; it downloads none.
"""

from __future__ import annotations

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
    from playwright.sync_api import CDPSession, Page

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
_PATIENCE_MS = 60_000  # on a machine that draws without a GPU and does other things as well


@dataclass
class Visit:
    """An open page. ``console`` is what it printed and what went wrong in it, so far."""

    page: Page
    fingers: CDPSession
    console: list[str] = field(default_factory=list)

    def wait(self, condition: str = _READY) -> None:
        """Until a JavaScript expression holds; by default, that the viewer stands.

        Asked again and again from here: the pages' policy forbids what Playwright's own wait does.
        """
        end = time.monotonic() + _PATIENCE_MS / 1000
        while not self.page.evaluate(condition):
            if time.monotonic() > end:
                raise TimeoutError(f"{self.page.url}: never came to {condition}: {self.console}")
            self.page.wait_for_timeout(20)

    def picture(self) -> np.ndarray:
        """What is in the window, (H, W, 3), blue first."""
        return cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), cv2.IMREAD_COLOR)

    def touch(self, kind: str, *points: tuple[float, float]) -> None:
        """Send ``touchStart``, ``touchMove`` or ``touchEnd`` of fingers at ``points``, as the
        touch screen would; CSS pixels of the window."""
        told = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(points)]
        self.fingers.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": told})


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
    """The page, a file or an address, in a window of ``size`` CSS pixels; ``address`` is added to
    its own.

    A ``phone`` has a touch screen, a finger in place of a pointer, and obeys the page's viewport.
    The browser's own record of its network goes to ``log``; read it by :func:`asked`, afterwards.
    """
    from playwright.sync_api import sync_playwright

    options = [*_OPTIONS, *([] if log is None else [f"--log-net-log={log}"])]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=CHROMIUM, args=options, chromium_sandbox=False
        )
        context = browser.new_context(
            viewport={"width": size[0], "height": size[1]},
            is_mobile=phone,
            has_touch=phone,
            color_scheme="dark" if dark else "light",
            reduced_motion="reduce",
        )
        page = context.new_page()
        found = Visit(page, context.new_cdp_session(page))
        found.page.set_default_timeout(_PATIENCE_MS)
        found.page.on("console", lambda message: found.console.append(message.text))
        found.page.on("pageerror", lambda error: found.console.append(str(error)))
        own = shown if isinstance(shown, str) else shown.resolve().as_uri()
        found.page.goto(own + address)
        try:
            yield found
        finally:
            browser.close()


def asked(log: Path) -> set[str]:
    """The addresses that the page itself asked the network for, from the browser's record."""
    found = set()
    for event in json.loads(log.read_text())["events"]:
        values: dict[str, Any] = event.get("params", {})
        # the browser's own errands (updates, accounts) have no origin for an initiator
        if "url" in values and values.get("initiator", "not an origin") != "not an origin":
            found.add(values["url"])
    return found


def serious_faults(visited: Visit) -> list[str]:
    """What the accessibility checker axe calls serious or critical: rule, element, and why."""
    from axe_playwright_python.sync_playwright import Axe

    found = Axe().run(visited.page, options={"resultTypes": ["violations"]}).response
    return [
        f"{fault['id']} ({fault['impact']}): {node['target']} {node['html'][:160]} "
        f"{node['failureSummary']}"
        for fault in found["violations"]
        if fault["impact"] in ("serious", "critical")
        for node in fault["nodes"]
    ]
