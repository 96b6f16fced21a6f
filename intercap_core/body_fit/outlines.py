"""The rim of the person's mask as a measurement of E_D (equation 4), with depth or without.

Beyond the paper. The rim is the contour of the mask. A ray through the rim grazes the surface of
the person's clothes. The plane spanned by this ray and the rim's tangent touches the surface at a
point whose normal is that of the plane. There the distance is

    e = N . (o - v) - c,

with the camera centre o, the outward normal N of the plane and the thickness c of the covering as
in :mod:`.cloud_term`. v is the vertex that is nearest in normal and in position in the image. Two
parts of the rim are not the contour of the person and are left out: those at the border of the
image, and those where another detected object begins, which may be in front.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import cv2
import numba
import numpy as np

from intercap_core.body_fit.surface import MATCH_SIDEWAYS_M, NORMAL_LENGTH_M, Samples, SkinSurface
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.mask_pixels import decode_box
from intercap_core.geometry.camera.masks import Runs

# Largest absolute cosine between the line of sight and the normal of a sample on the rim. Samples
# are sparse, so few have a cosine of 0: this is two thirds of their spacing on a limb. Tuned on the
# studio.
_FACING = 0.6
# Smallest cosine between the normals of the rim's plane and its vertex. Tuned on the studio.
_COSINE = 0.8


@dataclass(frozen=True, eq=False)
class MaskRim:
    """The rim of the person's mask in one camera."""

    view: int
    """Camera index."""
    rays: np.ndarray
    """(M, 3) float32 unit rays through the rim, colour camera's frame."""
    normals: np.ndarray
    """(M, 3) float32 outward unit normals of the planes that touch the person there."""


def trace_outline(mask: Runs, others: Runs | None, lens: Intrinsics, view: int) -> MaskRim | None:
    """Return about 400 rays evenly along the rim of the mask, or None if there are none.

    Args:
        mask: mask of the person.
        others: mask of other detected objects. Points next to it are left out: the person may
            continue behind these objects.
        lens: intrinsics of the colour camera.
        view: camera index.
    """
    pixels, outward = _rim(mask)
    # away from the border of the image, 3 px wide
    inside = (pixels > 2) & (pixels < np.array([mask.width, mask.height]) - 3)
    own = inside.all(1)
    if others is not None:
        # masks of touching objects are some pixels apart: look 1, 4 and 7 px outward, at an image
        # height of 720; tuned on the studio
        for away in (1.0, 4.0, 7.0):
            ahead = np.rint(pixels + away * mask.height / 720 * outward).astype(int)
            own &= ~others.sample(*ahead.T)
    keep = np.flatnonzero(own)
    if not len(keep):
        return None
    # about 400 points, a third of the pixels of a person who fills 720 lines: speed
    keep = keep[:: max(1, round(len(keep) / 400))]
    pixels, outward = pixels[keep], outward[keep]
    along = outward[:, ::-1] * (-1, 1)  # tangent: outward rotated by 90 degrees
    rays = lens.unproject(pixels)
    ahead = lens.unproject(pixels + along) - lens.unproject(pixels - along)
    out = lens.unproject(pixels + outward) - rays
    normals = np.cross(rays, ahead)
    normals *= np.sign((normals * out).sum(1, keepdims=True))
    length = np.linalg.norm(normals, axis=1)
    good = np.isfinite(length) & (length > 0)
    rays, normals = rays[good], normals[good] / length[good, None]
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    return MaskRim(view, rays.astype(np.float32), normals.astype(np.float32))


