"""The dataset's card: content, accuracy, conventions, licence, and splits for training and test.

The same facts are written as JSON for programs and as Markdown for people, with the header that
dataset hubs read.
"""

from __future__ import annotations

import hashlib
import html
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import pandas as pd

from intercap_core.body.artefact import file_digest
from intercap_core.body.loading import OPEN_BODY
from intercap_core.config import CardSettings
from intercap_core.evaluation import figures
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.physics.figures import physics_figures
from intercap_core.evaluation.summary import SequenceSummary
from intercap_core.evaluation.verdict.figures import mean_stated, stated_errors
from intercap_core.flags import PARTS
from intercap_core.output.export.registry import formats as export_formats
from intercap_core.output.release.datasheet import statements, text_templates
from intercap_core.output.site.measures import covered, made_by_stage
from intercap_core.versions import versions

Facts = dict[str, Any]

_NUMBER = re.compile(r"\d+(\.\d+)?")  # replaced in reasons, which are counted without numbers
_MARKUP = re.compile(r"[\\`*\[\]!]")  # characters that begin markup within a line of Markdown
_HUB_LICENCE = re.compile(r"[a-z0-9][a-z0-9.-]*")  # identifiers of licences on hubs
_MAX_REASONS = 12  # most frequent reasons of flags
# Size categories of dataset hubs: upper limit in frames, name
_SIZES = (
    (1_000, "n<1K"), (10_000, "1K<n<10K"), (100_000, "10K<n<100K"), (1_000_000, "100K<n<1M"),
    (10_000_000, "1M<n<10M"),
)  # fmt: skip
CONVENTIONS = {
    "length": "metres; columns of tables in millimetres have it in their names",
    "angle": "radians; rotations are 3x3 matrices or rotation vectors, applied on the left",
    "artefacts": "the master colour camera's frame: x right, y down, z forward",
    "exports": "amass, glb and meshes: see export.json, by default z up with the ground at z = 0; "
    "intercap, bop and coco: camera frames",
    "frames": "numbered from 0, the frame sets of the recording; images of a camera may have "
    "slipped: image_of in scene.h5 and the numbers in exports assign images to frames",
    "body": "parameters in SMPL-X's order for the named body file; with another file, the same "
    "parameters give another person",
    "contact": "probability by frame and body region that it touches the object",
    "flags": "by frame and part (body, hands, object, contact), with reasons; exclude only the "
    "flagged parts that you use",
    "errors": "estimated without ground truth, by cameras held out; the factor gives a range that "
    "contains most true errors",
}


def facts(
    dataset: str,
    settings: CardSettings,
    summaries: Sequence[SequenceSummary],
    groups: Mapping[str, pd.DataFrame],
    *,
    formats: Sequence[str],
    failed: Mapping[str, str],
) -> Facts:
    """Return the content of the card for JSON.

    Args:
        groups: tables by "objects", "subjects" and "intents".
        formats: formats of the exports.
        failed: sequences without a result, with the reason.
    """
    measured = [s.metrics for s in summaries]
    frames = sum(len(s) for s in measured)
    by_subject, by_object = _splits(measured, settings)
    virtual = all(s.has_truth for s in measured)
    return {
        "name": dataset,
        "title": settings.title or dataset,
        "version": settings.version,
        "description": settings.description,
        "licence": settings.licence,
        "creators": list(settings.creators),
        "url": settings.url,
        "citation": settings.citation,
        "published": settings.published.isoformat() if settings.published else "",
        "virtual": virtual,
        "statements": statements(settings, virtual=virtual),
        "counts": {
            "sequences": len(measured),
            "frames": frames,
            "minutes": round(sum(len(s) / s.fps for s in measured) / 60, 2),
            "subjects": len({s.subject for s in measured}),
            "objects": len({s.object_ for s in measured} - {""}),
            "of_another_program": sum(bool(s.made_by) for s in measured),
            "cameras": sorted({len(s.rig["camera_names"]) for s in summaries}),
            "frames_per_second": sorted({round(float(s.fps), 3) for s in measured}),
        },
        **{f"by_{name[:-1]}": _records(table) for name, table in groups.items()},
        "accuracy": _accuracy(summaries),
        "flagged": _flagged(summaries),
        "failed": [{"sequence": name, "reason": why} for name, why in sorted(failed.items())],
        "bodies": _bodies(summaries),
        "splits": {"subject": _split_to_json(by_subject, measured, "subject"),
                   "object": _split_to_json(by_object, measured, "object_")},
        "formats": _formats(formats),
        "conventions": CONVENTIONS,
        "stages": _stages(summaries),
        "software": dict(versions()),
    }  # fmt: skip


