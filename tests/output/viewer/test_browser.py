"""The viewer in a real browser, from disk: loads, plays, seeks, shows what is there."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.camera.transforms import apply, invert
from intercap_core.output.viewer import page
from intercap_core.output.viewer.content import Content, gather
from intercap_core.schemas import JOINT, SCENE
from intercap_core.sequence_inputs import SequencePaths
from tests.helpers import fitted_capture as fitted
from tests.helpers.browser import PHONE, Visit, needs_chromium, visit

FRAMES, SIZE = 4, (900, 1000)
NAME = "s01_o03"


@pytest.fixture(scope="module")
def capture(captures: dict[str, fitted.Capture]) -> fitted.Capture:
    return captures[NAME]


def _gather_all(capture: fitted.Capture) -> Content:
    stages = (stage for stage in capture.paths if stage != "truth")
    return gather(capture.inputs(*stages), capture.models, truth=capture.paths["truth"])


def _write(capture: fitted.Capture, folder: Path, name: str = NAME, **without: bool) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    paths = {stage: path for stage, path in capture.paths.items() if stage not in without}
    page.write_script(
        folder / page.SCRIPT,
        SequencePaths(**{stage: path for stage, path in paths.items() if stage != "truth"}),
        capture.models,
        truth=None if "truth" in without else capture.paths["truth"],
    )
    (folder / "index.html").write_text(page.standalone(name))
    return folder / "index.html"


@pytest.fixture(scope="module")
def shown(capture: fitted.Capture, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _write(capture, tmp_path_factory.mktemp("page"))


_AT_HAND = """
  const root = document.querySelector(".viewer");
  const viewer = window.intercapViewer, result = {};
  const key = (name, more) => root.dispatchEvent(
    new KeyboardEvent("keydown", { key: name, bubbles: true, ...more }));
  const pause = (ms) => new Promise((done) => setTimeout(done, ms));
  const become = async (test) => { while (!test()) await pause(20); };
"""


def _browse(shown: Path, script: str = "", address: str = "") -> dict[str, Any]:
    """What ``script`` leaves in ``result`` when the viewer stands, what the console printed, the
    page's text and a picture."""
    with visit(shown, size=SIZE, address=address) as visited:
        visited.wait()
        result = visited.page.evaluate("async () => {" + _AT_HAND + script + "\nreturn result; }")
        return {
            "result": result,
            "console": visited.console,
            "dom": visited.page.content(),
            "picture": visited.picture(),
        }


@needs_chromium
def test_loads_plays_and_seeks_without_an_error(shown: Path, tmp_path: Path) -> None:
    found = _browse(
        shown,
        """
        result.first = viewer.state.frame;
        key("ArrowRight"); result.right = viewer.state.frame; result.address = location.hash;
        key("End"); result.end = viewer.state.frame;
        key("Home"); result.home = viewer.state.frame;
        location.hash = "#t=0.2"; await become(() => viewer.state.frame === 3);
        key(" "); result.playing = viewer.state.playing; await become(() => !viewer.state.playing);
        result.played = viewer.state.frame;
        const layers = [...root.querySelectorAll("[data-layer]")];
        result.layers = layers.map((label) => label.dataset.layer);
        root.querySelector('[data-part="loop"]').click();
        key(" "); await become(() => viewer.state.frame === 1); key(" ");
        root.querySelector('[data-part="back"]').click(); result.back = viewer.state.frame;
        key("2"); result.contact = viewer.state.contact;
        result.images = viewer.header.cameras.length;
        """,
        "#t=0.14",
    )
    assert found["console"] == []
    result = found["result"]
    assert result is not None, "the viewer did not come to an end of what it was asked"
    assert result["first"] == 2  # 0.14 s of 15 a second
    assert (result["right"], result["end"], result["home"]) == (3, FRAMES - 1, 0)
    assert result["address"] == "#t=0.20"
    assert result["playing"] and result["played"] == FRAMES - 1
    assert result["layers"] == ["object", "contact", "clouds", "cameras", "images"]
    assert result["back"] == 0 and not result["contact"] and result["images"] == 3


@needs_chromium
def test_it_starts_at_the_first_contact(capture: fitted.Capture, shown: Path) -> None:
    bits = _gather_all(capture).arrays["contact/touching"]
    first = int(np.flatnonzero(bits.any(1))[0])
    assert _browse(shown, "result.frame = viewer.state.frame;")["result"]["frame"] == first


