"""Grasps that people would hold: no finger inside a cup."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from intercap_core.config import ObjectEntry, StudioCapture, StudioSettings
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.studio.interactions.grasps import Hollow
from intercap_core.studio.interactions.handling import HandlingScript
from intercap_core.studio.motion import RIGHT
from intercap_core.studio.stage import StudioStage


def test_half_of_all_directions_meet_a_wide_wall_and_all_a_shell() -> None:
    wall = trimesh.creation.box((20.0, 20.0, 0.02))
    share = Hollow(DistanceField(wall.vertices, wall.faces)).share(np.array([[0, 0, 0.02]]))
    assert share[0] == pytest.approx(0.5, abs=2 / Hollow.directions)
    shell = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    inside = Hollow(DistanceField(shell.vertices, shell.faces)).share(np.zeros((1, 3)))
    assert inside[0] == 1


@pytest.mark.parametrize("subject", ["s03", "s06"])
def test_no_finger_is_in_the_cup(subject: str, object_entry: Callable[[str], ObjectEntry]) -> None:
    capture = StudioCapture(interaction="cup_drink", subject=subject, seed=911, frames=3)
    stage = StudioStage(capture, StudioSettings(captures={}, cameras=1), object_entry("cup"))
    script = stage.interaction
    assert isinstance(script, HandlingScript)
    low, high = stage.bounds[:, 2]
    hollow = Hollow(stage.prop.surface)
    assert hollow.holds(np.array([[0.0, 0.0, (low + high) / 2]]))
    assert not hollow.holds(np.array([[0.0, 0.0, high + 0.02]]))
    hand, grip = stage.puppet.hands[RIGHT], script.grips[RIGHT]
    skin = hand.skin(hand.local(grip.closed)[None])[0]
    at = skin @ grip.object_from_wrist[:3, :3].T + grip.object_from_wrist[:3, 3]
    # by the cup's own shape: within the wall's middle line and below the rim
    in_cup = (np.hypot(at[:, 0], at[:, 1]) < 0.034) & (at[:, 2] < high - 0.005)
    assert not in_cup.any()
    assert grip.gaps.max() < 0.003