def _rim(mask: Runs) -> tuple[np.ndarray, np.ndarray]:
    """Return points (M, 2) along the rim, x and y in px, and outward unit directions (M, 2).

    The directions are gradients of the blurred mask.
    """
    blur = 3.0  # px, standard deviation of the blur; tuned on the studio
    # px; shorter rims, of spots and holes, are errors of the detector; tuned on the studio
    shortest = 40
    x, y, width, height = mask.box
    pad = round(2 * blur)  # beyond two deviations the blur is cut off
    window = np.zeros((height + 2 * pad, width + 2 * pad), np.uint8)
    window[pad:-pad, pad:-pad] = np.uint8(255) * decode_box(mask.ends, mask.box, mask.height).T
    rims, _ = cv2.findContours(window, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    rims = [rim[:, 0] for rim in rims if len(rim) >= shortest]
    if not rims:
        return np.zeros((0, 2)), np.zeros((0, 2))
    at = np.concatenate(rims)
    soft = cv2.GaussianBlur(window, (2 * pad + 1, 2 * pad + 1), blur)
    column, row = at.T
    left, right = soft[row, column - 1].astype(float), soft[row, column + 1]
    above, below = soft[row - 1, column].astype(float), soft[row + 1, column]
    outward = np.stack([left - right, above - below], -1)
    length = np.linalg.norm(outward, axis=1)
    steep = length > 0
    outward = outward[steep] / length[steep, None]
    # the rim is half a pixel outside the outermost pixel of the mask
    return at[steep] + (x - pad, y - pad) + 0.5 * outward, outward


class RimSamples(NamedTuple):
    """The S samples that a rim can touch. Masks round off fingers, so hands are left out."""

    number: np.ndarray
    """(S,) index among all samples."""
    vertex: np.ndarray
    """(S,) index of the sample among the vertices of the surface."""
    patch: np.ndarray
    """(S, 20) indices of the sample's patch among the vertices of the surface."""

    @classmethod
    def of(cls, samples: Samples, surface: SkinSurface) -> RimSamples:
        number = np.flatnonzero(~samples.hand)
        return cls(number, surface.sample[number], surface.patch[number])


def find_touched(
    rim: MaskRim,
    master_from_colour: np.ndarray,
    vertices: np.ndarray,
    normals: np.ndarray,
    samples: RimSamples,
    reach: float,
    displacement: np.ndarray | None,
) -> tuple[np.ndarray, np.ndarray]:
    """Find the samples that the planes of a rim touch.

    Args:
        rim: rays and planes.
        master_from_colour: (4, 4) pose of the camera.
        vertices: (R, 3) of the surface, master frame, metres.
        normals: (R, 3)
        samples: samples that a rim can touch.
        reach: largest valid distance, metres.
        displacement: (N, 3) displacement of all N samples until the camera exposes, metres, or
            None.

    Returns:
        (M,) index of each touched sample among all samples.
        (M,) distance, outside positive, metres.
    """
    pose = master_from_colour.astype(vertices.dtype)
    planes, rays = rim.normals @ pose[:3, :3].T, rim.rays @ pose[:3, :3].T
    at, distance, valid = _find_touched(
        pose[:3, 3], rays, planes, vertices, normals, samples.vertex, samples.patch, reach
    )
    sample = samples.number[at]
    if displacement is not None:
        # along the normal of the sample, as in the residual of the sample
        distance -= (displacement[sample] * normals[samples.vertex[at]]).sum(1)
    return sample[valid], distance[valid]


@numba.njit(cache=True, nogil=True)
def _find_touched(centre, rays, planes, vertices, normals, samples, patch, reach):
    """Return sample (M,), signed outward distance (M,) and validity (M,) of rays through a rim.

    Candidates are the samples on the rim as the camera sees it: their normals are nearly
    perpendicular to the line of sight. For each ray all candidates are compared. The best one
    minimises height^2 + sideways^2 + L^2 |n - N|^2 with the distances ``height`` from the plane and
    ``sideways`` from the ray within the plane, and L = `NORMAL_LENGTH_M`. In its patch, the vertex
    that minimises sideways^2 + L^2 |n - N|^2 gives the distance.

    centre (3,): of the camera. rays, planes (M,3): unit rays, and unit normals N of their planes.
    vertices, normals (R,3): one body. samples (S,), patch (S,20): indices of vertices.
    reach: largest distance along the plane's normal, metres.
    """
    kind, where = vertices.dtype, np.empty((6, len(samples)), vertices.dtype)
    rim = np.empty(len(samples), np.int64)
    count = 0
    for s in range(len(samples)):
        v = samples[s]
        along = square = vertices[v, 0] * 0
        for d in range(3):
            gap = vertices[v, d] - centre[d]
            along += gap * normals[v, d]
            square += gap * gap
        if along * along < _FACING * _FACING * square:
            rim[count] = s
            for d in range(3):
                where[d, count] = vertices[v, d] - centre[d]
                where[3 + d, count] = normals[v, d]
            count += 1
    where, apart = where[:, :count].copy(), np.empty(count, kind)
    sample = np.zeros(len(rays), np.int64)
    distance = np.zeros(len(rays), kind)
    valid = np.zeros(len(rays), np.bool_)
    if count == 0:
        return sample, distance, valid
    turn = 2 * NORMAL_LENGTH_M * NORMAL_LENGTH_M  # |n - m|^2 = 2 - 2 n . m of unit vectors
    for m in range(len(rays)):
        rx, ry, rz = rays[m, 0], rays[m, 1], rays[m, 2]
        nx, ny, nz = planes[m, 0], planes[m, 1], planes[m, 2]
        tx, ty, tz = ry * nz - rz * ny, rz * nx - rx * nz, rx * ny - ry * nx
        for at in range(count):
            x, y, z = where[0, at], where[1, at], where[2, at]
            height, sideways = x * nx + y * ny + z * nz, x * tx + y * ty + z * tz
            cosine = where[3, at] * nx + where[4, at] * ny + where[5, at] * nz
            apart[at] = height * height + sideways * sideways - turn * cosine
        best = rim[np.argmin(apart)]
        least = vertices[0, 0] * 0 + np.inf
        for v in patch[best]:
            x = vertices[v, 0] - centre[0]
            y = vertices[v, 1] - centre[1]
            z = vertices[v, 2] - centre[2]
            height, sideways = x * nx + y * ny + z * nz, x * tx + y * ty + z * tz
            cosine = normals[v, 0] * nx + normals[v, 1] * ny + normals[v, 2] * nz
            # without height, which is the distance to be measured
            far = sideways * sideways - turn * cosine
            if far < least:
                least = far
                distance[m] = -height
                near = abs(height) < reach and abs(sideways) < MATCH_SIDEWAYS_M
                valid[m] = near and cosine > _COSINE
        sample[m] = best
    return sample, distance, valid
