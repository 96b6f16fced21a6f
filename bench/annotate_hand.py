"""Operates the annotation page as a person does, by keys, clicks and drags, which are counted and
timed.

No function of the page is called to change anything.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from intercap_core.errors import UserError

if TYPE_CHECKING:
    from tests.helpers.browser import Visit

Point = tuple[float, float]
RUN_S = 1800.0  # the longest that a run of one small sequence may take
_STEPS = 6  # mouse events of a drag
_PAUSE_MS = 60  # between what the hand does
# Of the large views: where each is in the window, its camera, and where points are drawn on it.
_VIEWS = """(points) => {
  const { views } = window.annotate;
  return [...document.querySelectorAll("#big figure")].map((figure) => {
    const view = views.views.find((one) => one.figure === figure);
    const box = view.canvas.getBoundingClientRect(), scale = box.width / view.width;
    const spot = (p) => {
      const at = p && views.place(view, p);
      return at && [box.x + at[0] * scale, box.y + at[1] * scale];
    };
    const camera = view.camera.name, at = (points[camera] ?? []).map(spot);
    return { camera, box: [box.x, box.y, box.width, box.height], at };
  });
}"""


@dataclass
class Hand:
    """A person's hand on the page."""

    visit: Visit
    actions: int = 0
    """Keys, clicks and drags so far."""
    waited: float = 0.0
    """Seconds of runs."""
    started: float = field(default_factory=time.monotonic)

    @property
    def seconds(self) -> float:
        """Seconds in the browser, without the runs."""
        return time.monotonic() - self.started - self.waited

    def see(self, expression: str, argument: Any = None) -> Any:
        """Value of a JavaScript expression on the page."""
        return self.visit.page.evaluate(expression, argument)

    def views(self, points: dict[str, list[np.ndarray]]) -> list[dict[str, Any]]:
        """The large views, with the image positions of ``points`` by camera."""
        positions = {name: [p.tolist() for p in those] for name, those in points.items()}
        return list(self.see(_VIEWS, positions))

    def key(self, name: str, times: int = 1) -> None:
        for _ in range(times):
            self.visit.page.keyboard.press(name)
            self._done()

    def click(self, selector: str) -> None:
        self.visit.page.locator(selector).first.click()
        self._done()

    def double_click(self, selector: str) -> None:
        self.visit.page.locator(selector).first.dblclick()
        self._done()

    def choose(self, selector: str, value: str) -> None:
        """Select an entry of a list."""
        self.visit.page.locator(selector).select_option(value)
        self._done()

    def drag(self, start: Point, by: Point, held: str = "") -> None:
        page = self.visit.page
        if held:
            page.keyboard.down(held)
        page.mouse.move(*start)
        page.mouse.down()
        page.mouse.move(start[0] + by[0], start[1] + by[1], steps=_STEPS)
        page.mouse.up()
        if held:
            page.keyboard.up(held)
        self._done()

    def go_to(self, frame: int) -> None:
        """Go to a frame by the arrow keys, in steps of ten where it is far."""
        away = frame - int(self.see("window.annotate.frame"))
        tens, ones = divmod(abs(away), 10)
        arrow = "ArrowRight" if away > 0 else "ArrowLeft"
        self.key(f"Shift+{arrow}", tens)
        self.key(arrow, ones)
        self.visit.wait(f"window.annotate.frame === {frame}")

    def save_and_run(self) -> float:
        """Save by Ctrl+S and the dialog; returns the seconds until the new result is drawn.

        Raises UserError if the page does not save, or the run fails.
        """
        self.key("Control+s")
        self.visit.wait("document.getElementById('dialog').open")
        title = str(self.see("document.getElementById('dialog-title').textContent"))
        if not title.startswith("Save"):
            raise UserError(
                f"the page says: {self.see('document.getElementById(`dialog`).innerText')}"
            )
        self.click('#dialog [data-answer="run"]')
        with self._waiting():
            begin = time.monotonic()
            self.visit.wait("window.annotate.keep.run.state === 'running'")
            while self.see("window.annotate.keep.run.state") == "running":
                if time.monotonic() - begin > RUN_S:
                    raise UserError(f"the run did not end within {RUN_S:.0f} s")
                self.visit.page.wait_for_timeout(500)
            if self.see("window.annotate.keep.run.state") != "done":
                raise UserError(f"the run failed: {self.see('window.annotate.keep.run.words')}")
            self.visit.wait(
                "document.getElementById('hint').textContent.startsWith('the new result')"
            )
            return time.monotonic() - begin

    @contextmanager
    def _waiting(self) -> Iterator[None]:
        begin = time.monotonic()
        try:
            yield
        finally:
            self.waited += time.monotonic() - begin

    def _done(self) -> None:
        self.actions += 1
        self.visit.page.wait_for_timeout(_PAUSE_MS)
