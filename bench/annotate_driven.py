"""Correct two recordings on the annotation page in Chromium, as a person would.

    python -m bench.annotate_driven [config/annotate/config.yaml] [--output results/evaluation.json]

Measures the effort and the effect of annotation. Missing recordings and results are computed,
annotations of an earlier call are removed, and the page is operated by keys, clicks and drags only.
In the first recording the object is placed in a few of the frames in which the track is lost; in
the second the intervals of contact are corrected. Each is saved and run from the page, and compared
with truth before and after. The truth stands for the person's eye: it is used to see the object and
the contact, for nothing else.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from bench import annotate_page
from bench.annotate_page import Hand, Point
from bench.command import exit_on_user_error, replace_figures
from bench.evaluate.objects import measure
from bench.evaluate.sequence_figures import stated_contact_figures
from intercap_core import artefacts
from intercap_core.annotate.questions import answers_path
from intercap_core.annotate.rerun import targets
from intercap_core.errors import UserError
from intercap_core.evaluation import figures
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.evaluation.object_errors import ObjectErrors
from intercap_core.evaluation.truth import Truth
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.solve.time_series import runs
from intercap_core.project import Project, load_project
from intercap_core.schemas import METRIC_REGIONS, SCENE

OBJECT, CONTACT = "racquet_swing_s11", "bottle_drink_s02"
APART = (4, 2, 1)  # frames between poses: at first, where it is still lost after a run, and again
_TURN = 0.008  # radians that a pixel of a drag turns the object by
_REACH = 260.0  # pixels of one drag
_NEAR_PX, _NEAR_DEG = 1.5, 4.0  # as close as a person places it
_SEEN_DEG = 8.0  # a turn that is drawn wrong by more is seen to be
_MAX_EDITS = 120  # of contact; more would mean that the driver goes in circles
Interval = tuple[int, int]


@dataclass
class Eye:
    """Truth that stands for what a person sees in the images."""

    rotation: np.ndarray
    """(T, 3, 3) of the true object."""
    translation: np.ndarray
    """(T, 3)."""
    views: np.ndarray
    """(T,) number of cameras that see the object."""
    colour_from_master: dict[str, np.ndarray]
    """True cameras by name."""
    mesh: ObjectMesh

    @classmethod
    def of(cls, project: Project, name: str) -> Eye:
        truth, entry = project.sequences[name].truth, project.object_of(name)
        assert truth is not None and entry is not None
        with artefacts.read(project.artefact(name, "scene"), SCENE) as scene:
            true = Truth.load(truth, scene["times"], float(scene.attributes["fps"]), 0)
        poses = np.linalg.inv(true.master_from_colour)
        cameras = dict(zip(true.camera_names, poses, strict=True))
        mesh = ObjectMesh.load(entry)
        return cls(true.rotation, true.translation, true.object_views, cameras, mesh)

    def centre(self, frame: int, camera: str) -> np.ndarray:
        """The object's centre (3,) in the true camera's frame."""
        place = self.rotation[frame] @ self.mesh.centre_of_mass + self.translation[frame]
        pose = self.colour_from_master[camera]
        return pose[:3, :3] @ place + pose[:3, 3]


# --- the object --------------------------------------------------------------------------------


class Placing:
    """Places the object in frames of the page."""

    def __init__(self, hand: Hand, eye: Eye) -> None:
        self.hand, self.eye = hand, eye
        cameras = hand.see("window.annotate.info.cameras")
        self.cameras = {one["name"]: one for one in cameras if one["pose"] is not None}
        self.poses = {name: np.array(one["pose"]) for name, one in self.cameras.items()}

    def place(self, frame: int) -> float:
        """Drag and rotate the object in two views, fit it, and keep the better pose.

        Returns degrees.
        """
        hand = self.hand
        hand.go_to(frame)
        if hand.see("document.body.dataset.mode"):
            hand.key("Escape")
        self._enlarge(frame)
        if hand.see("window.annotate.following"):
            hand.key("f")
        hand.key("o")
        self._move(frame)
        self._turn(frame)
        hand.key("f")  # near it, for what is left
        self._move(frame)
        self._turn(frame)
        self._move(frame)
        before = self._off(frame)
        hand.key("s")
        hand.visit.wait("window.annotate.pose.report !== 'fitting…'")
        after = self._off(frame)
        if after[0] > before[0] + 0.01 or after[1] > before[1] + 5.0:  # it jumped off the object
            hand.key("Control+z")
            after = before
        hand.key("f")
        hand.key("Escape")
        print(f"  frame {frame}: {1e3 * after[0]:.0f} mm and {after[1]:.0f} degrees off")
        return after[1]

    def _enlarge(self, frame: int) -> None:
        """Enlarge the two views of the object with the most different viewing directions."""
        seen = [name for name in self.cameras if self._inside(frame, name)]
        if len(seen) < 2:
            seen = list(self.cameras)
        ahead = {name: self.poses[name][2, :3] for name in seen}
        pairs = [(a, b) for a in seen for b in seen if a < b]
        first, second = min(pairs, key=lambda pair: abs(ahead[pair[0]] @ ahead[pair[1]]))
        shown = {one["camera"] for one in self.hand.views({})}
        if shown != {first, second}:
            for name in (second, first):
                self.hand.double_click(f'[data-camera="{name}"] canvas')

    def _inside(self, frame: int, camera: str) -> bool:
        x, y, z = self.eye.centre(frame, camera)
        lens, (wide, high) = self.cameras[camera]["lens"], self.cameras[camera]["size"]
        u, v = lens[0] * x / z + lens[2], lens[1] * y / z + lens[3]
        return z > 0.2 and 0.03 * wide < u < 0.97 * wide and 0.03 * high < v < 0.97 * high

    def _shown(self) -> np.ndarray:
        return np.array(self.hand.see("window.annotate.pose.pose"))

    def _off(self, frame: int) -> tuple[float, float]:
        """Metres and degrees between the displayed and the true pose."""
        pose, centre = self._shown(), self.eye.mesh.centre_of_mass
        true = self.eye.rotation[frame] @ centre + self.eye.translation[frame]
        away = float(np.linalg.norm(pose[:, :3] @ centre + pose[:, 3] - true))
        turned = self.eye.mesh.symmetry.rotation_error_deg(pose[:, :3], self.eye.rotation[frame])
        return away, float(turned)

    def _move(self, frame: int) -> None:
        """Drag in both views in turn until the object is aligned in both."""
        centre = self.eye.mesh.centre_of_mass
        for _ in range(6):
            worst = 0.0
            for k in range(2):
                pose = self._shown()
                drawn = pose[:, :3] @ centre + pose[:, 3]
                seen = {name: self._as_drawn(frame, name) for name in self.cameras}
                view = self.hand.views({name: [drawn, at] for name, at in seen.items()})[k]
                if None in view["at"]:
                    continue
                (x, y), (to_x, to_y) = view["at"]
                by = _within((to_x - x, to_y - y))
                worst = max(worst, float(np.hypot(*by)))
                if np.hypot(*by) > _NEAR_PX:
                    self.hand.drag(_start(view["box"], (x, y), by), by)
            if worst <= _NEAR_PX:
                return

    def _as_drawn(self, frame: int, camera: str) -> np.ndarray:
        """The point of the room that is drawn where the true camera sees the true centre."""
        pose = self.poses[camera]
        return pose[:, :3].T @ (self.eye.centre(frame, camera) - pose[:, 3])

    def _turn(self, frame: int) -> None:
        """Drag with Shift and with Alt until the orientation is aligned in the first view."""
        view = self.hand.views({})[0]
        camera = self.poses[view["camera"]][:, :3]
        middle = (view["box"][0] + view["box"][2] / 2, view["box"][1] + view["box"][3] / 2)
        true, symmetry = self.eye.rotation[frame], self.eye.mesh.symmetry
        for _ in range(5):
            if self._off(frame)[1] < _NEAR_DEG:
                return
            for held in ("Shift", "Alt"):
                now = self._shown()[:, :3]
                wanted = symmetry.nearest_equivalent(true, now)
                x, y, z = camera @ Rotation.from_matrix(wanted @ now.T).as_rotvec()
                by = _within((y / _TURN, -x / _TURN) if held == "Shift" else (z / _TURN, 0.0))
                if np.hypot(*by) > 2.0:
                    self.hand.drag((middle[0] - by[0] / 2, middle[1] - by[1] / 2), by, held)


def _within(by: Point) -> Point:
    """A drag limited to the reach of a hand, in whole pixels."""
    scale = min(1.0, _REACH / max(1e-9, float(np.hypot(*by))))
    return round(by[0] * scale), round(by[1] * scale)


def _start(box: list[float], at: Point, by: Point) -> Point:
    """Start of a drag: on the object where the view shows it, else in the view's centre."""
    x, y, wide, high = box
    inside = x + 4 < at[0] < x + wide - 4 and y + 4 < at[1] < y + high - 4
    return at if inside else (x + wide / 2 - by[0] / 4, y + high / 2 - by[1] / 4)


