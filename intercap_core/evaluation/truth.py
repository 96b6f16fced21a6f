"""Truth of a virtual recording: true body, object, contact and cameras.

The true skin is sampled at the points that correspond to the vertices of the fitted mesh. Only the
metrics and the evaluation read it, never a fit.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from intercap_core import artefacts
from intercap_core.body.joints import BODY_JOINTS, BOTH_HANDS, FOOT_JOINTS
from intercap_core.errors import UserError
from intercap_core.evaluation import body, contact, motion, object_pose
from intercap_core.evaluation.motion import Floor
from intercap_core.evaluation.tracks import BodyTrack, ObjectTrack
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.surfaces import SurfaceSamples
from intercap_core.schemas import METRIC_REGIONS, TRUTH


def match_times(path: Path, true_times: np.ndarray, times: np.ndarray, fps: float) -> np.ndarray:
    """Index (T,) of the true frame set nearest in time to each recorded set.

    Both times are in seconds and increasing; ``path`` names the truth in the error message.

    Raises UserError if the truth has no set within half a frame of a recorded set.
    """
    after = np.clip(np.searchsorted(true_times, times), 0, len(true_times) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.abs(times - true_times[before]) < np.abs(true_times[after] - times)
    nearest = np.where(nearer, before, after)
    apart = np.abs(true_times[nearest] - times)
    if apart.max(initial=0) > 0.5 / fps:
        raise UserError(
            f"{path}: holds {len(true_times)} frames, the recording {len(times)}; the recorded "
            f"frame at {times[np.argmax(apart)]:.3f} s is {apart.max():.3f} s from the "
            "nearest true frame; make the truth of this recording again or remove it from the table"
        )
    return nearest


@dataclass(frozen=True, eq=False)
class Truth:
    """True body and object in the recording's T frame sets, master frame, metres.

    Without an object the object's mesh is empty and its pose NaN. ``vertices`` and ``visible`` are
    None if the truth file has no correspondences for the topology of the fitted body.
    """

    vertices: np.ndarray | None
    """(T, V, 3) points of the true skin that correspond to the vertices of the fitted mesh."""
    visible: np.ndarray | None
    """(T, V) whether a camera truly sees each of ``vertices``."""
    joints: np.ndarray
    """(T, 55, 3) joints of SMPL-X."""
    tips: np.ndarray
    """(T, 10, 3) fingertips, thumb to little finger, left hand first."""
    object_vertices: np.ndarray
    """(Vo, 3) vertices of the true object's mesh, object frame."""
    object_faces: np.ndarray
    """(Fo, 3) vertex indices."""
    object_visible: np.ndarray
    """(T, Vo) whether a camera truly sees each object vertex."""
    rotation: np.ndarray
    """(T, 3, 3) master_from_object."""
    translation: np.ndarray
    """(T, 3) master_from_object."""
    object_views: np.ndarray
    """(T,) number of cameras that truly see the object."""
    contact_region: np.ndarray
    """(T, 12) true contact, in the order of METRIC_REGIONS."""
    floor: Floor
    """The plane on which bare soles stand."""
    support_height: np.ndarray
    """(T, 2) height of the surface under the left and the right sole above the floor."""
    camera_names: tuple[str, ...]
    """Names of the C cameras."""
    master_from_colour: np.ndarray
    """(C, 4, 4) true camera poses."""

    @property
    def has_object(self) -> bool:
        """Whether the recording has an object."""
        return len(self.object_faces) > 0

    @classmethod
    def load(cls, path: Path, times: np.ndarray, fps: float, num_vertices: int) -> Truth:
        """Read the truth at the frame sets' ``times`` (T,), seconds.

        Raises UserError if the file is damaged or does not cover these times.
        """
        with artefacts.read(path, TRUTH) as file:
            at = match_times(path, file["times"], times, fps)
            vertices = visible = None
            face, weights = file["correspondence_face"], file["correspondence_weights"]
            if len(face) == num_vertices:
                faces = file["body_faces"]
                vertices = body.corresponding_vertices(
                    file["body_vertices"][at], faces, face, weights
                )
                seen = file["body_visible"][at].astype(np.float32)[..., None]
                visible = body.corresponding_vertices(seen, faces, face, weights)[..., 0] > 0.5
            names = file.text("region_names")
            # the body model has bare feet, which stand above the ground by the shoes' soles
            soles = float(file.attributes.get("sole_m", 0.0))
            offset = float(file.attributes["ground_offset"]) - soles
            columns = [names.index(name) for name in METRIC_REGIONS]
            return cls(
                vertices=vertices,
                visible=visible,
                joints=file["joints"][at],
                tips=file["fingertips"][at],
                **_object_datasets(file, at),
                contact_region=file["region_contact"][at][:, columns],
                floor=Floor(file["ground_normal"], offset),
                support_height=(
                    file["support_height"][at]
                    if "support_height" in file
                    else np.zeros((len(at), 2))
                ),
                camera_names=tuple(file.text("camera_names")),
                master_from_colour=file["master_from_colour"],
            )

    def object_samples_visible(
        self, samples: SurfaceSamples, mesh: ObjectMesh
    ) -> tuple[np.ndarray, np.ndarray]:
        """True object vertices nearest to the tracked mesh's samples, and their visibility.

        Returns:
            points: (N, 3) object frame.
            visible: (T, N) whether a camera truly sees each point.
        """
        points = samples.of(mesh.vertices, mesh.faces)
        nearest = cKDTree(self.object_vertices).query(points)[1]
        return self.object_vertices[nearest], self.object_visible[:, nearest]


