"""Objects of one colour, printed ones and those that look like their mesh."""

import numpy as np
import pytest

from intercap_core.studio.objects import object_colours


@pytest.fixture
def ball() -> np.ndarray:
    points = np.random.default_rng(0).normal(size=(2000, 3))
    return 0.1 * points / np.linalg.norm(points, axis=1, keepdims=True)


def test_a_plain_object_has_one_colour_and_a_printed_one_sides(ball):
    of_mesh = np.full((len(ball), 3), 0.5)
    for seed in range(8):
        plain, printed = (
            object_colours(look, ball, of_mesh, np.random.default_rng(seed))
            for look in ("plain", "printed")
        )
        assert len(np.unique(plain, axis=0)) == 1
        assert 2 <= len(np.unique(printed, axis=0)) <= 7
        common = (printed == plain[0]).all(1)
        assert 0.02 < common.mean() < 0.98, "spots leave some of the first colour"
        turned = printed[np.argsort(np.arctan2(ball[:, 1], ball[:, 0]))]
        assert not np.allclose(turned, np.roll(turned, len(ball) // 2, axis=0))


def test_an_object_may_look_like_its_mesh(ball):
    of_mesh = np.random.default_rng(1).random((len(ball), 3))
    assert object_colours("mesh", ball, of_mesh, np.random.default_rng(0)) is of_mesh
