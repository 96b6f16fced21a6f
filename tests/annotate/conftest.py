"""A small project that the tests share, and a copy for each test that changes it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from intercap_core.annotate.opened import Opened
from intercap_core.project import load_project
from tests.annotate.served import NAME, copied, small_project
from tests.helpers.shared_folder import shared_folder


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Settings of a project of one sequence with six frames; read only."""
    folder = shared_folder(tmp_path_factory, "annotated", small_project)
    return folder / "project" / "config.yaml"


@pytest.fixture
def settings(made: Path, tmp_path: Path) -> Path:
    return copied(made, tmp_path / "project")


@pytest.fixture
def opened(settings: Path) -> Iterator[Opened]:
    opened = Opened(load_project(settings), NAME)
    yield opened
    opened.close()
