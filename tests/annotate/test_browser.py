"""The page in a real browser, used as a person would: keys, drags, clicks, a save, a conflict."""

from __future__ import annotations

import json
import shutil
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from intercap_core.annotate import rerun
from tests.annotate.served import (
    NAME,
    TOKEN,
    Served,
    annotation,
    artefact,
    copied,
    detect,
    served,
    small_project,
)
from tests.helpers.browser import Visit, needs_chromium, serious_faults, visit

pytestmark = needs_chromium
SIZE = (1440, 900)
READY = "document.body.dataset.ready === 'yes'"
HAND = '[data-part="right_hand"] .bar'
_ASK_SEAT = (
    "(({ list }) => window.annotate.questions.ask(list.find((q) => q.part === 'seat')))"
    "(window.annotate.questions)"
)
STEP_MS = 100.0  # from the key to all views drawn
# Of a machine that draws without a GPU and shares its cores the tests ask less than of a desk.
PATIENCE = 4.0


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    settings = small_project(tmp_path_factory.mktemp("browsed"), total=10)
    with h5py.File(artefact(settings, "joint"), "r+") as file:
        names = [name.decode() for name in file["region_names"][:]]
        file["contact_probability"][...] = 0.02
        file["contact_probability"][2:8, names.index("right_hand")] = 0.9
        file["contact_probability"][4:8, names.index("seat")] = 0.45
        file["contact_annotated"][...] = -1
    return settings


@pytest.fixture
def settings(made: Path, tmp_path: Path) -> Path:
    return copied(made, tmp_path / "project")


@contextmanager
def _open(page: Served, **options: Any) -> Iterator[Visit]:
    address = f"{page.address}/sequence/{NAME}#token={TOKEN}"
    with visit(address, size=SIZE, **options) as found:
        found.wait(READY)
        yield found
        assert not [line for line in found.console if "Failed to load" not in line], found.console


def _draft(page: Visit, section: str) -> Any:
    return page.page.evaluate(f"window.annotate.draft.get({section!r})")


def _drag(page: Visit, start: tuple[float, float], by: tuple[float, float]) -> None:
    mouse = page.page.mouse
    mouse.move(*start)
    mouse.down()
    mouse.move(start[0] + by[0], start[1] + by[1], steps=6)
    mouse.up()


def _middle_of_the_object(page: Visit) -> tuple[float, float]:
    """Where the object's middle is in the first large view, pixels of the window."""
    box = page.page.locator("#big canvas").first.bounding_box()
    assert box is not None
    x, y, wide = page.page.evaluate(
        """() => { const a = window.annotate, view = a.views.views[0];
          return [...a.views.place(view, a.pose.middle()), view.width]; }"""
    )
    scale = box["width"] / wide
    return box["x"] + x * scale, box["y"] + y * scale


def _save(page: Visit, answer: str = "save") -> None:
    page.page.keyboard.press("Control+s")
    page.wait("document.getElementById('dialog').open")
    page.page.locator(f'[data-answer="{answer}"]').click()


def test_contact_is_dragged_split_denied_and_saved_with_its_difference(settings: Path) -> None:
    annotation(settings).write_text("# kept\ndrop_frames: [9]\n")
    with served(settings) as server, _open(server) as page:
        keys = page.page.keyboard
        box = page.page.locator(HAND).bounding_box()
        assert box is not None
        frame = box["width"] / 6
        _drag(page, (box["x"] + box["width"] - 4, box["y"] + 10), (-2 * frame, 3))
        assert _draft(page, "contact") == [{"part": "right_hand", "start": 2, "end": 6}]
        keys.press("Control+z")
        assert _draft(page, "contact") is None
        keys.press("Control+Shift+z")
        page.page.locator(HAND).focus()
        page.page.evaluate("window.annotate.show(4)")
        keys.press("k")
        assert [one["start"] for one in _draft(page, "contact")] == [2, 4]
        keys.press("Delete")
        assert _draft(page, "contact") == [{"part": "right_hand", "start": 2, "end": 4}]
        keys.press("Control+s")
        page.wait("document.getElementById('dialog').open")
        shown = page.page.locator("#dialog").inner_text()
        assert "+  - {part: right_hand, start: 2, end: 4}" in shown
        page.page.locator('[data-answer="save"]').click()
        page.wait("document.getElementById('status').textContent === 'saved'")
        text = annotation(settings).read_text()
        assert text.startswith("# kept\ndrop_frames: [9]\n") and "start: 2, end: 4" in text


