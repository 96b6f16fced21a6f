"""Shape and the detector's offsets are settled together with the hands."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.observations import Observations
from intercap_core.body_fit.schedule import Fitter
from intercap_core.config import BodyFitSettings
from intercap_core.geometry.camera.transforms import apply
from tests.helpers.bodies import open_body
from tests.helpers.body_capture import FPS, master_from_room, ring

FRAMES = 4
DETECTOR_M = 0.02  # the body detector's wrist lies so far down the hand
WRISTS = [JOINT_INDEX["left_wrist"], JOINT_INDEX["right_wrist"]]
ELBOWS = [JOINT_INDEX["left_elbow"], JOINT_INDEX["right_elbow"]]


def _person(model: BodyModel) -> torch.Tensor:
    """Vectors (T,P) of somebody whose arms swing, with fingers bent."""
    random = np.random.default_rng(3)
    x = model.zeros(FRAMES).vector().double().numpy()
    swing = np.sin(np.linspace(0, np.pi, FRAMES))
    for side, sign in (("left", 1), ("right", -1)):
        x[:, 3 * JOINT_INDEX[f"{side}_shoulder"] + 2] = -sign * 0.9
        x[:, 3 * JOINT_INDEX[f"{side}_elbow"] + 1] = -sign * (0.7 + 0.5 * swing)
        x[:, 3 * JOINT_INDEX[f"{side}_wrist"] : 3 * JOINT_INDEX[f"{side}_wrist"] + 3] = (
            0.2 * random.standard_normal(3)
        )
    x[:, 75:120], x[:, 120:165] = model.hand_mean.numpy()
    x[:, 168:178] = random.standard_normal(10)
    room = master_from_room()
    upright = Rotation.from_matrix([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    x[:, :3] = (Rotation.from_matrix(room[:3, :3]) * upright).as_rotvec()
    x[:, 165:168] = apply(room, np.array([[0.0, 0.0, 0.95]]))
    return torch.as_tensor(x, dtype=torch.float32)


def _seen(model: BodyModel, truth: torch.Tensor) -> Observations:
    """Keypoints with half a pixel of noise in five views; the body's wrists down the hand."""
    output = model.forward(model.parameters(truth))
    points = model.keypoints(output).double().numpy()
    joints = output.joints.double().numpy()
    for side, wrist, elbow in zip(("left", "right"), WRISTS, ELBOWS, strict=True):
        forearm = joints[:, wrist] - joints[:, elbow]
        forearm /= np.linalg.norm(forearm, axis=1, keepdims=True)
        points[:, KEYPOINT_NAMES.index(f"{side}_wrist")] += DETECTOR_M * forearm
    rig, random = ring(5), np.random.default_rng(0)
    pixels = np.stack([c.colour.project(apply(c.colour_from_master, points)) for c in rig], 1)
    pixels += 0.5 * random.standard_normal(pixels.shape)
    views = np.full(points.shape[:2], len(rig))
    return Observations(
        "test", rig, pixels, np.full(pixels.shape[:3], 0.9), points, views,
        [None] * len(rig), np.zeros(len(rig)),
        np.repeat(np.arange(FRAMES)[:, None], len(rig), 1), np.zeros(len(rig)),
        np.arange(FRAMES) / FPS,
    )  # fmt: skip


def test_hands_separate_wrist_offset_from_forearm_length():
    """Held at what the body's keypoints alone say, the forearm is taken to be longer."""
    model = open_body()
    truth = _person(model)
    true = model.forward(model.parameters(truth)).joints.numpy()
    fit = Fitter(model, _seen(model, truth), [None] * FRAMES, BodyFitSettings()).run()
    found = model.forward(model.parameters(fit.vectors)).joints.numpy()
    forearm = true[:, WRISTS] - true[:, ELBOWS]
    forearm /= np.linalg.norm(forearm, axis=2, keepdims=True)
    along = 1e3 * ((found - true)[:, WRISTS] * forearm).sum(2)
    lengths = [np.linalg.norm(x[:, WRISTS] - x[:, ELBOWS], axis=2) for x in (found, true)]
    wrists = [KEYPOINT_NAMES.index(f"{side}_wrist") for side in ("left", "right")]
    offsets = fit.settled.offsets[wrists].norm(dim=1).numpy()
    assert np.abs(along.mean(0)).max() < 1.5  # held: 2.3 mm
    assert np.abs(lengths[0] - lengths[1]).max() < 0.008  # held: 13 mm too long
    np.testing.assert_allclose(offsets, DETECTOR_M, atol=0.005)
