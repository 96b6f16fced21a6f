"""Check the files of a sequence's row in a fraction of a second: recordings and detections."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.commands.console import counted
from intercap_core.config import DetectionsSettings
from intercap_core.entries import ObjectEntry, SequenceEntry
from intercap_core.errors import UserError
from intercap_core.formats.detections import candidate_files, keypoint_files
from intercap_core.formats.detections.class_names import class_names
from intercap_core.formats.detections.coco import LARGEST_ID, DetectionPreview
from intercap_core.formats.detections.image_numbers import DOUBT, CameraImages
from intercap_core.formats.detections.keypoints import layouts as keypoint_layouts
from intercap_core.formats.recordings.extract import advice_on_size
from intercap_core.formats.recordings.image_files import FilesRecording
from intercap_core.formats.recordings.layouts import list_unread, open_layout
from intercap_core.formats.recordings.source import (
    CameraRecording,
    RecordingLayout,
    RecordingPreview,
)
from intercap_core.geometry.camera.rig import Rig, count_facing_away
from intercap_core.inputs.files import describe_unread, list_files, name_some
from intercap_core.project import Project
from intercap_core.schemas import HAND_HELD_TRUTH, TRUTH

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


@dataclass
class RecordingCheck:
    """Check of the recordings and detections of one sequence, and what it has found."""

    row: SequenceEntry
    """The sequence."""
    settings: DetectionsSettings
    """Models that replace files of detections, and the numbers of the first images in files."""
    faults: list[str] = field(default_factory=list)
    """Faults that cost a camera or most of its images."""
    notes: list[str] = field(default_factory=list)
    """Smaller losses and probable mistakes."""
    cameras: Sequence[str] = ()
    """Names of the cameras with recording and pose."""
    depth: int = 0
    """Number of cameras with depth that is used."""
    previews: dict[str, RecordingPreview] = field(default_factory=dict)
    """Size, number and duration of the images of each recording that could be opened."""
    images: dict[str, CameraImages] = field(default_factory=dict, compare=False)
    """Images of the same cameras; their number may be estimated."""
    recognised: dict[str, set[str]] = field(
        default_factory=lambda: {kind: set() for kind in _NAMES}
    )
    """What was recognised, by kind. Of images: the source of their times. Of keypoints and
    candidates: layout, numbering and unit."""

    def check_recordings(
        self, layout: RecordingLayout, cameras: Sequence[str], *, use_depth: bool = True
    ) -> None:
        """Open the recordings of ``cameras``, all of which have a camera pose, and check them."""
        row, recordings = self.row, {}
        self.cameras = cameras
        for name in cameras:
            try:
                with layout.open(name) as recording:
                    self.previews[name] = recording.preview()
                    recordings[name] = recording
            except UserError as error:
                self.faults.append(str(error))
            except OSError as error:
                self.faults.append(
                    f"{row.recordings}: camera {name} cannot be read ({error.strerror or error}); "
                    "copy its recording again"
                )
        for name, recording in recordings.items():
            self._check_recording(name, recording)
            for kind in ("keypoints", "candidates"):
                if getattr(row, kind) is not None:
                    self._compare_numbers(kind, name)
        posed = tuple(recording.camera for recording in recordings.values())
        self.depth = use_depth * sum(camera.depth is not None for camera in posed)
        away = count_facing_away(Rig(posed)) if posed else 0
        if 2 * away > len(posed):
            self.notes.append(
                f"{row.calibration}: {away} of {len(posed)} cameras face away from the place "
                "where their optical axes meet, so their poses likely have OpenGL's axes (y up, z "
                "backwards); expected y down, z forward"
            )
        if len(cameras) == len(posed) == 1 and not self.depth:
            self.faults.append(
                f"{row.recordings}: only camera {cameras[0]} is used, and without depth; "
                "add recordings and poses of other cameras (frames.cameras selects them), or depth"
            )

    def _check_recording(self, name: str, recording: CameraRecording) -> None:
        """Check one camera: image size, length, and number of images."""
        preview = self.previews[name]
        camera, notes, faults = f"{recording.source}: camera {name}", self.notes, self.faults
        size = recording.camera.colour.width, recording.camera.colour.height
        stated = f"{size[0]}x{size[1]}"
        if preview.size is None:
            faults.append(
                f"{camera} has no image that can be read, expected {stated}; copy or "
                "record it again"
            )
        elif preview.size != size:
            faults.append(
                f"{camera}'s images are {preview.size[0]}x{preview.size[1]}, "
                f"{self.row.calibration} is for {stated}, so the camera would be left out; "
                f"{advice_on_size(preview.size, size)}"
            )
        notes += [f"{camera}: {note}" for note in (*recording.notes, *preview.remarks)]
        notes += [f"{camera} {fault}; copy it again" for fault in preview.faults]
        images = str(preview.images) if preview.counted else f"about {preview.images or 'no'}"
        is_cut = preview.share < FULL_LENGTH_SHARE
        if is_cut or recording.truncated:
            part = f"about {preview.share:.0%} of the stated length"
            (faults if preview.share < MIN_LENGTH_SHARE else notes).append(
                f"{camera}'s recording is cut off: it has {part if preview.share < 1 else 'no end'}"
                f" ({images} images); copy or record it again"
            )
        # Other recordings may be cut off too, so only the longer half of them counts.
        others = sorted(
            p.seconds
            for other, p in self.previews.items()
            if other != name and p.seconds is not None
        )
        expected_s = float(np.median(others[len(others) // 2 :] or [0.0]))
        seconds = expected_s if preview.seconds is None or is_cut else preview.seconds
        if seconds + 1 / recording.fps < FULL_LENGTH_SHARE * expected_s:
            (faults if seconds < MIN_LENGTH_SHARE * expected_s else notes).append(
                f"{camera} lasts {seconds:.1f} s ({images} images), the other cameras "
                f"{expected_s:.1f} s; copy it again, or leave it out (frames.cameras)"
            )
        if preview.counted and preview.seconds is not None and preview.images is not None:
            count = round(preview.seconds * recording.fps) + 1
            if preview.images < MIN_IMAGE_SHARE * count:
                notes.append(
                    f"{camera} has {preview.images} images in {preview.seconds:.1f} s, expected "
                    f"about {count} at {recording.fps:g} a second; add the missing images or "
                    "correct fps or the timestamps"
                )
        self.recognised["images"] |= {recording.timing} - {""}
        stems: tuple[str, ...] = ()
        if isinstance(recording, FilesRecording) and self.row.layout == "plain":
            stems = tuple(path.stem for _, path in recording.colour_files)
        number = np.arange(len(stems) or preview.images or 0)
        times = np.round(1e6 * number / recording.fps).astype(np.int64)
        recorded = frozenset(number.tolist())
        self.images[name] = CameraImages(name, size, number, times, recorded, stems)

    @property
    def summary(self) -> str:
        """All recordings in one line; "" if none could be opened."""
        previews = self.previews.values()
        if not previews:
            return ""
        sizes = sorted({preview.size for preview in previews if preview.size is not None})
        images = [preview.images for preview in previews if preview.images is not None]
        seconds = [preview.seconds for preview in previews if preview.seconds is not None]
        detected = {
            kind: sum(bool(self.files(kind, name)) for name in self.images)
            for kind in ("keypoints", "candidates")
        }
        parts = [
            counted(len(previews), "camera"),
            ", ".join(f"{width}x{height}" for width, height in sizes),
            f"{_span(images, '{:d}')} image{'s' * (max(images) != 1)}" if images else "",
            f"{_span(seconds, '{:.1f}')} s" if seconds else "",
            f"depth of {self.depth}" if self.depth else "no depth",
            *(f"{_NAMES[kind]} of {count}" for kind, count in detected.items() if count),
        ]
        recognised = {kind: ", ".join(sorted(texts)) for kind, texts in self.recognised.items()}
        parts += [f"{_NAMES[kind]}: {texts}" for kind, texts in recognised.items() if texts]
        return "; ".join(part for part in parts if part)

    def _compare_numbers(self, kind: str, camera: str) -> None:
        """Compare the images of one camera's keypoints or candidates with those of its recording.

        Adds the numbering of a file of all images, and a note if there are more or fewer images.
        """
        folder, images = getattr(self.row, kind), self.numbered(kind, camera)
        recorded = len(images.recorded)
        if not recorded:
            return
        if kind == "keypoints":
            found = keypoint_files.KeypointFiles.find(folder, camera)
            whole, files = found.whole, list(found.single.values())
        else:
            whole = candidate_files.camera_file(folder, camera)
            files = candidate_files.image_files(folder, camera)
        count = len(files)
        if whole is not None:
            if whole.stat().st_size > 64 << 20:  # would take more than 0.5 s
                return
            content = whole.read_bytes()
            ids, names = ({_parse(v) for v in form.findall(content)} for form in _IMAGE_IDS)
            count = len(ids or names)
            texts = [v for v in ids | names if isinstance(v, str)]
            numbers = {v for v in ids if isinstance(v, int) and 0 <= v <= LARGEST_ID}
            _, _, remark = images.match_keys(texts, numbers)
            if DOUBT in remark:
                self.notes.append(f"{whole}: images are {remark}")
            elif remark:
                self.recognised[kind].add(f"images {remark}")
        cover = f"{folder}: {_NAMES[kind]} of camera {camera} cover {count}"
        if 0 < count < MIN_IMAGE_SHARE * recorded:
            self.notes.append(f"{cover} of its {recorded} images; run the detector on all of them")
        elif count * MIN_IMAGE_SHARE > recorded:
            self.notes.append(
                f"{cover} images, it has {recorded}; they may belong to another recording, or the "
                "recording is cut off"
            )

    def files(self, kind: str, camera: str) -> list[Path]:
        """Files of a camera's keypoints or candidates that are read."""
        folder = getattr(self.row, kind)
        if folder is None or not folder.is_dir():
            return []
        if kind == "candidates":
            return candidate_files.candidate_paths(folder, camera, self.row.layout)
        return keypoint_files.KeypointFiles.find(folder, camera).used

    def numbered(self, kind: str, camera: str) -> CameraImages:
        """The images, with the first number that the settings state for keypoints or candidates."""
        settings, keypoints = self.settings, kind == "keypoints"
        first = settings.keypoint_first_number if keypoints else settings.candidate_first_number
        return replace(self.images[camera], first_number=first)

    def note_unread(self, cameras: set[str]) -> None:
        """Note files in the folders of keypoints and candidates that are not read."""
        kinds = ("keypoints", "candidates")
        read = {path for kind in kinds for name in cameras for path in self.files(kind, name)}
        advice = "docs/detectors.md names the files that are read; rename, convert or remove them"
        for folder in sorted({getattr(self.row, kind) for kind in kinds} - {None}):
            if folder.is_dir() and not self.row.recordings.is_relative_to(folder):
                unread = (path for path in list_files(folder) if path not in read)
                self.notes += describe_unread(folder, unread, advice)

    def _preview(self, kind: str, *, has_model: bool) -> list[DetectionPreview]:
        """Read the first keypoints or candidates of each camera and add the findings on them.

        Adds a note on a camera without any, unless a model replaces them.
        """
        settings, folder, previews = self.settings, getattr(self.row, kind), []
        for name in self.cameras:
            if not self.files(kind, name) and not has_model:
                absent = f"{name}.json" if kind == "candidates" else f"file of keypoints for {name}"
                self.notes.append(
                    f"{folder} has no {absent}; add this camera's {_NAMES[kind]} "
                    "(docs/detectors.md names the files that are read)"
                )
            if not self.files(kind, name) or name not in self.images:
                continue
            images = self.numbered(kind, name)
            if kind == "candidates":
                classes = class_names(settings.category_names)
                preview = candidate_files.preview_candidates(folder, images, names=classes)
            else:
                preview = keypoint_files.preview_keypoints(
                    folder, images, full_confidence=settings.keypoint_full_confidence,
                    layout=settings.keypoint_layout,
                )  # fmt: skip
            self.notes += preview.notes
            self.faults += preview.faults
            self.recognised[kind] |= {*preview.recognised}
            previews.append(preview)
        return previews

    def check_keypoints(self) -> None:
        """Read the first keypoints, which a keypoint model may replace.

        Adds a fault if no camera has keypoints, or a single one of several cameras without depth.
        """
        folder, has_model = self.row.keypoints, self.settings.keypoint_model is not None
        having = ", ".join(name for name in self.cameras if self.files("keypoints", name))
        if folder is not None and not folder.is_dir():
            return  # a fault already
        is_made = self.row.layout == "behave" and any(self.row.recordings.glob("*/*.color.json"))
        if self.cameras and not having and not has_model and (folder or not is_made):
            self.faults.append(
                f"{folder or self.row.recordings}: no keypoints of {', '.join(self.cameras)}, and "
                "no keypoint model is set, so no person can be found; run a keypoint detector on "
                "the images and name its folder in the column keypoints, or set "
                "detections.keypoint_model (docs/detectors.md)"
            )
        if not having:
            return
        if len(self.cameras) > 1 and having in self.cameras and not self.depth and not has_model:
            self.faults.append(
                f"{folder}: keypoints of camera {having} only, and no depth, so no joint can be "
                "triangulated; add the keypoints of another camera, or depth"
            )
        previews = self._preview("keypoints", has_model=has_model)
        if previews and not any(preview.usable for preview in previews) and not has_model:
            self.faults.append(
                f"{folder}: the first keypoints of {having} cannot be used, so no person will be "
                "found; the notes say why (docs/detectors.md)"
            )
        layouts = {name for preview in previews for name in preview.layouts}
        if len({len(keypoint_layouts()[name].points) for name in layouts}) < len(layouts):
            self.notes.append(
                f"{folder}: the same number of points is recognised as different layouts in "
                f"different cameras ({', '.join(sorted(layouts))}); name theirs in "
                "detections.keypoint_layout"
            )

    def check_candidates(self, entry: ObjectEntry | None) -> None:
        """Read the first candidates, which a segmentation model may replace.

        Adds a note if no label is one of the object, or if neither candidates nor depth show it.
        """
        row, has_model = self.row, self.settings.segmentation_model is not None
        is_folder = row.candidates is not None and row.candidates.is_dir()
        previews = self._preview("candidates", has_model=has_model) if is_folder else []
        labels = {label for preview in previews for label in preview.labels}
        expected = () if entry is None else entry.labels
        if labels and expected and not labels & {*expected}:
            named = sorted(label or "no label" for label in labels)
            self.notes.append(
                f"{row.candidates}: the labels of the first results are {name_some(named, 8)}; "
                f"object {row.object!r} expects {', '.join(expected)}; add its labels to "
                "objects.yaml, or set detections.category_names"
            )
        having = [name for name in self.cameras if self.files("candidates", name)]
        is_shown = having or self.depth or row.layout == "behave" or has_model
        if row.object and not is_shown:
            self.notes.append(
                f"no camera has depth and there are no {_NAMES['candidates']} of object "
                f"{row.object!r}, so it will probably not be found; run a segmentation model and "
                "name its folder in the column candidates, or record with depth"
            )


