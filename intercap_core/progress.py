"""How far a long loop is, in lines of the log: for whoever has no terminal, and for `intercap run`.

Changes no result, so that stages need not run again where this file changes.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

EVERY_S = 15.0  # between two lines: a hundred lines of a stage of half an hour


class Progress:
    """Counts the steps of a loop and says now and then how many are done, and how fast.

    ``doing`` and ``things`` are the words before and after the numbers: "tracked 20 of 90 frames,
    4.1 a second, 17 s to go". ``of`` is their number, None where nobody knows it.
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
        self._start = self._told = clock()
        self._count = 0

    def step(self, count: int = 1) -> None:
        """Count ``count`` more as done; says a line where one is due, and at the last."""
        self._count += count
        now = self._clock()
        if now - self._told >= EVERY_S or self._count == self._of:
            self._told = now
            self._log.info("%s", self._line(now - self._start))

    def _line(self, elapsed: float) -> str:
        done = f"{self._count} of {self._of}" if self._of is not None else str(self._count)
        line = f"{self._doing} {done} {self._things}"
        if elapsed <= 0.0:
            return line
        rate = self._count / elapsed
        line += f", {rate:.3g} a second"
        if self._of is not None and 0 < self._count < self._of:
            line += f", {(self._of - self._count) / rate:.0f} s to go"
        return line