@needs_chromium
def test_the_address_restores_camera_layers_and_comparison(shown: Path) -> None:
    link = "#t=0.20&layers=object&other=truth&how=distance"
    script = """
        const { joint, truth } = viewer.versions;
        const place = ({ mesh }) => [...mesh.geometry.attributes.position.array];
        result.bodies = [place(joint), place(truth)];
        result.legend = root.querySelector('[data-part="legend"]').textContent;
        result.shown = [joint.group.visible, truth.group.visible];
        viewer.compare({ how: "split" });
        result.split = location.hash;
        const titles = root.querySelectorAll('[data-part="titles"] span');
        result.titles = [...titles].map((title) => title.textContent);
        const slider = root.querySelector('[data-part="opacity"]');
        slider.value = 0.6; slider.dispatchEvent(new Event("input"));
        result.opacity = location.hash.includes("opacity=0.6");
        location.hash = "#t=0.13"; await become(() => viewer.state.frame === 2);
        result.plain = [viewer.state.other, slider.value, location.hash];
    """
    found = _browse(shown, script, link)
    result = found["result"]
    assert found["console"] == [] and result["split"] == link.replace("distance", "split")
    joint, truth = (np.reshape(body, (-1, 3)) for body in result["bodies"])
    mean = 1e3 * np.linalg.norm(joint - truth, axis=1).mean()
    legend = re.fullmatch(r"distance to truth, 0 to (\d+) mm; mean ([\d.]+) mm", result["legend"])
    assert legend is not None, result["legend"]
    assert result["shown"] == [True, False] and result["titles"] == ["joint fit", "truth"]
    assert float(legend[2]) == pytest.approx(mean, rel=0.1) and float(legend[1]) > mean
    assert result["opacity"] and result["plain"] == ["", "0.3", "#t=0.13"]
    eye = _browse(shown, "result.eye = viewer.eye.position.toArray();", "#t=0.20&eye=1,2,3,0,0,1")
    assert eye["result"]["eye"] == pytest.approx([1, 2, 3])
    _browse(shown, "await become(() => viewer.cameras[1].plane.visible);", "#t=0.2&view=k2")


@needs_chromium
def test_the_wheel_scrolls_the_page_until_the_picture_is_clicked(shown: Path) -> None:
    with visit(shown, size=(900, 500)) as visited:
        visited.wait()
        page = visited.page
        far, _ = _far(visited)

        def wheel(by: int) -> tuple[float, float]:
            page.mouse.wheel(0, by)
            page.wait_for_timeout(200)
            return page.evaluate("scrollY"), _far(visited)[0]

        page.mouse.move(450, 250)
        scrolled, same = wheel(60)
        assert scrolled == 60 and same == far
        page.keyboard.down("Control")
        scrolled, near = wheel(-60)
        page.keyboard.up("Control")
        assert scrolled == 60 and near < far
        page.mouse.click(450, 250)
        assert wheel(60)[0] == 60 and _far(visited)[0] > near
        page.mouse.click(4, 250)
        page.mouse.move(450, 250)
        assert wheel(-60)[0] == 0


@needs_chromium
def test_a_distance_is_measured_and_follows_the_object(shown: Path) -> None:
    look_from = """(side) => { // at the ball, from 20 cm away along x
      const { versions, eye, draw } = intercapViewer, { mesh } = versions.joint.object;
      mesh.geometry.computeBoundingSphere();
      const middle = mesh.geometry.boundingSphere.center.clone().applyMatrix4(mesh.matrix);
      eye.position.copy(middle).x += 0.2 * side;
      eye.lookAt(middle);
      draw();
      return mesh.geometry.boundingSphere.radius;
    }"""
    with visit(shown, size=SIZE, address="#t=0") as visited:
        visited.wait()
        page = visited.page
        page.get_by_role("button", name="Measure").click()
        box = page.locator("[data-part=canvas]").bounding_box()
        assert box is not None
        for side in (1, -1):
            radius = page.evaluate(look_from, side)
            page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        metres = page.evaluate("intercapViewer.measurement.metres")
        assert metres == pytest.approx(2 * radius, rel=0.02)
        assert page.locator("[data-part=measured]").inner_text() == f"distance: {metres:.3f} m"
        point = "intercapViewer.measurement.points[0]().toArray()"
        before = page.evaluate(point)
        page.evaluate("intercapViewer.show(3)")
        assert np.linalg.norm(np.subtract(before, page.evaluate(point))) > 0.001
        assert page.evaluate("intercapViewer.measurement.metres") == pytest.approx(metres, abs=1e-4)
        assert visited.console == []


