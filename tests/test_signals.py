"""Signals that ask the process to end."""

from __future__ import annotations

import os
import signal

import pytest

from intercap_core.signals import Terminated, raise_on_signals


class EndsTheProcess:
    """An attribute during whose creation a signal arrives."""

    def __set_name__(self, owner: type, name: str) -> None:
        os.kill(os.getpid(), signal.SIGTERM)


def test_a_signal_ends_the_block_though_the_interrupted_code_raises_another_error() -> None:
    with pytest.raises(Terminated, match="SIGTERM") as found, raise_on_signals():
        type("Interrupted", (), {"attribute": EndsTheProcess()})
    assert found.value.status == 128 + signal.SIGTERM


def test_errors_without_a_signal_are_not_changed() -> None:
    with pytest.raises(ValueError, match="own"), raise_on_signals():
        raise ValueError("own")
