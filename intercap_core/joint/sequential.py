"""Where the joint fit starts: what the two sequential stages, body and object, have found."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians

import numpy as np

from intercap_core.artefacts import Artefact
from intercap_core.body.parameters import TRANSL
from intercap_core.geometry.camera.transforms import apply_step, rigid
from intercap_core.geometry.solve.time_series import rigid_velocity
from intercap_core.joint.state import State

# A tracked pose is never surer than this, rad and metres: the meshes differ from the things
# themselves. Tuned on the studio.
TRACK_FLOOR_TURN = radians(0.05)
TRACK_FLOOR_SHIFT = 0.0005
# What is added where different poses explain a frame equally well, rad and metres: it is nearly
# always the rotation (on which side the handle is). Tuned on the studio.
AMBIGUOUS_TURN = radians(10.0)
AMBIGUOUS_SHIFT = 0.002
BRIDGED_OBJECT_TURN = 0.5  # rad; tuned on the studio
BRIDGED_OBJECT_SHIFT = 0.15  # metres; tuned on the studio
# Standard deviation of the object's position where the track is lost, metres: contact detection
# then learns nothing from the distance. Tuned on the studio.
UNTRACKED_SIGMA = 0.5

# Standard deviations (6,) of turn and shift, rad and metres.
_FLOOR = np.repeat([TRACK_FLOOR_TURN, TRACK_FLOOR_SHIFT], 3)
_BRIDGED = np.repeat([BRIDGED_OBJECT_TURN, BRIDGED_OBJECT_SHIFT], 3)
_AMBIGUOUS = np.repeat([AMBIGUOUS_TURN, AMBIGUOUS_SHIFT], 3)
# In the order of `BodyParameters`.
_POSE = (
    "global_orient",
    "body_pose",
    "jaw_pose",
    "leye_pose",
    "reye_pose",
    "left_hand_pose",
    "right_hand_pose",
    "transl",
)


@dataclass(frozen=True)
class TrackedPoses:
    """``rotation`` (T, 3, 3), ``translation`` (T, 3) and ``information`` (T, 6, 6), the inverse
    covariance of (turn on the left, shift).

    ``twist`` (T, 6) is the motion in a second, ``share`` (T, C) each camera's part in the evidence
    for a pose and ``time_offset`` (C,) what the tracker took the cameras' to be, seconds. Frames
    (T,) that are ``seen`` and in which it is ``resting``, their ``times``, seconds; ``spread``
    (T, 6) the variance of a pose, beside what the images of a frame leave open.
    """

    rotation: np.ndarray
    translation: np.ndarray
    information: np.ndarray
    twist: np.ndarray
    share: np.ndarray
    time_offset: np.ndarray
    seen: np.ndarray
    resting: np.ndarray
    times: np.ndarray
    spread: np.ndarray

    @classmethod
    def from_track(
        cls,
        rotation: np.ndarray,
        translation: np.ndarray,
        covariance: np.ndarray,
        lost: np.ndarray,
        ambiguous: np.ndarray,
        resting: np.ndarray,
        *,
        carried: np.ndarray,
        visible: np.ndarray,
        times: np.ndarray,
        time_offset: np.ndarray,
    ) -> TrackedPoses:
        """Take over an object track whose lost frames are interpolated.

        ``covariance`` (T, 6, 6) around these poses alone; ``lost``, ``ambiguous``, ``resting`` and
        ``carried`` (T,), of which the images show nothing; ``visible`` (T, C) the views that show
        the object; ``times`` (T,) and ``time_offset`` (C,) seconds.
        """
        tracked = ~lost & np.isfinite(covariance).all(axis=(1, 2))
        total = np.where(tracked[:, None, None], covariance, 0.0)
        other = (ambiguous & ~carried)[:, None]  # of what is carried, the covariance says it
        floor = np.where(other, np.hypot(_FLOOR, _AMBIGUOUS), _FLOOR)
        spread = np.where(tracked[:, None], floor, _BRIDGED) ** 2
        total += np.eye(6) * spread[:, None, :]
        twist = rigid_velocity(rigid(rotation, translation), ~lost, times)
        twist[resting] = 0
        share = visible / np.maximum(visible.sum(axis=1, keepdims=True), 1)
        return cls(
            rotation,
            translation,
            np.linalg.inv(total),
            twist,
            share,
            time_offset,
            tracked & ~carried,
            resting,
            times,
            spread,
        )

    def at(self, time_offset: np.ndarray) -> TrackedPoses:
        """The poses if the cameras had these offsets (C,), seconds: earlier by the mean change of
        the views that show the object."""
        late = self.share @ (time_offset - self.time_offset)
        poses = apply_step(rigid(self.rotation, self.translation), -late[:, None] * self.twist)
        return replace(
            self, rotation=poses[:, :3, :3], translation=poses[:, :3, 3], time_offset=time_offset
        )


@dataclass(frozen=True)
class Trust:
    """Frames in which the sequential fits are trusted.

    ``body`` and ``object_`` (T,) flags, ``still`` (T-1,) the steps over which the object rests.
    """

    body: np.ndarray
    object_: np.ndarray
    still: np.ndarray


@dataclass(frozen=True)
class Flags:
    """Frames (T,) that a sequential fit has flagged.

    ``filled``: the body was not seen well enough; ``uncertain``: the body is not determined by what
    was seen; ``lost``, ``ambiguous`` and ``carried``: the object track's, where an object is named.
    ``hands`` (T, 2), left and right: the hand is not determined by what was seen, or not fitted at
    all; no reason to flag the frame.
    """

    filled: np.ndarray
    uncertain: np.ndarray
    lost: np.ndarray
    ambiguous: np.ndarray
    carried: np.ndarray
    hands: np.ndarray


@dataclass(frozen=True)
class SequentialFits:
    """One state of body and object, and how far it is to be trusted.

    ``state`` has the mean shape. ``tracked`` is None where there is no object: the track is lost in
    every frame, and the state's poses of the object are NaN. ``joint_sigma`` (T, 55) and
    ``object_sigma`` (T,) are stated standard deviations of positions, metres.
    """

    state: State
    tracked: TrackedPoses | None
    trust: Trust
    flags: Flags
    joint_sigma: np.ndarray
    object_sigma: np.ndarray

    @classmethod
    def read(cls, body: Artefact, track: Artefact, scene: Artefact) -> SequentialFits:
        """Read body_fit.h5, object_track.h5 and, for the cameras' times, scene.h5."""
        state = _state(body, track)
        failed, lost = body["failed"], track["lost"]
        named = bool(track.attributes["object"])
        filled = failed | body["bridged"]
        flags = Flags(
            filled=filled,
            uncertain=body["uncertain"],
            lost=lost & named,
            ambiguous=track["ambiguous"],
            carried=_carried(track),
            hands=_undetermined_hands(body) | filled[:, None],
        )
        resting = track["resting"]
        tracked = None
        if lost.all():
            state = state.without_object()
        else:
            tracked = TrackedPoses.from_track(
                state.rotation,
                state.translation,
                track["covariance"] - track["spread"],
                lost,
                flags.ambiguous,
                resting,
                carried=flags.carried,
                visible=(track["candidate"] >= 0) | np.isfinite(track["depth_residual"]),
                times=scene["times"],
                time_offset=scene["time_offset"],
            )
        sigma = np.sqrt(np.trace(track["covariance"][:, 3:, 3:], axis1=1, axis2=2) / 3)
        return cls(
            state=state,
            tracked=tracked,
            trust=Trust(~failed, ~lost, resting[1:] & resting[:-1]),
            flags=flags,
            joint_sigma=body["joint_sigma"].astype(float),
            object_sigma=np.where(lost | ~np.isfinite(sigma), UNTRACKED_SIGMA, sigma),
        )


