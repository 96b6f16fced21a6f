"""The open body's named grasps, rebuilt by the file's own components, measured on its skin."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from intercap_core.body import priors
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.geometry.rigid.distance import DistanceField
from tests.helpers.bodies import posed_normals

from .conftest import open_arrays

Posed = Callable[[str], np.ndarray]
Bones = Callable[..., np.ndarray]
FINGERS = ("index", "middle", "pinky", "ring", "thumb")
NAMES = ("flat", "relaxed", "fist", "medium_wrap", "small_diameter", "pinch", "tripod", "lateral",
         "point")  # fmt: skip
DOWN = np.array([0.0, -1, 0])
THUMB_PAD = np.array([0.26, -0.15, -0.96])  # across the section of its end phalanx, T-pose


@pytest.fixture(scope="module")
def poses(body64: BodyModel) -> dict[str, torch.Tensor]:
    """Left hand's (45,) by grasp, rebuilt by twenty components."""
    sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
    from open_body import gallery, hands

    mean, few = body64.hand_mean[0], body64.hand_components[0, :20]
    rest = gallery.rest_points(body64)
    grasps = {name: torch.as_tensor(hands.named_grasp(name, *rest)) for name in NAMES}
    return {name: mean + (pose - mean) @ few.T @ few for name, pose in grasps.items()}


@pytest.fixture(scope="module")
def posed(body64: BodyModel, poses: dict[str, torch.Tensor]) -> Posed:
    """Skin (V,3) of the mean body with its left hand in a grasp."""

    def skin(name: str) -> np.ndarray:
        params = body64.zeros()
        params.left_hand_pose[0] = poses[name]
        return body64.forward(params).vertices[0].numpy()

    return skin


@pytest.fixture(scope="module")
def normals(body64: BodyModel) -> np.ndarray:
    """Unit normals (V,3) of the skin in the T-pose."""
    return posed_normals(body64, body64.zeros())[1][0].numpy()


@pytest.fixture(scope="module")
def bones() -> Bones:
    """Which vertices (V,) mostly go with some of the left hand's joints."""
    weights = open_arrays()["weights"]
    return lambda *names: weights[:, [JOINT_INDEX[f"left_{n}"] for n in names]].sum(1) > 0.5


def _closed(skin: np.ndarray, faces: np.ndarray, mine: np.ndarray) -> DistanceField:
    """A part of the skin, its openings closed by fans about their centres."""
    own = faces[mine[faces].all(1)]
    edges = np.concatenate([own[:, [0, 1]], own[:, [1, 2]], own[:, [2, 0]]])
    known = {tuple(edge) for edge in edges.tolist()}
    following = {a: b for a, b in edges.tolist() if (b, a) not in known}
    points, caps = list(skin), []
    while following:
        loop = [next(iter(following))]
        while (end := following.pop(loop[-1])) != loop[0]:
            loop.append(end)
        caps += [(b, a, len(points)) for a, b in zip(loop, loop[1:] + loop[:1], strict=True)]
        points.append(skin[loop].mean(0))
    return DistanceField(np.array(points), np.concatenate([own, np.array(caps)]), threads=1)


def _gap(skin: np.ndarray, first: np.ndarray, second: np.ndarray) -> float:
    """Smallest distance between two sets of vertices, metres."""
    return float(np.linalg.norm(skin[first][:, None] - skin[second], axis=-1).min())


def test_pads_of_thumb_and_fingers_meet(posed: Posed, bones: Bones, normals: np.ndarray) -> None:
    def part(phalanx: str, way: np.ndarray) -> np.ndarray:
        return np.flatnonzero(bones(phalanx) & (normals @ way > 0.7))

    thumb = part("thumb3", THUMB_PAD)
    index, middle = part("index3", DOWN), part("middle3", DOWN)
    assert _gap(posed("pinch"), thumb, index) < 0.005
    assert _gap(posed("tripod"), thumb, index) < 0.008
    assert _gap(posed("tripod"), thumb, middle) < 0.006
    assert _gap(posed("lateral"), thumb, part("index2", np.array([0.0, 0, 1]))) < 0.006
    backs = part("index2", -DOWN), part("middle2", -DOWN)
    assert _gap(posed("fist"), part("thumb2", THUMB_PAD), backs[0]) < 0.008
    assert _gap(posed("fist"), thumb, backs[1]) < 0.006
    assert _gap(posed("point"), thumb, backs[1]) < 0.006


@pytest.mark.parametrize("name", NAMES)
def test_the_thumb_penetrates_no_finger(
    name: str, body64: BodyModel, posed: Posed, bones: Bones
) -> None:
    skin, faces = posed(name), body64.faces.numpy()
    thumb = bones("thumb2", "thumb3")
    inside_thumb = _closed(skin, faces, thumb)
    for finger in FINGERS[:4]:
        mine = bones(*(f"{finger}{i}" for i in (1, 2, 3)))
        depth = max(
            -_closed(skin, faces, mine).signed_distance(skin[thumb]).min(),
            -inside_thumb.signed_distance(skin[mine]).min(),
        )
        assert depth < 0.003


def test_grasps_are_likely_and_within_limits(
    body64: BodyModel, poses: dict[str, torch.Tensor]
) -> None:
    vector = torch.zeros(len(poses), body64.num_parameters, dtype=torch.float64)
    vector[:, 75:120] = torch.stack(list(poses.values()))
    assert priors.joint_limits(vector).residuals.abs().max() < np.radians(3)
    own = (body64.hand_mean, body64.hand_components, body64.hand_deviation)
    code = priors.hand_pose(vector, *own, side=0).residuals
    assert (code**2).mean(1).max() < 1
