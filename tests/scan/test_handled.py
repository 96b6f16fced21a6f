"""Choice of the handled object among the candidates."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import trimesh

from intercap_core.errors import UserError
from intercap_core.scan.handled import find_handled, is_still, slowest
from tests.scan.turned_object import Turned, turning

BALL = trimesh.creation.icosphere(radius=0.05)
STILL, MOVING = np.zeros((8, 3)), np.linspace([0, 0, 0], [0, 0.3, 0.0], 8)
ASIDE = np.array([0.25, -0.2, 0.0])


def recording(*paths: np.ndarray) -> Any:
    poses = np.stack([turning(8, 10.0, path) for path in paths])
    return Turned([(BALL.vertices.copy(), BALL.faces.copy())] * len(paths), poses)


def test_the_object_that_moves_is_found_next_to_one_that_stands() -> None:
    found = find_handled(recording(ASIDE + STILL, MOVING), "ball")
    assert sorted(found) == list(range(8)) and not is_still(found)
    middle = np.concatenate([view.points for view in found[7]]).mean(0)
    np.testing.assert_allclose(middle, MOVING[7], atol=0.02)


def test_the_slowest_frame_sets_are_those_at_rest() -> None:
    path = np.concatenate([np.zeros((4, 3)), np.linspace([0, 0, 0], [0, 0.4, 0], 4)])
    found = find_handled(recording(path), "ball")
    assert set(slowest(found)) <= {0, 1, 2, 3}


def test_a_single_object_may_stand_still() -> None:
    assert is_still(find_handled(recording(STILL), "ball"))


@pytest.mark.parametrize(
    ("paths", "message"),
    [
        ((STILL, ASIDE + STILL), "2 objects stand still.*name its detector class"),
        ((MOVING, ASIDE - MOVING), "two objects move.*record it alone"),
    ],
)
def test_what_cannot_be_told_apart_is_refused(paths: Any, message: str) -> None:
    with pytest.raises(UserError, match=f"sequence turned: .*{message}"):
        find_handled(recording(*paths), "ball")


def test_an_object_without_depth_is_refused() -> None:
    empty = recording(np.add(STILL, (0, 0, 5.0)))
    with pytest.raises(UserError, match=r"no depth image shows a candidate of 'ball'.*transparent"):
        find_handled(empty, "ball")
