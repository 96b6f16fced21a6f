"""Comparison of each entry of a sequence's annotation with the result of the last run."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.annotate.opened import Opened
from intercap_core.annotate.sides import sides_of
from intercap_core.annotation import ANY_REGION, Annotation
from intercap_core.errors import UserError
from intercap_core.evaluation.flags import ranges
from intercap_core.flags import Flags
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.time_series import runs
from intercap_core.person.sides import images_with_stated_sides
from intercap_core.schemas import FRAMES, JOINT, PERSON, SCENE

TOUCHING = 0.5  # least probability of contact in the result, as on the timeline
_OF_CONTACT = " annotated "  # in the joint fit's reasons of flags that concern annotated contact
_STALE = "the result was computed before this edit: recompute the outdated stages"


def list_edits(opened: Opened, annotation: Annotation) -> list[dict[str, Any]]:
    """Return the entries of an annotation with the corresponding values of the result, for JSON.

    Each entry has ``section``, ``frame`` (to show), the texts ``annotated``, ``result`` and ``why``
    (reason of a difference), and ``same``: the result agrees. Entries that differ come first.
    Sections whose stage has no readable result are left out.
    """
    entries: list[dict[str, Any]] = []
    for of_section in (_contact, _poses, _floor, _subject, _left_right, _dropped):
        with contextlib.suppress(UserError):
            entries += of_section(opened, annotation)
    return sorted(entries, key=lambda entry: entry["same"])


def _entry(
    section: str, frame: int, annotated: str, result: str, *, same: bool, why: str = ""
) -> dict[str, Any]:
    return {"section": section, "frame": int(frame), "annotated": annotated, "result": result,
            "same": bool(same), "why": "" if same else why}  # fmt: skip


def _contact(opened: Opened, annotation: Annotation) -> Iterator[dict[str, Any]]:
    """Compare the annotated frames of each part with those of the result.

    Intervals of a part that follow each other without a gap are one entry.
    """
    if annotation.contact is None:
        return
    with artefacts.read(opened.paths["joint"], JOINT) as joint:
        names, probability = joint.text("region_names"), joint["contact_probability"]
        labels, reasons = joint["contact_annotated"], Flags.read(joint).reasons_of("contact")
    flags = ranges(
        ["; ".join(why for why in text.split("; ") if _OF_CONTACT in why) for text in reasons]
    )
    if not annotation.contact:
        count = int((probability.max(1) >= TOUCHING).sum())
        result = "no contact" if not count else f"contact in {count} frames"
        yield _entry("contact", 0, "no contact at all", result, same=not count, why=_STALE)
    for part in sorted({interval.part for interval in annotation.contact}):
        intervals = [interval for interval in annotation.contact if interval.part == part]
        stated = np.zeros(len(probability), bool)
        for interval in intervals:
            stated[interval.start : interval.end] = True
        column = [names.index(part)] if part != ANY_REGION else list(range(len(names)))
        found = runs(probability[:, column].max(1) >= TOUCHING)
        stale = part != ANY_REGION and not np.array_equal(labels[:, column[0]] == 1, stated)
        for first, last in runs(stated):
            overlapping = [(a, b) for a, b in found if a <= last and b >= first]
            result = ", ".join(f"{a} to {b}" for a, b in overlapping) or "no contact"
            same = overlapping == [(first, last)]
            why = "; ".join(r for a, b, r in flags if a <= last and b >= first and part in r)
            if stale:
                why = _STALE
            elif not same and not why:
                why = "uncertain end: moved by the fit to where the surfaces part"
            yield _entry(
                "contact", first, f"{part.replace('_', ' ')}: frames {first} to {last}", result,
                same=same and not why, why=why,
            )  # fmt: skip
    for first, last, reason in flags:
        if "free of contact" in reason:
            yield _entry("contact", first, f"free: frames {first} to {last}", "free, but flagged",
                         same=False, why=reason)  # fmt: skip


def _poses(opened: Opened, annotation: Annotation) -> Iterator[dict[str, Any]]:
    """Compare each annotated pose of the object with the joint fit's."""
    entry = opened.project.object_of(opened.name)
    if not annotation.poses or entry is None:
        return
    with artefacts.read(opened.paths["joint"], JOINT) as joint:
        poses = rigid(joint["rotation"], joint["translation"])
        reasons = Flags.read(joint).reasons_of("object")
    mesh = opened.cached("whole mesh", (), lambda: ObjectMesh.load(entry))
    for stated in annotation.poses:
        annotated = f"object placed in frame {stated.frame}"
        fitted = poses[stated.frame] if stated.frame < len(poses) else np.array(np.nan)
        if not np.isfinite(fitted).all():
            yield _entry("object_poses", stated.frame, annotated, "no pose", same=False, why=_STALE)
            continue
        rotation = Rotation.from_rotvec(stated.rotation_vector).as_matrix()
        given = rigid(rotation, np.array(stated.translation))
        metres = float(np.linalg.norm(mesh.centre_at(given) - mesh.centre_at(fitted)))
        degrees = float(mesh.symmetry.rotation_error_deg(fitted[:3, :3], rotation))
        limits = 3 * stated.sigma_m, 3 * stated.sigma_degrees
        why = (
            "farther than three of its standard deviations "
            f"({1e3 * stated.sigma_m:.0f} mm, {stated.sigma_degrees:.0f}°): the images contradict "
            "it, or the result was computed before this edit"
        )
        yield _entry(
            "object_poses", stated.frame, annotated,
            f"{1e3 * metres:.0f} mm and {degrees:.0f}° away",
            same=metres <= limits[0] and degrees <= limits[1],
            why="; ".join(filter(None, (why, reasons[stated.frame]))),
        )  # fmt: skip


