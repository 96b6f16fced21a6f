"""All distances of one fitted body and object, frame by frame, for the metrics artefact.

A cloud is the set of depth points that the segmentation assigns to the person or the object.
Datasets ``truth/..._floor`` are distances of the true body or object from the clouds: the lower
bound of a correct fit.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from intercap_core.artefacts import RowStream, Writer
from intercap_core.evaluation import contact
from intercap_core.evaluation.proximity import (
    REACH_M,
    BodySurface,
    MeasuredCloud,
    PosedObject,
    seen_by_cameras,
)
from intercap_core.evaluation.segmented import SegmentedClouds
from intercap_core.evaluation.tracks import BodyTrack, ObjectTrack
from intercap_core.evaluation.truth import Truth
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.facing import facing_distance
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.surface_tree import ShapedSurface, SurfaceTree
from intercap_core.geometry.rigid.surfaces import (
    doubled_areas,
    face_normals,
    sample_surface,
    vertex_normals,
)
from intercap_core.progress import Progress
from intercap_core.schemas import CONTACT_M, CONTACT_REGIONS, PER_VERTEX_METRICS

log = logging.getLogger(__name__)

# Distance between contact samples on the object's surface; resolves the touch of a fingertip.
SAMPLE_SPACING_M = 0.006

Values = dict[str, Any]


class HandledObject:
    """An object's ``mesh`` and ``track`` with its contact points and visibility samples."""

    def __init__(self, mesh: ObjectMesh, track: ObjectTrack) -> None:
        self.mesh, self.track = mesh, track
        self.surface = PosedObject(mesh.vertices, mesh.faces, watertight=mesh.watertight)
        area = doubled_areas(mesh.vertices, mesh.faces).sum() / 2
        count = int(np.clip(area / SAMPLE_SPACING_M**2, 500, 20000))
        contact_samples = sample_surface(mesh.vertices, mesh.faces, count)
        self.points = contact_samples.of(mesh.vertices, mesh.faces)
        # of the points, then of the vertices; an open surface is touched from both sides
        self.normals = float(mesh.watertight) * np.concatenate(
            [mesh.face_normals[contact_samples.faces], vertex_normals(mesh.vertices, mesh.faces)]
        )
        self.samples = sample_surface(mesh.vertices, mesh.faces, 2000)
        self.sample_points = self.samples.of(mesh.vertices, mesh.faces)
        self.sample_normals = mesh.face_normals[self.samples.faces]

    def posed(self, t: int, points: np.ndarray) -> np.ndarray:
        """Points (N, 3) of the object, object frame, in the master frame at frame ``t``."""
        return points @ self.track.rotation[t].T + self.track.translation[t]

    def placed(self, t: int) -> ShapedSurface:
        """The object's surface in the master frame at frame ``t``."""
        return self.surface.placed(self.track.rotation[t], self.track.translation[t])


