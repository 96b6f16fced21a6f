"""Errors of the bodies fitted to one recording, and the figures of many such recordings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body.joints import JOINT_NAMES
from intercap_core.config import BodyModels
from intercap_core.evaluation import body, contact
from intercap_core.evaluation.body_clouds import CLOUD_KEYS, EVERY, BodyClouds
from intercap_core.evaluation.figures import BAD_BODY_M, Figures
from intercap_core.evaluation.tracks import BodyTrack, read_body
from intercap_core.evaluation.truth import Truth, body_errors
from intercap_core.schemas import SCENE, TRUTH

BODY_JOINT_NAMES = JOINT_NAMES[body.BODY_JOINTS]


@dataclass(frozen=True, eq=False)
class BodyErrors:
    """T frames of one body, metres; what is not known is NaN.

    ``pve``, ``visible`` (T,): mean error of all vertices, and of those that cameras truly see.
    ``joints`` (T, 22) by joint; ``hands``, ``hands_wrist`` (T, 2) of joints and tips, the second
    with the wrist aligned; ``touching`` (T, 2) hands that truly touch the object. ``face``,
    ``face_aligned`` (T,) of 68 landmarks. ``acceleration`` (T,) metres a frame^2 at 30 fps.
    ``normalised`` (T, 22), ``normalised_hands`` (T, 30) errors over the stated deviation.
    ``flagged`` (T,) the stage does not trust it. ``clouds``: (N,) each, of every few frames.
    ``views`` cameras that have images; ``truth`` the file that it was held to.
    """

    sequence: str
    interaction: str
    truth: Path
    views: int
    pve: np.ndarray
    visible: np.ndarray
    joints: np.ndarray
    hands: np.ndarray
    hands_wrist: np.ndarray
    touching: np.ndarray
    face: np.ndarray
    face_aligned: np.ndarray
    acceleration: np.ndarray
    normalised: np.ndarray
    normalised_hands: np.ndarray
    flagged: np.ndarray
    clouds: dict[str, np.ndarray] = field(default_factory=dict)

    @property
    def bad(self) -> np.ndarray:
        """Frames (T,) whose body is truly off: a vertex error above 40 mm."""
        return self.pve > BAD_BODY_M

    @property
    def worst(self) -> int:
        """The frame with the largest error, of the joints where that of vertices is not known."""
        known = np.isfinite(self.pve).any()
        return int(np.nanargmax(self.pve if known else self.joints.mean(1)))


def measure(
    frames: Path,
    scene: Path,
    person: Path,
    body_fit: Path,
    truth: Path,
    body_models: BodyModels,
    gender: str,
) -> BodyErrors:
    """Compare the artefact of stage ``body_fit`` with the truth of its recording.

    Raises UserError where an artefact is broken, or the truth is of another recording.
    """
    track = read_body(body_fit, "body_fit", body_models, gender)
    with artefacts.read(scene, SCENE) as found:
        sequence, fps = str(found.attributes["sequence"]), float(found.attributes["fps"])
        known = Truth.load(truth, found["times"], fps, track.model.num_vertices)
        views = int(found["present"].sum())
    with artefacts.read(truth, TRUTH) as told:
        interaction = str(told.attributes["interaction"])
    found_errors = body_errors(known, track, fps)
    assert track.sigma is not None
    with BodyClouds.open(frames, scene, person, track.model) as points:
        surface, clouds = _surface(track, known, points)
    return BodyErrors(
        sequence=sequence,
        interaction=interaction,
        truth=truth,
        views=views,
        joints=body.joint_errors(track.joints, known.joints),
        hands=found_errors["hand_mpjpe"],
        hands_wrist=found_errors["hand_mpjpe_wrist"],
        touching=known.contact_region[:, :2],  # METRIC_REGIONS starts with the hands
        acceleration=found_errors["acceleration_body"],
        normalised=found_errors["joint_normalised"],
        normalised_hands=body.normalised_joint_error(
            track.joints, known.joints, track.sigma, body.BOTH_HANDS
        ),
        flagged=track.flagged,
        clouds=clouds,
        **surface,
    )


def _surface(
    track: BodyTrack,
    truth: Truth,
    clouds: BodyClouds,
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Errors of skin and face (T,), and distances to the measured points of every few frames."""
    total = len(track.joints)
    found = {key: np.full(total, np.nan) for key in ("pve", "visible", "face", "face_aligned")}
    measured: list[dict[str, float]] = []
    if truth.vertices is None or truth.visible is None:
        return found, {}
    keypoints = track.model.keypoint_map
    for t, vertices in enumerate(track.vertices()):
        true = truth.vertices[t]
        found["pve"][t] = body.vertex_error(vertices, true)
        found["visible"][t] = body.visible_vertex_error(vertices, true, truth.visible[t])
        face, true_face = (body.landmarks(v, keypoints) for v in (vertices, true))
        found["face"][t] = body.landmark_error(face, true_face)
        found["face_aligned"][t] = body.landmark_error(face, true_face, align=True)
        if t % EVERY == 0:
            measured.append(clouds.measure(t, vertices, truth))
    return found, {
        key: np.array([values[key] for values in measured]) for key in CLOUD_KEYS if measured
    }


