"""Description of a sequence for the page: cameras, frames, result, and places to check.

A place is a run of frames in which the result may be wrong, with a reason and a weight; the page
lists the largest weights first. Artefacts that cannot be read are reported in ``notes``; everything
else is shown.
"""

from __future__ import annotations

import base64
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

from intercap_core import artefacts
from intercap_core.annotate.opened import Opened, object_of
from intercap_core.annotate.sides import doubts
from intercap_core.errors import UserError
from intercap_core.evaluation.flags import ranges
from intercap_core.flags import Flags
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.time_series import runs
from intercap_core.output.viewer import page as page_of
from intercap_core.output.viewer.content import gather
from intercap_core.output.viewer.page import payload, unpacked
from intercap_core.pipeline.provenance import read_manifest
from intercap_core.schemas import BODY_FIT, JOINT, METRICS, OBJECT_TRACK, PERSON, SCENE
from intercap_core.sequence_inputs import SequencePaths

DOUBTFUL = 1.5  # frames with a larger multiple of the part's stated error are doubtful
_CALL = 'showInterCap("'  # call in the page's script, before the data
_VIEWER = ("frames", "scene", "body_fit")  # stages that the viewer needs
_DRAWN = {"scene", "body_fit", "joint", "metrics", "object_track"}  # stages that the viewer draws


def describe(opened: Opened) -> dict[str, Any]:
    """Return everything but images and meshes for JSON; raises UserError without frames."""
    with opened.lock:
        with opened.images() as images:
            info: dict[str, Any] = {
                "notes": [],
                "places": [],
                "sequence": opened.name,
                "frames": images.num_sets,
                "fps": images.fps,
                "times": np.round(images.time_s, 4).tolist(),
                "master": images.master,
                "stamp": opened.stamp("frames", "scene"),
                "result": opened.stamp(),
                # by camera a text of T characters: 1 = the frame has an image, 0 = it has none
                "images": ["".join(map(str, c)) for c in images.colour_available.T.astype(int)],
                "image_of": None,
                "zup_from_master": np.eye(4)[:3].tolist(),
            }
            rig = images.rig
        broken: set[str] = set()
        for stage, (read, schema, key) in _READERS.items():
            if not opened.has(stage):
                continue
            try:
                with artefacts.read(opened.paths[stage], schema) as source:
                    count = source.describe(key)[0][0]
                    if count != info["frames"]:  # the images were read again
                        raise UserError(
                            f"{opened.paths[stage]}: has {count} frames, but {info['frames']} were "
                            f"read since; it is not shown; re-run stage {stage!r}"
                        )
                    rig = read(opened, source, info) or rig
            except UserError as error:  # another version, damaged, or of another recording
                info["notes"].append(str(error))
                broken.add(stage)
        info["cameras"] = _cameras(rig)
        info["viewer"] = all(opened.has(stage) for stage in _VIEWER) and not broken & _DRAWN
        if not opened.has("joint"):
            shown = "the sequential fits" if info["viewer"] else "only images"
            info["notes"].append(f"there is no joint result yet: {shown} are shown")
        recordings = opened.project.sequences[opened.name].recordings
        if not recordings.exists():
            info["notes"].append(
                f"{recordings}: the recordings are missing; computed results can be viewed and "
                "annotated, but a run that reads recordings fails until the table has their path"
            )
        info["places"].sort(key=lambda place: -place["weight"])
    return info


def viewer_payload(opened: Opened) -> str:
    """Return the 4D viewer's data; raises UserError without a readable body."""
    project = opened.project

    def make() -> str:
        data = _data_of_page(opened)
        if data:
            return payload(*_final_result(*unpacked(data)))
        paths = SequencePaths(
            **{stage: path for stage, path in opened.paths.items() if stage != "summary"}
        )
        content = gather(paths, project.models(opened.name))
        return payload(*_final_result(content.header, content.arrays))

    missing = [stage for stage in _VIEWER if not opened.has(stage)]
    if missing:
        raise UserError(
            f"sequence {opened.name!r} has no body yet: no result of stage {missing[0]!r}"
        )
    stages = (*_VIEWER, "joint", "metrics", "object_track", "person", "detections")
    return opened.cached("viewer", stages, make)


