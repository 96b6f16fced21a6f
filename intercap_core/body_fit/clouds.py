"""The person's cloud in each frame: depth points of all cameras, and rims of the person's masks.

The body fit makes the clouds and writes them to body_fit.h5, from which later stages read them.
Depth images around the person are not copied: they are read from frames.h5.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from torch import Tensor

from intercap_core import artefacts
from intercap_core.artefacts import Artefact, Writer
from intercap_core.body_fit.free_space import DepthWindow
from intercap_core.body_fit.observations import Observations
from intercap_core.body_fit.outlines import MaskRim, trace_outline
from intercap_core.formats.detections.read import FROM_DETECTOR
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.mask_pixels import mask_pixels, mask_window
from intercap_core.geometry.camera.masks import Runs
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.solve.thread_pool import ThreadPool, threads_of_job
from intercap_core.schemas import BODY_FIT, PERSON

EDGE_TRUST = 0.3  # trust of a point at a depth edge; tuned on the studio


@dataclass(frozen=True, eq=False)
class PersonCloud:
    """Depth points of the person in one frame, from all views, in the master frame."""

    points: Tensor
    """(M, 3) float32, metres."""
    normals: Tensor
    """(M, 3) float32 unit normals, towards the camera."""
    trust: Tensor
    """(M,) weight in (0, 1], lower at depth edges."""
    view: Tensor
    """(M,) camera index."""
    windows: tuple[DepthWindow, ...] = ()
    """Depth around the person, by camera."""
    outlines: tuple[MaskRim, ...] = ()
    """Rims of the person's masks, by camera."""

    def __reduce__(self) -> tuple[Any, ...]:
        # arrays are pickled faster than tensors
        arrays = [values.numpy() for values in (self.points, self.normals, self.trust, self.view)]
        return _cloud_of_arrays, (arrays, self.windows, self.outlines)

    def of_view(self, view: int) -> PersonCloud:
        """Return the part of camera ``view``."""
        mine = self.view == view
        return PersonCloud(
            self.points[mine],
            self.normals[mine],
            self.trust[mine],
            self.view[mine],
            tuple(window for window in self.windows if window.view == view),
            tuple(rim for rim in self.outlines if rim.view == view),
        )

    def through(
        self, rig: Rig, bias: np.ndarray, before: Rig, bias_before: np.ndarray
    ) -> PersonCloud:
        """Return the same pixels, back-projected with other camera poses and depth biases.

        Args:
            rig: new camera poses.
            bias: (C,) new depth biases, metres.
            before: camera poses of this cloud.
            bias_before: (C,) depth biases of this cloud, metres.
        """
        points, normals = self.points.clone(), self.normals.clone()
        for view in np.unique(self.view.numpy()):
            mine = self.view == int(view)
            old, new = before[view].depth_from_master, rig[view].master_from_depth
            measured = apply(old, points[mine].double().numpy())
            measured -= (bias[view] - bias_before[view]) * measured / measured[:, 2:]
            turn = new[:3, :3] @ old[:3, :3]
            points[mine] = torch.as_tensor(apply(new, measured)).to(points)
            normals[mine] = normals[mine] @ torch.as_tensor(turn.T).to(normals)
        return replace(self, points=points, normals=normals)


def _cloud_of_arrays(
    arrays: list[np.ndarray], windows: tuple[DepthWindow, ...], outlines: tuple[MaskRim, ...]
) -> PersonCloud:
    points, normals, trust, view = map(torch.from_numpy, arrays)
    return PersonCloud(points, normals, trust, view, windows, outlines)


class _Masks(NamedTuple):
    """Masks in one image."""

    person: bytes
    """RLE of the person's mask; empty = none."""
    source: int
    """What segmented the person; see :mod:`intercap_core.formats.detections.read`."""
    others: bytes
    """RLE of other detected objects; empty = none."""