def correct_object(project: Project, name: str, hand: Hand) -> dict[str, float]:
    """Answer the questions, then place the object in lost frames, run, and repeat."""
    errors = measure(project, name)
    before = float(errors.lost.mean())
    print(f"{name}: lost in {int(errors.lost.sum())} of {len(errors.lost)} frames")
    if not before:
        raise UserError(f"{name}: the object is lost in no frame; there is nothing to correct")
    eye = Eye.of(project, name)
    placing = Placing(hand, eye)
    posed: set[int] = set()
    after = before
    for apart in APART:
        placed = _answer_questions(placing, errors)
        for frame in _frames_to_place(errors.lost & (eye.views > 0), posed | placed, apart):
            placing.place(frame)
            placed.add(frame)
        if not placed:
            continue
        posed |= placed
        seconds = hand.save_and_run()
        errors = measure(project, name)
        after = float(errors.lost.mean())
        print(
            f"{name}: {len(posed)} times placed, run in {seconds:.0f} s, then lost in frames "
            f"{np.flatnonzero(errors.lost).tolist()}"
        )
        if not errors.lost.any():
            break
    return {
        "annotate.object_lost_before": before,
        "annotate.object_lost_after": after,
        "annotate.object_poses": float(len(project.annotation(name).poses)),
    }


