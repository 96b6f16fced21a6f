"""Which of the 135 keypoints a detector's points are: by name, for the layouts in use.

COCO's 17 body points, with COCO-WholeBody's feet, face and hands (133), the same as DWPose's tools
sort them (134), Halpe's 26 and 136; a layout is known by its number of points. Order of
COCO-WholeBody: body, feet, face (dlib's 68), left hand, right hand; sides are the person's own, as
in OpenPose.
"""

from __future__ import annotations

import numpy as np

from intercap_core.body.keypoints import KEYPOINT_NAMES, LEFT_HAND, NUM_KEYPOINTS, RIGHT_HAND

COCO_BODY = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee",
    "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
COCO_FEET = (
    "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
)  # fmt: skip
FACE_68 = tuple(f"face_{i}" for i in range(68))
# Wrist, then thumb, index, middle, ring and little finger from the root to the tip: the same in
# OpenPose, COCO-WholeBody, Halpe and MediaPipe.
HANDS = (*KEYPOINT_NAMES[LEFT_HAND], *KEYPOINT_NAMES[RIGHT_HAND])
# Halpe's top of the head is none of the 135.
HALPE_BODY = (
    *COCO_BODY, "head", "neck", "mid_hip", "left_big_toe", "right_big_toe", "left_small_toe",
    "right_small_toe", "left_heel", "right_heel",
)  # fmt: skip
# OpenPose's older body. The neck that DWPose and rtmlib insert is computed, so it is left out.
DWPOSE_BODY = (
    "nose", "middle_of_shoulders", "right_shoulder", "right_elbow", "right_wrist", "left_shoulder",
    "left_elbow", "left_wrist", "right_hip", "right_knee", "right_ankle", "left_hip", "left_knee",
    "left_ankle", "right_eye", "left_eye", "right_ear", "left_ear",
)  # fmt: skip
WHOLE_BODY = (*COCO_BODY, *COCO_FEET, *FACE_68, *HANDS)
LAYOUTS: dict[int, tuple[str, ...]] = {
    len(names): names
    for names in (
        COCO_BODY,
        (*COCO_BODY, *COCO_FEET),
        HALPE_BODY,
        WHOLE_BODY,
        (*DWPOSE_BODY, *COCO_FEET, *FACE_68, *HANDS),
        (*HALPE_BODY, *FACE_68, *HANDS),
    )
}
KNOWN_COUNTS = ", ".join(map(str, LAYOUTS))
_INDEX = {name: index for index, name in enumerate(KEYPOINT_NAMES)}


def to_shared(points: np.ndarray, names: tuple[str, ...]) -> np.ndarray:
    """Points (..., K, 3) of x, y, confidence, named ``names``, as the 135 (..., 135, 3).

    What the layout lacks has confidence 0: of COCO's, neck and middle of the hips, which are known
    in space later (:func:`intercap_core.person.middles.fill_middles`).
    """
    result = np.zeros((*points.shape[:-2], NUM_KEYPOINTS, 3))
    kept = [i for i, name in enumerate(names) if name in _INDEX]
    result[..., [_INDEX[names[i]] for i in kept], :] = points[..., kept, :]
    return result
