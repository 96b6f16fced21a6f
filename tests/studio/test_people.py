"""People and their shoes."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from intercap_core.body.model import BodyModel
from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.studio.stage import StudioStage
from intercap_core.studio.subjects import (
    SOLE_M,
    Subject,
)


@pytest.fixture(scope="module")
def person() -> Subject:
    return Subject.load("s04")


def test_the_rest_pose_is_the_rest_mesh(person: Subject) -> None:
    shift = np.array([0.1, 0.2, 0.3])
    out = person.skin(np.zeros((1, 165)), shift[None])
    assert np.allclose(out.vertices[0], person.rest + shift, atol=1e-9)
    assert np.allclose(out.joints[0], person.rest_joints + shift)
    assert np.allclose(out.tips[0], person.rest_tips + shift)


def test_poses_agree_with_the_fitted_body(person: Subject, body: BodyModel) -> None:
    """Limb directions of the posed skeleton agree, although the bones' lengths do not."""
    pose = np.zeros((1, 165))
    pose[0, [48, 51, 55, 12, 1]] = [0.3, -0.2, -1.2, 1.1, 0.7]
    truth = person.skin(pose, np.zeros((1, 3))).joints[0]
    ours = (
        body.forward(
            body.parameters(torch.as_tensor(np.c_[pose, np.zeros((1, 23))], dtype=torch.float32))
        )
        .joints[0]
        .numpy()
    )
    for a, b in ((16, 18), (18, 20), (17, 19), (1, 4), (4, 7), (28, 29)):
        u, w = truth[b] - truth[a], ours[b] - ours[a]
        assert u @ w / np.linalg.norm(u) / np.linalg.norm(w) > np.cos(np.radians(3))


def test_mapped_points_are_on_the_surface_and_on_the_same_limb(
    person: Subject, body: BodyModel
) -> None:
    mapped = person.on_fitted_topology(person.rest[None])[0]
    own = body.skinning_weights.numpy().argmax(1)
    theirs = np.asarray(person.weights.argmax(1)).ravel()[person.faces[person.fitted_face]]
    hands = np.flatnonzero(own >= 25)
    assert (np.abs(theirs[hands] - own[hands, None]).min(1) <= 2).mean() > 0.97
    assert mapped.shape == (body.num_vertices, 3)
    assert person.fitted_bary.min() >= 0


def test_a_person_stands_on_the_soles() -> None:
    """Bare feet are at the height of the sole, soles on the floor."""
    settings = StudioSettings(captures={}, cameras=1)
    for shoes, height in (("plain", 0.0), ("heavy", SOLE_M)):
        capture = StudioCapture(
            interaction="walk_and_wave", subject="s06", seed=11, frames=20, shoes=shoes
        )
        stage = StudioStage(capture, settings, None)
        state = stage.at(stage.set_times[::4])
        lowest, soles = (part[..., 2].min(1) for part in (state.body, state.clothed))
        assert np.abs(soles).max() < 0.001 and np.abs(lowest - height).max() < 0.001
