"""The dataset stage: files, the page's content, and the page in a real browser."""

from __future__ import annotations

import base64
import json
import shutil
import subprocess
from html.parser import HTMLParser
from pathlib import Path

import cv2
import h5py
import numpy as np
import pandas as pd
import pytest

from intercap_core import artefacts
from intercap_core.config import MetricsSettings, ReportSettings
from intercap_core.errors import UserError
from intercap_core.schemas import CONTACT_REGIONS, HEATMAPS, METRICS
from intercap_core.stage_list import SEQUENCE_STAGES
from intercap_core.stages import dataset, metrics
from tests.helpers import fitted_capture as fitted

STAGES = ("frames", "scene", "detections", "person", "object_track", "body_fit", "joint")
FAILED = {"s03_o01": "k2.mkv: is cut after 3 s <and> more; record it again"}


@pytest.fixture(scope="module")
def captures(tmp_path_factory: pytest.TempPathFactory) -> dict[str, fitted.Capture]:
    """One sequence with truth, one without."""
    made = {}
    for name, object_name in (("s01_o03", "football"), ("s01_o09", "cup")):
        folder = tmp_path_factory.mktemp(name)
        made[name] = fitted.make_capture(folder, name=name, object_name=object_name, total=4)
        with h5py.File(made[name].paths["joint"], "r+") as file:  # the ball is held, the cup is not
            hands = [CONTACT_REGIONS.index(f"{side}_hand") for side in ("left", "right")]
            file["contact_probability"][:2, hands] = 0.9 if object_name == "football" else 0.1
            file["contact_probability"][3, hands] = 0.9 if object_name == "football" else 0.1
        metrics.run(
            **made[name].inputs(*STAGES),
            output=made[name].paths["metrics"],
            object_=made[name].object_,
            subject=fitted.SUBJECT,
            body_models=fitted.BODY_MODELS,
            settings=MetricsSettings(),
            **fitted.OTHER_SETTINGS,
            truth=made[name].paths["truth"] if object_name == "football" else None,
        )
    return made


def _run(captures: dict[str, fitted.Capture], out: Path, **settings: int) -> Path:
    dataset.run(
        dataset="demo",
        sequences={name: capture.inputs(*SEQUENCE_STAGES) for name, capture in captures.items()},
        objects={capture.object_.name: capture.object_ for capture in captures.values()},
        subjects={"p01": fitted.SUBJECT},
        body_models=fitted.BODY_MODELS,
        settings=ReportSettings(**settings),
        report=out / "report.html",
        summary=out / "summary.json",
        heatmaps=out / "heatmaps.h5",
        tables_folder=out / "tables",
        failed=FAILED,
        truths={name: capture.paths["truth"] for name, capture in captures.items()},
    )
    return out


