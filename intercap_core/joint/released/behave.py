"""Results as BEHAVE has them: meshes and poses in the folders of frames, or poses at 30 fps.

Their body is SMPL-H's: another template and other shape directions than those of a file in SMPL-X's
format, so that no parameter but its rotations means the same. What is imported is its surface, to
which our body is fitted (:mod:`intercap_core.joint.released.surface_fit`), and how far the two are
apart is told.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import POSE_BLOCKS, TRANSL
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.behave import frame_folders
from intercap_core.formats.released import (
    BEHAVE_OBJECT,
    BEHAVE_PERSON,
    PERSON_MESH,
    Recording,
    Results,
    Skin,
    object_fits,
    object_poses_at_30_fps,
    person_poses_at_30_fps,
    read_object_pose,
    read_person_pose,
    read_skin,
)
from intercap_core.geometry.rigid.distance import DistanceField
from intercap_core.geometry.rigid.mesh import read_mesh
from intercap_core.joint.released.surface_fit import fit_surfaces

# Names of BEHAVE's folders round times to milliseconds; images come 33 ms apart at the least.
SAME_TIME_US = 5_000
# Beyond these a frame is flagged: four times what it ends at otherwise (see SURFACE_SIGMA_M).
FAR_MEAN_M = 0.010
FAR_MOST_M = 0.030  # 95th percentile
# 95th percentile of how far the released placement is from ours, beyond which the mesh is another
# one than the poses belong to. Closed and simplified copies of a template are nearer.
OTHER_MESH_M = 0.010
CHECKED_FRAMES = 5

log = logging.getLogger(__name__)
_FAR = "the body is far from the mesh that it was fitted to"


class _Person(NamedTuple):
    """Frames (N,) that have a surface: their numbers, surfaces, and rotations (N, 55, 3)."""

    frames: np.ndarray
    skins: list[Skin]
    rotations: np.ndarray


def read_results(folder: Path, recording: Recording) -> Results:
    """Results in a sequence's folder: those of the frames that the recording has, by their times.

    Meshes of the person are in the folders of frames, ``t0003.000/person/fit02``; the object's
    poses there too, or where no frame has one in ``object_fit_all.npz``. The two are of different
    registrations and are not mixed. Raises UserError naming file and entry where something is
    broken or in other units, where nothing is of this recording's times, where there are parameters
    without meshes, and where the object's mesh is not that of its poses.
    """
    total = len(recording.times)
    found = _of_frames(folder, recording)
    reasons = np.full(total, "no result in the imported files", object)
    person = _person(folder, found, recording, reasons)
    rotation, translation = np.full((total, 3, 3), np.nan), np.full((total, 3), np.nan)
    if recording.object_ is not None:
        _object(folder, found, recording, rotation, translation)
    model = BodyModel.load(recording.body, num_betas=recording.betas)
    fitted = fit_surfaces(model, person.skins, person.rotations)
    vectors = np.full((total, fitted.vectors.shape[1]), np.nan)
    vectors[person.frames] = fitted.vectors.numpy()
    distance = np.full((total, 2), np.nan)
    distance[person.frames] = fitted.distance
    known = np.isfinite(vectors).all(1)
    if np.isfinite(translation).any():
        posed = np.isfinite(translation).all(1)
        reasons[known & ~posed] = "no pose of the object in the imported files"
        known &= posed
    far = (distance[:, 0] > FAR_MEAN_M) | (distance[:, 1] > FAR_MOST_M)
    reasons[known] = np.where(far[known], _FAR, "")
    mean, most = 1e3 * np.mean(fitted.distance, axis=0)
    log.info(
        "sequence %s: the body was fitted to %d meshes in %s, %.1f mm beside them in the mean, "
        "%.1f mm in the 95th percentile; %d frames are beyond %.0f or %.0f mm and flagged",
        recording.sequence, len(person.frames), folder, mean, most, int(far.sum()),
        1e3 * FAR_MEAN_M, 1e3 * FAR_MOST_M,
    )  # fmt: skip
    pose, start = {}, 0
    for name, size in POSE_BLOCKS:
        pose[name], start = vectors[:, start : start + size], start + size
    hands = pose.pop("left_hand_pose"), pose.pop("right_hand_pose")
    shape = slice(TRANSL.stop, TRANSL.stop + model.num_betas)
    return Results(
        folder,
        pose,
        hands,
        vectors[:, TRANSL],
        vectors[:, shape],
        vectors[:, shape.stop :],
        rotation,
        translation,
        f"BEHAVE, {folder.name}; body fitted to its meshes, {mean:.1f} mm beside them "
        f"(95th percentile {most:.1f} mm)",
        list(reasons),
        distance,
    )


def _of_frames(folder: Path, recording: Recording) -> dict[int, Path]:
    """The folders of the recording's frames: path by number."""
    folders = frame_folders(folder)
    found = {
        t: folders[time]
        for t, time in _at_times(recording.times, list(folders)).items()
    }  # fmt: skip
    if not found:
        span = recording.times[0], recording.times[-1]
        held = f"{len(folders)} folders t<seconds>" if folders else "no folders t<seconds>"
        raise UserError(
            f"{folder}: holds {held}, none of a frame of sequence {recording.sequence!r}, which "
            f"lasts from {span[0]:.3f} to {span[1]:.3f} s; its body is read from "
            f"t<seconds>/{PERSON_MESH.as_posix()}: name BEHAVE's folder of this sequence, with its "
            "results unpacked"
        )
    return found


