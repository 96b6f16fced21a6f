"""Errors of the joint fit with parts of the truth as input, and with a mesh that has holes.

    python -m bench.oracle [SETTINGS] [--sequences NAME ...] [--variants NAME ...]
        [--cores N] [--output results/oracle.json] [--folder results/oracle]

Stages `object_track`, `joint` and `metrics` are computed for each variant from the artefacts of a
run of SETTINGS (default: those of `make evaluate-quick`, which must have run):

    as it is                 the inputs of the run
    true cameras             true camera poses, fixed; depth biases are estimated
    true depth               true camera poses and depth biases, fixed
    true mesh                also the studio's mesh: the lower bound of the object's error
    starts at the truth      the same inputs, but the cameras may move as far as the scene's
                             covariance allows: the lower bound of the cameras' error, which is
                             due to the noise of the images
    open mesh                the given mesh with a tenth of its faces missing, in one patch and
                             scattered, also for the tracker

The body's fit from which joint starts, the masks and the time offsets are unchanged, and the
metrics use the scene and the mesh of the run. Results that are up to date by their content are
reused, so an interrupted run continues. Prints tables by object and adds figures to the JSON of
``--output`` with keys ``oracle.<variant>.<measure>``, ``oracle.<object>.<variant>.<measure>``,
``joint.extrinsics_floor_mm``, ``joint.object_..._floor_...`` and ``joint.open_mesh_ratio``. No file
of the project is overwritten.
"""

from __future__ import annotations

import json
import os
import sys
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from itertools import repeat
from multiprocessing import get_context
from pathlib import Path

os.environ.setdefault("OMP_NUM_THREADS", "1")  # read when the libraries start

import numpy as np
import trimesh
from scipy.spatial import cKDTree

from bench.again import artefacts_of, check_run, compute_once, slug, variants_parser
from bench.command import exit_on_user_error, replace_figures
from bench.evaluate.part import number
from bench.evaluate.sequences import areas
from intercap_core import artefacts
from intercap_core.artefacts import Artefact
from intercap_core.commands.console import ListTable, standard_console
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.geometry.camera.transforms import invert
from intercap_core.geometry.rigid.contact_vertices import contact_list
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.joint.cameras import BIAS
from intercap_core.project import Project, load_project
from intercap_core.schemas import SCENE, TRUTH

REMOVED_SHARE = 0.1  # of the faces
# Faces in each small hole. Half of the removed faces are one patch, the others such holes;
# with six faces they have more than the four edges up to which loading a mesh closes a hole.
CLUMP_FACES = 6


def write_true_scene(scene: Path, truth: Path, output: Path, *, biases: bool, held: bool) -> Path:
    """Write ``scene`` with the true camera poses, and the true depth biases where ``biases``.

    Poses are relative to the scene's master, whose pose is unchanged. Cameras are matched by name;
    values that the scene does not know (no images, no depth) stay unknown. With ``held`` the
    covariance of the true values is 0; otherwise it stays as the scene states it. Raises UserError
    where the truth lacks a camera or states no depth bias.
    """
    with artefacts.read(scene, SCENE) as found, artefacts.read(truth, TRUTH) as true:
        poses, bias = _true_cameras(found, true, biases)
        covariance = found["camera_covariance"]
        if held:
            known = slice(None) if biases else slice(0, BIAS)
            covariance[:, known] = 0
            covariance[:, :, :, known] = 0
        new = {"master_from_colour": poses, "depth_bias": bias, "camera_covariance": covariance}
        keys, attributes = found.keys(), {n: found.attributes[n] for n in SCENE.attributes}
        digest = str(found.attributes["settings_digest"])
        with artefacts.write(output, SCENE, settings_digest=digest, **attributes) as writer:
            for key in keys:
                writer.put(key, new[key] if key in new else found[key])
    return output


