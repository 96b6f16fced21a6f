"""Masks and candidates from the images alone."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.config import PersonSettings
from intercap_core.formats.detections.read import FROM_DETECTOR, FROM_IMAGES, Detections
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera import masks
from intercap_core.person.segmentation.image_segmentation import segment_images
from intercap_core.schemas import PERSON as PERSON_SCHEMA
from intercap_core.schemas import SCENE
from intercap_core.stages import person
from tests.helpers.synthetic_people import seen_by, write_detections
from tests.person.segmentation.carrying import BOX, BOX_M, PERSON, SCENERY, STOOL, Carrying

STEP = 4
CAPTURE = Carrying()
CERTAIN = np.zeros(CAPTURE.joints.shape[:2])


@pytest.fixture(scope="module")
def written(tmp_path_factory) -> tuple[Path, Path, Path]:
    """Frames, scene, and detections whose images all have candidates: none."""
    folder = tmp_path_factory.mktemp("carrying")
    detections = write_detections(folder / "detections.h5", CAPTURE.rig, seen())
    return (*CAPTURE.write(folder), detections)


def seen() -> list[list[list[np.ndarray]]]:
    """The person's keypoints [T][C][1], off by a few pixels."""
    keypoints = seen_by(CAPTURE.people, CAPTURE.rig, CAPTURE.zup_from_master)
    keypoints[..., :2] += np.random.default_rng(1).normal(0, 3, keypoints[..., :2].shape)
    return [[[keypoints[t, c]] for c in range(CAPTURE.views)] for t in range(CAPTURE.sets)]


def run(written: tuple[Path, Path, Path], output: Path, segmentation: str = "images") -> Path:
    frames, scene, detections = written
    person.run(
        frames=frames,
        detections=detections,
        scene=scene,
        output=output,
        settings=PersonSettings(segmentation=segmentation),
    )
    return output


@pytest.fixture(scope="module")
def segmented(written, tmp_path_factory) -> Path:
    return run(written, tmp_path_factory.mktemp("person") / "person.h5")


def overlap(a: np.ndarray, b: np.ndarray) -> float:
    return float((a & b).sum() / max(1, (a | b).sum()))


def best_overlaps(written, segmented, t: int, part: int) -> list[float]:
    """IoU of each view's best candidate with the true mask, in views with more than 300 pixels."""
    frames, _, detections = written
    with Frames.open(frames) as images:
        moments = np.tile(np.arange(images.num_sets)[:, None], (1, CAPTURE.views))
    detected = Detections.load(detections).showing(moments).with_candidates_of(segmented)
    result = []
    for c, camera in enumerate(CAPTURE.rig):
        truth = CAPTURE.true_masks(t, camera, STEP) == part
        if truth.sum() > 300:
            drawn = [candidate.mask()[::STEP, ::STEP] for candidate in detected.candidates(t, c)]
            result.append(max([overlap(mask, truth) for mask in drawn], default=0.0))
    return result


def test_the_person_is_segmented(segmented):
    with artefacts.read(segmented, PERSON_SCHEMA) as found:
        rles = artefacts.unpack_ragged(found["mask_offsets"], found["mask_rle"])
        assert (found["mask_source"] == FROM_IMAGES).all()
    for t in (1, 7, 12):
        for c, camera in enumerate(CAPTURE.rig):
            truth = CAPTURE.true_masks(t, camera, STEP) == PERSON
            mask = masks.decode(rles[t * CAPTURE.views + c], 1080, 1920)[::STEP, ::STEP]
            assert overlap(mask, truth) > 0.75


@pytest.mark.parametrize("t", [1, 6, 12])
def test_carried_object_is_a_candidate_at_rest_and_in_the_hand(written, segmented, t):
    found = best_overlaps(written, segmented, t, BOX)
    assert len(found) >= 2 and np.median(found) > 0.6 and min(found) > 0.35


def test_static_object_near_the_path_is_a_candidate(written, segmented):
    found = best_overlaps(written, segmented, 12, SCENERY)
    assert len(found) >= 3 and min(found) > 0.6


def test_candidates_have_their_size_and_are_few(segmented):
    with artefacts.read(segmented, PERSON_SCHEMA) as found:
        extents, scores = found["candidate_extents"], found["candidate_scores"]
        count = np.diff(found["candidate_offsets"])
        things = found["candidate_things"]
    for size in (np.linalg.norm(BOX_M), np.linalg.norm(STOOL[1] - STOOL[0])):
        assert (np.abs(extents - size) < 0.12).sum() >= CAPTURE.sets
    assert ((scores > 0) & (scores <= 1)).all() and (things >= 0).all()
    assert count.max() <= 8  # no furniture that nobody comes near


