"""Stage ``object_track``: the object's pose in every frame (equation 1)."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.config import ObjectEntry, ObjectPose, ObjectTrackSettings, digest
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh, Paint
from intercap_core.object_track.absent import NOT_NAMED, SOURCE, absent_track
from intercap_core.object_track.constants import NOTHING_LOG_RATIO, TOLD_SHARE, TRACKING_FACES
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.object_size import label_doubt, size_doubt
from intercap_core.object_track.proposals import NotFound
from intercap_core.object_track.recording import ObjectRecording
from intercap_core.object_track.tracker import Track, Tracker
from intercap_core.schemas import OBJECT_TRACK

log = logging.getLogger(__name__)


def run(
    *,
    frames: Path,
    scene: Path,
    detections: Path,
    person: Path,
    output: Path,
    object_: ObjectEntry | None,
    settings: ObjectTrackSettings,
    poses: Sequence[ObjectPose] = (),
) -> None:
    """Track the object through the recording and write the object_track artefact.

    Where ``object_`` is None, a person alone, or the images show nothing of it, it says so: lost in
    every frame, without a pose. The track agrees with the annotated ``poses`` of some frames unless
    the images contradict them clearly; without any, it is searched for. Raises UserError where the
    mesh or an input artefact is unusable, or a pose is of a frame that is not there.
    """
    if object_ is None:
        with Frames.open(frames) as recording:
            _write_absent(output, recording, "", [NOT_NAMED], settings)
        return
    mesh = ObjectMesh.load(object_)
    simple = mesh.simplified(TRACKING_FACES)
    with Frames.open(frames) as recording:
        detected = Detections.load(detections)
        source = ObjectRecording(recording, detected, scene, person, mesh.diameter)
        sequence = recording.sequence
        if not source.cameras:
            raise UserError(
                f"sequence {sequence}: no camera has images and a pose; check the recordings and "
                "the calibration"
            )
        doubts = [
            label_doubt(detected, object_.labels),
            size_doubt(recording, detected, recording.rig, mesh.diameter, object_.labels),
        ]
        for doubt in filter(None, doubts):
            log.warning("sequence %s: object %r: %s", sequence, object_.name, doubt)
        tracker = Tracker(
            simple,
            source.views,
            source.labels(),
            settings,
            times=recording.time_s,
            labels=object_.labels,
            up=source.up if np.isfinite(source.up).all() else None,
            joints=source.joints,
            pictures=source.pictures,
            paint=Paint.load(Path(object_.mesh), mesh),
        )
        try:
            track = tracker.run(_given(poses, recording.num_sets, sequence))
            nothing = _nothing(track)
        except NotFound:
            nothing = (
                "it was found in no frame (no segmentation candidate, with depth or in two views, "
                f"fits its size; labels expected: {', '.join(object_.labels) or 'any'})"
            )
        if nothing:
            nothing += (
                ": no frame has a pose of it; check the candidates, annotate 'object_poses', or "
                "clear the column 'object' where there is none"
            )
            log.warning("sequence %s: object %r: %s", sequence, object_.name, nothing)
            told = [nothing, *filter(None, doubts)]
            _write_absent(output, recording, object_.name, told, settings)
            return
        names = list(recording.rig.names)
    told = [*(doubt for doubt in doubts if doubt), *track.doubts]
    for doubt in track.doubts:
        log.warning("sequence %s: object %r: %s", sequence, object_.name, doubt)
    _tell(track, sequence)
    with artefacts.write(
        output,
        OBJECT_TRACK,
        settings_digest=digest(settings),
        sequence=sequence,
        object=object_.name,
        seed_frame=track.seed_frame,
        seed_source=_source(track),
        doubts="; ".join(told),
    ) as writer:
        for key, values in _datasets(track, source.cameras, len(names)).items():
            writer.put(key, values)
        writer.put("camera_names", names)


def _nothing(track: Track) -> str:
    """Why the track is not believed in any frame, "" = it is in some."""
    believed = sum(not frame.lost for frame in track.frames)
    if believed == 0:
        return "its track is lost in every frame"
    if track.of_nothing:
        return (
            f"what was tracked in {believed} of {len(track.frames)} frames is not believed, as all "
            f"images together hardly show it ({track.evidence:.0f} nats, expected "
            f"{NOTHING_LOG_RATIO:.0f} and more)"
        )
    return ""


def _write_absent(
    output: Path,
    recording: Frames,
    name: str,
    doubts: list[str],
    settings: ObjectTrackSettings,
) -> None:
    """Write that there is no object, with the reasons."""
    names = list(recording.rig.names)
    with artefacts.write(
        output,
        OBJECT_TRACK,
        settings_digest=digest(settings),
        sequence=recording.sequence,
        object=name,
        seed_frame=-1,
        seed_source=SOURCE,
        doubts="; ".join(doubts),
    ) as writer:
        for key, values in absent_track(recording.num_sets, len(names)).items():
            writer.put(key, values)
        writer.put("camera_names", names)


def _given(poses: Sequence[ObjectPose], count: int, sequence: str) -> list[GivenPose]:
    """The annotated poses as the tracker takes them, of a recording of ``count`` frame sets."""
    beyond = [pose.frame for pose in poses if pose.frame >= count]
    if beyond:
        raise UserError(
            f"sequence {sequence}: an annotated pose of the object is in frame {beyond[0]}, the "
            f"recording has {count} frame sets; correct 'frame' in the annotation"
        )
    return [
        GivenPose(
            pose.frame,
            rigid(
                Rotation.from_rotvec(pose.rotation_vector).as_matrix(), np.array(pose.translation)
            ),
            pose.sigma_m,
            float(np.radians(pose.sigma_degrees)),
        )
        for pose in poses
    ]


def _source(track: Track) -> str:
    if not track.annotated:
        return "search"
    return "annotated" if track.borne_out else "annotated against the images"


def _tell(track: Track, sequence: str) -> None:
    """What whoever runs the stage should know of a track that is not sound."""
    count = len(track.frames)
    lost = sum(frame.lost for frame in track.frames)
    gone = sum(frame.gone for frame in track.frames)
    doubtful = sum(frame.ambiguous for frame in track.frames)
    if gone:
        log.warning(
            "sequence %s: in %d of %d frames no camera shows the object for so long that it seems "
            "to have left; if it was there, check the candidates, or annotate 'object_poses'",
            sequence,
            gone,
            count,
        )
    if lost > TOLD_SHARE * count:
        log.warning(
            "sequence %s: the object is lost in %d of %d frames; check the candidates, or "
            "annotate 'object_poses'",
            sequence,
            lost,
            count,
        )
    elif lost + doubtful > TOLD_SHARE * count:
        log.warning(
            "sequence %s: of %d frames the object is lost in %d, and quite different poses explain "
            "%d alike; annotate 'object_poses' to decide",
            sequence,
            count,
            lost,
            doubtful,
        )


def _datasets(track: Track, cameras: list[int], count: int) -> dict[str, np.ndarray]:
    """The artefact's datasets by name; cameras without a view keep -1 and NaN."""
    shape = (len(track.frames), count)
    candidate = np.full(shape, -1, np.int32)
    overlap, depth, contour = (np.full(shape, np.nan, np.float32) for _ in range(3))
    for t, frame in enumerate(track.frames):
        for c, view in zip(cameras, frame.fit.views, strict=True):
            candidate[t, c] = view.candidate
            overlap[t, c] = view.overlap
            depth[t, c] = view.depth_residual_m
            contour[t, c] = view.contour_residual_px
    poses = np.array([frame.fit.pose for frame in track.frames])
    carried = {"carried": np.array([frame.carried for frame in track.frames])}
    return {
        "rotation": poses[:, :3, :3],
        "translation": poses[:, :3, 3],
        "candidate": candidate,
        "overlap": overlap,
        "depth_residual": depth,
        "silhouette_residual": contour,
        "views": np.array([frame.fit.support for frame in track.frames], np.int8),
        "covariance": np.array([frame.fit.covariance + frame.spread for frame in track.frames]),
        "spread": np.array([frame.spread for frame in track.frames]),
        "lost": np.array([frame.lost for frame in track.frames]),
        "gone": np.array([frame.gone for frame in track.frames]),
        "recovered": np.array([frame.recovered for frame in track.frames]),
        "probability": np.array([frame.probability for frame in track.frames], np.float32),
        "ambiguous": np.array([frame.ambiguous for frame in track.frames]),
        "resting": np.array([frame.resting for frame in track.frames]),
        "free_axis": np.array([frame.free_axis for frame in track.frames]),
        **(carried if track.annotated else {}),
    }
