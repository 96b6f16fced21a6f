"""Read results in BEHAVE's format: meshes and poses in frame folders, or parameters at 30 fps.

BEHAVE's body is SMPL-H, whose template and shape space differ from SMPL-X's: only its rotations
carry over. Its surface is imported: :mod:`intercap_core.joint.released.surface_fit` fits our body
to it, and the distance between the two is reported.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import POSE_COLUMNS, TRANSL
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.flags import OF_BODY, PARTS, Cause, Flags
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
from intercap_core.geometry.solve.time_series import nearest
from intercap_core.joint.released.surface_fit import fit_surfaces

# Distances between the fitted and the released body above which a frame is flagged.
FLAGGED_MEAN_M = 0.010  # mean; four times that of good fits, measured on the studio
FLAGGED_P95_M = 0.030  # 95th percentile; likewise measured on the studio

log = logging.getLogger(__name__)


class _Person(NamedTuple):
    """Released bodies of N frames."""

    frames: np.ndarray  # (N,) frame numbers
    skins: list[Skin]  # (N,) surfaces
    rotations: np.ndarray  # (N, 55, 3) rotation vectors in SMPL-X's order


def read_results(folder: Path, recording: Recording) -> Results:
    """Read the results in a sequence's folder for the frames of ``recording``, matched by time.

    The object's poses are those of the frame folders. ``object_fit_all.npz`` is read only if no
    frame folder has one: the two are different registrations and are not mixed.

    Raises UserError, naming file and entry, if a file is damaged or not in metres, if no folder
    matches the recording's times, if parameters have no meshes, or if the object's mesh is not the
    one of its poses.
    """
    total = len(recording.times)
    folders = _match_folders(folder, recording)
    reasons = np.full(total, "no result in the imported files", object)
    person = _read_person(folder, folders, recording, reasons)
    rotation, translation = np.full((total, 3, 3), np.nan), np.full((total, 3), np.nan)
    if recording.object_ is not None:
        _read_object(folder, folders, recording, recording.object_, rotation, translation)
    model = BodyModel.load(recording.body, num_betas=recording.betas)
    fitted = fit_surfaces(model, person.skins, person.rotations)
    vectors = np.full((total, fitted.vectors.shape[1]), np.nan)
    vectors[person.frames] = fitted.vectors.numpy()
    distance = np.full((total, 2), np.nan)
    distance[person.frames] = fitted.distance
    known = np.isfinite(vectors).all(1)
    has_object = bool(np.isfinite(translation).any())
    if has_object:
        posed = np.isfinite(translation).all(1)
        reasons[known & ~posed] = "no pose of the object in the imported files"
        known &= posed
    far = (distance[:, 0] > FLAGGED_MEAN_M) | (distance[:, 1] > FLAGGED_P95_M)
    lacking: list[Cause] = [
        (~known & (reasons == reason), reason, PARTS) for reason in dict.fromkeys(reasons)
    ]
    far_off = (known & far, "the body is far from the mesh that it was fitted to", OF_BODY)
    mean, p95 = 1e3 * np.mean(fitted.distance, axis=0)
    log.info(
        "sequence %s: the body was fitted to %d meshes in %s; distance %.1f mm (mean), %.1f mm "
        "(95th percentile); %d frames exceed %.0f or %.0f mm and are flagged",
        recording.sequence, len(person.frames), folder, mean, p95, int(far.sum()),
        1e3 * FLAGGED_MEAN_M, 1e3 * FLAGGED_P95_M,
    )  # fmt: skip
    pose = {name: vectors[:, columns] for name, columns in POSE_COLUMNS.items()}
    shape = slice(TRANSL.stop, TRANSL.stop + model.num_betas)
    return Results(
        path=folder,
        hands=(pose.pop("left_hand_pose"), pose.pop("right_hand_pose")),
        turns=pose,
        transl=vectors[:, TRANSL],
        betas=vectors[:, shape],
        expression=vectors[:, shape.stop :],
        rotation=rotation,
        translation=translation,
        source=f"BEHAVE, {folder.name}; body fitted to its meshes, {mean:.1f} mm from them in the "
        f"mean (95th percentile {p95:.1f} mm)",
        flags=Flags.of(total, [*lacking, far_off], has_object=has_object),
        surface_distance=distance,
    )


def _match_folders(folder: Path, recording: Recording) -> dict[int, Path]:
    """Folders of the recording's frames by frame number."""
    folders = frame_folders(folder)
    by_frame = {t: folders[at] for t, at in _match_times(recording.times, list(folders)).items()}
    if not by_frame:
        first, last = recording.times[0], recording.times[-1]
        count = f"{len(folders)} folders t<seconds>" if folders else "no folders t<seconds>"
        raise UserError(
            f"{folder}: holds {count}, none of a frame of sequence {recording.sequence!r}, which "
            f"lasts from {first:.3f} to {last:.3f} s; its body is read from "
            f"t<seconds>/{PERSON_MESH.as_posix()}: name BEHAVE's folder of this sequence, with its "
            "results unpacked"
        )
    return by_frame


