"""Single faults of meshes, names and truth are refused by file and place."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from intercap_core.commands.check_recordings import faults_of_truth
from intercap_core.errors import UserError
from intercap_core.geometry.rigid.mesh_files import get_colours, load_mesh
from tests.fuzz.kinds import KINDS
from tests.fuzz.plausible import check_plausible


def _text(old: str, new: str) -> Callable[[Path], None]:
    """Replace text of the mesh file, once."""

    def edit(folder: Path) -> None:
        content = (folder / "box.ply").read_text()
        assert old in content
        (folder / "box.ply").write_text(content.replace(old, new, 1))

    return edit


def _a_kilometre_away(folder: Path) -> None:
    mesh = trimesh.load(folder / "box.ply", process=False)
    mesh.apply_translation([1000.0, 0, 0])
    mesh.export(folder / "box.ply", encoding="ascii")


@pytest.mark.parametrize(
    ("edit", "words"),
    [
        (_text("element face 12", "element face 1000000000"),
         "box.ply.*states 1000000008 elements"),
        (_text("element face 12", "element face 13"), "box.ply"),
        (_text("\n3 ", "\n1000000000 "), "box.ply: a face states 10"),
        (_a_kilometre_away, "box.ply.*1000 m from its origin"),
    ],
)  # fmt: skip
def test_a_fault_of_a_mesh_is_refused_by_file_and_place(
    edit: Callable[[Path], None], words: str, tmp_path: Path
) -> None:
    kind = KINDS["mesh-ply-text"]
    kind.make(tmp_path)
    kind.read(tmp_path)
    edit(tmp_path)
    with pytest.raises(UserError, match=words) as caught:
        kind.read(tmp_path)
    assert str(tmp_path) in str(caught.value)


def test_labels_of_undecodable_mask_names_are_text(tmp_path: Path) -> None:
    kind = KINDS["mask-images"]
    kind.make(tmp_path)
    (tmp_path / "k1/a__cup.png").rename(tmp_path / "k1/a__c\udcffup.png")
    assert not check_plausible(kind.read(tmp_path))  # encodes every label


def test_textures_outside_the_folder_of_the_mesh_are_ignored(tmp_path: Path) -> None:
    folder = tmp_path / "object"
    folder.mkdir()
    KINDS["mesh-textured"].make(folder)
    (folder / "box.png").rename(tmp_path / "outside.png")
    cv2.imwrite(str(tmp_path / "outside.png"), np.full((4, 4, 3), (0, 0, 255), np.uint8))
    for name in ("../outside.png", str(tmp_path / "outside.png"), "/dev/zero"):
        (folder / "box.mtl").write_text(f"newmtl a\nKd 0.8 0.8 0.8\nmap_Kd {name}\n")
        colours = get_colours(load_mesh(folder / "box.obj"))
        assert not (colours[:, :3] == (255, 0, 0)).all(1).any()


def test_damaged_truth_is_refused(tmp_path: Path) -> None:
    (tmp_path / "truth.h5").write_text("no truth")
    (fault,) = faults_of_truth(tmp_path / "truth.h5")
    assert str(tmp_path / "truth.h5") in fault
