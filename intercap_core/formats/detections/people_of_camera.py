"""People of one camera: cleaning, units and layout of their keypoints.

:mod:`.keypoint_files` finds and reads the files.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.body.keypoints import NUM_KEYPOINTS
from intercap_core.errors import UserError
from intercap_core.formats.detections.coco import DetectionsByImage, UnreadableDetections
from intercap_core.formats.detections.image_numbers import (
    CameraImages,
    note_broken,
    note_faults,
    short_name,
)
from intercap_core.formats.detections.instance import (
    MAX_SHARE,
    are_shares,
    hint_on_size,
    notes_on_extent,
    scale_to,
)
from intercap_core.formats.detections.keypoints import (
    KeypointReader,
    PeopleFile,
    compare_bones,
    layouts,
    mean_length,
    read_people,
    visible,
)

# Shares of compare_bones in 427 cameras of virtual recordings (noise, MediaPipe, its errors): up to
# 0.72 in body_25, up to 0.94 without neck and middle of the hips. Right points read in another
# layout: body_25b as body_25 0.75 to 1.35 (median 0.96), kinect_v2 as body_25 0.69 to 1.22, h36m as
# coco 0.90 to 1.70. Points in random order: about 1.3.
CERTAIN_BONE_SHARE = 0.75  # below it the layout is certain
CERTAIN_WITHOUT_NECK = 0.95  # the same for layouts without neck and middle of the hips
MAX_BONE_SHARE = 1.1  # above it points are not joined by bones
MAX_SHARE_OF_OTHER = 0.75  # another layout is used if its share is smaller by this factor
NOBODY = np.zeros((0, NUM_KEYPOINTS, 3), np.float32)


@dataclass
class KeypointCleaner:
    """Removes impossible keypoints of one camera's images and counts them."""

    size: tuple[int, int]
    """Width and height of the images."""
    full_confidence: float = 1.0
    """Confidence that counts as 1."""
    seen: int = 0
    """Number of points with finite coordinates and a confidence above 0."""
    outside: int = 0
    """Number of points outside the image."""
    beyond: int = 0
    """Number of points with more than the full confidence."""
    normalised: int = 0
    """Number of people with normalised coordinates."""
    extent: float = 0.0
    """Largest x or y of a point, as a share of the image's width or height."""

    def clean(self, people: np.ndarray) -> np.ndarray:
        """Return the usable people (P, 135, 3) as float32: x, y (px), confidence from 0 to 1.

        People without a visible point or with normalised coordinates are left out. A point becomes
        zeros if it is not finite, lies outside the image or exactly at (0, 0), or if it has no
        confidence. Confidence beyond the full one is clipped to 1.
        """
        x, y, confidence = np.moveaxis(np.asarray(people, np.float64), -1, 0)
        with np.errstate(invalid="ignore"):
            seen = visible(np.asarray(people, np.float64))
            # The centres of pixels have integer coordinates.
            inside = (np.minimum(x, y) >= -0.5) & (x < self.size[0] - 0.5)
            inside &= y < self.size[1] - 0.5
        beyond = seen & (confidence > self.full_confidence)
        self.seen += int(seen.sum())
        self.outside += int((seen & ~inside).sum())
        self.beyond += int(beyond.sum())
        known = seen & inside
        share = np.minimum(np.where(known, confidence, 0) / self.full_confidence, 1)
        result = np.where(known[..., None], np.stack([x, y, share], -1), 0).astype(np.float32)
        self.extent = max(self.extent, float((result[..., :2] / self.size).max(initial=0)))
        present = known.any(-1)
        largest = result[..., :2].max((1, 2), initial=0)
        normalised = present & (largest <= MAX_SHARE)
        self.normalised += int(normalised.sum())
        return result[present & ~normalised]

    def notes(self) -> list[str]:
        """Messages for the user about points and people that were changed or left out."""
        notes = []
        width, height = self.size
        if self.outside:
            hint = hint_on_size(self.outside, self.seen)
            notes.append(
                f"{self.outside} of {self.seen} keypoints lie outside the image of "
                f"{width}x{height} pixels and count as not seen{hint}"
            )
        if not self.normalised:
            notes += notes_on_extent("keypoints", self.extent, self.size)
        if self.normalised:
            notes.append(
                f"{self.normalised} people left out whose points all lie within "
                f"{MAX_SHARE:g} pixels of the upper left corner: coordinates must be "
                "pixels, not shares of the image"
            )
        if self.beyond:
            notes.append(
                f"{self.beyond} of {self.seen} confidences are beyond {self.full_confidence:g} and "
                "count as 1; detections.keypoint_full_confidence sets the full confidence"
            )
        return notes


PeopleByImage = DetectionsByImage[np.ndarray]  # people (P, 135, 3)