def _match_times(times: np.ndarray, known: list[int]) -> dict[int, int]:
    """Return the ``known`` time (microseconds) within 5 ms of each frame, by frame number.

    Frames without such a time are missing. ``times`` (T,) are seconds. BEHAVE rounds times to
    milliseconds; its images are at least 33 ms apart.
    """
    if not known or not np.isfinite(times).all():
        return {}
    wanted = np.rint(1e6 * times).astype(np.int64)
    found = nearest(np.sort(known), wanted)
    return {int(t): int(found[t]) for t in np.flatnonzero(np.abs(found - wanted) <= 5_000)}


def _read_person(
    folder: Path, folders: Mapping[int, Path], recording: Recording, reasons: np.ndarray
) -> _Person:
    """Read surfaces and rotations. ``reasons`` (T,) receives what a frame lacks."""
    at_30_fps = person_poses_at_30_fps(folder)
    of_time = _match_times(recording.times, list(at_30_fps))
    frames: list[int] = []
    skins: list[Skin] = []
    rotations: list[np.ndarray] = []
    for t, place in sorted(folders.items()):
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
        skin = read_skin(mesh)
        if skins and np.array_equal(skin.faces, skins[-1].faces):
            skin = skin._replace(faces=skins[-1].faces)  # one copy in memory
        frames.append(t)
        skins.append(skin)
        rotations.append(rotation)
    if not frames:
        parameters = f", but {BEHAVE_PERSON}" if at_30_fps else ""
        raise UserError(
            f"{folder}: holds no t<seconds>/{PERSON_MESH.as_posix()} with a person_fit.pkl of "
            f"sequence {recording.sequence!r}{parameters}; parameters of SMPL-H mean another body "
            "than SMPL-X's, which is fitted to their meshes: unpack person_fit.ply of each frame, "
            "or write it with SMPL-H from the parameters"
        )
    return _Person(np.array(frames), skins, np.array(rotations))


def _read_object(
    folder: Path,
    folders: Mapping[int, Path],
    recording: Recording,
    entry: ObjectEntry,
    rotation: np.ndarray,
    translation: np.ndarray,
) -> None:
    """Fill in ``rotation`` (T, 3, 3) and ``translation`` (T, 3) of master_from_object.

    A released pose turns the template about the mean of its vertices and moves that to ``trans``.
    """
    files: dict[int, Path] = {}
    for t, frame in folders.items():
        fits = object_fits(frame)
        if len(fits) > 1:
            raise UserError(
                f"{frame}: holds poses of several objects, {fits[0].name} and {fits[1].name}; keep "
                "that of the sequence's object"
            )
        if fits:
            files[t] = fits[0]
    if files:
        poses = {t: read_object_pose(path) for t, path in files.items()}
    else:
        at_30_fps = object_poses_at_30_fps(folder)
        of_time = _match_times(recording.times, list(at_30_fps))
        poses = {t: at_30_fps[time] for t, time in of_time.items()}
    if not poses:
        log.warning(
            "sequence %s: %s has no <object>_fit.pkl of its frames and no %s of their times",
            recording.sequence, folder, BEHAVE_OBJECT,
        )  # fmt: skip
        return
    centre = _template_centre(folder, entry)
    for t, (angle, trans) in poses.items():
        rotation[t] = Rotation.from_rotvec(angle).as_matrix()
        translation[t] = trans - rotation[t] @ centre
    _check_placement(entry, files, rotation, translation)


def _template_centre(folder: Path, entry: ObjectEntry) -> np.ndarray:
    """Mean (3,) of the vertices of the template about which released poses turn.

    The template is ``objects/<name>/<name>_f<faces>.ply``, two folders above the sequence's, if it
    exists, else the entry's mesh. The latter may be a closed copy, whose vertices have another
    mean.
    """
    place = folder.absolute().parent.parent / "objects" / entry.name
    released = sorted(place.glob("*_f[0-9]*.ply")) if place.is_dir() else []
    template = released[0] if released else Path(entry.mesh)
    return np.asarray(read_mesh(template).vertices, np.float64).mean(axis=0)


def _check_placement(
    entry: ObjectEntry, files: Mapping[int, Path], rotation: np.ndarray, translation: np.ndarray
) -> None:
    """Raise UserError if the entry's mesh does not lie on the released ``<object>_fit.ply``.

    Closed and simplified copies of a template are less than 10 mm (95th percentile) from it; the
    limit is tuned.
    """
    meshes = {t: path.with_suffix(".ply") for t, path in files.items()}
    frames = [t for t, path in sorted(meshes.items()) if path.is_file()]
    if not frames:
        return
    own = read_mesh(Path(entry.mesh))
    surface = DistanceField(np.asarray(own.vertices), np.asarray(own.faces))
    for i in np.unique(np.linspace(0, len(frames) - 1, 5).round().astype(int)):
        t = frames[i]
        placed = np.asarray(read_mesh(meshes[t]).vertices, np.float64)
        distance = surface.distance((placed - translation[t]) @ rotation[t])
        p95 = float(np.percentile(distance, 95))
        if not p95 <= 0.010:
            raise UserError(
                f"{entry.mesh}: does not lie on {meshes[t]}, whose vertices are {1e3 * p95:.0f} "
                "mm from it, expected at most 10; the poses "
                f"belong to BEHAVE's template: name objects/{entry.name}/{entry.name}_f1000.ply "
                "(or its like) as 'mesh' in objects.yaml"
            )
