"""What the estimate of time offsets is told: its velocities are what later exposures would see."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.observations import person_clouds, read_observations
from intercap_core.body_fit.schedule import Fitter, Settled
from intercap_core.body_fit.surface import COVERINGS
from intercap_core.config import BodyFitSettings
from intercap_core.joint.time_offsets import (
    OffsetPrior,
    estimate_offsets,
    observe_clouds,
    observe_keypoints,
)
from tests.helpers.bodies import open_body
from tests.helpers.body_capture import master_from_room, ring, write_capture

FRAMES, CAMERAS, FPS = 12, 4, 15.0
LATE = np.array([0.0, 0.007, -0.006, 0.004])
NOTHING = OffsetPrior(np.zeros(CAMERAS), np.full(CAMERAS, np.nan), 0)


def moving_vectors(model: BodyModel, times: np.ndarray) -> torch.Tensor:
    """Parameter vectors (T,P): somebody sways through the ring with both arms swinging."""
    x = model.zeros(len(times)).vector().double().numpy()
    x[:, 75:120], x[:, 120:165] = model.hand_mean.numpy()
    x[:, 0] = np.pi  # y down, facing the master
    room = master_from_room()
    x[:, 165:168] = room[:3, :3] @ [0, 0, 0.95] + room[:3, 3]
    x[:, 165] += 0.4 * np.sin(4 * times)
    x[:, 167] += 0.2 * np.sin(5 * times + 1)
    for side, joint in ((-1, "left_shoulder"), (1, "right_shoulder")):
        x[:, 3 * JOINT_INDEX[joint] + 2] += side * (0.9 + 0.3 * np.sin(6 * times + side))
    return torch.as_tensor(x, dtype=torch.float32)


@pytest.fixture(scope="module")
def fitted(tmp_path_factory):
    """A fitter and its problem at the true bodies, in a capture whose cameras are ``LATE``."""
    model = open_body()
    times = np.arange(FRAMES) / FPS
    seen = [model.forward(model.parameters(moving_vectors(model, times + late))) for late in LATE]
    inputs = write_capture(
        tmp_path_factory.mktemp("moving"),
        ring(CAMERAS),
        np.stack([output.vertices.double().numpy() for output in seen], 1),
        model.faces.numpy(),
        np.stack([model.keypoints(output).double().numpy() for output in seen], 1),
    )
    observed = read_observations(inputs.scene, inputs.person)
    settings = BodyFitSettings(points_per_frame=3000)
    clouds = person_clouds(inputs.frames, observed, 3000, model.device)
    fitter = Fitter(model, observed, clouds, settings)
    settled = Settled(
        torch.zeros(25, 3),
        torch.full((len(COVERINGS),), -3.0),
        fitter.evidence.keypoint_sigma,
        torch.tensor([covering.noise for covering in COVERINGS]),
        fitter.evidence.keypoint_doubt,
    )
    problem = fitter.resume(moving_vectors(model, times), settled)
    fitter.observe(problem)
    return fitter, problem


def test_velocities_are_what_a_later_exposure_changes(fitted):
    fitter, problem = fitted
    evidence, step = fitter.evidence, 0.002
    given = evidence.observations
    before = observe_keypoints(evidence, problem), observe_clouds(evidence, problem)
    evidence.observations = replace(given, time_offset=np.full(CAMERAS, step))
    fitter.observe(problem)
    after = observe_keypoints(evidence, problem), observe_clouds(evidence, problem)
    evidence.observations = given
    fitter.observe(problem)
    for a, b, tolerance in zip(before, after, (0.02, 0.05), strict=True):
        same = (a.weight > 0) & (b.weight == a.weight)
        change, expected = (b.residual - a.residual)[same], step * a.velocity[same]
        assert np.median(np.abs(expected)) > 0
        assert np.abs(change - expected).mean() < tolerance * np.abs(expected).mean()


@pytest.mark.parametrize("kind", [observe_keypoints, observe_clouds])
def test_the_true_offsets_are_found_beside_the_true_bodies(fitted, kind):
    fitter, problem = fitted
    evidence = fitter.evidence
    seen = kind(evidence, problem)
    found = estimate_offsets(
        [seen], evidence.observations.times, evidence.observations.time_offset, NOTHING
    )
    assert np.abs(found.offset - LATE).max() < 1e-3
    assert (np.abs(found.offset - LATE)[1:] < 4 * found.sigma[1:] + 1e-4).all()
