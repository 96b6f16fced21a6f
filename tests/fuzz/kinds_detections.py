"""Keypoints, candidates, masks, class names and ONNX models of detectors."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from intercap_core.config import DetectionsSettings
from intercap_core.formats.detections import candidate_files, keypoint_files
from intercap_core.formats.detections.candidate_files import preview_candidates
from intercap_core.formats.detections.class_names import COCO_NAMES, read_label_map
from intercap_core.formats.detections.image_numbers import CameraImages
from intercap_core.formats.detections.instance import Instance
from intercap_core.formats.detections.keypoint_files import preview_keypoints
from intercap_core.formats.detections.keypoints.coco import WHOLE_BODY
from intercap_core.formats.detections.onnx_pose import PoseModel
from intercap_core.formats.detections.onnx_segmentation import Segmenter
from intercap_core.geometry.camera import masks
from tests.fuzz.kind import ImplausibleError, Kind, finite, within
from tests.helpers import tiny_onnx, tiny_pose

SIZE = (320, 240)
IMAGES = CameraImages(
    "k1", SIZE, np.arange(4), np.arange(4) * 33_333, frozenset(range(4)), tuple("abcd")
)
PICTURE = np.zeros((240, 320, 3), np.uint8)
PICTURE[60:120, 80:140] = (0, 0, 255)
PICTURE[130:200, 200:260] = (255, 0, 0)


def check_instances(instances: Sequence[Instance]) -> None:
    """Masks of the image's size, boxes near it, scores that are shares, labels that are text."""
    for one in instances:
        masks.decode(one.rle, SIZE[1], SIZE[0])
        within(-0.1, 1.3, score=one.score)
        within(-2 * SIZE[0], 3 * SIZE[0], box=np.array(one.box, np.float32))
        if min(one.box[2:]) < 0:
            raise ImplausibleError(f"a box is {one.box}")
        if len(one.label) > 200 or one.label.encode("utf-8", "replace").decode() != one.label:
            raise ImplausibleError(f"a label is {one.label!r:.60}")


def _read_candidates(folder: Path) -> list[str]:
    found = candidate_files.read_camera(
        folder, IMAGES, layout="plain", min_score=0.05, names=COCO_NAMES
    )
    for instances in found.by_image.values():
        check_instances(instances)
    look = preview_candidates(folder, "k1", size=SIZE, names=COCO_NAMES)
    for label in look.labels:
        label.encode()
    notes = [*found.notes, *look.notes]
    return [f"camera k1: {note}" for note in notes if "scaled" not in note]


def _read_keypoints(folder: Path) -> list[str]:
    found = keypoint_files.read_camera(folder, IMAGES, full_confidence=1.0)
    for people in found.by_image.values():
        finite(people=people)
        within(0, 1, confidence=people[..., 2])
        within(-1, max(SIZE), place=people[..., :2])
    notes = [*found.notes, *preview_keypoints(folder, "k1", size=SIZE, full_confidence=1.0)]
    return [f"camera k1: {note}" for note in notes]


def _person(count: int) -> np.ndarray:
    """Points (count, 3) over the image."""
    place = np.linspace(0, 1, count)[:, None]
    return np.hstack([60 + 200 * place, 40 + 150 * place**2, np.full_like(place, 0.8)]).round(2)


def _make_openpose(folder: Path) -> None:
    lists = {"pose_keypoints_2d": 25, "hand_left_keypoints_2d": 21,
             "hand_right_keypoints_2d": 21, "face_keypoints_2d": 70}  # fmt: skip
    person = {"person_id": [-1], **{k: _person(n).ravel().tolist() for k, n in lists.items()}}
    (folder / "k1").mkdir()
    for n in range(4):
        (folder / f"k1/{n:06d}_keypoints.json").write_text(
            json.dumps({"version": 1.3, "people": [person, person]})
        )


def _make_wholebody(folder: Path) -> None:
    people = [
        {"image_id": n, "category_id": 1, "score": 0.9,
         "keypoints": _person(len(WHOLE_BODY)).ravel().tolist()}
        for n in range(4)
    ]  # fmt: skip
    (folder / "k1.json").write_text(json.dumps(people))


def _make_mmpose(folder: Path) -> None:
    points = _person(len(WHOLE_BODY))
    person = {"keypoints": points[:, :2].tolist(), "keypoint_scores": points[:, 2].tolist()}
    frames = [{"frame_id": n + 1, "instances": [person]} for n in range(4)]
    (folder / "results_k1.json").write_text(json.dumps({"meta_info": {}, "instance_info": frames}))


def _mask() -> np.ndarray:
    mask = np.zeros(SIZE[::-1], np.uint8)
    cv2.ellipse(mask, (150, 110), (60, 35), 20, 0, 360, 1, -1)
    return mask


