"""Results of the two sequential fits, body and object, at which the joint fit starts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import radians

import numpy as np

from intercap_core.artefacts import Artefact
from intercap_core.body.joints import FIRST_FINGER
from intercap_core.body.parameters import POSE_COLUMNS, TRANSL
from intercap_core.body_fit.quality import LARGEST_HAND_SIGMA_M
from intercap_core.geometry.camera.transforms import rigid
from intercap_core.joint.hand_track import smooth_hands
from intercap_core.joint.state import State

POSE_NAMES = (*POSE_COLUMNS, "transl")
"""Datasets with a frame's pose and translation, in the order of the parameter vector."""


@dataclass(frozen=True)
class TrackMarks:
    """Masks (T,) of frames of the object track."""

    lost: np.ndarray  # The object is lost; its pose is interpolated
    ambiguous: np.ndarray  # Different poses explain the frame equally well
    carried: np.ndarray  # The images show nothing: the pose follows from annotated poses alone
    resting: np.ndarray  # The object rests


@dataclass(frozen=True)
class TrackedPoses:
    """The object track as Gaussians, one per frame."""

    rotation: np.ndarray  # (T, 3, 3) of master_from_object
    translation: np.ndarray  # (T, 3) of master_from_object, metres
    information: np.ndarray  # (T, 6, 6) inverse covariance of turn (left) and shift
    share: np.ndarray  # (T, C) 1 / n for each of the n cameras that show the object, else 0
    seen: np.ndarray  # (T,) frames whose images determine the pose
    resting: np.ndarray  # (T,) frames in which the object rests
    times: np.ndarray  # (T,) seconds
    spread: np.ndarray  # (T, 6) variance added to the images': mesh, ambiguity, interpolation

    def window(self, frames: slice) -> TrackedPoses:
        """The same of some frames."""
        return replace(self, **{name: value[frames] for name, value in vars(self).items()})

    @classmethod
    def from_track(
        cls,
        poses: np.ndarray,
        covariance: np.ndarray,
        marks: TrackMarks,
        *,
        visible: np.ndarray,
        times: np.ndarray,
    ) -> TrackedPoses:
        """Build from the arrays of an object track.

        Args:
            poses: (T, 4, 4) master_from_object.
            covariance: (T, 6, 6) around these poses, without the spread between rival poses.
            marks: lost frames and others.
            visible: (T, C) views that show the object.
            times: (T,) seconds.
        """
        # standard deviations of turn (rad) and shift (m) to add, tuned on the studio:
        # difference of mesh and object; ambiguity, mostly of the rotation; frames without a pose
        smallest = np.repeat([radians(0.05), 0.0005], 3)
        ambiguous = np.hypot(smallest, np.repeat([radians(10.0), 0.002], 3))
        interpolated = np.repeat([0.5, 0.15], 3)
        tracked = ~marks.lost & np.isfinite(covariance).all(axis=(1, 2))
        total = np.where(tracked[:, None, None], covariance, 0.0)
        # the covariance of a carried pose contains its ambiguity
        several = (marks.ambiguous & ~marks.carried)[:, None]
        added = np.where(several, ambiguous, smallest)
        spread = np.where(tracked[:, None], added, interpolated) ** 2
        total += np.eye(6) * spread[:, None, :]
        share = visible / np.maximum(visible.sum(axis=1, keepdims=True), 1)
        return cls(
            poses[:, :3, :3].copy(),
            poses[:, :3, 3].copy(),
            np.linalg.inv(total),
            share,
            tracked & ~marks.carried,
            marks.resting,
            times,
            spread,
        )


@dataclass(frozen=True)
class Trust:
    """Frames and steps in which the sequential fits are trusted."""

    body: np.ndarray  # (T,) frames with a fit of the body
    object_: np.ndarray  # (T,) frames in which the object is tracked
    still: np.ndarray  # (T - 1,) steps to the next frame over which the object rests

    def window(self, frames: slice) -> Trust:
        """The same of some frames."""
        steps = slice(frames.start, frames.stop - 1)
        return Trust(self.body[frames], self.object_[frames], self.still[steps])


