"""The depth camera: noise, bias, flying pixels, holes.

Magnitudes after the Azure Kinect's published behaviour (Tolgyessy et al. 2021, "Evaluation of the
Azure Kinect and its comparison to Kinect V1 and V2"): about 1 mm at 1 m, 10 mm at 4 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.studio.noise import NoiseSource, gaussian
from intercap_core.studio.render import Cast, View

NOISE_M, NOISE_PER_M2 = 0.0006, 0.00058  # standard deviation = a + b z^2
SMOOTH_SHARE = 0.45  # of the noise's variance that neighbours share
BIAS_M = 0.003  # of a camera
RIPPLE_M, RIPPLE_PERIOD_M = 0.0012, 0.75  # error that waves with distance
EDGE_M = 0.04  # a step in depth that makes flying pixels
FLYING, LOST_AT_EDGE = 0.35, 0.30  # shares of the pixels on a step
GRAZING_COSINE = 0.16
DARK = 0.10  # albedo below which the light does not always come back


@dataclass(frozen=True)
class ModeLimits:
    """Of one depth mode: nearest and farthest distance that is measured, somewhat beyond what the
    data sheet warrants, and its noise against the narrow unbinned mode's."""

    near_m: float
    far_m: float
    noise: float


LIMITS = {
    "NFOV_UNBINNED": ModeLimits(0.45, 4.3, 1.0),
    "NFOV_2X2BINNED": ModeLimits(0.45, 6.0, 0.7),
    "WFOV_2X2BINNED": ModeLimits(0.23, 3.2, 1.2),
    "WFOV_UNBINNED": ModeLimits(0.23, 2.5, 2.0),
}


class DepthSensor:
    """One depth camera looking at the room through ``view``; errors from ``noise``."""

    def __init__(
        self,
        view: View,
        noise: NoiseSource,
        name: str,
        mode: str = "NFOV_UNBINNED",
    ) -> None:
        self.view, self._noise, self._limits = view, noise, LIMITS[mode]
        rng = noise.rng("depth", name)
        self._rng = rng
        self.bias = float(noise.tails(rng.normal(size=1))[0]) * BIAS_M * noise.scale
        self._ripple = rng.uniform(0, 2 * np.pi)
        direction = view.directions()
        self._direction = direction / np.maximum(
            np.linalg.norm(direction, axis=-1, keepdims=True), 1e-9
        )
        self._in_field = _field(view.lens, mode)
        self._finite = np.isfinite(view.depth)
        self._room = np.where(self._finite, view.depth, 0)
        cosine = np.einsum("hwc,hwc->hw", view.normal, self._direction)
        risk = self._risk(view.depth, cosine, np.ones_like(view.depth))
        blotches = _blotches(rng, view.depth.shape, 2.0, 0.28)
        self._static_holes = blotches < np.where(np.isfinite(risk), risk, 1)

    def _risk(self, depth: np.ndarray, cosine: np.ndarray, albedo: np.ndarray) -> np.ndarray:
        """Share (...) of holes on surfaces at grazing angles and on dark ones."""
        scale = self._noise.scale
        risk = 0.9 * np.clip(1 - np.abs(cosine) / (GRAZING_COSINE * (0.5 + 0.5 * scale)), 0, 1)
        risk += np.clip(1 - albedo / DARK, 0, 1) * np.clip(depth / 4 - 0.2, 0, 0.7)
        return risk * min(scale, 1.5)

    def image(self, cast: Cast) -> np.ndarray:
        """Depth (H, W) uint16 in millimetres, 0 = invalid, of the room with moving things."""
        rng, scale = self._rng, np.float32(self._noise.scale)
        depth, invalid = self._room.copy(), ~self._finite | ~self._in_field | self._static_holes
        if len(cast.pixels):
            at = cast.image_pixels
            depth[at] = cast.depth
            cosine = np.einsum("nc,nc->n", cast.normal, self._direction[at])
            risk = self._risk(cast.depth, cosine, cast.colour.mean(-1))
            blotches = _blotches(rng, cast.identity.shape, 1.2, 0.45).ravel()[cast.pixels]
            invalid[at] = ~self._in_field[at] | (blotches < risk)
        self._edges(depth, invalid, scale)
        white, error = gaussian(rng, depth.shape), gaussian(rng, depth.shape)
        error *= np.float32(np.sqrt(1 - SMOOTH_SHARE))
        kernel = cv2.getGaussianKernel(3, 0.9)
        unit = np.sqrt(SMOOTH_SHARE) / np.linalg.norm(kernel @ kernel.T)
        error += cv2.GaussianBlur(white, (3, 3), 0.9) * np.float32(unit)
        if self._noise.family == "b":  # now and then a pixel is far off
            error *= np.where(np.abs(white) > 2.2, np.float32(3.0), np.float32(0.85))
        sigma = depth * depth
        sigma *= np.float32(NOISE_PER_M2)
        sigma += np.float32(NOISE_M)
        error *= sigma
        error *= np.float32(self._limits.noise)
        phase = depth * np.float32(2 * np.pi / RIPPLE_PERIOD_M) + np.float32(self._ripple)
        error += np.float32(RIPPLE_M) * np.sin(phase)
        error *= scale
        error += depth
        error += np.float32(self.bias)
        invalid |= (error <= self._limits.near_m) | (error >= self._limits.far_m)
        error[invalid] = 0
        return np.rint(error * 1000).astype(np.uint16)

    def _edges(self, depth: np.ndarray, invalid: np.ndarray, scale: np.float32) -> None:
        """Mix depths across steps, or lose them, in place."""
        kernel = np.ones((3, 3), np.uint8)
        near, far = cv2.erode(depth, kernel).ravel(), cv2.dilate(depth, kernel).ravel()
        at = np.flatnonzero((far - near > EDGE_M) & (near > 0))
        chance, share = self._rng.random((2, len(at)), np.float32)
        strength = min(float(scale), 1.5)
        flying = chance < FLYING * strength
        gone = ~flying & (chance < (FLYING + LOST_AT_EDGE) * strength)
        invalid.ravel()[at[gone]] = True
        at, share = at[flying], share[flying]
        here = depth.ravel()[at]
        towards = np.where(here - near[at] < far[at] - here, 1, -1)
        depth.ravel()[at] = here + share * (far[at] - near[at]) * towards


def _blotches(
    rng: np.random.Generator,
    shape: tuple[int, ...],
    size: float,
    contrast: float,
) -> np.ndarray:
    """Values in [0, 1] (H, W) that change over ``size`` pixels."""
    smooth = cv2.GaussianBlur(gaussian(rng, shape), (0, 0), size)
    return 0.5 + 0.5 * np.tanh(smooth / contrast / 1.2)


def _field(lens: Intrinsics, mode: str) -> np.ndarray:
    """Pixels (H, W) that the infrared light reaches: a hexagon in the narrow modes, a disc in the
    wide ones."""
    v, u = np.mgrid[: lens.height, : lens.width]
    x, y = u / (lens.width - 1) * 2 - 1, v / (lens.height - 1) * 2 - 1
    lit = abs(x) + 0.55 * abs(y) < 1.42 if mode.startswith("NFOV") else np.hypot(x, y) < 1
    return lit & np.isfinite(lens.rays[..., 0])
