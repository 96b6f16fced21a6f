"""The person of a recording, in memory, as the body's fit sees it, and the true skin.

Reads the artefacts of the stages before ``body_fit``; what is decoded here is not timed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from intercap_core.artefacts import read
from intercap_core.body.loading import OPEN_BODY
from intercap_core.body.model import BodyModel
from intercap_core.body_fit.observations import (
    Observations,
    PersonCloud,
    person_clouds,
    read_observations,
)
from intercap_core.config import BodyFitSettings
from intercap_core.errors import UserError
from intercap_core.evaluation.body import vertex_error
from intercap_core.evaluation.truth import Truth
from intercap_core.project import Project
from intercap_core.schemas import FRAMES

_BY_FRAME = (
    "keypoints", "confidence", "joints", "joint_views", "mask_source", "image_of", "times",
)  # fmt: skip
_TENSORS = ("points", "normals", "trust", "view")  # of a cloud
_CHUNK = 32  # bodies posed at once


@dataclass(frozen=True, eq=False)
class BodyClip:
    """T consecutive frame sets.

    ``seen`` and ``clouds`` (T entries) are what the fit reads; ``true_vertices`` (T, V, 3) the
    points of the true skin that correspond to the model's vertices, metres, master frame.
    """

    model: BodyModel
    seen: Observations
    clouds: list[PersonCloud | None]
    settings: BodyFitSettings
    true_vertices: np.ndarray

    @classmethod
    def load(cls, project: Project, sequence: str) -> BodyClip:
        """All frame sets of a sequence.

        Raises UserError where it has no truth for this body model or an artefact is missing.
        """
        row = project.sequences[sequence]
        gender = project.subjects[row.subject].gender
        model = BodyModel.load(project.config.body_models.of(gender) or OPEN_BODY)
        settings = project.config.body_fit
        frames, scene, person = (
            project.artefact(sequence, stage) for stage in ("frames", "scene", "person")
        )
        seen = read_observations(scene, person)
        with read(frames, FRAMES) as artefact:
            fps = float(artefact.attributes["fps"])
        truth = row.truth and Truth.load(row.truth, seen.times, fps, model.num_vertices)
        if truth is None or truth.vertices is None:
            raise UserError(
                f"sequence {sequence} has no true skin for {model.path}; measure a virtual "
                "recording with the body model that it was made for"
            )
        clouds = person_clouds(frames, seen, settings.points_per_frame, model.device)
        return cls(model, seen, clouds, settings, truth.vertices)

    def __len__(self) -> int:
        return len(self.clouds)

    def part(self, frames: slice) -> BodyClip:
        """Some of the frames as a clip of their own."""
        numbers, cameras = range(len(self))[frames], len(self.seen.rig)
        seen = replace(
            self.seen,
            **{
                name: [
                    getattr(self.seen, name)[t * cameras + c]
                    for t in numbers
                    for c in range(cameras)
                ]
                for name in ("masks", "beside")
            },
            **{name: getattr(self.seen, name)[frames] for name in _BY_FRAME},
        )
        return replace(
            self, seen=seen, clouds=self.clouds[frames], true_vertices=self.true_vertices[frames]
        )

    def on(self, device: torch.device) -> BodyClip:
        """The same with model and clouds on another device."""
        model = BodyModel.load(self.model.path, device=device)
        clouds = [
            cloud and replace(cloud, **{name: getattr(cloud, name).to(device) for name in _TENSORS})
            for cloud in self.clouds
        ]
        return replace(self, model=model, clouds=clouds)

    def errors(self, vectors: Tensor, frames: np.ndarray, *, step: int = 1) -> np.ndarray:
        """PVE (N,) in millimetres of bodies (N, P) in ``frames`` (N,), of every step-th vertex."""
        ids = np.arange(0, self.model.num_vertices, step)
        found = []
        for start in range(0, len(vectors), _CHUNK):
            at = slice(start, start + _CHUNK)
            chosen = None if step == 1 else ids
            params = self.model.parameters(vectors[at])
            with torch.no_grad():
                vertices = self.model.forward(params, vertex_ids=chosen).vertices
            true = self.true_vertices[frames[at]][:, ids]
            found.append(1e3 * vertex_error(vertices.cpu().numpy(), true))
        return np.concatenate(found)
