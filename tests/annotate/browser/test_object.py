"""The object on the page: its pose by hand and by numbers, and its contact surface."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from tests.annotate.browser.hand import SAVED, Hand, open_page
from tests.annotate.served import annotation, served
from tests.helpers.browser import needs_chromium

if TYPE_CHECKING:
    from playwright.sync_api import Route

pytestmark = needs_chromium


def test_the_object_follows_the_pointer(settings: Path) -> None:
    with served(settings) as server, open_page(server) as hand:
        hand.press("o")
        before = np.array(hand.app("pose.pose"))
        camera = hand.app("views.views[0].camera")
        width = hand.box("#big canvas")[2]
        start = hand.object_middle()
        hand.drag(start, (40, -20))
        [pose] = hand.draft("object_poses")
        metres = before[2, 3] / camera["lens"][0] * camera["size"][0] / width
        moved = np.array(pose["translation"]) - before[:, 3]
        assert np.allclose(moved, [40 * metres, -20 * metres, 0], atol=0.1 * 40 * metres)
        hand.page.keyboard.down("Shift")
        hand.drag(start, (50, 0))
        hand.page.keyboard.up("Shift")
        rotated = Rotation.from_rotvec(hand.draft("object_poses")[0]["rotation_vector"])
        assert 0.3 < rotated.magnitude() < 0.5  # 0.008 rad per pixel
        hand.press("Escape")
        hand.save()
    saved = yaml.safe_load(annotation(settings).read_text())
    assert [pose["frame"] for pose in saved["object_poses"]] == [0]


def test_the_object_can_be_placed_in_several_frames(settings: Path) -> None:
    single = "{frame: 4, rotation_vector: [0, 0, 0], translation: [0, 0, 2], sigma_m: 0.02}"
    annotation(settings).write_text(f"# kept\nobject_pose: {single}\n")

    def frames(hand: Hand) -> list[int]:
        return [pose["frame"] for pose in hand.draft("object_poses") or ()]

    with served(settings) as server, open_page(server) as hand:
        marks = hand.page.locator(".mark.posed")
        assert marks.count() == 1
        for frame in (0, 6):
            hand.show(frame)
            hand.press("o")
            hand.drag(hand.object_middle(), (25, 5))
            hand.press("Escape")
        assert frames(hand) == [0, 4, 6] and hand.draft("object_pose") is None
        assert hand.draft("object_poses")[1]["sigma_m"] == 0.02 and marks.count() == 3
        hand.press("Control+z", "Control+z")
        assert frames(hand) == [] and hand.draft("object_pose")["frame"] == 4
        hand.press("Control+Shift+z", "Control+Shift+z")
        hand.page.locator("#tab-object").click()
        hand.click("Remove the pose")  # of frame 6
        assert frames(hand) == [0, 4]
        hand.save()
    text = annotation(settings).read_text()
    saved = yaml.safe_load(text)
    assert text.startswith("# kept\n") and set(saved) == {"object_poses"}
    assert [pose["frame"] for pose in saved["object_poses"]] == [0, 4]


def test_typed_numbers_are_committed_before_shortcuts(settings: Path) -> None:
    def first_x(hand: Hand) -> float:
        return hand.draft("object_poses")[0]["translation"][0]

    with served(settings) as server, open_page(server) as hand:
        hand.press("o")
        field = hand.page.locator(".numbers input").first
        field.focus()
        hand.press("Control+a")
        hand.page.keyboard.type("0.125")
        assert "0.125" in hand.open_save()
        hand.press("Escape")
        hand.wait("!document.getElementById('dialog').open")
        field.focus()
        hand.press("Control+a")
        hand.page.keyboard.type("0.25")
        hand.press("Control+z")  # the typed number is an undo step
        assert first_x(hand) == 0.125 and field.input_value() == "0.1250"
        assert field.evaluate("(e) => e === document.activeElement")
        hand.press("Control+Shift+z")
        assert first_x(hand) == 0.25
        hand.press("Control+a", "Delete", "Tab")  # no number: the value is restored
        assert first_x(hand) == 0.25
        hand.page.mouse.move(*hand.object_middle())
        hand.page.mouse.wheel(0, 100)
        hand.wait("window.annotate.pose.wheelTimer")
        hand.show(1)  # before the step of the wheel is stored
        hand.page.wait_for_timeout(300)
        assert [pose["frame"] for pose in hand.draft("object_poses")] == [0]
        assert hand.app("draft.undoSteps.at(-1).label") == "object distance changed"


def test_a_late_fit_keeps_edits_and_saving_waits_for_it(settings: Path) -> None:
    def poses(hand: Hand) -> list[list[float]]:
        return [pose["translation"] for pose in hand.draft("object_poses") or ()]

    with served(settings) as server, open_page(server) as hand:
        held: list[Route] = []
        hand.page.route("**/snap", lambda route: held.append(route))

        def fit() -> None:
            hand.press("s")
            while not held:
                hand.page.wait_for_timeout(20)

        def arrive() -> None:
            held.pop().continue_()
            hand.wait("!window.annotate.pose.fits.size")

        hand.press("o")
        hand.drag(hand.object_middle(), (9, 4))
        fit()
        field = hand.page.locator(".numbers input").first
        typed = round(float(field.input_value()) + 0.01, 3)
        field.fill(str(typed))  # not yet committed
        arrive()
        assert field.input_value() == str(typed) and "discarded" in hand.text(".report")
        hand.press("Tab")
        assert [x for x, *_ in poses(hand)] == [typed]

        fit()
        hand.press("Control+s")
        assert "waiting for the fit of frame 0" in hand.text("#hint")
        assert not hand.page.locator("#dialog").is_visible()
        hand.press("ArrowRight")  # the fit is stored although another frame is shown
        arrive()
        hand.wait("document.getElementById('dialog').open")
        [fitted] = poses(hand)
        assert fitted[0] != typed and str(fitted[0]) in hand.text("#dialog")
        hand.answer("save")
        hand.wait(SAVED)
        assert yaml.safe_load(annotation(settings).read_text())["object_poses"][0][
            "translation"
        ] == pytest.approx(fitted)

        hand.press("o")
        fit()
        hand.click("Remove the pose")
        held.pop().continue_()
        hand.page.wait_for_timeout(300)
        assert poses(hand) == [fitted]


def test_the_contact_surface_is_painted_and_saved(settings: Path) -> None:
    objects = settings.parent / "objects.yaml"
    mesh = Path(yaml.safe_load(objects.read_text())["football"]["mesh"])
    own = Path(shutil.copy(mesh, settings.parent / mesh.name))
    objects.write_text(f"football:\n  mesh: {own.name}\n")

    def paint(hand: Hand) -> None:
        hand.click("Paint the contact surface")
        hand.wait("document.body.dataset.mode === 'Paint'")

    with served(settings) as server, open_page(server) as hand:
        hand.page.locator("#tab-object").click()
        paint(hand)
        x, y, width, height = hand.box("#big canvas")
        middle = (x + width / 2, y + height / 2)
        hand.drag(middle, (30, 0))
        assert hand.app("paint.painted.size") > 0
        hand.press("Control+z")
        assert hand.app("paint.painted.size") == 0
        hand.press("Control+Shift+z")
        assert hand.app("paint.painted.size") > 0
        hand.app("reload()")  # unsaved paint survives new results
        hand.wait("document.body.dataset.mode === ''")
        paint(hand)
        assert hand.app("paint.painted.size") > 0
        hand.press("Control+z")
        hand.drag(middle, (-20, 10))
        hand.press("Control+s")
        assert "its own save button" in hand.text("#hint")
        painted = hand.app("paint.painted.size")
        hand.click("Save the surface")
        hand.answer("save")
        hand.wait("!window.annotate.paint.changed")
    written = json.loads(own.with_suffix(".contact.json").read_text())
    assert len(written["contact_vertices"]) >= painted > 0
    assert f"contact_vertices: {own.stem}.contact.json" in objects.read_text()


def test_without_an_object_there_is_no_object_panel(settings: Path) -> None:
    table = settings.parent / "sequences.tsv"
    table.write_text(table.read_text().replace("football", ""))
    with served(settings) as server, open_page(server) as hand:
        assert hand.page.locator("#tab-object").count() == 0
        hand.press("ArrowRight", *"osffnck", "Delete", *"qb", "End", "x")
        assert hand.draft("drop_frames") == [9]
