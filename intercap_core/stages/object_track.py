"""Stage ``object_track``: the object's pose in every frame (equation 1)."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.annotation import ObjectPose
from intercap_core.config import ObjectTrackSettings, digest
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections.read import Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh, Paint
from intercap_core.object_track.artefact import NOT_NAMED, SOURCE_NONE, absent_track, track_datasets
from intercap_core.object_track.given_poses import GivenPose
from intercap_core.object_track.mesh_check import label_doubt, size_doubt
from intercap_core.object_track.observer import Observer
from intercap_core.object_track.proposals import NotFound
from intercap_core.object_track.recording import TRACKING_FACES, ObjectRecording, ViewCache
from intercap_core.object_track.tracker import NOTHING_LOG_RATIO, Track, Tracker
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

    All frames are written as lost, without a pose, if ``object_`` is None (a person alone), if the
    object is found in no frame, or if the images do not support the track as a whole.

    The track agrees with the annotated ``poses``, unless the images clearly contradict them.
    Without annotated poses, the object is searched for.

    Raises UserError if the mesh or an input artefact is unusable, if no camera has images and a
    pose, or if an annotated frame does not exist.
    """
    if object_ is None:
        with Frames.open(frames) as recording:
            _write(output, recording, "", [NOT_NAMED], settings, None, [])
        return
    mesh = ObjectMesh.load(object_)
    with Frames.open(frames) as recording:
        detected = Detections.load(detections)
        source = ObjectRecording(recording, detected, scene, person, mesh.diameter)
        sequence = recording.sequence
        if not source.cameras:
            raise UserError(
                f"sequence {sequence}: no camera has images and a pose; check the recordings and "
                "the calibration"
            )
        observer = Observer(
            mesh.simplified(TRACKING_FACES),
            ViewCache(source.views),
            source.labels(),
            settings,
            recording.time_s,
            labels=object_.labels,
            up=source.up if np.isfinite(source.up).all() else None,
            joints=source.joints,
            pictures=source.pictures,
            paint=Paint.load(Path(object_.mesh), mesh),
        )
        warn = partial(log.warning, "sequence %s: object %r: %s", sequence, object_.name)
        known = (
            label_doubt(detected, object_.labels),
            size_doubt(recording, detected, mesh.diameter, object_.labels),
        )
        doubts = [doubt for doubt in known if doubt]
        for doubt in doubts:
            warn(doubt)
        track: Track | None = None
        try:
            track = Tracker(observer).run(_given(poses, recording.num_sets, sequence))
            reason = _absence(track)
        except NotFound:
            reason = (
                "it was found in no frame (no segmentation candidate, with depth or in two views, "
                f"fits its size; labels expected: {', '.join(object_.labels) or 'any'})"
            )
        if track is None or reason:
            reason += (
                ": no frame has a pose of it; check the candidates, annotate 'object_poses', or "
                "clear the column 'object' if there is none"
            )
            warn(reason)
            _write(output, recording, object_.name, [reason, *doubts], settings, None, [])
            return
        for doubt in track.doubts:
            warn(doubt)
        _warn_if_unsound(track, warn)
        doubts += track.doubts
        _write(output, recording, object_.name, doubts, settings, track, source.cameras)


def _absence(track: Track) -> str:
    """Reason to reject the whole track; "" = it is accepted."""
    accepted = sum(not frame.lost for frame in track.frames)
    if accepted == 0:
        return "its track is lost in every frame"
    if track.shows_nothing:
        return (
            f"the track in {accepted} of {len(track.frames)} frames is rejected, as the images do "
            f"not support it (log-likelihood ratio {track.evidence:.0f}, expected at least "
            f"{NOTHING_LOG_RATIO:.0f})"
        )
    return ""


def _write(
    output: Path,
    recording: Frames,
    name: str,
    doubts: list[str],
    settings: ObjectTrackSettings,
    track: Track | None,
    cameras: list[int],
) -> None:
    """Write the artefact; if ``track`` is None, all frames are lost.

    ``cameras``: indices of the cameras that the track used.
    """
    names = list(recording.rig.names)
    if track is None:
        datasets = absent_track(recording.num_sets, len(names))
    else:
        datasets = track_datasets(track, cameras, len(names))
    with artefacts.write(
        output,
        OBJECT_TRACK,
        settings_digest=digest(settings),
        sequence=recording.sequence,
        object=name,
        seed_frame=-1 if track is None else track.seed_frame,
        seed_source=_seed_source(track),
        doubts="; ".join(doubts),
    ) as writer:
        for key, values in datasets.items():
            writer.put(key, values)
        writer.put("camera_names", names)


def _given(poses: Sequence[ObjectPose], count: int, sequence: str) -> list[GivenPose]:
    """Convert the annotated poses for a recording of ``count`` frame sets."""
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


def _seed_source(track: Track | None) -> str:
    """Origin of the pose from which the track started, as in the artefact."""
    if track is None:
        return SOURCE_NONE
    if not track.annotated:
        return "search"
    return "annotated" if track.agrees else "annotated against the images"


def _warn_if_unsound(track: Track, warn: Callable[[str], None]) -> None:
    """Log a warning if the object has left for some time, or most frames are lost or ambiguous."""
    count = len(track.frames)
    lost, gone, ambiguous = (
        sum(getattr(frame, state) for frame in track.frames)
        for state in ("lost", "gone", "ambiguous")
    )
    if gone:
        warn(
            f"in {gone} of {count} frames no camera shows it for so long that it seems to have "
            "left; if it was there, check the candidates, or annotate 'object_poses'"
        )
    if lost > 0.5 * count:
        warn(
            f"it is lost in {lost} of {count} frames; check the candidates, or annotate "
            "'object_poses'"
        )
    elif lost + ambiguous > 0.5 * count:
        warn(
            f"of {count} frames it is lost in {lost}, and different poses explain {ambiguous} "
            "equally well; annotate 'object_poses' to decide"
        )
