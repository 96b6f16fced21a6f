"""What a user writes by hand: settings, tables, objects, annotations; what released sets state."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np

from intercap_core.body_fit.definition import Definition
from intercap_core.project import load_project
from intercap_core.tables import behave
from intercap_core.tables.intercap_annotations import convert
from tests.fuzz.kind import Kind, within
from tests.test_project import HEADER

ROOT = Path(__file__).resolve().parents[2]
ANNOTATION = """contact:
- {part: right_hand, start: 3, end: 20}
object_poses:
- {frame: 0, rotation_vector: [0.1, 0.2, 0.3], translation: [0.5, -0.2, 2.1]}
- {frame: 9, rotation_vector: [0.1, 0, 0], translation: [0, 0, 2], sigma_m: 0.02, sigma_degrees: 9}
left_right: [{start: 3, end: 9, camera: k3}, {start: 12, end: 14}]
floor: [[0, 1.2, 2], [1, 1.2, 2], [0, 1.1, 3]]
subject: [{camera: k1, frame: 0, x: 612.5, y: 340}]
drop_frames: [7, 8]
starts: {k1: 0, k2: {seconds: 0.48, sigma: 0.01}}
starts_sigma: 0.05
"""


def _make(folder: Path) -> None:
    shutil.copy(ROOT / "config/config.yaml", folder / "config.yaml")
    text = (folder / "config.yaml").read_text()
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    (folder / "config.yaml").write_text("\n".join(lines) + "\n")
    columns = HEADER.rstrip("\n") + "\tkeypoints\tcalibration_up\tcalibration_floor\n"
    (folder / "sequences.tsv").write_text(
        f"{columns}one\ts01\tcup\trec/one\tcal\tkeys\tz\t0.5\ntwo\ts02\tcup\trec/two\tcal\tkeys\t\t\n"
    )
    (folder / "subjects.tsv").write_text(
        "subject\tgender\theight\ns01\tfemale\t1.68\ns02\tmale\t1.8\n"
    )
    shutil.copy(ROOT / "config/objects/09_cup.ply", folder / "cup.ply")
    (folder / "objects.yaml").write_text(
        "cup:\n  mesh: cup.ply\n  symmetry:\n    continuous:\n"
        "    - {axis: [0, 0, 1], offset: [0, 0, 0]}\n"
        "    discrete: [[1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]]\n"
        "  labels: [cup, wine glass]\n"
    )
    (folder / "annotations").mkdir()
    (folder / "annotations/one.yaml").write_text(ANNOTATION)


def _read(folder: Path) -> None:
    project = load_project(folder / "config.yaml")
    for name in project.sequences:
        project.annotation_path(name)
        annotation = project.annotation(name)
        if annotation.floor is not None:
            within(-50, 50, floor=annotation.floor)
        for pose in annotation.poses:
            within(-101, 101, translation=pose.translation, turn=pose.rotation_vector)
            within(1e-9, 90, sigma=[pose.sigma_m, pose.sigma_degrees])
        for start in annotation.stated_starts.values():
            within(-1e10, 1e10, start=start)
    within(0.4, 2.7, height=[s.height or 1.7 for s in project.subjects.values()])


def _make_definition(folder: Path) -> None:
    Definition.unknown().write(folder / "definition.tsv", "people of a test")


def _read_definition(folder: Path) -> None:
    found = Definition.read(folder / "definition.tsv")
    within(-0.2, 0.2, offsets=found.offsets)
    within(1e-6, 0.2, sigma=found.sigma)


def _make_release(folder: Path) -> None:
    (folder / "contact.txt").write_text("12\n80\n95\n120\n")
    (folder / "config.ini").write_text(
        "[init_trans]\ntrans = 0.1 0.2 2.0\n[init_rot]\nrot = 0.1 -0.4 1.2\n"
        "[init_frame_id]\nid = 3\n"
    )


def _read_release(folder: Path) -> list[str]:
    return convert(folder, np.arange(200), with_pose=True).faults


def _make_info(folder: Path) -> None:
    (folder / "info.json").write_text('{"gender": "male", "cat": "chair", "kinects": [0, 1, 2, 3]}')


def _read_info(folder: Path) -> None:
    behave._gender(folder)  # what cannot be read states no gender, which its caller tells


KINDS = (
    *(
        Kind(name, form, _make, [file], _read)
        for name, form, file in (
            ("settings", "yaml", "config.yaml"),
            ("sequences", "table", "sequences.tsv"),
            ("subjects", "table", "subjects.tsv"),
            ("objects", "yaml", "objects.yaml"),
            ("annotation", "yaml", "annotations/one.yaml"),
        )
    ),
    Kind("keypoint-definition", "table", _make_definition, ["definition.tsv"], _read_definition),
    Kind("intercap-annotation", "text", _make_release, ["contact.txt", "config.ini"],
         _read_release, named=("contact", "object_pose")),
    Kind("behave-info", "json", _make_info, ["info.json"], _read_info, share=0.3),
)  # fmt: skip
