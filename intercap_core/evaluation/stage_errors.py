"""Errors of the body and object of each stage against truth, by dataset of the metrics artefact.

Datasets are named ``truth/<stage>/<key>`` for errors and ``truth/<key>`` for the truth itself.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from intercap_core.evaluation import body, contact, motion, object_pose
from intercap_core.evaluation import truth as truths
from intercap_core.evaluation.measurement import Values
from intercap_core.evaluation.motion import foot_errors, slip_speed, support
from intercap_core.evaluation.proximity import BodySurface, PosedObject
from intercap_core.evaluation.tracks import BodyTrack, ObjectTrack
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.schemas import METRIC_REGIONS

_FEET = ("left_foot", "right_foot")  # regions of the soles


class StageErrors:
    """Errors of each stage by dataset name; quantities that a stage does not estimate are omitted.

    If ``mesh`` (of the tracked object) is None or there is no true object, only the body is
    evaluated. ``true_distance``, ``true_facing``: (T, V) signed and contact distances of the true
    body from the true object.
    """

    def __init__(
        self,
        truth: truths.Truth,
        true_distance: np.ndarray | None,
        true_facing: np.ndarray | None,
        mesh: ObjectMesh | None,
        threshold_m: float,
        fps: float,
    ) -> None:
        self._truth = truth
        self._true_distance, self._true_facing = true_distance, true_facing
        self._threshold, self._reach = threshold_m, contact.facing_reach(threshold_m)
        self._fps = fps
        self._mesh = mesh if truth.has_object else None
        if self._mesh is not None:
            self._surface = PosedObject(
                self._mesh.vertices, self._mesh.faces, watertight=self._mesh.watertight
            )
            self._true_surface = DistanceField(truth.object_vertices, truth.object_faces)
        self._touched = np.zeros(0, int)  # vertices in true contact in at least one frame
        self._true_local = np.zeros((0, 0, 3))  # (T, N, 3) of these vertices, true object's frame
        if truth.vertices is not None and true_facing is not None:
            touching = contact.vertex_contact(true_facing)
            self._touched = np.flatnonzero(touching.any(0))
            self._true_local = _local(
                truth.vertices[:, self._touched], truth.rotation, truth.translation
            )

    def of_object(self, stage: str, track: ObjectTrack) -> Values:
        """Errors of the object's pose after ``stage``."""
        if self._mesh is None:
            return {}
        true = self._truth.rotation, self._truth.translation
        errors = truths.object_errors(*true, track, self._mesh, self._fps)
        return {f"truth/{stage}/{key}": value for key, value in errors.items()}

    def of_body(
        self,
        stage: str,
        body_track: BodyTrack,
        track: ObjectTrack,
        distance: np.ndarray | None = None,
    ) -> Values:
        """Errors of the body after ``stage``, and of its contact with the object.

        Args:
            stage: "body_fit" or "joint".
            body_track: bodies after the stage.
            track: the object's poses; for ``body_fit`` those of ``object_track``.
            distance: (T, V) contact distances of the vertices from the object; None = compute.
        """
        errors = truths.body_errors(self._truth, body_track, self._fps)
        if self._truth.vertices is not None:
            errors |= self._vertices(body_track, track, distance)
        return {f"truth/{stage}/{key}": value for key, value in errors.items()}

    def _vertices(
        self, body_track: BodyTrack, track: ObjectTrack, known: np.ndarray | None
    ) -> Values:
        """Errors of skin, contact, slip and feet, by dataset without the prefix.

        ``known``: (T, V) contact distances from the object; None = compute.
        """
        pve, counts, touching, skin, soles = [], [], [], [], []
        assert self._truth.vertices is not None
        regions, faces = body_track.model.regions, body_track.model.faces.numpy()
        tree = SurfaceTree(body_track.model.template.numpy(), faces) if known is None else None
        for t, vertices in enumerate(body_track.vertices()):
            skin.append(vertices[self._touched])
            soles.append([vertices[regions[foot]] for foot in _FEET])
            pve.append(body.vertex_error(vertices, self._truth.vertices[t]))
            if self._mesh is None or self._true_facing is None:
                continue
            distance = np.full(len(vertices), np.inf)  # the object was not found
            if known is not None:
                distance = known[t]
            elif track.known and tree is not None:
                distance = self._surface.contact_distance(
                    BodySurface(vertices.astype(np.float64), faces, tree),
                    track.rotation[t],
                    track.translation[t],
                    self._reach,
                )
            counts.append(truths.contact_counts(distance, self._true_facing[t]))
            touching.append(contact.vertex_contact(distance, self._threshold))
        of_body = {
            **self._feet([np.stack(sole) for sole in zip(*soles, strict=True)], regions),
            "body_pve": pve,
        }
        if not touching:
            return of_body
        touched = np.stack(touching)
        return of_body | {
            **self._slip(np.stack(skin), track),
            "vertex_contact_counts": np.stack(counts),
            "contact_frame": touched.any(1),
            "region_contact": contact.region_contact(touched, regions, METRIC_REGIONS),
        }

    def _slip(self, skin: np.ndarray, track: ObjectTrack) -> Values:
        """Slip (T,) of the skin vertices (T, N, 3) that are ever in true contact."""
        assert self._true_facing is not None and self._mesh is not None
        if not track.known:
            return {"slip": np.full(len(skin), np.nan)}
        pose, true = (rigid(of.rotation, of.translation) for of in (track, self._truth))
        symmetry = self._mesh.symmetry  # a rotation about a symmetry axis is no slip
        pose = np.array(
            [symmetry.nearest_equivalent_pose(a, b) for a, b in zip(pose, true, strict=True)]
        )
        touching = contact.vertex_contact(self._true_facing[:, self._touched])
        speed = slip_speed(
            _local(skin, pose[:, :3, :3], pose[:, :3, 3]),
            self._true_local,
            touching,
            lambda points: self._true_surface.closest(points).normals,
            self._fps,
        )
        return {"slip": speed}

    def _feet(self, soles: Sequence[np.ndarray], regions: Mapping[str, np.ndarray]) -> Values:
        """Errors of both feet, whose sole vertices are (T, S, 3)."""
        assert self._truth.vertices is not None
        found = []
        for sole, true, carrying in zip(soles, *self._true_soles(regions), strict=True):
            found.append(foot_errors(sole, true, carrying, self._truth.floor, self._fps))
        return {
            "planted_speed": _since_before([foot.speed for foot in found]),
            "planted_height": _since_before([foot.height for foot in found]),
            "foot_swing": _since_before([foot.swing for foot in found]),
            "foot_centre": np.stack([sole.mean(1) for sole in soles], 1),
        }

    def _true_soles(
        self, regions: Mapping[str, np.ndarray]
    ) -> tuple[list[np.ndarray], list[np.ndarray]]:
        """Vertices (T, S, 3) of both true soles, and masks (T - 1, S) of their support."""
        truth = self._truth
        assert truth.vertices is not None
        soles = [truth.vertices[:, regions[foot]].astype(np.float64) for foot in _FEET]
        carrying = [
            support(sole, truth.floor, self._fps, level)
            for sole, level in zip(soles, truth.support_height.T, strict=True)
        ]
        return soles, carrying

    def about_truth(self, regions: Mapping[str, np.ndarray]) -> Values:
        """Datasets of the truth itself; ``regions`` are the body's vertex indices by region."""
        truth = self._truth
        if self._mesh is None:
            return self._true_skin(regions)
        centre = object_pose.posed_point(
            truth.rotation, truth.translation, self._mesh.centre_of_mass
        )
        return {
            "truth/sweep": contact.SWEEP_M,
            "truth/contact_region": truth.contact_region,
            "truth/object_views": truth.object_views,
            "truth/object_moving": motion.moving(truth.rotation, centre, self._fps),
            "truth/object_centre": centre,
            **self._true_skin(regions),
        }

    def _true_skin(self, regions: Mapping[str, np.ndarray]) -> Values:
        """Datasets of the true skin: distances of regions, standing feet and their centres."""
        truth = self._truth
        if truth.vertices is None:
            return {}
        soles, carrying = self._true_soles(regions)
        carried = [np.any(vertices, axis=1) for vertices in carrying]
        near = {}
        if self._mesh is not None and self._true_distance is not None:
            nearest = [self._true_distance[:, regions[name]].min(1) for name in METRIC_REGIONS]
            near = {"truth/region_distance": np.stack(nearest, 1)}
        return near | {
            "truth/standing": _since_before(carried) > 0,
            "truth/foot_centre": np.stack([sole.mean(1) for sole in soles], 1),
        }


def _local(points: np.ndarray, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
    """Points (T, N, 3) in the frame of an object with poses (T, 3, 3), (T, 3)."""
    return (points - translation[:, None]) @ rotation


def _since_before(feet: Sequence[np.ndarray]) -> np.ndarray:
    """Values (T - 1,) of both feet between consecutive frames as (T, 2), NaN in the first frame."""
    return np.concatenate([np.full((1, 2), np.nan), np.stack(feet, 1)])
