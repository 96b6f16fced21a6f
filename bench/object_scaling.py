"""Time of a fit of the object's pose by views, faces, pixels and threads, and of drawing.

No recording is needed: a ring of Kinects sees the object from 2.2 m, its masks and depth are
drawn, and one frame is fitted from 2 cm and 5 degrees off. Each figure is the least of several
runs. Part of :mod:`bench.object_speed`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera
from intercap_core.geometry.camera.transforms import apply_step, rigid
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.render import Renderer
from intercap_core.geometry.rigid.shots import Shot, Surface
from intercap_core.object_track.fit import MotionPrior, fit_pose
from intercap_core.object_track.reduced_mask import EMPTY, ReducedMask, reduced_lens
from intercap_core.object_track.view import FitContext, MaskCandidate, View, ViewGeometry

VIEWS = (1, 2, 4, 6, 12, 16)
FACES = (150, 600, 2400, 10_000)
STEPS = (1, 2, 4)  # every n-th pixel of the colour and of the depth image
THREADS = (1, 2)
SHOTS = (6, 96)  # images drawn at once
USUAL_VIEWS, USUAL_FACES = 6, 600
REPEATS = 9
DISTANCE_M = 2.2
OFF = np.concatenate([np.radians(5) * np.ones(3), 0.02 * np.ones(3)]) / np.sqrt(3)
# The Azure Kinect's colour camera in 1080p and its depth camera in NFOV unbinned, typical lenses.
COLOUR = Intrinsics(
    1920, 1080, 913.0, 913.0, 957.0, 548.0,
    np.array([0.5, -2.7, 5e-4, -3e-4, 1.5, 0.38, -2.5, 1.4]),
)  # fmt: skip
DEPTH = Intrinsics(
    640, 576, 504.0, 504.0, 321.0, 335.0,
    np.array([5.6, 3.8, -1e-4, -2e-5, 0.2, 5.9, 5.6, 1.0]),
)  # fmt: skip


@dataclass(frozen=True, eq=False)
class Scene:
    """A mesh, the views of it and its true pose (4, 4), master_from_object."""

    mesh: ObjectMesh
    views: list[View]
    pose: np.ndarray

    @classmethod
    def make(cls, mesh: ObjectMesh, cameras: int = USUAL_VIEWS, step: int | None = None) -> Scene:
        """``step`` reduces all images; None as tracking does."""
        pose = rigid(Rotation.from_euler("zx", [40, 8], degrees=True).as_matrix(), np.zeros(3))
        views = []
        for number in range(cameras):
            geometry = ViewGeometry.for_object(
                _camera(2 * np.pi * number / cameras + 0.3), mesh.diameter, distance_m=DISTANCE_M
            )
            if step is not None:
                geometry = replace(
                    geometry,
                    lens=reduced_lens(COLOUR, step),
                    step=step,
                    depth_lens=reduced_lens(DEPTH, step),
                    depth_step=step,
                )
            views.append(_view(mesh, geometry, pose))
        return cls(mesh, views, pose)

    def fit(self, renderer: Renderer) -> np.ndarray:
        """The pose (4, 4) fitted as in a pass, from a little off."""
        start = apply_step(self.pose, OFF)
        prior = MotionPrior(start)
        context = FitContext(self.mesh, renderer=renderer)
        fit = fit_pose(context, self.views, start, prior=prior, rounds=(3, 3), start_scale=0.5)
        return fit.pose


def tracking_scaling(mesh: ObjectMesh) -> dict[str, float]:
    """Milliseconds a fit of one frame by views, faces, pixels and threads; of an image."""
    renderer = Renderer()
    usual = with_faces(mesh, USUAL_FACES)
    found = {}
    for count in VIEWS:
        scene = Scene.make(usual, count)
        found[f"fit_ms_views_{count}"] = _least_ms(lambda scene=scene: scene.fit(renderer))
    for faces in FACES:
        scene = Scene.make(with_faces(mesh, faces))
        found[f"fit_ms_faces_{faces}"] = _least_ms(lambda scene=scene: scene.fit(renderer))
    for step in STEPS:
        scene = Scene.make(usual, step=step)
        found[f"fit_ms_step_{step}"] = _least_ms(lambda scene=scene: scene.fit(renderer))
    scene = Scene.make(usual)
    for threads in THREADS:
        crew = Renderer(threads)
        found[f"fit_ms_threads_{threads}"] = _least_ms(lambda crew=crew: scene.fit(crew))
    for count in SHOTS:
        shots = _shots(scene, count)
        ms = _least_ms(lambda s=shots: renderer.draw(Surface.of(usual), s)) / count
        found[f"draw_ms_cpu_{count}_images"] = ms
    return found


def with_faces(mesh: ObjectMesh, count: int) -> ObjectMesh:
    """The mesh with about ``count`` faces: simplified, or each split in four as often as needed."""
    import trimesh

    vertices, faces = mesh.vertices, mesh.faces
    while len(faces) < count:
        vertices, faces = trimesh.remesh.subdivide(vertices, faces)
    fine = replace(mesh, vertices=np.asarray(vertices), faces=np.asarray(faces, np.int32))
    return fine.simplified(count, tolerance_m=np.inf)


def _camera(angle: float) -> Camera:
    """On a ring around the origin, looking at it from somewhat above."""
    eye = DISTANCE_M * np.array([0.92 * np.cos(angle), 0.92 * np.sin(angle), 0.39])
    forward = -eye / np.linalg.norm(eye)
    right = np.cross(forward, (0, 0, 1))
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward], 1)
    colour_from_depth = rigid(
        Rotation.from_rotvec([0.105, 0.0, 0.0]).as_matrix(), np.array([-0.032, -0.002, 0.004])
    )
    return Camera("k1", COLOUR, DEPTH, colour_from_depth, rigid(rotation, eye))


def _view(mesh: ObjectMesh, geometry: ViewGeometry, pose: np.ndarray) -> View:
    """What a camera sees of the object alone."""
    lens = geometry.depth_lens
    assert lens is not None
    silhouette, drawn = Renderer().draw(
        Surface.of(mesh),
        [
            Shot(geometry.lens, geometry.camera.colour_from_master @ pose),
            Shot(lens, geometry.camera.depth_from_master @ pose),
        ],
    )
    depth = np.zeros((lens.height, lens.width), np.float32)
    depth[drawn.window] = drawn.depth
    mask = ReducedMask(silhouette.x0, silhouette.y0, silhouette.mask)
    return View(geometry, depth, EMPTY, (MaskCandidate(0, mesh.name, mask),))


def _shots(scene: Scene, count: int) -> list[Shot]:
    """Colour images of poses all around, through the cameras in turn."""
    rng = np.random.default_rng(0)
    shots = []
    for number in range(count):
        geometry = scene.views[number % len(scene.views)].geometry
        turned = rigid(Rotation.random(rng=rng).as_matrix(), scene.pose[:3, 3])
        shots.append(Shot(geometry.lens, geometry.camera.colour_from_master @ turned))
    return shots


def _least_ms(work: Callable[[], object]) -> float:
    work()  # compiles, uploads
    seconds = []
    for _ in range(REPEATS):
        begin = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - begin)
    return round(1e3 * min(seconds), 3)
