"""The body's vertices that are compared with object and floor: patches dense, the rest sparse."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from intercap_core.body.model import BodyModel
from intercap_core.body_fit.body_samples import choose_samples
from intercap_core.joint.contact.patches import Patches


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
