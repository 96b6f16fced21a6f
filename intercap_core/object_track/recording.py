"""The views of one recording, read from the artefacts on request and cached."""

from __future__ import annotations

import logging
from collections import OrderedDict
from collections.abc import Callable
from pathlib import Path
from threading import Lock
from typing import Literal

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Candidate, Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.object_track.view import View, ViewGeometry, camera_distances
from intercap_core.schemas import PERSON, SCENE

TRACKING_FACES = 600  # of the rendered mesh; measured within 0.5 mm of the full mesh

log = logging.getLogger(__name__)


class ObjectRecording:
    """Views, pictures and labels of every moment of a recording.

    Moment t is the time of frame set t. A camera's image of it may belong to another frame set, if
    that image is nearer in time (``image_of`` of the scene artefact).

    Attributes:
        up: (3,) vertical in the master frame.
        joints: (T, K, 3) of the person, master frame, NaN where unknown.
        count: number of cameras of the rig.
        cameras: indices in the rig of the usable cameras, which have images and a pose.
        geometry: reduced lenses of the usable cameras.
    """

    def __init__(
        self, frames: Frames, detections: Detections, scene: Path, person: Path, diameter_m: float
    ) -> None:
        """Open the views of a recording.

        Args:
            frames: the recording.
            detections: candidates of the recording.
            scene: artefact of stage ``scene``.
            person: artefact of stage ``person``.
            diameter_m: diameter of the object, metres.
        """
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
        away = camera_distances([rig[c] for c in self.cameras], self.joints)
        self.geometry = [
            ViewGeometry.for_object(
                rig[c], diameter_m, distance, float(np.nan_to_num(bias[c])), float(late[c])
            )
            for c, distance in zip(self.cameras, away, strict=True)
        ]

        self._rooms = [
            geometry.reduced_depth(rooms[c]) if c in rooms else None
            for c, geometry in zip(self.cameras, self.geometry, strict=True)
        ]

    def views(self, t: int) -> list[View]:
        """Return the view of each usable camera at moment t."""
        return [self.view(t, place) for place in range(len(self.cameras))]

    def view(self, t: int, place: int) -> View:
        """Return the view of camera number ``place`` among :attr:`cameras` at moment t."""
        c = self.cameras[place]
        candidates = [(item.index, item.label, item.rle) for item in self._candidates(t, c)]
        depth = self._frames.depth(t, c)
        detected = bool(self._detections.candidates_found[t, c])
        geometry, room = self.geometry[place], self._rooms[place]
        return View.build(geometry, depth, self._masks[t][c], candidates, detected, room)

    def pictures(self, t: int) -> list[np.ndarray | None]:
        """Return the colour image (h, w, 3) uint8 BGR of each usable camera at moment t.

        Images are on the reduced grid; None if there is no readable image.
        """
        pictures: list[np.ndarray | None] = []
        for c, geometry in zip(self.cameras, self.geometry, strict=True):
            step = geometry.step
            image = self._picture(t, c, 4 if step == 4 else 2 if step == 2 else 1)
            if image is not None and image.shape[:2] != (geometry.lens.height, geometry.lens.width):
                image = image[::step, ::step]
            pictures.append(image)
        return pictures

    def _picture(self, t: int, c: int, reduction: Literal[1, 2, 4]) -> np.ndarray | None:
        """Decode an image at reduced size, or in full if its size is unexpected."""
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
        """Return the candidates that have the object's size, or whose size is unknown.

        The limits allow for candidates that are partly hidden or include what the object touches.
        """
        low, high = 0.25 * self._diameter_m, 1.4 * self._diameter_m + 0.05  # tuned on the studio
        candidates = self._detections.candidates(t, c)
        return [item for item in candidates if not (item.extent_m < low or item.extent_m > high)]

    def labels(self) -> list[list[list[str]]]:
        """Return the labels [T][usable cameras][candidates]."""
        return [
            [[candidate.label for candidate in self._candidates(t, c)] for c in self.cameras]
            for t in range(self._frames.num_sets)
        ]


class ViewCache:
    """Least recently used cache of the views of frames.

    The default ``max_bytes`` holds 80 frame sets of six cameras with depth at full resolution, or
    370 with depth reduced as for a suitcase.
    """

    def __init__(self, load: Callable[[int], list[View]], max_bytes: int = 400_000_000) -> None:
        self._load = load
        self._max_bytes = max_bytes
        self._kept: OrderedDict[int, list[View]] = OrderedDict()
        self._bytes = 0
        self._lock = Lock()

    def __call__(self, t: int) -> list[View]:
        """Return the views of frame t, one per camera. One thread loads at a time."""
        with self._lock:
            if t in self._kept:
                self._kept.move_to_end(t)
                return self._kept[t]
            self._kept[t] = self._load(t)
            self._bytes += sum(view.nbytes for view in self._kept[t])
            while self._bytes > self._max_bytes and len(self._kept) > 1:
                _, oldest = self._kept.popitem(last=False)
                self._bytes -= sum(view.nbytes for view in oldest)
            return self._kept[t]
