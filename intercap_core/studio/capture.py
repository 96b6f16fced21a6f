"""Make one virtual capture: recordings, detections, calibration, and its truth."""

from __future__ import annotations

import hashlib
import json
import shutil
from pathlib import Path

import yaml

from intercap_core.camera.extrinsics_files import Extrinsics, write_rig_file
from intercap_core.config import ObjectEntry, StudioCapture, StudioSettings
from intercap_core.errors import UserError
from intercap_core.studio.keypoints import Detector
from intercap_core.studio.masks import Segmenter
from intercap_core.studio.recording import Kinect
from intercap_core.studio.stage import Stage
from intercap_core.studio.truth import erring_annotation, write_truth

MANIFEST = "capture.json"


def make_capture(
    capture: StudioCapture,
    settings: StudioSettings,
    *,
    sequence: str,
    objects: ObjectEntry,
    output: Path,
) -> None:
    """Write the folder of one capture.

    Holds <camera>.mkv, calibration.json, keypoints/<camera>/<image>_keypoints.json,
    candidates/<camera>.json, truth.h5, annotation.yaml if ``capture.annotate``, and last
    capture.json, the sorted list of the files with their SHA-256. ``objects`` is the tracked
    object's entry. The same arguments give the same bytes. Raises UserError for a subject,
    interaction or object that the studio does not have, and for an ``output`` that holds
    something else.
    """
    output = Path(output)
    if output.exists():
        others = [p for p in output.iterdir() if p.name != MANIFEST]
        if others and not (output / MANIFEST).is_file() and not _unfinished(output):
            raise UserError(
                f"{output}: is not empty and was not made by the studio; choose another folder"
            )
        shutil.rmtree(output)
    output.mkdir(parents=True)
    stage = Stage(capture, settings, objects)
    detector = Detector.build(stage.noise, stage.frames)
    segmenter = Segmenter(stage.noise, stage.frames, objects.name)
    recorded = [
        Kinect(stage, index, settings.colour_mode).record(output, detector, segmenter)
        for index in range(len(stage.rig.true))
    ]
    claimed = stage.rig.claimed
    poses = dict(zip(claimed.names, claimed.master_from_colour, strict=True))
    write_rig_file(output / "calibration.json", Extrinsics(claimed.names[0], poses))
    moment = stage.at(stage.set_times)
    contact = write_truth(
        output / "truth.h5",
        stage,
        moment,
        sequence,
        capture,
        recorded,
    )
    if capture.annotate:
        text = yaml.safe_dump(erring_annotation(stage, moment, contact), sort_keys=True)
        (output / "annotation.yaml").write_text(text)
    _write_manifest(output, sequence)


def _unfinished(folder: Path) -> bool:
    """Whether a studio run was cut off here."""
    return all(
        p.name in ("keypoints", "candidates", "calibration.json", "truth.h5", "annotation.yaml")
        or p.suffix == ".mkv"
        or p.name.startswith(".truth.h5")
        for p in folder.iterdir()
    )


def _write_manifest(folder: Path, sequence: str) -> None:
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name != MANIFEST)
    digests = {}
    for path in files:
        with open(path, "rb") as handle:
            digest = hashlib.file_digest(handle, "sha256").hexdigest()
        digests[path.relative_to(folder).as_posix()] = digest
    content = {"sequence": sequence, "files": digests}
    temporary = folder / f".{MANIFEST}.part"
    temporary.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
    temporary.replace(folder / MANIFEST)
