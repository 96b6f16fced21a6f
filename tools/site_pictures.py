"""The pictures of docs/usage.md: the demo's overview and one of its sequences, at a desk and on a
phone.

python tools/site_pictures.py results/demo/site docs/pictures

Needs Chromium, and Playwright of the extra `test`, which drives it.
"""

from __future__ import annotations

import shutil
import sys
import time
from pathlib import Path

import cv2
import numpy as np
from playwright.sync_api import Browser, Page, sync_playwright

SEQUENCE, MOMENT = "cup_drink_s02", "#t=1.80"  # the cup is at the mouth
DESK, PHONE = (1240, 1500), (390, 844)
QUALITY = 80
_OPTIONS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
_READY = "(document.querySelector('.viewer')?.dataset.ready ?? 'yes') === 'yes'"
_PATIENCE_S = 60.0


def main(site: Path, output: Path) -> None:
    """Write site_overview.jpg, site_sequence.jpg and site_phone.jpg."""
    overview = site / "index.html"
    sequence = site / "sequences" / SEQUENCE / "index.html"
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(
            executable_path=shutil.which("chromium"), args=_OPTIONS, chromium_sandbox=False
        )
        _write(output / "site_overview.jpg", _taken(browser, overview, DESK, "h1"))
        _write(output / "site_sequence.jpg", _taken(browser, sequence, DESK, "h1"))
        phone = [
            _taken(browser, page, PHONE, place)
            for page, place in (
                (overview, "#sequences-table"),
                (sequence, "#viewer"),
                (sequence, "#time"),
            )
        ]
        gap = np.full((phone[0].shape[0], 24, 3), 255, np.uint8)
        _write(output / "site_phone.jpg", np.hstack([phone[0], gap, phone[1], gap, phone[2]]))
        browser.close()


def _taken(browser: Browser, page: Path, size: tuple[int, int], place: str) -> np.ndarray:
    """The window (H, W, 3), blue first, scrolled to an element of the page."""
    phone = size == PHONE
    shown = browser.new_page(
        viewport={"width": size[0], "height": size[1]}, is_mobile=phone, has_touch=phone,
        device_scale_factor=1.5 if phone else 1, reduced_motion="reduce", color_scheme="light",
    )  # fmt: skip
    shown.goto(page.resolve().as_uri() + MOMENT)
    _wait(shown)
    shown.locator(place).first.evaluate("(element) => element.scrollIntoView()")
    shown.wait_for_timeout(500)  # pictures in view are decoded
    found = np.frombuffer(shown.screenshot(), np.uint8)
    shown.close()
    return cv2.imdecode(found, cv2.IMREAD_COLOR)


def _wait(page: Page) -> None:
    end = time.monotonic() + _PATIENCE_S
    while not page.evaluate(_READY):
        if time.monotonic() > end:
            raise TimeoutError(f"{page.url}: the viewer does not stand")
        page.wait_for_timeout(50)


def _write(path: Path, picture: np.ndarray) -> None:
    cv2.imwrite(str(path), picture, [cv2.IMWRITE_JPEG_QUALITY, QUALITY])
    print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
