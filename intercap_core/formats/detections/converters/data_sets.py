"""Keypoints and masks as two data sets keep them: the InterCap release and BEHAVE."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

from intercap_core.formats.detections.converters.mask_files import MaskFile
from intercap_core.formats.detections.instance import PERSON_LABEL
from intercap_core.formats.recordings.behave import frame_folders

BEHAVE_PERSON = ("person_mask",)
BEHAVE_OBJECT = ("obj_rend_mask", "obj_mask")  # the second where the first is not there
SUFFIXES = ("png", "jpg")  # without loss first
_NUMBERED = re.compile(r"\D*(\d{1,9})\.(?:png|jpe?g)", re.IGNORECASE)
# BEHAVE keeps OpenPose's lists of one person at the top of the file, under names of its own.
_BEHAVE_LISTS = {
    "pose_keypoints_2d": "body_joints",
    "hand_left_keypoints_2d": "left_hand_joints",
    "hand_right_keypoints_2d": "right_hand_joints",
    "face_keypoints_2d": "face_joints",
}


def as_openpose(content: Any) -> Any:
    """BEHAVE's parsed JSON of one person as OpenPose writes it; any other content as it is."""
    if not isinstance(content, dict) or "people" in content or "body_joints" not in content:
        return content
    return {"people": [{key: content.get(theirs, []) for key, theirs in _BEHAVE_LISTS.items()}]}


def release_masks(candidates: Path, camera: str) -> dict[int, MaskFile] | None:
    """Person masks of one camera as the InterCap release's tools keep them, by image number.

    ``<camera>/<number>.png`` or ``BodyIndexColor_<n>/<number>.png``, without ``_<n>`` for camera 1,
    with 0 for the person and 255 for the background; None where there is no such folder.
    """
    number = camera[1:]
    names = [camera, f"BodyIndexColor_{number}", *(["BodyIndexColor"] if number == "1" else [])]
    for name in names:
        folder = candidates / name
        if folder.is_dir():
            matches = ((path, _NUMBERED.fullmatch(path.name)) for path in sorted(folder.iterdir()))
            return {int(m.group(1)): MaskFile(path, PERSON_LABEL, True) for path, m in matches if m}
    return None


class BehaveFiles:
    """Keypoints and masks beside BEHAVE's images, by the time of the image, microseconds.

    The masks are of one person and of the sequence's object, which is given ``object_label``; None
    leaves them out.
    """

    def __init__(self, recordings: Path, object_label: str | None) -> None:
        self._folders = frame_folders(recordings) if recordings.is_dir() else {}
        self._labels: dict[tuple[str, ...], str] = {BEHAVE_PERSON: PERSON_LABEL}
        if object_label is not None:
            self._labels[BEHAVE_OBJECT] = object_label

    def keypoints(self, time_us: int, camera: str) -> Path | None:
        """The keypoint file of one image, None = there is none."""
        return self._existing(time_us, f"{camera}.color.json")

    def masks(self, time_us: int, camera: str) -> list[MaskFile]:
        """The masks of one image."""
        found = []
        for kinds, label in self._labels.items():
            paths = (
                self._existing(time_us, f"{camera}.{kind}.{suffix}")
                for kind in kinds
                for suffix in SUFFIXES
            )
            path = next((path for path in paths if path is not None), None)
            if path is not None:
                found.append(MaskFile(path, label))
        return found

    def _existing(self, time_us: int, name: str) -> Path | None:
        folder = self._folders.get(time_us)
        path = folder / name if folder is not None else None
        return path if path is not None and path.is_file() else None
