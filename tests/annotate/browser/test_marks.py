"""Subject, floor, dropped frames, left and right, and questions."""

from __future__ import annotations

from pathlib import Path

import yaml

from tests.annotate.browser.hand import Hand, open_page
from tests.annotate.served import NAME, annotation, detect, served
from tests.helpers.browser import needs_chromium

pytestmark = needs_chromium


def _ask(hand: Hand, question: str) -> None:
    """Wait for a question that fulfils a condition on ``q``, and open it."""
    hand.wait(f"window.annotate.questions.list.some((q) => {question})")
    hand.page.evaluate(
        "(({ questions }) => questions.ask(questions.list.find("
        f"(q) => {question})))(window.annotate)"
    )


def test_subject_floor_and_dropped_frames_are_clicked(settings: Path) -> None:
    with served(settings) as server, open_page(server) as hand:
        left, top, width, height = hand.box('[data-camera="k1"] canvas')
        hand.press("u")
        hand.page.mouse.click(left + 0.5 * width, top + 0.5 * height)
        [point] = hand.draft("subject")
        assert point["camera"] == "k1"
        assert abs(point["x"] - 239.5) < 2 and abs(point["y"] - 134.5) < 2
        hand.press("Escape", "g")
        for k, (x, y) in enumerate(((0.1, 0.9), (0.9, 0.9), (0.5, 0.1))):
            hand.page.mouse.click(left + x * width, top + y * height)
            hand.wait(f"(window.annotate.draft.get('floor') ?? []).length === {k + 1}")
        assert all(abs(z - 4.0) < 0.3 for _, _, z in hand.draft("floor"))  # wall of the capture
        hand.press("Escape", "End", "x")
        assert hand.draft("drop_frames") == [9]
        hand.save()
    saved = yaml.safe_load(annotation(settings).read_text())
    assert set(saved) == {"floor", "subject", "drop_frames"}


def test_left_and_right_are_shown_and_corrected(settings: Path) -> None:
    """k1 and k2 were detected with exchanged sides in frames 3 to 6."""
    detect(settings, {"k1": range(3, 7), "k2": range(3, 7)})
    annotation(settings).write_text("# kept\ndrop_frames: [9]\n")

    def differs(hand: Hand, frame: int) -> list[bool]:
        return hand.page.evaluate(
            f"[0, 1, 2].map((c) => window.annotate.sides.differs(c, {frame}))"
        )

    def left_wrist(hand: Hand) -> list[int]:
        """RGB next to the letter of the detected left wrist in the first large view."""
        return hand.page.evaluate(
            """() => { const a = window.annotate, view = a.views.views[0];
              const d = a.sides.data.arrays, k = 2 * ((a.frame * 3 + 0) * 14 + 2);
              const [x, y] = a.views.spot(view, d.detected[k], d.detected[k + 1]);
              const pixel = new OffscreenCanvas(1, 1).getContext("2d");
              pixel.drawImage(view.canvas, x - 6, y, 1, 1, 0, 0, 1, 1);
              return [...pixel.getImageData(0, 0, 1, 1).data].slice(0, 3); }"""
        )

    with served(settings) as server, open_page(server) as hand:
        hand.wait("window.annotate.questions.list.some((q) => q.kind === 'sides')")
        hand.press("l")
        hand.wait("window.annotate.sides.data !== null")
        assert differs(hand, 4) == [True, True, False] and not any(differs(hand, 2))
        assert hand.page.locator('[data-sides="k1"] canvas').count() == 1  # shaded on the timeline
        hand.page.locator('[data-camera="k1"] canvas').hover()
        hand.show(3)
        hand.wait("document.body.dataset.drawn === '3'")
        red, _, blue = left_wrist(hand)
        assert blue > 200 > red  # left
        hand.press("e")
        hand.show(5)
        hand.wait("document.querySelectorAll('.unfinished').length === 1")
        hand.press("e")
        stated = [{"start": 3, "end": 6, "camera": "k1"}]
        assert hand.draft("left_right") == stated
        assert [differs(hand, t)[0] for t in (3, 4, 5, 6)] == [False, False, False, True]
        hand.show(3)
        hand.wait("window.annotate.waits === false")
        red, _, blue = left_wrist(hand)
        assert red > 200 > blue  # right
        hand.press("Control+z")
        assert hand.draft("left_right") is None and differs(hand, 4)[0]
        hand.press("Control+Shift+z")
        x, y, width, _ = hand.box('[data-sides="k1"] .bar')
        hand.drag((x + width - 4, y + 8), (width / 3, 2))
        assert hand.draft("left_right") == [stated[0] | {"end": 7}] and not differs(hand, 6)[0]
        hand.page.locator('[data-sides="k1"] .bar').focus()
        hand.press("Delete")
        assert hand.draft("left_right") is None
        hand.show(8)
        hand.press("Shift+E")
        hand.page.locator("#tab-sides").click()
        hand.page.locator('button[data-sides="all"]').click()
        assert hand.draft("left_right") == [{"start": 8, "end": 9}]
        hand.press("Control+z", "q")
        _ask(hand, "q.kind === 'sides'")
        hand.press("3")  # exchanged in every view
        assert hand.draft("left_right") == [{"start": 3, "end": 7}]
        hand.press("Control+z")
        _ask(hand, "q.kind === 'sides'")
        hand.press("2")  # exchanged in the first view
        assert hand.draft("left_right") == [{"start": 3, "end": 7, "camera": "k1"}]
        hand.save()
        hand.wait("window.annotate.questions.pending.length === 0")
        assert not [q for q in server.json(f"sequences/{NAME}/questions") if q["kind"] == "sides"]
        # the images of a camera that slips are stated by their sets
        frames = hand.page.evaluate(
            """() => { const a = window.annotate, { sides, info } = a;
              info.image_of[1] = info.image_of[1].map((set) => set - 1);
              sides.change("k2", 7, 8, true);
              return sides.framesOf(sides.entries().find((entry) => entry.camera === "k2")); }"""
        )
        assert frames == [7, 9]
        assert {"start": 6, "end": 8, "camera": "k2"} in hand.draft("left_right")
        hand.press("Control+z")
    text = annotation(settings).read_text()
    assert text.startswith("# kept\n") and "left_right:\n  - {start: 3, end: 7, camera: k1}" in text


