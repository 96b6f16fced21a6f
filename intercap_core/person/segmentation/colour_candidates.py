"""The person's mask and candidates of the object from images of a camera without depth.

Background subtraction: a pixel that differs in colour from the recording's median is foreground.
Foreground around the projected keypoints is the person. Without depth, an object that occludes the
person in the image counts as the person. An object at rest for most of a recording is part of the
background.
"""

from __future__ import annotations

import cv2
import numba
import numpy as np

from intercap_core.artefacts import Artefact
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.solve.time_series import sample_evenly
from intercap_core.person.segmentation.candidate_masks import (
    ImageCandidate,
    ViewSegments,
    encode_window,
)
from intercap_core.person.segmentation.person_volume import MovingPerson

COLOUR_SCALE = 2  # images are decoded at half size, which takes a quarter of the time for JPEG


class ColourSegmenter:
    """Segments the views of cameras without depth."""

    def __init__(
        self, frames: Frames, scene: Artefact, joints: np.ndarray, sigma: np.ndarray
    ) -> None:
        """The arguments are those of :func:`.image_segmentation.segment_images`."""
        self._frames = frames
        self._rig = Rig.from_artefact(scene)
        self._person = MovingPerson(joints, sigma, scene)
        self._backgrounds: dict[int, tuple[np.ndarray, np.ndarray] | None] = {}

    def segment(self, t: int, c: int) -> ViewSegments | None:
        """Segment one image; None if it does not decode, or background or person are unknown."""
        if c not in self._backgrounds:
            self._backgrounds[c] = self._background(c)
        background = self._backgrounds[c]
        bones = self._person.bones(t, c)
        image = self._image(t, c) if background is not None and len(bones) else None
        if image is None or background is None:
            return None
        camera = self._rig[c]
        moved = find_foreground(image, *background)
        # the volume around the bones counts as person even without a change of colour: clothes of
        # the wall's colour, and places that the person never left
        body = draw_volume(bones, camera, moved.shape, 0)
        # A margin is the uncertainty of the volume's surface. 0 margins: certainly person; 2:
        # changed pixels are person; 1: changed pixels beyond may be an object; 5: kept out of the
        # background. All tuned on the studio.
        person = body | (moved & draw_volume(bones, camera, moved.shape, 2.0))
        # Pixels in which the mask's border is not the person's outline: around the volume without
        # change of colour, at changed pixels beyond two margins, and at unknown background.
        assumed = cv2.dilate((body & ~moved).view(np.uint8), np.ones((9, 9), np.uint8)) > 0
        unsure = assumed | (moved & ~person) | ~background[1]
        objects = moved & ~draw_volume(bones, camera, moved.shape, 1.0)
        block = np.ones((3, 3), np.uint8)
        rest = cv2.morphologyEx(objects.view(np.uint8), cv2.MORPH_OPEN, block)
        _, label, stats, _ = cv2.connectedComponentsWithStats(rest, connectivity=8)
        areas = stats[:, cv2.CC_STAT_AREA]
        # at least 60 pixels of the reduced image; tuned on the studio
        large = [k for k in np.argsort(-areas, kind="stable") if k and areas[k] >= 60]
        candidates = [  # score undecided, size in space unknown, no component common to the views
            ImageCandidate(self._rle(label == k, camera), 0.5, float("nan"), -1) for k in large[:5]
        ]
        if not person.any():
            return ViewSegments(b"", candidates)
        beside = self._rle(unsure, camera) if unsure.any() else b""
        return ViewSegments(self._rle(person, camera), candidates, beside)

    def _image(self, t: int, c: int) -> np.ndarray | None:
        """Image (H, W, 3) uint8 at half size; None if it is absent or damaged."""
        jpeg = self._frames.colour_jpeg(t, c)
        if jpeg is None:
            return None
        image = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_REDUCED_COLOR_2)
        lens = self._rig[c].colour
        size = (-(-lens.height // COLOUR_SCALE), -(-lens.width // COLOUR_SCALE), 3)
        return image if image is not None and image.shape == size else None

    def _background(self, c: int) -> tuple[np.ndarray, np.ndarray] | None:
        """Background of a camera from up to 15 images, see :func:`median_background`."""
        images, people = [], []
        for t in sample_evenly(self._frames.colour_available[:, c], 15):
            image, bones = self._image(int(t), c), self._person.bones(int(t), c)
            if image is not None:
                images.append(image)
                people.append(draw_volume(bones, self._rig[c], image.shape[:2], 5.0))
        if not images:
            return None
        median, known = median_background(np.stack(images), np.stack(people))
        return (median, known) if known.any() else None

    def _rle(self, mask: np.ndarray, camera: Camera) -> bytes:
        """RLE at full size of a mask (H, W) at half size that is not empty."""
        rows, columns = np.flatnonzero(mask.any(1)), np.flatnonzero(mask.any(0))
        top, left = int(rows[0]), int(columns[0])
        window = mask[top : rows[-1] + 1, left : columns[-1] + 1].astype(np.uint8)
        lens = camera.colour
        return encode_window(window, left, top, COLOUR_SCALE, lens.width, lens.height)


def median_background(images: np.ndarray, people: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Median colour (H, W, 3) float32 without the person, and mask (H, W) of known pixels.

    A pixel is known if at least three images show it without the person: of fewer, the median does
    not reject an outlier. The images are first multiplied to match the exposure of the first one.

    Args:
        images: (S, H, W, 3) uint8.
        people: (S, H, W) bool, pixels of the person.
    """
    gains = np.stack([_gain(image, images[0]) for image in images])
    seen = len(images) - people.sum(0)
    values = np.minimum(images * gains[:, None, None], np.float32(255))
    values[people] = np.inf
    middle = np.maximum(seen - 1, 0) // 2
    median = np.take_along_axis(np.sort(values, 0), middle[None, ..., None], 0)[0]
    median[seen == 0] = 0
    return median, seen >= 3


def find_foreground(image: np.ndarray, background: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Pixels (H, W) bool that differ from the background by more than a shadow, holes closed.

    Args:
        image: (H, W, 3) uint8.
        background: (H, W, 3) float32.
        known: (H, W) bool, pixels with a background; others are no foreground.
    """
    changed = _changed(image, background, _gain(image, background)) & known
    block = np.ones((3, 3), np.uint8)
    opened = cv2.morphologyEx(changed.view(np.uint8), cv2.MORPH_OPEN, block)
    return cv2.morphologyEx(opened, cv2.MORPH_CLOSE, np.ones((5, 5), np.uint8)) > 0


@numba.njit(cache=True)
def _changed(image: np.ndarray, background: np.ndarray, gain: np.ndarray) -> np.ndarray:
    """Mask (H, W) of changed pixels, by Horprasert, Harwood and Davis (1999).

    A pixel's colour is split into a multiple of the background's colour (brightness) and the rest
    (colour deviation). A pixel has changed if the deviation exceeds 14 grey levels or the
    brightness leaves 0.5 to 1.4: a shadow only darkens to half. Where the background is dark, its
    colour vector shorter than 40 grey levels, the direction of the vector is unreliable; there, a
    difference of 30 grey levels in any channel counts. Thresholds are tuned on the studio.
    """
    height, width, channels = image.shape
    changed = np.zeros((height, width), np.bool_)
    for y in range(height):
        for x in range(width):
            power = along = length = largest = np.float32(0)
            for channel in range(channels):
                seen = image[y, x, channel] * gain[channel]
                known = background[y, x, channel]
                power += known * known
                along += seen * known
                length += seen * seen
                largest = max(largest, abs(seen - known))
            if power < 40.0 * 40.0:
                changed[y, x] = largest > 30.0
                continue
            brightness = along / power
            off = length - brightness * along  # squared colour deviation
            changed[y, x] = off > 14.0 * 14.0 or brightness < 0.5 or brightness > 1.4
    return changed


def _gain(image: np.ndarray, reference: np.ndarray) -> np.ndarray:
    """Factors (3,) float32, by channel, that match an image's exposure to the reference.

    They are median ratios over every 16th pixel in both directions.
    """
    few = np.s_[::16, ::16]
    a, b = image[few].astype(np.float32), reference[few].astype(np.float32)
    good = (a > 20) & (a < 250) & (b > 20) & (b < 250)  # neither dark nor saturated
    gains = np.ones(3, np.float32)
    for channel in range(3):
        use = good[..., channel]
        if use.any():
            gains[channel] = np.median(b[..., channel][use] / a[..., channel][use])
    return gains


def draw_volume(
    bones: np.ndarray, camera: Camera, shape: tuple[int, ...], margins: float
) -> np.ndarray:
    """Mask (H, W) of the person's volume in the reduced colour image.

    Each bone is drawn as a line of its mean radius plus ``margins`` times its own margin.

    Args:
        bones: (B, 9) of :func:`.person_volume.build_bones`, master frame, metres.
        camera: the colour camera.
        shape: rows and columns of the reduced image.
        margins: widening, in margins of each bone.
    """
    mask = np.zeros(shape[:2], np.uint8)
    if not len(bones):
        return mask > 0
    ends = apply(camera.colour_from_master, bones[:, :6].astype(np.float64).reshape(-1, 3))
    pixels = (camera.colour.project(ends) / COLOUR_SCALE).reshape(-1, 4)
    radius = bones[:, 6:8].mean(1) + margins * bones[:, 8]
    distance = ends[:, 2].reshape(-1, 2).mean(1)
    shown = camera.colour.inside_model(ends).reshape(-1, 2).all(1)
    shown &= np.abs(pixels).max(1) < 1e4  # also False for NaN
    width = 2 * radius[shown] * camera.colour.fx / distance[shown] / COLOUR_SCALE
    for (x0, y0, x1, y1), thick in zip(
        np.rint(pixels[shown]).astype(int).tolist(),
        np.rint(width).astype(int).tolist(),
        strict=True,
    ):
        cv2.line(mask, (x0, y0), (x1, y1), 1, thickness=max(1, thick))
    return mask > 0