def _formats(names: Sequence[str]) -> dict[str, dict[str, str]]:
    """Return files and content of exported formats, and of merged ones, by name."""
    exported = [format_ for name, format_ in export_formats().items() if name in names]
    described = {
        format_.name: {"path": format_.files, "content": format_.content} for format_ in exported
    }
    merged = {
        f"{format_.name}_merged": {
            "path": format_.files.removeprefix("*/"), "content": format_.merged
        }
        for format_ in exported
        if format_.merged
    }  # fmt: skip
    return described | merged


def split_table(summaries: Sequence[SequenceSummary], settings: CardSettings) -> pd.DataFrame:
    """Return one row per sequence with its part of both splits, "" for none."""
    measured = [s.metrics for s in summaries]
    by_subject, by_object = ({} if why else parts for parts, why in _splits(measured, settings))
    return pd.DataFrame(
        [
            {
                "sequence": s.name,
                "subject": s.subject,
                "object": s.object_,
                "frames": len(s),
                "by_subject": by_subject.get(s.subject, ""),
                "by_object": by_object.get(s.object_, ""),
            }
            for s in measured
        ],
        columns=["sequence", "subject", "object", "frames", "by_subject", "by_object"],
    )


def markdown(card: Facts) -> str:
    """Return the card as Markdown, with the header that dataset hubs read."""
    environment = text_templates()
    environment.filters["plain"] = _escape
    frames = card["counts"]["frames"]
    size = next((name for most, name in _SIZES if frames < most), "n>10M")
    licence = card["licence"].lower()
    hub_licence = licence if _HUB_LICENCE.fullmatch(licence) else ""
    return environment.get_template("card.md.j2").render(
        card=card, size=size, hub_licence=hub_licence
    )


def _escape(text: str) -> str:
    """First line of a text of artefacts or logs, with the characters of markup escaped."""
    line = (str(text).splitlines() or [""])[0].replace("|", "/")
    return _MARKUP.sub(r"\\\g<0>", html.escape(line, quote=False))


def _splits(measured: Sequence[SequenceMetrics], settings: CardSettings) -> tuple[Split, Split]:
    """Split by subject and by object."""
    subjects: Counter[str] = Counter()
    objects: Counter[str] = Counter()
    for sequence in measured:
        subjects[sequence.subject] += len(sequence)
        if sequence.object_:
            objects[sequence.object_] += len(sequence)
    share = settings.test_share
    return (
        split(subjects, share=share, named=settings.test_subjects),
        split(objects, share=share, named=settings.test_objects),
    )


def _records(table: pd.DataFrame) -> list[dict[str, Any]]:
    """Return the card's figures of each group; None if unknown."""
    columns = ["sequences", "frames", "minutes", "contact_percent"]
    columns += [f"flagged.{part}_percent" for part in PARTS]
    rows = []
    for row in table.to_dict("records"):
        group = {str(table.columns[0]): row[table.columns[0]]}
        rows.append(group | {name: _plain(row[name]) for name in columns if name in row})
    return rows


def _plain(value: Any) -> int | float | None:
    if isinstance(value, int | np.integer):
        return int(value)
    return round(float(value), 2) if np.isfinite(value) else None


def _accuracy(summaries: Sequence[SequenceSummary]) -> dict[str, Any]:
    """Return stated errors, distances to the clouds, penetration and, if known, true errors."""
    measured = [s.metrics for s in summaries]
    clouds, depth = figures.cloud_figures(measured), figures.penetration_figures(measured)
    accuracy: dict[str, Any] = {
        "stated_mm": {part: round(value, 2) for part, value in mean_stated(measured).items()},
        "nothing_stated_of": sum(bool(e.silent) for s in measured for e in stated_errors(s)),
        "body_to_cloud_mm": _plain(clouds["body_visible_mm"]),
        "object_to_cloud_mm": _plain(clouds.get("object_visible_mm", np.nan)),
        "penetration_mm": _plain(depth.get("mean_mm", np.nan)),
        "physics": {name: _plain(value) for name, value in physics_figures(measured).items()},
    }
    if any(s.has_truth for s in measured):
        true = figures.truth_figures(measured, "joint")
        keys = ("body_pve_mm", "body_mpjpe_mm", "hand_mpjpe_mm", "object_translation_mm",
                "object_rotation_deg", "contact_region_f1")  # fmt: skip
        accuracy["against_truth"] = {key: _plain(true[key]) for key in keys if key in true}
        accuracy["in_range"] = {
            part: {"true_errors_in_range": inside, "of": count}
            for part, inside, count in covered(measured)
        }
    return accuracy


