"""The detections artefact, opened for reading: people and candidates of any image.

Images are indexed by camera c and frame set t, the images that the recordings' clocks put at one
time. After :meth:`Detections.showing`, t is a moment instead: the scene stage has corrected the
clocks and chosen the image of each camera that shows the moment.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.geometry.camera.masks import Runs
from intercap_core.schemas import DETECTIONS, PERSON

UNKNOWN_LABEL = ""  # of a candidate that no detector named
# Values of the person artefact's mask_source: what segmented the person in an image.
NOT_SEGMENTED, FROM_DETECTOR, FROM_IMAGES = 0, 1, 2


@dataclass(frozen=True, eq=False)
class Candidate:
    """One segmented instance of one image."""

    index: int
    """Position among the candidates of the image."""
    label: str
    """Name of the class; "" = unknown."""
    score: float
    """From 0 to 1."""
    rle: bytes
    """Mask as compressed COCO RLE; parsed on first use."""
    image_size: tuple[int, int]
    """Width and height of the image."""
    extent_m: float = float("nan")
    """Measured size of the instance, metres; NaN = not measured."""

    @cached_property
    def runs(self) -> Runs:
        """The mask; see :class:`Runs` for reading pixels, the box and the area."""
        width, height = self.image_size
        return Runs(self.rle, height, width)

    def mask(self) -> np.ndarray:
        """The mask decoded to the whole colour image (H, W) bool."""
        return self.runs.decode()


class PeopleOfImages(Protocol):
    """The people of a recording's images, from any source."""

    @property
    def num_sets(self) -> int:
        """Number T of frame sets or moments."""
        ...

    def people(self, t: int, c: int) -> np.ndarray:
        """Keypoints (P, 135, 3) of the image's people: x, y, confidence."""
        ...


@dataclass(frozen=True)
class _CandidateTable:
    """Datasets of candidates. Image i has the rows from ``offsets[i]`` up to ``offsets[i + 1]``."""

    offsets: np.ndarray
    scores: np.ndarray
    rle_offsets: np.ndarray
    rle: bytes
    labels: list[str] | None = None
    """Names of classes; None = unknown."""
    extents: np.ndarray | None = None
    """Measured sizes, metres; None = not measured."""

    def candidates(self, image: int, start: int, size: tuple[int, int]) -> list[Candidate]:
        """Candidates of an image of ``size`` (width, height), numbered from ``start``."""
        first, last = self.offsets[image : image + 2].tolist()
        return [
            Candidate(
                index=start + row - first,
                label=UNKNOWN_LABEL if self.labels is None else self.labels[row],
                score=float(self.scores[row]),
                rle=self.rle[self.rle_offsets[row] : self.rle_offsets[row + 1]],
                image_size=size,
                extent_m=float("nan" if self.extents is None else self.extents[row]),
            )
            for row in range(first, last)
        ]


