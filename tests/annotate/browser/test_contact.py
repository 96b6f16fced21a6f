"""Contact on the timeline, by drags and keys."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.annotate.browser.hand import HAND, SAVED, open_page
from tests.annotate.served import annotation, served
from tests.helpers.browser import needs_chromium

pytestmark = needs_chromium
NONE = "annotated: no contact in the whole sequence"
START = {"uncertain": "start"}  # an estimated end that was not edited


def test_contact_is_dragged_split_deleted_and_saved(settings: Path) -> None:
    annotation(settings).write_text("# kept\ndrop_frames: [9]\n")
    with served(settings) as server, open_page(server) as hand:
        x, y, width, _ = hand.box(HAND)
        hand.drag((x + width - 4, y + 10), (-2 * width / 6, 3))
        assert hand.draft("contact") == [{"part": "right_hand", "start": 2, "end": 6} | START]
        hand.press("Control+z")
        assert hand.draft("contact") is None
        hand.press("Control+Shift+z")
        hand.page.locator(HAND).focus()
        hand.show(4)
        hand.press("k")
        assert [interval["start"] for interval in hand.draft("contact")] == [2, 4]
        hand.press("Delete")
        assert hand.draft("contact") == [{"part": "right_hand", "start": 2, "end": 4} | START]
        hatched, lane = hand.box(".uncertain"), hand.box('[data-part="right_hand"] .lane')
        assert hatched[0] == lane[0] and hatched[2] == pytest.approx(0.7 * lane[2], abs=1)
        hand.page.locator(HAND).focus()
        for end in ("end", "start"):
            hand.page.locator(f"[data-exact={end}]").click()
        assert hand.draft("contact")[0]["uncertain"] == "end"
        hand.press("Control+z", "Control+z")
        assert "+  - {part: right_hand, start: 2, end: 4, uncertain: start}" in hand.open_save()
        hand.answer("save")
        hand.wait(SAVED)
        hand.page.locator("#tab-run").click()
        hand.app("saving.compare()")
        [edit] = hand.page.locator(".edits .differs", has_text="right hand").all_inner_texts()
        assert (
            "frames 2 to 3" in edit and "2 to 7" in edit and "recompute the outdated stages" in edit
        )
    text = annotation(settings).read_text()
    assert text.startswith("# kept\ndrop_frames: [9]\n") and "start: 2, end: 4" in text


def test_nothing_touches_is_stated_and_removed(settings: Path) -> None:
    path = annotation(settings)
    with served(settings) as server, open_page(server) as hand:
        hand.page.locator(HAND).focus()
        hand.press("Delete")  # the last interval
        assert hand.draft("contact") == [] and NONE in hand.text("#contact-bar")
        hand.click("Discard, use the estimate")
        assert hand.draft("contact") is None and hand.page.locator(HAND).count() == 1
        hand.press("Control+z")
        assert hand.draft("contact") == []
        assert "+contact: []" in hand.open_save()
        hand.wait("document.querySelector('[data-part=stale]').textContent.includes('joint')")
        hand.answer("save")
        hand.wait(SAVED)
        assert path.read_text() == "contact: []\n"
        hand.reload()
        assert hand.draft("contact") == [] and NONE in hand.text("#contact-bar")
        hand.click("Discard, use the estimate")
        hand.open_save()
        hand.answer("save")
        hand.wait("document.getElementById('status').textContent === 'no annotation yet'")
        hand.click("No contact at all")
        assert hand.draft("contact") == [] and path.read_text().strip() == ""


def test_undo_restores_contact_and_delete_removes_the_selected(settings: Path) -> None:
    confirmed = "contact.intervals().map((i) => window.annotate.contact.isConfirmed(i))"
    back = {"part": "back", "start": 3, "end": 10}
    with served(settings) as server, open_page(server) as hand:
        for key in ("k", "Delete"):
            hand.press(key)
            assert "select a bar" in hand.text("#hint")
        hand.show(3)
        hand.page.locator("#part").select_option("back")
        assert hand.app(confirmed) == [False, True]  # the hand's estimate was copied
        hand.page.locator(HAND).focus()
        hand.press("c")
        assert hand.app(confirmed) == [True, True]
        hand.press("Control+z")
        assert hand.app(confirmed) == [False, True] and back in hand.draft("contact")
        hand.page.locator(HAND).focus()
        hand.show(9)
        hand.press("[")
        assert "would end before" in hand.text("#hint")
        hand.show(5)
        hand.press("]", "Control+z", "Delete")
        assert hand.draft("contact") == [back]
        x, y, width, _ = hand.box('[data-part="back"] .bar')
        hand.drag((x + width / 2, y + 8), (-width, 2))  # past the first frame: the length stays
        assert hand.draft("contact") == [back | {"start": 0, "end": 7}]
