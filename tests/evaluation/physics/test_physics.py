"""Physics: closed forms of rest, fall and support."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from intercap_core.evaluation.physics.carriers import (
    HELD_S,
    Carrier,
    Distances,
    find_carriers,
    support_acceleration,
)
from intercap_core.evaluation.physics.rest_test import GRAVITY, RELEASED_FRAMES
from intercap_core.evaluation.physics.supports import StaticScene
from intercap_core.geometry.camera.transforms import rigid, rotation_exp
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.geometry.rigid.symmetry import SymmetryGroup

FPS = 30.0


def solid(mesh: trimesh.Trimesh) -> ObjectMesh:
    count = len(mesh.vertices)
    return ObjectMesh(
        "object",
        np.asarray(mesh.vertices, np.float64),
        np.asarray(mesh.faces, np.int32),
        np.arange(count),
        SymmetryGroup.none(),
        np.full((count, 3), 128, np.uint8),
    )


BOX = solid(trimesh.creation.box((0.2, 0.3, 0.4)))


def at(height: float, turn: tuple[float, float, float] = (0, 0, 0)) -> np.ndarray:
    return rigid(rotation_exp(np.array(turn, float)), np.array([1.0, -2.0, height]))


@pytest.fixture(scope="module")
def box():
    pytest.importorskip("mujoco", reason="the extra physics is not installed")
    from intercap_core.evaluation.physics.rest_test import FallingBody

    return FallingBody(BOX)


def test_a_standing_box_stays(box) -> None:
    assert box.displacement(at(0.2), FPS) < 0.0005


@pytest.mark.parametrize("error", [0.01, -0.01])
def test_an_error_of_the_height_is_the_displacement(box, error: float) -> None:
    assert box.displacement(at(0.2 + error), FPS) == pytest.approx(0.01, abs=0.001)


def test_a_box_in_the_air_falls_as_a_stone(box) -> None:
    seconds = RELEASED_FRAMES / FPS
    fallen = box.displacement(at(50.0), FPS)
    assert fallen == pytest.approx(GRAVITY * seconds**2 / 2, rel=0.005)


def test_a_box_falls_over_beyond_its_balance(box) -> None:
    # the centre of mass leaves the base of 0.3 m at atan(0.15 / 0.2) = 36.9 degrees
    moved = []
    for degrees in (30.0, 43.0):
        pose = at(0.0, (np.radians(degrees), 0, 0))
        pose[2, 3] -= box.gap(pose[None])[0]
        box_before = pose[2, 3]
        moved.append(box.displacement(pose, 15.0))
        assert box_before > 0.2
    # standing again: the centre returns above the base; lying: it is 0.15 m high
    assert moved[0] < 0.15 < moved[1]


def test_a_repeated_release_is_identical(box) -> None:
    pose = at(0.25, (0.3, 0.1, 0.2))
    assert box.displacement(pose, FPS) == box.displacement(pose, FPS)


def test_the_gap_is_the_lowest_corner(box) -> None:
    poses = np.stack([at(0.3), at(0.1)])
    assert np.allclose(box.gap(poses), [0.1, -0.1])


def table(height: float, half: float = 0.4) -> np.ndarray:
    x, y = np.meshgrid(np.arange(-half, half, 0.01), np.arange(-half, half, 0.01))
    noise = np.random.default_rng(0).normal(0, 0.002, x.size)
    return np.column_stack([x.ravel() + 1, y.ravel() - 2, height + noise])


def support(scene: StaticScene, pose: np.ndarray):
    shape = BOX.vertices @ pose[:3, :3].T + pose[:3, 3]
    return scene.support_under(shape, pose[:3, 3], 0.002)


def test_floor_and_furniture_carry() -> None:
    scene = StaticScene(True, True, table(0.7))
    assert support(scene, at(0.21)).name == "floor"
    found = support(scene, at(0.91))
    assert found.name == "furniture" and found.height == pytest.approx(0.7, abs=0.001)


def test_a_support_that_the_scene_does_not_hold_is_named() -> None:
    scene = StaticScene(True, True, table(0.7))
    assert "no surface" in support(scene, at(1.5)).reason
    assert "no surface" in support(StaticScene(False, False, np.zeros((0, 3))), at(0.2)).reason
    shifted = at(0.9)
    shifted[0, 3] += 0.45
    assert "does not lie above its support" in support(scene, shifted).reason
    rough = table(0.7)
    rough[:, 2] += np.random.default_rng(1).uniform(-0.03, 0.03, len(rough))
    assert "not level" in support(StaticScene(True, True, rough), at(0.9)).reason


TIMES = np.arange(40) / FPS


def test_acceleration_of_rest_and_flight() -> None:
    sigma = np.full(40, 0.002)
    resting, deviation = support_acceleration(np.full(40, 0.8), sigma, TIMES)
    flying, _ = support_acceleration(5 * TIMES - GRAVITY / 2 * TIMES**2, sigma, TIMES)
    inner = slice(2, -2)
    assert np.allclose(resting[inner], GRAVITY) and np.allclose(flying[inner], 0, atol=1e-9)
    assert np.isnan(resting[:2]).all()
    noise = np.random.default_rng(0).normal(0, 0.002, (300, 40))
    spread = np.std([support_acceleration(z, sigma, TIMES)[0][20] for z in noise])
    assert spread == pytest.approx(deviation[20], rel=0.15)


def carriers(height: np.ndarray, *, confirmed: bool, **near: float) -> list[str]:
    far = {name: np.full(40, near.get(name, 0.5)) for name in ("body", "floor", "furniture")}
    sigma = np.full(40, 0.002)
    every = np.ones(40, bool)
    distances = Distances(**far, sigma=sigma, touched=~every, body_known=every)
    acceleration = support_acceleration(height, sigma, TIMES)
    found = find_carriers(distances, *acceleration, every & confirmed, TIMES)
    return list(found[5:-5])


HANGING = np.full(40, 0.8)
FLIGHT = 5 * TIMES - GRAVITY / 2 * TIMES**2


@pytest.mark.parametrize(
    "height,confirmed,near,expected",
    [
        (HANGING, False, {}, Carrier.UNSUPPORTED),
        (HANGING, True, {}, Carrier.UNKNOWN),
        (FLIGHT, False, {}, Carrier.NOTHING),
        (HANGING, False, {"body": 0.003}, Carrier.BODY),
        (HANGING, False, {"floor": 0.003}, Carrier.FLOOR),
        (HANGING, False, {"furniture": 0.003}, Carrier.FURNITURE),
        (HANGING, False, {"body": 0.02}, Carrier.UNDETERMINED),
        (HANGING, False, {"furniture": np.nan}, Carrier.UNDETERMINED),
    ],
)
def test_carriers(height, confirmed, near, expected) -> None:
    assert set(carriers(height, confirmed=confirmed, **near)) == {expected}


def test_a_short_confirmed_gap_is_not_determined() -> None:
    height = np.full(40, 0.8)
    sigma, every = np.full(40, 0.002), np.ones(40, bool)
    body = np.full(40, 0.002)
    body[15 : 15 + int(HELD_S * FPS / 2)] = 0.2
    far = np.full(40, 0.5)
    distances = Distances(body, far, far, sigma, ~every, every)
    found = find_carriers(distances, *support_acceleration(height, sigma, TIMES), every, TIMES)
    assert set(found) == {Carrier.BODY, Carrier.UNDETERMINED}


def test_catalogue_objects_stand(box) -> None:
    from intercap_core.evaluation.physics.rest_test import FallingBody
    from intercap_core.project import load_project

    objects = load_project(Path("config/object/config.yaml")).objects
    for name in ("football", "stool", "cup"):
        body = FallingBody(ObjectMesh.load(objects[name]))
        pose = at(0.0)
        pose[2, 3] -= body.gap(pose[None])[0]
        assert body.displacement(pose, 15.0) < 0.001, name
