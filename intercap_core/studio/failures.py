"""What fails in devices beyond noise: unsteady clocks, depth that is away for a moment, and faults
that a capture asks for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from intercap_core.config import LayoutName
from intercap_core.errors import UserError
from intercap_core.studio.capture_folder import SWAPPED
from intercap_core.studio.layouts import FOLDERS
from intercap_core.studio.noise import NoiseSource

CLOCK_JITTER_S = 100e-6  # of a subordinate's device times, at noise 1
MAX_JITTER = 3.0  # times the above
DEPTH_GAPS = (1, 3)  # episodes without depth in one camera
DEPTH_GAP_FRAMES = (1, 3)
CLOCK_FALLS_BACK_SETS = 10  # by which a clock jumps back where that is asked for
ANY_LAYOUT = frozenset({"dead_half", "no_depth", "zero_depth", "no_overlap"})
ONE_CAMERA_EACH = (
    "dead_half", "no_depth", "zero_depth", "same_serial", "backwards_clock", "wrong_resolution"
)  # fmt: skip


@dataclass(frozen=True)
class Failures:
    """Of every camera of one capture.

    ``jitter_s`` (T, C): what device times are off from an even beat; ``depth_empty`` and
    ``depth_away`` (T, C) bool: the depth image holds nothing, or there is none; ``broken``: fault
    to the camera's index (:data:`ONE_CAMERA_EACH`).
    """

    jitter_s: np.ndarray
    depth_empty: np.ndarray
    depth_away: np.ndarray
    broken: dict[str, int] = field(default_factory=dict)

    @classmethod
    def draw(
        cls,
        noise: NoiseSource,
        *,
        frames: int,
        cameras: int,
        faults: Sequence[str] = (),
        depth: bool = True,
    ) -> Failures:
        """Decide what fails; the master's clock is the one that the sets go by."""
        jitter = np.zeros((frames, cameras))
        empty, away = np.zeros((2, frames, cameras), bool)
        rng = noise.rng("clocks")
        steps = np.clip(rng.normal(size=(frames, cameras)), -MAX_JITTER, MAX_JITTER)
        jitter[:, 1:] = steps[:, 1:] * CLOCK_JITTER_S * noise.scale
        rng = noise.rng("depth gaps")
        if noise.scale > 0 and cameras > 1 and frames >= 8:
            camera = int(rng.integers(1, cameras))
            for _ in range(int(rng.integers(DEPTH_GAPS[0], DEPTH_GAPS[1] + 1))):
                start = int(rng.integers(0, frames - 1))
                length = int(rng.integers(DEPTH_GAP_FRAMES[0], DEPTH_GAP_FRAMES[1] + 1))
                which = empty if rng.random() < 0.5 else away
                which[start : start + length, camera] = True
        away |= not depth
        broken = _assigned(noise, cameras, faults)
        if "no_depth" in broken:
            away[:, broken["no_depth"]] = True
        if "zero_depth" in broken:
            empty[:, broken["zero_depth"]] = True
        return cls(jitter, empty, away, broken)


def _assigned(noise: NoiseSource, cameras: int, faults: Sequence[str]) -> dict[str, int]:
    """A subordinate camera for each fault of one camera, different ones while there are enough."""
    order = 1 + noise.rng("faults").permutation(max(cameras - 1, 1))
    named = [fault for fault in ONE_CAMERA_EACH if fault in faults]
    return {fault: int(order[i % len(order)]) for i, fault in enumerate(named)}


def check_faults(faults: Sequence[str], *, layout: LayoutName, cameras: int, frames: int) -> None:
    """Raise UserError where a capture asks for faults that it cannot have."""
    strange = set(faults) - ANY_LAYOUT - FOLDERS[layout].own_faults
    if strange:
        raise UserError(
            f"studio: recordings of layout {layout!r} cannot have fault {min(strange)}; take the "
            "fault out or choose another layout"
        )
    if "swapped_lenses" in faults and cameras <= max(SWAPPED):
        raise UserError(
            f"studio: fault swapped_lenses is of cameras 4 and 5, 'cameras' is {cameras}; use more"
        )
    if faults and cameras < 2:
        raise UserError(
            f"studio: faults {', '.join(faults)} need a second camera, 'cameras' is {cameras}; "
            "use more cameras or no faults"
        )
    if {"dead_half", "backwards_clock"} & set(faults) and frames < 4:
        raise UserError(
            f"studio: faults dead_half and backwards_clock need 4 frames, 'frames' is {frames}; "
            "make the capture longer or take the fault out"
        )
