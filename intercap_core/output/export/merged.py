"""Exports of all sequences as one: a COCO file and a BOP dataset with one split.

Both are merged from the exports of the sequences. Numbers of images, annotations and scenes are
unique over the sequences, and those of classes are the same in all of them. Masks and images of BOP
are hard links to the files of the sequences where the file system has links, otherwise copies.
"""

from __future__ import annotations

import json
import os
import shutil
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TextIO

from intercap_core import artefacts
from intercap_core.disk import link
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.output.export.bop import SPLIT, object_id
from intercap_core.stage_list import STAGES

_README = """\
{dataset}: exports of {count} sequences as one

coco/annotations.json  person and object in every image, as in <sequence>/export/coco
  file_name is relative to the folder of the dataset; sequence and frame name the frame of an image
  info.sequences: body file, frame and estimated errors of each sequence; facts about each frame
    are in <sequence>/export/coco/annotations.json
bop/                   one dataset in BOP's layout with the split {split}
  a scene is a camera of a sequence: scenes.json names both, and the lens
  scene_about.json of a scene: the frame that each image shows, and its flagged parts
  models/ holds the objects, numbered as in categories.json and as in COCO less 1
{missing}"""


def class_numbers(objects: Mapping[str, ObjectEntry]) -> dict[str, int]:
    """Number of each object: that of its mesh's file name, such as 9 of 09_cup.ply.

    If two objects have the same, their positions in ``objects``, from 1.
    """
    numbers = {name: object_id(entry.mesh) for name, entry in objects.items()}
    if len(set(numbers.values())) == len(numbers):
        return numbers
    return {name: place for place, name in enumerate(objects, 1)}


def write(
    folder: Path, dataset: str, exports: Mapping[str, Path], objects: Mapping[str, ObjectEntry]
) -> None:
    """Replace ``folder`` by the merged exports.

    A sequence without a format, such as BOP of a person alone, is left out of it.

    Args:
        dataset: name of the dataset.
        exports: folder of the export of each sequence.
        objects: the list of objects, by name, with those of all sequences.

    Raises UserError if a file of an export is missing or damaged.
    """
    part = artefacts.part_of(folder)
    shutil.rmtree(part, ignore_errors=True)
    part.mkdir(parents=True)
    numbers = class_numbers(objects)
    found = {
        kind: {name: path / kind for name, path in exports.items() if (path / kind).is_dir()}
        for kind in ("coco", "bop")
    }
    if found["coco"]:
        _merge_coco(part / "coco" / "annotations.json", dataset, found["coco"], numbers)
    if found["bop"]:
        _merge_bop(part / "bop", found["bop"], numbers)
    missing = [kind for kind, folders in found.items() if not folders]
    text = "".join(f"{name} is omitted: no sequence has it\n" for name in missing)
    (part / "README.txt").write_text(
        _README.format(dataset=dataset, count=len(exports), split=SPLIT, missing=text),
        encoding="utf-8",
    )
    shutil.rmtree(folder, ignore_errors=True)
    os.replace(part, folder)


