"""Physics of metrics.h5 in tables, page, exports and card."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pytest

from intercap_core.inputs.arrays import read_pickle
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted
from tests.helpers.site import merge, write_page, write_summaries

NAME = "s01_o09"
CARRIER = ["floor", "unsupported", "unsupported", "held by something unknown"]
BAD = [False, True, True, False]
PENETRATION_M = [0.0, 0.001, 0.002, np.nan]
PHYSICS = {
    "carrier": np.array(CARRIER, "S"), "bad": BAD, "penetration": np.float32(PENETRATION_M),
    "support_acceleration": np.full(4, 9.81, np.float32),
    "support_acceleration_sigma": np.full(4, 0.1, np.float32),
    "release_frame": np.array([0, 1, 3], np.int32),
    "release_displacement": np.array([0.010, 0.015, 0.050]),
    "release_support": np.array(["floor", "floor", "furniture"], "S"),
}  # fmt: skip
RELEASED = "25.0 mm (mean of 3 releases)"


@pytest.fixture(scope="module")
def folder(
    captures: Mapping[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory
) -> Path:
    """Results of a sequence with three releases and of another one without physics."""
    results = tmp_path_factory.mktemp("physics")
    made = {
        name: capture.copied(results / "made" / name, "metrics")
        for name, capture in captures.items()
    }
    for name, capture in made.items():
        with capture.edit("metrics") as file:
            if "physics" in file:
                del file["physics"]
            for key, value in PHYSICS.items() if name == NAME else ():
                file[f"physics/{key}"] = value
            file.attrs["physics_note"] = "two rests are not released" if name == NAME else "no mesh"
    write_page(made[NAME], results, NAME)
    merge(write_summaries(made, results / "summaries"), made, results, "demo")
    formats = ["amass", "intercap", "coco", "gmr", "holosoma"]
    exported.run(made[NAME], results / "export", formats=formats)
    return results


def rows_of(folder: Path, table: str) -> list[dict[str, str]]:
    with open(folder / "tables" / f"{table}.csv", newline="") as file:
        return list(csv.DictReader(file))


def test_tables_have_figures_and_frames(folder: Path) -> None:
    rows = {row["sequence"]: row for row in rows_of(folder, "sequences")}
    assert float(rows[NAME]["physics.displacement_mm"]) == pytest.approx(25)
    assert float(rows[NAME]["physics.releases"]) == 3
    assert float(rows[NAME]["physics.unsupported_share"]) == 0.5
    assert {row["physics.displacement_mm"] for name, row in rows.items() if name != NAME} == {""}
    frames = rows_of(folder, "frames")
    own = [row for row in frames if row["sequence"] == NAME]
    assert [row["physics.carrier"] for row in own] == CARRIER
    assert [row["physics.bad"] == "true" for row in own] == BAD
    depth = [float(row["physics.penetration_mm"] or "nan") for row in own]
    assert depth == pytest.approx([0, 1, 2, np.nan], nan_ok=True)
    assert {row["physics.bad"] for row in frames if row["sequence"] != NAME} == {""}


def test_the_page_has_tile_timeline_and_note(folder: Path) -> None:
    page = (folder / "site" / "sequences" / NAME / "index.html").read_text()
    assert "object moves when released" in page and "25.0 mm" in page
    assert "mean over 3 releases at rest" in page and "unsupported in 50 %" in page
    assert "carried by" in page and "held by something unknown" in page
    assert "Physics of the object: two rests are not released." in page


def test_exports_have_every_frame(folder: Path) -> None:
    out = folder / "export"
    for file in ("amass/body", "amass/object", "intercap/res"):
        with np.load(out / f"{file}.npz") as arrays:
            assert arrays["carrier"].tolist() == CARRIER, file
            assert arrays["physics_bad"].tolist() == BAD
    for name in ("gmr", "holosoma"):
        with np.load(out / name / f"{NAME}.npz") as arrays:
            at = np.rint(arrays["source_frame"]).astype(int)
            assert len(at) == 7  # 30 frames per second from 15
            assert arrays["carrier"].tolist() == [CARRIER[t] for t in at]
            assert arrays["physics_bad"].tolist() == [BAD[t] for t in at]
    info = json.loads((out / "coco" / "annotations.json").read_text())["info"]
    for about in (info, read_pickle(out / "intercap" / "res.pkl")["about"]):
        assert about["physics"]["displacement_mm"] == 25 and about["physics"]["releases"] == 3
        assert about["physics"]["note"] == "two rests are not released"
        assert list(about["by_frame"]["carrier"]) == CARRIER
        assert list(about["by_frame"]["physics_bad"]) == BAD
    readme = (out / "README.txt").read_text()
    assert RELEASED in readme and "Physics is not judged: two rests are not released." in readme


def test_the_card_counts_releases(folder: Path) -> None:
    assert RELEASED in (folder / "README.md").read_text()
    physics = json.loads((folder / "card.json").read_text())["accuracy"]["physics"]
    assert physics["releases"] == 3 and isinstance(physics["releases"], int)
    assert physics["displacement_mm"] == 25 and physics["bad_share"] == 0.5