def figures(recordings: Sequence[BodyErrors]) -> Figures:
    """What is reported of several recordings, millimetres: means over their frames.

    Hands in grasp are over the frames in which that hand truly touches the object. Flags are held
    to the frames that are truly bad; recall and precision are left out where they have no meaning.
    """
    if not recordings:
        return {}

    def mean(name: str) -> float:
        values = np.concatenate([getattr(r, name).ravel() for r in recordings])
        return 1e3 * float(np.nanmean(values)) if np.isfinite(values).any() else np.nan

    def median(name: str) -> float:
        return float(np.nanmedian(np.concatenate([getattr(r, name).ravel() for r in recordings])))

    pve, hands, touching = (
        np.concatenate([getattr(r, name) for r in recordings])
        for name in ("pve", "hands", "touching")
    )
    found: Figures = {
        "frames": float(len(pve)),
        "pve_mm": mean("pve"),
        "pve_visible_mm": mean("visible"),
        "mpjpe_mm": mean("joints"),
        "hand_mpjpe_mm": mean("hands"),
        "hand_wrist_mpjpe_mm": mean("hands_wrist"),
        "face_mm": mean("face"),
        "face_aligned_mm": mean("face_aligned"),
        "acceleration_mm": mean("acceleration"),
        "normalised_median": median("normalised"),
        "normalised_hand_median": median("normalised_hands"),
    }
    if np.isfinite(pve).any():
        found["pve_p95_mm"] = 1e3 * float(np.nanpercentile(pve, 95))
    if touching.any():
        found["hand_grasp_mpjpe_mm"] = 1e3 * float(hands[touching].mean())
    for key in CLOUD_KEYS:
        values = np.concatenate([np.zeros(0), *(r.clouds[key] for r in recordings if r.clouds)])
        if np.isfinite(values).any():
            found[f"{key}_mm"] = 1e3 * float(np.nanmean(values))
    found = {key: value for key, value in found.items() if np.isfinite(value)}
    return found | flag_figures(recordings)


def flag_figures(recordings: Sequence[BodyErrors]) -> Figures:
    """How many frames are flagged, how many are truly bad, and how well the two agree."""
    bad, flagged = (np.concatenate([getattr(r, n) for r in recordings]) for n in ("bad", "flagged"))
    found = {
        "flagged_share": float(flagged.mean()),
        "bad_frames_share": float(bad.mean()),
        "bad_frames_recall": contact.recall(flagged, bad),
        "bad_frames_precision": contact.precision(flagged, bad),
    }
    return {key: value for key, value in found.items() if np.isfinite(value)}


def by_interaction(recordings: Sequence[BodyErrors]) -> dict[str, list[BodyErrors]]:
    """The recordings of each interaction, by name."""
    names = sorted({r.interaction for r in recordings})
    return {name: [r for r in recordings if r.interaction == name] for name in names}


def by_joint(recordings: Sequence[BodyErrors]) -> dict[str, tuple[float, float, float]]:
    """Mean and 95th percentile of each body joint's error, mm, and its median normalised error."""
    errors, ratios = (
        np.concatenate([getattr(r, name) for r in recordings]) for name in ("joints", "normalised")
    )
    return {
        name: (
            1e3 * float(errors[:, j].mean()),
            1e3 * float(np.percentile(errors[:, j], 95)),
            float(np.median(ratios[:, j])),
        )
        for j, name in enumerate(BODY_JOINT_NAMES)
    }
