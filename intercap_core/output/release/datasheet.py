"""Datasheet of the dataset, and the responsible-AI fields of its Croissant file.

The questions of the datasheet follow Gebru et al., "Datasheets for Datasets" (2021). What the
results tell is filled in; what only its authors know are statements of the settings' section
``card``. Responsible-AI fields: mlcommons.org/croissant/RAI, version 1.0.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jinja2

from intercap_core.config import CardSettings

Facts = Mapping[str, Any]


STATEMENTS = {  # questions that only the authors of a dataset can answer, by setting in `card`
    "licence": "Under which licence may the data be used?",
    "collection": "Who recorded whom, where, when, with which devices and instructions, and for "
    "what pay?",
    "consent": "How did the recorded persons consent, to which uses, how can they withdraw, and "
    "which ethics board approved it?",
    "uses": "For which tasks is the data meant, and for which should it not be used?",
    "biases": "Which groups of people, objects and actions are rare or absent?",
    "social_impact": "What good and harm can come from the data's use?",
    "maintenance": "Who maintains the data, and where are errors reported?",
}
_IF_VIRTUAL = {  # answers for a dataset of virtual recordings if the settings state none
    "collection": "The recordings were rendered by the virtual studio of intercap-core.",
    "consent": "No person was recorded: the recordings are virtual.",
}


def statements(settings: CardSettings, *, virtual: bool) -> dict[str, str]:
    """Return the text of each statement, "" if it is missing.

    Args:
        virtual: all recordings are virtual.
    """
    return {
        name: getattr(settings, name).strip() or (_IF_VIRTUAL.get(name, "") if virtual else "")
        for name in STATEMENTS
    }


def text_templates() -> jinja2.Environment:
    """Return the environment of this package's Markdown templates."""
    return jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent / "data"),
        autoescape=False,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def datasheet(card: Facts) -> str:
    """Return the datasheet as Markdown; missing statements are placeholders with their question."""
    stated = {
        name: text or f"**Not stated.** {STATEMENTS[name]} (setting `card.{name}`)"
        for name, text in card["statements"].items()
    }
    return (
        text_templates()
        .get_template("datasheet.md.j2")
        .render(card=card, stated=stated, limitations=_limitations(card))
    )


def rai_fields(card: Facts) -> dict[str, Any]:
    """Return the responsible-AI fields of Croissant; missing statements are left out."""
    stated = card["statements"]
    counts, flagged = card["counts"], card["flagged"]["parts"]
    shares = ", ".join(f"{entry['part']} {entry['percent']:.1f} %" for entry in flagged)
    groups = f"{counts['subjects']} subjects, {counts['objects']} objects"
    fields = {
        "dataCollection": stated["collection"],
        "dataCollectionType": "Software Collection" if card["virtual"] else "Direct Measurement",
        "dataCollectionMissingData": f"Frames with an unreliable part are flagged: {shares}. "
        f"{len(card['failed'])} recordings have no result.",
        "dataImputationProtocol": "Poses in frames that show a part in no camera are interpolated "
        "or extrapolated, and flagged.",
        "dataPreprocessingProtocol": [
            f"stage {stage}, version {made[0]['version']}" for stage, made in card["stages"].items()
        ],
        "dataAnnotationProtocol": "Body, hands and object are fitted to images and depth of all "
        "cameras, with contact by body region; annotated contact and poses are evidence.",
        "dataAnnotationAnalysis": _accuracy(card),
        "machineAnnotationTools": [f"{name} {number}" for name, number in card["software"].items()],
        "dataLimitations": _limitations(card),
        "dataBiases": [groups, *([stated["biases"]] if stated["biases"] else [])],
        "dataUseCases": stated["uses"],
        "dataSocialImpact": stated["social_impact"],
        "personalSensitiveInformation": stated["consent"],
        "dataReleaseMaintenancePlan": stated["maintenance"],
    }
    return {f"rai:{name}": value for name, value in fields.items() if value}


def _accuracy(card: Facts) -> str:
    parts = card["accuracy"]["stated_mm"].items()
    if not parts:
        return "No errors are estimated."
    words = ", ".join(f"{part} {mm:.1f} mm" for part, mm in parts)
    return f"Mean errors, estimated without ground truth by holding out cameras: {words}."


def _limitations(card: Facts) -> list[str]:
    return [
        _accuracy(card),
        "Estimated errors do not reveal a wrong person, a wrong object, or a scale that all "
        "cameras share.",
        "Fingers that hold an object are the least certain part.",
        *(["The recordings are virtual: they show no real person."] if card["virtual"] else []),
    ]