def person_clouds(
    frames: Path, person: Path, observations: Observations, count: int
) -> Iterator[PersonCloud | None]:
    """Yield the cloud of each frame, of about ``count`` points; None = no usable mask."""
    threads = ThreadPool(threads_of_job())
    together = 16  # frames, limited by memory: a cloud and its depth images have 0.8 MB
    with Frames.open(frames) as reader, artefacts.read(person, PERSON) as read:
        reader = reader.showing(observations.image_of)
        for start in range(0, observations.num_frames, together):
            some = range(observations.num_frames)[start : start + together]
            yield from threads.map(
                lambda of_frame: _fuse(reader, observations, *of_frame, count),
                list(zip(some, _read_masks(read, some, len(observations.rig)), strict=True)),
            )


def _read_masks(read: Artefact, frames: range, cameras: int) -> list[list[_Masks]]:
    """Return the masks of some frames, by frame and camera."""
    images = slice(frames.start * cameras, frames.stop * cameras)
    persons = [rle.tobytes() for (rle,) in _ragged(read, "mask", ("rle",), images)]
    others = [b""] * len(persons)
    if "beside_offsets" in read:
        others = [rle.tobytes() for (rle,) in _ragged(read, "beside", ("rle",), images)]
    source = read.rows("mask_source", slice(frames.start, frames.stop)).ravel().tolist()
    masks = list(map(_Masks, persons, source, others))
    return [masks[first : first + cameras] for first in range(0, len(masks), cameras)]


def _fuse(
    reader: Frames, observations: Observations, t: int, masks: Sequence[_Masks], count: int
) -> PersonCloud | None:
    """Return the depth points of frame t within the person's masks, and the rims of the masks."""
    seen_by: list[tuple[int, np.ndarray, np.ndarray]] = []  # camera, depth image, pixels
    windows, outlines = [], []
    for c, (camera, of_image) in enumerate(zip(observations.rig, masks, strict=True)):
        mask = _runs(of_image.person, camera)
        if mask is None:
            continue
        depth = None if camera.depth is None else reader.depth(t, c)
        # The rim of a detector's mask is used. That of a foreground segmentation is used only if
        # there is no depth, and if masks of other objects tell where they cover the person.
        if of_image.source == FROM_DETECTOR or (depth is None and of_image.others):
            rim = trace_outline(mask, _runs(of_image.others, camera), camera.colour, c)
            outlines += [] if rim is None else [rim]
        if depth is None:
            continue
        window = mask_window(depth, camera, mask)
        if window is None:
            continue
        # pixels in front of the background are the person or an occluder
        index = mask_pixels(
            depth,
            camera,
            mask,
            window,
            background=observations.background[c],
            before_m=0.04,  # of the background; tuned on the studio
            every=2,  # neighbouring rows and columns are redundant
        )
        if len(index):
            seen_by.append((c, depth, index))
            rows, columns = window
            corner = (rows.start, columns.start)
            windows.append(DepthWindow(c, corner, depth[rows, columns].copy()))
    if not seen_by and not outlines:
        return None
    # every n-th point: pixels are in scan order, so this spreads over the surface
    first = np.cumsum([0, *(len(index) for _, _, index in seen_by)])
    pick = np.unique(np.linspace(0, first[-1] - 1, min(count, first[-1])).astype(np.int64))
    none = np.zeros(0)
    parts: list[tuple[np.ndarray, ...]] = [(none.reshape(0, 3), none.reshape(0, 3), none, none)]
    for (c, depth, index), start in zip(seen_by, first[:-1], strict=True):
        chosen = index[pick[(pick >= start) & (pick < start + len(index))] - start]
        in_master = _place_pixels(depth, observations.rig[c], chosen, observations.depth_bias[c])
        parts.append((*in_master, np.full(len(chosen), c)))
    points, normals, trust, view = (np.concatenate(p) for p in zip(*parts, strict=True))
    return PersonCloud(
        torch.as_tensor(points, dtype=torch.float32),
        torch.as_tensor(normals, dtype=torch.float32),
        torch.as_tensor(trust, dtype=torch.float32),
        torch.as_tensor(view, dtype=torch.int64),
        tuple(windows),
        tuple(outlines),
    )


