"""The stage of one capture: subject, object, room and cameras, and their state at any time.

Stage frame: z up, the floor at z = 0, metres. Scripts have a frame of their own
(``stage_from_script``); the cameras' poses are in the master's colour frame.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.model import BodyModel
from intercap_core.config import StudioCapture, StudioSettings
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.geometry.rigid.surfaces import vertex_normals
from intercap_core.studio.capture_folder import SWAPPED
from intercap_core.studio.interactions import interaction_named
from intercap_core.studio.layouts import FOLDERS, camera_names
from intercap_core.studio.mkv import KINECT_RATES
from intercap_core.studio.motion import PersonState, Puppet
from intercap_core.studio.noise import NoiseSource
from intercap_core.studio.objects import TrueObject, object_colours, press_out, true_mesh
from intercap_core.studio.passer_by import PasserBy
from intercap_core.studio.rig import Failures, StudioRig, build_rig, started_apart
from intercap_core.studio.room import Furnishing, build_room
from intercap_core.studio.skeleton import about_z
from intercap_core.studio.subjects import Subject, build_names, in_heavy_shoes, subject_names

LOOKS = ("mesh", "plain", "printed")  # of the object, equally likely

# Faults that recordings of any layout can have.
ANY_LAYOUT = frozenset({"dead_half", "no_depth", "zero_depth", "no_overlap"})


@dataclass(frozen=True)
class StageState(PersonState):
    """State of subject and object at N moments."""

    tips: np.ndarray
    """(N, 10, 3) fingertips, thumb to little finger, left then right."""
    stage_from_object: np.ndarray
    """(N, 4, 4) object poses; NaN without an object."""


class StudioStage:
    """The true state of a capture.

    Raises UserError for a subject, interaction or object that does not fit.
    """

    def __init__(
        self, capture: StudioCapture, settings: StudioSettings, entry: ObjectEntry | None
    ) -> None:
        check_capture(capture, settings, None if entry is None else entry.name)
        self.depth_mode, self.has_depth = settings.depth_mode, capture.depth
        self.depth_errors = capture.depth_errors
        self.frames, self.fps = capture.frames, settings.fps
        self.duration = capture.frames / settings.fps
        self.noise = NoiseSource(
            capture.seed,
            settings.noise,
            settings.noise_family,
            settings.fps,
            capture.redrawn_detections,
        )
        self.subject = Subject.load(capture.subject)
        if capture.shoes == "heavy":
            self.subject = in_heavy_shoes(self.subject, self.noise.rng("shoes"))
        self.puppet = Puppet(self.subject)
        self.prop = TrueObject.nothing() if entry is None else self._true_prop(entry, capture)
        corners = self.prop.vertices
        self.bounds = np.stack([corners.min(0, initial=np.inf), corners.max(0, initial=-np.inf)])
        size = float(np.ptp(self.bounds, 0).max())
        kind = interaction_named(capture.interaction)
        self.interaction = kind(self.puppet, self.prop, self.noise.rng("script"))
        rng = self.noise.rng("room")
        self.stage_from_script = _placed(rng, self.interaction.centre)
        self.rig: StudioRig = build_rig(
            self.noise.rng("rig"), capture, settings, camera_names(capture.layout, settings.cameras)
        )
        if capture.starts_apart:
            apart = self.noise.rng("starts")
            self.rig = started_apart(self.rig, apart, capture.starts_apart, settings.fps)
        self.every = [capture.every.get(name, 1) for name in self.rig.true.names]
        self.failures = Failures.draw(self.noise, capture, settings.cameras)
        furniture = [box.moved(self.stage_from_script) for box in self.interaction.furniture]
        is_bare = bool(rng.random() < 0.2)  # with room: random
        by_chance: Furnishing = "bare" if is_bare else "furnished"
        self.furnishing = by_chance if capture.room == "random" else capture.room
        eyes = invert(self.rig.master_from_stage) @ self.rig.true.master_from_colour
        self.room = build_room(
            rng,
            furniture,
            eyes[:, :2, 3],
            furnishing=self.furnishing,
            twin=(corners, self.prop.faces) if self.prop else None,
            hidden=self._highlight() if self.prop and size < 0.35 else None,  # metres
        )
        self.passer_by = None
        if capture.passer_by != "nobody":
            self.passer_by = self._passer_by(eyes[:, :2, 3], stands=capture.passer_by == "stands")

    def _true_prop(self, entry: ObjectEntry, capture: StudioCapture) -> TrueObject:
        """The object as it truly is in this capture."""
        vertices, faces, colours = true_mesh(entry, capture.seed)
        rng = self.noise.rng("look")
        by_chance = LOOKS[rng.integers(len(LOOKS))]
        look = by_chance if capture.look == "random" else capture.look
        return TrueObject(
            entry.name, vertices, faces, object_colours(look, vertices, colours / 255.0, rng)
        )

    def _passer_by(self, eyes: np.ndarray, *, stands: bool) -> PasserBy:
        """The second person; ``eyes``: (C, 2) places of the cameras on the floor."""
        _, pelvis, stage_from_object = self.play(self.set_times)
        prop = stage_from_object[:, :2, 3] if self.prop else np.full((1, 2), np.inf)
        return PasserBy(
            self.noise, self.subject, self.room, eyes, self.set_times, pelvis[:, :2], prop,
            stands=stands,
        )  # fmt: skip

    def _highlight(self) -> np.ndarray:
        """Place (2,) of the object on the floor plan at the highlight."""
        played = self.interaction.perform(np.array([self.interaction.highlight]))
        return (self.stage_from_script @ played.script_from_object[0])[:2, 3]

    @cached_property
    def set_times(self) -> np.ndarray:
        """Times (T,) of the sets, seconds since the first."""
        return np.arange(self.frames) / self.fps

    @cached_property
    def prop_normals(self) -> np.ndarray:
        """Smooth outward normals (Vo, 3) of the object, its frame."""
        return vertex_normals(self.prop.vertices, self.prop.faces)

    @cached_property
    def fitted(self) -> BodyModel:
        """The open body, for the names of its points."""
        return BodyModel.load()

    def play(self, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Play the script at recording times (N,), seconds since the first set.

        Returns joint rotations (N, 55, 3, 3), the pelvis (N, 3) and object poses (N, 4, 4) in the
        stage frame.
        """
        played = self.interaction.perform(self.interaction.script_times(times, self.duration))
        place = self.stage_from_script
        pelvis = apply(place, played.pelvis)
        return place[:3, :3] @ played.world, pelvis, place @ played.script_from_object

    def at(self, times: np.ndarray) -> StageState:
        """State at recording times (N,), seconds since the first set."""
        world, pelvis, stage_from_object = self.play(times)
        posed = self.puppet.skin(world, pelvis)
        body, clothed = posed.vertices.copy(), posed.clothed.copy()
        for n in range(len(times) if self.prop else 0):
            for points in (body, clothed):
                points[n] = press_out(
                    points[n], self.prop.surface, stage_from_object[n], self.bounds
                )
        order = [4, 0, 1, 3, 2]  # thumb, index, middle, ring, little finger
        tips = posed.tips[:, [*order, *(5 + i for i in order)]]
        pelvis = world[:, JOINT_INDEX["pelvis"]]
        return StageState(body, clothed, posed.joints, pelvis, tips, stage_from_object)

    def keypoints(self, moment: PersonState) -> np.ndarray:
        """True keypoints (N, 135, 3) in the stage. All people have the same mesh topology."""
        chart = self.fitted.keypoint_map
        corners = self.subject.faces[self.subject.fitted_face[chart.vertex_ids]]
        weights = self.subject.fitted_bary[chart.vertex_ids]
        seen = np.einsum("nvkc,vk->nvc", moment.body[:, corners], weights)
        return chart.matrix @ np.concatenate([seen, moment.joints], 1)

    def to_master(self, points: np.ndarray) -> np.ndarray:
        """Points (..., 3) of the stage in the master's colour frame."""
        pose = self.rig.master_from_stage
        return points @ pose[:3, :3].T + pose[:3, 3]


