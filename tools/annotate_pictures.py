"""Draw docs/pictures/annotate_*.jpg: the annotation page in Chromium, used as a person would.

    intercap run config/demo/config.yaml
    python tools/annotate_pictures.py [config/demo/config.yaml]

Nothing is saved: the project's annotations stay as they are.
"""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import cv2

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.helpers.browser import Visit, visit

PICTURES = Path(__file__).resolve().parents[1] / "docs" / "pictures"
READY = "document.body.dataset.ready === 'yes'"
SEQUENCE, DRINKING, DOUBTED = "cup_drink_s02", 28, 32
SIZE = (1360, 850)
QUALITY = 80


def main(settings: str) -> None:
    """Write the pictures."""
    command = [sys.executable, "-m", "intercap_core.cli", "annotate", settings, SEQUENCE]
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    try:
        assert server.stdout is not None
        address = re.search(r"http\S+", server.stdout.readline())
        assert address is not None
        with visit(address.group(0), size=SIZE) as page:
            page.wait(READY)
            page.page.evaluate(
                "window.addEventListener('beforeunload', (e) => e.stopImmediatePropagation(), true)"
            )
            _contact(page)
            _object(page)
            _question(page)
    finally:
        server.terminate()
        server.wait()


def _contact(page: Visit) -> None:
    page.page.evaluate(f"window.annotate.show({DRINKING})")
    _drag_end(page, -70)
    page.page.evaluate(f"window.annotate.show({DRINKING})")
    page.page.keyboard.press("f")
    _take(page, "annotate_contact")
    page.page.keyboard.press("Control+s")
    page.wait("document.getElementById('dialog').open")
    page.wait("!document.getElementById('dialog').textContent.includes('Determining')")
    _take(page, "annotate_save")
    page.page.locator("#dialog-buttons").get_by_text("Cancel").click()


def _object(page: Visit) -> None:
    page.page.keyboard.press("o")
    box = page.page.locator("#big canvas").first.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
    page.page.mouse.move(x, y)
    page.page.mouse.down()
    page.page.mouse.move(x + 40, y + 25, steps=6)
    page.page.mouse.up()
    _take(page, "annotate_object")
    page.page.keyboard.press("Escape")
    page.page.keyboard.press("Control+z")


def _question(page: Visit) -> None:
    page.page.keyboard.press("q")
    _take(page, "annotate_question")


def _drag_end(page: Visit, by: float) -> None:
    """Of the right hand's contact, by so many pixels."""
    box = page.page.locator('[data-part="right_hand"] .bar').first.bounding_box()
    assert box is not None
    x, y = box["x"] + box["width"] - 4, box["y"] + box["height"] / 2
    page.page.mouse.move(x, y)
    page.page.mouse.down()
    page.page.mouse.move(x + by, y, steps=8)
    page.page.mouse.up()


def _take(page: Visit, name: str) -> None:
    page.page.wait_for_timeout(1500)
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY, cv2.IMWRITE_JPEG_OPTIMIZE, 1]
    path = PICTURES / f"{name}.jpg"
    cv2.imwrite(str(path), page.picture(), options)
    print(path)


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "config/demo/config.yaml")