def _expected_pixels(
    capture: fitted.Capture, box: dict[str, float], frame: int
) -> tuple[np.ndarray, np.ndarray]:
    """Where the first camera sees body vertices and the object's centre, on the page's canvas."""
    with artefacts.read(capture.paths["joint"], JOINT) as joint:
        poses, ball = joint["master_from_colour"], joint["translation"][frame]
    with artefacts.read(capture.paths["scene"], SCENE) as scene:
        camera = Rig.from_artefact(scene).moved(poses)[0]
    with artefacts.read(capture.paths["joint"], JOINT) as joint:
        joints = joint["joints"][frame]
    to_camera = invert(camera.master_from_colour)
    lens = camera.colour
    scale = min(box["width"] / lens.width, box["height"] / lens.height)
    middle = np.array([box["left"] + box["width"] / 2, box["top"] + box["height"] / 2])

    def on_page(points: np.ndarray) -> np.ndarray:
        local = apply(to_camera, points)
        pinhole = local[:, :2] / local[:, 2:] * [lens.fx, lens.fy]
        return middle + scale * pinhole

    return on_page(joints[[0, 3, 6, 9]]), on_page(ball[None])[0]


@needs_chromium
def test_body_and_object_are_where_the_camera_sees_them(
    capture: fitted.Capture, shown: Path, tmp_path: Path
) -> None:
    found = _browse(
        shown,
        """
        for (const name of ["contact", "cameras"])
          root.querySelector(`[data-layer="${name}"] input`).click();
        const opacity = root.querySelector('[data-part="opacity"]');
        opacity.value = 0;
        opacity.dispatchEvent(new Event("input"));
        viewer.show(3); viewer.look(0); await become(() => viewer.cameras[0].plane.visible);
        const box = root.querySelector("canvas").getBoundingClientRect();
        result.box = { left: box.left, top: box.top, width: box.width, height: box.height };
        """,
    )
    assert found["console"] == []
    body, ball = _expected_pixels(capture, found["result"]["box"], 3)
    picture = found["picture"][..., ::-1].astype(int)

    def at(point: np.ndarray) -> np.ndarray:
        x, y = np.rint(point).astype(int)
        return np.median(picture[y - 2 : y + 3, x - 2 : x + 3].reshape(-1, 3), axis=0)

    for point in body:  # along the spine: skin, which is blue
        red, _, blue = at(point)
        assert blue > red + 25, (point, at(point))
    red, _, blue = at(ball)
    assert not blue > red + 25


@needs_chromium
def test_another_result_changes_the_picture(shown: Path) -> None:
    script = "viewer.compare({ shown: 'truth' }); await pause(100);"
    pictures = [_browse(shown, then)["picture"].astype(int) for then in ("", script)]
    assert (np.abs(pictures[0] - pictures[1]).max(2) > 40).mean() > 0.01


def _far(visited: Visit) -> tuple[float, np.ndarray]:
    """How far the eye is from the body's middle, and the direction in which it is."""
    found = visited.page.evaluate(
        """() => {
          const { eye, versions, state } = intercapViewer;
          return [eye.position.toArray(), versions.joint.centre(state.frame).toArray()];
        }"""
    )
    away = np.subtract(*found)
    return float(np.linalg.norm(away)), away / np.linalg.norm(away)


