"""The card says what the tables say, and a Croissant loader reads the dataset by it."""

from __future__ import annotations

import csv
import datetime
import json
from pathlib import Path

import pytest
import yaml

from intercap_core.config import CardSettings
from intercap_core.output.release.card import markdown
from tests.helpers import fitted_capture as fitted
from tests.helpers.site import merge, write_summaries

CARD = CardSettings(
    title='Hands: "things" & more',
    description="Six people, <ten> things.",
    version="1.2.0",
    published=datetime.date(2026, 3, 1),
    licence="CC-BY-4.0",
    creators=("A. Body", "B. Object"),
    url="https://example.org/things",
    citation="@misc{things}",
)


@pytest.fixture(scope="module")
def folder(captures: dict[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The card and tables of three sequences with two objects and one subject; one fails."""
    made = {}
    for name in ("s01_o03", "s01_o09", "s01_o09_b"):
        source = captures[name.removesuffix("_b")]
        capture = source.copied(tmp_path_factory.mktemp(name), *source.paths, name=name)
        with capture.edit("joint") as file:
            file["flagged"][:2] = True
            reasons = file["flag_reason"][()].astype("S80")
            reasons[:2] = [b"lost 3 frames | ago", b"lost 12 frames | ago; unsure"]
            del file["flag_reason"]
            file["flag_reason"] = reasons
        capture.measure(hold_out=False)
        made[name] = capture
    out = tmp_path_factory.mktemp("dataset")
    summaries = write_summaries(made, out / "summaries")
    merge(summaries, made, out, "things", {"s02_o01": "k2.mkv: cut\nmore"}, card=CARD)
    return out


def test_json_says_what_the_tables_say(folder: Path) -> None:
    card = json.loads((folder / "card.json").read_text())
    with open(folder / "tables" / "sequences.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    assert card["counts"]["sequences"] == len(rows) == 3
    assert card["counts"]["frames"] == sum(int(row["frames"]) for row in rows) == 12
    assert card["counts"]["objects"] == 2 and card["counts"]["subjects"] == 1
    for entry in card["flagged"]["parts"]:
        of_rows = sum(int(row[f"flagged.{entry['part']}_frames"]) for row in rows)
        assert entry["frames"] == of_rows >= 6, entry
    # numbers within a reason make no new one
    reasons = {entry["reason"]: entry["frames"] for entry in card["flagged"]["reasons"]}
    assert reasons["lost … frames | ago"] == 6 and reasons["unsure"] == 3
    assert [row["object"] for row in card["by_object"]] == ["cup", "football"]
    assert card["failed"] == [{"sequence": "s02_o01", "reason": "k2.mkv: cut\nmore"}]
    assert card["bodies"][0]["open"] and not card["virtual"]
    assert card["accuracy"]["stated_mm"] == {} and "against_truth" not in card["accuracy"]
    assert card["accuracy"]["body_to_cloud_mm"] > 0


def test_splits_are_in_a_table(folder: Path) -> None:
    with open(folder / "tables" / "splits.csv", newline="") as file:
        rows = list(csv.DictReader(file))
    by_object = {row["object"]: row["by_object"] for row in rows}
    assert sorted(by_object.values()) == ["test", "train"]
    assert {row["by_subject"] for row in rows} == {""}  # of one subject there is no split
    card = json.loads((folder / "card.json").read_text())
    assert "only one" in card["splits"]["subject"]["why_not"]
    parts = card["splits"]["object"]
    assert parts["train"]["frames"] + parts["test"]["frames"] == 12


def test_markdown_has_a_head_that_hubs_read(folder: Path) -> None:
    text = (folder / "README.md").read_text()
    _, head, body = text.split("---\n", 2)
    header = yaml.safe_load(head)
    assert header["pretty_name"] == CARD.title and header["license"] == "cc-by-4.0"
    assert header["size_categories"] == ["n<1K"]
    for config in header["configs"]:
        assert (folder / config["data_files"]).is_file()
    assert CARD.description in body and "2026-03-01" in body and "A. Body, B. Object" in body
    assert "| `export/bop` |" in body and "| `export/coco/annotations.json` |" in body
    assert "lost … frames / ago" in body  # a bar would end the cell
    for line in body.splitlines():
        if line.startswith("|"):
            assert line.endswith("|") and line.count("|") >= 3
    assert "s02_o01: k2.mkv: cut\n" in body and "nan" not in body.lower().split()


def test_texts_of_artefacts_are_no_markup(folder: Path) -> None:
    card = json.loads((folder / "card.json").read_text())
    hostile = "<img src=x> [a](http://b) ![c](d) `e` **f** | g\n# h"
    card["flagged"]["reasons"] = [{"reason": hostile, "frames": 1}]
    text = markdown(card)
    line = r"&lt;img src=x&gt; \[a\](http://b) \!\[c\](d) \`e\` \*\*f\*\* / g"
    assert f"| {line} | 1 |\n" in text and "# h" not in text


def test_without_a_licence_the_card_says_so(
    folder: Path, captures: dict[str, fitted.Capture], tmp_path: Path
) -> None:
    summaries = {path.stem: path for path in (folder / "summaries").iterdir()}
    merge(summaries, captures, tmp_path, "things")
    text = (tmp_path / "README.md").read_text()
    assert "licence | **not stated" in text and "license: other" in text
    assert "license" not in json.loads((tmp_path / "croissant.json").read_text())


def test_a_croissant_loader_reads_the_tables(folder: Path) -> None:
    loader = pytest.importorskip("mlcroissant")
    dataset = loader.Dataset(jsonld=folder / "croissant.json")
    assert not dataset.metadata.ctx.issues.errors and not dataset.metadata.ctx.issues.warnings
    globs = [file.includes for file in dataset.metadata.file_sets]
    assert ["export/coco/annotations.json"] in globs and ["export/bop/**/*.json"] in globs
    assert dataset.metadata.license == ["CC-BY-4.0"] and dataset.metadata.version == "1.2.0"
    rows = list(dataset.records(record_set="splits"))
    assert [row["splits/sequence"] for row in rows] == [b"s01_o03", b"s01_o09", b"s01_o09_b"]
    assert [row["splits/frames"] for row in rows] == [4, 4, 4]
    frames = list(dataset.records(record_set="frames"))
    assert len(frames) == 12
    for entry in json.loads((folder / "card.json").read_text())["flagged"]["parts"]:
        flagged = [bool(row[f"frames/flagged.{entry['part']}"]) for row in frames]
        assert sum(flagged) == entry["frames"]
