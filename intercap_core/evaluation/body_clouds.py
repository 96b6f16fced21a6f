"""Distances between fitted bodies and the person's measured points, with those of the true body."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.model import BodyModel
from intercap_core.evaluation.clouds import Cloud, visible_to_cloud
from intercap_core.evaluation.proximity import DEEPEST_M, Sight, face_normals
from intercap_core.evaluation.segmented import SegmentedClouds, read_person_masks
from intercap_core.evaluation.truth import Truth
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.surface_samples import sample_surface
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.schemas import SCENE

EVERY = 5  # one frame in so many is compared with its points: neighbours are redundant
SURFACE_SAMPLES = 4000  # of the body, spread over its area
CLOUD_POINTS = 3000  # at most, evenly thinned
CLOUD_KEYS = (
    "cloud_to_mesh", "mesh_to_cloud_visible", "cloud_to_mesh_floor", "mesh_to_cloud_visible_floor",
)  # fmt: skip


class BodyClouds:
    """The person's points of one recording, as stage ``body_fit`` is given them: its masks, all
    views that have depth, refined extrinsics."""

    def __init__(
        self,
        images: Frames,
        rig: Rig,
        masks: list[list[bytes]],
        depth_bias: np.ndarray,
        model: BodyModel,
    ) -> None:
        self._images, self._rig, self._masks = images, rig, masks
        self._clouds = SegmentedClouds(images, rig, masks, None, depth_bias)
        self._faces = model.faces.numpy()
        template = model.template.numpy().astype(np.float64)
        self._tree = SurfaceTree(template, self._faces)
        self._samples = sample_surface(template, self._faces, SURFACE_SAMPLES)

    @classmethod
    @contextlib.contextmanager
    def open(
        cls,
        frames: Path,
        scene: Path,
        person: Path,
        model: BodyModel,
    ) -> Iterator[BodyClouds]:
        """Open for a ``with`` block; raises UserError as reading artefacts does."""
        with Frames.open(frames) as images, artefacts.read(scene, SCENE) as found:
            rig = Rig.from_artefact(found)
            images = images.showing(found["image_of"])
            yield cls(images, rig, read_person_masks(person), found["depth_bias"], model)

    def measure(self, t: int, vertices: np.ndarray, truth: Truth) -> dict[str, float]:
        """Mean distances of frame ``t`` by CLOUD_KEYS, metres; NaN where no point was measured.

        ``vertices`` (V, 3) fitted. Of points to the mesh; of samples of the mesh to the points,
        those that some depth image in which the person was segmented truly shows. The floors are
        the same of the true body, which no fit of a body without clothes can go far below.
        """
        assert truth.vertices is not None
        true = truth.vertices[t].astype(np.float64)
        fitted = vertices.astype(np.float64)
        person, _ = self._clouds.at(t, np.concatenate([fitted[::10], true[::10]]))
        if not len(person):
            return dict.fromkeys(CLOUD_KEYS, np.nan)
        cloud = Cloud(person)
        chosen = person[:: -(-len(person) // CLOUD_POINTS)].astype(np.float64)
        seen = self._seen(t, true, truth)
        found = {}
        for floor, surface in (("", fitted), ("_floor", true)):
            to_mesh = self._tree.shaped(surface).distance(chosen, DEEPEST_M)
            points = self._samples.of(surface, self._faces)
            found[f"cloud_to_mesh{floor}"] = float(to_mesh.mean())
            found[f"mesh_to_cloud_visible{floor}"] = visible_to_cloud(points, seen, cloud)
        return found

    def _seen(self, t: int, true: np.ndarray, truth: Truth) -> np.ndarray:
        """Which samples of the true body (N,) are truly seen by depth that has a mask."""
        assert truth.visible is not None
        there = self._images.depth_available[t]
        cameras = [c for i, c in enumerate(self._rig) if there[i] and self._masks[t][i]]
        object_ = truth.object_vertices @ truth.rotation[t].T + truth.translation[t]
        occluders = [self._tree.shaped(true)]
        if truth.has_object:
            occluders.append(SurfaceTree(object_, truth.object_faces).shaped(object_))
        sight = Sight(occluders)
        points = self._samples.of(true, self._faces)
        normals = face_normals(true, self._faces)[self._samples.faces]
        # occlusion by furniture is known from the truth of the whole rig
        anyhow = self._samples.of(truth.visible[t].astype(np.float32), self._faces) > 0.5
        return anyhow & sight.seen(points, normals, cameras)