def _make_results(folder: Path) -> None:
    rle = masks.encode(_mask()).decode()
    lengths = np.diff(masks.Runs(rle.encode(), 240, 320).ends, prepend=0).tolist()
    forms = (
        {"size": [240, 320], "counts": rle},
        {"size": [240, 320], "counts": lengths},
        [[100, 90, 180, 95.5, 170, 140, 95, 130]],
        {"size": [240, 320], "counts": rle},
    )
    results = [
        {"image_id": n, "category_id": 47, "score": 0.9 - 0.1 * n, "bbox": [90, 75, 120, 72],
         "segmentation": form}
        for n, form in enumerate(forms)
    ]  # fmt: skip
    (folder / "k1.json").write_text(json.dumps(results))


def _make_data_set(folder: Path) -> None:
    outline = {"x": [10, 60, 60.5, 12], "y": [12, 10, 70, 66]}
    content = {
        "images": [{"id": n, "file_name": f"{'abcd'[n]}.jpg", "width": 160, "height": 120}
                   for n in range(4)],
        "categories": [{"id": 1, "name": "cup"}, {"id": 2, "name": "person"}],
        "annotations": [
            {"id": n, "image_id": n, "category_id": 1 + n % 2, "confidence": 0.7,
             "segmentation": [[10, 12, 60, 10, 60.5, 70, 12, 66]] if n else outline}
            for n in range(4)
        ],
    }  # fmt: skip
    (folder / "k1.json").write_text(json.dumps(content))


def _make_masks(folder: Path) -> None:
    (folder / "k1").mkdir()
    for name in "abcd":
        cv2.imwrite(str(folder / f"k1/{name}__cup.png"), 255 * _mask())


def _make_label_map(folder: Path, name: str, text: str) -> None:
    (folder / name).write_text(text)


def _read_label_map(name: str, folder: Path) -> None:
    for number, label in read_label_map(folder / name).items():
        within(-(2**63), 2**64, number=number)
        if len(label) > 200:
            raise ImplausibleError(f"a label has {len(label)} characters")
        label.encode()


def _segment(folder: Path) -> None:
    model = Segmenter.load(DetectionsSettings(segmentation_model=folder / "model.onnx"))
    for _, instances in model.segment([(0, PICTURE)]):
        check_instances(instances)


def _find_people(folder: Path) -> None:
    model = PoseModel.load(DetectionsSettings(keypoint_model=folder / "model.onnx"))
    people = model.find(PICTURE, [])
    if people.shape[1:] != (135, 3):
        raise ImplausibleError(f"people are {people.shape}")


def _labels(name: str, form: str, text: str) -> Kind:
    make: Callable[[Path], object] = partial(_make_label_map, name=name, text=text)
    return Kind(f"labels-{form}", form, make, [name], partial(_read_label_map, name), share=0.6)


KINDS = (
    Kind("openpose", "json", _make_openpose,
         ["k1/000000_keypoints.json", "k1/000002_keypoints.json"], _read_keypoints,
         named=("camera k1",)),
    Kind("wholebody", "json", _make_wholebody, ["k1.json"], _read_keypoints, named=("camera k1",)),
    Kind("mmpose", "json", _make_mmpose, ["results_k1.json"], _read_keypoints,
         named=("camera k1",)),
    Kind("coco-results", "json", _make_results, ["k1.json"], _read_candidates),
    Kind("coco-data-set", "json", _make_data_set, ["k1.json"], _read_candidates),
    Kind("mask-images", "bytes", _make_masks, ["k1/a__cup.png", "k1/c__cup.png"],
         _read_candidates, named=("no mask for",)),
    _labels("labels.json", "json", json.dumps(
        {"categories": [{"id": n, "name": COCO_NAMES[n]} for n in (1, 2, 47)]})),
    _labels("labels.yaml", "yaml", "names:\n  0: person\n  1: cup\n  2: chair\n"),
    _labels("labels.txt", "text", "person\ncup\nchair\n"),
    Kind("onnx-yolo", "bytes",
         lambda folder: tiny_onnx.yolo(folder / "model.onnx", (320, 256), {"task": "segment"}),
         ["model.onnx"], _segment, share=0.7),
    Kind("onnx-rcnn", "bytes",
         lambda folder: tiny_onnx.mask_rcnn(folder / "model.onnx", "torchvision"),
         ["model.onnx"], _segment, share=0.7),
    Kind("onnx-pose", "bytes", lambda folder: tiny_pose.simcc(folder / "model.onnx"),
         ["model.onnx"], _find_people, share=0.7),
)  # fmt: skip
