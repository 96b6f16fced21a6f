"""Comparison of two versions of a dataset."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import h5py
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.commands.compare import print_comparison
from intercap_core.errors import UserError
from intercap_core.evaluation.compare import compare
from intercap_core.schemas import CONTACT_REGIONS
from tests.helpers import fitted_capture as fitted
from tests.helpers.reduced_capture import Reduction

HAND = CONTACT_REGIONS.index("right_hand")


@pytest.fixture
def versions(capture: fitted.Capture, tmp_path: Path) -> tuple[Path, Path]:
    """Three sequences before, three after, one of which is new; all of the same content."""
    for version, names in (("old", ("a", "b", "gone")), ("new", ("a", "b", "came"))):
        for name in names:
            (tmp_path / version / name).mkdir(parents=True)
            shutil.copyfile(capture.paths["joint"], tmp_path / version / name / "joint.h5")
    return tmp_path / "old", tmp_path / "new"


def test_unchanged_added_and_removed_sequences(versions: tuple[Path, Path]) -> None:
    found = compare(*versions)
    states = dict(zip(found.sequences["sequence"], found.sequences["state"], strict=True))
    assert states == {"a": "same", "b": "same", "came": "added", "gone": "removed"}
    assert len(found.frames) == 0 and found.sequences["state"][0] in ("added", "removed")


def test_a_change_is_measured_in_its_frames(versions: tuple[Path, Path]) -> None:
    with h5py.File(versions[1] / "b" / "joint.h5", "r+") as file:
        file["joints"][1] += [0.0, 0.003, 0.004]  # 5 mm
        file["translation"][2] += [0.010, 0.0, 0.0]
        turn = Rotation.from_rotvec([0, 0, np.radians(3.0)]).as_matrix()
        file["rotation"][2] = turn @ file["rotation"][2]
        file["contact_probability"][3, HAND] = 0.0
        file["flagged"][3, 0], file["flag_reason"][3] = True, b"body: ?"
    with h5py.File(versions[0] / "b" / "joint.h5", "r+") as file:
        file["contact_probability"][3, HAND] = 0.9
    found = compare(*versions)
    row = found.sequences.set_index("sequence").loc["b"]
    assert (row["state"], row["changed_frames"], row["frames"]) == ("changed", 3, 5)
    assert (row["body_mm"], row["body_max_mm"]) == pytest.approx((5 / 5, 5), rel=1e-4)
    assert row["object_max_mm"] == pytest.approx(10) and row["contact_changed_frames"] == 1
    frames = found.frames.set_index("frame")
    assert frames.index.tolist() == [1, 2, 3] and set(frames["sequence"]) == {"b"}
    assert frames.loc[1, "hands_mm"] == pytest.approx(5, rel=1e-4)
    assert frames.loc[2, "object_deg"] == pytest.approx(3)
    assert frames.loc[3, ["touches", "touches_no_more"]].tolist() == ["", "right_hand"]
    assert frames.loc[3, ["flag_before", "flag_after"]].tolist() == ["", "body (?)"]
    back = compare(*reversed(versions)).frames.set_index("frame")
    assert back.loc[3, "touches"] == "right_hand"


def test_figures_of_both_versions_are_listed(
    versions: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert compare(*versions).figures.empty
    for folder, value in zip(versions, (1.5, 20.29), strict=True):
        summary = {
            "dataset": "x",
            "frames": 4,
            "vertex_to_cloud": {"body_mm": value, "other": None},
        }
        (folder / "summary.json").write_text(json.dumps(summary))
    figures = compare(*versions).figures.set_index("figure")
    assert figures.loc["vertex_to_cloud.body_mm"].tolist() == [1.5, 20.29]
    assert set(figures.index) == {"frames", "vertex_to_cloud.body_mm"}
    paths = print_comparison(*versions, tmp_path / "changes")
    assert "20.29" in capsys.readouterr().out
    written = pd.read_csv(paths[-1]).set_index("figure")
    assert written.loc["vertex_to_cloud.body_mm"].tolist() == [1.5, 20.29]
    (versions[0] / "summary.json").write_text("{")
    assert compare(*versions).figures.empty


def test_unstated_contact_is_no_change(versions: tuple[Path, Path]) -> None:
    with h5py.File(versions[0] / "b" / "joint.h5", "r+") as file:
        file["contact_probability"][:, HAND] = 0.9
    with h5py.File(versions[1] / "b" / "joint.h5", "r+") as file:
        file["contact_probability"][:] = np.nan
    found = compare(*versions).sequences.set_index("sequence")
    assert found.loc["b", "contact_changed_frames"] == 5
    with h5py.File(versions[1] / "b" / "joint.h5", "r+") as file:
        file.attrs["made_by"] = "another program"
    found = compare(*versions).sequences.set_index("sequence")
    assert found.loc["b", "contact_changed_frames"] == 0 and found.loc["b", "state"] == "same"


def test_recordings_of_different_lengths_are_reported(
    capture: fitted.Capture, versions: tuple[Path, Path], tmp_path: Path
) -> None:
    whole = {stage: capture.paths[stage] for stage in ("frames", "joint")}
    shorter = Reduction(sets=4).apply(whole, tmp_path / "shorter")["joint"]
    shutil.copyfile(shorter, versions[1] / "a" / "joint.h5")
    row = compare(*versions).sequences.set_index("sequence").loc["a"]
    assert row["state"] == "not comparable" and "5 frames before and 4 after" in row["note"]


def test_a_broken_artefact_costs_its_own_sequence(versions: tuple[Path, Path]) -> None:
    (versions[1] / "a" / "joint.h5").write_bytes(b"nothing")
    states = compare(*versions).sequences.set_index("sequence")
    assert states.loc["a", "state"] == "not comparable" and "joint.h5" in states.loc["a", "note"]
    assert states.loc["b", "state"] == "same"


def test_tables_are_written_and_printed(
    versions: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with h5py.File(versions[1] / "b" / "joint.h5", "r+") as file:
        file["joints"][1] += 0.1
    written = print_comparison(*versions, tmp_path / "changes")
    printed = capsys.readouterr().out
    assert "3 of 4 sequences differ, in 1 frame; 1 are the same" in " ".join(printed.split())
    assert [path.name for path in written] == [
        "compare_sequences.csv", "compare_frames.csv", "compare_figures.csv"
    ]  # fmt: skip
    assert pd.read_csv(written[1])["frame"].tolist() == [1]


@pytest.mark.parametrize(("folder", "words"), [("none", "no such folder"), ("", "no sequence")])
def test_folders_without_results(tmp_path: Path, folder: str, words: str) -> None:
    with pytest.raises(UserError, match=words):
        compare(tmp_path / folder, tmp_path)
