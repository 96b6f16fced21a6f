"""Orderly end of a process after Ctrl-C, SIGTERM or SIGHUP."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import CodeType, FrameType
from typing import Any

_UNBROKEN: set[CodeType] = set()  # functions inside which no signal raises
_pending: list[int] = []  # signals that arrived, for raise_pending
_ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class Terminated(BaseException):
    """Raised when a signal asks the process to end.

    Not an Exception, so that no error handler catches it, and not a KeyboardInterrupt, which typer
    handles itself.
    """

    def __init__(self, number: int) -> None:
        self.number = number
        super().__init__(f"terminated by {signal.Signals(number).name}")

    @property
    def status(self) -> int:
        """Exit status by the convention of shells."""
        return 128 + self.number


def unbroken(*functions: Callable[..., Any]) -> None:
    """Defer signals inside these functions, which C code calls, until :func:`raise_pending`."""
    _UNBROKEN.update(function.__code__ for function in functions)


def raise_pending() -> None:
    """Raise :class:`Terminated` if a signal was deferred, or raised where C code ignored it."""
    if _pending:
        raise Terminated(_pending[0])


def _is_within(frame: FrameType | None) -> bool:
    """Whether the frame or a caller of it is a function of ``_UNBROKEN``."""
    while frame is not None:
        if frame.f_code in _UNBROKEN:
            return True
        frame = frame.f_back
    return False


@contextmanager
def raise_on_signals() -> Iterator[None]:
    """Raise :class:`Terminated` in the block at the first SIGINT, SIGTERM or SIGHUP.

    Later signals are ignored, so that they do not interrupt the clean-up. Signals that were ignored
    before (``nohup``) stay ignored. Without effect outside the main thread.
    """
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        _pending.append(number)
        if _is_within(frame):
            return
        for other in before:
            signal.signal(other, signal.SIG_IGN)
        raise Terminated(number)

    handlers = {number: signal.getsignal(number) for number in _ENDING}
    before = {n: h for n, h in handlers.items() if h is not None and h is not signal.SIG_IGN}
    _pending.clear()
    for number in before:
        signal.signal(number, end)
    try:
        yield
    except Exception as error:
        if _pending:  # the interrupted code raised this error instead, as some hooks of C code do
            raise Terminated(_pending[0]) from error
        raise
    finally:
        _pending.clear()
        for number, handler in before.items():
            signal.signal(number, handler)
