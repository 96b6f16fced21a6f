"""The cameras of a capture: lenses and poses, in the order of every C axis.

The master frame is the common world frame of a capture.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.transforms import invert
from intercap_core.schemas import SCENE

# Standard deviation of the disparity that an active stereo camera measures, pixels. RealSense D400:
# 0.08 is recommended for real scenes (https://github.com/realsenseai/librealsense/issues/3904).
STEREO_SUBPIXEL = 0.08


def stereo_depth_noise(lens: Intrinsics, baseline_m: float) -> float:
    """Growth with squared distance, 1/m, of the standard deviation of a stereo camera's depth.

    sigma = subpixel z^2 / (f b), as in RealSense's "Tuning depth cameras for best performance". 0
    for a baseline of 0, which stands for time of flight.
    """
    return STEREO_SUBPIXEL / (lens.fx * baseline_m) if baseline_m else 0.0


@dataclass(frozen=True, eq=False)
class Camera:
    """One colour camera and its depth camera, if there is one."""

    name: str
    """Name in the calibration and the recordings."""
    colour: Intrinsics
    """Lens of the colour camera."""
    depth: Intrinsics | None
    """Lens of the depth camera."""
    colour_from_depth: np.ndarray | None
    """(4, 4), metres; None without depth."""
    master_from_colour: np.ndarray
    """(4, 4), metres."""
    depth_noise: float = 0.0
    """Growth with squared distance, 1/m, of the standard deviation of depth
    (:func:`stereo_depth_noise`); 0 = time of flight, whose noise is below its systematic error."""

    @cached_property
    def colour_from_master(self) -> np.ndarray:
        """(4, 4)."""
        return invert(self.master_from_colour)

    @cached_property
    def master_from_depth(self) -> np.ndarray:
        """(4, 4). Raises ValueError for a camera without depth."""
        if self.colour_from_depth is None:
            raise ValueError(f"camera {self.name} has no depth")
        return self.master_from_colour @ self.colour_from_depth

    @cached_property
    def depth_from_master(self) -> np.ndarray:
        """(4, 4). Raises ValueError for a camera without depth."""
        return invert(self.master_from_depth)

    @cached_property
    def aligned(self) -> bool:
        """Whether depth lies on the colour image's pixel grid: same lens, same pose."""
        if self.depth is None or self.colour_from_depth is None:
            return False
        same_size = (self.depth.width, self.depth.height) == (self.colour.width, self.colour.height)
        return (
            same_size
            and np.array_equal(self.depth.parameters, self.colour.parameters)
            and np.array_equal(self.colour_from_depth, np.eye(4))
        )

    def stereo_sigma(self, points: np.ndarray) -> np.ndarray:
        """Standard deviation (...,), metres, of depth at points (..., 3), master frame.

        0 for time of flight. Raises ValueError for a camera without depth.
        """
        row = self.depth_from_master[2]
        return self.depth_noise * (points @ row[:3] + row[3]) ** 2

    def moved(self, master_from_colour: np.ndarray) -> Camera:
        """Return the same camera at another pose (4, 4)."""
        return replace(self, master_from_colour=np.asarray(master_from_colour, np.float64))


