"""Whether the person that was followed is the subject, image by image."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_NAMES
from intercap_core.evaluation.times import match_times
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.schemas import PERSON, SCENE, TRUTH

APART_M = 0.3  # in the median over limbs, beside the ray: another person; people pass at 0.8 m
_LIMBS = [
    f"{side}_{part}"
    for side in ("left", "right")
    for part in ("shoulder", "elbow", "wrist", "hip", "knee", "ankle")
]
_KEYPOINTS = [KEYPOINT_NAMES.index(name) for name in _LIMBS]
_JOINTS = [JOINT_INDEX[name] for name in _LIMBS]
_OTHER_SIDE = np.r_[len(_LIMBS) // 2 : len(_LIMBS), : len(_LIMBS) // 2]


def measure(person: Path, scene: Path, truth: Path) -> float:
    """The share of the images with a chosen person in which it is the subject; NaN without any.

    The chosen keypoints are compared with the true joints as the true cameras see them, sides
    exchanged where that is nearer: a detector that exchanges them still shows the subject.
    Raises UserError where an artefact cannot be read or they are of different recordings.
    """
    with (
        artefacts.read(person, PERSON) as chosen,
        artefacts.read(scene, SCENE) as found,
        artefacts.read(truth, TRUTH) as true,
    ):
        fps = float(found.attributes["fps"])
        at = match_times(truth, true["times"], found["times"], fps)
        rig = Rig.from_artefact(found)
        order = [true.text("camera_names").index(name) for name in rig.names]
        camera_from_master = invert(true["master_from_colour"][order])
        joints = true["joints"][at][:, _JOINTS]
        keypoints = chosen["keypoints"][:, :, _KEYPOINTS]
        right = [
            _apart(keypoints[t, c], rig[c], apply(camera_from_master[c], joints[t])) < APART_M
            for t, c in np.argwhere(chosen["person"] >= 0)
        ]
        return float(np.mean(right)) if right else float("nan")


def _apart(keypoints: np.ndarray, camera: Camera, joints: np.ndarray) -> float:
    """Median distance, metres beside the ray, of keypoints (K, 3) x, y, confidence from joints
    (K, 3) in the camera's frame; infinite where nothing is seen."""
    rays, seen = camera.colour.unproject(keypoints[:, :2]), keypoints[:, 2] > 0
    if not seen.any():
        return np.inf
    sides = (np.arange(len(_LIMBS)), _OTHER_SIDE)
    return min(
        float(np.median(np.linalg.norm((rays * joints[side, 2:] - joints[side])[seen, :2], axis=1)))
        for side in sides
    )
