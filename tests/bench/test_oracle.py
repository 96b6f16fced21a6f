"""The oracle: what is put in is the truth, what is known is not computed again, ratios by hand."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial import cKDTree

from bench import again, oracle
from bench.oracle import (
    AS_IT_IS,
    FREE,
    OPEN,
    TRUE_MESH,
    VARIANTS,
    consult,
    joint_figures,
    slug,
)
from bench.oracle_inputs import (
    REMOVED_SHARE,
    removed_faces,
    write_open_mesh,
    write_true_mesh,
    write_true_scene,
)
from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.evaluation.scene_errors import displacement
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.joint.cameras import BIAS
from intercap_core.joint.inputs import read_cameras
from intercap_core.schemas import SCENE
from tests.helpers import fitted_capture as fitted

NAME = "s01_o03"
BIASES = np.array([0.004, -0.002, 0.001])  # metres, by the scene's order of cameras
ORDER = [2, 0, 1]  # of the scene's cameras in the truth
OBJECTS = (
    "suitcase", "skateboard", "football", "umbrella", "tennis_racquet", "toolbox", "chair",
    "bottle", "cup", "stool",
)  # fmt: skip


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> fitted.Capture:
    """The scene's cameras are off, and the truth lists them in another order and frame."""
    made = fitted.make_capture(tmp_path_factory.mktemp("capture"), name=NAME, total=4)
    turn = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    frame = rigid(turn, np.array([0.3, 0.1, -0.2]))
    with h5py.File(made.paths["truth"], "r+") as file:
        file["camera_names"][...] = file["camera_names"][:][ORDER]
        file["master_from_colour"][...] = frame @ file["master_from_colour"][:][ORDER]
        file.create_dataset("depth_bias", data=BIASES[ORDER])
    with h5py.File(made.paths["scene"], "r+") as file:
        file["present"][...] = True
        file["master_from_colour"][1:, 0, 3] += 0.01
        file["depth_bias"][...] = [0.001, 0.002, np.nan]
        whole = np.diag(np.full(21, 1e-4)) + 1e-5
        whole[:6] = whole[:, :6] = 0  # the master's pose is known
        file["camera_covariance"][...] = whole.reshape(3, 7, 3, 7)
    return made


def _scene_off(scene: Path, capture: fitted.Capture) -> np.ndarray:
    with artefacts.read(scene, SCENE) as found:
        return displacement(found["master_from_colour"], capture.rig.master_from_colour, 0)


def test_cameras_become_the_true_ones_by_their_names(
    capture: fitted.Capture, tmp_path: Path
) -> None:
    scene, truth = capture.paths["scene"], capture.paths["truth"]
    assert _scene_off(scene, capture)[1:] == pytest.approx(0.01)
    poses = write_true_scene(scene, truth, tmp_path / "a.h5", biases=False, held=True)
    both = write_true_scene(scene, truth, tmp_path / "b.h5", biases=True, held=True)
    free = write_true_scene(scene, truth, tmp_path / "c.h5", biases=True, held=False)
    for path in (poses, both, free):
        assert _scene_off(path, capture) == pytest.approx(0, abs=1e-9)
    with (
        artefacts.read(scene, SCENE) as was,
        artefacts.read(poses, SCENE) as one,
        artefacts.read(both, SCENE) as two,
        artefacts.read(free, SCENE) as three,
    ):
        np.testing.assert_array_equal(one["depth_bias"], was["depth_bias"])
        # a depth that the scene does not know stays unknown
        np.testing.assert_allclose(two["depth_bias"], [*BIASES[:2], np.nan])
        left = one["camera_covariance"]
        assert not left[:, :BIAS].any() and not left[..., :BIAS].any()
        kept = was["camera_covariance"]
        np.testing.assert_array_equal(left[:, BIAS, :, BIAS], kept[:, BIAS, :, BIAS])
        assert not two["camera_covariance"].any()
        np.testing.assert_array_equal(three["camera_covariance"], kept)
        changed = {"master_from_colour", "depth_bias", "camera_covariance"}
        assert was.keys() == three.keys()
        for key in set(was.keys()) - changed:
            np.testing.assert_array_equal(three[key], was[key], err_msg=key)
        # what is held has nothing to settle
        assert len(read_cameras(two)._free) == 0
        np.testing.assert_array_equal(read_cameras(one)._free, [6, 13])


