"""The part of the skin that E_D (equation 4) and E_P_self (equation 5) look at, posed.

Samples and the patches around them, with their normals.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.kinematics import vertex_normals
from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import BodyParameters
from intercap_core.body_fit.body_constants import NORMAL_LENGTH_M, SAMPLES_TOGETHER
from intercap_core.body_fit.body_samples import Samples


@dataclass(frozen=True, eq=False)
class Surface:
    """R vertices of a body and the F faces among them that touch a sample's patch.

    ids (R,) of the vertices in the body; faces (F,3), sample (N,) and patch (N,20) count places in
    ids. around, starts: the faces at each of the R, those of r from starts[r] to starts[r + 1],
    none where r is only needed for the normals of others. order (N,): samples in groups that lie
    close together, group g from ``groups[g]`` to ``groups[g + 1]``.
    """

    model: BodyModel
    ids: np.ndarray
    faces: np.ndarray
    sample: np.ndarray
    patch: np.ndarray
    around: np.ndarray
    starts: np.ndarray
    order: np.ndarray
    groups: np.ndarray

    @classmethod
    def around_samples(cls, model: BodyModel, samples: Samples) -> Surface:
        """Of the samples of a body."""
        every = model.faces.cpu().numpy()
        met = np.zeros(model.num_vertices, bool)
        met[samples.vertex] = met[samples.patch] = True
        faces = every[met[every].any(1)]
        ids = np.unique(faces)
        place = np.full(model.num_vertices, -1)
        place[ids] = np.arange(len(ids))
        faces = place[faces]
        corner = faces.ravel()
        face = np.repeat(np.arange(len(faces)), 3)[met[ids][corner]]
        corner = corner[met[ids][corner]]
        order, groups = _grouped(model, samples)
        return cls(
            model, ids, faces, place[samples.vertex], place[samples.patch],
            face[np.argsort(corner, kind="stable")],
            np.searchsorted(np.sort(corner), np.arange(len(ids) + 1)), order, groups,
        )  # fmt: skip

    def posed(self, params: BodyParameters) -> tuple[Tensor, Tensor]:
        """Vertices and unit normals (B,R,3), metres; only those of samples and patches are right
        among the normals."""
        vertices = self.model.forward(params, vertex_ids=self.ids).vertices
        if vertices.device.type != "cpu":
            return vertices, vertex_normals(
                vertices, torch.as_tensor(self.faces).to(vertices.device)
            )
        from intercap_core.body_fit import body_match_kernel

        normals = torch.empty_like(vertices)
        body_match_kernel.vertex_normals(
            vertices.numpy(), self.faces, self.starts, self.around, normals.numpy()
        )
        return vertices, normals


def _grouped(model: BodyModel, samples: Samples) -> tuple[np.ndarray, np.ndarray]:
    """The samples halved by place and orientation, at rest, until few are left: their order (N,)
    and where each group starts, and the last ends."""
    template = model.template[None]
    rest = torch.cat([template, NORMAL_LENGTH_M * vertex_normals(template, model.faces)], 2)[0]
    at = rest.double().cpu().numpy()[samples.vertex]
    whole, parts = [np.arange(len(at))], []
    while whole:
        part = whole.pop()
        if len(part) <= SAMPLES_TOGETHER:
            parts.append(part)
            continue
        axis = int(np.ptp(at[part], axis=0).argmax())
        half = np.array_split(part[np.argsort(at[part, axis], kind="stable")], 2)
        whole += half[::-1]
    return np.concatenate(parts), np.cumsum([0, *map(len, parts)])
