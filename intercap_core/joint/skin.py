"""Vertices of the body that are compared with object and floor.

They are an even sample of the skin, and the contact patches, which are H of E_C (A.4).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from intercap_core.body.joints import FIRST_FINGER
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.surface import choose_samples
from intercap_core.schemas import CONTACT_REGIONS

# Standard deviation of the distance between skin and object or floor while they touch, metres:
# errors of skin, mesh and calibration that differ in each frame. Tuned on the studio: without E_C
# contact of vertices has an F1 of 0.44, with it 0.51; without both terms of the floor soles are 3.8
# mm off it, with them 2.7 (bench/RESULTS.md, commit 86d72be).
SURFACE_SIGMA = 0.004
VERTICES_PER_MEASUREMENT = 10.0  # neighbours have the same error and count as one; tuned


@dataclass(frozen=True)
class Patches:
    """Vertices of the contact regions, cut into patches."""

    vertices: np.ndarray  # (M,) ids on the body
    region: np.ndarray  # (M,) index into ``CONTACT_REGIONS``
    patch: np.ndarray  # (M,) patch of each vertex
    region_of_patch: np.ndarray  # (P,) region of each patch
    joint: np.ndarray  # (M,) joint with the largest skinning weight
    share: np.ndarray  # (M,) number of vertices of the region that each stands for


def contact_patches(model: BodyModel) -> Patches:
    """Cut hands into palm and fingers; each of the other regions is one patch.

    A region keeps at most 240 vertices, evenly spread (tuned on the studio). Fewer would miss thin
    fingers around an object, or the few vertices of a large region that touch an edge.
    """
    template = model.template.numpy()
    joint_of = model.skinning_weights.numpy().argmax(axis=1)
    region_of_patch: list[int] = []
    vertices, region, patch, share = [], [], [], []
    for r, name in enumerate(CONTACT_REGIONS):
        ids = np.asarray(model.regions[name])
        kept = ids[farthest_points(template[ids], 240)]
        part = np.full(len(kept), -1)  # the palm, or the only patch
        if name.endswith("_hand"):
            finger = joint_of[kept] >= FIRST_FINGER
            part[finger] = (joint_of[kept][finger] - FIRST_FINGER) // 3  # number of finger
        for value in np.unique(part):
            members = kept[part == value]
            vertices.append(members)
            region.append(np.full(len(members), r))
            patch.append(np.full(len(members), len(region_of_patch)))
            region_of_patch.append(r)
            share.append(np.full(len(members), len(ids) / len(kept)))
    ids = np.concatenate(vertices)
    return Patches(
        vertices=ids,
        region=np.concatenate(region),
        patch=np.concatenate(patch),
        region_of_patch=np.array(region_of_patch),
        joint=joint_of[ids],
        share=np.concatenate(share),
    )


def farthest_points(points: np.ndarray, count: int) -> np.ndarray:
    """Indices of ``count`` evenly spread points of ``points`` (N, 3), by farthest-point sampling.

    All if there are fewer.
    """
    if len(points) <= count:
        return np.arange(len(points))
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    distance = np.full(len(points), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, np.square(points - points[chosen[-1]]).sum(axis=1))
        chosen.append(int(distance.argmax()))
    return np.sort(np.array(chosen))


@dataclass(frozen=True)
class SkinSamples:
    """All contact patches and an even sample of the outer skin."""

    vertices: np.ndarray  # (N,) ids on the body, ascending
    share: np.ndarray  # (N,) number of vertices of the mesh that each stands for
    patch: np.ndarray  # (M,) indices of the contact patches' vertices among the samples

    @classmethod
    def select(cls, model: BodyModel, patches: Patches) -> SkinSamples:
        """Choose the samples."""
        vertices = np.union1d(patches.vertices, choose_samples(model).vertex)
        template = model.template.double().numpy()
        _, nearest = cKDTree(template[vertices]).query(template)
        share = np.bincount(nearest, minlength=len(vertices)).astype(float)
        return cls(vertices, share, np.searchsorted(vertices, patches.vertices))