def _flagged(summaries: Sequence[SequenceSummary]) -> dict[str, Any]:
    """Count the flagged frames of each part, and the frames with each reason."""
    counted: Counter[str] = Counter()
    for s in summaries:
        for reasons in s.metrics.flags.reasons:
            kinds = {_NUMBER.sub("…", part.strip()) for part in str(reasons).split(";")}
            counted.update(kinds - {""})
    flags = figures.pooled_flags([s.metrics for s in summaries])
    return {
        "parts": [
            {"part": part, "frames": int(count), "percent": round(100 * share, 2)}
            for (part, share), count in zip(
                flags.shares().items(), flags.flagged.sum(axis=0), strict=True
            )
        ],
        "reasons": [
            {"reason": why, "frames": count} for why, count in counted.most_common(_MAX_REASONS)
        ],
    }


def _bodies(summaries: Sequence[SequenceSummary]) -> list[dict[str, Any]]:
    open_digest = file_digest(OPEN_BODY)
    bodies = {s.body for s in summaries}
    return [
        {
            "gender": body.gender,
            "open": body.digest == open_digest,
            "digest": body.digest,
            "num_betas": body.num_betas,
            "num_expression": body.num_expression,
        }
        for body in sorted(bodies, key=lambda b: (b.gender, b.digest))
    ]


def _split_to_json(
    split_: Split, measured: Sequence[SequenceMetrics], attribute: str
) -> dict[str, Any]:
    parts, why = split_
    entries: dict[str, Any] = {"why_not": why}
    for part in (TRAIN, TEST):
        groups = [group for group, own in parts.items() if own == part]
        members = [s for s in measured if getattr(s, attribute) in groups]
        frames = sum(len(s) for s in members)
        entries[part] = {"groups": groups, "sequences": len(members), "frames": frames}
    return entries


def _stages(summaries: Sequence[SequenceSummary]) -> dict[str, list[dict[str, Any]]]:
    """Count sequences by stage, schema version and digest of settings."""
    return {
        stage: [
            {"version": version, "settings": digest, "sequences": len(names)}
            for version, digest, names in entries
        ]
        for stage, entries in made_by_stage(summaries).items()
    }


TRAIN, TEST = "train", "test"
Split = tuple[dict[str, str], str]
"""Part (TRAIN or TEST) of each group (subject or object), and why there is no split; "" if there is
one. Without a split, all groups are for training."""


def split(frames: Mapping[str, int], *, share: float, named: Sequence[str] = ()) -> Split:
    """Choose groups for the test part that have about ``share`` of all frames.

    Groups are visited in the order of a digest of their names. A group is added if that brings the
    number of frames nearer to the goal; if none is added, the group with the fewest frames is.
    The choice is independent of the groups' numbering, and the same groups give the same split.

    Args:
        frames: number of frames by group.
        named: groups to choose instead; unknown names are ignored.
    """
    groups = sorted(frames, key=lambda name: hashlib.sha256(name.encode()).digest())
    test, why = {name for name in named if name in frames}, ""
    if named and not test:
        why = f"none of {', '.join(named)} has a sequence"
    elif named and test == set(frames):
        test, why = set(), "all groups would be held out"
    elif not named and share <= 0:
        why = "the share of the test part is 0"
    elif not named and len(groups) < 2:
        why = "there is only one group" if groups else "there is no group"
    elif not named:
        goal, total = share * sum(frames.values()), 0
        for name in groups:
            remaining = len(groups) - len(test) > 1
            if remaining and abs(total + frames[name] - goal) < abs(total - goal):
                test.add(name)
                total += frames[name]
        test = test or {min(groups, key=frames.__getitem__)}
    return {name: TEST if name in test else TRAIN for name in sorted(frames)}, why
