"""Statements that only authors can make: filled in, or asked for by datasheet and release."""

from __future__ import annotations

import datetime
import json
from pathlib import Path

import pytest

from intercap_core.config import CardSettings
from intercap_core.output.release.datasheet import STATEMENTS, datasheet, rai_fields, statements
from tests.helpers import fitted_capture as fitted
from tests.helpers.site import merge, write_summaries

CARD = CardSettings(
    citation="@misc{things}",
    published=datetime.date(2026, 3, 1),
    licence="CC-BY-4.0",
    collection="Recorded in a gym.",
    consent="Written consent; ethics board 12/2026.",
    uses="Grasp synthesis; no identification of persons.",
    biases="Adults alone.",
    social_impact="Assistive robots.",
    maintenance="The lab; errors by mail.",
)


@pytest.fixture(scope="module")
def folders(
    captures: dict[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory
) -> dict[str, Path]:
    """Datasets with and without statements."""
    out = tmp_path_factory.mktemp("datasets")
    summaries = write_summaries(captures, out / "summaries")
    for name, card in (("stated", CARD), ("empty", CardSettings())):
        merge(summaries, captures, out / name, "things", card=card)
    return {name: out / name for name in ("stated", "empty")}


def test_a_datasheet_has_the_statements_or_their_questions(folders: dict[str, Path]) -> None:
    full = (folders["stated"] / "datasheet.md").read_text()
    empty = (folders["empty"] / "datasheet.md").read_text()
    assert "Not stated" not in full
    for name, question in STATEMENTS.items():
        assert getattr(CARD, name) in full
        assert f"**Not stated.** {question} (setting `card.{name}`)" in empty


def test_croissant_has_the_responsible_ai_fields(folders: dict[str, Path]) -> None:
    loader = pytest.importorskip("mlcroissant")
    dataset = loader.Dataset(jsonld=folders["stated"] / "croissant.json")
    metadata = dataset.metadata
    assert not metadata.ctx.issues.errors and not metadata.ctx.issues.warnings
    assert metadata.data_collection == CARD.collection
    assert metadata.personal_sensitive_information == [CARD.consent]
    assert metadata.data_use_cases == [CARD.uses] and CARD.biases in metadata.data_biases
    assert metadata.data_social_impact == CARD.social_impact
    assert metadata.data_release_maintenance_plan == CARD.maintenance
    assert any("errors" in text for text in metadata.data_limitations)
    assert metadata.data_annotation_protocol and metadata.machine_annotation_tools
    assert "stage joint" in " ".join(metadata.data_preprocessing_protocol)
    content = json.loads((folders["empty"] / "croissant.json").read_text())
    assert "http://mlcommons.org/croissant/RAI/1.0" in content["conformsTo"]
    missing = {"rai:dataCollection", "rai:dataUseCases", "rai:personalSensitiveInformation"}
    assert not missing & set(content) and "rai:dataLimitations" in content


def test_virtual_recordings_need_no_consent(folders: dict[str, Path]) -> None:
    stated = statements(CardSettings(uses=" "), virtual=True)
    missing = {name for name, text in stated.items() if not text}
    assert missing == set(STATEMENTS) - {"collection", "consent"}
    card = json.loads((folders["empty"] / "card.json").read_text())
    card |= {"virtual": True, "statements": stated}
    assert "No person was recorded" in datasheet(card)
    assert rai_fields(card)["rai:dataCollectionType"] == "Software Collection"


def test_the_readme_is_a_card_of_hugging_face(folders: dict[str, Path]) -> None:
    hub = pytest.importorskip("huggingface_hub")
    card = hub.DatasetCard.load(folders["stated"] / "README.md")
    assert card.data.license == "cc-by-4.0" and card.data.pretty_name == "things"
    assert card.data.size_categories == ["n<1K"]
    assert card.data.annotations_creators == ["machine-generated"]
    assert card.text.startswith("\n# things") or "# things" in card.text
    unknown = hub.DatasetCard.load(folders["empty"] / "README.md")
    assert unknown.data.license == "other"