def _true_cameras(found: Artefact, true: Artefact, biases: bool) -> tuple[np.ndarray, np.ndarray]:
    """Poses (C, 4, 4) and depth biases (C,) of the scene's cameras."""
    names, true_names = found.text("camera_names"), true.text("camera_names")
    strangers = sorted(set(names) - set(true_names))
    if strangers:
        raise UserError(
            f"{true.path}: knows no camera {strangers[0]!r}, which {found.path} has; it is the "
            "truth of another recording"
        )
    order = [true_names.index(name) for name in names]
    master = names.index(str(found.attributes["master"]))
    given, bias = found["master_from_colour"], found["depth_bias"]
    poses = true["master_from_colour"][order]
    poses = given[master] @ invert(poses[master]) @ poses
    poses = np.where(np.isfinite(given), poses, given)
    if biases:
        if "depth_bias" not in true:
            raise UserError(f"{true.path}: has no depth bias; make the recording again")
        bias = np.where(np.isfinite(bias), true["depth_bias"][order], bias)
    return poses, bias


def write_true_mesh(truth: Path, output: Path, entry: ObjectEntry) -> ObjectEntry:
    """The object with the mesh that the studio drew, written to ``output`` (.ply)."""
    with artefacts.read(truth, TRUTH) as true:
        vertices, faces = true["object_vertices"], true["object_faces"]
    return _write_mesh(vertices, faces, output, entry)


def write_open_mesh(output: Path, entry: ObjectEntry, *, seed: int = 0) -> ObjectEntry:
    """The object with a tenth of its faces missing, written to ``output`` (.ply)."""
    mesh = ObjectMesh.load(entry)
    kept = ~removed_faces(mesh.vertices, mesh.faces, seed)
    return _write_mesh(mesh.vertices, mesh.faces[kept], output, entry)


