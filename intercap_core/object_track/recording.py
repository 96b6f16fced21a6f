"""The views of one recording as the tracker uses them, read from the artefacts when asked for."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import Literal

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Candidate, Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.object_track.constants import (
    CANDIDATE_MAX_EXTENT,
    CANDIDATE_MIN_EXTENT,
    CANDIDATE_SLACK_M,
)
from intercap_core.object_track.view import View, ViewGeometry, distances
from intercap_core.schemas import PERSON, SCENE

log = logging.getLogger(__name__)

# By the step of the reduced grid, how many pixels a decoder may join.
_DECODED_BY: dict[int, Literal[1, 2, 4]] = {2: 2, 4: 4}


class ObjectRecording:
    """The views of every moment, read from the artefacts when asked for."""

    def __init__(
        self,
        frames: Frames,
        detections: Detections,
        scene: Path,
        person: Path,
        diameter_m: float,
    ) -> None:
        rig = Rig.from_scene(scene)
        with artefacts.read(scene, SCENE) as artefact:
            present = artefact["present"]
            bias, late = artefact["depth_bias"], artefact["time_offset"]
            self._frames = frames.showing(artefact["image_of"])
            moments = detections.showing(artefact["image_of"])
            self.up = artefact["zup_from_master"][2, :3].copy()
            rooms = {
                c: artefact[f"cameras/{camera.name}/background"]
                for c, camera in enumerate(rig)
                if f"cameras/{camera.name}/background" in artefact
            }
        self._detections = moments.with_candidates_of(person)
        self._diameter_m = diameter_m
        self._unreadable: set[tuple[int, int]] = set()
        with artefacts.read(person, PERSON) as artefact:
            masks = artefacts.unpack_ragged(artefact["mask_offsets"], artefact["mask_rle"])
            self.joints = np.where(artefact["missing"][:, None, None], np.nan, artefact["joints"])
        self._masks = [masks[t * len(rig) : (t + 1) * len(rig)] for t in range(frames.num_sets)]
        usable = present & np.isfinite(rig.master_from_colour).all((1, 2))
        self.count, self.cameras = len(rig), [int(c) for c in np.flatnonzero(usable)]
        away = distances([rig[c] for c in self.cameras], self.joints)
        self.geometry = [
            ViewGeometry.for_object(
                rig[c], diameter_m, float(np.nan_to_num(bias[c])), float(late[c]), distance
            )
            for c, distance in zip(self.cameras, away, strict=True)
        ]

        self._rooms = [
            geometry.reduced_depth(rooms[c]) if c in rooms else None
            for c, geometry in zip(self.cameras, self.geometry, strict=True)
        ]

    def views(self, t: int) -> list[View]:
        """What each usable camera shows of moment t."""
        return [self.view(t, place) for place in range(len(self.cameras))]

    def view(self, t: int, place: int) -> View:
        """What the usable camera at ``place`` among :attr:`cameras` shows of moment t."""
        c = self.cameras[place]
        candidates = [
            (candidate.index, candidate.label, candidate.score, candidate.rle)
            for candidate in self._candidates(t, c)
        ]
        depth = self._frames.depth(t, c)
        detected = bool(self._detections.candidates_found[t, c])
        geometry, room = self.geometry[place], self._rooms[place]
        return View.build(geometry, depth, self._masks[t][c], candidates, detected, room)

    def pictures(self, t: int) -> list[np.ndarray | None]:
        """The colour image (h, w, 3) uint8 BGR of each usable camera at moment t, on its reduced
        grid; None where there is none that can be read."""
        found: list[np.ndarray | None] = []
        for c, geometry in zip(self.cameras, self.geometry, strict=True):
            image = self._picture(t, c, _DECODED_BY.get(geometry.step, 1))
            step = geometry.step
            if image is not None and image.shape[:2] != (geometry.lens.height, geometry.lens.width):
                image = image[::step, ::step]
            found.append(image)
        return found

    def _picture(self, t: int, c: int, reduction: Literal[1, 2, 4]) -> np.ndarray | None:
        """The image as its decoder reduces it, or whole where that is of another size."""
        try:
            return self._frames.colour(t, c, reduction)
        except UserError as error:
            if reduction > 1:
                return self._picture(t, c, 1)
            if (t, c) not in self._unreadable:
                log.warning("%s", error)
            self._unreadable.add((t, c))
            return None

    def _candidates(self, t: int, c: int) -> list[Candidate]:
        """What may be the object by its size, where that is known."""
        low, high = (
            CANDIDATE_MIN_EXTENT * self._diameter_m,
            CANDIDATE_MAX_EXTENT * self._diameter_m + CANDIDATE_SLACK_M,
        )
        found = self._detections.candidates(t, c)
        return [one for one in found if not (one.extent_m < low or one.extent_m > high)]

    def labels(self) -> list[list[list[str]]]:
        """Labels [T][usable cameras][candidates] of what was detected."""
        return [
            [[candidate.label for candidate in self._candidates(t, c)] for c in self.cameras]
            for t in range(self._frames.num_sets)
        ]
