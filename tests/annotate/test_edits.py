"""Comparison of the annotation's entries with the result."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from intercap_core.annotate.edits import list_edits
from intercap_core.annotate.opened import Opened
from intercap_core.annotation import Annotation
from tests.annotate.served import artefact, detect


def _fitted(settings: Path, touching: slice, labels: slice, reason: str = "") -> None:
    """Contact of the right hand in the joint artefact, and the annotation that it used."""
    with h5py.File(artefact(settings, "joint"), "r+") as file:
        hand = list(file["region_names"].asstr()).index("right_hand")
        file["contact_probability"][...] = 0.0
        file["contact_probability"][touching, hand] = 0.9
        file["contact_annotated"][...] = 0
        file["contact_annotated"][labels, hand] = 1
        reasons = [reason if t == 1 else "" for t in range(len(file["flag_reason"]))]
        del file["flag_reason"]
        file["flag_reason"] = np.array(reasons, "S120")


@pytest.mark.parametrize(
    ("fitted", "labels", "reason", "uncertain", "result", "why"),
    [
        (slice(1, 4), slice(1, 4), "", None, "1 to 3", ""),
        (slice(1, 5), slice(1, 4), "", "end", "1 to 4", "uncertain"),
        (slice(2, 3), slice(2, 3), "", None, "2 to 2", "before this edit"),
        (slice(1, 4), slice(1, 4), "body: body inside; contact: contact of right_hand annotated "
         "0.20 m from the object or more", None, "1 to 3", "0.20 m"),
        (slice(0, 0), slice(1, 4), "", "both", "no contact", "uncertain"),
    ],
)  # fmt: skip
def test_contact(
    opened: Opened, settings: Path, fitted: slice, labels: slice, reason: str,
    uncertain: Any, result: str, why: str,
) -> None:  # fmt: skip
    _fitted(settings, fitted, labels, reason)
    stated = {"part": "right_hand", "start": 1, "end": 4, "uncertain": uncertain}
    [entry] = list_edits(opened, Annotation.model_validate({"contact": [stated]}))
    assert entry["annotated"] == "right hand: frames 1 to 3" and entry["result"] == result
    assert entry["same"] == (not why) and why in entry["why"] and "body" not in entry["why"]


def test_all_sections_differing_entries_first(opened: Opened, settings: Path) -> None:
    _fitted(settings, slice(0, 0), slice(0, 0))
    detect(settings, {"k1": [1]})
    with h5py.File(artefact(settings, "joint")) as file:
        vectors = Rotation.from_matrix(file["rotation"][:]).as_rotvec()
        places = file["translation"][:].astype(float)
    poses = [
        {"frame": 2, "rotation_vector": vectors[2].tolist(), "translation": places[2].tolist()},
        {"frame": 3, "rotation_vector": vectors[3].tolist(),
         "translation": (places[3] + [0.0, 0.04, 0.03]).tolist()},
    ]  # fmt: skip
    found = list_edits(
        opened,
        Annotation.model_validate(
            {
                "contact": [],
                "object_poses": poses,
                "floor": [[0, 1, 2], [1, 1, 2], [0, 1, 3]],
                "subject": [{"camera": "k1", "x": 5, "y": 5}],
                "drop_frames": [5],
                "left_right": [{"camera": "k1", "start": 1, "end": 3}],
            }
        ),
    )
    assert [(entry["section"], entry["frame"], entry["same"]) for entry in found] == [
        ("object_poses", 3, False), ("floor", 0, False), ("subject", 0, False),
        ("left_right", 1, False), ("drop_frames", 5, False),
        ("contact", 0, True), ("object_poses", 2, True),
    ]  # fmt: skip
    assert found[0]["result"] == "50 mm and 0° away" and "10 mm" in found[0]["why"]
    assert found[3]["result"] == "swapped in 1 of 2 images"


def test_without_results_there_are_no_entries(opened: Opened, settings: Path) -> None:
    for path in artefact(settings, "joint").parent.glob("*.h5"):
        path.unlink()
    assert list_edits(opened, Annotation.model_validate({"contact": []})) == []
