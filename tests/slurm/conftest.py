"""A real Slurm for the tests of this folder; they are skipped where none can be started."""

from __future__ import annotations

import os
from collections.abc import Iterator

import pytest

from tests.helpers.loopback_slurm import LoopbackSlurm, missing


@pytest.fixture(scope="session")
def slurm(tmp_path_factory: pytest.TempPathFactory) -> Iterator[LoopbackSlurm]:
    """Munge, a controller and two nodes on the loopback address."""
    why = missing()
    if why:
        pytest.skip(f"no Slurm can be started: {why}")
    slurm = LoopbackSlurm(tmp_path_factory.mktemp("slurm"))
    try:
        slurm.start()
        yield slurm
    finally:
        slurm.stop()


@pytest.fixture(scope="session")
def everything() -> None:
    """For tests that take minutes: only `make test-slurm` runs them."""
    if "INTERCAP_TEST_SLURM" not in os.environ:
        pytest.skip("takes minutes: make test-slurm")