def test_the_object_is_moved_in_a_view_where_the_pointer_goes(settings: Path) -> None:
    with served(settings) as server, _open(server) as page:
        keys = page.page.keyboard
        keys.press("o")
        box = page.page.locator("#big canvas").first.bounding_box()
        assert box is not None
        told = page.page.evaluate(
            """() => { const a = window.annotate, view = a.views.views[0];
              return { pose: a.pose.pose, focal: view.camera.lens[0],
                       size: view.camera.size[0] }; }"""
        )
        start = _middle_of_the_object(page)
        _drag(page, start, (40, -20))
        [pose] = _draft(page, "object_poses")
        depth = told["pose"][2][3]
        metres = depth / told["focal"] * told["size"] / box["width"]
        moved = np.array(pose["translation"]) - np.array(told["pose"])[:, 3]
        assert np.allclose(moved, [40 * metres, -20 * metres, 0], atol=0.1 * 40 * metres)
        keys.down("Shift")
        _drag(page, start, (50, 0))
        keys.up("Shift")
        turned = Rotation.from_rotvec(_draft(page, "object_poses")[0]["rotation_vector"])
        assert 0.3 < turned.magnitude() < 0.5  # about the vertical of the view, 0.008 rad a pixel
        keys.press("Escape")
        _save(page)
        page.wait("document.getElementById('status').textContent === 'saved'")
    told = yaml.safe_load(annotation(settings).read_text())
    assert [one["frame"] for one in told["object_poses"]] == [0]


def test_the_object_is_placed_in_several_frames_and_a_single_pose_joins_them(
    settings: Path,
) -> None:
    single = (
        "object_pose: {frame: 4, rotation_vector: [0, 0, 0], translation: [0, 0, 2], sigma_m: 0.02}"
    )
    annotation(settings).write_text(f"# kept\n{single}\n")

    def frames(page: Visit) -> list[int]:
        return [one["frame"] for one in _draft(page, "object_poses") or ()]

    with served(settings) as server, _open(server) as page:
        keys = page.page.keyboard
        assert page.page.locator(".mark.posed").count() == 1
        for frame in (0, 6):
            page.page.evaluate(f"window.annotate.show({frame})")
            keys.press("o")
            middle = _middle_of_the_object(page)
            _drag(page, middle, (25, 5))
            keys.press("Escape")
        assert frames(page) == [0, 4, 6] and _draft(page, "object_pose") is None
        assert _draft(page, "object_poses")[1]["sigma_m"] == 0.02
        assert page.page.locator(".mark.posed").count() == 3
        keys.press("Control+z")
        keys.press("Control+z")
        assert frames(page) == [] and _draft(page, "object_pose")["frame"] == 4
        keys.press("Control+Shift+z")
        keys.press("Control+Shift+z")
        page.page.locator("#tab-object").click()
        page.page.get_by_role("button", name="Remove the pose").click()  # of frame 6, the shown one
        assert frames(page) == [0, 4]
        _save(page)
        page.wait("document.getElementById('status').textContent === 'saved'")
    text = annotation(settings).read_text()
    told = yaml.safe_load(text)
    assert text.startswith("# kept\n") and set(told) == {"object_poses"}
    assert [one["frame"] for one in told["object_poses"]] == [0, 4]