@dataclass
class PeopleReading:
    """People of one camera, as its files are read."""

    images: CameraImages
    layout: str | None
    """Layout according to the settings."""
    raw: dict[int, np.ndarray] = field(default_factory=dict)
    """People (P, 135, 3) by image number, as written."""
    assumed: set[str] = field(default_factory=set)
    """Layouts that were selected by the number of points alone."""
    notes: list[str] = field(default_factory=list)
    recognised: list[str] = field(default_factory=list)
    broken: list[str] = field(default_factory=list)
    """Files that cannot be loaded."""
    faults: list[str] = field(default_factory=list)
    """People or files that cannot be used."""
    used: bool = False
    """Whether anything could be used."""

    def parse(
        self, loaded: Any, reader: KeypointReader, path: Path, *, one_image: bool
    ) -> PeopleFile | None:
        """The people of a loaded file in pixels of the images; None with a fault if none."""
        try:
            content = read_people(loaded, reader.load, one_image=one_image, layout=self.layout)
        except UnreadableDetections as error:
            self.faults.append(f"{short_name(path)} {error}")
            return None
        self.assumed |= content.assumed
        results, content.results = content.results, []
        for key, person in results:
            try:
                x, y = scale_to(key.size, self.images.size) if key.size else (1.0, 1.0)
            except ValueError as error:
                content.add_fault("a person", key, error)
                continue
            if (x, y) != (1.0, 1.0):  # pixel centres have integer coordinates
                scaled = (person[:, :2] + 0.5) * (x, y) - 0.5
                seen = (person[:, :2] != 0).any(1, keepdims=True)
                person = np.column_stack([np.where(seen, scaled, 0), person[:, 2]])
                content.scaled += 1
                own = "x".join(map(str, key.size or ()))
                self.recognised.append(f"scaled from {own} pixels")
            content.results.append((key, person))
        return content

    @property
    def people(self) -> np.ndarray:
        """All people (N, 135, 3), as written."""
        return np.concatenate([NOBODY, *self.raw.values()])

    def finish(self, folder: Path, full_confidence: float) -> PeopleByImage:
        """The people, with notes; raises UserError if files can be loaded and none can be used."""
        notes = self.notes
        note_broken(notes, "keypoint files", self.broken)
        if self.faults and not self.used:
            raise UserError(
                f"{folder}: none of camera {self.images.name}'s keypoints can be used: "
                f"{self.faults[0]}"
            )
        note_faults(notes, "people or files of keypoints", self.faults)
        self._scale_shares()
        cleaner = KeypointCleaner(self.images.size, full_confidence)
        by_image = {number: cleaner.clean(people) for number, people in self.raw.items()}
        # Only `intercap check` reports a default layout that fits; the artefact has no note.
        recognised = list(dict.fromkeys(self.recognised))
        notes += [text for text in recognised if not text.startswith("layout ")]
        notes += cleaner.notes()
        return PeopleByImage(by_image, notes, recognised)

    def _scale_shares(self) -> None:
        """Scale coordinates that are shares of the images' size if those of all people are."""
        points = self.people.reshape(-1, 3)
        values = points[visible(points), :2]
        # Coordinates from -1 to 1 are relative to the middle of the image, in an unknown unit.
        if are_shares(values.ravel()) and (values < 0).mean() < 0.1:
            factors = (*self.images.size, 1.0)
            self.raw = {number: people * factors for number, people in self.raw.items()}
            width, height = self.images.size
            self.recognised.append(
                f"coordinates are shares of the image's size, scaled to {width}x{height} pixels"
            )


def recognise_layout(
    reading: PeopleReading, read_as: Callable[[str], PeopleReading], folder: Path
) -> PeopleReading:
    """Compare the assumed layout with the people's bones; read again if another one fits.

    ``read_as`` reads them in the layout of a name. Raises UserError, naming the ``folder``, if no
    layout of the same number of points fits.
    """
    share = compare_bones(reading.people)
    if reading.layout is not None or len(reading.assumed) != 1 or share is None:
        return reading
    (assumed,) = reading.assumed
    points = layouts()[assumed].points
    has_neck = {"neck", "mid_hip"}.issubset(points)
    if share <= (CERTAIN_BONE_SHARE if has_neck else CERTAIN_WITHOUT_NECK):
        reading.recognised.append(f"layout {assumed}")
        return reading
    count = len(points)
    readings = {
        name: read_as(name)
        for name, layout in layouts().items()
        if name != assumed and len(layout.points) == count
    }
    limit = min(MAX_SHARE_OF_OTHER * share, MAX_BONE_SHARE)
    # Long bones fit several layouts if arms are in the place of legs, of which the mean is larger.
    fitting = {
        name: compare_bones(other.people, mean_length)
        for name, other in readings.items()
        if (compare_bones(other.people) or np.inf) < limit
    }
    best = min(fitting, key=lambda name: fitting[name] or np.inf, default=None)
    if best is not None:
        found = readings[best]
        found.recognised.append(f"{count} points are {best}, not {assumed}, by their bones")
        return found
    if share > MAX_BONE_SHARE:
        raise UserError(
            f"{folder}: the {count} keypoints of camera {reading.images.name} fit none of the "
            f"layouts {', '.join([assumed, *readings])}: in {assumed}, bones are {share:.2f} times "
            f"as long as the distance of two points, expected less than {MAX_BONE_SHARE:g}; name "
            "the layout in detections.keypoint_layout, or write the keypoints in one of "
            f"{', '.join(sorted(layouts()))}"
        )
    reading.recognised.append(
        f"{count} points are taken for {assumed}, but bones are {share:.2f} times as long as the "
        "distance of two points; detections.keypoint_layout states another layout"
    )
    return reading
