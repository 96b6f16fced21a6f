"""A small capture with known errors, shared by the tests of this folder."""

from __future__ import annotations

import pytest

from tests.helpers import fitted_capture as fitted


@pytest.fixture(scope="session")
def capture(tmp_path_factory: pytest.TempPathFactory) -> fitted.Capture:
    return fitted.shared_capture(tmp_path_factory)
