"""Figures over sequences, worked by hand, and the tables made from them."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from intercap_core.evaluation import figures
from intercap_core.evaluation.contact import SWEEP_M
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.flags import OF_OBJECT, PARTS
from intercap_core.output.site import tables
from intercap_core.schemas import CONTACT_REGIONS


def sequence(name: str = "a", total: int = 4, **values: object) -> SequenceMetrics:
    """A sequence without truth whose every length is 10 mm, but for what is given."""
    lengths = (
        "penetration_mean", "penetration_median", "penetration_max", "penetration_object",
        "ground_penetration", "body_to_cloud", "object_to_cloud", "body_visible_to_cloud",
        "object_visible_to_cloud", "cloud_to_body", "acceleration_body", "acceleration_object",
    )  # fmt: skip
    known = {key: np.full(total, 0.010, np.float32) for key in lengths}
    known |= {
        "flagged": np.zeros((total, len(PARTS)), bool),
        "flag_reason": np.array([""] * total, object),
        "contact_frame": np.ones(total, bool),
        "region_names": np.array(CONTACT_REGIONS, object),
        "region_contact": np.zeros((total, len(CONTACT_REGIONS)), bool),
        "contact_probability": np.zeros((total, len(CONTACT_REGIONS)), np.float32),
    }
    known |= {key: np.asarray(value) for key, value in values.items()}
    truth = any(key.startswith("truth/") for key in known)
    return SequenceMetrics(name, "p01", "cup", 30.0, truth, known)


def test_penetration_is_over_the_contact_frames_of_all_sequences() -> None:
    first = sequence(
        penetration_mean=[0.002, 0.004, 0.5, 0.5], contact_frame=[True, True, False, False]
    )
    second = sequence(penetration_mean=[0.024] * 4, contact_frame=[True, False, False, False])
    found = figures.penetration_figures([first, second])
    assert found["mean_mm"] == pytest.approx(10)
    assert found["median_mm"] == pytest.approx(4)
    assert found["share_le_5mm"] == pytest.approx(2 / 3)
    assert found["share_le_20mm"] == pytest.approx(2 / 3)


def test_cloud_figures_omit_frames_without_a_cloud() -> None:
    found = figures.cloud_figures([sequence(body_to_cloud=[0.01, 0.02, np.nan, 0.03])])
    assert found["body_mm"] == pytest.approx(20)
    assert found["object_visible_mm"] == pytest.approx(10)
    assert figures.floor_figures([sequence()]) == {}


def _tracked(**values: object) -> SequenceMetrics:
    total = 4
    known: dict[str, object] = {
        "truth/joint/object_translation": [0.001, 0.003, 0.900, 0.100],
        "truth/joint/object_rotation": [1.0, 2.0, 99.0, 3.0],
        "truth/joint/object_centre": np.zeros((total, 3)),
        "truth/joint/object_turn": [np.nan, 0.0, 0.0, 0.0],
        "truth/joint/object_flagged": [False, False, True, False],
        "truth/object_centre": np.zeros((total, 3)),
        "truth/object_moving": np.zeros(total, bool),
        "truth/object_views": [6, 2, 1, 6],
        "truth/joint/acceleration_object": [np.nan, 0.001, 0.003, np.nan],
        "flagged": np.outer([False, False, True, False], np.isin(PARTS, OF_OBJECT)),
    }
    return sequence(**(known | values))


def test_object_figures_are_medians_over_frames_seen_twice() -> None:
    found = figures.truth_figures([_tracked()], "joint")
    assert found["object_translation_mm"] == pytest.approx(3)
    assert found["object_rotation_deg"] == pytest.approx(2)
    assert found["object_translation_p95_mm"] == pytest.approx(3 + 0.9 * 97)
    assert found["lost_share"] == 0.5 and found["lost_unnoticed_share"] == 0.25
    assert found["first_frame_success"] == 1.0
    assert found["rest_jitter_mm"] == 0
    assert found["acceleration_error"] == pytest.approx(2)
    assert "body_pve_mm" not in found and "contact_f1" not in found
    assert figures.truth_figures([_tracked()], "object_track") == {}


def test_contact_and_hands_in_grasp() -> None:
    counts = np.zeros((4, len(SWEEP_M), 4), int)
    counts[:, SWEEP_M.index(0.0045)] = [3, 1, 1, 95]
    touching = np.zeros((4, 12), bool)
    touching[:2, 1] = True
    found_regions = touching.copy()
    found_regions[0, 1] = False
    s = _tracked(
        **{
            "truth/joint/vertex_contact_counts": counts,
            "truth/joint/region_contact": found_regions,
            "truth/contact_region": touching,
            "truth/joint/contact_frame": np.array([False, True, False, True]),
            "truth/contact_frame": np.array([True, True, False, False]),
            "truth/joint/hand_mpjpe": np.array([[9, 0.02], [9, 0.04], [9, 9], [9, 9.0]]),
            "truth/sweep": np.array(SWEEP_M),
        }
    )
    found = figures.truth_figures([s], "joint")
    assert found["contact_f1"] == pytest.approx(0.75)
    assert found["contact_region_f1"] == pytest.approx(2 / 3)
    assert found["contact_recall"] == 0.5
    assert found["hand_grasp_mpjpe_mm"] == pytest.approx(30)
    sweep = figures.contact_sweep([s], "joint")
    assert sweep[4.5] == pytest.approx(0.75) and np.isnan(sweep[30.0])


def test_flags_are_judged_on_truly_bad_frames() -> None:
    s = _tracked(**{"truth/joint/body_pve": np.array([0.01, 0.05, 0.01, 0.01])})
    # bad: the body of frame 1, the object of frames 2 and 3, of which that of 2 is flagged
    found = figures.flag_figures([s])
    assert found == pytest.approx({"bad_frames": 0.75, "flag_recall": 1 / 3, "flag_precision": 1})
    s.values["flagged"][1, PARTS.index("object")] = True  # says nothing about the body
    assert figures.flag_figures([s])["flag_recall"] == pytest.approx(1 / 3)
    s.values["physics/bad"] = np.array([True, False, False, True])  # frame 0 is fine
    with_physics = figures.flag_figures([s])
    assert with_physics["flag_recall_with_physics"] == pytest.approx(2 / 3)
    assert with_physics["flag_recall"] == pytest.approx(1 / 3)
    # flagged objects of frames 1 and 2, contradicted ones of 0 and 3: those of 2 and 3 are bad
    assert with_physics["flag_precision_with_physics"] == pytest.approx(1 / 2)
    assert figures.flag_figures([sequence()]) == {}


def test_a_lost_object_is_noticed_by_its_own_stage_alone() -> None:
    s = _tracked(flagged=np.ones((4, 4), bool), **{"truth/joint/object_flagged": np.zeros(4, bool)})
    assert figures.truth_figures([s], "joint")["lost_unnoticed_share"] == 0.5


def test_jitter_is_pooled_over_the_frames_of_rest() -> None:
    def shaking(step_m: float, turn_deg: float, moving: list[bool]) -> SequenceMetrics:
        centre = np.zeros((4, 3))
        centre[1::2, 0] = step_m
        return _tracked(
            **{
                "truth/joint/object_centre": centre,
                "truth/joint/object_turn": np.array([np.nan, *[turn_deg] * 3]),
                "truth/object_moving": np.array(moving),
            }
        )

    # three steps of 1 mm and 1 degree, and one of 7 mm and 5 degrees
    both = [shaking(0.001, 1, [False] * 4), shaking(0.007, 5, [False, False, True, True])]
    found = figures.truth_figures(both, "joint")
    assert found["rest_jitter_mm"] == pytest.approx(np.sqrt(52 / 4))
    assert found["rest_jitter_deg"] == pytest.approx(np.sqrt(28 / 4))
    never = figures.truth_figures([shaking(0.001, 1, [True] * 4)], "joint")
    assert "rest_jitter_mm" not in never and "rest_jitter_deg" not in never


def test_late_and_early_starts_of_motion_do_not_cancel() -> None:
    total, fps = 40, 30.0

    def started(at: int) -> np.ndarray:
        centre = np.zeros((total, 3))
        centre[at:, 0] = 0.02 * np.arange(1, total - at + 1)
        return centre

    def late_by(frames: int) -> SequenceMetrics:
        moving = np.arange(total) >= 19
        values = {
            "truth/joint/object_translation": np.zeros(total),
            "truth/joint/object_rotation": np.zeros(total),
            "truth/joint/object_centre": started(20 + frames),
            "truth/joint/object_turn": np.zeros(total),
            "truth/joint/object_flagged": np.zeros(total, bool),
            "truth/joint/acceleration_object": np.zeros(total),
            "truth/object_centre": started(20),
            "truth/object_moving": moving,
            "truth/object_views": np.full(total, 6),
            "flagged": np.zeros((total, len(PARTS)), bool),
        }
        return SequenceMetrics("s", "p", "cup", fps, True, values)

    found = figures.truth_figures([late_by(4), late_by(-2)], "joint")
    assert found["motion_onset_frames"] == pytest.approx(3)
    assert found["motion_onset_late_frames"] == pytest.approx(1)


def test_extrinsics_omit_the_master_and_absent_cameras() -> None:
    none = np.nan
    moved = {"before": [0.01, none, none, 0.03], "after": [0, none, none, 0.002]}
    s = sequence(**{f"truth/extrinsics_{when}": values for when, values in moved.items()})
    assert figures.extrinsics_figures([s]) == pytest.approx(
        {"before_mean_mm": 20, "before_worst_mm": 30, "after_mean_mm": 1, "after_worst_mm": 2}
    )


def test_summary_has_exactly_the_agreed_keys() -> None:
    content = figures.summary("demo", [_tracked(), sequence("b", contact_frame=np.zeros(4, bool))])
    assert list(content) == [
        "dataset", "sequences", "frames", "truth", "penetration", "vertex_to_cloud"
    ]  # fmt: skip
    assert content["frames"] == 8
    assert set(content["truth"]["joint"]) <= set(figures.SUMMARY_TRUTH)
    assert tuple(content["penetration"]) == figures.SUMMARY_PENETRATION
    assert list(content["vertex_to_cloud"]) == [
        "body_mm", "object_mm", "body_visible_mm", "object_visible_mm"
    ]  # fmt: skip
    nothing = figures.summary("demo", [sequence(contact_frame=np.zeros(4, bool))])
    assert nothing["penetration"]["mean_mm"] is None and nothing["truth"] == {}
    json.dumps(nothing, allow_nan=False)


def test_ranks_put_the_worst_sequence_first() -> None:
    good = sequence("good", object_visible_to_cloud=[0.005] * 4)
    bad = sequence("bad", flagged=np.ones((4, 4), bool), penetration_mean=[0.03] * 4)
    untouched = sequence("untouched", contact_frame=np.zeros(4, bool))
    table = tables.sequence_table([good, bad, untouched], {"bad": (0.01, 0.004)})
    ranks = dict(zip(table["sequence"], table["rank"], strict=True))
    assert ranks["bad"] == 1 and sorted(ranks.values()) == [1, 2, 3]
    row = table.set_index("sequence").loc["bad"]
    assert row["extrinsics_residual_before_mm"] == pytest.approx(10)
    assert row["penetration.mean_mm"] == pytest.approx(30, rel=1e-5)
    assert row["flagged.object_frames"] == 4


def test_frame_table_has_a_row_a_frame(tmp_path: Path) -> None:
    regions = np.zeros((4, len(CONTACT_REGIONS)), bool)
    regions[1, [0, 11]] = True
    stated = np.where(regions, 0.9, 0.1)
    tracked = _tracked(region_contact=regions, contact_probability=stated)
    frames = tables.frame_table([tracked, sequence("b")])
    assert len(frames) == 8
    assert frames["contact_probability.mouth"].tolist()[:3] == pytest.approx([0.1, 0.9, 0.1])
    assert frames["contact_regions"].tolist()[:2] == ["", "left_hand;mouth"]
    assert frames["joint.object_translation_mm"][0] == pytest.approx(1)
    assert frames["joint.object_translation_mm"].isna().sum() == 4
    by_sequence = tables.sequence_table([_tracked(), sequence("b")], {})
    for folder in ("one", "two"):
        tables.write(tmp_path / folder, {"sequences": by_sequence, "frames": frames})
    for path in (tmp_path / "one").iterdir():
        assert path.read_bytes() == (tmp_path / "two" / path.name).read_bytes()
    read = pd.read_parquet(tmp_path / "one" / "frames.parquet")
    pd.testing.assert_frame_equal(read, frames, check_dtype=False)
    assert len(pd.read_csv(tmp_path / "one" / "sequences.csv")) == 2
