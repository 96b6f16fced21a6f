"""The dataset stage: files and the pages' content."""

from __future__ import annotations

import base64
import json
import shutil
from html.parser import HTMLParser
from pathlib import Path

import cv2
import h5py
import numpy as np
import pandas as pd
import pytest

from intercap_core import artefacts
from intercap_core.annotation import ContactInterval
from intercap_core.config import CardSettings, PageSettings
from intercap_core.schemas import HEATMAPS, METRICS
from intercap_core.stage_list import STAGES
from intercap_core.stages import page
from tests.helpers import fitted_capture as fitted
from tests.helpers.site import FAILED, INTENTS, merge, row, write_summaries


class _Reader(HTMLParser):
    """Collects the images, the text, and every address that the page mentions."""

    def __init__(self) -> None:
        super().__init__()
        self.images: list[dict[str, str | None]] = []
        self.addresses: list[str] = []
        self.text: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        values = dict(attrs)
        if tag == "img":
            self.images.append(values)
        assert tag not in ("link", "iframe", "object", "embed")
        for key in ("src", "href", "action"):
            if values.get(key):
                self.addresses.append(str(values[key]))

    def handle_data(self, data: str) -> None:
        self.text.append(data)


def _read(path: Path) -> _Reader:
    reader = _Reader()
    reader.feed(path.read_text())
    return reader


def _page(out: Path, name: str) -> Path:
    return out / "site" / "sequences" / name / "index.html"


@pytest.fixture(scope="module")
def overview(site: Path) -> _Reader:
    return _read(site / "site" / "index.html")


@pytest.fixture(scope="module")
def pages(site: Path, captures: dict[str, fitted.Capture]) -> dict[str, _Reader]:
    return {name: _read(_page(site, name)) for name in captures}


@pytest.fixture
def summaries(site: Path, captures: dict[str, fitted.Capture], tmp_path: Path) -> dict[str, Path]:
    """Copies of the summary artefacts, to be changed."""
    return {
        name: Path(shutil.copy(site / "summaries" / f"{name}.h5", tmp_path)) for name in captures
    }


def test_all_files_are_there(site: Path) -> None:
    summary = json.loads((site / "summary.json").read_text())
    assert (summary["dataset"], summary["sequences"], summary["frames"]) == ("demo", 2, 8)
    assert summary["truth"]["joint"]["body_pve_mm"] == pytest.approx(10, abs=1e-2)
    assert set(summary["truth"]["object_track"]) == {
        "object_translation_mm", "object_rotation_deg", "acceleration_error"
    }  # fmt: skip
    assert len(pd.read_parquet(site / "tables" / "sequences.parquet")) == 2
    assert len(pd.read_parquet(site / "tables" / "frames.parquet")) == 8


def test_heatmaps_are_shares_of_frames(site: Path, captures: dict[str, fitted.Capture]) -> None:
    with artefacts.read(site / "heatmaps.h5", HEATMAPS) as heat:
        body, names = heat["body_likelihood"], heat.text("object_names")
        offsets, likelihood = heat["object_offsets"], heat["object_likelihood"]
    assert names == ["cup", "football"]
    expected = np.zeros(len(body))
    for capture in captures.values():
        with artefacts.read(capture.paths["metrics"], METRICS) as measured:
            expected += (measured["body_contact_distance"] <= 0.0045).sum(0)
    assert body == pytest.approx(expected / 8)
    ball = likelihood[offsets[1] : offsets[2]]
    assert ball.max() == 1 and 0 < (ball > 0).mean() < 0.2
    regions = captures["s01_o03"].model.regions
    assert body[regions["right_hand"]].max() > 0 and body[regions["left_foot"]].max() == 0