def _merge_coco(
    path: Path, dataset: str, exports: Mapping[str, Path], numbers: Mapping[str, int]
) -> None:
    """Write the images and annotations of all sequences, reading one sequence at a time."""
    path.parent.mkdir()
    info: dict[str, Any] = {"description": dataset, "sequences": {}}
    categories: dict[int, dict[str, Any]] = {}
    images = annotations = 0  # written so far
    with (
        path.open("w", encoding="utf-8") as out,
        tempfile.TemporaryFile("w+", encoding="utf-8", dir=path.parent) as later,
    ):
        out.write('{"images":[')
        for name, folder in exports.items():
            content = _load(folder / "annotations.json")
            facts = {key: value for key, value in content["info"].items() if key != "by_frame"}
            info["sequences"][name] = facts
            class_of = {}
            for category in content["categories"]:
                number = class_of[category["id"]] = _category(category["name"], numbers)
                categories[number] = {**category, "id": number}
            labels = [
                {
                    **entry,
                    "id": annotations + entry["id"],
                    "image_id": images + entry["image_id"],
                    "category_id": class_of[entry["category_id"]],
                }
                for entry in content["annotations"]
            ]
            pictures = [
                {
                    **image,
                    "id": images + image["id"],
                    "sequence": name,
                    "file_name": f"{name}/export/coco/{image['file_name']}",
                }
                for image in content["images"]
            ]
            _write_entries(later, annotations, labels)
            _write_entries(out, images, pictures)
            images, annotations = images + len(pictures), annotations + len(labels)
        out.write('],"annotations":[')
        later.seek(0)
        shutil.copyfileobj(later, out)
        out.write(f'],"categories":{_dense([categories[n] for n in sorted(categories)])}')
        out.write(f',"info":{_dense(info)}}}\n')


def _category(name: str, numbers: Mapping[str, int]) -> int:
    """Number of a class: 1 = person, then the objects."""
    if name != "person" and name not in numbers:
        raise UserError(
            f"object {name!r} of an export is not in the list of objects; re-run stage 'export'"
        )
    return 1 if name == "person" else 1 + numbers[name]


def _write_entries(out: TextIO, before: int, entries: Sequence[Mapping[str, Any]]) -> None:
    """Append entries to a list that has ``before`` of them."""
    for place, entry in enumerate(entries, before):
        out.write(("," if place else "") + _dense(entry))


def _merge_bop(folder: Path, exports: Mapping[str, Path], numbers: Mapping[str, int]) -> None:
    targets: list[dict[str, Any]] = []
    scenes: dict[str, dict[str, Any]] = {}
    models: dict[str, Any] = {}
    names: dict[int, str] = {}
    (folder / "models").mkdir(parents=True)
    for name, own in exports.items():
        object_ = _load(own.parent / STAGES["export"].folder_marker)["object"]
        number, before = _category(object_, numbers) - 1, len(scenes)
        ((own_number, model),) = _load(own / "models" / "models_info.json").items()
        if number not in names:
            names[number], models[str(number)] = object_, model
            ply = own / "models" / f"obj_{int(own_number):06d}.ply"
            _link(ply, folder / "models" / f"obj_{number:06d}.ply")
        for scene, lens in _load(own / "lenses.json").items():
            merged = f"{before + int(scene):06d}"
            scenes[merged] = {"sequence": name, **lens}
            _merge_scene(own / SPLIT / scene, folder / SPLIT / merged, number)
        targets += [
            {**target, "scene_id": before + target["scene_id"], "obj_id": number}
            for target in _load(own / "test_targets_bop19.json")
        ]
    _link(next(iter(exports.values())) / "camera.json", folder / "camera.json")
    for file, content in (
        ("models/models_info.json", models),
        ("test_targets_bop19.json", targets),
        ("scenes.json", scenes),
        ("categories.json", [{"id": n, "name": names[n]} for n in sorted(names)]),
    ):
        (folder / file).write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")


def _merge_scene(own: Path, merged: Path, number: int) -> None:
    """Link the files of a scene; ``scene_gt.json`` is written with the object's ``number``."""
    for file in sorted(own.rglob("*")):
        target = merged / file.relative_to(own)
        if file.name == "scene_gt.json":
            content = {
                image: [{**entry, "obj_id": number} for entry in entries]
                for image, entries in _load(file).items()
            }
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_text(json.dumps(content, indent=1) + "\n", encoding="utf-8")
        elif file.is_file():
            _link(file, target)


def _link(file: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        link(file, target)
    except FileNotFoundError:
        raise UserError(f"{file}: is missing; re-run stage 'export'") from None


def _load(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise UserError(f"{path}: cannot be read ({error}); re-run stage 'export'") from None


def _dense(content: Any) -> str:
    return json.dumps(content, separators=(",", ":"))
