"""Limbs, hands and grasps of a puppet."""

from __future__ import annotations

import numpy as np
import pytest

from intercap_core.studio.interactions.grasps import Hollow
from intercap_core.studio.interactions.handling import HandlingScript
from intercap_core.studio.motion import RIGHT
from intercap_core.studio.skeleton import REACH_FREE, PuppetSkeleton
from intercap_core.studio.subjects import Subject
from tests.studio.studio_stage import make_stage


def test_limb_reaches_its_target_and_bends_to_the_pole() -> None:
    skeleton = PuppetSkeleton(Subject.load("s03").rest_joints)
    rng = np.random.default_rng(0)
    names = ("left_hip", "left_knee", "left_ankle")
    root, direction, pole = rng.normal(size=(3, 50, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    length = rng.uniform(0.4, REACH_FREE, (50, 1)) * skeleton.length(*names)
    target = root + direction * length
    upper, lower = skeleton.limb(names, root, target, pole, np.array([1.0, 0, 0]))
    knee = root + upper @ skeleton.bone(*names[:2])
    end = knee + lower @ skeleton.bone(*names[1:])
    np.testing.assert_allclose(end, target, atol=1e-9)
    across = pole - direction * (pole * direction).sum(1, keepdims=True)
    assert (((knee - root) * across).sum(1) > 0).all()
    np.testing.assert_allclose(np.linalg.det(upper), 1, atol=1e-9)


@pytest.mark.parametrize("subject", ["s03", pytest.param("s06", marks=pytest.mark.full)])
def test_no_finger_is_inside_the_cup(subject: str) -> None:
    stage = make_stage("cup_drink", subject, 911, 3)
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