def check_row(project: Project, row: SequenceEntry) -> RecordingCheck:
    """Check that the files of a row exist, then its recordings, keypoints and candidates."""
    check = RecordingCheck(row, project.config.detections)
    faults = check.faults
    if not row.recordings.is_dir():
        faults.append(f"column recordings names {row.recordings}, which is not a folder")
    for column in ("calibration", "keypoints", "candidates", "results", "truth"):
        path = getattr(row, column)
        if path is not None and not path.exists():
            hint = f"; intercap calibrate SETTINGS {row.sequence} can find it"
            advice = hint if column == "calibration" else ""
            faults.append(f"column {column} names {path}, which does not exist{advice}")
    if row.truth is not None and row.truth.exists():
        faults += faults_of_truth(row.truth)
    if not row.recordings.is_dir() or not row.calibration.exists():
        return check
    check.notes += list_unread(row)
    try:
        layout = open_layout(row)
    except UserError as error:
        faults.append(str(error))
        return check
    if not layout.names:
        faults.append(f"{row.recordings} contains no recording in the layout {row.layout}")
        return check
    settings = project.config.frames
    known = list(layout.extrinsics.master_from_colour)
    faults += [
        f"the setting frames.cameras names {name!r}, {row.recordings} has {', '.join(layout.names)}"
        for name in settings.cameras
        if name not in known and name not in layout.names
    ]
    used = [name for name in layout.names if not settings.cameras or name in settings.cameras]
    faults += [
        layout.pose_faults.get(
            name,
            f"{row.calibration}: has no pose of {name}, which {row.recordings} records; add the "
            "camera",
        )
        for name in used
        if name not in known
    ]
    posed = [name for name in used if name in known]
    check.check_recordings(layout, posed, use_depth=settings.depth)
    absent = [name for name in known if name not in layout.names]
    if absent:
        check.notes.append(
            f"{row.recordings} records {', '.join(layout.names)}; {row.calibration} also has "
            f"{', '.join(absent)}: add their recordings or correct the file names if they exist"
        )
    check.note_unread({*known, *layout.names})
    check.check_keypoints()
    check.check_candidates(project.object_of(row.sequence))
    return check


def faults_of_truth(path: Path) -> list[str]:
    """Error message if a file in the column truth is no truth file; [] otherwise."""
    problem = ""
    for schema in (HAND_HELD_TRUTH, TRUTH):
        try:
            with artefacts.read(path, schema):
                return []
        except UserError as error:
            problem = f"column truth names a file without truth: {error}"
    return [problem]


def _parse(value: bytes) -> int | str | None:
    """A number or text of JSON; None for any other value."""
    try:
        parsed = json.loads(value)
    except (ValueError, RecursionError):
        return None
    return parsed if type(parsed) in (int, str) else None


def _span(values: list, form: str) -> str:
    low, high = form.format(min(values)), form.format(max(values))
    return low if low == high else f"{low} to {high}"
