"""A look at candidates before a run: the first results of each camera, in milliseconds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from intercap_core.formats.detections.candidate_files import camera_file, image_files
from intercap_core.formats.detections.coco import UnreadableCandidates, candidates_of, read_head


@dataclass
class Look:
    """What was seen of one camera: what is wrong, in words, and the labels."""

    notes: list[str] = field(default_factory=list)
    labels: set[str] = field(default_factory=set)


def look_at_candidates(
    folder: Path, camera: str, *, size: tuple[int, int], names: Mapping[int, str]
) -> Look:
    """Read the beginning of one camera's file, or its first file of one image.

    ``size`` (width, height) of the colour images; ``names`` are the classes by number. Masks as
    images are not looked at.
    """
    look = Look()
    whole = camera_file(folder, camera)
    path = whole if whole is not None else next(iter(image_files(folder, camera)), None)
    if path is None:
        return look
    try:
        content = read_head(path)
        if content is None:
            return look
        found = candidates_of(
            content,
            width=size[0],
            height=size[1],
            min_score=0.0,
            names=names,
            one_image=whole is None,
        )
    except UnreadableCandidates as error:
        look.notes.append(f"{path} {error}; the camera will count as without candidates")
        return look
    if found.faults:
        look.notes.append(
            f"{path}: {len(found.faults)} of its first {found.entries} results cannot be used "
            f"(first: {found.faults[0]})"
        )
    if found.scaled:
        look.notes.append(
            f"{path}: masks are of another resolution than the images of {size[0]}x{size[1]} and "
            "will be scaled"
        )
    look.labels = {instance.label for _, instance in found.results}
    return look
