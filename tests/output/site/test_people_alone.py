"""A dataset of people with an object, alone, and with one that was found in no frame."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from bench.evaluate.sequences import areas
from intercap_core.config import PageSettings
from intercap_core.evaluation.figures import SequenceMetrics, flag_figures, truth_figures
from intercap_core.evaluation.summary import SequenceSummary, collect_heatmaps
from intercap_core.schemas import CONTACT_REGIONS
from tests.helpers import fitted_capture as fitted
from tests.helpers.site import HELD, merge, write_page, write_summaries

TOTAL = 4
ALONE, MISSED = "alone", "missed"
WHY = "the track is of nothing"


@pytest.fixture(scope="module")
def mixed(
    captures: dict[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, fitted.Capture]:
    """One of a person with an object, and two copies: one without it, one whose track is lost."""
    held = captures[HELD]
    alone, missed = (
        held.copied(tmp_path_factory.mktemp(name), *held.paths, name=name)
        for name in (ALONE, MISSED)
    )
    alone = fitted.take_object_away(alone)
    fitted.lose_object(missed, WHY)
    for made in (alone, missed):
        made.measure(truth=True)
    return {HELD: held, ALONE: alone, MISSED: missed}


@pytest.fixture(scope="module")
def measured(mixed: dict[str, fitted.Capture]) -> dict[str, SequenceMetrics]:
    return {name: SequenceMetrics.read(made.paths["metrics"]) for name, made in mixed.items()}


@pytest.fixture(scope="module")
def out(mixed: dict[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("dataset")
    merge(write_summaries(mixed, folder / "summaries"), mixed, folder, "mixed")
    return folder


def test_the_body_is_measured_as_with_an_object(measured: dict[str, SequenceMetrics]) -> None:
    held, alone, missed = (measured[name] for name in (HELD, ALONE, MISSED))
    assert (held.object_, alone.object_, missed.object_) == ("football", "", "football")
    assert [s.has_object for s in (held, alone, missed)] == [True, False, False]
    for key in ("body_to_cloud", "truth/joint/body_pve", "truth/joint/planted_speed"):
        np.testing.assert_allclose(alone.values[key], held.values[key], rtol=1e-4)
    assert list(held.values["verdict/part_names"]) == ["body", "hands", "object"]
    for without in (alone, missed):
        assert list(without.values["verdict/part_names"]) == ["body", "hands"]
    judged = {key for key in alone.values if key.startswith("verdict/")}
    about = {key.rpartition("/")[2].partition("_")[0] for key in alone.values.keys() - judged}
    assert not about & {"object", "contact", "region", "penetration", "vertex"}


def test_an_object_that_was_missed_is_lost(measured: dict[str, SequenceMetrics]) -> None:
    missed = measured[MISSED]
    assert np.isposinf(missed.values["truth/joint/object_translation"]).all()
    for stage in ("object_track", "joint"):
        heat = truth_figures([missed], stage)
        assert heat["lost_share"] == 1 and heat["lost_unnoticed_share"] == 0
        assert "object_translation_mm" not in heat
    assert truth_figures([missed], "joint")["contact_recall"] == 0
    shares = missed.flags.shares()
    assert shares["object"] == shares["contact"] == 1 and shares["body"] < 1
    assert flag_figures([missed, measured[ALONE]])["bad_frames"] == 0.5


def test_figures_of_a_mixed_dataset_are_those_of_its_parts(
    measured: dict[str, SequenceMetrics],
) -> None:
    held, alone = measured[HELD], measured[ALONE]
    both, single = areas([held, alone]), areas([held])
    for area in ("joint", "body_fit", "penetration", "vertex_to_cloud"):
        for key, value in single[area].items():
            assert both[area][key] == pytest.approx(value, rel=1e-4), key
    assert not [key for key in areas([alone])["joint"] if "object" in key or "contact" in key]


def test_heatmaps_count_only_sequences_with_an_object(out: Path) -> None:
    summaries = [
        SequenceSummary.read(out / "summaries" / f"{name}.h5") for name in (ALONE, HELD, MISSED)
    ]
    heat, held = collect_heatmaps(summaries), collect_heatmaps(summaries[1:2])
    assert heat.body_frames == TOTAL and list(heat.objects) == ["football"]
    np.testing.assert_array_equal(heat.body, held.body)
    assert heat.objects["football"].frames == TOTAL


def test_tables_have_gaps_and_no_zeros(out: Path) -> None:
    table = pd.read_csv(out / "tables" / "sequences.csv").set_index("sequence")
    assert table.loc[HELD, "contact_frames"] == TOTAL
    for name in (ALONE, MISSED):
        row = table.loc[name]
        columns = [c for c in table if "penetration" in c or c.startswith("vertex_to_cloud.object")]
        assert row[[*columns, "contact_frames", "acceleration_object_mm"]].isna().all()
        assert row["vertex_to_cloud.body_mm"] > 0
    assert sorted(table["rank"]) == [1, 2, 3]
    assert (table[[f"verdict.{part}_odd_even_mm" for part in ("body", "hands")]] > 0).all().all()
    assert table["verdict.object_odd_even_mm"].notna().tolist() == [
        name == HELD for name in table.index
    ]
    frames = pd.read_parquet(out / "tables" / "frames.parquet").set_index("sequence")
    region = f"contact_probability.{CONTACT_REGIONS[0]}"
    assert frames.loc[ALONE, ["contact", region, "object_to_cloud_mm"]].isna().all().all()
    assert frames.loc[HELD, ["contact", region]].notna().all().all()
    assert json.loads((out / "summary.json").read_text())["sequences"] == 3


def test_the_page_says_why_the_object_is_missing(
    mixed: dict[str, fitted.Capture], tmp_path: Path
) -> None:
    write_page(mixed[MISSED], tmp_path, MISSED, settings=PageSettings(cameras=1, frames=1))
    page = (tmp_path / "site" / "sequences" / MISSED / "index.html").read_text()
    assert "data:image/jpeg" in page and ">in contact<" not in page
    track = page.split('id="track"')[1].split('id="body"')[0]
    assert WHY in track and "found in no frame" in track
    assert "deviation of the position" not in track
    verdict = page.split('id="verdict"')[1].split("</table>")[0]
    assert verdict.count("<small>frame-to-frame noise") == len(("body", "hands"))
