"""A look at keypoints before a run: the first people of each camera, in milliseconds."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core.errors import UserError
from intercap_core.formats.detections import openpose
from intercap_core.formats.detections.coco import UnreadableCandidates, read_head
from intercap_core.formats.detections.converters.data_sets import as_openpose
from intercap_core.formats.detections.converters.wholebody import people_of
from intercap_core.formats.detections.keypoint_files import camera_file, image_files
from intercap_core.formats.detections.keypoint_values import NOBODY, Values


def look_at_keypoints(
    folder: Path, camera: str, *, size: tuple[int, int], full_confidence: float
) -> list[str]:
    """What is wrong with the beginning of one camera's file, or its first file of one image.

    ``size`` (width, height) of the colour images; ``full_confidence`` counts as 1.
    """
    whole = camera_file(folder, camera)
    path = whole if whole is not None else next(iter(image_files(folder / camera)), None)
    if path is None:
        return []
    notes, values = [], Values(size, full_confidence)
    try:
        content = read_head(path)
        if content is None:
            return []
        if whole is None:
            content = as_openpose(content)
        if whole is None and openpose.is_openpose(content):
            people = openpose.people_of(content, str(path))
        else:
            found = people_of(content, one_image=whole is None)
            if found.faults:
                notes.append(
                    f"{path}: {len(found.faults)} of its first {found.entries} people cannot be "
                    f"used (first: {found.faults[0]})"
                )
            people = np.array([person for _, person in found.results]).reshape(
                -1, *NOBODY.shape[1:]
            )
    except UnreadableCandidates as error:
        return [f"{path} {error}"]
    except UserError as error:
        return [str(error)]
    values.clean(people)
    if len(people) and not values.seen:
        notes.append(
            f"{path}: none of its first {len(people)} people has a point with numbers and a "
            "confidence above 0; write the keypoints again"
        )
    return notes + [f"{path}: {note}" for note in values.notes()]