def check_capture(
    capture: StudioCapture, settings: StudioSettings, object_name: str | None
) -> None:
    """Raise UserError for a capture that the studio cannot play."""
    kind, people = interaction_named(capture.interaction), (*subject_names(), *build_names())
    layout, wanted = capture.layout, kind.object_class
    faults, cameras, frames = capture.faults, settings.cameras, capture.frames
    foreign = set(faults) - ANY_LAYOUT - FOLDERS[layout].own_faults
    for is_wrong, text in (
        (
            (object_name or "") != wanted,
            f"interaction {capture.interaction!r} needs "
            f"{f'object {wanted!r}' if wanted else 'no object'}, the sequence has "
            f"{repr(object_name) if object_name else 'none'}; correct the sequence's object",
        ),
        (
            capture.shoes != "plain" and kind.feet_meet_object,
            f"in interaction {capture.interaction!r} bare soles meet the object, 'shoes' is "
            f"{capture.shoes!r}; set shoes: plain or another interaction",
        ),
        (
            settings.fps > max(KINECT_RATES) and layout != "plain",
            f"recordings of layout {layout!r} have at most {max(KINECT_RATES)} frames a second, "
            f"'fps' is {settings.fps}; set layout: plain or another fps",
        ),
        (
            capture.subject not in people,
            f"no subject {capture.subject!r}, there are {', '.join(people)}; correct 'subject' of "
            "the capture",
        ),
        (
            capture.video and layout != "plain",
            f"recordings of layout {layout!r} are no videos; take 'video' out or set layout: plain",
        ),
        (
            capture.keypoints == "mediapipe" and layout not in ("k4a", "plain"),
            f"keypoints in recordings of layout {layout!r} are simulated; take 'keypoints' out or "
            "set layout: plain",
        ),
        (
            capture.camera == "hand_held" and (settings.cameras != 1 or not capture.depth),
            f"a hand-held camera is alone and has depth; 'cameras' is {settings.cameras}, 'depth' "
            f"is {str(capture.depth).lower()}; set cameras: 1 and depth: true",
        ),
        (
            capture.camera == "hand_held" and not wanted,
            f"interaction {capture.interaction!r} has no object for a hand-held camera; choose "
            "another interaction",
        ),
        (
            capture.sound and not capture.video,
            "only videos carry sound; take 'sound' out or set video: true and layout: plain",
        ),
        (
            foreign,
            f"recordings of layout {layout!r} cannot have fault {min(foreign, default='')}; take "
            "the fault out or choose another layout",
        ),
        (
            "swapped_lenses" in faults and cameras <= max(SWAPPED),
            f"fault swapped_lenses is of cameras 4 and 5, 'cameras' is {cameras}; use more",
        ),
        (
            faults and cameras < 2,
            f"faults {', '.join(faults)} need a second camera, 'cameras' is {cameras}; use more "
            "cameras or no faults",
        ),
        (
            {"dead_half", "backwards_clock"} & set(faults) and frames < 4,
            f"faults dead_half and backwards_clock need 4 frames, 'frames' is {frames}; make the "
            "capture longer or take the fault out",
        ),
    ):
        if is_wrong:
            raise UserError(f"studio: {text}")
    _check_rates(capture, settings)