def test_tables_by_object_subject_intent_and_camera(
    site: Path, captures: dict[str, fitted.Capture]
) -> None:
    tables = {path.stem: pd.read_csv(path) for path in (site / "tables").glob("*.csv")}
    names = "sequences frames cameras objects rig splits subjects intents"
    assert set(tables) == set(names.split())
    assert tables["objects"]["object"].tolist() == ["cup", "football"]
    subject = tables["subjects"].iloc[0]
    assert (subject["sequences"], subject["frames"]) == (2, 8)
    assert tables["intents"][["intent", "frames"]].values.tolist() == [["pass", 4], ["use", 4]]
    # a group of one sequence has that sequence's figures
    by_name = tables["sequences"].set_index("sequence")
    ball = tables["objects"].set_index("object").loc["football"]
    for column in ("penetration.mean_mm", "vertex_to_cloud.body_mm", "joint.body_pve_mm"):
        assert ball[column] == pytest.approx(by_name.loc["s01_o03", column], rel=1e-5)
    cameras = tables["cameras"]
    assert cameras.groupby("sequence")["camera"].nunique().tolist() == [3, 3]
    assert (cameras["images"] == 4).all()
    first, own = tables["rig"].iloc[0], cameras[cameras["camera"] == "k1"]
    assert (first["camera"], first["sequences"], first["images"]) == ("k1", 2, 8)
    assert first["depth_bias_mm"] == pytest.approx(own["depth_bias_mm"].mean(), abs=1e-6)
    for name in tables:
        read = pd.read_parquet(site / "tables" / f"{name}.parquet")
        assert len(read) == len(tables[name]) and list(read) == list(tables[name])


def test_pages_need_nothing_beside_the_site(
    site: Path, overview: _Reader, pages: dict[str, _Reader]
) -> None:
    for folder, shown in (
        (site / "site", overview),
        *((_page(site, n).parent, pages[n]) for n in pages),
    ):
        for address in shown.addresses:
            if not address.startswith(("data:", "#")):
                target = (folder / address.partition("#")[0]).resolve()
                assert target.is_relative_to((site / "site").resolve()) and target.is_file()
        thumbnails = [image for image in shown.images if image.get("class") == "thumbnail"]
        assert len(thumbnails) == (len(pages) if shown is overview else 0)
        assert all((folder / str(image["src"])).is_file() for image in thumbnails)
        # the last one is the empty enlargement
        for image in (other for other in shown.images[:-1] if other not in thumbnails):
            assert image["alt"]
            data = base64.b64decode(str(image["src"]).split(";base64,")[1])
            shape = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape
            assert shape[:2] == (int(str(image["height"])), int(str(image["width"])))
    targets = {a[1:] for a in overview.addresses if a.startswith("#")}
    assert {"sequences-table", "truth", "penetration", "heatmaps"} <= targets


def test_pages_show_overlays_flags_and_failures(
    overview: _Reader, pages: dict[str, _Reader]
) -> None:
    text = " ".join(" ".join(overview.text).split())
    captions = [str(image["alt"]) for image in overview.images]
    assert {"front", "back", "left hand, palm", "right hand, back", "one side"} <= set(captions)
    for part in (FAILED["s03_o01"], "object lost", "Against ground truth", "virtual recordings"):
        assert part in text
    assert "as published" not in text  # a figure of real recordings
    for name, shown in pages.items():
        captions = [str(image["alt"]) for image in shown.images]
        assert sum(c.startswith("camera ") for c in captions) == 3 * 4  # cameras, frames
        assert sum(c.startswith(f"{name}, frame ") for c in captions) == 6  # two sides, one slice
        text = " ".join(" ".join(shown.text).split())
        for part in (
            "Over time",
            "Estimated error (no ground truth)",
            "Joint fit",
            "before (grey) and after (blue)",
        ):
            assert part in text
    ball_captions = [str(image["alt"]) for image in pages["s01_o03"].images]
    assert [c for c in ball_captions if " hand, frames " in c] == [
        "left hand, frames 0–1, drawn at 0",
        "right hand, frames 0–1, drawn at 0",
    ]  # of four holds the longest


def test_annotated_contact_is_shown_with_stated_contact(
    captures: dict[str, fitted.Capture], tmp_path: Path
) -> None:
    capture = captures["s01_o03"]
    for name in ("page", "again"):
        page.run(
            paths=capture.inputs(*STAGES["page"].reads),
            sequence=row("s01_o03"), models=capture.models,
            settings=PageSettings(cameras=1, frames=1),
            contact=[ContactInterval(part="right_hand", start=1, end=9)],
            output=tmp_path / name, truth=None,
        )  # fmt: skip
    for path in (tmp_path / "page").iterdir():
        assert (tmp_path / "again" / path.name).read_bytes() == path.read_bytes(), path.name
    text = (tmp_path / "page" / "index.html").read_text()
    assert "right hand, annotated" in text and "1–3: annotated" in text
    assert text.count("camera k") and "left hand, annotated" not in text


