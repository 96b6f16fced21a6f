"""Cameras placed by the background that they share, in rooms that do and do not determine it."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

from intercap_core.calibrate.background import confirm_by_joints, place_by_background
from intercap_core.errors import UserError
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.scene.background import Background
from tests.calibrate.synthetic_views import views_of_walker
from tests.helpers.synthetic_capture import (
    FURNITURE,
    extrinsics_error,
    ring,
    room_depth,
    to_millimetres,
)

SIX, UP = ring(6)
TRUTH = Rig(SIX.cameras[:4])  # four on a half circle
MIDDLE = apply(invert(UP), np.array([[0, 0, 0.8]]))[0]
UNKNOWN = TRUTH.moved(np.broadcast_to(np.eye(4), (4, 4, 4)))
NOTHING = np.zeros((0, 2, 3))
# cupboards and a shelf along the walls, which without them look alike from four places
WALLED = np.array([
    [[2.6, -0.6, 0], [3.6, 0.9, 2.0]],
    [[-3.6, 1.8, 0], [-2.9, 3.0, 1.5]],
    [[-1.0, -3.6, 0], [0.3, -3.1, 2.2]],
])  # fmt: skip
ROOM = np.concatenate([FURNITURE, WALLED])


@cache
def images(room: str) -> list[np.ndarray]:
    """Depth images (H, W), mm, of the four cameras."""
    boxes, walls = {
        "furnished": (ROOM, 3.6), "bare": (NOTHING, None),
    }[room]  # fmt: skip
    rng = np.random.default_rng(1)
    return [to_millimetres(room_depth(camera, UP, boxes, walls), rng) for camera in TRUTH]


def backgrounds(room: str) -> list[Background | None]:
    return [Background(depth, depth > 0) for depth in images(room)]


GRAVITY = TRUTH.master_from_colour[:, :3, :3].transpose(0, 2, 1) @ -UP[2, :3]
"""Down (C, 3) in each camera."""


def errors_m(rig: Rig) -> np.ndarray:
    """Errors (C,) of a rig, moved so that its first camera is at its true pose."""
    poses = rig.master_from_colour
    return extrinsics_error(rig.moved(invert(poses[0]) @ poses), TRUTH, MIDDLE)


def test_a_furnished_room_places_all_cameras() -> None:
    unmeasured = np.full((4, 3), np.nan)
    rig, witnesses = place_by_background(UNKNOWN, backgrounds("furnished"), unmeasured, [])
    assert sorted(witnesses) == [0, 1, 2, 3]
    assert all(len(others) >= 2 and c not in others for c, others in witnesses.items())
    assert errors_m(rig).max() < 0.1


def test_placed_cameras_stay_and_place_the_others() -> None:
    start = Rig((*TRUTH.cameras[:3], UNKNOWN.cameras[3]))
    rig, witnesses = place_by_background(start, backgrounds("furnished"), GRAVITY, [0, 1, 2])
    assert list(witnesses) == [3] and len(witnesses[3]) >= 2
    assert (rig.master_from_colour[:3] == TRUTH.master_from_colour[:3]).all()
    assert errors_m(rig).max() < 0.1


def test_a_bare_floor_determines_nothing() -> None:
    rig, witnesses = place_by_background(UNKNOWN, backgrounds("bare"), GRAVITY, [])
    assert not witnesses
    assert (rig.master_from_colour == UNKNOWN.master_from_colour).all()


def test_two_cameras_cannot_confirm_each_other() -> None:
    seen = [*backgrounds("furnished")[:2], None, None]
    assert not place_by_background(UNKNOWN, seen, GRAVITY, [])[1]


def test_a_person_confirms_or_contradicts_the_background() -> None:
    rig, _, views = views_of_walker(4, sets=15, noise_px=1.0, depth=True)
    confirm_by_joints(rig, views, {2: frozenset({0, 1})})
    half_turn = np.diag([-1.0, -1.0, 1.0, 1.0])
    zup_from_master = ring(4)[1]
    poses = rig.master_from_colour.copy()
    poses[2] = invert(zup_from_master) @ half_turn @ zup_from_master @ poses[2]
    with pytest.raises(UserError, match=r"k3: its background fits to that of k1, k2.*not where"):
        confirm_by_joints(rig.moved(poses), views, {2: frozenset({0, 1})})
    empty = views.only(np.zeros(views.confidence.shape, bool))
    with pytest.raises(UserError, match=r"k3.*too few joints.*walk through the common view"):
        confirm_by_joints(rig, empty, {2: frozenset({0, 1})})
