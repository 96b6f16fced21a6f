"""Make one virtual capture: recordings, detections, calibration, and its truth."""

from __future__ import annotations

import hashlib
import json
import logging
import shutil
from pathlib import Path

import yaml

from intercap_core.config import ObjectEntry, StudioCapture, StudioSettings
from intercap_core.errors import UserError
from intercap_core.progress import Progress
from intercap_core.studio.keypoints import Detector
from intercap_core.studio.layouts import FOLDERS
from intercap_core.studio.masks import Segmenter
from intercap_core.studio.recording import Kinect
from intercap_core.studio.stage import Stage
from intercap_core.studio.truth import erring_annotation, erring_starts, write_truth

log = logging.getLogger(__name__)

MANIFEST = "capture.json"
MARK = ".virtual"  # there from the first file on: the studio may delete what lies beside it


def make_capture(
    capture: StudioCapture,
    settings: StudioSettings,
    *,
    sequence: str,
    objects: ObjectEntry | None,
    output: Path,
) -> None:
    """Write the folder of one capture.

    Holds the recordings and calibration in the layout of ``capture``,
    keypoints/<camera>/<image>_keypoints.json, candidates/<camera>.json, truth.h5, annotation.yaml
    if ``capture.annotate`` or it states starts, and last capture.json, the sorted list of the files
    with their SHA-256. ``objects`` is the tracked object's entry, None of a person alone. The same
    arguments give the same bytes. Raises UserError for a subject, interaction, object or fault that
    the studio does not have, and for an ``output`` that holds something else.
    """
    output = Path(output)
    if output.exists():
        ours = (output / MANIFEST).is_file() or (output / MARK).is_file()
        if not ours and any(output.iterdir()):
            raise UserError(
                f"{output}: is not empty and was not made by the studio; choose another folder, or "
                "delete it"
            )
        shutil.rmtree(output)
    output.mkdir(parents=True)
    (output / MARK).touch()
    stage = Stage(capture, settings, objects)
    folder = FOLDERS[capture.layout](output, capture, stage.failures.broken)
    detector = Detector.build(stage.noise, stage.frames, capture.keypoint_bias)
    segmenter = Segmenter(
        stage.noise, stage.frames, stage.thing.name, passer_by=stage.passer_by is not None
    )
    recorded = []
    progress = Progress(log, "recorded", len(stage.rig.true), "cameras")
    for index in range(len(stage.rig.true)):
        kinect = Kinect(stage, index, settings.colour_mode)
        recorded.append(kinect.record(folder, detector, segmenter))
        progress.step()
    folder.write_calibration(stage.rig.claimed, settings.fps)
    moment = stage.at(stage.set_times)
    contact = write_truth(
        output / "truth.h5",
        stage,
        moment,
        sequence,
        capture,
        recorded,
    )
    annotation = erring_annotation(stage, moment, contact) if capture.annotate else {}
    if capture.states_starts is not None:
        annotation |= erring_starts(stage, capture.states_starts)
    if annotation:
        text = yaml.safe_dump(annotation, sort_keys=True)
        (output / "annotation.yaml").write_text(text)
    _write_manifest(output, sequence)


def _write_manifest(folder: Path, sequence: str) -> None:
    files = sorted(p for p in folder.rglob("*") if p.is_file() and p.name not in (MANIFEST, MARK))
    digests = {}
    for path in files:
        with open(path, "rb") as handle:
            digest = hashlib.file_digest(handle, "sha256").hexdigest()
        digests[path.relative_to(folder).as_posix()] = digest
    content = {"sequence": sequence, "files": digests}
    temporary = folder / f".{MANIFEST}.part"
    temporary.write_text(json.dumps(content, indent=1, sort_keys=True) + "\n")
    temporary.replace(folder / MANIFEST)
