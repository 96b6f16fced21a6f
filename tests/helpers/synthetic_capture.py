"""A ring of cameras around a room whose surfaces are known in closed form, and frames artefacts.

Nothing of the studio: rays are cast on boxes and planes analytically.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.artefacts import Writer, pack_ragged
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig
from intercap_core.geometry.camera.transforms import apply, invert, rigid
from intercap_core.schemas import FRAMES, PERSON, SCENE

COLOUR = Intrinsics(
    1920, 1080, 918.0, 917.0, 959.2, 549.4,
    np.array([0.33, -2.489, -1.6e-4, -1.3e-4, 1.454, 0.209, -2.303, 1.375]),
)  # fmt: skip
DEPTH = Intrinsics(
    640, 576, 504.6, 504.7, 332.8, 348.8,
    np.array([0.548, -0.021, 2.1e-5, -7.2e-5, -0.0027, 0.89, 0.086, -0.0139]), 1.74,
).scaled(0.3)  # fmt: skip
COLOUR_FROM_DEPTH = rigid(
    np.array([[1, 0, 0], [0, 0.995, 0.0998749], [0, -0.0998749, 0.995]]),
    np.array([-0.032, -0.002, 0.004]),
)


def looking_at(centre: np.ndarray, target: np.ndarray) -> np.ndarray:
    """world_from_camera (4, 4) of a camera whose image is upright in a z-up world."""
    forward = (target - centre) / np.linalg.norm(target - centre)
    right = np.cross(forward, [0, 0, 1.0])
    right /= np.linalg.norm(right)
    return rigid(np.stack([right, np.cross(forward, right), forward], 1), centre)


def ring_of(
    count: int,
    *,
    radius: float,
    height: float,
    target_height: float,
    colour: Intrinsics,
    depth: Intrinsics,
    colour_from_depth: np.ndarray,
    first_angle: float = 0.0,
) -> tuple[Rig, np.ndarray]:
    """Equal cameras around the z axis of a room with z up, and room_from_master (4, 4).

    All look at the axis at ``target_height``; the first one, at ``first_angle``, is the master.
    """
    poses = []
    for index in range(count):
        angle = 2 * np.pi * index / count + first_angle
        centre = np.array([radius * np.cos(angle), radius * np.sin(angle), height])
        poses.append(looking_at(centre, np.array([0, 0, target_height])))
    master_from_room = invert(poses[0])
    cameras = tuple(
        Camera(f"k{i + 1}", colour, depth, colour_from_depth, master_from_room @ pose)
        for i, pose in enumerate(poses)
    )
    return Rig(cameras), poses[0]


def ring(count: int = 6, radius: float = 2.6, height: float = 1.7) -> tuple[Rig, np.ndarray]:
    """A rig of ``count`` cameras and zup_from_master (4, 4); the floor is z = 0."""
    return ring_of(
        count,
        radius=radius,
        height=height,
        target_height=0.8,
        colour=COLOUR,
        depth=DEPTH,
        colour_from_depth=COLOUR_FROM_DEPTH,
    )


def room_depth(
    camera: Camera, zup_from_master: np.ndarray, boxes: np.ndarray, walls: float | None = 3.6
) -> np.ndarray:
    """Depth (H, W) float64 metres of a floor, four walls (or none) and ``boxes`` (B, 2, 3)."""
    assert camera.depth is not None
    rays = np.dstack([camera.depth.rays.astype(np.float64), np.ones(camera.depth.rays.shape[:2])])
    pose = zup_from_master @ camera.master_from_depth
    direction = rays.reshape(-1, 3) @ pose[:3, :3].T
    origin = pose[:3, 3]
    depth = np.full(len(direction), np.inf)
    with np.errstate(divide="ignore", invalid="ignore"):
        faces = [(2, 0.0)]
        if walls is not None:
            faces += [(axis, side * walls) for axis in (0, 1) for side in (-1, 1)]
        for axis, at in faces:
            t = (at - origin[axis]) / direction[:, axis]
            depth = np.where((t > 0) & (t < depth), t, depth)
        for low, high in boxes:
            a, b = (low - origin) / direction, (high - origin) / direction
            near, far = np.minimum(a, b).max(1), np.maximum(a, b).min(1)
            depth = np.where((near > 0) & (near < far) & (near < depth), near, depth)
    depth[~np.isfinite(depth)] = 0
    return depth.reshape(camera.depth.height, camera.depth.width)


FURNITURE = np.array([
    [[-1.9, -0.4, 0], [-1.2, 0.5, 0.75]],
    [[0.9, 1.1, 0], [1.5, 1.6, 1.1]],
    [[0.4, -1.7, 0], [1.2, -1.2, 0.5]],
])  # fmt: skip


def to_millimetres(depth: np.ndarray, rng: np.random.Generator, noise: float = 1.0) -> np.ndarray:
    """Depth with noise that grows with distance, as the sensor stores it: uint16 mm."""
    sigma = noise * (0.001 + 0.0005 * depth**2)
    noisy = depth + sigma * rng.standard_normal(depth.shape)
    return np.where(depth > 0, np.rint(np.maximum(noisy, 0) * 1000), 0).astype(np.uint16)


def perturbed(rig: Rig, rng: np.random.Generator, metres: float, degrees: float) -> Rig:
    """Every camera but the first moved by a random motion of these sizes."""
    poses = rig.master_from_colour.copy()
    for index in range(1, len(rig)):
        axis = rng.standard_normal(3)
        axis *= np.radians(degrees) / np.linalg.norm(axis)
        shift = rng.standard_normal(3)
        poses[index, :3, :3] = poses[index, :3, :3] @ rotation_of(axis)
        poses[index, :3, 3] += metres * shift / np.linalg.norm(shift)
    return rig.moved(poses)


def rotation_of(vector: np.ndarray) -> np.ndarray:
    """Rotation matrix (3, 3) of a rotation vector, by Rodrigues' formula."""
    angle = float(np.linalg.norm(vector))
    if angle == 0:
        return np.eye(3)
    x, y, z = vector / angle
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross


