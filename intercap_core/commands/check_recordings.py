"""Every recording of a sequence looked into, cheaply: what would be lost without a word later."""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import NamedTuple

import numpy as np

from intercap_core.config import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections import candidate_files, keypoint_files
from intercap_core.formats.recordings.containers import RecordingPreview
from intercap_core.formats.recordings.source import RecordingLayout

# Of what the others last, or of what a file or its rate states: below the first a recording is of
# little use and a problem, below the second it is noted.
SHORT, SHORTER = 0.5, 0.95
SPARSE = 0.9  # of the images that a rate and a duration give; every recording loses a few
PARTLY_DETECTED = 0.9  # of a camera's images
COUNTED_BYTES = 64 << 20  # a larger file of detections is not read through: half a second each
_IMAGE_ID = re.compile(rb'"(?:image_id|file_name)"\s*:\s*("[^"]*"|[^,}\s]+)')


class Seen(NamedTuple):
    """One camera's recording that opened: its preview, and what the calibration expects."""

    source: Path
    size: tuple[int, int]
    fps: float
    depth: bool
    truncated: bool
    preview: RecordingPreview


@dataclass
class Looked:
    """What a look at one sequence's recordings shows; ``summary`` in one line."""

    summary: str = ""
    faults: list[str] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)


def look_at_recordings(
    row: SequenceEntry, layout: RecordingLayout, cameras: Iterable[str], without_depth: bool = False
) -> Looked:
    """Open each of ``cameras``, which have a recording and a pose, and look at it.

    Faults cost a camera or most of it; notes are survived. ``without_depth``: no depth is used.
    """
    looked, seen = Looked(), {}
    for name in cameras:
        try:
            with layout.open(name) as recording:
                lens, depth = recording.camera.colour, recording.camera.depth
                seen[name] = Seen(
                    recording.source,
                    (lens.width, lens.height),
                    recording.fps,
                    depth is not None and not without_depth,
                    recording.truncated,
                    recording.preview(),
                )
        except UserError as error:
            looked.faults.append(str(error))
        except OSError as error:
            looked.faults.append(
                f"{layout.sequence.recordings}: camera {name} cannot be read "
                f"({error.strerror or error}); copy its recording again"
            )
    usual = _usual(seen)
    for name, one in seen.items():
        _judge(looked, row, name, one, usual.get(name))
        looked.notes += _notes_of_detections(row, name, one.preview.images)
    looked.summary = _summary(row, seen)
    return looked


def _usual(seen: dict[str, Seen]) -> dict[str, float]:
    """How long the others of each camera last, seconds; the longest half, as most may be cut."""
    lasting = {name: one.preview.seconds for name, one in seen.items()}
    usual = {}
    for name in lasting:
        others = sorted(s for other, s in lasting.items() if other != name and s is not None)
        if others:
            usual[name] = float(np.median(others[len(others) // 2 :]))
    return usual


def _judge(looked: Looked, row: SequenceEntry, name: str, one: Seen, usual: float | None) -> None:
    source, found = one.source, one.preview
    if found.size is None:
        looked.faults.append(
            f"{source}: camera {name} has no image that can be read, expected "
            f"{one.size[0]}x{one.size[1]}; copy or record it again"
        )
    elif found.size != one.size:
        looked.faults.append(
            f"{source}: camera {name}'s images are {found.size[0]}x{found.size[1]}, "
            f"{row.calibration} is for {one.size[0]}x{one.size[1]}: the camera would be left out; "
            "give the calibration of this resolution"
        )
    looked.notes += [f"{source}: camera {name} {fault}; copy it again" for fault in found.faults]
    images = str(found.images) if found.counted else f"about {found.images or 'no'}"
    if found.share < SHORTER or one.truncated:
        there = f"about {found.share:.0%} of what its head states" if found.share < 1 else "no end"
        text = (
            f"{source}: camera {name}'s recording is cut off: it has {there} ({images} images); "
            "copy or record it again"
        )
        (looked.faults if found.share < SHORT else looked.notes).append(text)
    if found.seconds is not None and usual is not None and found.share >= SHORTER:
        shorter = found.seconds + 1 / one.fps < SHORTER * usual
        if shorter:
            text = (
                f"{source}: camera {name} lasts {found.seconds:.1f} s ({images} images), the "
                f"other cameras {usual:.1f} s; copy it again, or leave it out (frames.cameras)"
            )
            most = found.seconds < SHORT * usual
            (looked.faults if most else looked.notes).append(text)
    if found.counted and found.seconds is not None and found.images is not None:
        expected = round(found.seconds * one.fps) + 1
        if found.images < SPARSE * expected:
            looked.notes.append(
                f"{source}: camera {name} has {found.images} images in {found.seconds:.1f} s, "
                f"expected about {expected} at {one.fps:g} a second; add the missing ones, or "
                "correct fps or the timestamps"
            )


def _notes_of_detections(row: SequenceEntry, name: str, images: int | None) -> list[str]:
    """Where a camera's keypoints or candidates speak of other images than it has."""
    counted = {
        "keypoints": row.keypoints and _count(
            keypoint_files.camera_file(row.keypoints, name),
            keypoint_files.image_files(row.keypoints / name),
        ),
        "candidates": row.candidates and _count(
            candidate_files.camera_file(row.candidates, name),
            candidate_files.image_files(row.candidates, name),
        ),
    }  # fmt: skip
    notes = []
    for kind, count in counted.items():
        if not images or not count:
            continue
        folder = getattr(row, kind)
        if count < PARTLY_DETECTED * images:
            notes.append(
                f"{folder}: {kind} of camera {name} speak of {count} of its {images} images; run "
                "the detector on all of them"
            )
        elif count * PARTLY_DETECTED > images:
            notes.append(
                f"{folder}: {kind} of camera {name} speak of {count} images, it has {images}; they "
                "may be another recording's, or the recording is cut"
            )
    return notes


def _count(whole: Path | None, files: list[Path]) -> int | None:
    """How many images one camera's detections speak of; None = not known."""
    if whole is None:
        return len(files) or None
    if whole.stat().st_size > COUNTED_BYTES:
        return None
    return len(set(_IMAGE_ID.findall(whole.read_bytes()))) or None


def _summary(row: SequenceEntry, seen: dict[str, Seen]) -> str:
    if not seen:
        return ""
    sizes = sorted({size for one in seen.values() if (size := one.preview.size) is not None})
    images = [one.preview.images for one in seen.values() if one.preview.images is not None]
    seconds = [one.preview.seconds for one in seen.values() if one.preview.seconds is not None]
    depth = sum(one.depth for one in seen.values())
    detected = [
        f"{kind} of {count}"
        for kind, has in (
            ("keypoints", lambda name, f: keypoint_files.has_keypoints(f, name)),
            ("candidates", lambda name, f: candidate_files.has_candidates(f, name, row.layout)),
        )
        if (folder := getattr(row, kind)) is not None
        and (count := sum(has(name, folder) for name in seen))
    ]
    parts = [
        f"{len(seen)} cameras" if len(seen) > 1 else "1 camera",
        ", ".join(f"{width}x{height}" for width, height in sizes),
        f"{_span(images, '{:d}')} images" if images else "",
        f"{_span(seconds, '{:.1f}')} s" if seconds else "",
        f"depth of {depth}" if depth else "no depth",
        *detected,
    ]
    return "; ".join(part for part in parts if part)


def _span(values: list, form: str) -> str:
    low, high = form.format(min(values)), form.format(max(values))
    return low if low == high else f"{low} to {high}"
