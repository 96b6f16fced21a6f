"""Saves that meet others, and edits that were not saved."""

from __future__ import annotations

from pathlib import Path

from tests.annotate.browser.hand import (
    HAND,
    READY,
    SAVED,
    draft_of,
    keep_mine,
    open_page,
    save,
)
from tests.annotate.served import NAME, TOKEN, annotation, served
from tests.helpers.browser import Visit, needs_chromium

pytestmark = needs_chromium


def test_two_annotators_keep_both_changes(settings: Path) -> None:
    path = annotation(settings)
    path.write_text("# two people\ndrop_frames: [9]\n")
    with served(settings) as server, open_page(server) as page:
        page.page.locator(HAND).focus()
        page.page.keyboard.press("c")
        path.write_text("# two people\ndrop_frames: [8, 9]\n")
        save(page)
        page.wait("document.getElementById('dialog-title').textContent.startsWith('Somebody')")
        assert "[8, 9]" in page.page.locator("#dialog").inner_text()
        keep_mine(page)
    text = path.read_text()
    assert (
        "drop_frames: [8, 9]" in text and "right_hand" in text and text.startswith("# two people")
    )


def test_edits_of_a_tab_that_went_away_are_found_again(settings: Path) -> None:
    with served(settings) as server, open_page(server) as page:
        page.page.keyboard.press("x")
        assert draft_of(page, "drop_frames") == [0]
        page.page.on("dialog", lambda dialog: dialog.accept())
        page.page.reload()
        page.wait(READY)
        assert draft_of(page, "drop_frames") is None
        page.page.keyboard.press("u")  # the older edits are not written over by new ones
        page.page.evaluate("window.annotate.draft.set('subject', [{camera: 'k1', x: 9, y: 9}])")
        page.page.get_by_text("Take them up again").click()
        assert draft_of(page, "drop_frames") == [0] and draft_of(page, "subject") is not None


def test_edits_of_several_tabs_meet_what_was_saved_meanwhile(settings: Path) -> None:
    path = annotation(settings)
    path.write_text("# two people\ndrop_frames: [9]\n")
    with served(settings) as server, open_page(server) as page:
        address = f"{server.address}/sequence/{NAME}#token={TOKEN}"
        offered = page.page.locator('[data-banner="left"]')
        others = [page.page.context.new_page() for _ in range(2)]
        for other, edit in zip(others, ("drop_frames: [0, 9]", "contact: []"), strict=True):
            other.goto(address)
            Visit(other, page.fingers).wait(READY)
            assert other.locator('[data-banner="left"]').count() == 0  # of tabs that live
            name, value = edit.split(": ")
            other.evaluate(f"window.annotate.draft.set('{name}', {value})")
        for other in others:
            other.close()
        path.write_text("# two people\ndrop_frames: [8, 9]\n")
        page.page.evaluate(
            """() => { const old = { at: Date.now() - 31 * 24 * 3600e3, changes: {}, sections: {} };
              localStorage.setItem("intercap-draft:other:s:tab", JSON.stringify(old));
              localStorage.setItem(`intercap-draft:other:${window.annotate.told.sequence}:tab`,
                JSON.stringify({ ...old, at: Date.now(), changes: { drop_frames: [5] } })); }"""
        )
        page.page.reload()
        page.wait(READY)
        assert "contact" in offered.inner_text() and "1 older" in offered.inner_text()
        page.page.get_by_text("Take them up again").click()
        page.wait("document.getElementById('dialog').open")
        assert "both changes can stand" in page.page.locator("#dialog").inner_text()
        keep_mine(page)
        assert path.read_text() == "# two people\ndrop_frames: [8, 9]\n\ncontact: []\n"
        page.wait("document.querySelector('[data-banner=\"left\"]') !== null")
        assert "drop frames" in offered.inner_text()
        page.page.get_by_text("Take them up again").click()
        page.wait("document.getElementById('dialog').open")
        shown = page.page.locator("#dialog").inner_text()
        assert "Both of you changed drop frames" in shown and "+drop_frames: [8, 9]" in shown
        page.page.locator('[data-answer="theirs"]').click()
        page.wait(SAVED)
        assert draft_of(page, "drop_frames") == [8, 9] and draft_of(page, "contact") == []
        assert page.page.evaluate("Object.keys(localStorage)") == [
            f"intercap-draft:other:{NAME}:tab"
        ]


def test_no_step_back_takes_away_what_others_saved(settings: Path) -> None:
    path = annotation(settings)
    path.write_text("drop_frames: [9]\n")
    with served(settings) as server, open_page(server) as page:
        keys = page.page.keyboard
        page.page.locator(HAND).focus()
        keys.press("c")
        path.write_text("drop_frames: [8, 9]\n")
        save(page)
        page.wait("document.getElementById('dialog-title').textContent.startsWith('Somebody')")
        page.page.locator('[data-answer="theirs"]').click()
        page.wait("window.annotate.draft.get('contact') === null")
        keys.press("Control+z")
        assert draft_of(page, "drop_frames") == [8, 9] and draft_of(page, "contact") is not None
        save(page)
        page.wait(SAVED)
        keys.press("x")
        save(page)  # at once, while it is looked up what a run would make anew
        page.wait(SAVED)
        path.write_text("drop_frames: [7]\n")
        page.page.evaluate("window.annotate.reload()")
        page.wait("window.annotate.draft.get('contact') === null")
        keys.press("Control+z")
        assert draft_of(page, "drop_frames") == [7]
        path.write_text("drop_frames: [7\n")
        page.page.evaluate("window.annotate.reload()")
        page.wait("document.getElementById('banners').textContent.includes('not valid YAML')")
        assert draft_of(page, "drop_frames") == [7]
