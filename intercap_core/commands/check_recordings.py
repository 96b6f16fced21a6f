"""Check the files of a sequence's row in a fraction of a second: recordings and detections."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from intercap_core import artefacts
from intercap_core.commands.console import counted
from intercap_core.config import DetectionsSettings
from intercap_core.entries import SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections import candidate_files, keypoint_files
from intercap_core.formats.detections.class_names import class_names
from intercap_core.formats.detections.coco import LARGEST_ID
from intercap_core.formats.detections.image_numbers import DOUBT, CameraImages
from intercap_core.formats.detections.keypoints import layouts as keypoint_layouts
from intercap_core.formats.recordings.extract import advice_on_size
from intercap_core.formats.recordings.image_files import FilesRecording
from intercap_core.formats.recordings.layouts import list_unread, open_layout
from intercap_core.formats.recordings.source import RecordingLayout, RecordingPreview
from intercap_core.geometry.camera.rig import Camera, Rig, count_facing_away
from intercap_core.inputs.files import describe_unread, list_files
from intercap_core.project import Project
from intercap_core.schemas import TRUTH

# Length of a recording as a share of the other cameras' or of the length that its header states.
MIN_LENGTH_SHARE = 0.5  # a shorter one is a fault
FULL_LENGTH_SHARE = 0.95  # a shorter one is noted
MIN_IMAGE_SHARE = 0.9  # smallest share of the expected images; recordings lose a few images
_NAMES = {
    "images": "images", "keypoints": "keypoints", "candidates": "segmentation masks (candidates)"
}  # fmt: skip
_IMAGE_IDS = [
    re.compile(rb'"%s"\s*:\s*("[^"]*"|[^,}\s]+)' % key) for key in (b"image_id", b"file_name")
]


class CheckedRecording(NamedTuple):
    """Recording of one camera."""

    source: Path
    """File or folder."""
    size: tuple[int, int]
    """Width and height that the calibration states."""
    fps: float
    """Images a second that the recording states."""
    depth: bool
    """Whether it has depth images that are used."""
    truncated: bool
    """Whether its end is missing."""
    preview: RecordingPreview
    """Size, number and duration of its images."""


@dataclass
class RecordingFindings:
    """Findings on the recordings of one sequence."""

    summary: str = ""
    """All recordings in one line."""
    faults: list[str] = field(default_factory=list)
    """Faults that cost a camera or most of its images."""
    notes: list[str] = field(default_factory=list)
    """Smaller losses and probable mistakes."""
    depth: bool = False
    """Whether any camera has depth that is used."""
    images: dict[str, CameraImages] = field(default_factory=dict, compare=False)
    """Images of each camera whose recording could be opened; their number may be estimated."""
    recognised: dict[str, set[str]] = field(default_factory=dict)
    """What was recognised, by kind. Of images: the source of their times. Of keypoints and
    candidates: layout, numbering and unit."""

    def add_recognised(self, kind: str, texts: Iterable[str]) -> None:
        """Add what was recognised in one camera's files."""
        self.recognised.setdefault(kind, set()).update(texts)

    def compare_numbers(
        self, kind: str, folder: Path, whole: Path | None, files: list[Path], images: CameraImages
    ) -> None:
        """Compare the images of one camera's detections with those of its recording.

        Adds the numbering of a file of all images, and a note if there are more or fewer images.

        Args:
            kind: keypoints or candidates.
            folder: folder of all cameras' detections.
            whole: the file of all images, if there is one.
            files: files of single images.
            images: the camera's images.
        """
        recorded, count = len(images.recorded), len(files)
        if whole is not None:
            if whole.stat().st_size > 64 << 20:  # would take more than 0.5 s
                return
            content = whole.read_bytes()
            ids, names = ({_parse(v) for v in form.findall(content)} for form in _IMAGE_IDS)
            count = len(ids or names)
            texts = [v for v in ids | names if isinstance(v, str)]
            numbers = {v for v in ids if isinstance(v, int) and 0 <= v <= LARGEST_ID}
            _, _, remark = images.match_keys(texts, numbers)
            if recorded and DOUBT in remark:
                self.notes.append(f"{whole}: images are {remark}")
            elif recorded and remark:
                self.add_recognised(kind, [f"images {remark}"])
        if not recorded or not count:
            return
        cover = f"{folder}: {_NAMES[kind]} of camera {images.name} cover {count}"
        if count < MIN_IMAGE_SHARE * recorded:
            self.notes.append(f"{cover} of its {recorded} images; run the detector on all of them")
        elif count * MIN_IMAGE_SHARE > recorded:
            self.notes.append(
                f"{cover} images, it has {recorded}; they may belong to another recording, or the "
                "recording is cut off"
            )