def test_an_answered_question_is_not_asked_again(settings: Path) -> None:
    seat = "q.id === 'contact.seat.4.7'"
    with served(settings) as server, open_page(server) as hand:
        _ask(hand, seat)
        hand.press("1")
        hand.wait(f"!window.annotate.questions.list.some((q) => {seat})")
        stated = {"part": "seat", "start": 4, "end": 8, "uncertain": "both"}
        assert stated in hand.draft("contact")
        hand.app("contact.add('seat', 6, 9)")  # the end is exact, the start stays uncertain
        assert stated | {"end": 9, "uncertain": "start"} in hand.draft("contact")
        hand.press("Control+z", "Control+z")  # the question of an undone edit is asked again
        _ask(hand, seat)
        hand.press("1")
        hand.save()
        hand.wait("window.annotate.questions.pending.length === 0")
        hand.reload()
        hand.wait("window.annotate.questions.list.length > 0")
        assert not hand.app(f"questions.list.some((q) => {seat})")


def test_left_right_edits_keep_entries_of_unknown_cameras(settings: Path) -> None:
    annotation(settings).write_text("left_right:\n  - {start: 1, end: 3, camera: k9}\n")
    with served(settings) as server, open_page(server) as hand:
        hand.page.locator('[data-camera="k1"] canvas').hover()
        hand.press("e", "e")
        stated = [{"start": 0, "end": 1, "camera": "k1"}, {"start": 1, "end": 3, "camera": "k9"}]
        assert hand.draft("left_right") == stated
        hand.wait("document.getElementById('status').textContent.includes('k9')")
        hand.page.locator("li", has_text="k9").get_by_role("button", name="Remove").click()
        assert hand.draft("left_right") == stated[:1]


def test_a_question_without_an_edit_is_asked_again(settings: Path) -> None:
    """Answer "I place it" without a pose; also drop a range of frames backwards."""
    with served(settings) as server, open_page(server) as hand:
        _ask(hand, "q.kind === 'lost'")
        hand.press("1", "Escape")
        hand.page.locator("#tab-marks").click()
        hand.show(8)
        hand.click("Drop from this frame")
        hand.show(6)
        hand.click("Drop 8 to 6")
        assert hand.draft("drop_frames") == [6, 7, 8]
        hand.save()
        hand.wait("window.annotate.questions.list.some((q) => q.kind === 'lost')")
        assert not list(annotation(settings).parent.glob("*.answers.jsonl"))