@dataclass(frozen=True)
class SequentialFlags:
    """Frames that a sequential fit has flagged."""

    filled: np.ndarray  # (T,) the body was not seen well enough and is interpolated
    uncertain: np.ndarray  # (T,) the body is not determined by the images
    lost: np.ndarray  # (T,) the sequence has an object and its track is lost
    ambiguous: np.ndarray  # (T,) different poses of the object explain the frame
    carried: np.ndarray  # (T,) the object's pose follows from annotated poses alone
    hands: np.ndarray  # (T, 2) left, right hand is undetermined

    def window(self, frames: slice) -> SequentialFlags:
        """The same of some frames."""
        return SequentialFlags(**{name: mask[frames] for name, mask in vars(self).items()})


@dataclass(frozen=True)
class SequentialFits:
    """Body fit and object track as one state, and how far they are trusted."""

    state: State  # Both fits with the mean shape. Without an object its poses are NaN.
    tracked: TrackedPoses | None  # The object track; None if it is lost in all frames
    trust: Trust
    flags: SequentialFlags
    joint_sigma: np.ndarray  # (T, 55) stated standard deviations of the joints' positions, metres
    hand_sigma: np.ndarray  # (T, 2) those of the smoothed left and right hand, metres
    object_sigma: np.ndarray  # (T,) stated standard deviation of the object's position, metres

    def window(self, frames: slice) -> SequentialFits:
        """The fits of some frames."""
        return SequentialFits(
            state=self.state.window(frames),
            tracked=None if self.tracked is None else self.tracked.window(frames),
            trust=self.trust.window(frames),
            flags=self.flags.window(frames),
            joint_sigma=self.joint_sigma[frames],
            hand_sigma=self.hand_sigma[frames],
            object_sigma=self.object_sigma[frames],
        )

    @classmethod
    def read(cls, body: Artefact, track: Artefact, scene: Artefact) -> SequentialFits:
        """Read body_fit.h5, object_track.h5 and, for the cameras' times, scene.h5."""
        state = _state(body, track)
        failed, lost = body["failed"], track["lost"]
        named = bool(track.attributes["object"])
        filled = failed | body["bridged"]
        fingers = body["joint_sigma"][:, FIRST_FINGER:].astype(float).reshape(-1, 2, 15)
        state, hand_sigma = smooth_hands(
            state,
            body["joints"].astype(float),
            np.sqrt(np.square(fingers).mean(axis=2)),
            float(scene.attributes["fps"]),
        )
        carried = np.asarray(track["carried"] if "carried" in track else np.zeros_like(lost))
        marks = TrackMarks(lost, track["ambiguous"], carried, track["resting"])
        flags = SequentialFlags(
            filled=filled,
            uncertain=body["uncertain"],
            lost=lost & named,
            ambiguous=marks.ambiguous,
            carried=carried,
            hands=(hand_sigma > LARGEST_HAND_SIGMA_M) | filled[:, None],
        )
        tracked = None
        if lost.all():
            state = state.without_object()
        else:
            tracked = TrackedPoses.from_track(
                rigid(state.rotation, state.translation),
                track["covariance"] - track["spread"],
                marks,
                visible=(track["candidate"] >= 0) | np.isfinite(track["depth_residual"]),
                times=scene["times"],
            )
        sigma = np.sqrt(np.trace(track["covariance"][:, 3:, 3:], axis1=1, axis2=2) / 3)
        unknown = lost | ~np.isfinite(sigma)
        return cls(
            state=state,
            tracked=tracked,
            trust=Trust(~failed, ~lost, marks.resting[1:] & marks.resting[:-1]),
            flags=flags,
            joint_sigma=body["joint_sigma"].astype(float),
            hand_sigma=hand_sigma,
            # metres; so wide that distances say nothing about contact
            object_sigma=np.where(unknown, 0.5, sigma),
        )


def pose_vector(body: Artefact) -> np.ndarray:
    """Pose and translation (T, 168) of a body_fit or joint artefact."""
    vector = np.concatenate([body[name] for name in POSE_NAMES], axis=1).astype(float)
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
