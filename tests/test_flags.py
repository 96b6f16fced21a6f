"""Flags by part."""

import numpy as np

from intercap_core.flags import OF_BODY, OF_OBJECT, PARTS, Flags


def test_a_cause_flags_its_parts_and_the_others_stay_trusted():
    lost, unseen = np.array([1, 0, 1], bool), np.array([0, 0, 1], bool)
    flags = Flags.of(3, [(lost, "object lost", OF_OBJECT), (unseen, "no images", PARTS)])
    assert flags.flagged.astype(int).tolist() == [[0, 0, 1, 1], [0, 0, 0, 0], [1, 1, 1, 1]]
    every = "body, hands, object, contact: no images"
    assert flags.reasons == [
        "object, contact: object lost",
        "",
        f"object, contact: object lost; {every}",
    ]
    assert flags.texts()[:2] == ["object and contact (object lost)", ""]
    assert flags.reasons_of("object") == ["object lost", "", "object lost; no images"]
    assert flags.reasons_of("hands") == ["", "", "no images"]


def test_reasons_may_contain_separators():
    always = np.array([True])
    flags = Flags.of(1, [(always, "k1: cut; repaired", ["body"]), (always, "lost", OF_OBJECT)])
    assert flags.reasons == ["body: k1: cut; repaired; object, contact: lost"]
    assert flags.texts() == ["body (k1: cut; repaired); object and contact (lost)"]
    assert flags.reasons_of("body") == ["k1: cut; repaired"]


def test_a_person_alone_has_no_flags_of_object_and_contact():
    flags = Flags.of(1, [(np.array([True]), "not seen", OF_BODY)], has_object=False)
    assert flags.flagged.tolist() == [[True, True, False, False]]
    assert flags.summary() == "flagged: body 1, hands 1 of 1 frames"
