"""Progress of long loops as lines of the log, which `intercap run` shows."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

EVERY_S = 15.0  # interval of the lines


class Progress:
    """Counts the steps of a loop and logs count, rate and remaining time.

    A line reads "tracked 20 of 90 frames, 4.1 a second, 17 s to go".

    Args:
        doing: word before the numbers, such as "tracked".
        of: number of all steps; None if unknown.
        things: word after the numbers, such as "frames".
    """

    def __init__(
        self,
        log: logging.Logger,
        doing: str,
        of: int | None,
        things: str = "frames",
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._log, self._doing, self._of, self._things = log, doing, of, things
        self._clock = clock
        self._start = self._logged = clock()
        self._count = 0

    def step(self, count: int = 1) -> None:
        """Count ``count`` more steps; logs a line every ``EVERY_S`` seconds and at the last
        step."""
        self._count += count
        now = self._clock()
        if now - self._logged >= EVERY_S or self._count == self._of:
            self._logged = now
            self._log.info("%s", self._line(now - self._start))

    def _line(self, elapsed: float) -> str:
        done = f"{self._count} of {self._of}" if self._of is not None else str(self._count)
        line = f"{self._doing} {done} {self._things}"
        if elapsed <= 0.0:
            return line
        rate = self._count / elapsed
        line += f", {rate:.3g} a second" if rate >= 1.0 else f", {1.0 / rate:.3g} s each"
        if self._of is not None and 0 < self._count < self._of:
            line += f", {(self._of - self._count) / rate:.0f} s to go"
        return line