def _final_result(
    header: dict[str, Any], arrays: dict[str, np.ndarray]
) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the data of the final fit without the cameras' images, which the page has already."""
    shown, *others = header["versions"]
    removed = tuple(f"{name}/" for name in (*others, "truth", "images"))
    versions = {shown: header["versions"][shown]}
    kept = {name: values for name, values in arrays.items() if not name.startswith(removed)}
    return header | {"versions": versions}, kept


def _data_of_page(opened: Opened) -> str:
    """Return the viewer's data of the site's page if it was made from these artefacts, else "".

    Computing the data takes a minute for a long sequence.
    """
    page = opened.project.artefact(opened.name, "page")
    script, record = page / page_of.SCRIPT, read_manifest(page)
    if record is None or not script.is_file():
        return ""
    for stage, identity in record.artefacts.items():
        made = read_manifest(opened.paths[stage]) if opened.has(stage) else None
        if made is None or made.fingerprint != identity:
            return ""
    _, called, data = script.read_text(encoding="utf-8").rpartition(_CALL)
    return data.partition('"')[0] if called else ""


def object_payload(opened: Opened) -> str:
    """Return the object's mesh and its poses (T, 3, 4) master_from_object for the overlay.

    Raises UserError if the sequence has no object.
    """
    entry = object_of(opened.project, opened.name)

    def make() -> str:
        mesh = ObjectMesh.load(entry)
        arrays = {
            "vertices": mesh.vertices.astype(np.float32),
            "faces": mesh.faces.astype(np.uint32),
            "centre": np.asarray(mesh.centre_of_mass, np.float32),
        }
        header: dict[str, Any] = {"name": entry.name, "diameter": float(mesh.diameter)}
        for name, schema in (("joint", JOINT), ("object_track", OBJECT_TRACK)):
            try:
                with artefacts.read(opened.paths[name], schema) as source:
                    poses = rigid(source["rotation"], source["translation"])
            except artefacts.Unreadable:
                continue
            arrays[f"poses/{name}"] = poses[:, :3].astype(np.float32)
        return payload(header, arrays)

    return opened.cached("object", ("joint", "object_track"), make)


_Info = dict[str, Any]


def _scene(opened: Opened, scene: artefacts.Artefact, info: _Info) -> Rig:
    """Add transforms, image assignment and floor; returns the refined cameras."""
    info["zup_from_master"] = scene["zup_from_master"][:3].tolist()
    info["image_of"] = scene["image_of"].T.tolist()
    point, normal = scene["ground_point"], scene["ground_normal"]
    if np.isfinite(point).all():
        info["ground"] = {"point": point.tolist(), "normal": normal.tolist()}
    return Rig.from_artefact(scene)


def _person(opened: Opened, person: artefacts.Artefact, info: _Info) -> None:
    """Add the choice of the subject, and places without the subject or with doubtful sides."""
    info["subject"] = {key: str(person.attributes[key]) for key in ("chosen_by", "doubts")}
    message = "fewer than two views see the subject"
    info["places"] += _runs(person["missing"], "subject", message, 1.0)
    info["places"] += [
        _place(doubt.first, doubt.last, "sides", doubt.message, 2.0, doubt.frame)
        for doubt in doubts(opened)
    ]


def _track(opened: Opened, track: artefacts.Artefact, info: _Info) -> None:
    """Add doubts about the track, and places with a lost object or an ambiguous rotation."""
    lost = track["lost"]
    info["track"] = {
        "doubts": str(track.attributes["doubts"]), "lost": np.flatnonzero(lost).tolist()
    }  # fmt: skip
    if track.attributes["object"]:
        info["places"] += _runs(lost, "object", _LOST, 3.0)
        message = "the rotation of the object is ambiguous"
        info["places"] += _runs(track["ambiguous"], "object", message, 2.0)


def _body(opened: Opened, fit: artefacts.Artefact, info: _Info) -> None:
    """Add places in which the body fit failed."""
    info["places"] += _runs(fit["failed"], "body", "the body fit failed", 2.5)


def _joint(opened: Opened, joint: artefacts.Artefact, info: _Info) -> Rig | None:
    """Add contact; returns the cameras of the joint fit, None without a scene."""
    probability = joint["contact_probability"]
    if np.isfinite(probability).any():
        info["contact"] = {
            "regions": joint.text("region_names"), "probability": _bytes(probability)
        }  # fmt: skip
    if opened.has("scene"):
        return Rig.from_scene(opened.paths["scene"]).moved(joint["master_from_colour"])
    return None


