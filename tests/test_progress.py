"""Progress of long loops in the log."""

from __future__ import annotations

import logging

import pytest

from intercap_core.progress import Progress


@pytest.mark.parametrize(
    ("of", "steps", "seconds", "messages"),
    [
        (100, 100, 0.4, ["tracked 38 of 100 frames, 2.5 a second, 25 s to go",
                    "tracked 76 of 100 frames, 2.5 a second, 10 s to go",
                    "tracked 100 of 100 frames, 2.5 a second"]),
        (None, 50, 0.4, ["tracked 38 frames, 2.5 a second"]),
        (20, 19, 0.4, []),
        (2, 2, 20.0, ["tracked 1 of 2 frames, 20 s each, 20 s to go",
                      "tracked 2 of 2 frames, 20 s each"]),
    ],
)  # fmt: skip
def test_a_long_loop_says_now_and_then_how_far_it_is(
    caplog: pytest.LogCaptureFixture,
    of: int | None,
    steps: int,
    seconds: float,
    messages: list[str],
) -> None:
    now = [0.0]
    with caplog.at_level(logging.INFO, logger="intercap_core.test"):
        log = logging.getLogger("intercap_core.test")
        progress = Progress(log, "tracked", of, clock=lambda: now[0])
        for _ in range(steps):
            now[0] += seconds
            progress.step()
    assert [record.getMessage() for record in caplog.records] == messages
