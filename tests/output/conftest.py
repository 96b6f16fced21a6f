"""Two measured captures and their site, shared by all workers."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.helpers import fitted_capture as fitted
from tests.helpers import site as sites
from tests.helpers.shared_folder import shared_folder


@pytest.fixture(scope="session")
def captures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, fitted.Capture]:
    """One sequence with truth, whose ball is held, and one without, whose cup is not; read only."""
    folder = shared_folder(tmp_path_factory, "two_captures", sites.make_two_captures)
    return sites.open_two_captures(folder)


@pytest.fixture(scope="session")
def site(captures: dict[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of their dataset, with one failed sequence; read only."""

    def make(folder: Path) -> None:
        sites.write_site(captures, folder, failed=sites.FAILED, intents=sites.INTENTS)

    return shared_folder(tmp_path_factory, "site", make)