def _parse(value: bytes) -> int | str | None:
    """A number or text of JSON; None for any other value."""
    try:
        parsed = json.loads(value)
    except (ValueError, RecursionError):
        return None
    return parsed if type(parsed) in (int, str) else None


def check_row(project: Project, row: SequenceEntry) -> RecordingFindings:
    """Check that the files of a row exist, then its recordings, keypoints and candidates."""
    faults = []
    for column in ("calibration", "keypoints", "candidates", "results", "truth"):
        path = getattr(row, column)
        if path is not None and not path.exists():
            faults.append(f"column {column} names {path}, which does not exist")
    if row.truth is not None and row.truth.exists():
        faults += faults_of_truth(row.truth)
    if not row.recordings.is_dir():
        faults.insert(0, f"column recordings names {row.recordings}, which is not a folder")
    if not row.recordings.is_dir() or not row.calibration.exists():
        return RecordingFindings(faults=faults)
    unread = list_unread(row)
    try:
        layout = open_layout(row)
    except UserError as error:
        return RecordingFindings(faults=[*faults, str(error)], notes=unread)
    if not layout.names:
        faults.append(f"{row.recordings} contains no recording in the layout {row.layout}")
        return RecordingFindings(faults=faults, notes=unread)
    settings = project.config.frames
    known = list(layout.extrinsics.master_from_colour)
    faults += [
        f"the setting frames.cameras names {name!r}, {row.recordings} has {', '.join(layout.names)}"
        for name in settings.cameras
        if name not in known and name not in layout.names
    ]
    used = [name for name in layout.names if not settings.cameras or name in settings.cameras]
    faults += [
        f"{row.calibration}: has no pose of {name}, which {row.recordings} records; add the camera"
        for name in used
        if name not in known
    ]
    posed = [name for name in used if name in known]
    findings = check_recordings(
        row, layout, posed, without_depth=not settings.depth, settings=project.config.detections
    )
    findings.faults[:0] = faults
    findings.notes[:0] = unread
    absent = [name for name in known if name not in layout.names]
    if absent:
        findings.notes.append(
            f"{row.recordings} records {', '.join(layout.names)}; {row.calibration} also has "
            f"{', '.join(absent)}: add their recordings or correct the file names if they exist"
        )
    findings.notes += _notes_on_unread(row, {*known, *layout.names})
    findings.notes += _notes_on_keypoints(project, row, posed, findings)
    findings.notes += _notes_on_candidates(project, row, posed, findings)
    findings.notes += _notes_on_object(project, row, posed, findings)
    if findings.summary:
        recognised = [
            f"{_NAMES[kind]}: {', '.join(sorted(texts))}"
            for kind, texts in findings.recognised.items()
            if texts
        ]
        findings.summary = "; ".join([findings.summary, *recognised])
    return findings


def faults_of_truth(path: Path) -> list[str]:
    """Error message if a file in the column truth is no truth file; [] otherwise."""
    try:
        with artefacts.read(path, TRUTH):
            return []
    except UserError as error:
        return [f"column truth names a file without truth: {error}"]


def _notes_on_unread(row: SequenceEntry, cameras: set[str]) -> list[str]:
    """Notes on files in the folders of keypoints and candidates that are not read."""
    read: set[Path] = set()
    folders = {folder for folder in (row.keypoints, row.candidates) if folder and folder.is_dir()}
    for camera in cameras:
        if row.keypoints in folders:
            whole, single = keypoint_files.keypoint_paths(row.keypoints, camera)
            read.update(single if whole is None else [whole])
        if row.candidates in folders:
            read.update(candidate_files.candidate_paths(row.candidates, camera, row.layout))
    return [
        note
        for folder in sorted(folders)
        if not row.recordings.is_relative_to(folder)
        for note in describe_unread(
            folder,
            (path for path in list_files(folder) if path not in read),
            "docs/detectors.md names the files that are read; rename, convert or remove them",
        )
    ]


