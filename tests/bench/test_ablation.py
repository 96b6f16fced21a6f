"""The ablation: every weight has its variant, what is known is not computed again, its pictures."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import cv2
import h5py
import numpy as np
import pytest

from bench import again
from bench.ablation import EVERYTHING, SEQUENTIAL, VARIANTS, ablate, markdown, rows
from intercap_core.config import JointSettings
from intercap_core.errors import UserError
from intercap_core.project import load_project
from intercap_core.schemas import CONTACT_REGIONS
from tests.helpers import fitted_capture as fitted

NAME = "s01_o03"
FRAMES = 9  # more than half a second, so that there is a path to draw


def test_every_weight_is_left_out_in_some_variant() -> None:
    """And so are the images that are looked at anew, and the cameras; other variants change what a
    term does."""
    fields = JointSettings.model_fields.items()
    weights = {name for name, field in fields if isinstance(field.default, float)}
    assert len(weights) >= 8
    for changed in VARIANTS.values():
        JointSettings(**changed)  # raises for a setting that is not there
    without = [changed for name, changed in VARIANTS.items() if name.startswith("without ")]
    assert not any(value for changed in without for value in changed.values())
    assert {name for changed in without for name in changed} == (
        weights | {"look_again", "refine_cameras"}
    )
    others = [changed for changed in VARIANTS.values() if changed and changed not in without]
    assert others == [{"contact_to": "annotated"}]
    assert VARIANTS[EVERYTHING] == {}
    assert len({tuple(sorted(changed)) for changed in VARIANTS.values()}) == len(VARIANTS)


def test_the_table_says_where_a_figure_is_not_known() -> None:
    figures = {
        EVERYTHING: {"body_pve_mm": 6.764, "penetration_mean_mm": 2.5, "slip_mm_s": 143.2},
        SEQUENTIAL: {"body_pve_mm": 7.0},
    }
    first, second = rows(figures)
    assert first[:2] == [EVERYTHING, "6.76"] and first[-1] == "2.50" and "143" in first
    assert second[:2] == [SEQUENTIAL, "7.00"] and second[-1] == "–"
    text = markdown(figures, Path("quick.yaml"), ["one", "two"])
    table = [line for line in text.splitlines() if line.startswith("|")]
    assert len(table) == 4 and len({line.count("|") for line in table}) == 1
    assert "one, two" in text and "quick.yaml" in text


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> fitted.Capture:
    made = fitted.make_capture(tmp_path_factory.mktemp("capture"), name=NAME, total=FRAMES)
    with h5py.File(made.paths["joint"], "r+") as file:
        file["contact_probability"][:, CONTACT_REGIONS.index("right_hand")] = 0.9
    return made


@pytest.fixture
def settings(capture: fitted.Capture, tmp_path: Path) -> Path:
    """A project whose one sequence was taken to the joint fit."""
    return fitted.write_project(tmp_path, capture, NAME)


@pytest.fixture
def computed(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, dict[str, Any]]]:
    """Stages that were run and the joint settings' changes; a stage copies what the project has,
    and metrics are the real ones."""
    done: list[tuple[str, dict[str, Any]]] = []
    whole = again.run_step

    def run(stage: str, project: Any, sequence: str, *, inputs: Any, output: Path) -> None:
        done.append((stage, project.config.joint.model_dump(exclude_defaults=True)))
        if stage == "joint":
            output.parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(project.artefact(sequence, "joint"), output)
        else:
            whole(stage, project, sequence, inputs=inputs, output=output)

    monkeypatch.setattr(again, "run_step", run)
    return done


def test_each_variant_is_computed_once(
    settings: Path, tmp_path: Path, computed: list[tuple[str, dict[str, Any]]]
) -> None:
    variants, folder = [EVERYTHING, "without stick"], tmp_path / "ablation"
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "results").rglob("*.h5")}
    paths, figures = ablate(settings, [], variants, folder)
    stick = {"stick_weight": 0.0}
    assert computed == [("joint", {}), ("metrics", {}), ("joint", stick), ("metrics", stick)]
    assert list(figures) == [*variants, SEQUENTIAL]
    assert figures[EVERYTHING]["body_pve_mm"] == pytest.approx(10, abs=1e-2)
    assert figures[EVERYTHING]["object_translation_mm"] == pytest.approx(2, abs=1e-2)
    assert figures[SEQUENTIAL]["object_translation_mm"] == pytest.approx(4, abs=1e-2)
    assert "contact_detected_f1" not in figures[SEQUENTIAL]
    computed.clear()
    assert ablate(settings, [], variants, folder) == (paths, figures)
    assert not computed
    paths[EVERYTHING][NAME]["metrics"].with_suffix(".key").write_text("of other code")
    ablate(settings, [], variants, folder)
    assert computed == [("metrics", {})]
    # nothing of the project is written over
    assert before == {p: p.stat().st_mtime_ns for p in (tmp_path / "results").rglob("*.h5")}


def test_what_is_missing_is_named(settings: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"no variant 'without luck'; known are everything"):
        ablate(settings, [], ["without luck"], tmp_path)
    with pytest.raises(UserError, match=r"no sequence 'nobody'; it lists s01_o03"):
        ablate(settings, ["nobody"], [EVERYTHING], tmp_path)
    (tmp_path / "results" / "trial" / NAME / "body_fit.h5").unlink()
    with pytest.raises(UserError, match=r"body_fit\.h5: not there.*intercap run"):
        ablate(settings, [], [EVERYTHING], tmp_path)


def test_pictures_of_what_is_held(settings: Path, capture: fitted.Capture, tmp_path: Path) -> None:
    pytest.importorskip("matplotlib")
    from bench import ablation_pictures

    project = load_project(settings)
    paths = {variant: {NAME: capture.paths} for variant in VARIANTS}
    drawn = ablation_pictures.draw_pictures(project, paths, tmp_path / "pictures")
    assert [p.name for p in drawn] == ["grasps.jpg", "acceleration.png", "contact_path.png"]
    for path in drawn:
        image = cv2.imread(str(path))
        assert image.shape[0] > 200 and image.std() > 10, path.name
    # a part of the variants gives the pictures that they allow
    some = {variant: paths[variant] for variant in (EVERYTHING, "without smoothness")}
    drawn = ablation_pictures.draw_pictures(project, some, tmp_path / "some")
    assert [p.name for p in drawn] == ["acceleration.png"]


def test_the_path_is_of_skin_that_truly_touches(settings: Path, capture: fitted.Capture) -> None:
    from bench import ablation_pictures

    paths = {EVERYTHING: {NAME: capture.paths}}
    held = ablation_pictures._held(load_project(settings), paths, {"joint": EVERYTHING})
    known, vertex, frames = held[NAME]
    assert vertex in capture.model.regions["right_hand"]
    assert len(frames) == FRAMES
    path = known.tracks["truth"].local(vertex)
    off = known.tracks["joint"].local(vertex) - path  # body 10 mm and object 2 mm down
    np.testing.assert_allclose(np.linalg.norm(off, axis=1), 0.008, atol=1e-5)
    radius = np.abs(capture.mesh.vertices).max()
    assert np.abs(np.linalg.norm(path, axis=1) - radius).max() < 0.0045
