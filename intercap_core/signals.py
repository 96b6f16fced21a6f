"""A process that is told to end does so in order: what is half-written goes, one sentence stays."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType, FrameType
from typing import Any

_UNBROKEN: set[CodeType] = set()
_pending: list[int] = []
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class ToldToEnd(BaseException):
    """Raised where a signal reaches the process: no handler of errors takes it for one, and typer,
    which has an answer of its own to KeyboardInterrupt, lets it through."""

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(f"told to end ({signal.Signals(number).name})")

    @property
    def status(self) -> int:
        """What a shell expects as the exit status."""
        return 128 + self.number


def unbroken(*functions: Callable[..., Any]) -> None:
    """From these functions, which other languages call, no signal raises: it waits for
    :func:`raise_pending`."""
    _UNBROKEN.update(function.__code__ for function in functions)


def raise_pending() -> None:
    """Raise :class:`ToldToEnd` where a signal came in the midst of what may not be broken."""
    if _pending:
        raise ToldToEnd(_pending.pop())


def _is_within(frame: FrameType | None) -> bool:
    while frame is not None:
        if frame.f_code in _UNBROKEN:
            return True
        frame = frame.f_back
    return False


@contextmanager
def told_to_end() -> Iterator[None]:
    """Raise :class:`ToldToEnd` in the block at the first Ctrl-C, SIGTERM or hang-up; later ones are
    ignored, so that none breaks into the clearing up. Signals that are ignored stay so (``nohup``),
    and nothing is done outside a process's main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        if _is_within(frame):
            _pending.append(number)
            return
        for other in before:
            signal.signal(other, signal.SIG_IGN)
        raise ToldToEnd(number)

    before = {one: signal.getsignal(one) for one in _ENDING}
    before = {one: h for one, h in before.items() if h is not None and h is not signal.SIG_IGN}
    _pending.clear()
    for one in before:
        signal.signal(one, end)
    try:
        yield
    finally:
        for one, handler in before.items():
            signal.signal(one, handler)
