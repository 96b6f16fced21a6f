"""The tool for MediaPipe: which point is which, and itself where there is an environment for it.

INTERCAP_MEDIAPIPE names the Python of an environment with mediapipe; without, that test is skipped.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[3]
sys.path.insert(0, str(ROOT / "tools"))

import mediapipe_keypoints as tool  # noqa: E402

from intercap_core.body.keypoints import KEYPOINT_NAMES  # noqa: E402
from intercap_core.formats.detections.keypoints import coco, read_people  # noqa: E402

AT = KEYPOINT_NAMES.index
SIZE = (1000, 500)
BODY = {
    name: (0.1 + i / 100, 0.2 + i / 100, 0.5 + i / 100)
    for i, name in enumerate([
        *tool.COCO_BODY, "left_foot_index", "right_foot_index", "left_heel", "right_heel",
        "left_pinky", "mouth_left",
    ])
}  # fmt: skip
HAND = [(0.5 + i / 100, 0.3, 0.0) for i in range(21)]
FACE = [(i / 1000, 0.4, 0.0) for i in range(478)]


def read(person: dict) -> np.ndarray:
    content = {"images": [{"id": 0}], "annotations": [person | {"image_id": 0}]}
    found = read_people(content, one_image=False)
    assert not found.faults
    return found.results[0][1]


def seen(share: float, length: int) -> float:
    return share * length - 0.5


def test_its_names_are_the_pipelines():
    assert tool.COCO_BODY == coco.BODY
    assert tool.COCO_FEET == coco.FEET
    assert set(tool.FEET) == set(tool.COCO_FEET) - {"left_small_toe", "right_small_toe"}
    assert len(tool.FACE) == len(set(tool.FACE)) == 68 and max(tool.FACE) < 468


def test_points_arrive_by_name():
    person = read(tool.person(BODY, (HAND, [(1 - x, y, 0) for x, y, _ in HAND]), FACE, SIZE))
    for name in ("nose", "left_wrist", "right_hip", "left_heel"):
        x, y, confidence = BODY[name]
        np.testing.assert_allclose(
            person[AT(name)], [seen(x, 1000), seen(y, 500), confidence], err_msg=name
        )
    assert person[AT("right_big_toe"), 2] == pytest.approx(BODY["right_foot_index"][2])
    for name in ("left_small_toe", "right_small_toe", "neck", "mid_hip"):
        assert (person[AT(name)] == 0).all()
    assert person[AT("left_index1"), 0] == pytest.approx(seen(HAND[5][0], 1000))
    assert person[AT("right_pinky_tip"), 0] == pytest.approx(seen(1 - HAND[20][0], 1000))
    assert person[AT("left_thumb1"), 2] == pytest.approx(BODY["left_wrist"][2])
    assert person[AT("face_8"), 0] == pytest.approx(seen(0.152, 1000)), "the chin"
    assert person[AT("face_36"), 0] == pytest.approx(seen(0.033, 1000)), "outside of the right eye"
    assert person[AT("face_27"), 2] == pytest.approx(BODY["nose"][2])


def test_what_was_not_found_is_not_seen():
    person = read(tool.person(BODY, (None, HAND), None, SIZE))
    left, right = coco.LEFT, coco.RIGHT
    assert (person[[AT(name) for name in left]] == 0).all()
    assert (person[[AT(name) for name in right], 2] > 0).all()
    assert (person[67:] == 0).all()


CHECK = """
import json, sys
from mediapipe.python.solutions import face_mesh_connections as contours
from mediapipe.python.solutions.holistic import HandLandmark, PoseLandmark
names = ("LIPS", "LEFT_EYE", "RIGHT_EYE", "LEFT_EYEBROW", "RIGHT_EYEBROW", "FACE_OVAL", "NOSE")
json.dump({
    "pose": [mark.name.lower() for mark in PoseLandmark],
    "hand": [mark.name.lower() for mark in HandLandmark],
    "face": {n: sorted({i for e in getattr(contours, "FACEMESH_" + n) for i in e}) for n in names},
}, sys.stdout)
"""


@pytest.fixture
def python() -> str:
    path = os.environ.get("INTERCAP_MEDIAPIPE")
    if not path:
        pytest.skip("INTERCAP_MEDIAPIPE does not name a Python with mediapipe")
    return path


def test_mediapipe_itself_calls_the_points_so(python):
    done = subprocess.run([python, "-c", CHECK], capture_output=True, text=True, check=True)
    names = json.loads(done.stdout)
    assert {*tool.COCO_BODY, *tool.FEET.values()} <= {*names["pose"]}
    parts = {"cmc": "1", "mcp": "2", "ip": "3", "tip": "_tip"}
    fingers = {"mcp": "1", "pip": "2", "dip": "3", "tip": "_tip"}
    expected = ["hand_wrist"]
    for name in names["hand"][1:]:
        finger, _, joint = name.replace("_finger", "").partition("_")
        expected.append(finger + (parts if finger == "thumb" else fingers)[joint])
    assert [f"left_{name}" for name in expected] == list(coco.LEFT)
    for points, contour in (
        (tool.JAW, "FACE_OVAL"), (tool.RIGHT_BROW, "RIGHT_EYEBROW"), (tool.LEFT_EYE, "LEFT_EYE"),
        (tool.LEFT_BROW, "LEFT_EYEBROW"), (tool.RIGHT_EYE, "RIGHT_EYE"), (tool.OUTER_LIPS, "LIPS"),
        (tool.INNER_LIPS, "LIPS"), (tool.NOSE_BRIDGE, "NOSE"), (tool.NOSTRILS, "NOSE"),
    ):  # fmt: skip
        assert {*points} <= {*names["face"][contour]}, contour


def test_images_without_anybody_are_looked_at(python, tmp_path):
    (tmp_path / "k1").mkdir()
    cv2.imwrite(str(tmp_path / "k1" / "a_1.png"), np.full((90, 160, 3), 90, np.uint8))
    (tmp_path / "k1" / "a_2.png").write_bytes(b"no image")
    out = tmp_path / "keypoints" / "k1.json"
    command = [python, str(ROOT / "tools/mediapipe_keypoints.py"), str(tmp_path / "k1"), str(out)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert "somebody in 0 of 1 images" in done.stderr and "a_2.png: cannot be read" in done.stderr
    image = {"id": 0, "width": 160, "height": 90, "file_name": "a_1.png"}
    assert json.loads(out.read_text()) == {"images": [image], "annotations": []}