def test_subject_floor_and_dropped_frames_are_clicked(settings: Path) -> None:
    with served(settings) as server, _open(server) as page:
        keys, view = page.page.keyboard, page.page.locator('[data-camera="k1"] canvas')
        box = view.bounding_box()
        assert box is not None
        keys.press("u")
        page.page.mouse.click(box["x"] + 0.5 * box["width"], box["y"] + 0.5 * box["height"])
        [point] = _draft(page, "subject")
        assert (
            point["camera"] == "k1" and abs(point["x"] - 239.5) < 2 and abs(point["y"] - 134.5) < 2
        )
        keys.press("Escape")
        keys.press("g")
        for k, (x, y) in enumerate(((0.1, 0.9), (0.9, 0.9), (0.5, 0.1))):
            page.page.mouse.click(box["x"] + x * box["width"], box["y"] + y * box["height"])
            page.wait(f"(window.annotate.draft.get('floor') ?? []).length === {k + 1}")
        assert all(
            abs(z - 4.0) < 0.3 for _, _, z in _draft(page, "floor")
        )  # the wall of the capture
        keys.press("Escape")
        keys.press("End")
        keys.press("x")
        assert _draft(page, "drop_frames") == [9]
        _save(page)
        page.wait("document.getElementById('status').textContent === 'saved'")
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

    with served(settings) as server, _open(server) as page:
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
        assert _draft(page, "left_right") == stated
        assert [against(page, t)[0] for t in (3, 4, 5, 6)] == [False, False, False, True]
        page.page.evaluate("window.annotate.show(3)")
        page.wait("window.annotate.waits === false")
        named_left = colour(page, 0)
        assert named_left[0] > 200 > named_left[2]  # orange
        keys.press("Control+z")
        assert _draft(page, "left_right") is None and against(page, 4)[0]
        keys.press("Control+Shift+z")
        bar = page.page.locator('[data-sides="k1"] .bar')
        box = bar.bounding_box()
        assert box is not None
        _drag(page, (box["x"] + box["width"] - 4, box["y"] + 8), (box["width"] / 3, 2))
        stated[0]["end"] = 7
        assert _draft(page, "left_right") == stated and not any(against(page, 6)[:1])
        bar.focus()
        keys.press("Delete")
        assert _draft(page, "left_right") is None
        page.page.evaluate("window.annotate.show(8)")
        keys.press("Shift+E")
        page.page.locator("#tab-sides").click()
        page.page.locator('button[data-sides="all"]').click()
        assert _draft(page, "left_right") == [{"start": 8, "end": 9}]
        keys.press("Control+z")
        keys.press("q")
        page.page.evaluate(
            "(({ list }) => window.annotate.questions.ask(list.find((q) => q.kind === 'sides')))"
            "(window.annotate.questions)"
        )
        keys.press("3")  # in every view
        assert _draft(page, "left_right") == [{"start": 3, "end": 7}]
        keys.press("Control+z")
        page.wait("window.annotate.questions.list.some((q) => q.kind === 'sides')")
        page.page.evaluate(
            "(({ list }) => window.annotate.questions.ask(list.find((q) => q.kind === 'sides')))"
            "(window.annotate.questions)"
        )
        keys.press("2")  # in the view that is shown first
        assert _draft(page, "left_right") == [{"start": 3, "end": 7, "camera": "k1"}]
        _save(page)
        page.wait("document.getElementById('status').textContent === 'saved'")
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
        assert {"start": 6, "end": 8, "camera": "k2"} in _draft(page, "left_right")
        page.page.keyboard.press("Control+z")
    text = annotation(settings).read_text()
    assert text.startswith("# kept\n") and "left_right:\n  - {start: 3, end: 7, camera: k1}" in text


