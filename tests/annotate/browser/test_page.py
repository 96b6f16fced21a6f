"""The page as a whole: missing and changed results, runs, connection, speed, access."""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest

from intercap_core.annotate import rerun
from tests.annotate.browser.hand import SIZE, open_page
from tests.annotate.served import TOKEN, annotation, artefact, served
from tests.helpers.browser import needs_chromium, serious_faults, visit

pytestmark = needs_chromium
STEP_MS = 100.0  # from the key to all views drawn
PATIENCE = 4.0  # factor for a machine that draws without a GPU


def test_unreadable_results_are_reported_and_edits_stay(settings: Path) -> None:
    frames, joint = artefact(settings, "frames"), artefact(settings, "joint")
    banner = "[data-banner=result]"
    with served(settings) as server, open_page(server) as hand:
        hand.press("x")
        content = frames.read_bytes()
        for damage in (lambda: frames.write_bytes(content[:2000]), frames.unlink):
            damage()
            hand.app("reload()")
            hand.wait(f"document.querySelector('{banner}')?.textContent.includes('edits')")
            assert hand.draft("drop_frames") == [0] and "frames" in hand.text(banner)
            hand.press("ArrowRight", "ArrowLeft")
        frames.write_bytes(content)
        joint.write_bytes(joint.read_bytes()[:2000])
        hand.click("Try again")
        hand.wait("document.getElementById('banners').textContent.includes('joint.h5')")
        hand.wait("window.annotate.info.frames === 10")
        assert hand.draft("drop_frames") == [0]


def test_requests_are_repeated_after_a_lost_connection(settings: Path) -> None:
    with served(settings) as server, open_page(server) as hand:
        hand.wait("document.body.dataset.drawn === '0'")
        hand.page.context.set_offline(True)
        hand.press("x", "End")
        hand.wait("document.getElementById('status').textContent.includes('tunnel')")
        hand.wait("window.annotate.pictures.waiting.size === 0")
        hand.press("Control+s")
        hand.wait("!document.getElementById('hint').hidden")
        assert hand.page.evaluate("document.body.dataset.drawn") == "0"
        hand.app("saving.poll()")
        hand.wait("document.querySelector('[data-banner=server]') !== null")
        hand.page.context.set_offline(False)
        hand.app("saving.poll()")
        hand.wait("document.body.dataset.drawn === '9'")
        hand.wait("document.getElementById('status').textContent.startsWith('not saved')")
        hand.save()
    assert annotation(settings).read_text() == "drop_frames: [0]\n"


