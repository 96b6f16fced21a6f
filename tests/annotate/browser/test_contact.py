"""Contact on the timeline, by drags and keys."""

from __future__ import annotations

from pathlib import Path

from tests.annotate.browser.hand import HAND, READY, SAVED, draft_of, drag, open_page, save
from tests.annotate.served import annotation, served
from tests.helpers.browser import needs_chromium

pytestmark = needs_chromium


def test_contact_is_dragged_split_denied_and_saved_with_its_difference(settings: Path) -> None:
    annotation(settings).write_text("# kept\ndrop_frames: [9]\n")
    with served(settings) as server, open_page(server) as page:
        keys = page.page.keyboard
        box = page.page.locator(HAND).bounding_box()
        assert box is not None
        frame = box["width"] / 6
        drag(page, (box["x"] + box["width"] - 4, box["y"] + 10), (-2 * frame, 3))
        assert draft_of(page, "contact") == [{"part": "right_hand", "start": 2, "end": 6}]
        keys.press("Control+z")
        assert draft_of(page, "contact") is None
        keys.press("Control+Shift+z")
        page.page.locator(HAND).focus()
        page.page.evaluate("window.annotate.show(4)")
        keys.press("k")
        assert [one["start"] for one in draft_of(page, "contact")] == [2, 4]
        keys.press("Delete")
        assert draft_of(page, "contact") == [{"part": "right_hand", "start": 2, "end": 4}]
        keys.press("Control+s")
        page.wait("document.getElementById('dialog').open")
        shown = page.page.locator("#dialog").inner_text()
        assert "+  - {part: right_hand, start: 2, end: 4}" in shown
        page.page.locator('[data-answer="save"]').click()
        page.wait(SAVED)
        text = annotation(settings).read_text()
        assert text.startswith("# kept\ndrop_frames: [9]\n") and "start: 2, end: 4" in text


def test_that_nothing_touches_is_stated_and_taken_back(settings: Path) -> None:
    path = annotation(settings)
    with served(settings) as server, open_page(server) as page:
        bar, keys = page.page.locator("#contact-bar"), page.page.keyboard
        page.page.locator(HAND).focus()
        keys.press("Delete")  # the last interval: nothing touches any more
        assert (
            draft_of(page, "contact") == [] and "nothing touches, as annotated" in bar.inner_text()
        )
        page.page.get_by_role("button", name="As found again").click()
        assert draft_of(page, "contact") is None and page.page.locator(HAND).count() == 1
        keys.press("Control+z")
        assert draft_of(page, "contact") == []
        keys.press("Control+s")
        page.wait("document.getElementById('dialog').open")
        page.wait("document.querySelector('[data-part=touches]').textContent.includes('joint')")
        assert "+contact: []" in page.page.locator("#dialog").inner_text()
        page.page.locator('[data-answer="save"]').click()
        page.wait(SAVED)
        assert path.read_text() == "contact: []\n"
        page.page.reload()
        page.wait(READY)
        assert (
            draft_of(page, "contact") == [] and "nothing touches, as annotated" in bar.inner_text()
        )
        page.page.get_by_role("button", name="As found again").click()
        save(page)
        page.wait("document.getElementById('status').textContent === 'no annotation yet'")
        page.page.get_by_role("button", name="Nothing touches").click()
        assert draft_of(page, "contact") == [] and path.read_text().strip() == ""


def test_a_step_back_leads_to_what_was_and_delete_takes_the_chosen_part(settings: Path) -> None:
    looked = "window.annotate.contact.intervals().map((one) => window.annotate.contact.looked(one))"
    back = {"part": "back", "start": 3, "end": 10}
    with served(settings) as server, open_page(server) as page:
        keys, hint = page.page.keyboard, page.page.locator("#hint")
        for key in ("k", "Delete"):
            keys.press(key)
            assert "choose a bar" in hint.inner_text()
        page.page.evaluate("window.annotate.show(3)")
        page.page.locator("#part").select_option("back")
        assert page.page.evaluate(looked) == [False, True]  # the hand's is taken as it was found
        page.page.locator(HAND).focus()
        keys.press("c")
        assert page.page.evaluate(looked) == [True, True]
        keys.press("Control+z")  # of confirming alone
        assert page.page.evaluate(looked) == [False, True] and back in draft_of(page, "contact")
        page.page.locator(HAND).focus()
        page.page.evaluate("window.annotate.show(9)")
        keys.press("[")
        assert "would end before" in hint.inner_text()
        page.page.evaluate("window.annotate.show(5)")
        keys.press("]")
        keys.press("Control+z")
        keys.press("Delete")
        assert draft_of(page, "contact") == [back]
        box = page.page.locator('[data-part="back"] .bar').bounding_box()
        assert box is not None  # a bar that is dragged past the first frame keeps its length
        drag(page, (box["x"] + box["width"] / 2, box["y"] + 8), (-box["width"], 2))
        assert draft_of(page, "contact") == [back | {"start": 0, "end": 7}]