def test_moving_objects_are_found_without_a_floor(written, tmp_path):
    frames, scene = CAPTURE.write(tmp_path, floor=False)
    wanted = np.zeros((CAPTURE.sets, CAPTURE.views), bool)
    wanted[12] = True
    with Frames.open(frames) as images, artefacts.read(scene, SCENE) as artefact:
        found = segment_images(images, artefact, CAPTURE.joints, CERTAIN, wanted)
    overlaps = []
    for c, camera in enumerate(CAPTURE.rig):
        truth = CAPTURE.true_masks(12, camera, STEP)
        size = camera.colour.height, camera.colour.width
        drawn = masks.decode(found[12, c].person, *size)[::STEP, ::STEP]
        assert overlap(drawn, truth == PERSON) > 0.7
        things = [masks.decode(one.rle, *size) for one in found[12, c].candidates]
        if (truth == BOX).sum() > 300:
            overlaps.append(max(overlap(m[::STEP, ::STEP], truth == BOX) for m in things))
    assert np.median(overlaps) > 0.6


def test_only_requested_images_are_segmented_and_gaps_are_filled(written):
    frames, scene, _ = written
    wanted = np.zeros((CAPTURE.sets, CAPTURE.views), bool)
    wanted[7, 1] = wanted[7, 3] = wanted[9, 0] = True
    joints = CAPTURE.joints.copy()
    joints[6:8] = np.nan
    with Frames.open(frames) as images, artefacts.read(scene, SCENE) as artefact:
        found = segment_images(images, artefact, joints, CERTAIN, wanted)
        nobody = segment_images(images, artefact, np.full_like(joints, np.nan), CERTAIN, wanted)
    assert sorted(found) == [(7, 1), (7, 3), (9, 0)] and not nobody
    truth = CAPTURE.true_masks(7, CAPTURE.rig[1], STEP) == PERSON
    assert overlap(masks.decode(found[7, 1].person, 1080, 1920)[::STEP, ::STEP], truth) > 0.7


def test_images_that_a_detector_saw_are_left_to_it(written, tmp_path, monkeypatch):
    monkeypatch.setattr(Frames, "depth", lambda *_: pytest.fail("opens depth"))
    output = run(written, tmp_path / "person.h5", "auto")
    with artefacts.read(output, PERSON_SCHEMA) as found:
        assert (found["mask_source"] == FROM_DETECTOR).all()
        assert "candidate_rle" not in found


def test_image_candidates_follow_those_of_the_detector(written, segmented, tmp_path):
    frames, scene, _ = written
    rle = masks.encode(np.eye(1080, 1920, dtype=bool))
    named = {(7, 1): [("cup", rle)]}
    detections = write_detections(tmp_path / "detections.h5", CAPTURE.rig, seen(), named)
    inputs = (frames, scene, detections)
    moments = np.tile(np.arange(CAPTURE.sets)[:, None], (1, CAPTURE.views))
    found = Detections.load(detections).showing(moments)
    first = found.with_candidates_of(segmented)
    second = found.with_candidates_of(run(inputs, tmp_path / "both.h5", "both"))
    alone, both = (one.candidates(7, 1) for one in (first, second))
    assert [one.label for one in both] == ["cup"] + [""] * len(alone) and len(alone) > 0
    assert [one.index for one in both] == list(range(len(both)))
    assert [one.rle for one in both] == [rle, *(one.rle for one in alone)]
    for t, c in np.ndindex(CAPTURE.sets, CAPTURE.views):  # and another run gives the same
        if (t, c) != (7, 1):
            again = [one.rle for one in second.candidates(t, c)]
            assert again == [one.rle for one in first.candidates(t, c)]
    with artefacts.read(tmp_path / "both.h5", PERSON_SCHEMA) as artefact:
        person = artefacts.unpack_ragged(artefact["mask_offsets"], artefact["mask_rle"])
        # no candidate is the person, so the images give the mask
        assert artefact["mask_source"][7, 1] == FROM_IMAGES and person[7 * CAPTURE.views + 1]
    none = run(inputs, tmp_path / "detector.h5", "detector")
    assert [one.label for one in found.with_candidates_of(none).candidates(7, 1)] == ["cup"]