def _answer_questions(placing: Placing, errors: ObjectErrors) -> set[int]:
    """Answer the questions about the object; returns the frames in which it was placed."""
    hand, found = placing.hand, set()
    for _ in range(12):
        hand.key("q")
        asked = hand.see("window.annotate.questions.current")
        if asked is None or asked["kind"] not in ("lost", "turn"):
            break
        frame = int(asked["frame"])
        seen = placing.eye.views[frame] > 0
        if asked["kind"] == "turn":
            wrong = errors.lost[frame] or errors.rotation[frame] > _SEEN_DEG
            answer = "3" if not seen else "2" if wrong else "1"
        else:
            answer = "1" if seen else "2"
        hand.key(answer)
        placed = hand.see("document.body.dataset.mode") == "PoseEditor"
        print(f"  asked: {asked['words']} {asked['choices'][int(answer) - 1]['label']}")
        if placed:
            placing.place(frame)
            found.add(frame)
    hand.key("Escape")
    return found


def _frames_to_place(lost: np.ndarray, posed: set[int], apart: int) -> list[int]:
    """The ``lost`` frames (T,) without a pose within ``apart`` frames."""
    found: list[int] = []
    for frame in np.flatnonzero(lost).tolist():
        if all(abs(frame - other) >= apart for other in (*posed, *found)):
            found.append(frame)
    return found


# --- contact -----------------------------------------------------------------------------------


def correct_contact(project: Project, name: str, hand: Hand) -> dict[str, float]:
    """Drag, split, delete and add intervals on the timeline until they match the truth."""
    before, meshes_before, true = contact_figures(project, name)
    print(f"{name}: contact F1 {before:.3f}, of the fitted meshes {meshes_before:.3f}")
    edits = 0
    for part, wanted in true.items():
        while edits <= _MAX_EDITS and not _apply_edit(hand, part, wanted):
            edits += 1
    if edits > _MAX_EDITS:
        raise UserError(f"{name}: after {edits} edits contact is still not as it is seen")
    print(f"  {edits} edits of contact")
    seconds = hand.save_and_run()
    after, meshes_after, _ = contact_figures(project, name)
    print(f"{name}: run in {seconds:.0f} s, then {after:.3f} and {meshes_after:.3f}")
    return {
        "annotate.contact_f1_before": before, "annotate.contact_f1_after": after,
        "annotate.contact_meshes_f1_before": meshes_before,
        "annotate.contact_meshes_f1_after": meshes_after,
    }  # fmt: skip


def contact_figures(project: Project, name: str) -> tuple[float, float, dict[str, list[Interval]]]:
    """F1 of stated contact and of the fitted meshes' contact, and the true intervals by part.

    An interval is its first frame and the frame after its last.
    """
    found = SequenceMetrics.read(project.artefact(name, "metrics"))
    true = found.values["truth/contact_region"]
    intervals = {
        part: [(a, b + 1) for a, b in runs(true[:, r])] for r, part in enumerate(METRIC_REGIONS)
    }
    stated = stated_contact_figures([found])["contact_detected_f1"]
    meshes = figures.truth_figures([found], "joint")["contact_region_f1"]
    return float(stated), float(meshes), intervals