def test_results_that_cannot_be_loaded_are_named_and_edits_stay(settings: Path) -> None:
    frames, joint = artefact(settings, "frames"), artefact(settings, "joint")
    with served(settings) as server, _open(server) as page:
        page.page.keyboard.press("x")
        whole = frames.read_bytes()
        for damage in (lambda: frames.write_bytes(whole[:2000]), frames.unlink):
            damage()
            page.page.evaluate("window.annotate.reload()")
            page.wait(
                "document.querySelector('[data-banner=result]')?.textContent.includes('edits')"
            )
            assert _draft(page, "drop_frames") == [0]
            assert "frames" in page.page.locator("[data-banner=result]").inner_text()
            page.page.keyboard.press("ArrowRight")
            page.page.keyboard.press("ArrowLeft")
        frames.write_bytes(whole)
        joint.write_bytes(joint.read_bytes()[:2000])
        page.page.locator("[data-banner=result]").get_by_text("Try again").click()
        page.wait("document.getElementById('banners').textContent.includes('joint.h5')")
        page.wait("window.annotate.told.frames === 10")
        assert _draft(page, "drop_frames") == [0]


def test_what_a_cut_tunnel_leaves_open_is_asked_for_again(settings: Path) -> None:
    with served(settings) as server, _open(server) as page:
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
        _save(page)
        page.wait("document.getElementById('status').textContent === 'saved'")
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

    with served(settings) as server, _open(server) as page:
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


def test_where_people_touch_is_painted_and_kept_with_the_object(settings: Path) -> None:
    mesh = Path(yaml.safe_load((settings.parent / "objects.yaml").read_text())["football"]["mesh"])
    own = settings.parent / mesh.name
    shutil.copy(mesh, own)
    (settings.parent / "objects.yaml").write_text(f"football:\n  mesh: {own.name}\n")
    with served(settings) as server, _open(server) as page:
        page.page.locator("#tab-object").click()
        page.page.get_by_text("Paint its contact surface").click()
        page.wait("document.body.dataset.mode === 'Paint'")
        box = page.page.locator("#big canvas").first.bounding_box()
        assert box is not None
        middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        _drag(page, middle, (30, 0))
        assert page.page.evaluate("window.annotate.paint.painted.size") > 0
        page.page.keyboard.press("Control+z")
        assert page.page.evaluate("window.annotate.paint.painted.size") == 0
        _drag(page, middle, (-20, 10))
        painted = page.page.evaluate("[...window.annotate.paint.painted]")
        page.page.get_by_text("Save the surface").click()
        page.page.locator('[data-answer="save"]').click()
        page.wait("!window.annotate.paint.changed")
    written = json.loads(own.with_suffix(".contact.json").read_text())
    assert len(written["contact_vertices"]) >= len(painted) > 0
    assert (
        f"contact_vertices: {own.stem}.contact.json"
        in (settings.parent / "objects.yaml").read_text()
    )


def test_a_question_is_answered_by_a_key_and_never_asked_again(settings: Path) -> None:
    with served(settings) as server, _open(server) as page:
        page.wait("window.annotate.questions.list.length > 0")
        asked = page.page.evaluate("window.annotate.questions.list.map((q) => q.id)")
        assert "contact.seat.4.7" in asked
        page.page.evaluate(_ASK_SEAT)
        page.page.keyboard.press("1")
        page.wait("!window.annotate.questions.list.some((q) => q.part === 'seat')")
        assert {"part": "seat", "start": 4, "end": 8} in _draft(page, "contact")
        page.page.keyboard.press("Control+z")  # an edit that is undone is asked again
        page.wait("window.annotate.questions.list.some((q) => q.part === 'seat')")
        page.page.evaluate(_ASK_SEAT)
        page.page.keyboard.press("1")
        _save(page)
        page.wait("document.getElementById('status').textContent === 'saved'")
        page.wait("window.annotate.questions.pending.length === 0")
        page.page.reload()
        page.wait(READY)
        page.wait("window.annotate.questions.list.length > 0")
        asked = page.page.evaluate("window.annotate.questions.list.map((q) => q.id)")
        assert "contact.seat.4.7" not in asked


