"""Body parameters and object poses as AMASS and as the InterCap release store them."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.output.export.format import Content, ExportFormat
from intercap_core.output.export.motion import Coordinates, Motion

NUM_HAND_COMPONENTS = 12  # of a hand's pose in the InterCap release (SMPLify-X's default)


def _write_amass(folder: Path, content: Content) -> Coordinates:
    """Write ``body.npz`` and, with an object, ``object.npz``.

    Equal input gives equal bytes: numpy stores the year 1980 as the date of every entry.
    """
    motion, about = content.viewed, content.about
    coordinates = Coordinates.of(motion)
    arrays = about.to_arrays(coordinates) | amass_body(motion)
    np.savez(folder / "body.npz", allow_pickle=False, **arrays)
    if motion.has_object:  # x = rotation[t] @ vertex + translation[t], metres
        arrays = {
            "object": np.array(motion.object_),
            "mocap_frame_rate": np.array(motion.fps),
            "rotation": motion.rotation,
            "translation": motion.translation,
            **about.per_frame_arrays(),
            **coordinates.to_arrays(),
        }
        np.savez(folder / "object.npz", allow_pickle=False, **arrays)
    return coordinates


def amass_body(motion: Motion) -> dict[str, np.ndarray]:
    """Return AMASS's keys (SMPL-X variant); ``poses`` (T, 165) holds 55 joints in SMPL-X order."""
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


def _write_intercap(folder: Path, content: Content) -> Coordinates:
    """Write the InterCap release's pickle (protocol 4) with an entry ``about``, and an npz file.

    Equal input gives equal bytes. In both files, facts about every frame are arrays.
    """
    about, coordinates = content.about, Coordinates.of(content.motion)
    values = intercap_result(content.motion)
    facts = about.to_json(coordinates) | {"by_frame": about.per_frame_arrays()}
    with (folder / "res.pkl").open("wb") as file:
        _OldNamesPickler(file, protocol=4).dump({**values, "about": facts})
    arrays = {key: np.asarray(value) for key, value in values.items()}
    np.savez(folder / "res.npz", allow_pickle=False, **arrays, **about.to_arrays(coordinates))
    return coordinates


def intercap_result(motion: Motion) -> dict[str, Any]:
    """Return the release's keys and shapes for T frames, plus the full hand poses.

    ``body_pose`` is (1, 63 T), as released. Without an object, its keys are omitted.
    ``pose_embedding`` belongs to VPoser and is omitted.
    """
    params, total = motion.parameters, len(motion)
    object_values = {}
    if motion.has_object:
        turns = Rotation.from_matrix(motion.rotation).as_rotvec()
        object_values = {
            "ob_pose": list(turns.astype(np.float32)),
            "ob_trans": list(motion.translation.astype(np.float32)),
        }
    hands = {
        f"{side}_hand_pose": _hand_components(motion, index)
        for index, side in enumerate(("left", "right"))
    }
    return {
        "global_orient": _to_float32(params.global_orient),
        "transl": _to_float32(params.transl),
        "body_pose": _to_float32(params.body_pose).reshape(1, 63 * total),
        **hands,
        "left_hand_pose_axis_angle": _to_float32(params.left_hand_pose),
        "right_hand_pose_axis_angle": _to_float32(params.right_hand_pose),
        "betas": _to_float32(params.betas.expand(total, -1)),
        "expression": _to_float32(params.expression.expand(total, -1)),
        "jaw_pose": _to_float32(params.jaw_pose),
        "leye_pose": _to_float32(params.leye_pose),
        "reye_pose": _to_float32(params.reye_pose),
        **object_values,
    }


def _hand_components(motion: Motion, side: int) -> np.ndarray:
    """Return the PCA coefficients (T, 12), relative to the mean pose, nearest to a hand's pose.

    ``side``: 0 = left, 1 = right.
    """
    params = motion.parameters
    pose = (params.left_hand_pose, params.right_hand_pose)[side].numpy()
    mean = motion.model.hand_mean[side].numpy().astype(np.float64)
    basis = motion.model.hand_components[side, :NUM_HAND_COMPONENTS].numpy().astype(np.float64)
    return np.linalg.lstsq(basis.T, (pose - mean).T, rcond=None)[0].T.astype(np.float32)


def _to_float32(values: Any) -> np.ndarray:
    return np.ascontiguousarray(values.numpy(), np.float32)


class _OldNamesPickler(pickle._Pickler):  # the C pickler offers no hook for names
    """Write numpy's function names as numpy 1 has them, which both numpy 1 and 2 can load."""

    def save_global(self, obj: Any, name: str | None = None) -> None:
        module = str(getattr(obj, "__module__", ""))
        if not module.startswith("numpy._core."):
            super().save_global(obj, name)  # type: ignore[misc]
            return
        old = module.replace("numpy._core.", "numpy.core.")
        self.write(pickle.GLOBAL + f"{old}\n{obj.__name__}\n".encode())  # type: ignore[attr-defined]
        self.memoize(obj)  # type: ignore[attr-defined]


_AMASS_README = """
amass/body.npz      AMASS keys (SMPL-X): poses (T,165) = root, body, jaw, eyes, hands; trans; betas
  plus the body file, frame and units, and the facts about each frame, below
{% if mesh %}
amass/object.npz    rotation (T,3,3), translation (T,3): frame from object, metres
{% endif %}
  frame: {{ viewed.frame }}; {{ up }}
  SMPL-X turns the body about its pelvis joint, not the origin; trans allows for that
"""
_INTERCAP_README = """
intercap/res.pkl    pickle of numpy arrays and lists, keys and shapes as the InterCap release
  plus "about": the body file, and the facts about each frame, below, in "by_frame"
intercap/res.npz    the same as arrays
  frame: {{ motion.frame }}; {{ up_of_master }}
  global_orient, transl (T,3), body_pose (1,63T), betas and expression (T,10), jaw/leye/reye (T,3)
  left_hand_pose, right_hand_pose (T,12): PCA coefficients over the mean hand
    (flat_hand_mean=False), the nearest to the fitted pose
  *_hand_pose_axis_angle (T,45): the fitted poses themselves, mean included
{% if mesh %}
  ob_pose, ob_trans: lists of T (3,) rotation vectors (radians) and translations (metres),
    master camera from object
{% else %}
  ob_pose, ob_trans are omitted: there is no object
{% endif %}
  pose_embedding is omitted: it belongs to VPoser, which was not used
"""
FORMATS = (
    ExportFormat(
        name="amass",
        path="*/export/amass/body.npz and object.npz",
        content="AMASS keys",
        includes="*/export/amass/*.npz",
        readme=_AMASS_README,
        write=_write_amass,
        holds_parameters=True,
    ),
    ExportFormat(
        name="intercap",
        path="*/export/intercap/res.pkl and res.npz",
        content="as the InterCap release",
        includes="*/export/intercap/*",
        readme=_INTERCAP_README,
        write=_write_intercap,
        holds_parameters=True,
    ),
)