def test_a_foreign_truth_is_told(capture: fitted.Capture, tmp_path: Path) -> None:
    truth = shutil.copy(capture.paths["truth"], tmp_path / "truth.h5")
    with h5py.File(truth, "r+") as file:
        del file["depth_bias"]
    with pytest.raises(UserError, match=r"truth\.h5: states no depth bias"):
        write_true_scene(
            capture.paths["scene"], truth, tmp_path / "scene.h5", biases=True, held=True
        )
    with h5py.File(truth, "r+") as file:
        file["camera_names"][0] = b"k9"
    with pytest.raises(UserError, match=r"knows no camera 'k3'"):
        write_true_scene(
            capture.paths["scene"], truth, tmp_path / "scene.h5", biases=False, held=True
        )
    assert not (tmp_path / "scene.h5").exists()


@pytest.mark.parametrize("name", OBJECTS)
def test_the_open_mesh_lacks_a_tenth_and_is_accepted(name: str, tmp_path: Path) -> None:
    entry = fitted.object_entry(name)
    whole = ObjectMesh.load(entry)
    mesh = ObjectMesh.load(write_open_mesh(tmp_path / "open.ply", entry))
    assert not mesh.watertight
    assert len(mesh.faces) == pytest.approx((1 - REMOVED_SHARE) * len(whole.faces), rel=0.01)
    touched = whole.vertices[whole.contact_vertices]  # those that faces still use stay listed
    kept = mesh.vertices[mesh.contact_vertices]
    assert cKDTree(touched).query(kept)[0].max() < 1e-5 and len(kept) > 0.7 * len(touched)
    removed = removed_faces(whole.vertices, whole.faces, 0)
    np.testing.assert_array_equal(removed, removed_faces(whole.vertices, whole.faces, 0))
    assert (removed != removed_faces(whole.vertices, whole.faces, 1)).any()


def test_the_true_mesh_is_the_studios(capture: fitted.Capture, tmp_path: Path) -> None:
    entry = write_true_mesh(capture.paths["truth"], tmp_path / "true.ply", capture.object_)
    assert entry.name == capture.object_.name and entry.symmetry == capture.object_.symmetry
    mesh = ObjectMesh.load(entry)
    np.testing.assert_allclose(mesh.vertices, capture.mesh.vertices, atol=1e-6)
    np.testing.assert_array_equal(mesh.contact_vertices, capture.mesh.contact_vertices)


@pytest.fixture
def settings(capture: fitted.Capture, tmp_path: Path) -> Path:
    """A project whose one sequence was taken to the joint fit."""
    return fitted.write_project(tmp_path, capture, NAME)


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, str]]:
    """Stage, and the folders that its scene and its mesh lie in. A fit copies what the project
    has, twice as far off with an open mesh, and the cameras that are put in; metrics are the real
    ones."""
    done: list[tuple[str, str, str]] = []
    whole = again.run_step

    def run(stage: str, project: Any, sequence: str, *, inputs: Any, output: Path) -> None:
        mesh = project.objects["football"].mesh
        done.append((stage, inputs["scene"].parent.name, mesh.parent.name))
        output.parent.mkdir(parents=True, exist_ok=True)
        if stage == "metrics":
            whole(stage, project, sequence, inputs=inputs, output=output)
            return
        shutil.copy(project.artefact(sequence, stage), output)
        with h5py.File(output, "r+") as file, h5py.File(inputs["scene"]) as scene:
            if stage == "joint":
                file["master_from_colour"][...] = scene["master_from_colour"][:]
                if mesh.parent.name == slug(OPEN):
                    file["translation"][:, 1] += fitted.OBJECT_OFFSET_M / 2

    monkeypatch.setattr(again, "run_step", run)
    return done