def _at_times(times: np.ndarray, known: list[int]) -> dict[int, int]:
    """Of ``known`` times, microseconds, that of each frame: by number, where there is one."""
    if not known or not np.isfinite(times).all():
        return {}
    ordered = np.sort(np.array(known))
    wanted = np.rint(1e6 * times).astype(np.int64)
    right = np.clip(np.searchsorted(ordered, wanted), 0, len(ordered) - 1)
    left = np.maximum(right - 1, 0)
    nearer = np.abs(ordered[left] - wanted) < np.abs(ordered[right] - wanted)
    nearest = ordered[np.where(nearer, left, right)]
    same = np.abs(nearest - wanted) <= SAME_TIME_US
    return {int(t): int(nearest[t]) for t in np.flatnonzero(same)}


def _person(
    folder: Path, found: Mapping[int, Path], recording: Recording, reasons: np.ndarray
) -> _Person:
    """Surfaces and rotations of the frames that have both; the others' ``reasons`` are filled."""
    at_30_fps = person_poses_at_30_fps(folder)
    of_time = _at_times(recording.times, list(at_30_fps))
    frames: list[int] = []
    skins: list[Skin] = []
    rotations: list[np.ndarray] = []
    for t, place in sorted(found.items()):
        mesh = place / PERSON_MESH
        pose = mesh.with_suffix(".pkl")
        if not mesh.is_file():
            reasons[t] = f"no {mesh.name} in the imported files"
            continue
        if pose.is_file():
            rotation = read_person_pose(pose)
        elif t in of_time:
            rotation = at_30_fps[of_time[t]]
        else:
            reasons[t] = f"no {pose.name} in the imported files"
            continue
        frames.append(t)
        skins.append(_sharing_faces(read_skin(mesh), skins))
        rotations.append(rotation)
    if not frames:
        parameters = f", but {BEHAVE_PERSON}" if at_30_fps else ""
        raise UserError(
            f"{folder}: holds no t<seconds>/{PERSON_MESH.as_posix()} beside a person_fit.pkl of "
            f"sequence {recording.sequence!r}{parameters}; parameters of SMPL-H mean another body "
            "than SMPL-X's, which is fitted to their meshes: unpack person_fit.ply of each frame, "
            "or write it with SMPL-H from the parameters"
        )
    return _Person(np.array(frames), skins, np.array(rotations))


