"""Errors of the bodies fitted to one recording, and figures (summary numbers) of many recordings.

Names that end in ``_floor`` are lower bounds: the same distance for the true body. It is not 0,
because of clothing and depth noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.joints import BODY_JOINTS, BOTH_HANDS, JOINT_NAMES
from intercap_core.body.keypoints import CONTOUR, FACE, KeypointMap
from intercap_core.body.model import BodyModel
from intercap_core.config import BodyModels
from intercap_core.evaluation import body, contact
from intercap_core.evaluation.known import Figures, finite, over_known
from intercap_core.evaluation.proximity import (
    DEEPEST_M,
    MeasuredCloud,
    seen_by_cameras,
)
from intercap_core.evaluation.segmented import SegmentedClouds, read_person_masks
from intercap_core.evaluation.tracks import BodyTrack, read_body
from intercap_core.evaluation.truth import Truth, body_errors
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.surface_tree import SurfaceTree
from intercap_core.geometry.rigid.surfaces import face_normals, sample_surface
from intercap_core.schemas import BAD_BODY_M, SCENE, TRUTH
from intercap_core.sequence_inputs import SequencePaths

CLOUD_KEYS = (
    "cloud_to_mesh", "mesh_to_cloud_visible", "cloud_to_mesh_floor", "mesh_to_cloud_visible_floor",
)  # fmt: skip


def visible_vertex_error(
    vertices: np.ndarray, true_vertices: np.ndarray, visible: np.ndarray
) -> np.ndarray:
    """Mean vertex error (...) over the mask ``visible`` (..., V); NaN if the mask is empty."""
    error = np.linalg.norm(vertices - true_vertices, axis=-1)
    count = visible.sum(-1)
    mean = (error * visible).sum(-1) / np.maximum(count, 1)
    return np.where(count > 0, mean, np.nan)


def landmarks(vertices: np.ndarray, keypoints: KeypointMap) -> np.ndarray:
    """Face landmarks (..., 68, 3) of vertices (..., V, 3): 51 inner ones, then the jaw line."""
    ids, weights = (
        np.concatenate([of[FACE], of[CONTOUR]]) for of in (keypoints.ids, keypoints.weights)
    )
    return (vertices[..., ids, :] * weights[..., None]).sum(-2)


def landmark_error(found: np.ndarray, true: np.ndarray, *, align: bool = False) -> np.ndarray:
    """Mean distance (...) of corresponding points (..., N, 3).

    ``align`` first applies the rigid transform that best maps the found onto the true points
    (Kabsch 1976). The remaining error is that of shape and expression, without the head's pose.
    """
    if align:
        middle = true.mean(-2, keepdims=True)
        centred = found - found.mean(-2, keepdims=True)
        u, _, vt = np.linalg.svd(np.swapaxes(true - middle, -1, -2) @ centred)
        flip = np.ones(u.shape[:-1])
        flip[..., 2] = np.sign(np.linalg.det(u @ vt))
        rotation = (u * flip[..., None, :]) @ vt
        found = centred @ np.swapaxes(rotation, -1, -2) + middle
    return np.linalg.norm(found - true, axis=-1).mean(-1)


class BodyClouds:
    """The person's measured points of one recording, as stage ``body_fit`` reads them.

    They use the person masks, all views with depth and the refined extrinsics.
    """

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
        self._samples = sample_surface(template, self._faces, 4000)

    def measure(self, t: int, vertices: np.ndarray, truth: Truth) -> dict[str, float]:
        """Mean distances of frame ``t`` by CLOUD_KEYS, metres; NaN if no point was measured.

        - ``cloud_to_mesh``: from the points to the fitted mesh, vertices (V, 3).
        - ``mesh_to_cloud_visible``: from samples of the mesh to the points. Only samples are used
          that a depth image with a person mask truly shows.
        - ``..._floor``: the same distances for the true body, which has no clothing: the lower
          bound of a correct fit.
        """
        assert truth.vertices is not None
        true = truth.vertices[t].astype(np.float64)
        fitted = vertices.astype(np.float64)
        person, _ = self._clouds.at(t, np.concatenate([fitted[::10], true[::10]]))
        if not len(person):
            return dict.fromkeys(CLOUD_KEYS, np.nan)
        cloud = MeasuredCloud(person)
        # at most 3000 points, which bounds the time
        chosen = person[:: -(-len(person) // 3000)].astype(np.float64)
        seen = self._seen(t, true, truth)
        found = {}
        for floor, surface in (("", fitted), ("_floor", true)):
            to_mesh = self._tree.shaped(surface).distance(chosen, DEEPEST_M)
            points = self._samples.of(surface, self._faces)
            found[f"cloud_to_mesh{floor}"] = float(to_mesh.mean())
            found[f"mesh_to_cloud_visible{floor}"] = cloud.mean_distance(points[seen])
        return found

    def _seen(self, t: int, true: np.ndarray, truth: Truth) -> np.ndarray:
        """Mask (N,) of the true body's samples that a depth image with a person mask shows."""
        assert truth.visible is not None
        there = self._images.depth_available[t]
        cameras = [c for i, c in enumerate(self._rig) if there[i] and self._masks[t][i]]
        object_ = truth.object_vertices @ truth.rotation[t].T + truth.translation[t]
        occluders = [self._tree.shaped(true)]
        if truth.has_object:
            occluders.append(SurfaceTree(object_, truth.object_faces).shaped(object_))
        points = self._samples.of(true, self._faces)
        normals = face_normals(true, self._faces)[self._samples.faces]
        # visibility in any camera by the truth, which includes occlusion by furniture
        anyhow = self._samples.of(truth.visible[t].astype(np.float32), self._faces) > 0.5
        return anyhow & seen_by_cameras(points, normals, cameras, occluders)