def extrinsics_error(rig: Rig, truth: Rig, centre: np.ndarray, side: float = 2.0) -> np.ndarray:
    """RMS displacement (C,) of a cube's points, metres, between two rigs with one master."""
    steps = np.linspace(-side / 2, side / 2, 5)
    cube = np.stack(np.meshgrid(steps, steps, steps), -1).reshape(-1, 3) + centre
    moved = [
        apply(a.master_from_colour @ b.colour_from_master, cube) - cube
        for a, b in zip(rig, truth, strict=True)
    ]
    return np.sqrt((np.stack(moved) ** 2).sum(-1).mean(-1))


def put_frame_sets(
    writer: artefacts.Writer,
    rig: Rig,
    times: np.ndarray,
    *,
    colour_index: np.ndarray,
    depth_index: np.ndarray,
    dropped: np.ndarray | None = None,
    gravity: np.ndarray | None = None,
) -> None:
    """What a frames artefact holds besides images; indices (T, C), ``gravity`` (C, 3)."""
    count = len(rig)
    for key, values in rig.datasets().items():
        writer.put(key, values)
    writer.put("master_from_colour", rig.master_from_colour)
    writer.put("gravity", np.full((count, 3), np.nan) if gravity is None else gravity)
    writer.put("present", np.ones(count, bool))
    writer.put("truncated", np.zeros(count, bool))
    writer.put("note", [""] * count)
    writer.put("times", times)
    writer.put("dropped", np.zeros(len(times), bool) if dropped is None else dropped)
    writer.put("colour_index", colour_index)
    writer.put("depth_index", depth_index)
    writer.put("skew", np.zeros((len(times), count)))


def write_frames(
    path: Path,
    rig: Rig,
    *,
    num_sets: int,
    depths: list[np.ndarray] | None = None,
    colour_index: np.ndarray | None = None,
    dropped: np.ndarray | None = None,
    gravity: np.ndarray | None = None,
    stated: Mapping[str, np.ndarray] | None = None,
    colour_times: bool = False,
    sound: Mapping[str, np.ndarray] | None = None,
    colours: Sequence[Sequence[bytes]] | None = None,
    sequence: str = "test",
) -> Path:
    """Write a frames artefact.

    Args:
        depths: (T, H, W) uint16 mm for each camera.
        colours: T images for each camera; they and the depth images get device times from 0.
        stated: datasets of what the calibration states about its world.
        colour_times: also write the device times of colour images, which begin at 7 s.
        sound: datasets of the start times found in the sound.
    """
    count = len(rig)
    sets = np.repeat(np.arange(num_sets)[:, None], count, 1)
    none = np.full((num_sets, count), -1)
    with artefacts.write(path, FRAMES, sequence=sequence, master="k1", fps=15.0) as writer:
        put_frame_sets(
            writer,
            rig,
            np.arange(num_sets) / 15.0,
            colour_index=sets if colour_index is None else colour_index,
            depth_index=none if depths is None else sets,
            dropped=dropped,
            gravity=gravity,
        )
        for key, values in {**(stated or {}), **(sound or {})}.items():
            writer.put(key, values)
        for index, name in enumerate(rig.names):
            if depths is not None:
                writer.put(f"cameras/{name}/depth", depths[index])
            if colours is not None:
                offsets, packets = pack_ragged(colours[index])
                times = (np.arange(num_sets) * 1e6 / 15).astype(np.int64)
                for key, values in (
                    ("colour", packets), ("colour_offsets", offsets), ("colour_time", times),
                    ("depth_time", times),
                ):  # fmt: skip
                    writer.put(f"cameras/{name}/{key}", values)
            if colour_times:
                times = 7_000_000 + np.rint(np.arange(num_sets) * 1e6 / 15).astype(np.int64)
                writer.put(f"cameras/{name}/colour_time", times)
    return path


