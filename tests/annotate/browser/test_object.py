"""The object in the page: its pose by hand and by numbers, where it is touched."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import yaml
from scipy.spatial.transform import Rotation

from tests.annotate.browser.hand import SAVED, draft_of, drag, middle_of_the_object, open_page, save
from tests.annotate.served import annotation, served
from tests.helpers.browser import Visit, needs_chromium

pytestmark = needs_chromium


def test_the_object_is_moved_in_a_view_where_the_pointer_goes(settings: Path) -> None:
    with served(settings) as server, open_page(server) as page:
        keys = page.page.keyboard
        keys.press("o")
        box = page.page.locator("#big canvas").first.bounding_box()
        assert box is not None
        told = page.page.evaluate(
            """() => { const a = window.annotate, view = a.views.views[0];
              return { pose: a.pose.pose, focal: view.camera.lens[0],
                       size: view.camera.size[0] }; }"""
        )
        start = middle_of_the_object(page)
        drag(page, start, (40, -20))
        [pose] = draft_of(page, "object_poses")
        depth = told["pose"][2][3]
        metres = depth / told["focal"] * told["size"] / box["width"]
        moved = np.array(pose["translation"]) - np.array(told["pose"])[:, 3]
        assert np.allclose(moved, [40 * metres, -20 * metres, 0], atol=0.1 * 40 * metres)
        keys.down("Shift")
        drag(page, start, (50, 0))
        keys.up("Shift")
        turned = Rotation.from_rotvec(draft_of(page, "object_poses")[0]["rotation_vector"])
        assert 0.3 < turned.magnitude() < 0.5  # about the vertical of the view, 0.008 rad a pixel
        keys.press("Escape")
        save(page)
        page.wait(SAVED)
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
        return [one["frame"] for one in draft_of(page, "object_poses") or ()]

    with served(settings) as server, open_page(server) as page:
        keys = page.page.keyboard
        assert page.page.locator(".mark.posed").count() == 1
        for frame in (0, 6):
            page.page.evaluate(f"window.annotate.show({frame})")
            keys.press("o")
            middle = middle_of_the_object(page)
            drag(page, middle, (25, 5))
            keys.press("Escape")
        assert frames(page) == [0, 4, 6] and draft_of(page, "object_pose") is None
        assert draft_of(page, "object_poses")[1]["sigma_m"] == 0.02
        assert page.page.locator(".mark.posed").count() == 3
        keys.press("Control+z")
        keys.press("Control+z")
        assert frames(page) == [] and draft_of(page, "object_pose")["frame"] == 4
        keys.press("Control+Shift+z")
        keys.press("Control+Shift+z")
        page.page.locator("#tab-object").click()
        page.page.get_by_role("button", name="Remove the pose").click()  # of frame 6, the shown one
        assert frames(page) == [0, 4]
        save(page)
        page.wait(SAVED)
    text = annotation(settings).read_text()
    told = yaml.safe_load(text)
    assert text.startswith("# kept\n") and set(told) == {"object_poses"}
    assert [one["frame"] for one in told["object_poses"]] == [0, 4]


def test_a_number_that_is_typed_counts_before_a_key_of_the_page(settings: Path) -> None:
    with served(settings) as server, open_page(server) as page:
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
        assert draft_of(page, "object_poses")[0]["translation"][0] == 0.125
        assert field.input_value() == "0.1250" and field.evaluate(
            "(e) => e === document.activeElement"
        )
        keys.press("Control+Shift+z")
        assert draft_of(page, "object_poses")[0]["translation"][0] == 0.25
        keys.press("Control+a")
        keys.press("Delete")
        keys.press("Tab")  # no number: as it was
        assert draft_of(page, "object_poses")[0]["translation"][0] == 0.25
        page.page.mouse.move(*middle_of_the_object(page))
        page.page.mouse.wheel(0, 100)
        page.wait("window.annotate.pose.late")
        page.page.evaluate("window.annotate.show(1)")  # before the wheel's step was taken
        page.page.wait_for_timeout(300)
        assert [one["frame"] for one in draft_of(page, "object_poses")] == [0]
        assert page.page.evaluate("window.annotate.draft.done.at(-1).says").endswith("farther")


def test_where_people_touch_is_painted_and_kept_with_the_object(settings: Path) -> None:
    mesh = Path(yaml.safe_load((settings.parent / "objects.yaml").read_text())["football"]["mesh"])
    own = settings.parent / mesh.name
    shutil.copy(mesh, own)
    (settings.parent / "objects.yaml").write_text(f"football:\n  mesh: {own.name}\n")
    with served(settings) as server, open_page(server) as page:
        page.page.locator("#tab-object").click()
        page.page.get_by_text("Paint its contact surface").click()
        page.wait("document.body.dataset.mode === 'Paint'")
        box = page.page.locator("#big canvas").first.bounding_box()
        assert box is not None
        middle = (box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        drag(page, middle, (30, 0))
        assert page.page.evaluate("window.annotate.paint.painted.size") > 0
        page.page.keyboard.press("Control+z")
        assert page.page.evaluate("window.annotate.paint.painted.size") == 0
        page.page.keyboard.press("Control+Shift+z")
        assert page.page.evaluate("window.annotate.paint.painted.size") > 0
        page.page.evaluate("window.annotate.reload()")  # results are others by now
        page.wait("document.body.dataset.mode === ''")
        page.page.get_by_text("Paint its contact surface").click()
        page.wait("document.body.dataset.mode === 'Paint'")
        assert page.page.evaluate("window.annotate.paint.painted.size") > 0
        page.page.keyboard.press("Control+z")
        drag(page, middle, (-20, 10))
        page.page.keyboard.press("Control+s")
        assert "its own button" in page.page.locator("#hint").inner_text()
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


def test_a_person_alone_has_no_object_to_mend(settings: Path) -> None:
    table = settings.parent / "sequences.tsv"
    table.write_text(table.read_text().replace("football", ""))
    with served(settings) as server, open_page(server) as page:
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
        assert draft_of(page, "drop_frames") == [9]
