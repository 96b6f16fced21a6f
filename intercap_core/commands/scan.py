"""`intercap scan`: mesh of an object from recordings of a person who turns it, or of a walk around
it."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import ExitStack
from pathlib import Path

import numpy as np
import torch
import trimesh
import yaml
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.annotation import ObjectPose
from intercap_core.body.artefact import load_model, read_parameters
from intercap_core.commands.console import print_plain, standard_console
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.output.site.scan_page import scan_page
from intercap_core.pipeline.step import run_step
from intercap_core.project import Project
from intercap_core.scan.fusion import Posed, fuse
from intercap_core.scan.handled import Chain, cloud_of, find_handled, is_still, slowest
from intercap_core.scan.multiview import register_turned
from intercap_core.scan.result import ScannedMesh, finish, simplified
from intercap_core.scan.standing import ON_PLANE_M, find_standing, posed
from intercap_core.scan.surfaces import Recording
from intercap_core.scan.volume import ClosedSurface
from intercap_core.scan.walk import HandHeld, camera_moves, follow
from intercap_core.schemas import BODY_FIT, OBJECT_TRACK
from intercap_core.stages import object_track

READ = ("frames", "detections", "scene", "person")
ROUNDS = 2  # of tracking and fusion; the second one tracks with a mesh of all frame sets
TRACKED_VOXELS, TRACKED_FACES = 100**3, 1500  # of the grid and of the mesh that is tracked
MIN_TRACKED = 10  # frame sets with a pose
# Largest standard deviation of a registered pose that the tracker takes as known. Poses of the
# tracker are off by 3 mm.
SURE_M = 0.004
MAX_CLOSED = 0.25  # largest share of the surface that no depth image measured
MIN_EXPLAINED = 0.9  # least share of the object's points on the mesh
NOTED_CLOSED = 0.03  # share of the surface from which on the page should be looked at
MAX_APART = 0.10  # largest share of the measured surface in separate parts, which noise leaves


def scan(
    project: Project,
    name: str,
    sequences: Sequence[str],
    *,
    output: Path | None = None,
    labels: Sequence[str] = (),
    improve: bool = False,
    hand_held: bool = False,
    replace: bool = False,
) -> tuple[ScannedMesh, Path, Path]:
    """Scan an object; write its mesh, its entry in objects.yaml and a page, and print a summary.

    Returns the mesh, its file and the page. Raises UserError if the file exists, or if the
    recordings do not show the object as needed.

    Args:
        name: of the object.
        sequences: recordings in which a person turns the object; the first one defines its frame.
        output: file of the mesh; default: objects/NAME.ply next to the settings.
        labels: detector classes of the object; default: those of objects.yaml, or any.
        improve: the poses are those of the object's mesh in objects.yaml, whose frame is kept.
        hand_held: the recording is of one camera that is carried around the object at rest.
        replace: overwrite an existing file.
    """
    for sequence in sequences:
        project.require_sequence(sequence)
    path = output or project.path.parent / "objects" / f"{name}.ply"
    if path.exists() and not replace:
        raise UserError(
            f"{path}: exists and is not replaced; name another file (--output), or give --replace"
        )
    entry = project.objects.get(name)
    if improve:
        _require_tracked(project, name, sequences)
    labels = tuple(labels) or (() if entry is None else entry.labels)
    places = project.results / "scan" / name
    if hand_held:
        mesh, underside = _scan_walk(project, name, sequences, improve=improve)
        _require_whole(mesh, name, sequences, underside)
    else:
        mesh = _scan_turned(project, name, sequences, labels, places, improve=improve)
        _require_whole(mesh, name, sequences)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_ply(mesh.vertices, mesh.faces, mesh.colours))
    page = places / "scan.html"
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(scan_page(name, sequences, mesh), encoding="utf-8")
    add_entry(project, name, labels, mesh, path)
    lines = [f"  {key}: {value}" for key, value in mesh.figures().items()]
    if mesh.closed_share > NOTED_CLOSED:
        lines.append("  no camera measured the orange parts of 'Measured surface' on the page")
    print_plain(standard_console(), "\n".join([f"scan of {name}", *lines]))
    return mesh, path, page


def _scan_walk(
    project: Project, name: str, sequences: Sequence[str], *, improve: bool
) -> tuple[ScannedMesh, float]:
    """Scan an object at rest around which one camera was carried.

    Returns the mesh, and the share of its surface on the plane on which it stands.
    """
    if len(sequences) > 1 or improve:
        raise UserError(
            f"--hand-held takes one sequence and not --improve, but {', '.join(sequences)} "
            f"{'with' if improve else 'without'} --improve was given; scan each walk into a file "
            "of its own (--output), and keep the best"
        )
    run_step("frames", project, sequences[0], keep=True)
    with Frames.open(project.artefact(sequences[0], "frames")) as frames:
        images = HandHeld(frames)
        walk = follow(images)
        standing = find_standing(walk, f"sequence {sequences[0]}, object {name!r}")
        part = posed(images, walk, standing)
        up = np.array([0.0, 0.0, 1.0])
        surface = fuse([part], up=up, ground=0.0)
        underside = (surface.vertices[:, 2] < ON_PLANE_M) & ~surface.measured
        areas = trimesh.triangles.area(surface.vertices[surface.faces])
        share = float(areas[underside[surface.faces].all(1)].sum() / areas.sum())
        return finish(surface, [part], up), share


def _scan_turned(
    project: Project,
    name: str,
    sequences: Sequence[str],
    labels: Sequence[str],
    places: Path,
    *,
    improve: bool,
) -> ScannedMesh:
    """Scan an object that a person turns, that rests before the rig, or that is tracked."""
    with ExitStack() as opened:
        recordings = [_open(project, sequence, labels, opened) for sequence in sequences]
        shown = [find_handled(recording, name) for recording in recordings]
        if improve:
            parts = [
                Posed(r, views, *_poses(run_step("object_track", project, sequence, keep=True)))
                for r, views, sequence in zip(recordings, shown, sequences, strict=True)
            ]
            return finish(fuse(parts), parts, None)
        return _scan(project, recordings, shown, name, labels, places)


def _require_tracked(project: Project, name: str, sequences: Sequence[str]) -> None:
    """Raise UserError unless the sequences track the object ``name``."""
    for sequence in sequences:
        if project.sequences[sequence].object != name:
            raise UserError(
                f"sequence {sequence}: its column 'object' is "
                f"{project.sequences[sequence].object or 'empty'!r}, and --improve needs the track "
                f"of {name!r}; name a sequence of this object"
            )


def _open(project: Project, sequence: str, labels: Sequence[str], opened: ExitStack) -> Recording:
    """Run the stages that a scan needs, and open their artefacts."""
    run_step("frames", project, sequence, keep=True)
    with Frames.open(project.artefact(sequence, "frames")) as frames:
        if camera_moves(frames):
            raise UserError(
                f"sequence {sequence}: its only camera moves; give --hand-held if the object rests "
                "on a table or on the floor, or let the camera stand"
            )
    for stage in (*READ[1:], "body_fit"):
        run_step(stage, project, sequence, keep=True)
    frames = opened.enter_context(Frames.open(project.artefact(sequence, "frames")))
    recording = Recording(
        frames,
        project.artefact(sequence, "detections"),
        project.artefact(sequence, "scene"),
        project.artefact(sequence, "person"),
        _skin(project, sequence),
        labels,
    )
    if not recording.cameras:
        raise UserError(
            f"sequence {sequence}: no camera measures depth, and a scan needs it; record the "
            "object with depth cameras"
        )
    return recording


def _skin(project: Project, sequence: str) -> Callable[[int], np.ndarray]:
    """Function that returns the vertices (V, 3) of the fitted body at a moment."""
    gender = project.subjects[project.sequences[sequence].subject].gender
    with artefacts.read(project.artefact(sequence, "body_fit"), BODY_FIT) as source:
        model = load_model(project.config.body_models, gender, source)
        vectors = read_parameters(source).vector()

    def vertices(t: int) -> np.ndarray:
        with torch.no_grad():
            return np.asarray(model.forward(model.parameters(vectors[[t]])).vertices[0])

    return vertices


def _scan(
    project: Project,
    recordings: Sequence[Recording],
    shown: Sequence[Chain],
    name: str,
    labels: Sequence[str],
    places: Path,
) -> ScannedMesh:
    """Track and fuse the object in turns.

    The first mesh is of the frame sets around one in which the object hardly moves and of which
    many points are seen.
    """
    clouds = {t: cloud_of(views) for t, views in shown[0].items()}
    seed = max(slowest(shown[0]), key=lambda t: len(clouds[t].points))
    extent = float(np.ptp(clouds[seed].points, axis=0).max())
    registered = register_turned(clouds, seed, max(0.004, extent / 100))
    poses: Mapping[int, np.ndarray] = {t: found.pose for t, found in registered.items()}
    up = recordings[0].zup_from_master[2, :3]  # the object's frame has the master's axes
    if len(shown) == 1 and is_still(shown[0]):
        parts = [Posed(recordings[0], shown[0], dict.fromkeys(shown[0], poses[seed]))]
        return finish(fuse(parts, up=up), parts, up)
    surface = fuse([Posed(recordings[0], shown[0], poses)], up=up, voxels=TRACKED_VOXELS)
    sure = [_pose_of(t, r.pose) for t, r in sorted(registered.items()) if r.sigma_m < SURE_M]
    for round_ in range(ROUNDS):
        entry = _tracked_entry(surface, name, labels, places)
        parts = []
        for recording, views in zip(recordings, shown, strict=True):
            known = sure if recording is recordings[0] else []
            track = _track(project, recording, entry, known, places)
            parts.append(Posed(recording, views, *_poses(track)))
            _require_poses(parts[-1], name)
        poses = {seed: poses[seed]} | dict(parts[0].poses)
        last = round_ == ROUNDS - 1
        surface = fuse(parts) if last else fuse(parts, voxels=TRACKED_VOXELS)
    return finish(surface, parts, poses[seed][:3, :3].T @ up)


def _tracked_entry(
    surface: ClosedSurface, name: str, labels: Sequence[str], places: Path
) -> ObjectEntry:
    """Entry of a simplified mesh, written to ``places``."""
    path = places / "tracked.ply"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(_ply(*simplified(surface, TRACKED_FACES)))
    return ObjectEntry(name=name, mesh=path, labels=tuple(labels))


def _pose_of(frame: int, pose: np.ndarray) -> ObjectPose:
    """A pose (4, 4) as an annotation."""
    a, b, c = Rotation.from_matrix(pose[:3, :3]).as_rotvec().tolist()
    x, y, z = pose[:3, 3].tolist()
    return ObjectPose(frame=frame, rotation_vector=(a, b, c), translation=(x, y, z))


def _track(
    project: Project,
    recording: Recording,
    entry: ObjectEntry,
    known: Sequence[ObjectPose],
    places: Path,
) -> Path:
    """Run stage ``object_track`` with the mesh of ``entry``; returns its artefact."""
    sequence = recording.frames.sequence
    output = places / f"{sequence}.h5"
    object_track.run(
        **{stage: project.artefact(sequence, stage) for stage in READ},
        output=output, object_=entry, settings=project.config.object_track, poses=known,
    )  # fmt: skip
    return output


def _poses(track: Path) -> tuple[dict[int, np.ndarray], dict[int, np.ndarray]]:
    """Poses master_from_object (4, 4) and their covariances (6, 6) by frame set.

    Frame sets in which the object is lost are left out.
    """
    with artefacts.read(track, OBJECT_TRACK) as source:
        rotation, translation = source["rotation"], source["translation"]
        covariance = source["covariance"]
        sure = ~(source["lost"] | source["gone"]) & np.isfinite(translation).all(1)
    sets = np.flatnonzero(sure).tolist()
    return {t: rigid(rotation[t], translation[t]) for t in sets}, {t: covariance[t] for t in sets}


def _require_poses(part: Posed, name: str) -> None:
    if len(part.sets) < MIN_TRACKED:
        raise UserError(
            f"sequence {part.recording.frames.sequence}: {name!r} can be followed in "
            f"{len(part.sets)} of the {len(part.surfaces)} frame sets that show it, expected at "
            f"least {MIN_TRACKED}; turn it more slowly, and hold it with few fingers"
        )


def _require_whole(
    mesh: ScannedMesh, name: str, sequences: Sequence[str], underside: float | None = None
) -> None:
    """Raise UserError if the scan is in pieces, or too much of its surface was never measured.

    ``underside``: share of the surface on which the object stood, of a hand-held camera.
    """
    closed = mesh.closed_share - (underside or 0.0)
    if closed > MAX_CLOSED:
        advice = (
            f"in which it turned by {mesh.turned_deg:.0f} degrees; at most {MAX_CLOSED:.0%} is "
            "closed. Turn it so that every side faces the cameras, also its underside, or add a "
            "recording in which it is held in another place"
            if underside is None
            else f"without its underside; at most {MAX_CLOSED:.0%} is closed. Walk around it with "
            "the camera low and high"
        )
        raise UserError(
            f"object {name!r}: no camera measured {closed:.0%} of its surface in "
            f"{', '.join(sequences)}, {advice}"
        )
    if mesh.explained_share < MIN_EXPLAINED:
        raise UserError(
            f"object {name!r}: only {mesh.explained_share:.0%} of the points that show it in "
            f"{', '.join(sequences)} are on the mesh, expected {MIN_EXPLAINED:.0%}: its poses are "
            "wrong in a part of the frames. Turn it, or walk, more slowly, hold it with few "
            "fingers, and let it stand alone for a second"
        )
    if mesh.apart_share > MAX_APART:
        raise UserError(
            f"object {name!r}: the scan of {', '.join(sequences)} is in pieces, with "
            f"{mesh.apart_share:.0%} of the measured surface apart from the largest; its parts may "
            "move against each other, or hands, shine or darkness hide what joins them. Record it "
            "closed or folded, held in another place, or covered with matt spray"
        )


def _ply(vertices: np.ndarray, faces: np.ndarray, colours: np.ndarray | None = None) -> bytes:
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
    content = mesh.export(file_type="ply")
    assert isinstance(content, bytes)
    return content


def add_entry(
    project: Project, name: str, labels: Sequence[str], mesh: ScannedMesh, path: Path
) -> None:
    """Append the object to objects.yaml, or print its entry if it cannot be appended."""
    file = project.path.parent / project.config.objects
    symmetry = mesh.symmetry.symmetry.model_dump(mode="json", exclude_defaults=True)
    content: dict[str, object] = {"mesh": os.path.relpath(path, file.parent)}
    if symmetry:
        content["symmetry"] = symmetry
    if labels:
        content["labels"] = list(labels)
    text = yaml.safe_dump({name: content}, sort_keys=False, default_flow_style=None)
    if name in project.objects:
        print_plain(
            standard_console(), f"{file} has an entry {name!r}; of this mesh it is:\n{text}"
        )
        return
    after = _appended(file.read_text(encoding="utf-8"), text)
    if after is None:
        print_plain(
            standard_console(),
            f"{file} is not a block mapping, so that nothing was added; add this entry:\n{text}",
        )
        return
    file.write_text(after, encoding="utf-8")
    print_plain(standard_console(), f"added to {file}:\n{text}")


def _appended(before: str, entry: str) -> str | None:
    """The text of a YAML mapping with one more entry; None if appending lines does not add it."""
    known = yaml.safe_load(before) or {}
    if not known:  # {} or comments alone
        before = "".join(line for line in before.splitlines(True) if line.startswith("#"))
    after = before + "\n" * (bool(before) and not before.endswith("\n")) + entry
    try:
        added = yaml.safe_load(after) == known | yaml.safe_load(entry)
    except yaml.YAMLError:
        return None
    return after if added else None
