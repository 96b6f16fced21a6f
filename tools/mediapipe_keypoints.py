"""Detect keypoints with MediaPipe Holistic and write them as COCO-WholeBody JSON.

Runs in a separate environment, because MediaPipe needs an older NumPy:

    python3.11 -m venv mediapipe && mediapipe/bin/pip install mediapipe==0.10.21
    mediapipe/bin/python tools/mediapipe_keypoints.py images/k1 keypoints/k1.json

The input is a folder of images of one camera, or its video. Nothing is downloaded: the models are
in the wheel (Apache-2.0, as MediaPipe). MediaPipe detects one person per image and no small toes.
It has no confidence for points of hands and face: they get that of the wrist and of the nose.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

COCO_BODY = (
    "nose", "left_eye", "right_eye", "left_ear", "right_ear", "left_shoulder", "right_shoulder",
    "left_elbow", "right_elbow", "left_wrist", "right_wrist", "left_hip", "right_hip", "left_knee",
    "right_knee", "left_ankle", "right_ankle",
)  # fmt: skip
# Points of the feet in MediaPipe's pose: the tip of the foot is the big toe.
FEET = {
    "left_big_toe": "left_foot_index", "left_heel": "left_heel",
    "right_big_toe": "right_foot_index", "right_heel": "right_heel",
}  # fmt: skip
COCO_FEET = (
    "left_big_toe", "left_small_toe", "left_heel", "right_big_toe", "right_small_toe", "right_heel",
)  # fmt: skip
# The hand's points have the order of OpenPose and COCO-WholeBody: wrist, then each finger from the
# thumb's root to the little finger's tip.
HAND_POINTS = 21
# Vertices of MediaPipe's face mesh at dlib's 68 landmarks, the person's right side first. The jaw's
# are on the mesh's outline, from temple to temple.
JAW = (
    127, 234, 93, 132, 58, 136, 150, 148, 152, 377, 379, 365, 288, 361, 323, 454, 356,
)  # fmt: skip
RIGHT_BROW, LEFT_BROW = (70, 63, 105, 66, 107), (336, 296, 334, 293, 300)
NOSE_BRIDGE, NOSTRILS = (168, 197, 5, 4), (98, 97, 2, 326, 327)
RIGHT_EYE, LEFT_EYE = (33, 160, 158, 133, 153, 144), (362, 385, 387, 263, 373, 380)
OUTER_LIPS = (61, 40, 37, 0, 267, 270, 291, 321, 314, 17, 84, 91)
INNER_LIPS = (78, 81, 13, 311, 308, 402, 14, 178)
FACE = (
    *JAW, *RIGHT_BROW, *LEFT_BROW, *NOSE_BRIDGE, *NOSTRILS, *RIGHT_EYE, *LEFT_EYE, *OUTER_LIPS,
    *INNER_LIPS,
)  # fmt: skip
IMAGES = {".jpg", ".jpeg", ".png", ".bmp", ".webp", ".tif", ".tiff"}
COMPLEXITY = 1  # the models 0 (lighter) and 2 (heavier) are not in the wheel
PER_LINE = 100  # images between two lines of progress

Points = list[list[float]]  # x, y, confidence of each


def person(
    body: dict[str, Sequence[float]],
    hands: tuple[Sequence[Sequence[float]] | None, Sequence[Sequence[float]] | None],
    face: Sequence[Sequence[float]] | None,
    size: tuple[int, int],
) -> dict[str, list[float]]:
    """COCO-WholeBody's lists of one person.

    ``body`` by MediaPipe's names in lower case: x, y as shares of the image and visibility.
    ``hands`` left and right (21 of x, y) and ``face`` (468 or 478 of x, y), None = not detected.
    ``size`` (width, height) of the image.
    """

    def place(point: Sequence[float], confidence: float) -> list[float]:
        # A share of 0 is the left edge of the first pixel, whose middle is at 0.
        x, y = point[0] * size[0] - 0.5, point[1] * size[1] - 0.5
        return [round(x, 2), round(y, 2), round(confidence, 3)]

    def listed(points: Points) -> list[float]:
        return [number for point in points for number in point]

    unseen = [0.0, 0.0, 0.0]
    lists = {
        "keypoints": listed([place(body[name], body[name][2]) for name in COCO_BODY]),
        "foot_kpts": listed(
            [
                place(body[FEET[name]], body[FEET[name]][2]) if name in FEET else unseen
                for name in COCO_FEET
            ]
        ),
        "face_kpts": listed(
            [unseen if face is None else place(face[i], body["nose"][2]) for i in FACE]
        ),
    }
    for side, points in zip(("left", "right"), hands, strict=True):
        confidence = body[f"{side}_wrist"][2]
        lists[f"{side}hand_kpts"] = listed(
            [unseen if points is None else place(points[i], confidence) for i in range(HAND_POINTS)]
        )
    return lists


def pictures(source: Path) -> Iterator[tuple[str | None, Any]]:
    """Names and images (H, W, 3) BGR of a folder or video; an unreadable image is None."""
    import cv2

    if source.is_dir():
        for path in sorted(p for p in source.iterdir() if p.suffix.lower() in IMAGES):
            if not path.name.startswith("."):
                yield path.name, cv2.imread(str(path))
        return
    video = cv2.VideoCapture(str(source))
    if not video.isOpened():
        raise SystemExit(f"{source}: is neither a folder of images nor a readable video")
    while True:
        found, picture = video.read()
        if not found:
            return
        yield None, picture


def detect(source: Path, *, min_confidence: float) -> dict[str, list[dict[str, Any]]]:
    """COCO data set of one camera's images, without those that cannot be read."""
    import cv2
    from mediapipe.python.solutions.holistic import Holistic, PoseLandmark

    content: dict[str, list[dict[str, Any]]] = {"images": [], "annotations": []}
    with Holistic(model_complexity=COMPLEXITY, min_detection_confidence=min_confidence) as model:
        for number, (name, picture) in enumerate(pictures(source)):
            if picture is None:
                print(f"{source / (name or '')}: cannot be read; it is omitted", file=sys.stderr)
                continue
            height, width = picture.shape[:2]
            image = {"id": number, "width": width, "height": height}
            content["images"].append(image if name is None else image | {"file_name": name})
            found = model.process(cv2.cvtColor(picture, cv2.COLOR_BGR2RGB))
            if found.pose_landmarks is not None:
                marks = found.pose_landmarks.landmark
                body = {
                    mark.name.lower(): (marks[mark].x, marks[mark].y, marks[mark].visibility)
                    for mark in PoseLandmark
                }
                hands = (found.left_hand_landmarks, found.right_hand_landmarks)
                lists = person(
                    body, (_places(hands[0]), _places(hands[1])), _places(found.face_landmarks),
                    (width, height),
                )  # fmt: skip
                content["annotations"].append(
                    {"id": len(content["annotations"]) + 1, "image_id": number, "category_id": 1}
                    | lists
                )
            if (number + 1) % PER_LINE == 0:
                print(f"{number + 1} images", file=sys.stderr)
    return content


def _places(marks: Any) -> list[tuple[float, float]] | None:
    return None if marks is None else [(mark.x, mark.y) for mark in marks.landmark]


def main() -> None:
    """Read the command line, detect, write."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("images", type=Path, help="one camera's folder of images, or its video")
    parser.add_argument("output", type=Path, help="file to write, such as keypoints/k1.json")
    parser.add_argument(
        "--min-confidence", type=float, default=0.5, help="of a person to be found (0.5)"
    )
    options = parser.parse_args()
    if not options.images.exists():
        raise SystemExit(f"{options.images}: does not exist")
    content = detect(options.images, min_confidence=options.min_confidence)
    if not content["images"]:
        raise SystemExit(f"{options.images}: contains no readable image")
    options.output.parent.mkdir(parents=True, exist_ok=True)
    options.output.write_text(json.dumps(content))
    print(
        f"{options.output}: a person in {len(content['annotations'])} of "
        f"{len(content['images'])} images",
        file=sys.stderr,
    )


if __name__ == "__main__":
    main()