def _metrics(opened: Opened, metrics: artefacts.Artefact, info: _Info) -> None:
    """Add stated errors, and places with flags or large stated errors."""
    if "verdict/error" in metrics:
        parts = metrics.text("verdict/part_names")
        error, by_frame = metrics["verdict/error"], metrics["verdict/error_frame"]
        silent = metrics.text("verdict/silent")
        info["verdict"] = [
            {
                "part": part,
                "mm": None if not np.isfinite(error[p]) else round(1e3 * float(error[p]), 1),
                "silent": silent[p],
            }
            for p, part in enumerate(parts)
        ]
        for p, part in enumerate(parts):
            info["places"] += _doubtful(part, float(error[p]), by_frame[p])
    lost = set(info.get("track", {}).get("lost", ()))
    info["places"] = [place for place in info["places"] if place["message"] != _LOST]  # are flagged
    for first, last, reason in ranges(Flags.read(metrics).texts()):
        weight = 3.0 if lost.intersection(range(first, last + 1)) else 1.5
        info["places"].append(_place(first, last, "flag", f"not reliable: {reason}", weight))


_LOST = "the object is lost"
_Reader = Callable[[Opened, Any, _Info], Rig | None]
# Reader of each stage, schema, and a dataset with a row per frame
_READERS: dict[str, tuple[_Reader, artefacts.Schema, str]] = {
    "scene": (_scene, SCENE, "times"),
    "person": (_person, PERSON, "missing"),
    "object_track": (_track, OBJECT_TRACK, "lost"),
    "body_fit": (_body, BODY_FIT, "failed"),
    "joint": (_joint, JOINT, "flagged"),
    "metrics": (_metrics, METRICS, "flagged"),
}


def _doubtful(part: str, error: float, by_frame: np.ndarray) -> Iterator[dict[str, Any]]:
    """Return places whose stated error exceeds ``DOUBTFUL`` times that of the whole sequence.

    Args:
        error: stated error of the part over the sequence, metres; NaN = none is stated.
        by_frame: (T,) stated error by frame, metres.
    """
    if not np.isfinite(error):
        return
    high = np.nan_to_num(by_frame) > DOUBTFUL * error
    for first, last in runs(high):
        worst = first + int(np.nanargmax(by_frame[first : last + 1]))
        ratio = float(by_frame[worst] / error)
        message = f"estimated error of the {part}: {1e3 * by_frame[worst]:.0f} mm"
        yield _place(first, last, "verdict", message, min(ratio, 3.0), worst)


def _runs(mask: np.ndarray, kind: str, message: str, weight: float) -> list[dict[str, Any]]:
    """Return a place for each run of set frames (T,)."""
    return [_place(first, last, kind, message, weight) for first, last in runs(mask)]


def _place(
    first: int, last: int, kind: str, message: str, weight: float, frame: int | None = None
) -> dict[str, Any]:
    """Return a place for JSON; the logarithm of its length is a factor of its weight.

    ``frame``: frame to show; by default the middle one.
    """
    middle = (first + last) // 2 if frame is None else frame
    return {
        "first": int(first), "last": int(last), "frame": int(middle), "kind": kind,
        "message": message, "weight": round(weight * float(np.log2(2 + last - first)), 3),
    }  # fmt: skip


def _cameras(rig: Rig) -> list[dict[str, Any]]:
    """Return lens (13,) and colour_from_master (3, 4) of each camera, None for unknown poses."""
    return [
        {
            "name": camera.name,
            "size": [camera.colour.width, camera.colour.height],
            "lens": camera.colour.parameters.tolist(),
            "pose": camera.colour_from_master[:3].tolist()
            if np.isfinite(camera.master_from_colour).all()
            else None,
        }
        for camera in rig
    ]


def _bytes(share: np.ndarray) -> str:
    """Encode shares 0..1 as bytes, row by row, in base64."""
    values = np.rint(255 * np.clip(np.nan_to_num(share), 0, 1)).astype(np.uint8)
    return base64.b64encode(values.tobytes()).decode()
