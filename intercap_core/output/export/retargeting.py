"""Motions for programs that retarget them to humanoids: GMR and holosoma (OmniRetarget).

Both assume z up with the ground at z = 0, metres, and 30 frames per second; motions of other rates
are resampled. GMR reads SMPL-X parameters by AMASS's names. holosoma reads joint positions: 22 of
SMPL-X from npz files, or 52 of SMPL-H together with an object from tensors in InterMimic's layout.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from intercap_core.body.joints import BODY_JOINTS, JOINT_INDEX, JOINT_NAMES
from intercap_core.body.parameters import BodyParameters
from intercap_core.flags import PARTS
from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates, Motion, posed_batches, rest_pose
from intercap_core.output.export.parameters import amass_body

FPS = 30.0  # frames per second that both programs assume
_GMR = ("gender", "mocap_frame_rate", "betas", "root_orient", "pose_body", "trans")  # as in AMASS
# Columns of InterMimic's tensors (T, 591); holosoma reads these three
_WIDTH = 591
_POSITIONS, _OBJECT, _OBJECT_CONTACT = slice(162, 318), slice(318, 325), 330
_SIDES = ("left", "right")
# The 52 joints in InterMimic's order, by SMPL-X's names
_INTERMIMIC = (
    "pelvis",
    *(f"{side}_{joint}" for side in _SIDES for joint in ("hip", "knee", "ankle", "foot")),
    "spine1", "spine2", "spine3", "neck", "head",
    *(f"{side}_{joint}" for side in _SIDES for joint in (
        "collar", "shoulder", "elbow", "wrist",
        *(f"{finger}{i}" for finger in ("index", "middle", "pinky", "ring", "thumb")
          for i in (1, 2, 3)),
    )),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Resampled:
    """A motion of N frames at FPS."""

    motion: Motion
    source_frame: np.ndarray
    """(N,) frame of the recording, with fractions where the motion is interpolated."""
    object_poses: np.ndarray | None
    """(N, 7) qw, qx, qy, qz, x, y, z of the object, metres: the nearest known pose where it has
    none; None without an object."""

    @classmethod
    def of(cls, motion: Motion) -> Resampled:
        """Resample by spherical interpolation of rotations and linear one of positions."""
        last = len(motion) - 1
        count = int(last * FPS / motion.fps + 1e-6) + 1
        at = np.minimum(np.arange(count) * motion.fps / FPS, last)
        values = motion.parameters
        poses = values.full_pose().double().numpy()
        turned = np.stack(
            [_interpolate_rotations(at, np.arange(last + 1), Rotation.from_rotvec(poses[:, joint]))
             .as_rotvec() for joint in range(len(JOINT_NAMES))],
            axis=1,
        )  # fmt: skip
        rest = torch.cat([values.transl, values.betas, values.expression], 1).double().numpy()
        others = _interpolate(at, np.arange(last + 1), rest)
        vector = torch.as_tensor(np.concatenate([turned.reshape(count, -1), others], 1))
        parameters = BodyParameters.from_vector(vector, num_betas=motion.model.num_betas)
        nothing = np.full((count, 3, 3), np.nan)
        moved = replace(
            motion, fps=FPS, parameters=parameters, rotation=nothing, translation=nothing[..., 0]
        )
        object_poses = None
        if motion.has_object:
            known = np.flatnonzero(np.isfinite(motion.translation).all(axis=1))
            turn = _interpolate_rotations(at, known, Rotation.from_matrix(motion.rotation[known]))
            translation = _interpolate(at, known, motion.translation[known])
            moved = replace(moved, rotation=turn.as_matrix(), translation=translation)
            quaternion = turn.as_quat(canonical=True, scalar_first=True)
            object_poses = np.concatenate([quaternion, translation], 1)
        return cls(moved, at, object_poses)

    def to_arrays(self, content: Content) -> dict[str, np.ndarray]:
        """Serialize what both formats state besides the motion."""
        flags, physics = content.about.flags, content.about.physics
        nearest = np.rint(self.source_frame).astype(int)
        arrays: dict[str, Any] = {
            **Coordinates.of(self.motion).to_arrays(),
            **content.about.body.to_arrays(),
            "source_frame": self.source_frame,
            "flag_part": np.array(PARTS),
            "flagged": flags.flagged[nearest],
        }
        if physics is not None:
            arrays |= {name: values[nearest] for name, values in physics.per_frame.items()}
        if self.object_poses is not None:
            arrays |= {
                "object": np.array(self.motion.object_),
                "object_poses": self.object_poses.astype(np.float32),
            }
        return arrays


def _interpolate(at: np.ndarray, frames: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Interpolate (K, D) values of ``frames`` (K,) at (N,) places; constant beyond the ends."""
    return np.stack([np.interp(at, frames, column) for column in values.T], axis=1)