@dataclass(frozen=True)
class Rig:
    """All cameras of a capture, in the order of every C axis."""

    cameras: tuple[Camera, ...]

    @property
    def names(self) -> tuple[str, ...]:
        """The cameras' names."""
        return tuple(camera.name for camera in self.cameras)

    def __len__(self) -> int:
        return len(self.cameras)

    def __getitem__(self, index: int) -> Camera:
        return self.cameras[index]

    def __iter__(self) -> Iterator[Camera]:
        return iter(self.cameras)

    @cached_property
    def master_from_colour(self) -> np.ndarray:
        """(C, 4, 4)."""
        return np.stack([camera.master_from_colour for camera in self.cameras])

    @cached_property
    def colour_from_master(self) -> np.ndarray:
        """(C, 4, 4)."""
        return invert(self.master_from_colour)

    @cached_property
    def colour_parameters(self) -> np.ndarray:
        """(C, 13): the colour lenses in the form :mod:`.projection` takes for a batch."""
        return np.stack([camera.colour.parameters for camera in self.cameras])

    def moved(self, master_from_colour: np.ndarray) -> Rig:
        """Return the same cameras at other poses (C, 4, 4)."""
        poses = zip(self.cameras, master_from_colour, strict=True)
        return Rig(tuple(camera.moved(pose) for camera, pose in poses))

    def datasets(self) -> dict[str, np.ndarray | list[str]]:
        """Return the cameras' names and lenses as datasets of the frames and scene artefacts."""
        no_lens = np.full(13, np.nan)
        no_pose = np.full((4, 4), np.nan)
        colour = self.colour_parameters
        depth = np.stack([c.depth.parameters if c.depth else no_lens for c in self.cameras])
        sizes = [(c.depth.width, c.depth.height) if c.depth else (0, 0) for c in self.cameras]
        poses = [no_pose if c.colour_from_depth is None else c.colour_from_depth for c in self]
        noise = np.array([camera.depth_noise for camera in self])
        stereo: dict[str, np.ndarray | list[str]] = {"depth_noise": noise} if noise.any() else {}
        return stereo | {
            "camera_names": list(self.names),
            "colour_size": np.array([(c.colour.width, c.colour.height) for c in self.cameras]),
            "colour_intrinsics": colour[:, :4],
            "colour_distortion": colour[:, 4:12],
            "colour_metric_radius": colour[:, 12],
            "depth_size": np.array(sizes),
            "depth_intrinsics": depth[:, :4],
            "depth_distortion": depth[:, 4:12],
            "depth_metric_radius": depth[:, 12],
            "colour_from_depth": np.stack(poses),
        }

    @classmethod
    def from_scene(cls, path: Path) -> Rig:
        """Read the cameras of a scene artefact, with the refined extrinsics.

        Raises UserError as :func:`artefacts.read` does.
        """
        with artefacts.read(path, SCENE) as scene:
            return cls.from_artefact(scene)

    @classmethod
    def from_artefact(cls, artefact: artefacts.Artefact) -> Rig:
        """Read the cameras of an open artefact that holds :meth:`datasets` and the poses."""
        cameras = []
        poses = artefact["master_from_colour"]
        names = artefact.text("camera_names")
        noise = artefact["depth_noise"] if "depth_noise" in artefact else np.zeros(len(names))
        for index, name in enumerate(names):
            lenses: dict[str, Intrinsics | None] = {}
            for kind in ("colour", "depth"):
                size = artefact[f"{kind}_size"][index]
                parameters = np.concatenate(
                    [
                        artefact[f"{kind}_intrinsics"][index],
                        artefact[f"{kind}_distortion"][index],
                        artefact[f"{kind}_metric_radius"][index : index + 1],
                    ]
                )
                lenses[kind] = Intrinsics.from_parameters(size, parameters) if size[0] else None
            if lenses["colour"] is None:
                raise ValueError(f"{artefact.path}: camera {name} has no colour image size")
            between = artefact["colour_from_depth"][index] if lenses["depth"] else None
            camera = Camera(name, lenses["colour"], lenses["depth"], between, poses[index])
            cameras.append(replace(camera, depth_noise=float(noise[index])))
        return cls(tuple(cameras))


def ring_centre(rig: Rig) -> np.ndarray:
    """Return the point (3,), metres, with the least sum of squared distances to the optical axes.

    If the axes are nearly parallel, it is the mean of the points 2 m in front of the cameras.
    """
    poses = rig.master_from_colour
    axes, centres = poses[:, :3, 2], poses[:, :3, 3]
    # projections onto the planes perpendicular to the axes
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    normal = across.sum(0)
    if np.linalg.eigvalsh(normal)[0] < 0.05 * len(rig):  # nearly parallel; tuned on the studio
        return (centres + 2.0 * axes).mean(0)
    return np.linalg.solve(normal, np.einsum("cij,cj->i", across, centres))


def count_facing_away(rig: Rig) -> int:
    """Number of cameras that have :func:`ring_centre` behind them."""
    to_colour = rig.colour_from_master
    return int((to_colour[:, 2, :3] @ ring_centre(rig) + to_colour[:, 2, 3] < 0).sum())