BODY_JOINT_NAMES = JOINT_NAMES[BODY_JOINTS]


@dataclass(frozen=True, eq=False)
class BodyErrors:
    """Errors of one body over T frames, metres; NaN = unknown."""

    interaction: str
    """Script that the studio's person performs."""
    truth: Path
    """The file with the truth."""
    pve: np.ndarray
    """(T,) mean error of all vertices."""
    visible: np.ndarray
    """(T,) mean error of the vertices that a camera truly sees."""
    joints: np.ndarray
    """(T, 22) error of each body joint."""
    hands: np.ndarray
    """(T, 2) mean error of joints and tips of the left and right hand."""
    hands_wrist: np.ndarray
    """(T, 2) the same error after translation of the fitted wrist to the true one."""
    touching: np.ndarray
    """(T, 2) whether the hand truly touches the object."""
    face: np.ndarray
    """(T,) mean error of 68 landmarks."""
    face_aligned: np.ndarray
    """(T,) the same after rigid alignment."""
    acceleration: np.ndarray
    """(T,) mean error of the joints' second differences, metres per frame^2 at 30 fps."""
    normalised: np.ndarray
    """(T, 22) joint errors over their expected size; median 1 if calibrated."""
    normalised_hands: np.ndarray
    """(T, 30) the same for the finger joints."""
    flagged: np.ndarray
    """(T,) bool: the stage marked the frame as unreliable."""
    clouds: dict[str, np.ndarray] = field(default_factory=dict)
    """Distances (N,) in every fifth frame, by CLOUD_KEYS."""

    @property
    def bad(self) -> np.ndarray:
        """Mask (T,) of frames with a vertex error above 40 mm."""
        return self.pve > BAD_BODY_M


def measure(paths: SequencePaths, truth: Path, body_models: BodyModels, gender: str) -> BodyErrors:
    """Compare the artefact of stage ``body_fit`` with the truth of its recording.

    Raises UserError if an artefact cannot be read or the truth is of another recording.
    """
    track = read_body(paths.body_fit, "body_fit", body_models, gender)
    with artefacts.read(paths.scene, SCENE) as found:
        fps = float(found.attributes["fps"])
        known = Truth.load(truth, found["times"], fps, track.model.num_vertices)
    with artefacts.read(truth, TRUTH) as true:
        interaction = str(true.attributes["interaction"])
    found_errors = body_errors(known, track, fps)
    assert track.sigma is not None
    masks = read_person_masks(paths.person)
    with Frames.open(paths.frames) as images, artefacts.read(paths.scene, SCENE) as found:
        images, rig = images.showing(found["image_of"]), Rig.from_artefact(found)
        points = BodyClouds(images, rig, masks, found["depth_bias"], track.model)
        surface, clouds = _surface(track, known, points)
    return BodyErrors(
        interaction=interaction,
        truth=truth,
        joints=body.joint_errors(track.joints, known.joints),
        hands=found_errors["hand_mpjpe"],
        hands_wrist=found_errors["hand_mpjpe_wrist"],
        touching=known.contact_region[:, :2],  # METRIC_REGIONS starts with the hands
        acceleration=found_errors["acceleration_body"],
        normalised=found_errors["joint_normalised"],
        normalised_hands=body.normalised_joint_error(
            track.joints, known.joints, track.sigma, BOTH_HANDS
        ),
        flagged=track.flagged,
        clouds=clouds,
        **surface,
    )