def _interpolate_rotations(at: np.ndarray, frames: np.ndarray, values: Rotation) -> Rotation:
    """Interpolate rotations as :func:`_interpolate` does values."""
    if len(frames) == 1:
        return values[np.zeros(len(at), int)]
    return Slerp(frames, values)(np.clip(at, frames[0], frames[-1]))


def _write_gmr(folder: Path, content: Content) -> Coordinates:
    resampled = Resampled.of(content.z_up)
    motion = resampled.motion
    body = amass_body(motion)
    left, right = np.split(body["pose_hand"], 2, axis=1)
    arrays = {
        **resampled.to_arrays(content),
        **{name: body[name] for name in _GMR},
        "left_hand_pose": left,
        "right_hand_pose": right,
    }
    np.savez(folder / f"{motion.sequence}.npz", allow_pickle=False, **arrays)
    return Coordinates.of(motion)


def _write_holosoma(folder: Path, content: Content) -> Coordinates:
    resampled = Resampled.of(content.z_up)
    motion = resampled.motion
    posed = posed_batches(motion.model, motion.parameters)
    joints = np.concatenate([batch.joints.numpy() for batch in posed])  # (N, 55, 3)
    vertices, _ = rest_pose(motion.model, motion.parameters)
    arrays = {
        **resampled.to_arrays(content),
        "fps": np.array(motion.fps),
        "global_joint_positions": joints[:, BODY_JOINTS].astype(np.float32),
        "height": np.array(np.ptp(vertices[:, 1])),
    }
    np.savez(folder / f"{motion.sequence}.npz", allow_pickle=False, **arrays)
    if resampled.object_poses is not None and content.mesh is not None:
        torch.save(_intermimic(resampled, joints, content), folder / f"{motion.sequence}.pt")
        mesh = trimesh.Trimesh(content.mesh.vertices, content.mesh.faces, process=False)
        text = trimesh.exchange.obj.export_obj(mesh, include_normals=False, digits=6)
        (folder / f"{motion.object_}.obj").write_text(f"{text}\n", encoding="utf-8")
    return Coordinates.of(motion)


def _intermimic(resampled: Resampled, joints: np.ndarray, content: Content) -> torch.Tensor:
    """Return the columns of InterMimic's layout that holosoma reads; the others are zero."""
    poses = resampled.object_poses
    assert poses is not None
    tensor = np.zeros((len(joints), _WIDTH), np.float32)
    order = [JOINT_INDEX[name] for name in _INTERMIMIC]
    tensor[:, _POSITIONS] = joints[:, order].reshape(len(joints), -1)
    tensor[:, _OBJECT] = poses[:, [4, 5, 6, 1, 2, 3, 0]]  # x, y, z, qx, qy, qz, qw
    if content.about.contact is not None:
        touching = np.any(content.about.contact.probability >= 0.5, axis=1)
        tensor[:, _OBJECT_CONTACT] = touching[np.rint(resampled.source_frame).astype(int)]
    return torch.as_tensor(tensor)


_GMR_README = """
gmr/*.npz           as GMR (smplx_to_robot.py) reads it: gender, betas (S,), root_orient (N,3),
  pose_body (N,63), trans (N,3), left_hand_pose, right_hand_pose (N,45), mocap_frame_rate
{% if mesh %}
  object_poses (N,7): qw qx qy qz x y z, frame from object, metres; GMR does not read it
{% endif %}
  z up, metres; resampled to 30 frames per second, which GMR assumes; source_frame (N,) is the
    frame of the recording, flagged (N,P) those of flag_part that are not reliable
{% if about.physics and about.physics.per_frame %}
  carrier, physics_bad (N,): as below
{% endif %}
"""
_HOLOSOMA_README = """
holosoma/*.npz      as holosoma's format smplx reads it: global_joint_positions (N,22,3), height
  z up, metres; resampled to 30 frames per second; source_frame and facts about each frame as in gmr
{% if mesh %}
  object_poses (N,7): qw qx qy qz x y z, frame from object, metres
holosoma/*.pt       as its task object_interaction reads it: tensor (N,591) in InterMimic's layout,
  of which 162:318 (52 joints), 318:325 (object: x y z qx qy qz qw) and 330 (contact) are set
holosoma/*.obj      the object's mesh, metres
{% endif %}
"""
FORMATS = (
    ExportFormat(
        name="gmr",
        content="SMPL-X parameters and object poses at 30 Hz, as GMR reads them",
        includes="*/export/gmr/*.npz",
        readme=_GMR_README,
        write=_write_gmr,
        holds_parameters=True,
    ),
    ExportFormat(
        name="holosoma",
        content="joint positions and object poses at 30 Hz, as holosoma (OmniRetarget) reads them",
        includes="*/export/holosoma/*",
        readme=_HOLOSOMA_README,
        write=_write_holosoma,
    ),
)