def _runs(rle: bytes, camera: Camera) -> Runs | None:
    return Runs(rle, camera.colour.height, camera.colour.width) if rle else None


def _place_pixels(
    depth: np.ndarray, camera: Camera, index: np.ndarray, depth_bias: float
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return points and normals (M, 3), master frame, and trust (M,) of flat depth pixels (M,)."""
    points, normals, edge = _measure_normals(depth, camera, index)
    if depth_bias:
        points = points - depth_bias * points / points[:, 2:]
    master = camera.master_from_depth
    rotation = master[:3, :3].astype(np.float32)
    return apply(master, points), normals @ rotation.T, np.where(edge, EDGE_TRUST, 1.0)


def _measure_normals(
    depth: np.ndarray, camera: Camera, index: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Measure surface normals by differences of depth along rows and columns.

    Returns:
        (M, 3) points, depth camera's frame, metres.
        (M, 3) unit normals towards the camera.
        (M,) bool: the pixel is at a depth edge.
    """
    assert camera.depth is not None
    base = 3  # px, half the distance over which a normal is measured; tuned on the studio
    edge_m = 0.04  # a larger change of depth within ``base`` px is an edge; tuned on the studio
    height, width = depth.shape
    rays = camera.depth.rays
    row, column = np.divmod(index, width)
    z = depth[row, column].astype(np.float32) * np.float32(1e-3)

    def at(r: np.ndarray, c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return points (M, 3) at rows r, columns c, and whether they continue the surface."""
        r, c = np.clip(r, 0, height - 1), np.clip(c, 0, width - 1)
        there = depth[r, c].astype(np.float32) * np.float32(1e-3)
        ray = rays[r, c]
        good = (there > 0) & (np.abs(there - z) < edge_m) & np.isfinite(ray[:, 0])
        ray = np.where(good[:, None], ray, 0)
        return np.concatenate([ray * there[:, None], there[:, None]], 1), good

    ray = np.nan_to_num(rays[row, column])
    here = np.concatenate([ray * z[:, None], z[:, None]], 1)
    spans, smooth = [], np.ones(len(index), bool)
    for dr, dc in ((0, base), (base, 0)):
        ahead, a = at(row + dr, column + dc)
        back, b = at(row - dr, column - dc)
        # one-sided if the other side is another surface
        span = np.where(a[:, None], ahead, here) - np.where(b[:, None], back, here)
        spans.append(span)
        smooth &= a & b
    normals = np.cross(spans[1], spans[0])
    length = np.linalg.norm(normals, axis=1)
    flat = length < 1e-9
    facing = -here / np.maximum(np.linalg.norm(here, axis=1, keepdims=True), 1e-9)
    normals = np.where(flat[:, None], facing, normals / np.maximum(length, 1e-9)[:, None])
    normals *= np.where((normals * here).sum(1) > 0, -1.0, 1.0)[:, None]
    return here, normals.astype(np.float32), ~smooth


# --- artefact -------------------------------------------------------------------------------------


def put_clouds(writer: Writer, clouds: Iterable[PersonCloud | None], cameras: int) -> None:
    """Write the clouds of all frames, one by one; ``cameras`` is the number of cameras."""
    streams = {
        key: writer.stream(key, shape)
        for key, shape in (
            ("cloud_points", (3,)), ("cloud_normals", (3,)), ("cloud_edge", ()), ("cloud_view", ()),
            ("rim_rays", (3,)), ("rim_normals", (3,)), ("rim_view", ()),
        )
    }  # fmt: skip
    windows, points, rays = [], [], []
    for cloud in clouds:
        windows.append(np.zeros((cameras, 4), np.int32))
        points.append(0 if cloud is None else len(cloud.points))
        rays.append(0 if cloud is None else sum(len(rim.rays) for rim in cloud.outlines))
        if cloud is None:
            continue
        for window in cloud.windows:
            windows[-1][window.view] = *window.first, *window.depth.shape
        streams["cloud_points"].append(cloud.points.numpy())
        streams["cloud_normals"].append(cloud.normals.numpy())
        streams["cloud_edge"].append((cloud.trust < 1).numpy())
        streams["cloud_view"].append(cloud.view.numpy())
        rims = cloud.outlines
        if rims:
            streams["rim_rays"].append(np.concatenate([rim.rays for rim in rims]))
            streams["rim_normals"].append(np.concatenate([rim.normals for rim in rims]))
            views = np.array([rim.view for rim in rims], np.uint8)
            streams["rim_view"].append(np.repeat(views, [len(rim.rays) for rim in rims]))
    writer.put("cloud_window", np.stack(windows))
    writer.put("cloud_offsets", _offsets(points))
    writer.put("rim_offsets", _offsets(rays))


def read_clouds(
    body_fit: Path, frames: Path, image_of: np.ndarray, moments: slice
) -> list[PersonCloud | None]:
    """Return the clouds of the frames ``moments``; None = no cloud.

    Raises UserError if an artefact cannot be read.

    Args:
        body_fit: artefact of the body fit, with the clouds.
        frames: artefact with the depth images.
        image_of: (T, C) frame set of each image, of the scene.
        moments: start and stop of the frames.
    """
    with Frames.open(frames) as reader, artefacts.read(body_fit, BODY_FIT) as read:
        reader = reader.showing(image_of)
        windows = read.rows("cloud_window", moments)
        points = _ragged(read, "cloud", ("points", "normals", "edge", "view"), moments)
        rims = _ragged(read, "rim", ("rays", "normals", "view"), moments)
        return [
            _cloud(reader, t, *of_frame)
            for t, *of_frame in zip(
                range(moments.start, moments.stop), windows, points, rims, strict=True
            )
        ]


def _cloud(
    reader: Frames,
    t: int,
    windows: np.ndarray,
    points: tuple[np.ndarray, ...],
    rims: tuple[np.ndarray, ...],
) -> PersonCloud | None:
    """Return the cloud of frame t from its rows of the artefact."""
    where, normals, edge, view = points
    rays, planes, rim_view = rims
    if not len(where) and not len(rays):
        return None
    depth = []
    for c in np.flatnonzero(windows[:, 2]):
        row, column, height, width = windows[c].tolist()
        image = reader.depth(t, int(c))
        if image is not None:
            crop = image[row : row + height, column : column + width].copy()
            depth.append(DepthWindow(int(c), (row, column), crop))
    return PersonCloud(
        torch.from_numpy(where),
        torch.from_numpy(normals),
        torch.from_numpy(np.where(edge, np.float32(EDGE_TRUST), np.float32(1))),
        torch.from_numpy(view.astype(np.int64)),
        tuple(depth),
        tuple(
            MaskRim(int(c), rays[rim_view == c], planes[rim_view == c]) for c in np.unique(rim_view)
        ),
    )


def _offsets(sizes: Sequence[int]) -> np.ndarray:
    return np.cumsum([0, *sizes], dtype=np.int64)


def _ragged(
    read: Artefact, prefix: str, names: Sequence[str], moments: slice
) -> Iterator[tuple[np.ndarray, ...]]:
    """Yield the rows of each frame of the datasets ``prefix_name``."""
    offsets = read.rows(f"{prefix}_offsets", slice(moments.start, moments.stop + 1))
    values = [read.rows(f"{prefix}_{name}", slice(offsets[0], offsets[-1])) for name in names]
    for start, stop in itertools.pairwise(offsets - offsets[0]):
        yield tuple(value[start:stop] for value in values)