@needs_chromium
def test_fingers_turn_come_nearer_play_seek_and_switch(shown: Path) -> None:
    with visit(shown, size=PHONE, phone=True) as visited:
        visited.wait()
        page = visited.page
        assert page.evaluate("document.documentElement.scrollWidth") == PHONE[0]
        box = page.locator("[data-part=canvas]").bounding_box()
        assert box is not None
        x, y = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2

        far, before = _far(visited)
        visited.touch("touchStart", (x, y))
        for by in range(10, 101, 10):
            visited.touch("touchMove", (x + by, y))
        visited.touch("touchEnd")
        same, after = _far(visited)
        assert same == pytest.approx(far, rel=0.02)
        assert np.degrees(np.arccos(before @ after)) > 20
        assert page.evaluate("scrollY") == 0  # the page stays, the scene turns

        visited.touch("touchStart", (x - 30, y), (x + 30, y))
        for by in range(40, 91, 10):
            visited.touch("touchMove", (x - by, y), (x + by, y))
        visited.touch("touchEnd")
        near, _ = _far(visited)
        assert near < 0.6 * far
        page.get_by_role("button", name="Overview").tap()
        assert _far(visited)[0] == pytest.approx(far, rel=0.05)

        bar = page.get_by_label("Frame").bounding_box()
        assert bar is not None and bar["height"] >= 30
        page.touchscreen.tap(bar["x"] + 0.99 * bar["width"], bar["y"] + bar["height"] / 2)
        assert page.evaluate("intercapViewer.state.frame") == FRAMES - 1
        page.get_by_role("button", name="Play").tap()  # from the start, as it stood at the end
        visited.wait("!intercapViewer.state.playing")
        assert page.evaluate("location.hash") == f"#t={(FRAMES - 1) / fitted.FPS:.2f}"
        page.get_by_label("compared with").select_option("truth")
        assert page.evaluate("intercapViewer.versions.truth.group.visible")
        for control in page.locator(".viewer :is(button, select, label):visible").all():
            at = control.bounding_box()
            assert at is not None and at["height"] >= 40, control.inner_text()
        page.evaluate("scrollTo(0, 0)")
        view = _far(visited)
        visited.touch("touchStart", (x, y))
        for by in range(20, 201, 20):
            visited.touch("touchMove", (x, y - by))
        visited.touch("touchEnd")
        visited.wait("scrollY > 50")
        assert np.allclose(_far(visited)[1], view[1], atol=1e-6)  # the page moved, not the scene
        assert visited.console == []


@needs_chromium
def test_text_from_files_is_escaped(capture: fitted.Capture, tmp_path: Path) -> None:
    changed = capture.copied(tmp_path, "joint")
    del changed.paths["metrics"]
    with changed.edit("joint") as file:
        reasons = file["flag_reason"][()].astype("S60")
        reasons[0] = b"body: <img src=x onerror=alert(1)> </script>"
        del file["flag_reason"]
        file["flag_reason"] = reasons
        file["flagged"][0] = [True, False, False, False]
    shown = _write(changed, tmp_path / "page", name='<b onclick="x">"name"</b>')
    found = _browse(shown, "result.flag = root.querySelector('[data-part=flag]').innerHTML;")
    assert found["console"] == [] and "<b onclick" not in found["dom"]
    assert found["result"]["flag"].startswith("not reliable here: body (&lt;img src=x")


@needs_chromium
def test_a_page_without_its_file_says_so(shown: Path, tmp_path: Path) -> None:
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / page.SCRIPT).write_text("")
    (tmp_path / "none" / "index.html").write_text(shown.read_text())
    with visit(tmp_path / "none" / "index.html") as visited:
        assert visited.page.get_by_role("status").inner_text() == (
            "The file viewer.js is not in the folder of this page."
        )
        assert visited.page.evaluate("window.intercapViewer") is None


def test_the_viewer_needs_only_the_body_fit(capture: fitted.Capture, tmp_path: Path) -> None:
    found = gather(capture.inputs("frames", "scene", "body_fit"), capture.models)
    assert list(found.header["versions"]) == ["sequential"] and found.header["object"] == ""
    assert "clouds/person" not in found.arrays and found.header["frames"] == FRAMES
    whole = _gather_all(capture)
    assert list(whole.header["versions"]) == ["joint", "sequential", "truth"]
    starts = whole.arrays["clouds/person_starts"]
    assert len(starts) == len(whole.header["moments"]) + 1 and starts[-1] > 0
    assert max(whole.header["error_mm"].values()) <= 1.0
    with artefacts.read(capture.paths["scene"], SCENE) as scene:
        assert whole.header["floor"] == bool(np.isfinite(scene["ground_point"]).all())
    data, (first, last) = whole.arrays["images/data"], whole.arrays["images/starts"][:2]
    image = cv2.imdecode(data[first:last], cv2.IMREAD_COLOR)
    assert image.shape[1] == min(640, whole.header["cameras"][0]["size"][0])
