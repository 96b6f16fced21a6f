"""Conflicts with other annotators, and unsaved edits of closed tabs."""

from __future__ import annotations

from pathlib import Path

from tests.annotate.browser.hand import HAND, READY, SAVED, open_page
from tests.annotate.served import NAME, TOKEN, annotation, served
from tests.helpers.browser import Visit, needs_chromium

pytestmark = needs_chromium


def test_two_annotators_keep_both_changes(settings: Path) -> None:
    path = annotation(settings)
    path.write_text("# two people\ndrop_frames: [9]\n")
    with served(settings) as server, open_page(server) as hand:
        hand.page.locator(HAND).focus()
        hand.press("c")
        path.write_text("# two people\ndrop_frames: [8, 9]\n")
        assert "[8, 9]" in hand.save_conflict("mine")
    text = path.read_text()
    assert text.startswith("# two people") and "drop_frames: [8, 9]" in text
    assert "right_hand" in text


def test_edits_survive_a_reload(settings: Path) -> None:
    with served(settings) as server, open_page(server) as hand:
        hand.press("x")
        assert hand.draft("drop_frames") == [0]
        hand.page.on("dialog", lambda dialog: dialog.accept())
        hand.reload()
        assert hand.draft("drop_frames") is None
        hand.press("u")  # new edits do not overwrite the older ones
        hand.app("draft.set('subject', [{camera: 'k1', x: 9, y: 9}])")
        hand.click("Restore")
        assert hand.draft("drop_frames") == [0] and hand.draft("subject") is not None


def test_edits_of_closed_tabs_are_merged_with_later_saves(settings: Path) -> None:
    path = annotation(settings)
    path.write_text("# two people\ndrop_frames: [9]\n")
    offer = '[data-banner="orphans"]'
    with served(settings) as server, open_page(server) as hand:
        address = f"{server.address}/sequence/{NAME}#token={TOKEN}"
        others = [hand.page.context.new_page() for _ in range(2)]
        for other, edit in zip(others, ("drop_frames: [0, 9]", "contact: []"), strict=True):
            other.goto(address)
            Visit(other, hand.visit.fingers).wait(READY)
            assert other.locator(offer).count() == 0  # edits of open tabs are not offered
            name, value = edit.split(": ")
            other.evaluate(f"window.annotate.draft.set('{name}', {value})")
        for other in others:
            other.close()
        path.write_text("# two people\ndrop_frames: [8, 9]\n")
        hand.page.evaluate(
            """() => { const old = { at: Date.now() - 31 * 24 * 3600e3, changes: {}, sections: {} };
              localStorage.setItem("intercap-draft:other:s:tab", JSON.stringify(old));
              localStorage.setItem(`intercap-draft:other:${window.annotate.info.sequence}:tab`,
                JSON.stringify({ ...old, at: Date.now(), changes: { drop_frames: [5] } })); }"""
        )
        hand.reload()
        assert "contact" in hand.text(offer) and "1 older" in hand.text(offer)
        hand.click("Restore")
        hand.wait("document.getElementById('dialog').open")
        assert "both changes can be kept" in hand.text("#dialog")
        hand.resolve("mine")
        assert path.read_text() == "# two people\ndrop_frames: [8, 9]\n\ncontact: []\n"
        hand.wait("document.querySelector('[data-banner=\"orphans\"]') !== null")
        assert "drop frames" in hand.text(offer)
        hand.click("Restore")
        hand.wait("document.getElementById('dialog').open")
        text = hand.text("#dialog")
        assert "Both of you changed drop frames" in text and "+drop_frames: [8, 9]" in text
        hand.resolve("theirs")
        hand.wait(SAVED)
        assert hand.draft("drop_frames") == [8, 9] and hand.draft("contact") == []
        stored = hand.page.evaluate("Object.keys(localStorage)")
        assert stored == [f"intercap-draft:other:{NAME}:tab"]


def test_undo_never_discards_saves_of_others(settings: Path) -> None:
    path = annotation(settings)
    path.write_text("drop_frames: [9]\n")
    with served(settings) as server, open_page(server) as hand:
        hand.page.locator(HAND).focus()
        hand.press("c")
        path.write_text("drop_frames: [8, 9]\n")
        hand.save_conflict("theirs")
        hand.wait("window.annotate.draft.get('contact') === null")
        hand.press("Control+z")
        assert hand.draft("drop_frames") == [8, 9] and hand.draft("contact") is not None
        hand.save()
        hand.press("x")
        hand.save()  # does not wait for the plan of the first save
        path.write_text("drop_frames: [7]\n")
        hand.app("reload()")
        hand.wait("window.annotate.draft.get('contact') === null")
        hand.press("Control+z")
        assert hand.draft("drop_frames") == [7]
        path.write_text("drop_frames: [7\n")
        hand.app("reload()")
        hand.wait("document.getElementById('banners').textContent.includes('not valid YAML')")
        assert hand.draft("drop_frames") == [7]