def _surface(
    track: BodyTrack, truth: Truth, clouds: BodyClouds
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Errors of skin and face (T,), and distances to the measured points in every fifth frame."""
    total = len(track.joints)
    found = {key: np.full(total, np.nan) for key in ("pve", "visible", "face", "face_aligned")}
    measured: list[dict[str, float]] = []
    if truth.vertices is None or truth.visible is None:
        return found, {}
    keypoints = track.model.keypoint_map
    for t, vertices in enumerate(track.vertices()):
        true = truth.vertices[t]
        found["pve"][t] = body.vertex_error(vertices, true)
        found["visible"][t] = visible_vertex_error(vertices, true, truth.visible[t])
        face, true_face = (landmarks(v, keypoints) for v in (vertices, true))
        found["face"][t] = landmark_error(face, true_face)
        found["face_aligned"][t] = landmark_error(face, true_face, align=True)
        if t % 5 == 0:  # neighbouring frames are redundant
            measured.append(clouds.measure(t, vertices, truth))
    return found, {
        key: np.array([values[key] for values in measured]) for key in CLOUD_KEYS if measured
    }


def figures(recordings: Sequence[BodyErrors]) -> Figures:
    """Figures over several recordings, millimetres: means over all their frames.

    ``hand_grasp`` figures are over the frames in which the hand truly touches the object. Recall
    and precision of the flags are omitted if they are undefined.
    """
    if not recordings:
        return {}

    def pooled(name: str) -> np.ndarray:
        return np.concatenate([getattr(r, name) for r in recordings])

    means = {
        "pve_mm": "pve",
        "pve_visible_mm": "visible",
        "mpjpe_mm": "joints",
        "hand_mpjpe_mm": "hands",
        "hand_wrist_mpjpe_mm": "hands_wrist",
        "face_mm": "face",
        "face_aligned_mm": "face_aligned",
        "acceleration_mm": "acceleration",
    }
    found: Figures = {
        "frames": float(len(pooled("pve"))),
        **{key: 1e3 * over_known(np.nanmean, pooled(name).ravel()) for key, name in means.items()},
        "normalised_median": over_known(np.nanmedian, pooled("normalised")),
        "normalised_hand_median": over_known(np.nanmedian, pooled("normalised_hands")),
        "pve_p95_mm": 1e3 * over_known(np.nanpercentile, pooled("pve"), 95),
        "hand_grasp_mpjpe_mm": 1e3 * over_known(np.mean, pooled("hands")[pooled("touching")]),
    }
    for key in CLOUD_KEYS:
        values = [value for r in recordings if r.clouds for value in r.clouds[key]]
        found[f"{key}_mm"] = 1e3 * over_known(np.nanmean, values)
    return finite(found) | flag_figures(recordings)


def flag_figures(recordings: Sequence[BodyErrors]) -> Figures:
    """Shares of flagged and bad frames, and recall and precision of the flags."""
    bad, flagged = (np.concatenate([getattr(r, n) for r in recordings]) for n in ("bad", "flagged"))
    found: Figures = {
        "flagged_share": float(flagged.mean()),
        "bad_frames_share": float(bad.mean()),
        "bad_frames_recall": contact.recall(flagged, bad),
        "bad_frames_precision": contact.precision(flagged, bad),
    }
    return finite(found)


def joint_figures(recordings: Sequence[BodyErrors]) -> Figures:
    """Mean error of each body joint, ``joint_<name>_mm``."""
    mean = np.concatenate([r.joints for r in recordings]).mean(0)
    return {
        f"joint_{name}_mm": 1e3 * float(value)
        for name, value in zip(BODY_JOINT_NAMES, mean, strict=True)
    }