def fill(writer: Writer, schema: artefacts.Schema, **dims: int) -> None:
    """Write zeros of sizes ``dims`` for the datasets of the schema that are still missing."""
    for key, declared in schema.fields.items():
        if declared.optional or "{camera}" in key or key in writer._file:
            continue
        shape = [int(d) if d.isdigit() else dims.get(d, 1) for d in declared.dims]
        empty = np.full(shape, "") if declared.dtype == "str" else np.zeros(shape, declared.dtype)
        writer.put(key, empty)
    for name in schema.attributes:
        writer.attributes.setdefault(name, "")


def write_scene(
    path: Path,
    rig: Rig,
    times: np.ndarray,
    backgrounds: Sequence[np.ndarray] = (),
    *,
    zup_from_master: np.ndarray | None = None,
    attributes: Mapping[str, object] | None = None,
    **values: np.ndarray,
) -> Path:
    """Write a scene artefact whose extrinsics were not refined.

    Args:
        backgrounds: depth (H, W) of the empty room for each camera, or none at all.
        zup_from_master: (4, 4), None if no floor was found.
        attributes: attributes that differ from their neutral values.
        values: datasets that differ from their neutral values.
    """
    sets, count, known = len(times), len(rig), zup_from_master is not None
    floor = invert(zup_from_master) if known else np.full((4, 4), np.nan)
    written = {
        **rig.datasets(),
        "master_from_colour": rig.master_from_colour,
        "master_from_colour_start": rig.master_from_colour,
        "present": np.ones(count, bool),
        "times": times,
        "time_offset_sigma": np.full(count, np.nan),
        "image_of": np.arange(sets)[:, None].repeat(count, 1),
        "ground_point": floor[:3, 3],
        "ground_normal": floor[:3, 2],
        "zup_from_master": zup_from_master if known else np.full((4, 4), np.nan),
        **values,
    }
    neutral = {
        "sequence": "test", "master": "k1", "fps": 15.0, "extrinsics_refined": False,
        "extrinsics_converged": False, "verdict": "", "ground_found": known,
        "ground_source": "fitted" if known else "none", "ground_rms": 0.0 if known else np.nan,
        "ground_inliers": 100 if known else 0,
    }  # fmt: skip
    with artefacts.write(path, SCENE, **(neutral | dict(attributes or {}))) as writer:
        for key, value in written.items():
            writer.put(key, value)
        fill(writer, SCENE, T=sets, C=count, P=len(values.get("pairs", ())))
        for name, background in zip(rig.names if backgrounds else (), backgrounds, strict=True):
            writer.put(f"cameras/{name}/background", background)
    return path


def write_person(
    path: Path, rig: Rig, masks: Sequence[bytes], sequence: str = "test", **values: np.ndarray
) -> Path:
    """Write a person artefact.

    Args:
        masks: RLE of each set and camera, sets first.
        values: datasets that differ from zero.
    """
    sets, count = len(masks) // len(rig), len(rig)
    offsets, runs = pack_ragged(masks)
    with artefacts.write(
        path, PERSON, sequence=sequence, images_alone=False, chosen_by="alone", doubts=""
    ) as writer:
        known = {"camera_names": rig.names, "mask_offsets": offsets, "mask_rle": runs,
                 "mask_source": np.ones((sets, count), np.int8)}  # fmt: skip
        for key, value in {**known, **values}.items():
            writer.put(key, value)
        fill(writer, PERSON, T=sets, C=count)
    return path
