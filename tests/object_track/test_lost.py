"""Which poses are not believed."""

from dataclasses import replace

import numpy as np
import pytest

from intercap_core.config import ObjectTrackSettings
from intercap_core.object_track.fit import Fit
from intercap_core.object_track.lost import (
    UNNAMED_FRAMES,
    FrameResult,
    decided,
    doubted,
    judged,
)
from intercap_core.object_track.view_report import ViewReport, unhidden
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.rigid.shots import Rendering
from tests.rigid.conftest import catalogue

SEEN = ViewReport(0, 0.9, 0.002, 1.0, 500, 0.95)
UNNAMED = replace(SEEN, candidate=-1, overlap=float("nan"))


@pytest.fixture(scope="module")
def mesh() -> ObjectMesh:
    return ObjectMesh.load(catalogue()["bottle"])


def _fit(x: float = 0.0, view: ViewReport = SEEN, sigma=(0.01, 0.002)) -> Fit:
    pose = np.eye(4)
    pose[0, 3] = x
    return Fit(pose, np.diag(np.repeat(np.square(sigma), 3)), (view,) * 4)


def test_few_frames_do_not_decide_by_a_little():
    assert not decided(np.array([0.015]))
    assert not decided(np.zeros(0))
    assert decided(np.array([0.05])) and decided(np.full(40, -0.015))


def test_masks_that_hardly_overlap_are_no_support():
    settings = ObjectTrackSettings()
    assert not judged(_fit(), settings).lost
    assert judged(_fit(view=replace(SEEN, overlap=0.1, depth_agreement=0.1)), settings).lost


def test_depth_alone_is_believed_for_a_moment_and_where_the_object_was(mesh):
    """Moved by 20 cm a frame without a candidate, the middle of a long run is not believed."""
    moving = [_fit(0.2 * t, SEEN if t in (0, 19) else UNNAMED) for t in range(20)]
    lost = [f.lost for f in doubted(mesh, [FrameResult(fit, False) for fit in moving])]
    inside = range(UNNAMED_FRAMES + 1, 19 - UNNAMED_FRAMES)
    assert lost == [t in inside for t in range(20)]
    still = [_fit(0.0, SEEN if t == 0 else UNNAMED) for t in range(20)]
    assert not any(f.lost for f in doubted(mesh, [FrameResult(fit, False) for fit in still]))
    undetected = [_fit(0.2 * t, replace(UNNAMED, detected=False)) for t in range(20)]
    assert not any(f.lost for f in doubted(mesh, [FrameResult(fit, False) for fit in undetected]))


def test_an_uncertain_place_is_lost_and_an_uncertain_turn_ambiguous(mesh):
    def flags(fit):
        found = doubted(mesh, [FrameResult(fit, False)])[0]
        return found.lost, found.ambiguous

    assert flags(_fit()) == (False, False)
    assert flags(_fit(sigma=(0.01, 0.05))) == (True, False)
    assert flags(_fit(sigma=(0.6, 0.002))) == (False, True)
    spin = _fit()
    spin.covariance[2, 2] = 4.0  # about the bottle's own axis
    assert flags(spin) == (False, False)


def test_what_depth_finds_something_before_is_not_visible() -> None:
    face = np.zeros((20, 20), np.int32)
    drawn = Rendering(0, 0, np.ones((20, 20), np.float32), face, face.astype(np.int16))
    assert unhidden(drawn, 400, 90, 100) == 360
    assert unhidden(drawn, 200, 90, 100) == 200  # a person's mask covers the rest
    assert unhidden(drawn, 400, 5, 100) == 0
    assert unhidden(drawn, 400, 0, 3) == 400  # too little measured to tell
