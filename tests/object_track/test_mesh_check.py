"""A mesh of the wrong size, of another object, or with a symmetry that it has not, is told."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.config import ObjectTrackSettings
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup
from intercap_core.object_track.mesh_check import scaled
from intercap_core.object_track.tracker import Track, Tracker
from intercap_core.object_track.view import View, ViewGeometry
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture

FRAMES = 4


@pytest.fixture(scope="module")
def suitcase() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["suitcase"]).simplified(600)


@pytest.fixture(scope="module")
def capture(suitcase: ObjectMesh) -> ObjectCapture:
    return ObjectCapture.make(suitcase, FRAMES)


def tracked(capture: ObjectCapture, mesh: ObjectMesh) -> Track:
    images: list[list[View]] = []
    for t in range(FRAMES):
        images.append([])
        for c, camera in enumerate(capture.rig):
            depth, person, candidates = capture.image(t, c)
            geometry = ViewGeometry.for_object(camera, capture.mesh.diameter)
            images[-1].append(View.build(geometry, depth, person, candidates))
    return Tracker(
        mesh,
        images.__getitem__,
        [[[c.label for c in view.candidates] for view in views] for views in images],
        ObjectTrackSettings(),
        times=capture.times,
        labels=("suitcase",),
        up=capture.master_from_room[:3, 2],
    ).run()


def test_nothing_is_said_of_the_right_mesh(capture: ObjectCapture, suitcase: ObjectMesh) -> None:
    assert tracked(capture, suitcase).doubts == ()


@pytest.mark.parametrize(("scale", "word"), [(1.1, "10% smaller"), (0.9, "10% larger")])
def test_a_tenth_of_the_size_is_told(
    capture: ObjectCapture, suitcase: ObjectMesh, scale: float, word: str
) -> None:
    doubts = tracked(capture, scaled(suitcase, scale)).doubts
    assert any(word in doubt for doubt in doubts), doubts


def test_a_symmetry_that_the_mesh_has_not_is_told(
    capture: ObjectCapture, suitcase: ObjectMesh
) -> None:
    quarter = np.eye(4)
    quarter[:2, :2] = [[0, -1], [1, 0]]
    turns = np.array([np.linalg.matrix_power(quarter, n) for n in range(4)])
    wrong = replace(suitcase, symmetry=SymmetryGroup(turns))
    assert any("symmetry" in doubt for doubt in tracked(capture, wrong).doubts)
