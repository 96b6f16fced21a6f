"""Actions of a person on the page in a browser, and what the page shows."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from tests.annotate.served import NAME, TOKEN, Served
from tests.helpers.browser import Visit, visit

SIZE = (1440, 900)
READY = "document.body.dataset.ready === 'yes'"
SAVED = "document.getElementById('status').textContent === 'saved'"
HAND = '[data-part="right_hand"] .bar'


@dataclass
class Hand:
    """A person's hand on a page."""

    visit: Visit

    def __post_init__(self) -> None:
        self.page, self.wait = self.visit.page, self.visit.wait

    def press(self, *keys: str) -> None:
        """Press keys one after another."""
        for key in keys:
            self.page.keyboard.press(key)

    def app(self, expression: str) -> Any:
        """Evaluate an expression of the page's app."""
        return self.page.evaluate(f"window.annotate.{expression}")

    def draft(self, section: str) -> Any:
        """Return a section of the edited annotation."""
        return self.app(f"draft.get({section!r})")

    def show(self, frame: int) -> None:
        """Go to a frame."""
        self.app(f"show({frame})")

    def click(self, name: str) -> None:
        """Click a button by its text."""
        self.page.get_by_role("button", name=name).click()

    def text(self, selector: str) -> str:
        """Return the visible text of an element."""
        return self.page.locator(selector).inner_text()

    def box(self, selector: str) -> tuple[float, float, float, float]:
        """Return x, y, width and height of an element in the window."""
        box = self.page.locator(selector).first.bounding_box()
        assert box is not None
        return box["x"], box["y"], box["width"], box["height"]

    def drag(self, start: tuple[float, float], by: tuple[float, float]) -> None:
        """Drag with the left button."""
        self.page.mouse.move(*start)
        self.page.mouse.down()
        self.page.mouse.move(start[0] + by[0], start[1] + by[1], steps=6)
        self.page.mouse.up()

    def object_middle(self) -> tuple[float, float]:
        """Return the window position of the object's centre in the first large view."""
        x, y, wide = self.page.evaluate(
            """() => { const a = window.annotate, view = a.views.views[0];
              return [...a.views.place(view, a.pose.middle()), view.width]; }"""
        )
        left, top, width, _ = self.box("#big canvas")
        return left + x * width / wide, top + y * width / wide

    def open_save(self) -> str:
        """Press Ctrl+S and return the text of the dialog."""
        self.press("Control+s")
        self.wait("document.getElementById('dialog').open")
        return self.text("#dialog")

    def answer(self, answer: str) -> None:
        """Press a button of the dialog."""
        self.page.locator(f'[data-answer="{answer}"]').click()

    def save(self) -> None:
        """Save by Ctrl+S and the dialog."""
        self.open_save()
        self.answer("save")
        self.wait(SAVED)

    def save_conflict(self, answer: str) -> str:
        """Save, and answer the dialog of a conflict; return its text."""
        self.open_save()
        self.answer("save")
        title = "document.getElementById('dialog-title').textContent"
        self.wait(f"{title}.startsWith('Another annotator')")
        text = self.text("#dialog")
        self.resolve(answer)
        return text

    def resolve(self, answer: str) -> None:
        """Answer the dialog of a conflict, and save if our version is kept."""
        self.answer(answer)
        if answer == "mine":
            self.wait("document.getElementById('dialog-title').textContent.startsWith('Save')")
            self.answer("save")
            self.wait(SAVED)

    def reload(self) -> None:
        """Reload the page."""
        self.page.reload()
        self.wait(READY)


@contextmanager
def open_page(page: Served, **options: Any) -> Iterator[Hand]:
    """Open the sequence's page; check at the end that its console has no errors."""
    address = f"{page.address}/sequence/{NAME}#token={TOKEN}"
    with visit(address, size=SIZE, **options) as visited:
        visited.wait(READY)
        yield Hand(visited)
        assert not [line for line in visited.console if "Failed to load" not in line], (
            visited.console
        )