def test_two_annotators_keep_both_changes(settings: Path) -> None:
    path = annotation(settings)
    path.write_text("# two people\ndrop_frames: [9]\n")
    with served(settings) as server, _open(server) as page:
        page.page.locator(HAND).focus()
        page.page.keyboard.press("c")
        path.write_text("# two people\ndrop_frames: [8, 9]\n")
        _save(page)
        page.wait("document.getElementById('dialog-title').textContent.startsWith('Somebody')")
        assert "[8, 9]" in page.page.locator("#dialog").inner_text()
        page.page.locator('[data-answer="mine"]').click()
        page.wait("document.getElementById('dialog-title').textContent.startsWith('Save')")
        page.page.locator('[data-answer="save"]').click()
        page.wait("document.getElementById('status').textContent === 'saved'")
    text = path.read_text()
    assert (
        "drop_frames: [8, 9]" in text and "right_hand" in text and text.startswith("# two people")
    )


def test_edits_of_a_tab_that_went_away_are_found_again(settings: Path) -> None:
    with served(settings) as server, _open(server) as page:
        page.page.keyboard.press("x")
        assert _draft(page, "drop_frames") == [0]
        page.page.on("dialog", lambda dialog: dialog.accept())
        page.page.reload()
        page.wait(READY)
        assert _draft(page, "drop_frames") is None
        page.page.keyboard.press("u")  # the older edits are not written over by new ones
        page.page.evaluate("window.annotate.draft.set('subject', [{camera: 'k1', x: 9, y: 9}])")
        page.page.get_by_text("Take them up again").click()
        assert _draft(page, "drop_frames") == [0] and _draft(page, "subject") is not None


def test_edits_of_several_tabs_meet_what_was_saved_meanwhile(settings: Path) -> None:
    path = annotation(settings)
    path.write_text("# two people\ndrop_frames: [9]\n")
    with served(settings) as server, _open(server) as page:
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
        page.page.locator('[data-answer="mine"]').click()
        page.wait("document.getElementById('dialog-title').textContent.startsWith('Save')")
        page.page.locator('[data-answer="save"]').click()
        page.wait("document.getElementById('status').textContent === 'saved'")
        assert path.read_text() == "# two people\ndrop_frames: [8, 9]\n\ncontact: []\n"
        page.wait("document.querySelector('[data-banner=\"left\"]') !== null")
        assert "drop frames" in offered.inner_text()
        page.page.get_by_text("Take them up again").click()
        page.wait("document.getElementById('dialog').open")
        shown = page.page.locator("#dialog").inner_text()
        assert "Both of you changed drop frames" in shown and "+drop_frames: [8, 9]" in shown
        page.page.locator('[data-answer="theirs"]').click()
        page.wait("document.getElementById('status').textContent === 'saved'")
        assert _draft(page, "drop_frames") == [8, 9] and _draft(page, "contact") == []
        assert page.page.evaluate("Object.keys(localStorage)") == [
            f"intercap-draft:other:{NAME}:tab"
        ]


def test_that_nothing_touches_is_stated_and_taken_back(settings: Path) -> None:
    path = annotation(settings)
    with served(settings) as server, _open(server) as page:
        bar, keys = page.page.locator("#contact-bar"), page.page.keyboard
        page.page.locator(HAND).focus()
        keys.press("Delete")  # the last interval: nothing touches any more
        assert _draft(page, "contact") == [] and "nothing touches, as annotated" in bar.inner_text()
        page.page.get_by_role("button", name="As found again").click()
        assert _draft(page, "contact") is None and page.page.locator(HAND).count() == 1
        keys.press("Control+z")
        assert _draft(page, "contact") == []
        keys.press("Control+s")
        page.wait("document.getElementById('dialog').open")
        page.wait("document.querySelector('[data-part=touches]').textContent.includes('joint')")
        assert "+contact: []" in page.page.locator("#dialog").inner_text()
        page.page.locator('[data-answer="save"]').click()
        page.wait("document.getElementById('status').textContent === 'saved'")
        assert path.read_text() == "contact: []\n"
        page.page.reload()
        page.wait(READY)
        assert _draft(page, "contact") == [] and "nothing touches, as annotated" in bar.inner_text()
        page.page.get_by_role("button", name="As found again").click()
        _save(page)
        page.wait("document.getElementById('status').textContent === 'no annotation yet'")
        page.page.get_by_role("button", name="Nothing touches").click()
        assert _draft(page, "contact") == [] and path.read_text().strip() == ""