def _floor(opened: Opened, annotation: Annotation) -> Iterator[dict[str, Any]]:
    """Compare the annotated points with the floor of stage scene."""
    if annotation.floor is None:
        return
    with artefacts.read(opened.paths["scene"], SCENE) as scene:
        source = str(scene.attributes["ground_source"])
        heights = (np.array(annotation.floor) - scene["ground_point"]) @ scene["ground_normal"]
    farthest = f"the farthest is {1e3 * np.abs(heights).max():.0f} mm from the floor"
    yield _entry(
        "floor", 0, f"{len(annotation.floor)} points of the floor", farthest,
        same=source == "annotated", why=_STALE,
    )  # fmt: skip


def _subject(opened: Opened, annotation: Annotation) -> Iterator[dict[str, Any]]:
    """Report whether the subject was chosen by the annotated points."""
    if not annotation.subject:
        return
    with artefacts.read(opened.paths["person"], PERSON) as person:
        chosen_by, doubts = str(person.attributes["chosen_by"]), str(person.attributes["doubts"])
    yield _entry(
        "subject", annotation.subject[0].frame, f"{len(annotation.subject)} points on the subject",
        "this person" if chosen_by == "named" else f"chosen otherwise ({chosen_by})",
        same=chosen_by == "named", why=doubts or _STALE,
    )  # fmt: skip


def _left_right(opened: Opened, annotation: Annotation) -> Iterator[dict[str, Any]]:
    """Report in how many images stage person swapped the limbs as annotated."""
    if not annotation.left_right:
        return
    sides = sides_of(opened)
    visible = (sides.exchanged >= 0).any(axis=2)  # (T, C)
    swapped = (sides.exchanged != 0).all(axis=2)
    for entry in annotation.left_right:
        images = images_with_stated_sides([entry], sides.cameras, sides.image_of, opened.name)
        count, agree = int((images & visible).sum()), int((images & visible & swapped).sum())
        yield _entry(
            "left_right", int(images.any(axis=1).argmax()),
            f"swapped in {entry.camera or 'all views'}: frames {entry.start} to {entry.end - 1}",
            f"swapped in {agree} of {count} images", same=agree == count,
            why="the other views contradict the annotation in the other images, or the result was "
            "computed before this edit",
        )  # fmt: skip


def _dropped(opened: Opened, annotation: Annotation) -> Iterator[dict[str, Any]]:
    """Report whether the frames to drop were dropped."""
    with artefacts.read(opened.paths["frames"], FRAMES) as frames:
        dropped = np.flatnonzero(frames["dropped"])
    stated = sorted(set(annotation.drop_frames))
    if stated or len(dropped):
        yield _entry(
            "drop_frames", stated[0] if stated else dropped[0], f"{len(stated)} frames dropped",
            f"{len(dropped)} frames dropped", same=stated == dropped.tolist(), why=_STALE,
        )  # fmt: skip