def _check_rates(capture: StudioCapture, settings: StudioSettings) -> None:
    """Raise UserError if a camera cannot record every n-th frame set."""
    names = camera_names(capture.layout, settings.cameras)
    rates = KINECT_RATES if capture.layout == "k4a" else range(1, settings.fps)
    for name, every in capture.every.items():
        for is_wrong, text in (
            (
                name not in names,
                f"'every' names camera {name!r}, the cameras are {', '.join(names)}; correct it",
            ),
            (
                capture.layout not in ("plain", "k4a"),
                f"cameras of layout {capture.layout!r} all have one rate; take 'every' out or set "
                "layout: plain",
            ),
            (
                settings.fps % every or settings.fps // every not in rates,
                f"camera {name!r} would have {settings.fps / every:g} frames a second, expected "
                f"one of {', '.join(map(str, KINECT_RATES))} or, in layout plain, a whole number; "
                "correct 'every'",
            ),
        ):
            if is_wrong:
                raise UserError(f"studio: {text}")


def _placed(rng: np.random.Generator, centre: tuple[float, float]) -> np.ndarray:
    """stage_from_script (4, 4): any heading, the action's ``centre`` near the stage's middle."""
    heading = rng.uniform(0, 2 * np.pi)
    rotation = about_z(heading)
    shift = rng.normal(0, 0.12, 2) - rotation[:2, :2] @ centre
    return rigid(rotation, np.array([*shift, 0.0]))