def test_a_number_that_is_typed_counts_before_a_key_of_the_page(settings: Path) -> None:
    with served(settings) as server, _open(server) as page:
        keys = page.page.keyboard
        keys.press("o")
        field = page.page.locator(".numbers input").first
        field.focus()
        keys.press("Control+a")
        keys.type("0.125")
        keys.press("Control+s")
        page.wait("document.getElementById('dialog').open")
        assert "0.125" in page.page.locator("#dialog").inner_text()
        keys.press("Escape")
        page.wait("!document.getElementById('dialog').open")
        field.focus()
        keys.press("Control+a")
        keys.type("0.25")
        keys.press("Control+z")  # what is typed is a step of its own
        assert _draft(page, "object_poses")[0]["translation"][0] == 0.125
        assert field.input_value() == "0.1250" and field.evaluate(
            "(e) => e === document.activeElement"
        )
        keys.press("Control+Shift+z")
        assert _draft(page, "object_poses")[0]["translation"][0] == 0.25
        keys.press("Control+a")
        keys.press("Delete")
        keys.press("Tab")  # no number: as it was
        assert _draft(page, "object_poses")[0]["translation"][0] == 0.25
        page.page.mouse.move(*_middle_of_the_object(page))
        page.page.mouse.wheel(0, 100)
        page.wait("window.annotate.pose.late")
        page.page.evaluate("window.annotate.show(1)")  # before the wheel's step was taken
        page.page.wait_for_timeout(300)
        assert [one["frame"] for one in _draft(page, "object_poses")] == [0]
        assert page.page.evaluate("window.annotate.draft.done.at(-1).says").endswith("farther")


def test_images_alone_are_shown_and_can_be_annotated(settings: Path) -> None:
    for path in artefact(settings, "joint").parent.glob("*.h5"):
        if path.stem != "frames":
            path.unlink()
    with served(settings) as server, _open(server) as page:
        assert "images alone" in page.page.locator("#banners").inner_text()
        page.page.keyboard.press("ArrowRight")
        page.wait("document.body.dataset.drawn === '1'")
        page.page.keyboard.press("x")
        assert _draft(page, "drop_frames") == [1]


def test_a_person_alone_has_no_object_to_mend(settings: Path) -> None:
    table = settings.parent / "sequences.tsv"
    table.write_text(table.read_text().replace("football", ""))
    with served(settings) as server, _open(server) as page:
        assert page.page.locator("#tab-object").count() == 0
        for key in (
            "ArrowRight",
            "o",
            "s",
            "f",
            "f",
            "n",
            "c",
            "k",
            "Delete",
            "q",
            "b",
            "End",
            "x",
        ):
            page.page.keyboard.press(key)
        assert _draft(page, "drop_frames") == [9]


def test_before_the_first_run_it_says_what_to_do(settings: Path) -> None:
    artefact(settings, "frames").unlink()
    with served(settings) as server, _open(server) as page:
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
        assert _draft(page, "drop_frames") == [0]


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
        with _open(server, dark=dark) as page:
            for tab in ("doubts", "questions", "object", "marks", "sides", "run"):
                page.page.locator(f"#tab-{tab}").click()
                assert serious_faults(page) == []


def test_a_step_is_drawn_in_all_views_in_time(settings: Path) -> None:
    from bench.annotate_page import WATCH, steps_ms

    with served(settings) as server, _open(server) as page:
        page.page.evaluate(WATCH)
        found = steps_ms(page.page, 9)
    assert float(np.median(found[:, 0])) < PATIENCE * STEP_MS, found
