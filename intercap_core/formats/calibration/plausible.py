"""Lenses and poses that a camera can have: what a file says is held against glass and rooms."""

from __future__ import annotations

import numpy as np

from intercap_core.errors import UserError
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.projection import radial_fraction

# Focal lengths in units of the image's longer side: 0.2 sees 136 degrees across, where a pinhole
# with distortion ends (the Azure Kinect's wide depth mode has 0.49); 20 sees 3 degrees, an 800 mm
# lens before a full-frame sensor.
FOCAL_SIDES = (0.2, 20.0)
MAX_ASPECT = 2.0  # of fx to fy either way: anamorphic lenses squeeze by 2
MAX_OFF_IMAGE = 1.0  # image widths by which a principal point may lie outside: cut-out windows
METRIC_RADIUS = (
    1e-4,
    10.0,
)  # of the normalised plane; the Azure Kinect's are 1.7, 10 is 84 degrees
# The distorted image must grow with the angle over a quarter of the shorter side around its centre,
# else the coefficients are of another lens or another order.
LEAST_COVERED = 0.25
# By how much the distortion may change the scale between the centre and the edge. Measured lenses
# stay within a quarter to 2 (a GoPro's 130 degrees: 0.3 at the corner).
MAX_SCALE_CHANGE = 4.0
MAX_TANGENTIAL = 0.5  # of the image's radius at its edge; a lens mounted askew has 0.01
FRAMES_PER_SECOND = (0.05, 10_000.0)  # time lapse to high-speed cameras
LONGEST_OFFSET_S = 1e9  # clocks count from 1970 at most


def check_lens(lens: Intrinsics, where: str) -> Intrinsics:
    """Return the lens; raises UserError, beginning with ``where``, for one that no camera has."""
    fault = lens_fault(lens)
    if fault is not None:
        raise UserError(f"{where}: {fault}; calibrate again, or give this camera's own calibration")
    return lens


def lens_fault(lens: Intrinsics) -> str | None:
    """What is impossible about a lens, in words, or None."""
    side = max(lens.width, lens.height)
    low, high = FOCAL_SIDES
    if not np.isfinite(lens.parameters).all():
        return "the lens has a value that is not a finite number"
    for name, focal in (("fx", lens.fx), ("fy", lens.fy)):
        if not low * side <= focal <= high * side:
            return (
                f"{name} is {focal:.4g} px, expected {low * side:.0f} to {high * side:.0f} for "
                f"images of {lens.width}x{lens.height}"
            )
    if not 1 / MAX_ASPECT <= lens.fx / lens.fy <= MAX_ASPECT:
        return f"fx {lens.fx:.4g} and fy {lens.fy:.4g} differ by more than {MAX_ASPECT:g} times"
    for name, centre, size in (("cx", lens.cx, lens.width), ("cy", lens.cy, lens.height)):
        if not -MAX_OFF_IMAGE * size <= centre <= (1 + MAX_OFF_IMAGE) * size:
            return f"{name} is {centre:.4g} px, far outside the image's {size}"
    if not METRIC_RADIUS[0] <= lens.metric_radius <= METRIC_RADIUS[1]:
        return (
            f"its metric radius is {lens.metric_radius:.4g}, expected {METRIC_RADIUS[0]:g} to "
            f"{METRIC_RADIUS[1]:g}"
        )
    return _distortion_fault(lens)


def _distortion_fault(lens: Intrinsics) -> str | None:
    """What is wrong with the distortion: within the image, what lies farther out is imaged so."""
    focal = min(lens.fx, lens.fy)
    edge = min(lens.width, lens.height) / 2 / focal  # of the normalised image
    distortion = np.asarray(lens.distortion, np.float64)
    radius = np.concatenate([[0], np.geomspace(1e-6, 1e-2, 200), np.linspace(0.01, 5, 4992)[1:]])
    coefficients = np.concatenate([(1, 1, 0, 0), distortion, (np.inf,)])
    with np.errstate(all="ignore"):
        above, below = radial_fraction(radius * radius, coefficients)
        image = radius * above / below
        grows = (np.diff(image) > 0) & (below[1:] > 0) & np.isfinite(image[1:])
    turns = int(np.argmin(grows)) if not grows.all() else len(grows)
    covered = float(image[turns]) if np.isfinite(image[turns]) else 0.0
    told = np.array2string(distortion, precision=4, max_line_width=200)
    if covered < 2 * LEAST_COVERED * edge:
        return (
            f"the distortion {told} turns back {covered * focal:.0f} px from the centre of images "
            f"of {lens.width}x{lens.height}"
        )
    inside = image[: turns + 1] <= edge
    slope = np.diff(image[: turns + 1]) / np.diff(radius[: turns + 1])
    steepest = float(slope[inside[:-1]].max(initial=1.0))
    if steepest > MAX_SCALE_CHANGE:
        return (
            f"the distortion {told} scales the image's edge {steepest:.3g} times its centre, "
            f"expected at most {MAX_SCALE_CHANGE:g}"
        )
    tangential = 3 * float(np.abs(distortion[2:4]).max()) * min(edge, radius[turns])
    if tangential > MAX_TANGENTIAL:
        return f"the tangential distortion {told} moves the image's edge by {tangential:.0%}"
    return None


def check_rate(fps: float | None, where: str) -> None:
    """Raise UserError for images a second that no camera takes."""
    if fps is not None and not FRAMES_PER_SECOND[0] <= fps <= FRAMES_PER_SECOND[1]:
        raise UserError(
            f"{where}: fps is {fps:.4g}, expected {FRAMES_PER_SECOND[0]:g} to "
            f"{FRAMES_PER_SECOND[1]:g}; correct it"
        )