class Detections:
    """Detections of all images; obtained from :meth:`load`.

    Everything is read at once: keypoints and RLE strings are a few MB for a hundred frame sets.
    """

    camera_names: tuple[str, ...]
    """Names of the C cameras."""
    image_sizes: np.ndarray
    """(C, 2) width and height of the colour images."""
    keypoints_found: np.ndarray
    """(T, C) bool: a detector of people processed the image."""
    candidates_found: np.ndarray
    """(T, C) bool: a detector of instances processed the image."""
    notes: tuple[str, ...]
    """Note of each of the C cameras on missing detections, "" = nothing is missing."""

    def __init__(self, artefact: artefacts.Artefact) -> None:
        self.path = artefact.path
        self.sequence = str(artefact.attributes["sequence"])
        self.camera_names = tuple(artefact.text("camera_names"))
        self.image_sizes = artefact["colour_size"]
        self.keypoints_found = artefact["keypoints_found"]
        self.candidates_found = artefact["candidates_found"]
        self.notes = tuple(artefact.text("note"))
        groups = [f"cameras/{name}" for name in self.camera_names]
        self._people = [artefact[f"{group}/people"] for group in groups]
        self._people_offsets = [artefact[f"{group}/people_offsets"] for group in groups]
        self._detected = [
            _CandidateTable(
                offsets=artefact[f"{group}/candidate_offsets"],
                scores=artefact[f"{group}/candidate_scores"],
                rle_offsets=artefact[f"{group}/rle_offsets"],
                rle=artefact[f"{group}/rle"].tobytes(),
                labels=artefact.text(f"{group}/candidate_labels"),
            )
            for group in groups
        ]
        self._image_of: np.ndarray | None = None
        # Candidates of stage ``person``, whose image t C + c is moment t of camera c; whether they
        # replace the detector's.
        self._from_images: _CandidateTable | None = None
        self._images_alone = False

    @classmethod
    def load(cls, path: Path) -> Detections:
        """Read the artefact and close it; raises UserError as :func:`artefacts.read` does."""
        with artefacts.read(path, DETECTIONS) as artefact:
            return cls(artefact)

    def showing(self, image_of: np.ndarray) -> Detections:
        """Return the detections indexed by moment instead of frame set.

        Raises UserError if ``image_of`` is of another recording.

        Args:
            image_of: (T, C) of the scene artefact: the frame set whose image of each camera shows
                each moment, -1 = none.
        """
        if image_of.shape != self.keypoints_found.shape:
            sets, cameras = self.keypoints_found.shape
            raise UserError(
                f"{self.path}: holds {sets} frame sets of {cameras} cameras, the scene artefact "
                f"{image_of.shape[0]} of {image_of.shape[1]}; re-run stages 'detections' and "
                f"'scene' for sequence {self.sequence!r}"
            )
        moments = copy(self)
        moments._image_of = image_of
        shown, at = image_of >= 0, np.maximum(image_of, 0)
        moments.keypoints_found = shown & np.take_along_axis(self.keypoints_found, at, 0)
        moments.candidates_found = shown & np.take_along_axis(self.candidates_found, at, 0)
        return moments

    def with_candidates_of(self, person: Path) -> Detections:
        """Return the detections with the candidates that stage ``person`` found in the images.

        These are appended to the detector's candidates, or replace them if the stage used the
        images alone. The detections must be indexed by moment (:meth:`showing`). Raises UserError
        if the artefact cannot be read or is of another recording.
        """
        with artefacts.read(person, PERSON) as artefact:
            source = artefact["mask_source"]
            if source.shape != self.candidates_found.shape:
                sets, cameras = self.candidates_found.shape
                raise UserError(
                    f"{person}: holds {source.shape[0]} frame sets of {source.shape[1]} cameras, "
                    f"expected {sets} of {cameras} as in {self.path}; re-run stage 'person' for "
                    f"sequence {self.sequence!r}"
                )
            alone = bool(artefact.attributes["images_alone"])
            if not alone and "candidate_offsets" not in artefact:
                return self
            table = _CandidateTable(
                offsets=artefact["candidate_offsets"],
                scores=artefact["candidate_scores"],
                rle_offsets=artefact["candidate_rle_offsets"],
                rle=artefact["candidate_rle"].tobytes(),
                extents=artefact["candidate_extents"],
            )
        both = copy(self)
        both._from_images, both._images_alone = table, alone
        # An image without foreground may still show the object, so it stays "not found".
        found = (np.diff(table.offsets) > 0).reshape(source.shape)
        both.candidates_found = found if alone else self.candidates_found | found
        return both

    def _image(self, t: int, c: int) -> int:
        return t if self._image_of is None else int(self._image_of[t, c])

    @property
    def num_sets(self) -> int:
        """Number T of frame sets or moments."""
        return int(self.keypoints_found.shape[0])

    def people(self, t: int, c: int) -> np.ndarray:
        """Keypoints (P, 135, 3) float32 of the image's people: x, y, confidence."""
        people, offsets, image = self._people[c], self._people_offsets[c], self._image(t, c)
        return people[:0] if image < 0 else people[offsets[image] : offsets[image + 1]]

    def candidates(self, t: int, c: int) -> list[Candidate]:
        """The image's segmentation candidates, in the order of the artefacts."""
        width, height = self.image_sizes[c].tolist()
        image, found = self._image(t, c), list[Candidate]()
        if image >= 0 and not self._images_alone:
            found = self._detected[c].candidates(image, 0, (width, height))
        if self._from_images is not None:
            image = t * len(self.camera_names) + c
            found += self._from_images.candidates(image, len(found), (width, height))
        return found
