"""Checks of every lens that a calibration file states."""

from __future__ import annotations

import numpy as np

from intercap_core.errors import UserError
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.projection import radial_fraction

MIN_METRIC_RADIUS = 1e-4  # the Azure Kinect Sensor SDK takes a smaller radius as "not stated"


def check_resolution(centre: np.ndarray, size: tuple[int, int], most: float, where: str) -> None:
    """Raise UserError if a principal point (2,), px, is too far from the image's middle.

    The calibration is then of another resolution. ``most`` is the largest distance allowed, as a
    share of the image's width or height. Cameras have up to about 0.03.
    """
    if (np.abs(centre / size - 0.5) > most).any():
        x, y = centre
        raise UserError(
            f"{where}: the principal point {x:.0f}, {y:.0f} is that of images of about "
            f"{2 * x:.0f}x{2 * y:.0f}, the images have {size[0]}x{size[1]}; give the calibration "
            "of this resolution"
        )


def pad_distortion(coefficients: np.ndarray) -> np.ndarray:
    """Distortion (8,) of 4, 5 or 8 coefficients; raises ValueError for another number."""
    if coefficients.shape not in ((4,), (5,), (8,)):
        raise ValueError(f"{coefficients.size} coefficients, expected 4, 5 or 8")
    return np.concatenate([coefficients, np.zeros(8 - coefficients.size)])


def turning_radius(distortion: np.ndarray) -> float:
    """Radius in the normalised image plane up to which the distorted radius increases.

    The result is at most 5, which is 79 degrees off the axis. ``distortion`` has the shape (8,).
    """
    radius = np.linspace(0, 5, 50001)
    bad = np.flatnonzero(~_distort_radius(radius, distortion)[1])
    return float(radius[max(1, bad[0])] if len(bad) else radius[-1])


def _distort_radius(radius: np.ndarray, distortion: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Apply the radial part of OpenCV's model, r d(r^2), to increasing radii (N,).

    Returns the distorted radii (N,), and for each interval (N - 1,) whether they grow and stay
    finite.
    """
    # A lens as radial_fraction takes it: fx, fy, cx, cy, distortion, metric radius.
    lens = np.concatenate([(1, 1, 0, 0), distortion, (np.inf,)])
    with np.errstate(all="ignore"):
        above, below = radial_fraction(radius * radius, lens)
        image = radius * above / below
        grows = (np.diff(image) > 0) & (below[1:] > 0) & np.isfinite(image[1:])
    return image, grows


def check_lens(lens: Intrinsics, where: str) -> Intrinsics:
    """Return the lens; raises UserError, beginning with ``where``, if no camera has such a lens."""
    fault = find_lens_fault(lens)
    if fault is not None:
        raise UserError(f"{where}: {fault}; calibrate again, or give this camera's own calibration")
    return lens


def find_lens_fault(lens: Intrinsics) -> str | None:
    """Why the lens is impossible, for a message; None if it is possible."""
    if not np.isfinite(lens.parameters).all():
        return "the lens has a value that is not a finite number"
    # A focal length of 0.2 sides sees 136 degrees, about the limit of a pinhole with distortion
    # (the wide depth mode of the Azure Kinect has 0.49). 20 sides see 3 degrees, like an 800 mm
    # lens on a full-frame sensor.
    side = max(lens.width, lens.height)
    low, high = 0.2 * side, 20.0 * side
    for name, focal in (("fx", lens.fx), ("fy", lens.fy)):
        if not low <= focal <= high:
            return (
                f"{name} is {focal:.4g} px, expected {low:.0f} to {high:.0f} for images of "
                f"{lens.width}x{lens.height}"
            )
    if not 0.5 <= lens.fx / lens.fy <= 2.0:  # anamorphic lenses squeeze by 2
        return f"fx {lens.fx:.4g} and fy {lens.fy:.4g} differ by more than 2 times"
    for name, centre, size in (("cx", lens.cx, lens.width), ("cy", lens.cy, lens.height)):
        if not -size <= centre <= 2 * size:  # outside only if the image is cropped
            return f"{name} is {centre:.4g} px, far outside the image's {size}"
    largest = 10.0  # at 84 degrees; the Azure Kinect's is 1.7
    if not MIN_METRIC_RADIUS <= lens.metric_radius <= largest:
        return (
            f"its metric radius is {lens.metric_radius:.4g}, expected {MIN_METRIC_RADIUS:g} to "
            f"{largest:g}"
        )
    return _distortion_fault(lens)


def _distortion_fault(lens: Intrinsics) -> str | None:
    """Why the distortion is impossible; None if it is possible.

    The distorted radius must increase up to a quarter of the shorter side from the centre;
    otherwise the coefficients are in another order or of another lens. Within half of the shorter
    side, the scale and the tangential shift are limited.
    """
    focal = min(lens.fx, lens.fy)
    edge = min(lens.width, lens.height) / 2 / focal  # radius of the normalised image plane
    distortion = np.asarray(lens.distortion, np.float64)
    radius = np.concatenate([[0], np.geomspace(1e-6, 1e-2, 200), np.linspace(0.01, 5, 4992)[1:]])
    image, grows = _distort_radius(radius, distortion)
    turn = int(np.argmin(grows)) if not grows.all() else len(grows)
    covered = float(image[turn]) if np.isfinite(image[turn]) else 0.0
    shown = np.array2string(distortion, precision=4, max_line_width=200)
    if covered < 0.5 * edge:
        return (
            f"the distortion {shown} turns back {covered * focal:.0f} px from the centre of images "
            f"of {lens.width}x{lens.height}"
        )
    inside = image[: turn + 1] <= edge
    slope = np.diff(image[: turn + 1]) / np.diff(radius[: turn + 1])
    steepest = float(slope[inside[:-1]].max(initial=1.0))
    if steepest > 4:  # measured lenses: a quarter to 2 (130 degrees of a GoPro: 0.3 at the corner)
        return (
            f"the distortion {shown} scales the image's edge {steepest:.3g} times its centre, "
            "expected at most 4"
        )
    # p (r^2 + 2 x^2) is at most 3 p r^2, divided by r.
    tangential = 3 * float(np.abs(distortion[2:4]).max()) * min(edge, radius[turn])
    if tangential > 0.5:  # of the image's radius; a lens that is mounted askew has 0.01
        return f"the tangential distortion {shown} moves the image's edge by {tangential:.0%}"
    return None
