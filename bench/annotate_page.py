"""Latency of the annotation page in Chromium, from a key to the drawn views.

The arrow key is pressed with pauses, as by a person. A step ends when every view has drawn the new
frame, the graphics process has finished and the browser has painted. Figures:

- ``annotate.page_ms_per_step``: median of a step; ``..._p95`` the 95th percentile; ``..._3d`` the
  median until the 3D viewer has followed (at least two frames later).
- ``annotate.page_ms_per_jump``: jump to the last frame, whose images are not prefetched.
- ``annotate.page_ms_to_open``: from the address to the 4D viewer.
- ``annotate.page_ms_per_edit``: time for which an edit blocks the page.
"""

from __future__ import annotations

import re
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from intercap_core.errors import UserError

if TYPE_CHECKING:
    from playwright.sync_api import Page

    from tests.helpers.browser import Visit

Point = tuple[float, float]
RUN_S = 1800.0  # the longest that a run of one small sequence may take
_STEPS = 6  # mouse events of a drag
_PAUSE_MS = 60  # after each action of the hand
# Camera, window rectangle and image positions of points for each large view
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
            self.visit.wait("window.annotate.saving.run.state === 'running'")
            while self.see("window.annotate.saving.run.state") == "running":
                if time.monotonic() - begin > RUN_S:
                    raise UserError(f"the run did not end within {RUN_S:.0f} s")
                self.visit.page.wait_for_timeout(500)
            if self.see("window.annotate.saving.run.state") != "done":
                raise UserError(f"the run failed: {self.see('window.annotate.saving.run.message')}")
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


SIZE = (1440, 900)  # of the browser, px
PAUSE_MS = 160  # between keys
READY = "document.body.dataset.ready === 'yes'"
# A step begins with the key, before the page hears of it, and ends when all is painted.
WATCH = """
(() => {
  const app = window.annotate, drawn = app.drawn.bind(app);
  window.stepMs = [];
  let pressed = null;
  window.addEventListener("keydown", (event) => { pressed = event.timeStamp; }, { capture: true });
  app.drawn = () => {
    const stepped = app.requestedAt !== null && app.requestedAt !== undefined;
    drawn();
    if (!stepped || pressed === null) return;
    const key = pressed, solid = document.querySelector(".viewer canvas")?.getContext("webgl2");
    pressed = null;
    const ended = (gl) => gl?.readPixels(0, 0, 1, 1, gl.RGBA, gl.UNSIGNED_BYTE, new Uint8Array(4));
    ended(app.overlay?.gl); // waits for all that was to be drawn
    const channel = new MessageChannel(); // whose message comes after this frame was painted
    channel.port1.onmessage = () => {
      const views = performance.now() - key;
      requestAnimationFrame(() => requestAnimationFrame(() => {
        ended(solid);
        window.stepMs.push([views, performance.now() - key]);
      }));
    };
    channel.port2.postMessage(0);
  };
})()
"""

# A frame is dropped and kept again; nothing is saved.
_EDITS = """
[...Array(10)].map(() => {
  const start = performance.now();
  window.annotate.dropped.toggle(0);
  return performance.now() - start;
})
"""


def steps_ms(page: Page, steps: int, key: str = "ArrowRight") -> np.ndarray:
    """Milliseconds (N, 2) of N consecutive steps on a watched page (WATCH).

    The columns are the time to all views and to the 3D viewer.
    """
    page.evaluate("window.stepMs.length = 0")
    for step in range(steps):
        page.keyboard.press(key)
        while page.evaluate("window.stepMs.length") <= step:
            page.wait_for_timeout(5)
        page.wait_for_timeout(PAUSE_MS)
    return np.array(page.evaluate("window.stepMs"), float)


@contextmanager
def served_page(settings: Path, sequence: str, cores: int = 0) -> Iterator[Visit]:
    """The sequence's page in a browser, ready, with a server process of its own.

    Raises UserError if the server does not start.
    """
    from tests.helpers.browser import visit

    command = [sys.executable, "-m", "intercap_core.cli", "annotate", str(settings), sequence]
    command += ["--cores", str(cores)] if cores else []
    server = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert server.stdout is not None
    try:
        address = re.search(r"http\S+", server.stdout.readline())
        if address is None:
            raise UserError(f"{settings}: the server of {sequence}'s page did not start")
        with visit(address.group(0), size=SIZE) as page:
            page.wait(READY)
            yield page
    finally:
        server.terminate()
        server.wait()


def measure(settings: Path, sequence: str, steps: int) -> dict[str, float]:
    """Figures of one sequence, served by a separate process."""
    with served_page(settings, sequence) as page:
        page.page.wait_for_timeout(1500)
        page.page.evaluate(WATCH)
        steps = min(steps, page.page.evaluate("window.annotate.info.frames") - 1)
        on = steps_ms(page.page, steps)
        page.page.reload()
        page.wait(READY)
        to_open = page.page.evaluate("performance.now()")
        page.page.wait_for_timeout(1500)
        edits = page.page.evaluate(_EDITS)
        page.page.evaluate(WATCH)
        jump = steps_ms(page.page, 1, "End")
    return {
        "annotate.page_ms_per_step": round(float(np.median(on[:, 0])), 1),
        "annotate.page_ms_per_step_p95": round(float(np.percentile(on[:, 0], 95)), 1),
        "annotate.page_ms_per_step_3d": round(float(np.median(on[:, 1])), 1),
        "annotate.page_ms_per_jump": round(float(jump[0, 0]), 1),
        "annotate.page_ms_to_open": round(float(to_open), 1),
        "annotate.page_ms_per_edit": round(float(np.median(edits)), 1),
    }
