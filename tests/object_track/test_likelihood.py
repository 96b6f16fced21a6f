"""One log-likelihood ratio for all poses: what raises it, what lowers it, what says nothing."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.object_track.constants import LABEL_LOG_RATIO, LOG_MISSED
from intercap_core.object_track.fit import Fit, assess_all
from intercap_core.object_track.likelihood_kernel import outline_cost
from intercap_core.object_track.view import View, ViewGeometry
from tests.geometry.rigid.conftest import catalogue
from tests.helpers.object_capture import ObjectCapture

NONE = np.zeros((0, 0), bool)


@pytest.fixture(scope="module")
def capture() -> ObjectCapture:
    return ObjectCapture.make(ObjectMesh.load(catalogue()["suitcase"]).simplified(600), 3)


@pytest.fixture(scope="module")
def views(capture: ObjectCapture) -> list[View]:
    found = []
    for c, camera in enumerate(capture.rig):
        depth, person, candidates = capture.image(0, c)
        geometry = ViewGeometry.for_object(camera, capture.mesh.diameter)
        found.append(View.build(geometry, depth, person, candidates))
    return found


def ratios(capture: ObjectCapture, views: list[View], poses: np.ndarray, labels=()) -> np.ndarray:
    found = assess_all(capture.mesh, views, poses, min_overlap=0.1, labels=labels)
    return np.array([fit.log_ratio for fit in found])


def moved(pose: np.ndarray, metres: float = 0.0, degrees: float = 0.0) -> np.ndarray:
    result = pose.copy()
    result[:3, :3] = pose[:3, :3] @ Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    result[0, 3] += metres
    return result


def test_it_falls_with_the_error_and_speaks_for_no_wrong_place(capture, views) -> None:
    true = capture.poses[0]
    by_shift = ratios(capture, views, np.array([moved(true, m) for m in (0, 0.01, 0.03, 0.1, 0.6)]))
    by_turn = ratios(capture, views, np.array([moved(true, 0, d) for d in (0, 5, 15, 40)]))
    assert (np.diff(by_shift[:4]) < 0).all() and (np.diff(by_turn) < 0).all()
    assert by_shift[0] > 30 and by_shift[3:].max() < 0


def test_each_view_adds_its_own(capture, views) -> None:
    pose = capture.poses[:1]
    alone = [ratios(capture, [view], pose)[0] for view in views]
    assert ratios(capture, views, pose)[0] == pytest.approx(sum(alone))


def test_what_nothing_shows_says_nothing(capture, views) -> None:
    """Behind every camera, or with no detector and no depth."""
    behind = moved(capture.poses[0], 40.0)
    blind = [replace(view, depth=None, candidates=(), detected=False) for view in views]
    assert ratios(capture, views, behind[None]) == pytest.approx(0, abs=1e-9)
    assert ratios(capture, blind, capture.poses[:1]) == pytest.approx(0, abs=1e-9)


def test_what_the_empty_room_explains_is_no_evidence_outside_a_mask(capture, views) -> None:
    """The depth is the room's own: without candidates nothing speaks for the object there, with
    them the masks do; where something else is measured, the room takes nothing away."""
    pose = capture.poses[:1]
    unseen = [replace(view, candidates=()) for view in views]
    fits = ratios(capture, unseen, pose)[0]
    room = [replace(view, background=view.depth) for view in unseen]
    assert fits > 10 and ratios(capture, room, pose)[0] <= 0
    in_mask = [replace(view, background=view.depth) for view in views]
    assert ratios(capture, in_mask, pose)[0] > 0.9 * ratios(capture, views, pose)[0]
    before_wall = [replace(view, background=view.depth + np.float32(0.5)) for view in unseen]
    assert ratios(capture, before_wall, pose)[0] == pytest.approx(fits)
    seen_past = ratios(capture, unseen, moved(pose[0], 0.6)[None])[0]
    assert ratios(capture, room, moved(pose[0], 0.6)[None])[0] <= seen_past + 1e-9


def test_a_missed_object_costs_as_much_as_a_detector_misses(capture, views) -> None:
    unnamed = [replace(view, depth=None, candidates=()) for view in views]
    found = assess_all(capture.mesh, unnamed, capture.poses[:1], min_overlap=0.1)[0]
    assert all(LOG_MISSED < view.log_ratio < 0 for view in found.views)
    hidden = [replace(view, person=_everywhere(view)) for view in unnamed]
    assert ratios(capture, hidden, capture.poses[:1])[0] == pytest.approx(0)


def _everywhere(view: View):
    lens = view.geometry.lens
    return replace(view.person, x0=0, y0=0, mask=np.ones((lens.height, lens.width), bool))


def test_a_label_tips_the_scales_and_no_more(capture, views) -> None:
    named = [
        replace(
            view,
            depth=None,
            candidates=tuple(replace(one, label="suitcase") for one in view.candidates),
        )
        for view in views
    ]
    right = ratios(capture, named, capture.poses[:1], ("suitcase",))[0]
    wrong = ratios(capture, named, capture.poses[:1], ("cup",))[0]
    assert 0 < wrong < right <= wrong + 2 * LABEL_LOG_RATIO * len(views) + 1e-9


def test_the_fit_ends_with_the_same_likelihood(capture, views) -> None:
    """:func:`fit_pose` reports what :func:`assess_all` says of its pose."""
    from intercap_core.object_track.fit import fit_pose

    fit: Fit = fit_pose(
        capture.mesh, views, capture.poses[0], prior=None, min_overlap=0.1, background_term=True
    )
    # its last renderings may be a millimetre from its last step
    assert ratios(capture, views, fit.pose[None])[0] == pytest.approx(fit.log_ratio, abs=1.0)


def square(size: int) -> np.ndarray:
    return np.ones((size, size), bool)


def cost(face: np.ndarray, mask: np.ndarray, at: tuple[int, int], person=NONE) -> tuple[float, int]:
    drawn = np.where(face, 0, -1).astype(np.int32)
    return outline_cost(drawn, 50, 50, mask, *at, person, 50, 50, 200, 200, 1.0, 4.5)


def test_outlines_by_hand() -> None:
    assert cost(square(20), square(20), (50, 50)) == (0.0, 152)
    # shifted by two: the sides along the shift keep their distance 0, the others are 2 away
    shifted, count = cost(square(20), square(20), (52, 50))
    assert count == 152 and 0.4 < shifted < 1.3
    assert cost(square(20), square(2), (90, 90))[0] == 4.5  # nowhere near
    # a person beside the mask ends its outline there; what is left agrees
    half = square(20)
    half[:, 10:] = False
    covered = np.zeros((20, 20), bool)
    covered[:, 10:] = True
    agreed, fewer = cost(square(20), half, (50, 50), covered)
    assert agreed == 0.0 and 0 < fewer < 100
