"""What a person does on the page in a real browser, and what is seen of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.annotate.served import NAME, TOKEN, Served
from tests.helpers.browser import Visit, visit

SIZE = (1440, 900)
READY = "document.body.dataset.ready === 'yes'"
SAVED = "document.getElementById('status').textContent === 'saved'"
HAND = '[data-part="right_hand"] .bar'


@contextmanager
def open_page(page: Served, **options: Any) -> Iterator[Visit]:
    """The sequence's page; in the end its console holds nothing unforeseen."""
    address = f"{page.address}/sequence/{NAME}#token={TOKEN}"
    with visit(address, size=SIZE, **options) as found:
        found.wait(READY)
        yield found
        assert not [line for line in found.console if "Failed to load" not in line], found.console


def draft_of(page: Visit, section: str) -> Any:
    """A section of the annotation as it is edited."""
    return page.page.evaluate(f"window.annotate.draft.get({section!r})")


def drag(page: Visit, start: tuple[float, float], by: tuple[float, float]) -> None:
    """With the left button, from ``start``."""
    mouse = page.page.mouse
    mouse.move(*start)
    mouse.down()
    mouse.move(start[0] + by[0], start[1] + by[1], steps=6)
    mouse.up()


def middle_of_the_object(page: Visit) -> tuple[float, float]:
    """Where the object's middle is in the first large view, pixels of the window."""
    box = page.page.locator("#big canvas").first.bounding_box()
    assert box is not None
    x, y, wide = page.page.evaluate(
        """() => { const a = window.annotate, view = a.views.views[0];
          return [...a.views.place(view, a.pose.middle()), view.width]; }"""
    )
    scale = box["width"] / wide
    return box["x"] + x * scale, box["y"] + y * scale


def save(page: Visit, answer: str = "save") -> None:
    """By Ctrl+S and the dialog."""
    page.page.keyboard.press("Control+s")
    page.wait("document.getElementById('dialog').open")
    page.page.locator(f'[data-answer="{answer}"]').click()


def keep_mine(page: Visit) -> None:
    """In the dialog of a conflict, and save."""
    page.page.locator('[data-answer="mine"]').click()
    page.wait("document.getElementById('dialog-title').textContent.startsWith('Save')")
    page.page.locator('[data-answer="save"]').click()
    page.wait(SAVED)