def _apply_edit(hand: Hand, part: str, wanted: list[Interval]) -> bool:
    """Apply one edit to a part's intervals; True where they all match."""
    shown = _bars(hand, part)
    for one in shown:
        if one in wanted:
            continue
        meant = [true for true in wanted if _meet(one, true)]
        others = [bar for bar in shown if bar != one and meant and _meet(bar, meant[0])]
        if not meant or (len(meant) == 1 and others):
            hand.click(_bar(part, one))
            hand.key("Delete")
        elif len(meant) > 1:
            hand.click(_bar(part, one))
            hand.go_to(meant[0][1])
            hand.key("k")
        elif one[0] != meant[0][0]:
            _drag_end(hand, part, one, "left", meant[0][0] - one[0])
        else:
            _drag_end(hand, part, one, "right", meant[0][1] - one[1])
        return False
    for true in wanted:
        if true not in shown:
            hand.go_to(true[0])
            hand.choose("#part", part)
            return False
    return True


def _bars(hand: Hand, part: str) -> list[Interval]:
    """The part's intervals on the timeline."""
    labels = hand.see(
        "(part) => [...document.querySelectorAll(`[data-part='${part}'] .bar`)]"
        ".map((bar) => bar.dataset.interval)",
        part,
    )
    ends = [str(one).split(":")[1:] for one in labels]
    return sorted((int(start), int(end)) for start, end in ends)


def _meet(one: Interval, other: Interval) -> bool:
    return one[0] < other[1] and other[0] < one[1]


def _bar(part: str, one: Interval) -> str:
    return f'[data-interval="{part}:{one[0]}:{one[1]}"]'


def _drag_end(hand: Hand, part: str, one: Interval, end: str, frames: int) -> None:
    page = hand.visit.page
    page.locator(_bar(part, one)).scroll_into_view_if_needed()
    box = page.locator(f"{_bar(part, one)} .end.{end}").bounding_box()
    lane = page.locator(f'[data-part="{part}"] .lane').bounding_box()
    if box is None or lane is None:
        raise UserError(f"the timeline shows no interval of {part}")
    by = frames * lane["width"] / int(hand.see("window.annotate.info.frames"))
    hand.drag((box["x"] + box["width"] / 2, box["y"] + box["height"] / 2), (by, 0.0))


# --- all of it ---------------------------------------------------------------------------------


def compute_without_annotations(project: Project, cores: int) -> None:
    """Compute the results of both recordings without annotations.

    Raises UserError if annotations are outside the results folder, as a user's would be.
    """
    wanted = []
    for name in (OBJECT, CONTACT):
        if name not in project.sequences:
            raise UserError(f"{project.path}: there is no sequence {name!r}")
        path = project.annotation_path(name)
        if not path.resolve().is_relative_to(project.results.resolve()):
            raise UserError(f"{path}: only annotations among the results are taken away")
        for old in (path, answers_path(path)):
            old.unlink(missing_ok=True)
        wanted += targets(project, name)
    command = [sys.executable, "-m", "intercap_core.cli", "run", str(project.path)]
    command += [*(["--cores", str(cores)] if cores else []), "--", *wanted]
    print("results without annotations are made, where they are not there")
    if subprocess.run(command, check=False).returncode:
        raise UserError(f"{project.path}: the run without annotations failed")


def measure_sessions(settings: Path, cores: int) -> dict[str, float]:
    """Figures of both sessions and of the page; figures of a failed session are omitted."""
    from playwright.sync_api import Error

    project = load_project(settings)
    compute_without_annotations(project, cores)
    found: dict[str, float] = {}
    actions, seconds, whole = 0, 0.0, True
    for name, correct in ((OBJECT, correct_object), (CONTACT, correct_contact)):
        try:
            with annotate_page.served_page(settings, name, cores) as shown:
                shown.page.wait_for_timeout(1000)
                hand = Hand(shown)
                found |= correct(project, name, hand)
                actions, seconds = actions + hand.actions, seconds + hand.seconds
        except (UserError, TimeoutError, Error) as error:
            print(f"{name}: was not corrected: {error}", file=sys.stderr)
            whole = False
    if whole:
        found |= {"annotate.clicks": float(actions), "annotate.seconds": round(seconds, 1)}
    try:
        found |= annotate_page.measure(settings, OBJECT, 20)
    except (UserError, TimeoutError, Error, SystemExit) as error:
        print(f"the page's steps were not measured: {error}", file=sys.stderr)
    return found


def main() -> None:
    """Run both sessions, print the figures and add them to the output."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    settings = Path("config/annotate/config.yaml")
    parser.add_argument("settings", type=Path, nargs="?", default=settings)
    parser.add_argument("--output", type=Path, default=Path("results/evaluation.json"))
    parser.add_argument("--cores", type=int, default=0, help="of runs; 0 = all")
    options = parser.parse_args()
    with exit_on_user_error():
        found = measure_sessions(options.settings, options.cores)
        replace_figures(options.output, found, ("annotate.",))
    for name, value in found.items():
        print(f"{name}: {value:.4g}")
    if "annotate.clicks" not in found:
        raise SystemExit(1)


if __name__ == "__main__":
    main()