def _notes_on_keypoints(
    project: Project, row: SequenceEntry, cameras: list[str], findings: RecordingFindings
) -> list[str]:
    """Notes on cameras without keypoints, and on the first keypoints of the others.

    Adds a fault if no camera has keypoints, or a single one of several cameras without depth.
    """
    settings = project.config.detections
    folder, notes = row.keypoints, []
    if folder is None:
        there = row.layout == "behave" and any(row.recordings.glob("*/*.color.json"))
    elif folder.is_dir():
        there = any(keypoint_files.has_keypoints(folder, name) for name in cameras)
    else:
        return []  # a fault already
    if cameras and not there and settings.keypoint_model is None:
        findings.faults.append(
            f"{folder or row.recordings}: no keypoints of {', '.join(cameras)}, and no keypoint "
            "model is set, so no person can be found; run a keypoint detector on the images and "
            "name its folder in the column keypoints, or set detections.keypoint_model "
            "(docs/detectors.md)"
        )
        return []
    if folder is None:
        return []
    having = [name for name in cameras if keypoint_files.has_keypoints(folder, name)]
    if len(having) == 1 < len(cameras) and not findings.depth and settings.keypoint_model is None:
        findings.faults.append(
            f"{folder}: keypoints of camera {having[0]} only, and no depth, so no joint can be "
            "triangulated; add the keypoints of another camera, or depth"
        )
    layouts: set[str] = set()
    usable = 0
    for name in cameras:
        if keypoint_files.has_keypoints(folder, name):
            if name in findings.images:
                images = findings.images[name]
                images = replace(images, first_number=settings.keypoint_first_number)
                preview = keypoint_files.preview_keypoints(
                    folder,
                    images,
                    full_confidence=settings.keypoint_full_confidence,
                    layout=settings.keypoint_layout,
                )
                notes += preview.notes
                findings.faults += preview.faults
                findings.add_recognised("keypoints", preview.recognised)
                layouts |= preview.layouts
                usable += preview.usable
        elif settings.keypoint_model is None:
            notes.append(
                f"{folder} has no file of keypoints for {name}; add this camera's keypoints "
                f"({name}.json or {name}/<image>_keypoints.json)"
            )
    if {*having} & {*findings.images} and not usable and settings.keypoint_model is None:
        findings.faults.append(
            f"{folder}: the first keypoints of {', '.join(having)} cannot be used, so no person "
            "will be found; the notes say why (docs/detectors.md)"
        )
    counts = [len(keypoint_layouts()[name].points) for name in layouts]
    if len(set(counts)) < len(counts):
        notes.append(
            f"{folder}: the same number of points is recognised as different layouts in different "
            f"cameras ({', '.join(sorted(layouts))}); name theirs in detections.keypoint_layout"
        )
    return notes


def _notes_on_candidates(
    project: Project, row: SequenceEntry, cameras: list[str], findings: RecordingFindings
) -> list[str]:
    """Notes on cameras without candidates, and on format, size and labels of the first ones."""
    settings = project.config.detections
    folder, notes = row.candidates, []
    if folder is None or not folder.is_dir():
        return []
    labels: set[str] = set()
    for name in cameras:
        if candidate_files.has_candidates(folder, name, row.layout):
            if name in findings.images:
                images = findings.images[name]
                images = replace(images, first_number=settings.candidate_first_number)
                preview = candidate_files.preview_candidates(
                    folder, images, names=class_names(settings.category_names)
                )
                notes += preview.notes
                findings.faults += preview.faults
                findings.add_recognised("candidates", preview.recognised)
                labels |= preview.labels
        elif settings.segmentation_model is None:
            notes.append(f"{folder} has no {name}.json; add this camera's {_NAMES['candidates']}")
    entry = project.object_of(row.sequence)
    expected = () if entry is None else entry.labels
    if labels and expected and not labels & {*expected}:
        named = sorted(label or "no label" for label in labels)
        notes.append(
            f"{folder}: the labels of the first results are {list_labels(named)}; "
            f"object {row.object!r} expects {', '.join(expected)}; add its labels to "
            "objects.yaml, or set detections.category_names"
        )
    return notes


