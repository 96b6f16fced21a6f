"""Subject, floor, dropped frames, left and right, and questions."""

from __future__ import annotations

from pathlib import Path

import yaml

from tests.annotate.browser.hand import READY, SAVED, draft_of, drag, open_page, save
from tests.annotate.served import NAME, annotation, detect, served
from tests.helpers.browser import Visit, needs_chromium

pytestmark = needs_chromium
_ASK_SEAT = (
    "(({ list }) => window.annotate.questions.ask(list.find((q) => q.part === 'seat')))"
    "(window.annotate.questions)"
)


def test_subject_floor_and_dropped_frames_are_clicked(settings: Path) -> None:
    with served(settings) as server, open_page(server) as page:
        keys, view = page.page.keyboard, page.page.locator('[data-camera="k1"] canvas')
        box = view.bounding_box()
        assert box is not None
        keys.press("u")
        page.page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
        [point] = draft_of(page, "subject")
        assert (
            point["camera"] == "k1" and abs(point["x"] - 239.5) < 2 and abs(point["y"] - 134.5) < 2
        )
        keys.press("Escape")
        keys.press("g")
        for k, (x, y) in enumerate(((0.1, 0.9), (0.9, 0.9), (0.5, 0.1))):
            page.page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
            page.wait(f"(window.annotate.draft.get('floor') ?? []).length === {k + 1}")
        assert all(
            abs(z - 4.0) < 0.3 for _, _, z in draft_of(page, "floor")
        )  # the wall of the capture
        keys.press("Escape")
        keys.press("End")
        keys.press("x")
        assert draft_of(page, "drop_frames") == [9]
        save(page)
        page.wait(SAVED)
    assert set(yaml.safe_load(annotation(settings).read_text())) == {
        "floor", "subject", "drop_frames",
    }  # fmt: skip


def test_left_and_right_are_seen_and_mended(settings: Path) -> None:
    """k1 and k2 were detected left for right in frames 3 to 6."""
    detect(settings, {"k1": range(3, 7), "k2": range(3, 7)})
    annotation(settings).write_text("# kept\ndrop_frames: [9]\n")

    def against(page: Visit, frame: int) -> list[bool]:
        return page.page.evaluate(
            f"[0, 1, 2].map((c) => window.annotate.sides.against(c, {frame}))"
        )

    def colour(page: Visit, side: int) -> list[int]:
        """Where the first large view has the letter of the left (0) or right (7) wrist's points, as
        they were detected: one of its pixels, to the left of the letter."""
        return page.page.evaluate(
            """(side) => { const a = window.annotate, view = a.views.views[0];
              const d = a.sides.data.arrays;
              const k = 2 * ((a.frame * 3 + 0) * 14 + 2 + side);
              const [x, y] = a.views.spot(view, d.detected[k], d.detected[k + 1]);
              const one = new OffscreenCanvas(1, 1).getContext("2d");
              one.drawImage(view.canvas, x - 6, y, 1, 1, 0, 0, 1, 1);
              return [...one.getImageData(0, 0, 1, 1).data].slice(0, 3); }""",
            side,
        )

    with served(settings) as server, open_page(server) as page:
        keys = page.page.keyboard
        page.wait("window.annotate.questions.list.some((q) => q.kind === 'sides')")
        keys.press("l")
        page.wait("window.annotate.sides.data !== null")
        assert against(page, 4) == [True, True, False] and not any(against(page, 2))
        assert page.page.locator('[data-sides="k1"] canvas').count() == 1  # shaded on the timeline
        page.page.locator('[data-camera="k1"] canvas').hover()
        page.page.evaluate("window.annotate.show(3)")
        page.wait("document.body.dataset.drawn === '3'")
        named_left = colour(page, 0)
        assert named_left[2] > 200 > named_left[0]  # blue
        keys.press("e")
        page.page.evaluate("window.annotate.show(5)")
        page.wait("document.querySelectorAll('.begun').length === 1")
        keys.press("e")
        stated = [{"start": 3, "end": 6, "camera": "k1"}]
        assert draft_of(page, "left_right") == stated
        assert [against(page, t)[0] for t in (3, 4, 5, 6)] == [False, False, False, True]
        page.page.evaluate("window.annotate.show(3)")
        page.wait("window.annotate.waits === false")
        named_left = colour(page, 0)
        assert named_left[0] > 200 > named_left[2]  # orange
        keys.press("Control+z")
        assert draft_of(page, "left_right") is None and against(page, 4)[0]
        keys.press("Control+Shift+z")
        bar = page.page.locator('[data-sides="k1"] .bar')
        box = bar.bounding_box()
        assert box is not None
        drag(page, (box["x"] + box["width"] - 4, box["y"] + 8), (box["width"] / 3, 2))
        stated[0]["end"] = 7
        assert draft_of(page, "left_right") == stated and not any(against(page, 6)[:1])
        bar.focus()
        keys.press("Delete")
        assert draft_of(page, "left_right") is None
        page.page.evaluate("window.annotate.show(8)")
        keys.press("Shift+E")
        page.page.locator("#tab-sides").click()
        page.page.locator('button[data-sides="all"]').click()
        assert draft_of(page, "left_right") == [{"start": 8, "end": 9}]
        keys.press("Control+z")
        keys.press("q")
        page.page.evaluate(
            "(({ list }) => window.annotate.questions.ask(list.find((q) => q.kind === 'sides')))"
            "(window.annotate.questions)"
        )
        keys.press("3")  # in every view
        assert draft_of(page, "left_right") == [{"start": 3, "end": 7}]
        keys.press("Control+z")
        page.wait("window.annotate.questions.list.some((q) => q.kind === 'sides')")
        page.page.evaluate(
            "(({ list }) => window.annotate.questions.ask(list.find((q) => q.kind === 'sides')))"
            "(window.annotate.questions)"
        )
        keys.press("2")  # in the view that is shown first
        assert draft_of(page, "left_right") == [{"start": 3, "end": 7, "camera": "k1"}]
        save(page)
        page.wait(SAVED)
        page.wait("window.annotate.questions.pending.length === 0")
        assert not [q for q in server.json(f"sequences/{NAME}/questions") if q["kind"] == "sides"]
        # a camera that slips: its images are stated by the sets that they are of
        moments = page.page.evaluate(
            """() => { const a = window.annotate, { sides, told } = a;
              told.image_of[1] = told.image_of[1].map((set) => set - 1);
              sides.change("k2", 7, 8, true);
              return sides.moments(sides.entries().find((one) => one.camera === "k2")); }"""
        )
        assert moments == [7, 9]
        assert {"start": 6, "end": 8, "camera": "k2"} in draft_of(page, "left_right")
        page.page.keyboard.press("Control+z")
    text = annotation(settings).read_text()
    assert text.startswith("# kept\n") and "left_right:\n  - {start: 3, end: 7, camera: k1}" in text


