"""A project with ten frames and uncertain contact, which the tests of the page share."""

from __future__ import annotations

from pathlib import Path

import h5py
import pytest

from tests.annotate.served import artefact, small_project


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = small_project(tmp_path_factory.mktemp("browsed"), total=10)
    with h5py.File(artefact(settings, "joint"), "r+") as file:
        names = [name.decode() for name in file["region_names"][:]]
        file["contact_probability"][...] = 0.02
        file["contact_probability"][2:8, names.index("right_hand")] = 0.9
        file["contact_probability"][4:8, names.index("seat")] = 0.45
        file["contact_annotated"][...] = -1
    return settings