def test_odd_summaries_are_listed_and_their_texts_escaped(
    captures: dict[str, fitted.Capture], summaries: dict[str, Path], tmp_path: Path
) -> None:
    """Of two that cannot be read, and one with markup and an object that is not in the list."""
    with h5py.File(summaries["s01_o03"], "r+") as file:
        file["rig/note"][0] = "<script>alert(1)</script>"
        file.attrs["intent"] = "<img src=x>"
    with h5py.File(summaries["s01_o09"], "r+") as file:
        file.attrs["schema_version"] = 99
    summaries["s05_o01"] = tmp_path / "never.h5"
    listed = {"s01_o09": captures["s01_o09"]}
    text = merge(summaries, listed, tmp_path / "out", failed={"<b>": "<i>"}).read_text()
    assert "1 sequence, 4 frames" in text and "3 failed" in text
    assert "s01_o09.h5" in text and "never.h5" in text
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["sequences"] == 1
    assert "its object football has no entry in the list of objects" in text
    assert "<img src=x>" not in text and "&lt;img src=x&gt;" in text
    assert "<i>" not in text and "&lt;i&gt;" in text


def test_sequences_that_do_not_fit_the_heatmaps_are_reported(
    captures: dict[str, fitted.Capture], summaries: dict[str, Path], tmp_path: Path
) -> None:
    """Another object's mesh, another body's vertices, another body file: none ends the merge."""
    summaries["s02_o03"] = Path(shutil.copy(summaries["s01_o03"], tmp_path / "s02_o03.h5"))
    for name, key, count in (("s01_o09", "body_contact_frames", 11), ("s02_o03", "", 0)):
        with h5py.File(summaries[name], "r+") as file:
            file.attrs["sequence"] = name
            if key:
                del file[key]
                file.create_dataset(key, data=np.zeros(count, np.int32))
            else:
                file["object_sample_points"][0] += 0.1
    with h5py.File(summaries["s01_o03"], "r+") as file:
        file.attrs["body_model"] = "0123456789abcdef"
    common = CardSettings(heatmap_scale="common")
    text = merge(summaries, captures, tmp_path / "out", card=common).read_text()
    assert "3 sequences, 12 frames" in text and "Remarks" in text
    assert "% of the frames, in all maps" in text and "map's maximum" not in text
    for words in (
        "its body has 11 vertices", "measured with another mesh", "(digest 0123456789abcdef)"
    ):  # fmt: skip
        assert words in text
    with artefacts.read(tmp_path / "out" / "heatmaps.h5", HEATMAPS) as heat:
        assert heat["object_frames"].tolist() == [4, 4]
        assert heat.attributes["body_frames"] == 8
    # the body is drawn with the first file that is there
    assert "right hand, back" in text


def test_overlay_covers_the_person_in_the_image(pages: dict[str, _Reader]) -> None:
    """The recorded person is red; the overlay turns it blue where the fit is right."""
    image = next(i for i in pages["s01_o03"].images if str(i["alt"]).startswith("camera "))
    data = base64.b64decode(str(image["src"]).split(",")[1])
    blue, green, red = cv2.split(cv2.imdecode(np.frombuffer(data, np.uint8), 1).astype(int))
    uncovered = (red - blue > 60) & (red - green > 40)
    covered = blue - red > 25
    assert covered.sum() > 12 * uncovered.sum()


def test_same_input_same_bytes(
    captures: dict[str, fitted.Capture], site: Path, tmp_path: Path
) -> None:
    """Of the dataset; for a page see ``test_annotated_contact_is_shown_with_stated_contact``."""
    paths = write_summaries(captures, tmp_path / "summaries", INTENTS)
    merge(paths, captures, tmp_path, "demo", FAILED)
    for path in sorted(p for p in tmp_path.rglob("*") if p.is_file()):
        assert (site / path.relative_to(tmp_path)).read_bytes() == path.read_bytes(), path.name
