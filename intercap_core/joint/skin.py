"""The body's likely-contact vertices (H of E_C, A.4), subsampled and cut into patches.

The body's vertices that are compared with object and floor: patches dense, the rest sparse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.surface import choose_samples
from intercap_core.schemas import CONTACT_REGIONS

# Vertices of the body's mesh, inside the object or below the floor, that are one measurement:
# neighbours err together. Tuned on the studio.
VERTICES_PER_MEASUREMENT = 10.0
# Vertices kept of each region: fingers are thin and wrap around things, and what sits on an edge
# touches it with little of a large region. Tuned on the studio.
REGION_VERTICES = 240

# Joints from here on are the fingers', three a finger, first of the left hand.
_FIRST_FINGER_JOINT = JOINT_INDEX["left_index1"]
_PALM = -1


@dataclass(frozen=True)
class Patches:
    """``vertices`` (N,) ids on the body; ``region`` (N,) and ``patch`` (N,) of each;
    ``region_of_patch`` (P,); ``joint`` (N,) the joint that moves the vertex most; ``share`` (N,)
    how many vertices of its region it stands for."""

    vertices: np.ndarray
    region: np.ndarray
    patch: np.ndarray
    region_of_patch: np.ndarray
    joint: np.ndarray
    share: np.ndarray


def contact_patches(model: BodyModel) -> Patches:
    """Cut every region of ``CONTACT_REGIONS``: hands into palm and fingers, others are whole."""
    template = model.template.cpu().numpy()
    joint_of = model.skinning_weights.cpu().numpy().argmax(axis=1)
    region_of_patch: list[int] = []
    vertices, region, patch, share = [], [], [], []
    for r, name in enumerate(CONTACT_REGIONS):
        ids = np.asarray(model.regions[name])
        kept = ids[farthest_points(template[ids], REGION_VERTICES)]
        part = np.full(len(kept), _PALM)
        if name.endswith("_hand"):
            finger = joint_of[kept] >= _FIRST_FINGER_JOINT
            part[finger] = (joint_of[kept][finger] - _FIRST_FINGER_JOINT) // 3
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
    """Indices of ``count`` points spread evenly over points (N, 3); all where there are fewer."""
    if len(points) <= count:
        return np.arange(len(points))
    chosen = [int(np.linalg.norm(points - points.mean(axis=0), axis=1).argmax())]
    distance = np.full(len(points), np.inf)
    for _ in range(count - 1):
        distance = np.minimum(distance, np.square(points - points[chosen[-1]]).sum(axis=1))
        chosen.append(int(distance.argmax()))
    return np.sort(np.array(chosen))


@dataclass(frozen=True)
class Skin:
    """``vertices`` (N,) ids, ascending; ``share`` (N,) how many vertices of the mesh each stands
    for; ``patch`` (M,) the contact patches' places among them."""

    vertices: np.ndarray
    share: np.ndarray
    patch: np.ndarray

    @classmethod
    def select(cls, model: BodyModel, patches: Patches) -> Skin:
        """All contact patches and an even sample of the outer skin."""
        vertices = np.union1d(patches.vertices, choose_samples(model).vertex)
        template = model.template.double().cpu().numpy()
        _, nearest = cKDTree(template[vertices]).query(template)
        share = np.bincount(nearest, minlength=len(vertices)).astype(float)
        return cls(vertices, share, np.searchsorted(vertices, patches.vertices))