def _notes_on_object(
    project: Project, row: SequenceEntry, cameras: list[str], findings: RecordingFindings
) -> list[str]:
    """Note that neither depth nor candidates show the object, [] if one of them does."""
    has_model = project.config.detections.segmentation_model is not None
    folder = row.candidates
    if not row.object or has_model or findings.depth or row.layout == "behave":
        return []
    if folder is not None and any(
        candidate_files.has_candidates(folder, name, row.layout) for name in cameras
    ):
        return []
    return [
        f"no camera has depth and there are no {_NAMES['candidates']} of object {row.object!r}, "
        "so it will probably not be found; run a segmentation model and name its folder in the "
        "column candidates, or record with depth"
    ]


def list_labels(labels: list[str]) -> str:
    """The first labels of a detector as text."""
    more = f" and {len(labels) - 8} more" if len(labels) > 8 else ""
    return ", ".join(labels[:8]) + more


def check_recordings(
    row: SequenceEntry,
    layout: RecordingLayout,
    cameras: Sequence[str],
    *,
    without_depth: bool = False,
    settings: DetectionsSettings | None = None,
) -> RecordingFindings:
    """Open the recordings of ``cameras``, all of which have a camera pose, and check them.

    Args:
        row: the sequence.
        layout: its recordings.
        cameras: names of the cameras.
        without_depth: the settings do not use depth.
        settings: numbers of the first images in detections; None = recognised.
    """
    settings = settings or DetectionsSettings()
    findings, recordings = RecordingFindings(), {}
    posed: list[Camera] = []
    stems: dict[str, tuple[str, ...]] = {}
    for name in cameras:
        try:
            with layout.open(name) as recording:
                posed.append(recording.camera)
                findings.add_recognised("images", {recording.timing} - {""})
                lens, depth = recording.camera.colour, recording.camera.depth
                recordings[name] = CheckedRecording(
                    recording.source,
                    (lens.width, lens.height),
                    recording.fps,
                    depth is not None and not without_depth,
                    recording.truncated,
                    recording.preview(),
                )
                findings.notes += [
                    f"{recording.source}: camera {name}: {note}"
                    for note in (*recording.notes, *recordings[name].preview.remarks)
                ]
                if isinstance(recording, FilesRecording) and row.layout == "plain":
                    stems[name] = tuple(path.stem for _, path in recording.colour_files)
        except UserError as error:
            findings.faults.append(str(error))
        except OSError as error:
            findings.faults.append(
                f"{layout.sequence.recordings}: camera {name} cannot be read "
                f"({error.strerror or error}); copy its recording again"
            )
    expected = _expected_seconds(recordings)
    for name, recording in recordings.items():
        _check_recording(findings, row, name, recording, expected.get(name))
        images = _images_of(name, recording, stems.get(name, ()))
        findings.images[name] = images
        if row.keypoints is not None:
            whole, files = keypoint_files.keypoint_paths(row.keypoints, name)
            images = replace(images, first_number=settings.keypoint_first_number)
            findings.compare_numbers("keypoints", row.keypoints, whole, files, images)
        if row.candidates is not None:
            whole = candidate_files.camera_file(row.candidates, name)
            files = candidate_files.image_files(row.candidates, name)
            images = replace(images, first_number=settings.candidate_first_number)
            findings.compare_numbers("candidates", row.candidates, whole, files, images)
    findings.summary = _summary(row, recordings)
    away = count_facing_away(Rig(tuple(posed))) if posed else 0
    if 2 * away > len(posed):
        findings.notes.append(
            f"{row.calibration}: {away} of {len(posed)} cameras face away from the place where "
            "their optical axes meet, so their poses likely have OpenGL's axes (y up, z "
            "backwards); expected y down, z forward"
        )
    findings.depth = any(recording.depth for recording in recordings.values())
    if len(cameras) == len(recordings) == 1 and not recordings[cameras[0]].depth:
        findings.faults.append(
            f"{row.recordings}: only camera {cameras[0]} is used, and without depth; "
            "add recordings and poses of other cameras (frames.cameras selects them), or depth"
        )
    return findings


