"""The depth camera: noise, bias, flying pixels, holes.

Magnitudes after the Azure Kinect's published behaviour (Tolgyessy et al. 2021, "Evaluation of the
Azure Kinect and its comparison to Kinect V1 and V2"): about 1 mm at 1 m, 10 mm at 4 m.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.camera.intrinsics import Intrinsics
from intercap_core.studio.noise import NoiseSource
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
        self, view: View, noise: NoiseSource, name: str, mode: str = "NFOV_UNBINNED"
    ) -> None:
        self.view, self._noise, self._limits = view, noise, LIMITS[mode]
        rng = noise.rng("depth", name)
        self._rng = rng
        self.bias = float(noise.tails(rng.normal(size=1))[0]) * BIAS_M * noise.scale
        self._ripple = rng.uniform(0, 2 * np.pi)
        rays = view.lens.rays
        direction = np.dstack([rays, np.ones(rays.shape[:2], np.float32)]) @ view.rotation.T
        self._direction = direction / np.linalg.norm(direction, axis=-1, keepdims=True)
        self._in_field = _field(view.lens, mode)
        self._static_holes = self._holes(
            view.depth, view.normal, self._direction, np.ones_like(view.depth), rng,
            persistent=True,
        )  # fmt: skip

    def _holes(
        self,
        depth: np.ndarray,
        normal: np.ndarray,
        direction: np.ndarray,
        albedo: np.ndarray,
        rng: np.random.Generator,
        *,
        persistent: bool,
    ) -> np.ndarray:
        cosine = np.abs(np.einsum("hwc,hwc->hw", normal, direction))
        risk = 0.9 * np.clip(1 - cosine / (GRAZING_COSINE * (0.5 + 0.5 * self._noise.scale)), 0, 1)
        risk += np.clip(1 - albedo / DARK, 0, 1) * np.clip(depth / 4 - 0.2, 0, 0.7)
        risk = np.where(np.isfinite(risk), risk, 1) * min(self._noise.scale, 1.5)
        blotches = cv2.GaussianBlur(
            rng.standard_normal(depth.shape, np.float32), (0, 0), 2.0 if persistent else 1.2
        )
        blotches = 0.5 + 0.5 * np.tanh(blotches / (0.28 if persistent else 0.45) / 1.2)
        return blotches < risk

    def image(self, cast: Cast) -> np.ndarray:
        """Depth (H, W) uint16 in millimetres, 0 = invalid, of the room with moving things."""
        rng, scale = self._rng, np.float32(self._noise.scale)
        depth = self.view.depth.copy()
        holes = self._static_holes.copy()
        if cast.identity.size:
            window = cast.window
            moving = cast.identity > 0
            depth[window][moving] = cast.depth[moving]
            direction, albedo = self._direction[window], cast.colour.mean(-1)
            fresh = self._holes(cast.depth, cast.normal, direction, albedo, rng, persistent=False)
            holes[window] = np.where(moving, fresh, holes[window])
        finite = np.isfinite(depth)
        depth[~finite] = 0
        depth, lost = self._edges(depth, scale)
        sigma = np.float32(NOISE_M) + np.float32(NOISE_PER_M2) * depth * depth
        sigma *= np.float32(self._limits.noise)
        white = rng.standard_normal(depth.shape, np.float32)
        soft = cv2.GaussianBlur(white, (3, 3), 0.9)
        own = rng.standard_normal(depth.shape, np.float32)
        mixed = np.float32(np.sqrt(1 - SMOOTH_SHARE)) * own
        mixed += np.float32(np.sqrt(SMOOTH_SHARE) / max(soft.std(), 1e-6)) * soft
        if self._noise.family == "b":  # now and then a pixel is far off
            mixed *= np.where(np.abs(white) > 2.2, np.float32(3.0), np.float32(0.85))
        ripple = RIPPLE_M * np.sin(2 * np.pi * depth / RIPPLE_PERIOD_M + self._ripple)
        measured = depth + scale * (sigma * mixed + ripple.astype(np.float32)) + self.bias
        valid = finite & ~holes & ~lost & self._in_field
        valid &= (measured > self._limits.near_m) & (measured < self._limits.far_m)
        return np.where(valid, np.round(measured * 1000), 0).astype(np.uint16)

    def _edges(self, depth: np.ndarray, scale: np.float32) -> tuple[np.ndarray, np.ndarray]:
        """Mix depths across steps, or lose them; returns depth and which pixels are lost."""
        kernel = np.ones((3, 3), np.uint8)
        near, far = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
        rows, columns = np.nonzero((far - near > EDGE_M) & (near > 0))
        chance = self._rng.random((2, len(rows)), np.float32)
        share = chance[1]
        flying = chance[0] < FLYING * min(float(scale), 1.5)
        gone = ~flying & (chance[0] < (FLYING + LOST_AT_EDGE) * min(float(scale), 1.5))
        lost = np.zeros(depth.shape, bool)
        lost[rows[gone], columns[gone]] = True
        r, c = rows[flying], columns[flying]
        depth = depth.copy()
        depth[r, c] += (
            share[flying]
            * (far[r, c] - near[r, c])
            * np.where(depth[r, c] - near[r, c] < far[r, c] - depth[r, c], 1, -1)
        )
        return depth, lost


def _field(lens: Intrinsics, mode: str) -> np.ndarray:
    """Pixels (H, W) that the infrared light reaches: a hexagon in the narrow modes, a disc in the
    wide ones."""
    v, u = np.mgrid[: lens.height, : lens.width]
    x, y = u / (lens.width - 1) * 2 - 1, v / (lens.height - 1) * 2 - 1
    lit = abs(x) + 0.55 * abs(y) < 1.42 if mode.startswith("NFOV") else np.hypot(x, y) < 1
    return lit & np.isfinite(lens.rays[..., 0])
