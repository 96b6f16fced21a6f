"""Every distance of one fitted body and object, frame by frame."""

from __future__ import annotations

from typing import Any

import numpy as np

from intercap_core.camera.rig import Rig
from intercap_core.metrics import contact, penetration
from intercap_core.metrics.clouds import Cloud, vertex_to_cloud, visible_to_cloud
from intercap_core.metrics.proximity import PosedObject, Sight, distance_to_body, face_normals
from intercap_core.metrics.segmented import SegmentedClouds
from intercap_core.metrics.tracks import BodyTrack, ObjectTrack
from intercap_core.metrics.truth import Truth
from intercap_core.rigid.mesh import ObjectMesh
from intercap_core.rigid.surface_samples import sample_surface
from intercap_core.schemas import CONTACT_REGIONS

BODY_SAMPLES = 4000  # points of the body compared with the cloud, area-sampled
VISIBILITY_SAMPLES = 2000  # the same of the object
SAMPLE_SPACING_M = 0.006  # of the object's contact points, so that a fingertip's touch shows
MAX_OBJECT_SAMPLES = 20000
CLOUD_POINTS = 3000  # points of the person that are compared with the body's surface

Values = dict[str, Any]


class Measurement:
    """Distances of one body and object track, frame by frame."""

    def __init__(
        self,
        mesh: ObjectMesh,
        body_track: BodyTrack,
        object_track: ObjectTrack,
        clouds: SegmentedClouds,
        rig: Rig,
        threshold_m: float,
    ) -> None:
        self.mesh = mesh
        self.body = body_track
        self.object = object_track
        self.clouds = clouds
        self.rig = rig
        self.threshold = threshold_m
        self.faces = body_track.model.faces.numpy()
        self.surface = PosedObject(mesh.vertices, mesh.faces, watertight=mesh.watertight)
        template = body_track.model.template.numpy().astype(np.float64)
        self.body_samples = sample_surface(template, self.faces, BODY_SAMPLES)
        area = np.linalg.norm(
            np.cross(
                mesh.vertices[mesh.faces[:, 1]] - mesh.vertices[mesh.faces[:, 0]],
                mesh.vertices[mesh.faces[:, 2]] - mesh.vertices[mesh.faces[:, 0]],
            ),
            axis=1,
        ).sum()
        count = int(np.clip(area / 2 / SAMPLE_SPACING_M**2, 500, MAX_OBJECT_SAMPLES))
        self.object_points = sample_surface(mesh.vertices, mesh.faces, count).of(
            mesh.vertices, mesh.faces
        )
        self.object_samples = sample_surface(mesh.vertices, mesh.faces, VISIBILITY_SAMPLES)
        self.sample_points = self.object_samples.of(mesh.vertices, mesh.faces)
        self.sample_normals = mesh.face_normals[self.object_samples.faces]

    def over_frames(self, floor: tuple[np.ndarray, np.ndarray], truth: Truth | None) -> Values:
        """Values by dataset of the metrics artefact.

        With truth also ``true_distance`` (T, V), the true body's distances to the true object.
        """
        rows: list[Values] = []
        counts = np.zeros(len(self.object_points), np.int32)
        true_points = seen = true_surface = None
        if truth is not None:
            true_points, seen = truth.object_samples_visible(self.object_samples, self.mesh)
            true_surface = PosedObject(truth.object_vertices, truth.object_faces)
        for t, vertices in enumerate(self.body.vertices()):
            vertices = vertices.astype(np.float64)
            rotation, translation = self.object.rotation[t], self.object.translation[t]
            object_vertices = self.mesh.vertices @ rotation.T + translation
            points = self.object_points @ rotation.T + translation
            to_body = distance_to_body(
                np.concatenate([object_vertices, points]), vertices, self.faces
            )
            point_distance = to_body[len(object_vertices) :]
            counts += contact.vertex_contact(point_distance, self.threshold)
            to_object = self.surface.signed_distance(vertices, rotation, translation)
            depth = penetration.depths(to_object)
            row: Values = {
                "body_to_object": to_object,
                "object_to_body": to_body[: len(object_vertices)],
                "penetration_mean": depth.mean,
                "penetration_median": depth.median,
                "penetration_max": depth.max,
                "penetration_object": penetration.depths(point_distance).mean,
                "ground_penetration": np.fmax(
                    penetration.ground_penetration(vertices, *floor),
                    penetration.ground_penetration(object_vertices, *floor),
                ),
            }
            visible = None
            if truth is not None and truth.visible is not None and seen is not None:
                seen_body = self.body_samples.of(truth.visible[t].astype(np.float32), self.faces)
                visible = (seen_body > 0.5, seen[t])
            cloud_row, clouds = self._to_clouds(t, vertices, object_vertices, visible)
            row |= cloud_row
            if truth is not None and true_surface is not None and true_points is not None:
                row |= self._true_frame(t, truth, true_surface, true_points, clouds, visible)
            rows.append(row)
        values = {key: np.stack([row[key] for row in rows]) for key in rows[0]}
        touching = contact.vertex_contact(values["body_to_object"], self.threshold)
        return values | {
            "object_sample_points": self.object_points,
            "object_sample_contact": counts,
            "contact_frame": touching.any(1),
            "region_names": CONTACT_REGIONS,
            "region_contact": contact.region_contact(
                touching, self.body.model.regions, CONTACT_REGIONS
            ),
        }

    def _to_clouds(
        self,
        t: int,
        vertices: np.ndarray,
        object_vertices: np.ndarray,
        visible: tuple[np.ndarray, np.ndarray] | None,
    ) -> tuple[Values, tuple[Cloud, Cloud]]:
        """Distances to frame ``t``'s clouds; ``visible`` samples are found where not given."""
        near = np.concatenate([vertices[::10], object_vertices])
        person, object_ = (Cloud(points) for points in self.clouds.at(t, near))
        body_points = self.body_samples.of(vertices, self.faces)
        rotation, translation = self.object.rotation[t], self.object.translation[t]
        object_points = self.sample_points @ rotation.T + translation
        if visible is None:
            sight = Sight([(vertices, self.faces), (object_vertices, self.mesh.faces)])
            normals = face_normals(vertices, self.faces)[self.body_samples.faces]
            cameras = self.rig.cameras
            visible = (
                sight.seen(body_points, normals, cameras),
                sight.seen(object_points, self.sample_normals @ rotation.T, cameras),
            )
        step = max(1, len(person.points) // CLOUD_POINTS)
        chosen = person.points[::step].astype(np.float64)
        back = distance_to_body(chosen, vertices, self.faces)
        return {
            "body_to_cloud": vertex_to_cloud(vertices, person),
            "object_to_cloud": vertex_to_cloud(object_vertices, object_),
            "body_visible_to_cloud": visible_to_cloud(body_points, visible[0], person),
            "object_visible_to_cloud": visible_to_cloud(object_points, visible[1], object_),
            "cloud_to_body": float(np.abs(back).mean()) if len(back) else np.nan,
        }, (person, object_)

    def _true_frame(
        self,
        t: int,
        truth: Truth,
        surface: PosedObject,
        sample_points: np.ndarray,
        clouds: tuple[Cloud, Cloud],
        visible: tuple[np.ndarray, np.ndarray] | None,
    ) -> Values:
        """The same measures with the true poses put in: floors and true contact."""
        person, object_ = clouds
        rotation, translation = truth.rotation[t], truth.translation[t]
        object_vertices = truth.object_vertices @ rotation.T + translation
        row: Values = {"truth/object_floor": vertex_to_cloud(object_vertices, object_)}
        if visible is not None:
            points = sample_points @ rotation.T + translation
            row["truth/object_visible_floor"] = visible_to_cloud(points, visible[1], object_)
        if truth.vertices is not None:
            vertices = truth.vertices[t].astype(np.float64)
            distance = surface.signed_distance(vertices, rotation, translation)
            row["true_distance"] = distance.astype(np.float32)
            row["truth/penetration_mean"] = penetration.depths(distance).mean
            row["truth/contact_frame"] = contact.vertex_contact(distance, self.threshold).any()
            row["truth/body_floor"] = vertex_to_cloud(vertices, person)
            if visible is not None:
                points = self.body_samples.of(vertices, self.faces)
                row["truth/body_visible_floor"] = visible_to_cloud(points, visible[0], person)
        return row
