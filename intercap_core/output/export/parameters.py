"""Body motion as AMASS stores it (SMPL-X variant), with the object's poses beside it.

``surface_model_type`` names the mesh that was fitted: ``smplx`` of a licensed file alone, since the
same parameters make another person of another mesh.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.output.export.about import About
from intercap_core.output.export.motion import Coordinates, Motion


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


def write_amass(folder: Path, motion: Motion, about: About) -> None:
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


NUM_HAND_COMPONENTS = 12  # of the release; SMPLify-X's number, with flat_hand_mean=False


def intercap_result(motion: Motion) -> dict[str, Any]:
    """The release's keys and shapes for T frames, and the full hand poses beside its 12 components.

    ``body_pose`` is (1, 63 T), as released. Without an object its keys are left out.
    ``pose_embedding`` is VPoser's and left out.
    """
    params, total = motion.parameters, len(motion)
    of_object = {}
    if motion.has_object:
        turns = Rotation.from_matrix(motion.rotation).as_rotvec()
        of_object = {
            "ob_pose": list(turns.astype(np.float32)),
            "ob_trans": list(motion.translation.astype(np.float32)),
        }
    hands = {
        f"{side}_hand_pose": hand_components(motion, index)
        for index, side in enumerate(("left", "right"))
    }
    return {
        "global_orient": _single(params.global_orient),
        "transl": _single(params.transl),
        "body_pose": _single(params.body_pose).reshape(1, 63 * total),
        **hands,
        "left_hand_pose_axis_angle": _single(params.left_hand_pose),
        "right_hand_pose_axis_angle": _single(params.right_hand_pose),
        "betas": _single(params.betas.expand(total, -1)),
        "expression": _single(params.expression.expand(total, -1)),
        "jaw_pose": _single(params.jaw_pose),
        "leye_pose": _single(params.leye_pose),
        "reye_pose": _single(params.reye_pose),
        **of_object,
    }


def hand_components(motion: Motion, side: int) -> np.ndarray:
    """Coefficients (T, 12) whose pose is nearest to the full one, over the hand's mean pose."""
    params = motion.parameters
    pose = (params.left_hand_pose, params.right_hand_pose)[side].numpy()
    mean = motion.model.hand_mean[side].numpy().astype(np.float64)
    basis = motion.model.hand_components[side, :NUM_HAND_COMPONENTS].numpy().astype(np.float64)
    return np.linalg.lstsq(basis.T, (pose - mean).T, rcond=None)[0].T.astype(np.float32)


def _single(values: Any) -> np.ndarray:
    return np.ascontiguousarray(values.numpy(), np.float32)


class _OldNames(pickle._Pickler):  # the C pickler offers no hook for names
    """Names numpy's functions as numpy 1 did, so that numpy 1 and 2 both load the file."""

    def save_global(self, obj: Any, name: str | None = None) -> None:
        module = str(getattr(obj, "__module__", ""))
        if not module.startswith("numpy._core."):
            super().save_global(obj, name)  # type: ignore[misc]
            return
        old = module.replace("numpy._core.", "numpy.core.")
        self.write(pickle.GLOBAL + f"{old}\n{obj.__name__}\n".encode())  # type: ignore[attr-defined]
        self.memoize(obj)  # type: ignore[attr-defined]


def write_intercap(path: Path, motion: Motion, about: About) -> None:
    """Write the pickle, protocol 4, with ``about`` beside the release's keys, and the same as .npz;
    equal input gives equal bytes. What ``about`` has of every frame are arrays in both."""
    found, coordinates = intercap_result(motion), Coordinates.of(motion)
    told = about.told(coordinates) | {"by_frame": about.by_frame_arrays()}
    with path.open("wb") as file:
        _OldNames(file, protocol=4).dump({**found, "about": told})
    arrays = {key: np.asarray(value) for key, value in found.items()}
    np.savez(path.with_suffix(".npz"), allow_pickle=False, **arrays, **about.arrays(coordinates))