def removed_faces(vertices: np.ndarray, faces: np.ndarray, seed: int) -> np.ndarray:
    """Mask (F,) of the faces to remove: one patch and scattered clumps."""
    rng = np.random.default_rng(seed)
    mesh = trimesh.Trimesh(vertices, faces, process=False, validate=False)
    neighbours: list[list[int]] = [[] for _ in faces]
    for a, b in mesh.face_adjacency:
        neighbours[a].append(int(b))
        neighbours[b].append(int(a))
    share = mesh.area_faces / mesh.area_faces.sum()
    removed = np.zeros(len(faces), bool)
    total = round(REMOVED_SHARE * len(faces))
    _remove_patch(removed, neighbours, int(rng.choice(len(faces), p=share)), total // 2)
    while (left := total - int(removed.sum())) > 0:
        first = int(rng.choice(np.flatnonzero(~removed)))
        _remove_patch(removed, neighbours, first, min(CLUMP_FACES, left))
    return removed


def _remove_patch(removed: np.ndarray, neighbours: list[list[int]], first: int, count: int) -> None:
    """Remove up to ``count`` faces around ``first``, in the order of a breadth-first search."""
    waiting, seen = [first], {first}
    for face in waiting:
        if count <= 0:
            return
        count -= not removed[face]
        removed[face] = True
        new = [other for other in neighbours[face] if other not in seen]
        waiting += new
        seen.update(new)


def _write_mesh(
    vertices: np.ndarray, faces: np.ndarray, output: Path, entry: ObjectEntry
) -> ObjectEntry:
    """The object with this mesh in ``output``, likely-contact vertices at the same places."""
    output.parent.mkdir(parents=True, exist_ok=True)
    trimesh.Trimesh(vertices, faces, process=False, validate=False).export(output)
    listed = None
    if entry.contact_vertices is not None:
        given = ObjectMesh.load(entry)
        _, ids = cKDTree(vertices).query(given.vertices[given.contact_vertices])
        listed = output.with_suffix(".contact.json")
        listed.write_text(json.dumps(contact_list(np.unique(ids), vertices)), encoding="utf-8")
    return entry.model_copy(update={"mesh": output, "contact_vertices": listed})


STAGES = ("object_track", "joint", "metrics")
AS_IT_IS, TRUE_MESH, FREE, OPEN = "as it is", "true mesh", "starts at the truth", "open mesh"


@dataclass(frozen=True)
class Variant:
    """Inputs that are replaced by the truth."""

    cameras: bool = False
    """True camera poses."""
    biases: bool = False
    """True depth biases."""
    mesh: str = ""
    """"true" or "open"; empty: the run's mesh."""
    held: bool = True
    """Cameras and biases are fixed at these inputs."""


VARIANTS = {
    AS_IT_IS: Variant(),
    "true cameras": Variant(cameras=True),
    "true depth": Variant(cameras=True, biases=True),
    TRUE_MESH: Variant(cameras=True, biases=True, mesh="true"),
    FREE: Variant(cameras=True, biases=True, mesh="true", held=False),
    OPEN: Variant(mesh="open"),
}
# Figures by their names in the tables; "tracked" is after `object_track`, all else after `joint`.
MEASURES = {
    "tracked mm": "tracked_translation_mm",
    "object mm": "object_translation_mm",
    "p95": "object_translation_p95_mm",
    "turn deg": "object_rotation_deg",
    "p95 ": "object_rotation_p95_deg",
    "cameras mm": "extrinsics_mm",
    "body mm": "body_pve_mm",
    "penetration mm": "penetration_mean_mm",
}
# What ``joint.open_mesh_..._ratio`` compares; the first is `joint.open_mesh_ratio` itself.
RATIOS = {
    "": "object_translation_mm",
    "p95_": "object_translation_p95_mm",
    "body_": "body_pve_mm",
    "penetration_": "penetration_mean_mm",
}
FLOORS = {
    "object_translation_floor_mm": "object_translation_mm",
    "object_translation_p95_floor_mm": "object_translation_p95_mm",
    "object_rotation_floor_deg": "object_rotation_deg",
}
# Figures of these names are this command's: what an earlier run left of them goes.
_OWN = (
    "oracle.",
    "joint.open_mesh_",
    *(f"joint.{key}" for key in ("extrinsics_floor_mm", *FLOORS)),
)
Figures = dict[str, float]
Found = dict[str, dict[str, SequenceMetrics]]  # by variant and sequence


def compute_variants(
    settings: Path,
    sequences: Sequence[str],
    folder: Path,
    variants: Sequence[str],
    cores: int,
) -> Found:
    """Compute the variants, ``cores`` sequences at a time; returns their metrics.

    Raises UserError if a sequence or variant is unknown, or has no truth or artefacts.
    """
    project = load_project(settings)
    names = list(sequences or project.sequences)
    check_run(project, names, STAGES, variants, VARIANTS)
    given = (repeat(settings), names, repeat(folder), repeat(tuple(variants)))
    context = get_context("spawn")  # numerical libraries keep threads that a fork would lose
    with ProcessPoolExecutor(min(cores, len(names)), mp_context=context) as pool:
        every = list(pool.map(_compute_sequence, *given))
    return {
        variant: {
            name: SequenceMetrics.read(paths[variant])
            for name, paths in zip(names, every, strict=True)
        }
        for variant in variants
    }


def _compute_sequence(
    settings: Path, sequence: str, folder: Path, variants: Sequence[str]
) -> dict[str, Path]:
    """Metrics of one sequence by variant."""
    project = load_project(settings)
    tracks: dict[tuple[bool, bool, str], Path] = {}
    found = {}
    for name in variants:
        variant = VARIANTS[name]
        begin = time.perf_counter()
        place = folder / sequence / slug(name)
        plain = artefacts_of(project, sequence)
        given, scene = _replace_inputs(project, sequence, variant, place)
        paths = plain | {"scene": scene}
        # Whether cameras are held is nothing to the tracker.
        key = variant.cameras, variant.biases, variant.mesh
        if key not in tracks:
            output = place / "object_track.h5"
            tracks[key] = compute_once("object_track", given, sequence, paths, output)
        paths["object_track"] = tracks[key]
        paths["joint"] = compute_once("joint", given, sequence, paths, place / "joint.h5")
        found[name] = compute_once(
            "metrics", project, sequence, paths | {"scene": plain["scene"]}, place / "metrics.h5"
        )
        print(f"{sequence}, {name}: {time.perf_counter() - begin:.0f} s", file=sys.stderr)
    return found


def _replace_inputs(
    project: Project, sequence: str, variant: Variant, place: Path
) -> tuple[Project, Path]:
    """The project with the variant's mesh, and the scene with its cameras."""
    row = project.sequences[sequence]
    assert row.truth is not None
    scene, entry = project.artefact(sequence, "scene"), project.objects[row.object]
    if variant.cameras:
        scene = write_true_scene(
            scene, row.truth, place / "scene.h5", biases=variant.biases, held=variant.held
        )
    if variant.mesh == "true":
        entry = write_true_mesh(row.truth, place / "mesh.ply", entry)
    elif variant.mesh == "open":
        entry = write_open_mesh(place / "mesh.ply", entry)
    return replace(project, objects={**project.objects, row.object: entry}), scene


def by_variant(found: Found) -> dict[str, Figures]:
    """The figures ``MEASURES`` of each variant over all its sequences."""
    return {variant: _measured(list(some.values())) for variant, some in found.items()}


def by_object(found: Found) -> dict[str, dict[str, Figures]]:
    """The figures ``MEASURES`` of each variant by object."""
    names = sorted({s.object_ for some in found.values() for s in some.values()})
    return {
        name: {
            variant: _measured([s for s in some.values() if s.object_ == name])
            for variant, some in found.items()
        }
        for name in names
    }


def _measured(sequences: Sequence[SequenceMetrics]) -> Figures:
    found = areas(sequences)
    tracked = {f"tracked_{key}": value for key, value in found["object_track"].items()}
    every = found["joint"] | tracked
    wanted = (*MEASURES.values(), "extrinsics_scene_mm")
    return {key: float(value) for key in wanted if (value := every.get(key)) is not None}


def joint_figures(found: Found) -> Figures:
    """Lower bounds of the joint stage's errors, and error ratios of the open to the closed mesh.

    The ratio is of the means of the sequences' own figures; the worst sequence's ratio is added.
    """
    over_all = by_variant(found)
    floors = {key: over_all.get(TRUE_MESH, {}).get(measure) for key, measure in FLOORS.items()}
    floors["extrinsics_floor_mm"] = over_all.get(FREE, {}).get("extrinsics_mm")
    bounds = {key: value for key, value in floors.items() if value is not None}
    for what, measure in RATIOS.items():
        closed, opened = (_of_each(found.get(name, {}), measure) for name in (AS_IT_IS, OPEN))
        both = [name for name in closed if name in opened and closed[name] > 0]
        if both:
            whole = sum(closed[name] for name in both)
            bounds[f"open_mesh_{what}ratio"] = sum(opened[name] for name in both) / whole
        if both and not what:
            bounds["open_mesh_worst_ratio"] = max(opened[name] / closed[name] for name in both)
    return bounds


def _of_each(sequences: Mapping[str, SequenceMetrics], measure: str) -> Figures:
    """The figure of each sequence that has it."""
    measured = {name: _measured([metrics]) for name, metrics in sequences.items()}
    return {
        name: some[measure]
        for name, some in measured.items()
        if np.isfinite(some.get(measure, np.nan))
    }


def flat(found: Found) -> Figures:
    """All keys that are written."""
    keys = {f"joint.{key}": value for key, value in joint_figures(found).items()}
    for variant, some in by_variant(found).items():
        keys |= {f"oracle.{slug(variant)}.{key}": value for key, value in some.items()}
    for name, variants in by_object(found).items():
        for variant, some in variants.items():
            keys |= {f"oracle.{name}.{slug(variant)}.{key}": value for key, value in some.items()}
    return {key: round(value, 4) for key, value in keys.items() if np.isfinite(value)}


def print_tables(found: Found) -> None:
    """A table of all sequences and one of each object, and the figures of the joint stage."""
    console = standard_console()
    for title, variants in {"all": by_variant(found), **by_object(found)}.items():
        table = ListTable("put in", *MEASURES, title=title)
        for variant, some in variants.items():
            cells = (number(some.get(key), 2) for key in MEASURES.values())
            table.add_row(variant, *cells)
        console.print(table)
    for key, value in joint_figures(found).items():
        console.print(f"joint.{key} {value:.3f}", highlight=False)


def main(arguments: Sequence[str] | None = None) -> None:
    """Read the command line, compute, print and write."""
    parser = variants_parser(__doc__, VARIANTS, "oracle")
    parser.add_argument("--cores", type=int, default=0, help="sequences at a time; 0: all cores")
    options = parser.parse_args(arguments)
    with exit_on_user_error():
        cores = options.cores or len(os.sched_getaffinity(0))
        found = compute_variants(
            options.settings, options.sequences, options.folder, options.variants, cores
        )
        print_tables(found)
        replace_figures(options.output, flat(found), _OWN)
    print(options.output)


if __name__ == "__main__":
    main()
