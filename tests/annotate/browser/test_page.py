"""The page as a whole: results that lack or change, a run, a tunnel, its time, its access."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from intercap_core.annotate import rerun
from tests.annotate.browser.hand import SAVED, SIZE, draft_of, open_page, save
from tests.annotate.served import TOKEN, annotation, artefact, served
from tests.helpers.browser import needs_chromium, serious_faults, visit

pytestmark = needs_chromium
STEP_MS = 100.0  # from the key to all views drawn
# Of a machine that draws without a GPU and shares its cores the tests ask less than of a desk.
PATIENCE = 4.0


def test_results_that_cannot_be_loaded_are_named_and_edits_stay(settings: Path) -> None:
    frames, joint = artefact(settings, "frames"), artefact(settings, "joint")
    with served(settings) as server, open_page(server) as page:
        page.page.keyboard.press("x")
        whole = frames.read_bytes()
        for damage in (lambda: frames.write_bytes(whole[:2000]), frames.unlink):
            damage()
            page.page.evaluate("window.annotate.reload()")
            page.wait(
                "document.querySelector('[data-banner=result]')?.textContent.includes('edits')"
            )
            assert draft_of(page, "drop_frames") == [0]
            assert "frames" in page.page.locator("[data-banner=result]").inner_text()
            page.page.keyboard.press("ArrowRight")
            page.page.keyboard.press("ArrowLeft")
        frames.write_bytes(whole)
        joint.write_bytes(joint.read_bytes()[:2000])
        page.page.locator("[data-banner=result]").get_by_text("Try again").click()
        page.wait("document.getElementById('banners').textContent.includes('joint.h5')")
        page.wait("window.annotate.told.frames === 10")
        assert draft_of(page, "drop_frames") == [0]


def test_what_a_cut_tunnel_leaves_open_is_asked_for_again(settings: Path) -> None:
    with served(settings) as server, open_page(server) as page:
        keys, context = page.page.keyboard, page.page.context
        page.wait("document.body.dataset.drawn === '0'")
        context.set_offline(True)
        keys.press("x")
        keys.press("End")
        page.wait("document.getElementById('status').textContent.includes('tunnel')")
        page.wait("window.annotate.pictures.waiting.size === 0")
        keys.press("Control+s")
        page.wait("!document.getElementById('hint').hidden")
        assert page.page.evaluate("document.body.dataset.drawn") == "0"
        page.page.evaluate("window.annotate.keep.look()")
        page.wait("document.querySelector('[data-banner=server]') !== null")
        context.set_offline(False)
        page.page.evaluate("window.annotate.keep.look()")
        page.wait("document.body.dataset.drawn === '9'")
        page.wait("document.getElementById('status').textContent.startsWith('not saved')")
        save(page)
        page.wait(SAVED)
    assert annotation(settings).read_text() == "drop_frames: [0]\n"


def test_a_run_that_is_told_to_end_is_shown_to_be_ending(
    settings: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = (
        "import signal, sys, time; signal.signal(15, lambda *_: None); time.sleep(4); sys.exit(1)"
    )
    real = rerun.subprocess.Popen

    def start(command: list[str], **options: Any) -> Any:
        return real([sys.executable, "-c", script], **options)

    with served(settings) as server, open_page(server) as page:
        monkeypatch.setattr(rerun.subprocess, "Popen", start)
        page.page.locator("#tab-run").click()
        page.page.get_by_text("Run what is out of date").click()
        page.wait("window.annotate.keep.run.state === 'running'")
        page.page.wait_for_timeout(700)  # until the process minds signals
        page.page.get_by_role("button", name="Stop").click()
        page.wait("document.getElementById('panels').textContent.includes('Ending…')")
        assert page.page.get_by_role("button", name="Stop").count() == 0
        page.wait("window.annotate.keep.run.state === 'stopped'")
        page.wait("document.getElementById('panels').textContent.includes('was stopped')")


def test_images_alone_are_shown_and_can_be_annotated(settings: Path) -> None:
    for path in artefact(settings, "joint").parent.glob("*.h5"):
        if path.stem != "frames":
            path.unlink()
    with served(settings) as server, open_page(server) as page:
        assert "only images" in page.page.locator("#banners").inner_text()
        page.page.keyboard.press("ArrowRight")
        page.wait("document.body.dataset.drawn === '1'")
        page.page.keyboard.press("x")
        assert draft_of(page, "drop_frames") == [1]


def test_before_the_first_run_it_says_what_to_do(settings: Path) -> None:
    artefact(settings, "frames").unlink()
    with served(settings) as server, open_page(server) as page:
        assert "intercap run" in page.page.locator("#banners").inner_text()
        page.page.locator("#tab-run").click()
        assert page.page.get_by_text("Run what is out of date").is_visible()
        page.page.keyboard.press("x")
        page.page.evaluate("window.annotate.keep.look()")
        assert page.page.locator('[data-banner="result"]').count() == 0
        annotation(settings).write_text("drop_frames: [\n")
        page.page.evaluate("window.annotate.keep.look()")
        page.page.get_by_text("Show", exact=True).click()
        page.wait("document.getElementById('dialog').open")
        shown = page.page.locator("#dialog").inner_text()
        assert "broken" in shown and "line 2" in shown
        assert page.page.locator("#dialog-buttons button").all_inner_texts() == ["Back"]
        page.page.keyboard.press("Escape")
        assert draft_of(page, "drop_frames") == [0]


def test_a_page_without_the_token_shows_nothing(settings: Path) -> None:
    with served(settings) as server, visit(server.address, size=SIZE) as page:
        page.wait("!document.getElementById('stopped').hidden")
        assert "token" in page.page.locator("#stopped").inner_text()


@pytest.mark.parametrize("dark", [False, True])
def test_it_can_be_used_with_assistive_technology(settings: Path, dark: bool) -> None:
    with served(settings) as server:
        with visit(f"{server.address}/#token={TOKEN}", size=SIZE, dark=dark) as page:
            page.wait("document.querySelectorAll('#sequences a').length === 1")
            assert serious_faults(page) == []
        with open_page(server, dark=dark) as page:
            for tab in ("doubts", "questions", "object", "marks", "sides", "run"):
                page.page.locator(f"#tab-{tab}").click()
                assert serious_faults(page) == []


def test_a_step_is_drawn_in_all_views_in_time(settings: Path) -> None:
    from bench.annotate_page import WATCH, steps_ms

    with served(settings) as server, open_page(server) as page:
        page.page.evaluate(WATCH)
        found = steps_ms(page.page, 9)
    assert float(np.median(found[:, 0])) < PATIENCE * STEP_MS, found


def test_keys_work_wherever_the_focus_is(settings: Path) -> None:
    with served(settings) as server, open_page(server) as page:
        keys = page.page.keyboard
        page.page.locator('[data-layer="body"]').focus()
        keys.press("Space")
        layer = page.page.evaluate("window.annotate.layers.body")
        assert not layer and not page.page.evaluate("window.annotate.playing")
        page.page.locator("#tab-marks").click()
        page.page.get_by_role("button", name="Drop frame 0").focus()
        keys.press("Enter")
        focus = "document.activeElement.textContent"
        assert page.page.evaluate(focus) == "Keep frame 0"
        page.page.locator('[data-camera="k1"] canvas').hover()
        keys.press("e")
        keys.press("Control+s")
        page.wait("document.getElementById('dialog').open")
        assert (
            "not ended, so not in it: left and right" in page.page.locator("#dialog").inner_text()
        )
        keys.press("Escape")
        page.page.locator(".viewer").focus()
        keys.press("o")
        assert page.page.evaluate("document.body.dataset.mode") == "PoseEditor"
        keys.press("b")
        page.wait("document.getElementById('hint').textContent.startsWith('no run')")
        assert not page.page.evaluate("window.annotate.layers.before")
