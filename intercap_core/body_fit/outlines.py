"""What E_D (equation 4) says beside depth, and without it: the rim of the person's mask.

Beyond the paper. A ray through the rim grazes what the person wears: the plane that this ray and
the rim's tangent span touches the surface where the normals agree. There the distance is

    e = N . (o - v) - c,

with the camera's centre o, the plane's outward normal N, the vertex v of the body whose normal and
place in the image are nearest, and the covering's thickness c as in
:mod:`intercap_core.body_fit.body_cloud`. A rim at the image's border is not the person's, nor one
where another detected thing begins, which may be in front. Masks made from the images alone have
the form that was expected, but for what moved before a known background.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numpy as np

from intercap_core.body_fit import outlines_kernel
from intercap_core.body_fit.body_constants import MATCH_SIDEWAYS_M, NORMAL_LENGTH_M
from intercap_core.body_fit.body_samples import Samples
from intercap_core.body_fit.body_surface import Surface
from intercap_core.body_fit.constants import (
    BESIDE_AT_720P,
    OUTLINE_BLUR_PX,
    OUTLINE_COSINE,
    OUTLINE_FACING,
    OUTLINE_POINTS,
    SHORTEST_OUTLINE_PX,
)
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.mask_pixels import drawn
from intercap_core.geometry.camera.masks import Runs

_BORDER_PX = 2  # of the image


@dataclass(frozen=True, eq=False)
class Outline:
    """The rim of the person's mask in camera ``view``: unit rays (M,3) through it, and unit normals
    (M,3) of the planes that touch the person there, outward; colour camera's frame, float32."""

    view: int
    rays: np.ndarray
    normals: np.ndarray


def outline(mask: Runs, beside: Runs | None, lens: Intrinsics, view: int) -> Outline | None:
    """Some points of the mask's rim, evenly along it; None where there are none.

    Where the rim meets what else was detected, ``beside``, the person may go on behind it.
    """
    pixels, outward = _rim(mask)
    inside = (pixels > _BORDER_PX) & (pixels < np.array([mask.width, mask.height]) - 1 - _BORDER_PX)
    own = inside.all(1)
    if beside is not None:
        for away in BESIDE_AT_720P:
            ahead = np.rint(pixels + away * mask.height / 720 * outward).astype(int)
            own &= ~beside.sample(*ahead.T)
    keep = np.flatnonzero(own)
    if not len(keep):
        return None
    keep = keep[:: max(1, round(len(keep) / OUTLINE_POINTS))]
    pixels, outward = pixels[keep], outward[keep]
    along = outward[:, ::-1] * (-1, 1)
    rays = lens.unproject(pixels)
    ahead = lens.unproject(pixels + along) - lens.unproject(pixels - along)
    out = lens.unproject(pixels + outward) - rays
    normals = np.cross(rays, ahead)
    normals *= np.sign((normals * out).sum(1, keepdims=True))
    length = np.linalg.norm(normals, axis=1)
    good = np.isfinite(length) & (length > 0)
    rays, normals = rays[good], normals[good] / length[good, None]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return Outline(view, rays.astype(np.float32), normals.astype(np.float32))


def _rim(mask: Runs) -> tuple[np.ndarray, np.ndarray]:
    """Points (M,2) of the rim, px, in their order along it, and unit directions (M,2) outward."""
    x, y, width, height = mask.box
    pad = round(3 * OUTLINE_BLUR_PX)
    window = np.zeros((height + 2 * pad, width + 2 * pad), np.uint8)
    window[pad:-pad, pad:-pad] = np.uint8(255) * drawn(mask.ends, mask.box, mask.height).T
    rims, _ = cv2.findContours(window, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rims = [rim[:, 0] for rim in rims if len(rim) >= SHORTEST_OUTLINE_PX]
    if not rims:
        return np.zeros((0, 2)), np.zeros((0, 2))
    at = np.concatenate(rims)
    soft = cv2.GaussianBlur(window, (0, 0), OUTLINE_BLUR_PX)
    column, row = at.T
    left, right = soft[row, column - 1].astype(float), soft[row, column + 1]
    above, below = soft[row - 1, column].astype(float), soft[row + 1, column]
    outward = np.stack([left - right, above - below], -1)
    length = np.linalg.norm(outward, axis=1)
    steep = length > 0
    outward = outward[steep] / length[steep, None]
    # the rim runs between a pixel that is set and its neighbour
    return at[steep] + (x - pad, y - pad) + 0.5 * outward, outward


class RimSamples(NamedTuple):
    """The samples that masks tell of: their number (S,), vertex (S,) and patch (S,20) in a
    :class:`.body_surface.Surface`. Masks round off fingers, so hands are left out."""

    number: np.ndarray
    vertex: np.ndarray
    patch: np.ndarray

    @classmethod
    def of(cls, samples: Samples, surface: Surface) -> RimSamples:
        """Those of the body."""
        number = np.flatnonzero(~samples.hand)
        return cls(number, surface.sample[number], surface.patch[number])


def touching(
    rim: Outline,
    master_from_colour: np.ndarray,
    vertices: np.ndarray,
    normals: np.ndarray,
    samples: RimSamples,
    reach: float,
    late: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Samples (M,) that a rim's planes touch, and the distances (M,), metres, outside positive.

    vertices, normals (R,3) of the surface in the master frame; ``late`` (S,3): how much farther the
    samples have moved when the camera exposes. Planes farther than ``reach`` metres are left out.
    """
    pose = master_from_colour.astype(vertices.dtype)
    planes, rays = rim.normals @ pose[:3, :3].T, rim.rays @ pose[:3, :3].T
    at, distance, valid = outlines_kernel.touched(
        pose[:3, 3], rays, planes, vertices, normals, samples.vertex, samples.patch,
        NORMAL_LENGTH_M, OUTLINE_FACING, reach, MATCH_SIDEWAYS_M, OUTLINE_COSINE,
    )  # fmt: skip
    sample = samples.number[at]
    if late is not None:
        # along the sample's normal, as the row that the distance goes to has it
        distance -= (late[sample] * normals[samples.vertex[at]]).sum(1)
    return sample[valid], distance[valid]