def test_a_question_is_answered_by_a_key_and_never_asked_again(settings: Path) -> None:
    with served(settings) as server, open_page(server) as page:
        page.wait("window.annotate.questions.list.length > 0")
        asked = page.page.evaluate("window.annotate.questions.list.map((q) => q.id)")
        assert "contact.seat.4.7" in asked
        page.page.evaluate(_ASK_SEAT)
        page.page.keyboard.press("1")
        page.wait("!window.annotate.questions.list.some((q) => q.part === 'seat')")
        assert {"part": "seat", "start": 4, "end": 8} in draft_of(page, "contact")
        page.page.keyboard.press("Control+z")  # an edit that is undone is asked again
        page.wait("window.annotate.questions.list.some((q) => q.part === 'seat')")
        page.page.evaluate(_ASK_SEAT)
        page.page.keyboard.press("1")
        save(page)
        page.wait(SAVED)
        page.wait("window.annotate.questions.pending.length === 0")
        page.page.reload()
        page.wait(READY)
        page.wait("window.annotate.questions.list.length > 0")
        asked = page.page.evaluate("window.annotate.questions.list.map((q) => q.id)")
        assert "contact.seat.4.7" not in asked


def test_edits_of_left_and_right_keep_what_is_stated_of_another_camera(settings: Path) -> None:
    annotation(settings).write_text("left_right:\n  - {start: 1, end: 3, camera: k9}\n")
    with served(settings) as server, open_page(server) as page:
        page.page.locator('[data-camera="k1"] canvas').hover()
        page.page.keyboard.press("e")
        page.page.keyboard.press("e")
        stated = [{"start": 0, "end": 1, "camera": "k1"}, {"start": 1, "end": 3, "camera": "k9"}]
        assert draft_of(page, "left_right") == stated
        page.page.wait_for_timeout(600)
        assert "k9" in page.page.locator("#status").inner_text()
        page.page.locator("li", has_text="k9").get_by_role("button", name="Remove").click()
        assert draft_of(page, "left_right") == stated[:1]


def test_a_question_whose_answer_was_not_given_is_asked_again(settings: Path) -> None:
    """ "I place it", then nothing is placed; and frames that are dropped back to an earlier one."""
    with served(settings) as server, open_page(server) as page:
        page.wait("window.annotate.questions.list.some((q) => q.kind === 'lost')")
        page.page.evaluate(
            "(({ list }) => window.annotate.questions.ask(list.find((q) => q.kind === 'lost')))"
            "(window.annotate.questions)"
        )
        page.page.keyboard.press("1")
        page.page.keyboard.press("Escape")
        page.page.locator("#tab-marks").click()
        page.page.evaluate("window.annotate.show(8)")
        page.page.get_by_role("button", name="Drop from this frame").click()
        page.page.evaluate("window.annotate.show(6)")
        page.page.get_by_role("button", name="Drop 8 to 6").click()
        assert draft_of(page, "drop_frames") == [6, 7, 8]
        save(page)
        page.wait(SAVED)
        page.wait("window.annotate.questions.list.some((q) => q.kind === 'lost')")
        assert not list(annotation(settings).parent.glob("*.answers.jsonl"))
