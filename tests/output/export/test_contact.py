"""The draft of a contact annotation is one that the project reads."""

from __future__ import annotations

import numpy as np
import pytest
import yaml

from intercap_core.annotation import Annotation
from intercap_core.joint.contact.annotated import annotation_evidence
from intercap_core.output.export.contact import StatedContact
from intercap_core.output.export.contact_files import draft, table
from intercap_core.schemas import CONTACT_REGIONS


def _stated(*contacts: tuple[str, int, int]) -> StatedContact:
    probability = np.full((40, len(CONTACT_REGIONS)), 0.02)
    for region, start, end in contacts:
        probability[start:end, CONTACT_REGIONS.index(region)] = 0.9
    return StatedContact("cup", CONTACT_REGIONS, probability, np.full(probability.shape, -1))


@pytest.mark.parametrize(
    "contacts",
    [
        [],
        [("left_hand", 0, 40)],
        [("mouth", 20, 21), ("right_hand", 3, 12), ("right_hand", 14, 40), ("seat", 0, 2)],
    ],
)
def test_the_draft_reads_back_as_the_stated_contact(contacts):
    stated = _stated(*contacts)
    read = Annotation.model_validate(yaml.safe_load(draft(stated)))
    assert read.contact is not None
    _, labels = annotation_evidence(read.contact, CONTACT_REGIONS, 40, 0)
    np.testing.assert_array_equal(labels == 1, stated.probability >= 0.5)
    assert read.check_frames(40) is None


def test_the_draft_says_how_sure_each_interval_is():
    stated = _stated(("mouth", 20, 24))
    stated.probability[20, CONTACT_REGIONS.index("mouth")] = 0.5
    assert "{part: mouth, start: 20, end: 24, uncertain: both}  # 0.80, least 0.50" in draft(stated)


def test_ends_that_an_annotation_states_stay_exact_in_the_draft():
    stated = _stated(("mouth", 20, 24))
    mouth = stated.probability[:, CONTACT_REGIONS.index("mouth")]
    mouth[:20], mouth[20:24] = 0.0, 1.0
    assert "{part: mouth, start: 20, end: 24, uncertain: end}  # 1.00" in draft(stated)


def test_the_contact_table_has_a_row_per_frame_and_region():
    stated = _stated(("mouth", 20, 24))
    stated.annotated[0, 0] = 1
    rows = [row.split("\t") for row in table(stated).splitlines()]
    assert len(rows) == 1 + 40 * len(CONTACT_REGIONS)
    assert rows[1] == ["0", "left_hand", "0.0200", "1"]
    assert ["20", "mouth", "0.9000", ""] in rows