class Measurement:
    """Distances of one body and the object that it handles, frame by frame.

    If ``handled`` is None, datasets of the object and of contact are omitted.
    """

    def __init__(
        self,
        handled: HandledObject | None,
        body_track: BodyTrack,
        clouds: SegmentedClouds,
        rig: Rig,
        threshold_m: float,
    ) -> None:
        self.handled = handled
        self.body = body_track
        self.clouds = clouds
        self.rig = rig
        self.threshold = threshold_m
        self.faces = body_track.model.faces.numpy()
        template = body_track.model.template.numpy().astype(np.float64)
        self.tree = SurfaceTree(template, self.faces)
        self.body_samples = sample_surface(template, self.faces, 4000)

    def over_frames(
        self, floor: tuple[np.ndarray, np.ndarray], truth: Truth | None, writer: Writer
    ) -> Values:
        """Values by dataset of the metrics artefact, without ``PER_VERTEX_METRICS``.

        These grow with the recording, so that ``writer`` appends them frame by frame.

        With truth, also ``true_distance`` (T, V): signed distances of the true body's vertices from
        the true object, ``true_facing`` (T, V): their contact distances, and ``facing`` (T, V):
        contact distances of the fitted body. With an object, also ``body_distance`` (T,): smallest
        signed distance of a vertex of one to the surface of the other.

        Args:
            floor: point (3,) and unit normal (3,) of the floor; NaN = unknown.
            truth: true body and object; None = unknown.
            writer: of the metrics artefact.
        """
        values: Values = {}
        streams: dict[str, RowStream] = {}
        handled = self.handled
        counts = np.zeros(len(handled.points) if handled else 0, np.int32)
        true_points = seen = true_surface = None
        if truth is not None and truth.has_object:
            if handled is not None:
                true_points, seen = truth.object_samples_visible(handled.samples, handled.mesh)
            true_surface = PosedObject(truth.object_vertices, truth.object_faces)
        progress = Progress(log, "measured", len(self.body.joints))
        for t, vertices in enumerate(self.body.vertices()):
            vertices = vertices.astype(np.float64)
            row: Values = {"ground_penetration": contact.ground_penetration(vertices, *floor)}
            surface, placed = BodySurface(vertices, self.faces, self.tree), None
            if handled is not None:
                placed = handled.placed(t)
                between, touched = self._between(handled, t, vertices, surface, placed, floor)
                row |= between
                counts += touched
            seen_body = seen_object = None
            if truth is not None and truth.visible is not None:
                share = self.body_samples.of(truth.visible[t].astype(np.float32), self.faces)
                seen_body, seen_object = share > 0.5, None if seen is None else seen[t]
            cloud_row, clouds = self._to_clouds(
                t, vertices, surface, placed, seen_body, seen_object
            )
            row |= cloud_row
            if truth is not None:
                row |= self._true_body(t, truth, clouds[0], seen_body)
            if truth is not None and true_surface is not None:
                row |= self._true_object(
                    t, truth, true_surface, true_points, clouds[1], seen_object
                )
            for key in sorted(PER_VERTEX_METRICS & row.keys()):
                value = row.pop(key)
                if key not in streams:
                    streams[key] = writer.stream(key, value.shape)
                streams[key].append(value[None])
                if truth is not None and key == "body_contact_distance":
                    row["facing"] = value
            for key, value in row.items():
                if key not in values:
                    kind = np.asarray(value).dtype
                    values[key] = np.empty((len(self.body.joints), *np.shape(value)), kind)
                values[key][t] = value
            progress.step()
        if handled is None:
            return values
        return values | {
            "object_sample_points": handled.points,
            "object_sample_contact": counts,
            "region_names": CONTACT_REGIONS,
        }

    def _between(
        self,
        handled: HandledObject,
        t: int,
        vertices: np.ndarray,
        surface: BodySurface,
        placed: ShapedSurface,
        floor: tuple[np.ndarray, np.ndarray],
    ) -> tuple[Values, np.ndarray]:
        """Distances between body and object in frame ``t``.

        Also returns the mask (N,) of the object's contact points that the body touches.
        """
        object_vertices = handled.posed(t, handled.mesh.vertices)
        points = handled.posed(t, handled.points)
        to_body = surface.signed_distance(object_vertices)
        # outside the body only contact is evaluated, so distances may be clipped beyond the
        # thresholds
        reach = 1.01 * max(self.threshold, CONTACT_M)
        point_distance = surface.signed_distance(points, reach=reach)
        track = handled.track
        to_object = handled.surface.signed_distance(
            vertices, track.rotation[t], track.translation[t]
        )
        of_points, of_vertices = np.split(
            facing_distance(
                np.concatenate([points, object_vertices]),
                handled.normals @ track.rotation[t].T,
                np.concatenate([point_distance, to_body]),
                own=placed,
                other=surface.surface,
                reach=reach,
            ),
            [len(points)],
        )
        depth = contact.depths(to_object)
        facing = surface.facing(placed, to_object, contact.facing_reach(self.threshold))
        touching = contact.vertex_contact(facing.astype(np.float32), self.threshold)
        return {
            "body_to_object": to_object.astype(np.float32),
            "object_to_body": to_body.astype(np.float32),
            "body_contact_distance": facing.astype(np.float32),
            "object_contact_distance": np.minimum(of_vertices, REACH_M).astype(np.float32),
            "contact_frame": touching.any(),
            "region_contact": contact.region_contact(
                touching, self.body.model.regions, CONTACT_REGIONS
            ),
            "penetration_mean": depth.mean,
            "penetration_median": depth.median,
            "penetration_max": depth.max,
            "penetration_object": contact.depths(point_distance).mean,
            "body_distance": min(to_object.min(), to_body.min()),
            "ground_penetration": np.fmax(
                contact.ground_penetration(vertices, *floor),
                contact.ground_penetration(object_vertices, *floor),
            ),
        }, contact.vertex_contact(of_points, self.threshold)

    def _to_clouds(
        self,
        t: int,
        vertices: np.ndarray,
        surface: BodySurface,
        placed: ShapedSurface | None,
        seen_body: np.ndarray | None,
        seen_object: np.ndarray | None,
    ) -> tuple[Values, tuple[MeasuredCloud, MeasuredCloud]]:
        """Distances to the clouds of frame ``t``, and the clouds of person and object.

        ``placed``: surface of the object in this frame; None without an object.
        ``seen_body``, ``seen_object``: masks of the visible surface samples, from the truth; None =
        computed from the fitted meshes.
        """
        handled = self.handled
        near = [vertices[::10]]
        if handled is not None:
            object_vertices = handled.posed(t, handled.mesh.vertices)
            near.append(object_vertices)
        person, object_ = (
            MeasuredCloud(points) for points in self.clouds.at(t, np.concatenate(near))
        )
        body_points = self.body_samples.of(vertices, self.faces)
        occluders = [surface.surface] if placed is None else [surface.surface, placed]
        if seen_body is None:
            normals = face_normals(vertices, self.faces)[self.body_samples.faces]
            seen_body = seen_by_cameras(body_points, normals, self.rig.cameras, occluders)
        step = max(1, len(person.points) // 3000)
        chosen = person.points[::step].astype(np.float64)
        back = surface.distance(chosen)
        row: Values = {
            # of all vertices, also those that no camera sees, as in the paper
            "body_to_cloud": person.mean_distance(vertices),
            "body_visible_to_cloud": person.mean_distance(body_points[seen_body]),
            "cloud_to_body": float(back.mean()) if len(back) else np.nan,
        }
        if handled is not None:
            object_points = handled.posed(t, handled.sample_points)
            if seen_object is None:
                normals = handled.sample_normals @ handled.track.rotation[t].T
                seen_object = seen_by_cameras(object_points, normals, self.rig.cameras, occluders)
            row["object_to_cloud"] = object_.mean_distance(object_vertices)
            row["object_visible_to_cloud"] = object_.mean_distance(object_points[seen_object])
        return row, (person, object_)

    def _true_body(
        self, t: int, truth: Truth, person: MeasuredCloud, seen_body: np.ndarray | None
    ) -> Values:
        """Cloud distances of the true body: lower bounds of the fitted body's distances."""
        if truth.vertices is None:
            return {}
        vertices = truth.vertices[t].astype(np.float64)
        row: Values = {"truth/body_floor": person.mean_distance(vertices)}
        if seen_body is not None:
            points = self.body_samples.of(vertices, self.faces)
            row["truth/body_visible_floor"] = person.mean_distance(points[seen_body])
        return row

    def _true_object(
        self,
        t: int,
        truth: Truth,
        surface: PosedObject,
        sample_points: np.ndarray | None,
        object_: MeasuredCloud,
        seen_object: np.ndarray | None,
    ) -> Values:
        """Cloud distances of the true object, and true contact."""
        rotation, translation = truth.rotation[t], truth.translation[t]
        object_vertices = truth.object_vertices @ rotation.T + translation
        row: Values = {"truth/object_floor": object_.mean_distance(object_vertices)}
        if seen_object is not None and sample_points is not None:
            points = sample_points @ rotation.T + translation
            row["truth/object_visible_floor"] = object_.mean_distance(points[seen_object])
        if truth.vertices is not None:
            vertices = truth.vertices[t].astype(np.float64)
            distance = surface.signed_distance(vertices, rotation, translation)
            reach = contact.facing_reach(self.threshold)
            body = BodySurface(vertices, self.faces, self.tree)
            facing = body.facing(surface.placed(rotation, translation), distance, reach)
            row["true_distance"] = distance.astype(np.float32)
            row["true_facing"] = facing.astype(np.float32)
            row["truth/penetration_mean"] = contact.depths(distance).mean
            row["truth/contact_frame"] = contact.vertex_contact(facing, self.threshold).any()
        return row