def _sharing_faces(skin: Skin, others: list[Skin]) -> Skin:
    """The same skin, with the last one's faces where they are equal: memory."""
    if others and np.array_equal(skin.faces, others[-1].faces):
        return skin._replace(faces=others[-1].faces)
    return skin


def _object(
    folder: Path,
    found: Mapping[int, Path],
    recording: Recording,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> None:
    """Fill in master_from_object, (T, 3, 3) and (T, 3), where there is a pose.

    A pose turns the template about the mean of its vertices and brings that to ``trans``.
    """
    entry = recording.object_
    assert entry is not None
    fits = {t: _object_fit(place) for t, place in found.items()}
    files = {t: path for t, path in fits.items() if path is not None}
    if files:
        poses = {t: read_object_pose(path) for t, path in files.items()}
    else:
        at_30_fps = object_poses_at_30_fps(folder)
        of_time = _at_times(recording.times, list(at_30_fps))
        poses = {t: at_30_fps[time] for t, time in of_time.items()}
    if not poses:
        log.warning(
            "sequence %s: %s has no <object>_fit.pkl of its frames and no %s of their times",
            recording.sequence, folder, BEHAVE_OBJECT,
        )  # fmt: skip
        return
    middle = _middle(folder, entry)
    for t, (angle, trans) in poses.items():
        rotation[t] = Rotation.from_rotvec(angle).as_matrix()
        translation[t] = trans - rotation[t] @ middle
    _check_placement(entry, files, rotation, translation)


def _object_fit(frame: Path) -> Path | None:
    files = object_fits(frame)
    if len(files) > 1:
        raise UserError(
            f"{frame}: holds poses of several objects, {files[0].name} and {files[1].name}; keep "
            "that of the sequence's object"
        )
    return files[0] if files else None


def _middle(folder: Path, entry: ObjectEntry) -> np.ndarray:
    """The point (3,) of the mesh that poses turn about: the mean of the template's vertices.

    The template is the data set's own, ``objects/<name>/<name>_f<faces>.ply`` two folders above
    that of the sequence, where it is there: the entry's mesh may be a closed copy of it, whose
    vertices have another mean.
    """
    place = folder.absolute().parent.parent / "objects" / entry.name
    released = sorted(place.glob("*_f[0-9]*.ply")) if place.is_dir() else []
    template = released[0] if released else Path(entry.mesh)
    return np.asarray(read_mesh(template).vertices, np.float64).mean(axis=0)


def _check_placement(
    entry: ObjectEntry,
    files: Mapping[int, Path],
    rotation: np.ndarray,
    translation: np.ndarray,
) -> None:
    """Raise UserError where the entry's mesh does not lie on the released ``<object>_fit.ply``."""
    meshes = {t: path.with_suffix(".ply") for t, path in files.items()}
    there = [t for t, path in sorted(meshes.items()) if path.is_file()]
    if not there:
        return
    own = read_mesh(Path(entry.mesh))
    surface = DistanceField(np.asarray(own.vertices), np.asarray(own.faces))
    chosen = np.linspace(0, len(there) - 1, CHECKED_FRAMES).round().astype(int)
    for t in {there[i] for i in chosen}:
        placed = np.asarray(read_mesh(meshes[t]).vertices, np.float64)
        away = surface.distance((placed - translation[t]) @ rotation[t])
        apart = float(np.percentile(away, 95))
        if not apart <= OTHER_MESH_M:
            raise UserError(
                f"{entry.mesh}: does not lie on {meshes[t]}, whose vertices are {1e3 * apart:.0f} "
                f"mm from it, expected at most {1e3 * OTHER_MESH_M:.0f}; the poses "
                f"belong to BEHAVE's template: name objects/{entry.name}/{entry.name}_f1000.ply "
                "(or its like) as 'mesh' in objects.yaml"
            )
