"""Inputs and outputs of rendering: meshes, views of them, and images cut to a window."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from intercap_core.geometry.camera.intrinsics import Intrinsics

if TYPE_CHECKING:
    from intercap_core.geometry.rigid.mesh import ObjectMesh


@dataclass(frozen=True, eq=False)
class Rendering:
    """A window of the image; pixel [0, 0] is image pixel (x0, y0).

    ``depth`` (h, w) float32, z in the camera's frame, metres, 0 where nothing is hit; ``face``
    (h, w) int32, -1 where nothing is hit; ``body`` (h, w) int16, which of the meshes drawn, -1
    where none.
    """

    x0: int
    y0: int
    depth: np.ndarray
    face: np.ndarray
    body: np.ndarray

    @property
    def mask(self) -> np.ndarray:
        """Where a mesh is hit (h, w) bool."""
        return self.face >= 0

    @cached_property
    def area(self) -> int:
        """Number of pixels hit."""
        return int(np.count_nonzero(self.face >= 0))

    @property
    def window(self) -> tuple[slice, slice]:
        """Rows and columns of the image that the window covers."""
        height, width = self.depth.shape
        return slice(self.y0, self.y0 + height), slice(self.x0, self.x0 + width)

    def meets(self, x0: int, y0: int, height: int, width: int) -> bool:
        """Whether another window of the image shares a pixel with this one."""
        own_height, own_width = self.face.shape
        return (
            max(x0, self.x0) < min(x0 + width, self.x0 + own_width)
            and max(y0, self.y0) < min(y0 + height, self.y0 + own_height)
        )  # fmt: skip

    def full_mask(self, intrinsics: Intrinsics, body: int | None = None) -> np.ndarray:
        """The mask (H, W) in the whole image, of one mesh or of all."""
        image = np.zeros((intrinsics.height, intrinsics.width), bool)
        image[self.window] = self.mask if body is None else self.body == body
        return image


@dataclass(frozen=True, eq=False)
class Drawable:
    """A mesh and where it is: ``vertices`` (V, 3), ``faces`` (F, 3), ``camera_from_mesh`` (4, 4).

    ``cull_back`` leaves out faces that look away: right, and twice as fast, for closed meshes.
    """

    vertices: np.ndarray
    faces: np.ndarray
    camera_from_mesh: np.ndarray
    cull_back: bool = True


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh that is drawn many times: ``vertices`` (V, 3), ``faces`` (F, 3); see Drawable."""

    vertices: np.ndarray
    faces: np.ndarray
    cull_back: bool = True

    @classmethod
    def of(cls, mesh: ObjectMesh) -> Surface:
        """An object's mesh; back faces are left out where it is closed."""
        return cls(mesh.vertices, mesh.faces, mesh.watertight)


@dataclass(frozen=True, eq=False)
class Shot:
    """One image of a mesh: through which lens, and ``camera_from_mesh`` (4, 4)."""

    lens: Intrinsics
    camera_from_mesh: np.ndarray
