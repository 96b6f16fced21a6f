"""Merged exports of two sequences: a person with a cup and a person with a football."""

from __future__ import annotations

import json
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from pycocotools.coco import COCO

from intercap_core.output.export import merged
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted
from tests.helpers.fitted_capture import Capture

FIRST, SECOND = exported.NAME, "s01_o03"
NUMBERS = {"cup": 9, "football": 3}  # of the meshes' file names


def _load(path: Path) -> Any:
    return json.loads(path.read_text())


@pytest.fixture(scope="module")
def dataset(
    captures: dict[str, Capture], everything: Path, tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """The folder of a dataset: exports of both sequences, and the merged ones."""
    folder = tmp_path_factory.mktemp("dataset")
    (folder / FIRST).mkdir()
    (folder / FIRST / "export").symlink_to(everything)
    (folder / SECOND).mkdir()
    exported.run(captures[SECOND], folder / SECOND / "export", formats=("bop", "coco"))
    objects = {captures[name].object_.name: captures[name].object_ for name in (FIRST, SECOND)}
    exports = {name: folder / name / "export" for name in (FIRST, SECOND)}
    merged.write(folder / "export", "both", exports, objects)
    return folder


def test_coco_has_both_sequences_with_unique_ids(dataset: Path) -> None:
    read = COCO(str(dataset / "export" / "coco" / "annotations.json"))
    content = read.dataset
    for key in ("images", "annotations"):
        numbers = [entry["id"] for entry in content[key]]
        assert numbers == list(range(1, len(numbers) + 1))
    names = {category["name"]: category["id"] for category in content["categories"]}
    assert names == {"person": 1} | {name: 1 + number for name, number in NUMBERS.items()}
    for name, object_ in ((FIRST, "cup"), (SECOND, "football")):
        own = COCO(str(dataset / name / "export" / "coco" / "annotations.json"))
        images = [image for image in content["images"] if image["sequence"] == name]
        assert len(images) == len(own.dataset["images"])
        for image, there in zip(images, own.dataset["images"], strict=True):
            assert image["file_name"] == f"{name}/export/coco/{there['file_name']}"
            ours, theirs = (
                coco.loadAnns(coco.getAnnIds(imgIds=number))
                for coco, number in ((read, image["id"]), (own, there["id"]))
            )
            classes = [read.cats[entry["category_id"]]["name"] for entry in ours]
            assert classes == ["person", object_][: len(classes)] and len(ours) == len(theirs)
            for entry, before in zip(ours, theirs, strict=True):
                assert np.array_equal(read.annToMask(entry), own.annToMask(before))


def test_bop_scenes_are_those_of_the_sequences(dataset: Path) -> None:
    bop = dataset / "export" / "bop"
    scenes = _load(bop / "scenes.json")
    assert sorted(path.name for path in (bop / "test").iterdir()) == sorted(scenes)
    assert Counter(scene["sequence"] for scene in scenes.values()) == {FIRST: 3, SECOND: 3}
    models = {int(number): info for number, info in _load(bop / "models/models_info.json").items()}
    assert {entry["name"]: entry["id"] for entry in _load(bop / "categories.json")} == NUMBERS
    for number, info in models.items():
        mesh = trimesh.load(bop / "models" / f"obj_{number:06d}.ply")
        assert np.ptp(mesh.vertices, axis=0) == pytest.approx([info[f"size_{a}"] for a in "xyz"])
    objects = set()
    for name, scene in scenes.items():
        folder = bop / "test" / name
        cameras, gt = _load(folder / "scene_camera.json"), _load(folder / "scene_gt.json")
        assert cameras.keys() == gt.keys() == _load(folder / "scene_gt_info.json").keys()
        for image, (entry,) in gt.items():
            assert entry["obj_id"] in models and len(entry["cam_R_m2c"]) == 9
            objects.add((scene["sequence"], entry["obj_id"]))
            for kind in ("mask", "mask_visib"):
                assert (folder / kind / f"{int(image):06d}_000000.png").is_file()
    assert objects == {(FIRST, NUMBERS["cup"]), (SECOND, NUMBERS["football"])}
    for target in _load(bop / "test_targets_bop19.json"):
        (entry,) = _load(bop / "test" / f"{target['scene_id']:06d}" / "scene_gt.json")[
            str(target["im_id"])
        ]
        assert entry["obj_id"] == target["obj_id"]


def test_bop_toolkit_reads_and_scores_it(dataset: Path, tmp_path: Path) -> None:
    """Of exported poses shifted by 5 mm, the benchmark finds all below 6 mm and none below 4."""
    inout = pytest.importorskip("bop_toolkit_lib.inout", reason="bop_toolkit is not installed")
    from bop_toolkit_lib import misc, pose_error, pose_matching, score

    bop, shift = dataset / "export" / "bop", np.array([[3.0], [4.0], [0.0]])
    infos = inout.load_json(bop / "models" / "models_info.json", keys_to_int=True)
    points = {n: inout.load_ply(bop / "models" / f"obj_{n:06d}.ply")["pts"] for n in infos}
    symmetries = {n: misc.get_symmetry_transformations(info, 0.01) for n, info in infos.items()}
    truths, visible = (
        {int(place.name): read(place / f"scene_{name}.json") for place in (bop / "test").iterdir()}
        for name, read in (
            ("gt", inout.load_scene_gt),
            ("gt_info", lambda path: inout.load_json(path, keys_to_int=True)),
        )
    )
    shifted = [
        {
            "scene_id": scene, "im_id": image, "obj_id": entry["obj_id"], "score": 1.0,
            "R": entry["cam_R_m2c"], "t": entry["cam_t_m2c"] + shift, "time": 1.0,
        }
        for scene, images in truths.items()
        for image, (entry,) in images.items()
    ]  # fmt: skip
    inout.save_bop_results(tmp_path / "shifted.csv", shifted)
    errors: dict[int, list[dict[str, Any]]] = {scene: [] for scene in truths}
    for own in inout.load_bop_results(tmp_path / "shifted.csv"):
        scene, image, object_ = own["scene_id"], own["im_id"], own["obj_id"]
        (truth,) = truths[scene][image]
        error = pose_error.mssd(
            own["R"], own["t"], truth["cam_R_m2c"], truth["cam_t_m2c"],
            points[object_], symmetries[object_],
        )  # fmt: skip
        (info,) = visible[scene][image]
        errors[scene].append(
            {**own, "est_id": 0, "errors": {0: [error]}, "gt_visib_fracts": [info["visib_fract"]]}
        )
    for limit, recall in ((4.0, 0.0), (6.0, 1.0)):
        matches = []
        for scene, images in truths.items():
            valid = {image: [True] for image in images}
            matches += pose_matching.match_poses_scene(
                scene, images, visible[scene], valid, errors[scene], [limit], 1
            )
        found = score.calc_localization_scores(list(truths), list(infos), matches, 1, False)
        assert found["recall"] == recall and found["targets_count"] == len(shifted) > 0


def test_objects_with_the_same_number_are_numbered_by_position(
    captures: dict[str, fitted.Capture],
) -> None:
    cup, ball = (captures[name].object_ for name in (FIRST, SECOND))
    assert merged.class_numbers({"cup": cup, "football": ball}) == NUMBERS
    assert merged.class_numbers({"a": ball, "b": cup, "c": cup}) == {"a": 1, "b": 2, "c": 3}


def test_without_any_export_the_readme_says_so(tmp_path: Path) -> None:
    (tmp_path / "export").mkdir()
    (tmp_path / "export" / "old").write_text("of an earlier run")
    merged.write(tmp_path / "export", "none", {}, {})
    assert [path.name for path in (tmp_path / "export").iterdir()] == ["README.txt"]
    text = (tmp_path / "export" / "README.txt").read_text()
    assert "coco is omitted" in text and "bop is omitted" in text
