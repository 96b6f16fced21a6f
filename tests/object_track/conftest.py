"""Captures of a suitcase that several files share."""

from __future__ import annotations

import pytest

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.view import FitContext, View
from tests.helpers.object_capture import ObjectCapture
from tests.object_track.scenes import images_of, mesh_of


@pytest.fixture(scope="session")
def suitcase() -> ObjectMesh:
    return mesh_of("suitcase")


@pytest.fixture(scope="session")
def capture(suitcase: ObjectMesh) -> ObjectCapture:
    """Five frames of a suitcase that glides and turns."""
    return ObjectCapture.make(suitcase, 5)


@pytest.fixture(scope="session")
def images(capture: ObjectCapture) -> list[list[View]]:
    return images_of(capture)


@pytest.fixture(scope="session")
def views(images: list[list[View]]) -> list[View]:
    return images[0]


@pytest.fixture(scope="session")
def context(suitcase: ObjectMesh) -> FitContext:
    return FitContext(suitcase, ("suitcase",))
