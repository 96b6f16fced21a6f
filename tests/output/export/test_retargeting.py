"""Files for GMR and holosoma, read as their loaders do: the same names, slices and orders."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.geometry.camera.transforms import apply
from intercap_core.output.export.motion import Motion, read_motion
from intercap_core.output.export.retargeting import Resampled
from intercap_core.schemas import JOINT
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

DOCS = Path(__file__).resolve().parents[3] / "docs" / "exports.md"
# Places of joints among holosoma's SMPLH_DEMO_JOINTS, and their names in SMPL-X
SMPLH_PLACES = {
    0: "pelvis", 4: "left_foot", 5: "right_hip", 9: "spine1", 13: "head", 14: "left_collar",
    17: "left_wrist", 18: "left_index1", 24: "left_pinky1", 32: "left_thumb3", 36: "right_wrist",
    46: "right_ring1", 51: "right_thumb3",
}  # fmt: skip


@pytest.fixture(scope="module")
def folder(lively: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("retargeting") / "out"
    return exported.run(lively, out, formats=["gmr", "holosoma"], frame="camera")


@pytest.fixture(scope="module")
def motion(lively: fitted.Capture, zup_from_master: np.ndarray) -> Motion:
    read = read_motion(lively.paths["joint"], fitted.FPS, fitted.BODY_MODELS, "neutral")
    return read.moved(zup_from_master, "z-up")


@pytest.fixture(scope="module")
def joints(lively: fitted.Capture, zup_from_master: np.ndarray) -> np.ndarray:
    """Joints (T, 55, 3) of the joint result, z-up."""
    with artefacts.read(lively.paths["joint"], JOINT) as joint:
        return apply(zup_from_master, joint["joints"].astype(float))


def _load(path: Path) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """The loader of docs/exports.md."""
    code = re.search(r"```python\n# object_poses\.py\n(.*?)```", DOCS.read_text(), re.DOTALL)
    assert code is not None and len(code[1].split("def load")[1].strip().splitlines()) <= 10
    names: dict[str, Any] = {}
    exec(code[1], names)
    return names["load"](path)


def test_gmr_reads_the_body(folder: Path, joints: np.ndarray, motion: Motion) -> None:
    """By the peer body-models, with a closed mouth and without expression, as GMR has them."""
    from body_models.smplx.torch import SMPLX

    data, poses = _load(folder / "gmr" / f"{exported.NAME}.npz")
    count = 2 * len(motion) - 1
    assert data["mocap_frame_rate"].item() == 30 and str(data["gender"]) == "neutral"
    assert data["pose_body"].shape == (count, 63) and data["betas"].ndim == 1
    assert data["source_frame"] == pytest.approx(np.arange(count) / 2)
    body = SMPLX(model_path=folder / "body" / "open_body_300_100.npz", flat_hand_mean=True)
    hands = np.concatenate([data["left_hand_pose"], data["right_hand_pose"]], 1)
    tensors = {
        "body_pose": data["pose_body"].reshape(count, 21, 3),
        "head_pose": np.zeros((count, 3, 3)),
        "hand_pose": hands.reshape(count, 30, 3),
        "pelvis_rotation": data["root_orient"],
        "shape": np.tile(data["betas"], (count, 1)),
        "expression": np.zeros((count, 10)),
        "global_translation": data["trans"],
    }
    with torch.no_grad():
        skeleton = body.forward_skeleton(
            **{name: torch.as_tensor(value, dtype=torch.float32) for name, value in tensors.items()}
        )
    read = skeleton[:, :, :3, 3].numpy()[::2]
    of_head = [JOINT_INDEX[name] for name in ("jaw", "left_eye_smplhf", "right_eye_smplhf")]
    kept = np.setdiff1d(np.arange(55), of_head)
    assert np.linalg.norm(read - joints, axis=-1)[:, kept].max() < 1e-4
    known = np.concatenate([motion.rotation, motion.translation[:, :, None]], 2)
    assert poses[::2, :3] == pytest.approx(known, abs=1e-5)


def test_holosoma_reads_joints_and_object(
    folder: Path, joints: np.ndarray, motion: Motion, lively: fitted.Capture
) -> None:
    data, _ = _load(folder / "holosoma" / f"{exported.NAME}.npz")
    assert data["global_joint_positions"][::2] == pytest.approx(joints[:, :22], abs=1e-4)
    assert 1.4 < data["height"].item() < 2.1
    # columns and orders of holosoma's load_intermimic_data
    path = folder / "holosoma" / f"{exported.NAME}.pt"
    tensor = torch.load(path, map_location="cpu").detach().numpy()
    human = tensor[:, 162 : 162 + 52 * 3].reshape(-1, 52, 3)[::2]
    object_poses = tensor[:, 318:325][:, [6, 3, 4, 5, 0, 1, 2]]
    assert object_poses == pytest.approx(data["object_poses"], abs=1e-6)
    for place, name in SMPLH_PLACES.items():
        assert human[:, place] == pytest.approx(joints[:, JOINT_INDEX[name]], abs=1e-4), name
    turn = Rotation.from_quat(object_poses[::2, :4], scalar_first=True)
    assert turn.as_matrix() == pytest.approx(motion.rotation, abs=1e-5)
    mesh = trimesh.load(folder / "holosoma" / "cup.obj", process=False)
    assert mesh.vertices == pytest.approx(lively.mesh.vertices, abs=1e-5)


def test_positions_between_frames_are_in_the_middle(motion: Motion) -> None:
    resampled = Resampled.of(motion)
    middle = (motion.translation[1:] + motion.translation[:-1]) / 2
    assert resampled.motion.translation[1::2] == pytest.approx(middle)
    before, after = (
        Rotation.from_matrix(motion.rotation[part]) for part in (slice(3), slice(1, 4))
    )
    half = Rotation.from_rotvec((after * before.inv()).as_rotvec() / 2) * before
    assert resampled.motion.rotation[1::2] == pytest.approx(half.as_matrix(), abs=1e-9)


def test_frames_without_a_pose_get_the_nearest_one(motion: Motion) -> None:
    rotation, translation = motion.rotation.copy(), motion.translation.copy()
    rotation[[0, 2]], translation[[0, 2]] = np.nan, np.nan
    poses = Resampled.of(replace(motion, rotation=rotation, translation=translation)).object_poses
    assert poses is not None and np.isfinite(poses).all()
    assert poses[0, 4:] == pytest.approx(translation[1])
    assert poses[4, 4:] == pytest.approx((translation[1] + translation[3]) / 2)