def _object_datasets(file: artefacts.Artefact, at: np.ndarray) -> dict[str, np.ndarray]:
    """Fields of :class:`Truth` about the object at the T frame sets ``at``."""
    if not file.attributes["object"]:
        count = len(at)
        return {
            "object_vertices": np.zeros((0, 3)),
            "object_faces": np.zeros((0, 3), np.int32),
            "object_visible": np.zeros((count, 0), bool),
            "rotation": np.full((count, 3, 3), np.nan),
            "translation": np.full((count, 3), np.nan),
            "object_views": np.zeros(count, np.int8),
        }
    return {
        "object_vertices": file["object_vertices"].astype(np.float64),
        "object_faces": file["object_faces"],
        **{
            key: file[key][at]
            for key in ("object_visible", "rotation", "translation", "object_views")
        },
    }


def body_errors(truth: Truth, track: BodyTrack, fps: float) -> dict[str, np.ndarray]:
    """Errors of joints, hands and accelerations of T fitted bodies, metres, by dataset.

    The names are those of the metrics artefact without the prefix ``truth/<stage>/``.
    """
    joints, tips = track.joints, track.tips
    true = truth.joints
    result = {
        "body_mpjpe": body.joint_error(joints, true),
        "hand_mpjpe": body.hand_error(joints, tips, true, truth.tips),
        "hand_mpjpe_wrist": body.hand_error(joints, tips, true, truth.tips, align_wrists=True),
        "acceleration_body": motion.acceleration_error(
            joints[:, BODY_JOINTS], true[:, BODY_JOINTS], fps
        ),
        "acceleration_hands": motion.acceleration_error(
            joints[:, BOTH_HANDS], true[:, BOTH_HANDS], fps
        ),
        "acceleration_feet": motion.acceleration_error(
            joints[:, FOOT_JOINTS], true[:, FOOT_JOINTS], fps
        ),
        "joint_offset": (joints - true)[:, BODY_JOINTS],
        "fingertips": np.linalg.norm(tips - truth.tips, axis=-1).reshape(-1, 2, 5).mean(-1),
    }
    if track.sigma is not None:
        result["joint_normalised"] = body.normalised_joint_error(joints, true, track.sigma)
    return result


def object_errors(
    rotation: np.ndarray, translation: np.ndarray, track: ObjectTrack, mesh: ObjectMesh, fps: float
) -> dict[str, np.ndarray]:
    """Errors of T object poses, by dataset of the metrics artefact without ``truth/<stage>/``.

    If the object was found in no frame, errors of translation and rotation are infinite.

    Args:
        rotation, translation: (T, 3, 3) and (T, 3), true poses master_from_object.
        track: fitted poses.
        mesh: mesh of the tracked object.
        fps: frames per second.
    """
    if not track.known:
        unknown, beyond = np.full(len(rotation), np.nan), np.full(len(rotation), np.inf)
        return {
            "object_translation": beyond,
            "object_rotation": beyond,
            "object_centre": np.full((len(rotation), 3), np.nan),
            "object_turn": unknown,
            "object_flagged": np.ones(len(rotation), bool),
            "acceleration_object": unknown,
        }
    centre = mesh.centre_of_mass
    fitted = object_pose.posed_point(track.rotation, track.translation, centre)
    true = object_pose.posed_point(rotation, translation, centre)
    turns = motion.turns(track.rotation, rotation, mesh.symmetry)
    result = {
        "object_translation": np.linalg.norm(fitted - true, axis=-1),
        "object_rotation": mesh.symmetry.rotation_error_deg(track.rotation, rotation),
        "object_centre": fitted,
        "object_turn": np.append(np.nan, turns),
        "object_flagged": track.flagged,
        "acceleration_object": motion.acceleration_error(fitted[:, None], true[:, None], fps),
    }
    if track.covariance is not None:
        result["object_normalised"] = object_pose.normalised_translation_error(
            track.translation, translation, track.covariance
        )
    return result


def contact_counts(distance: np.ndarray, true_distance: np.ndarray) -> np.ndarray:
    """Confusion counts (W, 4) of a frame's body vertices for each threshold of the sweep.

    Both arguments are contact distances (V,) to the object, metres.
    """
    return np.stack(
        [
            contact.confusion(
                contact.vertex_contact(distance, limit),
                contact.vertex_contact(true_distance, limit),
            )
            for limit in contact.SWEEP_M
        ]
    )
