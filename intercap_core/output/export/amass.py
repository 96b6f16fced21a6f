"""Body motion as AMASS stores it (SMPL-X variant), with the object's poses beside it.

``surface_model_type`` names the mesh that was fitted: ``smplx`` of a licensed file alone, since the
same parameters make another person of another mesh.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core.output.export.about import About
from intercap_core.output.export.coordinates import Coordinates
from intercap_core.output.export.motion import Motion


def body_arrays(motion: Motion) -> dict[str, np.ndarray]:
    """AMASS's keys; ``poses`` (T, 165) holds the 55 joints in SMPL-X's order."""
    params, total = motion.parameters, len(motion)
    poses = params.full_pose().reshape(total, 165).numpy().astype(np.float32)
    return {
        "gender": np.array(motion.gender),
        "mocap_frame_rate": np.array(motion.fps),
        "mocap_time_length": np.array(total / motion.fps),
        "trans": params.transl.numpy().astype(np.float32),
        "poses": poses,
        "root_orient": poses[:, :3],
        "pose_body": poses[:, 3:66],
        "pose_jaw": poses[:, 66:69],
        "pose_eye": poses[:, 69:75],
        "pose_hand": poses[:, 75:],
        "betas": params.betas[0].numpy().astype(np.float32),
        "num_betas": np.array(params.betas.shape[1]),
        "expression": params.expression.expand(total, -1).numpy().astype(np.float32),
    }


def object_arrays(motion: Motion) -> dict[str, np.ndarray]:
    """The object in the same frame: x = rotation[t] @ vertex + translation[t], metres."""
    return {
        "object": np.array(motion.object_),
        "mocap_frame_rate": np.array(motion.fps),
        "rotation": motion.rotation,
        "translation": motion.translation,
    }


def write(folder: Path, motion: Motion, about: About) -> None:
    """Write ``body.npz`` and, where there is one, ``object.npz``; numpy dates their entries 1980,
    so bytes repeat."""
    folder.mkdir()
    coordinates = Coordinates.of(motion)
    np.savez(
        folder / "body.npz",
        allow_pickle=False,
        **{**about.arrays(coordinates), **body_arrays(motion)},
    )
    if motion.has_object:
        of_object = {**about.by_frame_arrays(), **coordinates.arrays()}
        np.savez(folder / "object.npz", allow_pickle=False, **object_arrays(motion), **of_object)