def _carried(track: Artefact) -> np.ndarray:
    """Frames (T,) bool whose pose of the object follows from annotated ones alone."""
    return np.asarray(track["carried"] if "carried" in track else np.zeros_like(track["lost"]))


def _undetermined_hands(body: Artefact) -> np.ndarray:
    """Left and right hands (T, 2) bool that the body fit says nothing determines."""
    parts = body.text("part_names")
    hands = [parts.index(f"{side}_hand") for side in ("left", "right")]
    return np.asarray(body["undetermined"][:, hands])


def pose_vector(body: Artefact) -> np.ndarray:
    """Pose and translation (T, 168) of a body_fit or joint artefact."""
    vector = np.concatenate([body[name] for name in _POSE], axis=1).astype(float)
    assert vector.shape[1] == TRANSL.stop
    return vector


def _state(body: Artefact, track: Artefact) -> State:
    """The sequential fits as one state, with the mean shape."""
    vector = pose_vector(body)
    betas = body["betas"].astype(float)
    fitted = ~body["failed"]
    shape = betas[fitted].mean(axis=0) if fitted.any() else betas.mean(axis=0)
    rotation, translation = (track[name].astype(float) for name in ("rotation", "translation"))
    return State(vector, shape, body["expression"].astype(float), rotation, translation)
