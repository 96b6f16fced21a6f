"""A pool of threads for functions that release the global interpreter lock."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import count
from typing import TypeVar

Item = TypeVar("Item")
Result = TypeVar("Result")

VARIABLE = "INTERCAP_THREADS"


def threads_of_job() -> int:
    """Return the number of threads that the job may use: the variable INTERCAP_THREADS, else one.

    The numerical libraries use one thread, since their rounding depends on the number of threads.
    """
    given = os.environ.get(VARIABLE, "")
    return int(given) if given.isdecimal() and int(given) > 0 else 1


class ThreadPool:
    """A pool of ``threads`` threads, one of which is the caller's: 1 starts no other."""

    def __init__(self, threads: int = 1) -> None:
        if threads < 1:
            raise ValueError(f"{threads} threads; expected at least one")
        self.threads = threads
        self._pool = ThreadPoolExecutor(threads - 1) if threads > 1 else None

    def map(self, function: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
        """Return ``function`` of every item, in the order of the items.

        Each thread takes the next item when it is free, which balances items of unequal cost.
        """
        if self._pool is None or len(items) < 2:
            return [function(item) for item in items]
        results: list[Result | None] = [None] * len(items)
        ticket = count()

        def work() -> None:
            while (number := next(ticket)) < len(items):
                results[number] = function(items[number])

        helpers = [self._pool.submit(work) for _ in range(min(self.threads, len(items)) - 1)]
        work()
        for helper in helpers:
            helper.result()
        return results  # type: ignore[return-value]  # all items have a result