def test_a_stopped_run_is_shown_as_ending(settings: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    script = "import signal, time; signal.signal(15, lambda *_: None); time.sleep(4); exit(1)"
    real = rerun.subprocess.Popen

    def start(command: list[str], **options: Any) -> Any:
        return real([sys.executable, "-c", script], **options)

    with served(settings) as server, open_page(server) as hand:
        monkeypatch.setattr(rerun.subprocess, "Popen", start)
        hand.page.locator("#tab-run").click()
        hand.click("Recompute outdated stages")
        hand.wait("window.annotate.saving.run.state === 'running'")
        assert "remaining time unknown" in hand.text("#panels")
        hand.page.wait_for_timeout(700)  # until the process handles signals
        hand.click("Stop")
        hand.wait("document.getElementById('panels').textContent.includes('Ending for')")
        assert hand.page.get_by_role("button", name="Stop").count() == 0
        hand.wait("window.annotate.saving.run.state === 'stopped'")
        hand.wait("document.getElementById('panels').textContent.includes('was stopped')")


def test_images_alone_are_shown_and_can_be_annotated(settings: Path) -> None:
    for path in artefact(settings, "joint").parent.glob("*.h5"):
        if path.stem != "frames":
            path.unlink()
    with served(settings) as server, open_page(server) as hand:
        assert "only images" in hand.text("#banners")
        hand.press("ArrowRight")
        hand.wait("document.body.dataset.drawn === '1'")
        hand.press("x")
        assert hand.draft("drop_frames") == [1]


def test_before_the_first_run_the_page_names_the_command(settings: Path) -> None:
    artefact(settings, "frames").unlink()
    with served(settings) as server, open_page(server) as hand:
        assert "intercap run" in hand.text("#banners")
        hand.page.locator("#tab-run").click()
        assert hand.page.get_by_text("Recompute outdated stages").is_visible()
        hand.press("x")
        hand.app("saving.poll()")
        assert hand.page.locator('[data-banner="result"]').count() == 0
        annotation(settings).write_text("drop_frames: [\n")
        hand.app("saving.poll()")
        hand.page.get_by_text("Show", exact=True).click()
        hand.wait("document.getElementById('dialog').open")
        assert "invalid" in hand.text("#dialog") and "line 2" in hand.text("#dialog")
        assert hand.page.locator("#dialog-buttons button").all_inner_texts() == ["Back"]
        hand.press("Escape")
        assert hand.draft("drop_frames") == [0]


def test_a_page_without_the_token_shows_nothing(settings: Path) -> None:
    with served(settings) as server, visit(server.address, size=SIZE) as page:
        page.wait("!document.getElementById('stopped').hidden")
        assert "full address" in page.page.locator("#stopped").inner_text()


@pytest.mark.parametrize("dark", [False, True])
def test_it_can_be_used_with_assistive_technology(settings: Path, dark: bool) -> None:
    with served(settings) as server:
        with visit(f"{server.address}/#token={TOKEN}", size=SIZE, dark=dark) as page:
            page.wait("document.querySelectorAll('#sequences a').length === 1")
            assert serious_faults(page) == []
        with open_page(server, dark=dark) as hand:
            for tab in ("doubts", "questions", "object", "marks", "sides", "run"):
                hand.page.locator(f"#tab-{tab}").click()
                assert serious_faults(hand.visit) == []


def _cpu_seconds() -> float:
    """Processor time so far of the browser and of the server's threads: independent of load."""
    process, total = psutil.Process(), 0.0
    for child in process.children(recursive=True):
        if "chrom" in child.name():
            times = child.cpu_times()
            total += times.user + times.system
    own = [t for t in process.threads() if t.id != os.getpid()]  # without this one, which polls
    return total + sum(t.user_time + t.system_time for t in own)


def test_a_step_is_drawn_in_all_views_in_time(settings: Path) -> None:
    from bench.annotate_page import WATCH, steps_ms

    with served(settings) as server, open_page(server) as hand:
        assert hand.page.evaluate(  # all views are visible, and the largest that are
            """() => { const views = document.getElementById("views");
              return views.scrollHeight === views.clientHeight
                && document.getElementById("strip").lastChild.getBoundingClientRect().bottom
                  > views.getBoundingClientRect().bottom - 150; }"""
        )
        hand.wait("window.annotate.space.viewer !== null")
        hand.page.evaluate("window.annotate.space.follow = () => {}")  # the views alone
        hand.page.evaluate(WATCH)
        before = _cpu_seconds()
        steps = len(steps_ms(hand.page, 9))
        # the page and the graphics process work at the same time
        assert 1000 * (_cpu_seconds() - before) / steps < 2 * PATIENCE * STEP_MS


def test_keys_work_wherever_the_focus_is(settings: Path) -> None:
    with served(settings) as server, open_page(server) as hand:
        hand.page.locator('[data-layer="body"]').focus()
        hand.press("Space")
        assert not hand.app("layers.body") and not hand.app("playing")
        hand.page.evaluate(
            "Object.assign(annotate.info, { places: [], track: { doubts: 'a doubtful mesh' } })"
        )
        hand.app("panels()")
        assert hand.text("#panels").endswith("a doubtful mesh")  # not also "No frame is flagged"
        hand.page.locator("#tab-marks").click()
        hand.page.get_by_role("button", name="Drop frame 0").focus()
        hand.press("Enter")
        assert hand.page.evaluate("document.activeElement.textContent") == "Keep frame 0"
        hand.page.locator('[data-camera="k1"] canvas').hover()
        hand.press("e")
        assert "last frame is not set: left and right" in hand.open_save()
        hand.press("Escape")
        hand.page.locator(".viewer").focus()
        hand.press("o")
        assert hand.page.evaluate("document.body.dataset.mode") == "PoseEditor"
        hand.press("b")
        hand.wait("document.getElementById('hint').textContent.startsWith('no run')")
        assert not hand.app("layers.before")