@pytest.fixture(scope="module")
def out(captures: dict[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _run(captures, tmp_path_factory.mktemp("dataset"))


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


@pytest.fixture(scope="module")
def page(out: Path) -> _Reader:
    reader = _Reader()
    reader.feed((out / "report.html").read_text())
    return reader


def test_all_files_are_there(out: Path) -> None:
    summary = json.loads((out / "summary.json").read_text())
    assert (summary["dataset"], summary["sequences"], summary["frames"]) == ("demo", 2, 8)
    assert summary["truth"]["joint"]["body_pve_mm"] == pytest.approx(10, abs=1e-2)
    assert set(summary["truth"]["object_track"]) == {
        "object_translation_mm", "object_rotation_deg", "acceleration_error"
    }  # fmt: skip
    assert len(pd.read_parquet(out / "tables" / "sequences.parquet")) == 2
    assert len(pd.read_parquet(out / "tables" / "frames.parquet")) == 8


def test_heatmaps_are_shares_of_frames(out: Path, captures: dict[str, fitted.Capture]) -> None:
    with artefacts.read(out / "heatmaps.h5", HEATMAPS) as heat:
        body, names = heat["body_likelihood"], heat.text("object_names")
        offsets, likelihood = heat["object_offsets"], heat["object_likelihood"]
    assert names == ["cup", "football"]
    expected = np.zeros(len(body))
    for capture in captures.values():
        with artefacts.read(capture.paths["metrics"], METRICS) as measured:
            expected += (measured["body_to_object"] <= 0.0045).sum(0)
    assert body == pytest.approx(expected / 8)
    ball = likelihood[offsets[1] : offsets[2]]
    assert ball.max() == 1 and 0 < (ball > 0).mean() < 0.2
    regions = captures["s01_o03"].model.regions
    assert body[regions["right_hand"]].max() > 0 and body[regions["left_foot"]].max() == 0


def test_page_needs_nothing_beside_itself(page: _Reader) -> None:
    assert all(address.startswith(("data:", "#")) for address in page.addresses)
    targets = {a[1:] for a in page.addresses if a.startswith("#")}
    assert {"s-s01_o03", "s-s01_o09", "truth", "penetration"} <= targets
    for image in page.images[:-1]:  # the last one is the empty enlargement
        assert image["alt"]
        data = base64.b64decode(str(image["src"]).split(";base64,")[1])
        shape = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR).shape
        assert shape[:2] == (int(str(image["height"])), int(str(image["width"])))


def test_page_shows_overlays_heatmaps_flags_and_failures(page: _Reader) -> None:
    text = " ".join(" ".join(page.text).split())
    captions = [str(image["alt"]) for image in page.images]
    assert sum(c.startswith("camera ") for c in captions) == 2 * 2 * 4  # sequences, cameras, frames
    assert {"front", "back", "left hand, palm", "right hand, back", "one side"} <= set(captions)
    for name in ("s01_o03", "s01_o09"):
        assert sum(c.startswith(f"{name}, frame ") for c in captions) == 6  # two sides, one slice
    assert [c for c in captions if " hand, frames " in c] == [
        "left hand, frames 0–1, drawn at 0",
        "right hand, frames 0–1, drawn at 0",
    ]  # of four holds the longest
    for part in (FAILED["s03_o01"], "object lost", "Against truth", "InterCap, as published"):
        assert part in text


def test_overlay_covers_the_person_in_the_image(
    captures: dict[str, fitted.Capture], page: _Reader
) -> None:
    """The recorded person is red; the overlay turns it blue where the fit is right."""
    image = next(i for i in page.images if str(i["alt"]).startswith("camera "))
    data = base64.b64decode(str(image["src"]).split(",")[1])
    blue, green, red = cv2.split(cv2.imdecode(np.frombuffer(data, np.uint8), 1).astype(int))
    uncovered = (red - blue > 60) & (red - green > 40)
    covered = blue - red > 25
    assert covered.sum() > 12 * uncovered.sum()


def test_more_sequences_than_shown_leaves_the_worst(
    captures: dict[str, fitted.Capture], tmp_path: Path
) -> None:
    text = (
        _run(captures, tmp_path, max_sequences=1, cameras=1, frames=1) / "report.html"
    ).read_text()
    assert text.count('<section class="sequence"') == 1
    assert "1 others are only in the tables" in text


def test_same_input_same_bytes(
    captures: dict[str, fitted.Capture], out: Path, tmp_path: Path
) -> None:
    again = _run(captures, tmp_path)
    for path in sorted(p for p in out.rglob("*") if p.is_file()):
        assert (again / path.relative_to(out)).read_bytes() == path.read_bytes(), path.name


def test_a_dataset_without_results_says_so(tmp_path: Path) -> None:
    with pytest.raises(UserError, match="no sequence has a result"):
        _run({}, tmp_path)


CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("chrome")


def _browse(page: Path, folder: Path) -> tuple[str, set[str], np.ndarray]:
    """What the browser printed, the addresses that the page itself asked for, and a picture."""
    log, shot = folder / "net.json", folder / "page.png"
    done = subprocess.run(
        [
            str(CHROMIUM), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
            "--no-first-run", "--disable-background-networking", "--disable-component-update",
            "--disable-sync", "--enable-logging=stderr", "--window-size=1240,2400",
            f"--user-data-dir={folder / 'profile'}", f"--log-net-log={log}",
            f"--screenshot={shot}", page.resolve().as_uri(),
        ],
        capture_output=True, text=True, timeout=120,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    asked = set()
    for event in json.loads(log.read_text())["events"]:
        values = event.get("params", {})
        # the browser's own errands (updates, accounts) have no origin for an initiator
        if "url" in values and values.get("initiator", "not an origin") != "not an origin":
            asked.add(values["url"])
    return done.stderr, asked, cv2.imread(str(shot))


@pytest.mark.skipif(CHROMIUM is None, reason="no Chromium here: install Debian's package chromium")
def test_page_in_a_browser_has_no_errors_and_asks_for_nothing(out: Path, tmp_path: Path) -> None:
    bad = tmp_path / "bad.html"
    bad.write_text('<img src="http://127.0.0.1:9/x.png"><script>console.error("wrong")</script>')
    (tmp_path / "control").mkdir()
    printed, asked, _ = _browse(bad, tmp_path / "control")
    assert "CONSOLE" in printed and asked == {"http://127.0.0.1:9/x.png"}

    printed, asked, image = _browse(out / "report.html", tmp_path)
    assert "CONSOLE" not in printed, printed
    assert asked == set()
    assert image.shape[:2] == (2400, 1240) and image.std() > 10