def _expected_seconds(recordings: dict[str, CheckedRecording]) -> dict[str, float]:
    """Expected duration of each camera's recording, seconds, from those of the other cameras.

    It is the median of the longer half of the others, because some of them may be cut off.
    """
    seconds = {name: recording.preview.seconds for name, recording in recordings.items()}
    expected = {}
    for name in seconds:
        others = sorted(s for other, s in seconds.items() if other != name and s is not None)
        if others:
            expected[name] = float(np.median(others[len(others) // 2 :]))
    return expected


def _check_recording(
    findings: RecordingFindings,
    row: SequenceEntry,
    name: str,
    recording: CheckedRecording,
    expected_s: float | None,
) -> None:
    """Add the findings on one camera: image size, length, and number of images.

    ``expected_s``: duration by the other cameras, seconds; None if there are none.
    """
    source, preview = recording.source, recording.preview
    if preview.size is None:
        findings.faults.append(
            f"{source}: camera {name} has no image that can be read, expected "
            f"{recording.size[0]}x{recording.size[1]}; copy or record it again"
        )
    elif preview.size != recording.size:
        findings.faults.append(
            f"{source}: camera {name}'s images are {preview.size[0]}x{preview.size[1]}, "
            f"{row.calibration} is for {recording.size[0]}x{recording.size[1]}, so the camera "
            f"would be left out; {advice_on_size(preview.size, recording.size)}"
        )
    findings.notes += [
        f"{source}: camera {name} {fault}; copy it again" for fault in preview.faults
    ]
    images = str(preview.images) if preview.counted else f"about {preview.images or 'no'}"
    if preview.share < FULL_LENGTH_SHARE or recording.truncated:
        part = f"about {preview.share:.0%} of the stated length" if preview.share < 1 else "no end"
        text = (
            f"{source}: camera {name}'s recording is cut off: it has {part} ({images} images); "
            "copy or record it again"
        )
        (findings.faults if preview.share < MIN_LENGTH_SHARE else findings.notes).append(text)
    if (
        preview.seconds is not None
        and expected_s is not None
        and preview.share >= FULL_LENGTH_SHARE
    ):
        shorter = preview.seconds + 1 / recording.fps < FULL_LENGTH_SHARE * expected_s
        if shorter:
            text = (
                f"{source}: camera {name} lasts {preview.seconds:.1f} s ({images} images), the "
                f"other cameras {expected_s:.1f} s; copy it again, or leave it out (frames.cameras)"
            )
            most = preview.seconds < MIN_LENGTH_SHARE * expected_s
            (findings.faults if most else findings.notes).append(text)
    if preview.counted and preview.seconds is not None and preview.images is not None:
        expected = round(preview.seconds * recording.fps) + 1
        if preview.images < MIN_IMAGE_SHARE * expected:
            findings.notes.append(
                f"{source}: camera {name} has {preview.images} images in {preview.seconds:.1f} s, "
                f"expected about {expected} at {recording.fps:g} a second; add the missing images "
                "or correct fps or the timestamps"
            )


def _images_of(name: str, recording: CheckedRecording, stems: tuple[str, ...]) -> CameraImages:
    """The images of a recording, numbered from 0; ``stems`` are names of image files."""
    number = np.arange(len(stems) or recording.preview.images or 0)
    times = np.round(1e6 * number / recording.fps).astype(np.int64)
    return CameraImages(name, recording.size, number, times, frozenset(number.tolist()), stems)


def _summary(row: SequenceEntry, recordings: dict[str, CheckedRecording]) -> str:
    if not recordings:
        return ""
    previews = [recording.preview for recording in recordings.values()]
    sizes = sorted({preview.size for preview in previews if preview.size is not None})
    images = [preview.images for preview in previews if preview.images is not None]
    seconds = [preview.seconds for preview in previews if preview.seconds is not None]
    depth = sum(recording.depth for recording in recordings.values())
    detected = [
        f"{_NAMES[kind]} of {count}"
        for kind, has in (
            ("keypoints", lambda name, f: keypoint_files.has_keypoints(f, name)),
            ("candidates", lambda name, f: candidate_files.has_candidates(f, name, row.layout)),
        )
        if (folder := getattr(row, kind)) is not None
        and (count := sum(has(name, folder) for name in recordings))
    ]
    parts = [
        counted(len(recordings), "camera"),
        ", ".join(f"{width}x{height}" for width, height in sizes),
        f"{_span(images, '{:d}')} image{'s' * (max(images) != 1)}" if images else "",
        f"{_span(seconds, '{:.1f}')} s" if seconds else "",
        f"depth of {depth}" if depth else "no depth",
        *detected,
    ]
    return "; ".join(part for part in parts if part)


def _span(values: list, form: str) -> str:
    low, high = form.format(min(values)), form.format(max(values))
    return low if low == high else f"{low} to {high}"
