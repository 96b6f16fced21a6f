"""Settings and figures of `intercap dev evaluate`."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from intercap_core.commands.evaluate import bodies as body_evaluation
from intercap_core.commands.evaluate import objects as object_evaluation
from intercap_core.commands.evaluate.objects import lost_by_draw
from intercap_core.commands.evaluate.part import Measured, require_truth
from intercap_core.commands.evaluate.run import PARTS, QUICK_SETTINGS
from intercap_core.errors import UserError
from intercap_core.evaluation.body_errors import BodyErrors
from intercap_core.evaluation.object_errors import ObjectErrors
from intercap_core.project import load_project

CONFIGS = sorted(Path("config/capture").glob("*.yaml"))


def test_no_two_recordings_share_a_seed() -> None:
    seeds: list[int] = []
    for path in CONFIGS:
        studio = load_project(path).config.studio
        assert studio is not None and studio.slips == "silent"
        rooms = [entry.room for entry in studio.captures.values()]
        assert {"furnished", "bare"} == set(rooms)
        seeds += [entry.seed for entry in studio.captures.values()]
    of_config = ("no_detector", "redrawn_1", "redrawn_2")
    objects = [path for path in PARTS["objects"].settings if path.stem not in of_config]
    others = [
        Path(f"config/{other}/config.yaml")
        for other in ("demo", "test", "bench", "evaluation", "annotate", "detector")
    ]
    others += [QUICK_SETTINGS, Path("config/evaluation/long.yaml")]
    others += sorted(Path("config/field").glob("*.yaml"))
    for path in [*others, *objects]:
        studio = load_project(path).config.studio
        assert studio is not None
        seeds += {entry.seed for entry in studio.captures.values()}
    assert len(CONFIGS) == 3 and len(seeds) == len(set(seeds))


def test_all_objects_are_evaluated_with_and_without_a_detector() -> None:
    project, without = (
        load_project(Path(f"config/object/{n}.yaml")) for n in ("config", "no_detector")
    )
    assert {row.object for row in project.sequences.values()} == set(project.objects)
    assert all(row.candidates is None for row in without.sequences.values())
    assert [row.recordings for row in without.sequences.values()] == [
        row.recordings for row in project.sequences.values()
    ]


def test_redrawn_detections_are_of_the_same_recordings() -> None:
    one, *others = (
        load_project(Path(f"config/object/{name}.yaml"))
        for name in ("config", "redrawn_1", "redrawn_2")
    )
    for number, other in enumerate(others, 1):
        for name, capture in other.config.studio.captures.items():
            first = one.config.studio.captures[name]
            assert capture == first.model_copy(update={"redrawn_detections": number})
        assert list(other.sequences) == list(one.sequences)


def test_lost_shares_are_by_object_and_draw() -> None:
    def measured(dataset: str, shares: dict[str, float]) -> Any:
        errors = [
            SimpleNamespace(object_=name, lost=np.arange(100) < 100 * share)
            for name, share in shares.items()
        ]
        return SimpleNamespace(dataset=dataset, errors=errors)

    draws = [
        measured("object", {"cup": 0.3, "chair": 0.0}),
        measured("object_noise2", {"cup": 0.9}),
        measured("object_redrawn1", {"cup": 0.04, "chair": 0.0}),
        measured("object_redrawn2", {"cup": 0.1, "chair": 0.02}),
    ]
    assert lost_by_draw(draws) == {"cup": [0.3, 0.04, 0.1], "chair": [0.0, 0.0, 0.02]}
    assert lost_by_draw(draws[:2]) == {}


def test_captures_without_truth_are_rejected() -> None:
    with pytest.raises(UserError, match="has no truth to be evaluated against"):
        require_truth(load_project(Path("config/config.yaml")))


def _cup(translation: list[float], views: list[int]) -> ObjectErrors:
    count = len(translation)
    none = np.zeros(count, bool)
    return ObjectErrors(
        "a", "cup", 15.0, np.array(translation), np.full(count, 0.5), np.full(count, np.nan),
        np.zeros((count, 3)), np.zeros((count, 3)), np.array(views), ~none, none,
    )  # fmt: skip


def test_keys_name_area_object_and_variant() -> None:
    cup = _cup([0.002, 0.003, 0.1], [6, 2, 1])
    flat = object_evaluation.flat([Measured("object", [cup])])
    assert flat["object.translation_median_mm"] == pytest.approx(2.5)
    assert flat["object.cup.lost_share"] == flat["object.views_0_to_1.lost_share"] / 3
    flat = object_evaluation.flat([Measured("object_noise2", [cup])])
    assert flat["object.noise2_translation_median_mm"] == pytest.approx(2.5)
    assert flat["object.cup.noise2_lost_share"] == pytest.approx(1 / 3)
    assert flat["object.noise2_views_2.frames"] == 1


def test_reduced_bodies_share_recordings() -> None:
    projects = [load_project(path) for path in PARTS["bodies"].settings]
    first = projects[0]
    assert first.config.studio is not None
    made = {row.recordings for row in first.sequences.values()}
    others = [project for project in projects if project.config.studio is None]
    assert len(others) == 6
    for project in others:
        assert {row.recordings for row in project.sequences.values()} <= made
    assert [body_evaluation.rig_of(project.config) for project in others] == [
        "all views, one shape per frame",
        "all views, no depth",
        "4 views",
        "2 views",
        "2 views, no depth",
        "1 view",
    ]
    assert {path for path in Path("config/body").glob("*.yaml")} < set(PARTS["bodies"].settings)


def _body(name: str, pve_mm: float, *, interaction: str = "drink", flagged: bool = False):
    def of(*shape: int) -> np.ndarray:
        return np.full((2, *shape), 1e-3 * pve_mm)

    return BodyErrors(
        name, interaction, Path(f"{name}.h5"), 6, of(), of(), of(22), of(2), of(2),
        np.ones((2, 2), bool), of(), of(), of(), np.ones((2, 22)), np.ones((2, 30)),
        np.full(2, flagged), {},
    )  # fmt: skip


def _bodies() -> list[Measured[BodyErrors]]:
    main = [_body("a", 5), _body("b", 7, interaction="sit")]
    return [
        Measured("object", main, rig="all views"),
        Measured("object_noise2", [_body("c", 50, flagged=True)], rig="all views"),
        Measured("body_two_view", [_body("b", 90)], ["a"], "2 views"),
    ]


def test_keys_of_bodies_name_the_variant_and_the_interaction() -> None:
    flat = body_evaluation.flat(_bodies())
    assert flat["body.pve_mm"] == pytest.approx(6)
    assert flat["body.pve_mm_spread"] == pytest.approx(1)  # of 5 and 7 mm
    assert flat["body.sit.mpjpe_mm"] == pytest.approx(7)
    assert flat["body.noise2_pve_mm"] == flat["body.drink.noise2_pve_mm"] == pytest.approx(50)
    assert flat["body.two_view_mpjpe_mm"] == pytest.approx(90)
    assert "body.drink.two_view_mpjpe_mm" not in flat
    assert flat["body.compared_pve_mm"] == pytest.approx(7)  # of b, which two views saw as well
    assert flat["body.joint_left_knee_mm"] == pytest.approx(6)
    # bad frames are those of c, which are flagged, and those of b by two views, which are not
    assert flat["body.bad_frames_recall"] == pytest.approx(0.5)
    assert flat["body.bad_frames_precision"] == 1
    assert flat["body.bad_frames_share"] == pytest.approx(0.5)
    assert flat["body.two_view_bad_frames_recall"] == 0
