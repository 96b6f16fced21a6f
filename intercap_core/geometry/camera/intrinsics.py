"""One lens: image size, pinhole matrix and OpenCV's rational distortion."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import Any
from weakref import WeakValueDictionary

import numpy as np

from intercap_core.geometry.camera import projection

DEFAULT_METRIC_RADIUS = 1.7  # default of the Azure Kinect SDK if a calibration states 0

# Ray tables by image size and parameters. Readers of a recording create their own lenses; equal
# lenses share one table as long as one of them refers to it.
_TABLES: WeakValueDictionary[tuple[int, int, bytes], np.ndarray] = WeakValueDictionary()


@dataclass(frozen=True, eq=False)
class Intrinsics:
    """A lens and its image; pixel (0, 0) is the centre of the first pixel.

    ``distortion`` (8,) is OpenCV's k1, k2, p1, p2, k3, k4, k5, k6. The calibration is valid up to
    ``metric_radius`` = sqrt(x^2 + y^2) with x = X/Z, y = Y/Z; see :mod:`.projection` beyond it.
    Sizes, focal lengths and the principal point are in pixels. Raises ValueError for impossible
    shapes or sizes.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: np.ndarray = field(default_factory=lambda: np.zeros(8))
    metric_radius: float = DEFAULT_METRIC_RADIUS

    def __post_init__(self) -> None:
        distortion = np.array(self.distortion, np.float64)
        if distortion.shape != (8,):
            raise ValueError(f"distortion has shape {distortion.shape}, expected (8,)")
        if min(self.width, self.height) < 1 or min(self.fx, self.fy, self.metric_radius) <= 0:
            raise ValueError("an image size, focal length or metric radius is not positive")
        distortion.setflags(write=False)
        object.__setattr__(self, "distortion", distortion)

    @classmethod
    def from_parameters(cls, size: Any, parameters: Any) -> Intrinsics:
        """Make a lens of ``size`` (2,) = width, height from :attr:`parameters` (13,)."""
        width, height = (int(n) for n in size)
        fx, fy, cx, cy, *rest = (float(p) for p in parameters)
        return cls(width, height, fx, fy, cx, cy, np.array(rest[:8]), rest[8])

    @cached_property
    def parameters(self) -> np.ndarray:
        """(13,) float64: fx, fy, cx, cy, the distortion, metric radius (:mod:`.projection`)."""
        head = (self.fx, self.fy, self.cx, self.cy)
        values = np.array([*head, *self.distortion, self.metric_radius])
        values.setflags(write=False)
        return values

    @property
    def matrix(self) -> np.ndarray:
        """The pinhole matrix (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    def project(self, points: Any) -> Any:
        """Project points (..., 3), this camera's frame, metres, to pixels (..., 2)."""
        return projection.project(points, self.parameters)

    def project_with_jacobian(self, points: Any) -> tuple[Any, Any]:
        """Return pixels (..., 2) and d pixel / d point (..., 2, 3) of points (..., 3)."""
        return projection.project_with_jacobian(points, self.parameters)

    def unproject(self, pixels: np.ndarray) -> np.ndarray:
        """Return the undistorted rays (..., 3), z = 1, float64, of pixels (..., 2).

        The inverse of :meth:`project`, exact to 1e-12 in X/Z and Y/Z, also beyond the metric
        radius. NaN if the model has no inverse: the distorted radius of some calibrations decreases
        before the metric radius.
        """
        from intercap_core.geometry.camera import projection_kernels

        pixels = np.asarray(pixels, np.float64)
        flat = np.ascontiguousarray(pixels.reshape(-1, 2))
        rays = np.ones((len(flat), 3))
        rays[:, :2] = projection_kernels.unproject(
            flat, tuple(self.parameters.tolist()), *self._radius_table
        )
        return rays.reshape(*pixels.shape[:-1], 3)

    @cached_property
    def _radius_table(self) -> tuple[np.ndarray, np.ndarray]:
        return projection.radius_table(self.parameters)

    def inside_model(self, points: Any) -> Any:
        """Return whether points (..., 3) are in front and within the metric radius."""
        return projection.inside_model(points, self.parameters)

    def sees(self, points: Any) -> Any:
        """Return whether points (..., 3) are inside the image and the lens model."""
        pixels = self.project(points)
        u, v = pixels[..., 0], pixels[..., 1]
        inside = (u >= -0.5) & (v >= -0.5) & (u < self.width - 0.5) & (v < self.height - 0.5)
        return inside & self.inside_model(points)

    @cached_property
    def rays(self) -> np.ndarray:
        """(height, width, 2) float32: X/Z and Y/Z of the ray of every pixel.

        NaN outside the metric radius. Lenses with equal parameters share the table. For images of
        more than 100,000 pixels, rays are computed at every fourth pixel and interpolated by cubic
        splines, to 1e-4 px. This requires that all of them are inside the metric radius.
        """
        key = (self.width, self.height, self.parameters.tobytes())
        table = _TABLES.get(key)
        if table is None:
            _TABLES[key] = table = self._ray_table()
        return table

    def _ray_table(self) -> np.ndarray:
        u, v = np.arange(self.width), np.arange(self.height)
        coarse_u, coarse_v = (np.linspace(0, n[-1], -(-n[-1] // 4) + 1) for n in (u, v))
        small = self.width * self.height <= 100_000  # nothing is gained by interpolating
        xy = self._rays_at(u, v) if small else self._rays_at(coarse_u, coarse_v)
        if not small and np.isfinite(xy).all():
            from scipy.interpolate import RectBivariateSpline

            splines = [RectBivariateSpline(coarse_v, coarse_u, xy[..., axis]) for axis in (0, 1)]
            xy = np.stack([spline(v, u) for spline in splines], -1)
        elif not small:
            xy = self._rays_at(u, v)
        table = xy.astype(np.float32)
        table.setflags(write=False)
        return table

    def _rays_at(self, u: np.ndarray, v: np.ndarray) -> np.ndarray:
        """Return rays (V, U, 2) of columns u (U,), rows v (V,); NaN outside the metric radius."""
        xy = self.unproject(np.stack(np.meshgrid(u, v), -1))[..., :2]
        xy[~(np.hypot(xy[..., 0], xy[..., 1]) <= self.metric_radius)] = np.nan
        return xy

    def scaled(self, factor: float) -> Intrinsics:
        """Return the lens of the image resized by ``factor``.

        Width and height are rounded. The borders of the image stay borders, so that the pixel
        centres move: cx + 0.5 is scaled.
        """
        width, height = round(self.width * factor), round(self.height * factor)
        sx, sy = width / self.width, height / self.height
        return Intrinsics(
            width,
            height,
            self.fx * sx,
            self.fy * sy,
            (self.cx + 0.5) * sx - 0.5,
            (self.cy + 0.5) * sy - 0.5,
            self.distortion,
            self.metric_radius,
        )

    def cropped(self, x0: int, y0: int, width: int, height: int) -> Intrinsics:
        """Return the lens of the window whose first pixel is (x0, y0)."""
        cx, cy = self.cx - x0, self.cy - y0
        return Intrinsics(
            width, height, self.fx, self.fy, cx, cy, self.distortion, self.metric_radius
        )
