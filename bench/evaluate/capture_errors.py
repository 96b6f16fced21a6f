"""Errors of the scene artefact against truth: camera poses, time offsets, slips, floor, depth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from intercap_core import artefacts
from intercap_core.errors import UserError
from intercap_core.evaluation.known import Figures, finite, over_known
from intercap_core.evaluation.scene_errors import displacement, rig_centre
from intercap_core.evaluation.truth import match_times
from intercap_core.geometry.solve.robust import SIGMA_PER_MAD
from intercap_core.schemas import FRAMES, SCENE, TRUTH

# Radius of the capture area on the floor around the rig's centre (docs/evaluation.md).
CAPTURE_RADIUS_M = 1.5


@dataclass(frozen=True)
class Slip:
    """A run of images of one camera that all lag by the same number of frame sets."""

    camera: int
    """Camera index."""
    first: int
    """First frame set."""
    last: int
    """Last frame set, inclusive."""
    frames: int
    """Lag in frame sets; positive = late."""


class SlipCounts(NamedTuple):
    """Detection of slips, counted by event and by image."""

    found: int
    """True slips that were detected."""
    missed: int
    """True slips that were not detected."""
    false: int
    """Detections without a true slip."""
    images_wrong: int
    """Images whose slip is not the true one."""
    images: int
    """All images."""


@dataclass(frozen=True, eq=False)
class CaptureErrors:
    """Errors of one capture's scene artefact; NaN = unknown or not estimated.

    Cameras without an image, or without depth, are excluded.
    """

    room: str
    """Kind of room; "bare" = nothing but the floor."""
    before: np.ndarray
    """(C-1,) displacement by the given extrinsics, metres, without the master."""
    after: np.ndarray
    """(C-1,) displacement by the refined extrinsics, metres."""
    offset: np.ndarray
    """(C-1,) errors of the time offsets relative to the master, seconds."""
    offset_normalised: np.ndarray
    """(C-1,) ``offset`` over its stated standard deviation."""
    slips: SlipCounts
    """Detection of images that are whole frames late."""
    ground_m: float
    """Mean height error of the floor over the capture area, metres."""
    ground_deg: float
    """Angle between the estimated and the true floor normal, degrees."""
    depth_bias: np.ndarray
    """(C,) errors of the depth biases, metres."""


def offset_errors(offset: np.ndarray, true_offset: np.ndarray, master: int) -> np.ndarray:
    """Errors (C-1,) of the offsets (C,) relative to the master, without the master, seconds."""
    error = (offset - offset[master]) - (true_offset - true_offset[master])
    return np.delete(error, master)


def slip_events(slip: np.ndarray, available: np.ndarray) -> list[Slip]:
    """Runs of equal nonzero slips of each camera.

    Frame sets without an image of the camera neither belong to a run nor end it.

    Args:
        slip: (T, C) lag of each image in frame sets.
        available: (T, C) bool, the set has an image of the camera.
    """
    events = []
    for camera in range(slip.shape[1]):
        images = np.flatnonzero(available[:, camera])
        values = slip[images, camera]
        starts = np.flatnonzero(np.diff(values, prepend=values[:1] + 1))
        ends = np.append(starts, len(values))[1:]
        for start, end in zip(starts, ends, strict=True):
            if values[start]:
                first, last = int(images[start]), int(images[end - 1])
                events.append(Slip(camera, first, last, int(values[start])))
    return events


def compare_slips(slip: np.ndarray, true_slip: np.ndarray, available: np.ndarray) -> SlipCounts:
    """Compare slips (T, C) by event, within the mask ``available`` (T, C) of the images.

    Two events match if they are of the same camera, have the same lag and overlap in time. A true
    event without a match is missed, a detected event without a match is false.
    """
    true, found = slip_events(true_slip, available), slip_events(slip, available)
    detected = sum(any(_match(t, f) for f in found) for t in true)
    return SlipCounts(
        found=detected,
        missed=len(true) - detected,
        false=sum(not any(_match(t, f) for t in true) for f in found),
        images_wrong=int((slip != true_slip)[available].sum()),
        images=int(available.sum()),
    )


def ground_error(
    point: np.ndarray,
    normal: np.ndarray,
    true_normal: np.ndarray,
    true_offset: float,
    centre: np.ndarray,
) -> tuple[float, float]:
    """Mean absolute height error over the capture area, metres, and angle of the normals, degrees.

    NaN if no floor was found. Both normals are unit vectors that point up.

    Args:
        point, normal: (3,) the estimated floor.
        true_normal, true_offset: the true floor, true_normal . x + true_offset = 0.
        centre: (3,) the capture area is the disc of ``CAPTURE_RADIUS_M`` below this point.
    """
    if not np.isfinite([*point, *normal]).all():
        return float("nan"), float("nan")
    foot = centre - (true_normal @ centre + true_offset) * true_normal
    across = np.cross(true_normal, np.eye(3)[np.argmin(np.abs(true_normal))])
    across /= np.linalg.norm(across)
    along = np.cross(true_normal, across)
    # 40 rings of equal area, 90 points each: all points have the same weight
    radius = CAPTURE_RADIUS_M * np.sqrt((np.arange(40) + 0.5) / 40)
    angle = 2 * np.pi * np.arange(90) / 90
    u, v = (np.outer(radius, f(angle)).ravel()[:, None] for f in (np.cos, np.sin))
    places = foot + u * across + v * along
    height = (point - places) @ normal / (true_normal @ normal)
    sine, cosine = np.linalg.norm(np.cross(normal, true_normal)), normal @ true_normal
    return float(np.abs(height).mean()), float(np.degrees(np.arctan2(sine, cosine)))


def measure(frames: Path, scene: Path, truth: Path) -> CaptureErrors:
    """Compare the scene artefact of one capture with its truth.

    Raises UserError if an artefact cannot be read or the truth is of another recording.
    """
    with (
        artefacts.read(frames, FRAMES) as recorded,
        artefacts.read(scene, SCENE) as found,
        artefacts.read(truth, TRUTH) as true,
    ):
        names, true_names = found.text("camera_names"), true.text("camera_names")
        at = match_times(truth, true["times"], found["times"], float(found.attributes["fps"]))
        unknown = sorted(set(names) - set(true_names))
        if unknown:
            raise UserError(
                f"{truth}: has no camera {unknown[0]!r}, which {scene} has; expected "
                "the truth of the same recording"
            )
        order = [true_names.index(name) for name in names]
        available = recorded["colour_index"] >= 0
        seen = available.any(0)
        measured = (recorded["depth_index"] >= 0).any(0)
        master = names.index(str(found.attributes["master"]))
        others = np.delete(seen, master)
        true_poses = true["master_from_colour"][order]
        true_offset = true["time_offset"][order]
        offset = offset_errors(found["time_offset"], true_offset, master)[others]
        sigma = np.delete(found["time_offset_sigma"], master)[others]
        before, after = (
            np.delete(displacement(found[key], true_poses, master), master)[others]
            for key in ("master_from_colour_start", "master_from_colour")
        )
        height, angle = ground_error(
            found["ground_point"],
            found["ground_normal"],
            true["ground_normal"],
            float(true.attributes["ground_offset"]),
            rig_centre(true_poses),
        )
        return CaptureErrors(
            room=str(true.attributes.get("room", "")),
            before=before,
            after=after,
            offset=offset,
            offset_normalised=offset / np.where(sigma > 0, sigma, np.nan),
            slips=compare_slips(found["slip"], true["slip"][at][:, order], available),
            ground_m=height,
            ground_deg=angle,
            depth_bias=(found["depth_bias"] - _true_bias(true)[order])[measured],
        )


def figures(captures: Sequence[CaptureErrors]) -> Figures:
    """Figures over several captures, in millimetres, milliseconds and degrees.

    Extrinsics are separate for rooms with furniture and for bare floors (``floor_only``). The
    shares of improved and worse captures are over both; a capture counts by the mean over its
    cameras. ``offset_normalised_median`` is 1 if the stated deviations are calibrated.
    """
    if not captures:
        return {}
    found: Figures = {"captures": float(len(captures))}
    for name, bare in (("extrinsics", False), ("extrinsics_floor_only", True)):
        group = [c for c in captures if (c.room == "bare") == bare and len(c.after)]
        before, after = (1e3 * _joined([getattr(c, n) for c in group]) for n in ("before", "after"))
        found |= {
            f"{name}_before_mm": over_known(np.mean, before),
            f"{name}_mm" if bare else f"{name}_after_mm": over_known(np.mean, after),
            f"{name}_worst_capture_mm": 1e3 * over_known(np.max, [c.after.mean() for c in group]),
            f"{name}_worst_camera_mm": over_known(np.max, after),
        }
    change = np.array([c.after.mean() - c.before.mean() for c in captures if len(c.after)])
    offset = np.abs(_joined([c.offset for c in captures]))
    normalised = np.abs(_joined([c.offset_normalised for c in captures]))
    slips = SlipCounts(*np.sum([c.slips for c in captures], axis=0).tolist())
    height = np.array([c.ground_m for c in captures])
    bias = np.abs(_joined([c.depth_bias for c in captures]))
    return finite(
        found
        | {
            "extrinsics_improved_share": over_known(np.mean, change < -1e-6),
            "extrinsics_worse_share": over_known(np.mean, change > 1e-6),
            "offset_error_ms": 1e3 * over_known(np.mean, offset),
            "offset_error_worst_ms": 1e3 * over_known(np.max, offset),
            "offset_normalised_median": SIGMA_PER_MAD * over_known(np.nanmedian, normalised),
            "offset_estimated_share": over_known(np.mean, np.isfinite(normalised)),
            "slips_true": float(slips.found + slips.missed),
            "slips_missed": float(slips.missed),
            "slips_false": float(slips.false),
            "slips_images_wrong_share": slips.images_wrong / max(slips.images, 1),
            "ground_missing_share": float(np.isnan(height).mean()),
            "ground_error_mm": 1e3 * over_known(np.nanmean, height),
            "ground_error_worst_mm": 1e3 * over_known(np.nanmax, height),
            "ground_error_deg": over_known(np.nanmean, [c.ground_deg for c in captures]),
            "depth_bias_error_mm": 1e3 * over_known(np.nanmean, bias),
        }
    )


def _true_bias(truth: artefacts.Artefact) -> np.ndarray:
    """Depth biases (C,), NaN if the truth does not state them."""
    if "depth_bias" in truth:
        return truth["depth_bias"]
    return np.full(len(truth["time_offset"]), np.nan)


def _match(a: Slip, b: Slip) -> bool:
    return a.camera == b.camera and a.frames == b.frames and a.first <= b.last and b.first <= a.last


def _joined(parts: Sequence[np.ndarray]) -> np.ndarray:
    return np.concatenate([np.zeros(0), *parts])