def test_each_variant_is_computed_once_and_measured_as_the_run_is(
    settings: Path, tmp_path: Path, computed: list[tuple[str, str, str]]
) -> None:
    folder = tmp_path / "oracle"
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "results").rglob("*.h5")}
    variants = ["true cameras", TRUE_MESH, FREE, OPEN]
    found = consult(settings, [], folder, variants=variants)
    assert list(found) == variants
    put = {stage: [rest for which, *rest in computed if which == stage] for stage in oracle.STAGES}
    assert len(put["object_track"]) == len(variants) - 1  # two variants share a track
    assert len(put["joint"]) == len(put["metrics"]) == len(variants)
    for name, (scene, mesh) in zip(variants, put["joint"], strict=True):
        variant = VARIANTS[name]
        assert scene == (slug(name) if variant.cameras else NAME)
        assert mesh == (slug(name) if variant.mesh else "objects")
    assert put["metrics"] == [[NAME, "objects"]] * len(variants)
    # all that is known is taken as it is, and what is of other content is not
    computed.clear()
    consult(settings, [], folder, variants=variants)
    assert not computed
    (folder / NAME / slug(FREE) / "joint.key").write_text("of other code")
    consult(settings, [], folder, variants=variants)
    assert computed == [("joint", slug(FREE), slug(FREE))]
    assert before == {p: p.stat().st_mtime_ns for p in (tmp_path / "results").rglob("*.h5")}


def test_floors_and_ratio_by_hand_beside_the_figures_of_others(
    settings: Path,
    tmp_path: Path,
    computed: list[tuple[str, str, str]],
    capsys: pytest.CaptureFixture[str],
) -> None:
    output, folder = tmp_path / "evaluation.json", tmp_path / "oracle"
    old = {"joint.extrinsics_mm": 2.5, "joint.open_mesh_ratio": 9.0, "oracle.old.body_pve_mm": 1.0}
    output.write_text(json.dumps(old))
    variants = [AS_IT_IS, TRUE_MESH, FREE, OPEN]
    oracle.main([str(settings), "--output", str(output), "--folder", str(folder), "--variants",
                 *variants])  # fmt: skip
    printed = capsys.readouterr().out
    assert AS_IT_IS in printed and "joint.open_mesh_ratio 2.0" in printed
    written = json.loads(output.read_text())
    assert written["joint.extrinsics_mm"] == 2.5  # not this command's
    assert "oracle.old.body_pve_mm" not in written
    assert {f"oracle.{slug(name)}.body_pve_mm" for name in variants} <= set(written)
    assert written["joint.extrinsics_floor_mm"] == pytest.approx(0, abs=1e-6)
    assert written["joint.object_translation_floor_mm"] == pytest.approx(2, abs=1e-2)
    assert written["oracle.as_it_is.extrinsics_mm"] == pytest.approx(10, abs=1e-3)
    assert written["oracle.football.open_mesh.object_translation_mm"] == pytest.approx(4, abs=1e-2)
    assert written["joint.open_mesh_ratio"] == pytest.approx(2, abs=1e-3)
    assert written["joint.open_mesh_worst_ratio"] == pytest.approx(2, abs=1e-3)
    assert written["joint.open_mesh_p95_ratio"] == pytest.approx(2, abs=1e-3)
    assert written["joint.open_mesh_body_ratio"] == pytest.approx(1)
    # a part of the variants gives what it allows
    found = consult(settings, [], folder, variants=variants)
    assert set(joint_figures({FREE: found[FREE]})) == {"extrinsics_floor_mm"}
    some = joint_figures({name: found[name] for name in (AS_IT_IS, OPEN)})
    assert "open_mesh_ratio" in some and "extrinsics_floor_mm" not in some


@pytest.mark.parametrize("option", ["sequence", "variant"])
def test_what_is_unknown_is_named(
    settings: Path, option: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit):
        oracle.main([str(settings), f"--{option}s", "nobody"])
    assert f"no {option} 'nobody'" in capsys.readouterr().err
