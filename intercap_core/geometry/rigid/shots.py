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
    """Result of rendering: a window of the image that contains all pixels hit."""

    x0: int
    """Image column of the window's first pixel."""
    y0: int
    """Image row of the window's first pixel."""
    depth: np.ndarray
    """(h, w) float32, z in the camera's frame, metres, 0 where nothing is hit."""
    face: np.ndarray
    """(h, w) int32 index of the face, -1 where nothing is hit."""
    body: np.ndarray
    """(h, w) int16 index of the mesh among those drawn, -1 where nothing is hit."""

    @property
    def mask(self) -> np.ndarray:
        """(h, w) bool: a mesh is hit."""
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
        """Return whether another window of the image shares a pixel with this one."""
        own_height, own_width = self.face.shape
        return (
            max(x0, self.x0) < min(x0 + width, self.x0 + own_width)
            and max(y0, self.y0) < min(y0 + height, self.y0 + own_height)
        )  # fmt: skip

    def full_mask(self, intrinsics: Intrinsics, body: int | None = None) -> np.ndarray:
        """Return the mask (H, W) in the whole image, of one mesh or of all."""
        image = np.zeros((intrinsics.height, intrinsics.width), bool)
        image[self.window] = self.mask if body is None else self.body == body
        return image


@dataclass(frozen=True, eq=False)
class Drawable:
    """A mesh with its pose."""

    vertices: np.ndarray
    """(V, 3) metres."""
    faces: np.ndarray
    """(F, 3) indices."""
    camera_from_mesh: np.ndarray
    """(4, 4)."""
    cull_back: bool = True
    """Skip faces that face away: correct, and twice as fast, for closed meshes."""


@dataclass(frozen=True, eq=False)
class Surface:
    """A mesh that is drawn many times."""

    vertices: np.ndarray
    """(V, 3) metres."""
    faces: np.ndarray
    """(F, 3) indices."""
    cull_back: bool = True
    """Skip faces that face away, as in :class:`Drawable`."""

    @classmethod
    def of(cls, mesh: ObjectMesh) -> Surface:
        """Return the surface of an object; back faces are skipped if it is closed."""
        return cls(mesh.vertices, mesh.faces, mesh.watertight)


@dataclass(frozen=True, eq=False)
class Shot:
    """One view of a :class:`Surface`: lens and pose."""

    lens: Intrinsics
    """Lens of the image."""
    camera_from_mesh: np.ndarray
    """(4, 4)."""
