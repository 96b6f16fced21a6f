"""Colours of the object's surface, learnt while it is tracked.

They decide between rotations that the shape leaves ambiguous. The surface is divided into patches.
The colour of a patch is three logarithms of linear light, to which a camera's gain and shading add:
mean of the channels (brightness), red over green, blue over green. The log-likelihood ratio of a
pose x is

    log p(colours | colours learnt for these patches at pose x)
        - log p(colours | colours of the object as a whole)

so an object of one colour decides nothing, and neither does a side that was never seen.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numba
import numpy as np

from intercap_core.geometry.rigid.mesh import Paint
from intercap_core.object_track.likelihood import VIEW_SAMPLES
from intercap_core.object_track.reduced_mask import covers

# Lower limits of the standard deviations of measured colours (brightness, two ratios) in logarithms
# of light: shadows and lamps change the brightness more than the two ratios. They apply
# where the frames vary less than the true noise, as for an object at rest.
COLOUR_MIN_SIGMA = np.array([0.25, 0.08, 0.08])  # tuned
LEVELS_USED = slice(10, 251)  # grey levels; darker ones are noise, brighter ones saturated; tuned


def linear(levels: np.ndarray) -> np.ndarray:
    """Convert uint8 grey levels to light (...,), 0 to 1, by the curve of sRGB (IEC 61966-2-1)."""
    value = np.asarray(levels) / 255.0
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


LIGHT = np.full(256, np.nan)
"""(256,) logarithms of light of the grey levels, NaN outside of ``LEVELS_USED``."""
LIGHT[LEVELS_USED] = np.log(linear(np.arange(256)[LEVELS_USED]))


@dataclass(frozen=True, eq=False)
class SurfaceColours:
    """Colours of the surface in one frame at one pose, patch by patch."""

    frame: int
    """Frame."""
    patch: np.ndarray
    """(N,) numbers of the patches (:func:`patch_of`)."""
    colour: np.ndarray
    """(N, 3) mean colours: brightness and two ratios, logarithms of light."""
    normal: np.ndarray
    """(N, 3) unit normals of the patches, master frame."""
    view: np.ndarray
    """(N,) index of the view that shows each patch, ascending."""
    pixels: np.ndarray
    """(N,) number of pixels of each patch."""


@dataclass(frozen=True, eq=False)
class _PatchColours:
    """Colours of P patches as Gaussians, one per channel."""

    mean: np.ndarray
    """(P, 3) means."""
    variance: np.ndarray
    """(P, 3) variances of the means, without the noise of a measurement."""


class Appearance:
    """Colours of the surface, learnt from frames with a certain pose."""

    def __init__(
        self, sightings: Sequence[SurfaceColours], views: int, paint: Paint | None, size: float
    ) -> None:
        """Learn the colours.

        Args:
            sightings: colours of one frame each, at its pose.
            views: number of views.
            paint: colours of the mesh; ignored if they do not explain the learnt ones.
            size: size of a patch, metres.
        """
        self.sightings = tuple(sightings)
        self._patches = np.unique(np.concatenate([s.patch for s in sightings]))
        self._gain = np.zeros((views, 3))
        every = np.concatenate([s.colour for s in sightings])
        self._average = np.median(every, axis=0)
        self._spread = np.maximum(every.var(0), COLOUR_MIN_SIGMA**2)
        self._noise = self._spread.copy()
        self._frames = np.array([s.frame for s in sightings])
        count = len(self._patches)
        self._totals = np.zeros((len(sightings), count, 3))
        self._looks = np.zeros((len(sightings), count))
        self._learn()
        self._painted = None if paint is None else self._compare(paint, size)

    @property
    def is_coloured(self) -> bool:
        """Whether the patches' colours vary: their variance exceeds half of the noise."""
        return bool((self._spread > 0.5 * self._noise).any())

    def log_ratio(self, seen: SurfaceColours, apart: int) -> float:
        """Return the log-likelihood ratio of a pose, nats.

        The learnt colours are those of frames at least ``apart`` frames away.
        """
        return self._ratio(seen, self._known(np.abs(self._frames - seen.frame) >= apart))

    def paint_log_ratio(self, seen: SurfaceColours) -> float:
        """Return the ratio for the mesh's own colours, nats; 0 if they are not the object's."""
        return 0.0 if self._painted is None else self._ratio(seen, self._painted)

    def _learn(self) -> None:
        """Estimate colours, gains of the cameras, noise and spread alternately, four times.

        The colour of each frame is compared with those learnt in all other frames. The residual
        gives the gains and the noise; the rest of the colours' variance is their spread.
        """
        gain_sigma = 0.15  # of a camera's gain, logarithm of light
        views = np.concatenate([s.view for s in self.sightings])
        cameras = np.unique(views)
        for _ in range(4):
            plain = [
                self._unshaded(s, s.colour - self._gain[s.view] - self._average)
                for s in self.sightings
            ]
            self._add_up(plain)
            left = []
            for seen in self.sightings:
                at, _ = self._find(seen.patch)
                known = self._known(self._frames != seen.frame)
                colour = seen.colour - self._gain[seen.view] - known.mean[at]
                left.append(self._unshaded(seen, colour))
            residual = np.concatenate(left)
            # shrunk toward 0: in a camera that has seen one side only, the residual may be that
            # side's colour instead of a gain
            share = gain_sigma**2 / (gain_sigma**2 + self._noise)
            for camera in cameras:
                left_over = residual[views == camera] + self._gain[camera]
                self._gain[camera] = share * np.median(left_over, axis=0)
            self._gain[cameras] -= self._gain[cameras].mean(0)
            # what other frames do not predict is noise: a hand in front of the object, a shadow
            noise = _mean_square(residual)
            self._noise = np.maximum(noise, COLOUR_MIN_SIGMA**2)
            self._spread = np.maximum(_mean_square(np.concatenate(plain)) - noise, 0.0)

    def _add_up(self, plain: Sequence[np.ndarray]) -> None:
        """Average the colours of the patches by frame.

        All views of a frame count as one observation. ``plain`` [frames] (N, 3) are unshaded
        differences from the average colour.
        """
        count = len(self._patches)
        for number, (seen, colour) in enumerate(zip(self.sightings, plain, strict=True)):
            at, _ = self._find(seen.patch)
            weight = np.bincount(at, seen.pixels, count)
            self._looks[number] = weight > 0
            for channel in range(3):
                own = np.bincount(at, seen.pixels * (self._average + colour)[:, channel], count)
                self._totals[number, :, channel] = own / np.maximum(weight, 1e-9)

    def _known(self, frames: np.ndarray) -> _PatchColours:
        """Return the colours of the patches by the learnt frames in the mask ``frames`` (N,)."""
        spread = np.maximum(self._spread, 1e-9)
        looks = self._looks[frames].sum(0)[:, None]
        variance = 1 / (1 / spread + looks / self._noise)
        total = self._totals[frames].sum(0)
        return _PatchColours(variance * (self._average / spread + total / self._noise), variance)

    def _find(self, patch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the indices (N,) of patches among the known ones, and whether each is known."""
        at = np.minimum(np.searchsorted(self._patches, patch), len(self._patches) - 1)
        return at, self._patches[at] == patch

    def _unshaded(self, seen: SurfaceColours, colour: np.ndarray) -> np.ndarray:
        """Remove shading and exposure from differences of colour (N, 3).

        Each view has an offset of all colours (exposure), and a gradient of brightness along the
        normals (light from one side). Both are estimated by ridge regression.
        """
        # standard deviations, logarithms of light: exposure and white balance of a view from frame
        # to frame, and light from one side relative to the other
        exposure_sigma, shading_sigma = 0.1, 0.4
        result = colour.copy()
        starts = np.flatnonzero(np.diff(seen.view, prepend=-1))
        for start, stop in zip(starts, [*starts[1:], len(seen.view)], strict=True):
            own = slice(start, stop)
            # Errors of a view's patches are correlated: all its pixels count as VIEW_SAMPLES
            # samples. With more, the colour of a view of one side would be taken for exposure.
            weight = VIEW_SAMPLES * seen.pixels[own, None] / seen.pixels[own].sum()
            light = np.concatenate(
                [np.full((stop - start, 1), exposure_sigma), shading_sigma * seen.normal[own]], 1
            )
            # brightness: exposure and shading; ratios: an offset alone (white balance)
            for channels, design in ((slice(0, 1), light), (slice(1, 3), light[:, :1])):
                noise = self._noise[channels].mean()
                matrix = (weight * design).T @ design / noise + np.eye(design.shape[1])
                force = (weight * design).T @ colour[own, channels] / noise
                result[own, channels] -= design @ np.linalg.solve(matrix, force)
        return result

    def _ratio(self, seen: SurfaceColours, known: _PatchColours) -> float:
        """Return the log-likelihood ratio of colours, nats.

        It is the sum over views of the mean over pixels times the number of independent samples.
        """
        at, is_known = self._find(seen.patch)
        colour = seen.colour - self._gain[seen.view]
        any_ = self._unshaded(seen, colour - self._average)
        mean = np.where(is_known[:, None], known.mean[at], self._average)
        variance = np.where(is_known[:, None], known.variance[at], self._spread) + self._noise
        own = self._unshaded(seen, colour - mean)
        common = self._spread + self._noise
        ratio = _cost(any_, common) - _cost(own, variance)
        total = 0.0
        for camera in np.unique(seen.view):
            here = seen.view == camera
            pixels = float(seen.pixels[here].sum())
            samples = VIEW_SAMPLES * pixels / (pixels + 60)  # half of them at 60 pixels
            total += samples * float(seen.pixels[here] @ ratio[here]) / pixels
        return total

    def _compare(self, paint: Paint, size: float) -> _PatchColours | None:
        """Return the mesh's own colours of the patches if they explain the learnt ones."""
        number = patches_of(paint.points, paint.normals, size)
        at, is_known = self._find(number)
        # a scan has no noise in its darkest and brightest colours
        levels = np.clip(paint.colours, LEVELS_USED.start, LEVELS_USED.stop - 1)
        red, green, blue = LIGHT[levels].T
        colour = np.stack([(red + green + blue) / 3, red - green, blue - green], 1)
        usable = is_known & np.isfinite(colour).all(1)
        count = len(self._patches)
        looks = np.bincount(at[usable], minlength=count)
        total = [np.bincount(at[usable], colour[usable, k], count) for k in range(3)]
        there = looks > 0
        if there.sum() < 2:
            return None
        mean = np.tile(self._average, (count, 1))
        mean[there] = np.stack(total, 1)[there] / looks[there, None]
        learnt = self._known(np.ones(len(self._frames), bool)).mean
        mean[there] += np.median(learnt[there] - mean[there], axis=0)
        off = _mean_square(learnt[there] - mean[there])
        square = _mean_square(learnt[there] - self._average)
        # They must explain half of the variance of all channels together, because the paint of
        # another copy may match in one channel by chance.
        if (off / self._noise).sum() > 0.5 * (square / self._noise).sum():
            return None
        variance = np.where(there[:, None], off, self._spread)
        return _PatchColours(mean, variance)


def _cost(residual: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Return minus log-likelihoods (N,) of residuals (N, 3) up to a constant, bounded."""
    # at most three standard deviations: an occluder, a highlight
    cost = np.minimum(0.5 * residual**2 / variance, 4.5)
    return (cost + 0.5 * np.log(variance)).sum(1)


def _mean_square(residual: np.ndarray) -> np.ndarray:
    """Return the mean square (3,) of residuals (N, 3), each bounded by 2 (a factor of 7)."""
    return (np.clip(residual, -2.0, 2.0) ** 2).mean(0)


@numba.njit(cache=True, nogil=True)
def patch_of(point, normal, size):
    """Return the number of the patch of a surface point.

    A patch is a cell of a grid of ``size`` metres. It is split by the direction (+ or - x, y or z
    of the object) that the surface faces most. The number has 1024 cells along each axis.
    """
    facing = 0
    for axis in range(1, 3):
        if abs(normal[axis]) > abs(normal[facing]):
            facing = axis
    side = 2 * facing + (1 if normal[facing] > 0 else 0)
    number = 0
    for axis in range(3):
        number = number * 1024 + int(np.floor(point[axis] / size)) + 512
    return 6 * number + side


@numba.njit(cache=True, nogil=True)
def patches_of(points, normals, size):
    """Return :func:`patch_of` of points (N, 3): (N,) int64."""
    patches = np.empty(len(points), np.int64)
    for i in range(len(points)):
        patches[i] = patch_of(points[i], normals[i], size)
    return patches


@numba.njit(cache=True, nogil=True)
def seen_patches(
    depth, face, corner, mask, rays, picture, light, object_from_camera, face_normals, size, steep
):
    """Return the patches of all pixels that show the object, with faces and colours.

    The loop runs over the pixels of the rendering. A pixel counts if it and its four neighbours lie
    in the rendering and in the candidate's mask. No channel may be too dark or saturated, nor the
    surface too oblique. Its depth gives the surface point, and so the patch.

    Args:
        depth, face: (h, w) of the rendering, whose first pixel is ``corner`` of the image.
        mask: the candidate's mask (:attr:`.reduced_mask.ReducedMask.placed`).
        rays: (H, W, 2) of the lens.
        picture: (H, W, 3) uint8 BGR.
        light: (256,) logarithms of light of grey levels, NaN if too dark or saturated.
        object_from_camera: (4, 4).
        face_normals: (F, 3), object frame.
        size: size of a patch, metres.
        steep: least cosine between the surface's normal and the ray to the camera.

    Returns:
        Patches (n,), faces (n,) and colours (n, 3): brightness, red over green, blue over green.
    """
    height, width = face.shape
    patches = np.empty(height * width, np.int64)
    faces = np.empty(height * width, np.int64)
    colours = np.empty((height * width, 3))
    point = np.empty(3)
    count = 0
    for v in range(1, height - 1):
        for u in range(1, width - 1):
            f = face[v, u]
            if f < 0:
                continue
            x, y = corner[0] + u, corner[1] + v
            blue, green = light[picture[y, x, 0]], light[picture[y, x, 1]]
            red = light[picture[y, x, 2]]
            if np.isnan(blue + green + red):
                continue
            inside = True
            for a, b in ((0, 0), (-1, 0), (1, 0), (0, -1), (0, 1)):
                inside &= face[v + a, u + b] >= 0 and covers(mask, x + b, y + a)
            if not inside:
                continue
            z = depth[v, u]
            px, py = rays[y, x, 0] * z, rays[y, x, 1] * z
            across, length = 0.0, 0.0
            for axis in range(3):
                along = (
                    object_from_camera[axis, 0] * px
                    + object_from_camera[axis, 1] * py
                    + object_from_camera[axis, 2] * z
                )
                point[axis] = along + object_from_camera[axis, 3]
                across -= along * face_normals[f, axis]
                length += along * along
            if across < steep * np.sqrt(length):
                continue
            patches[count], faces[count] = patch_of(point, face_normals[f], size), f
            colours[count, 0] = (blue + green + red) / 3
            colours[count, 1], colours[count, 2] = red - green, blue - green
            count += 1
    return patches[:count], faces[:count], colours[:count]
