"""Physics of a sequence: a ball on the floor, above it, and without a closed mesh."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from intercap_core.artefacts import read
from intercap_core.evaluation.physics.carriers import Carrier
from intercap_core.evaluation.physics.judge import judge_physics
from intercap_core.flags import PARTS, Flags
from intercap_core.geometry.camera.transforms import invert
from intercap_core.schemas import METRICS, SCENE
from tests.helpers import fitted_capture as fitted


def at_rest(capture: fitted.Capture, folder: Path, above_m: float) -> fitted.Capture:
    """The capture with the ball at rest, its lowest point ``above_m`` over the floor."""
    pytest.importorskip("mujoco", reason="the extra physics is not installed")
    lying = capture.copied(folder, "joint", "object_track")
    with read(capture.paths["scene"], SCENE) as scene:
        master_from_up = invert(scene["zup_from_master"])
    ball = capture.mesh.vertices
    pose = master_from_up.copy()
    pose[:3, 3] += master_from_up[:3, :3] @ [2.0, 0.0, above_m - ball[:, 2].min()]
    for stage in ("joint", "object_track"):
        with lying.edit(stage) as file:
            file["rotation"][...], file["translation"][...] = pose[:3, :3], pose[:3, 3]
            if stage == "joint":
                file["contact_probability"][...] = 0.0
            else:
                file["lost"][...], file["resting"][...] = False, True
                file["covariance"][...] = np.eye(6) * 0.001**2
    return lying


def judge(capture: fitted.Capture, folder: Path, above_m: float):
    """Physics of :func:`at_rest`, without a pose that the images confirm."""
    frames = len(capture.translation)
    paths = at_rest(capture, folder, above_m).inputs("scene", "joint", "object_track")
    return judge_physics(
        capture.mesh, paths, np.full(frames, 0.1), Flags.of(frames, []), np.full(frames, 0.3)
    )


def test_a_ball_on_the_floor_stays(capture: fitted.Capture, tmp_path: Path) -> None:
    values, note = judge(capture, tmp_path, 0.004)
    assert note == "" and set(values["carrier"]) == {Carrier.FLOOR}
    assert set(values["release_support"]) == {"floor"}
    assert values["release_displacement"] == pytest.approx(0.004, abs=0.001)
    assert values["penetration"] == pytest.approx(0, abs=1e-6) and not values["bad"].any()


def test_a_ball_below_the_floor_is_bad(capture: fitted.Capture, tmp_path: Path) -> None:
    values, _ = judge(capture, tmp_path, -0.08)
    assert values["penetration"] == pytest.approx(0.08, abs=1e-6) and values["bad"].all()


def test_a_ball_in_the_air_is_unsupported(capture: fitted.Capture, tmp_path: Path) -> None:
    values, note = judge(capture, tmp_path, 0.8)
    assert "the scene holds no surface under it" in note
    assert not len(values["release_frame"])
    assert set(values["carrier"]) == {Carrier.UNSUPPORTED, Carrier.UNDETERMINED}
    assert (values["bad"] == [name == Carrier.UNSUPPORTED for name in values["carrier"]]).all()


def test_a_ball_on_a_rope_is_reported_and_not_judged(
    tmp_path_factory: pytest.TempPathFactory, tmp_path: Path
) -> None:
    """By stage metrics: the images show a ball at rest in the air, and nothing that carries it."""
    frames = 14  # at 15 frames per second; support is unknown in the first and the last two
    hanging = at_rest(fitted.shared_capture(tmp_path_factory, frames), tmp_path, 0.8)
    with hanging.edit("joint") as file:
        file["flagged"][...] = False
        file["flag_reason"][...] = b""
    with read(hanging.measure(tmp_path / "metrics.h5", hold_out=False), METRICS) as metrics:
        note = str(metrics.attributes["physics_note"])
        carriers = metrics.text("physics/carrier")
        assert carriers[2:-2] == [Carrier.UNKNOWN] * (frames - 4)
        assert not metrics["physics/bad"].any()
        assert not metrics["flagged"][:, PARTS.index("object")].any()
        assert not len(metrics["physics/release_frame"])
    assert f"frames 2 to {frames - 3}: held by something unknown" in note
    assert f"frames 0 to {frames - 1} not judged: the scene holds no surface under it" in note


def test_an_open_mesh_is_named(capture: fitted.Capture, tmp_path: Path) -> None:
    opened = replace(capture, mesh=replace(capture.mesh, watertight=False))
    values, note = judge(opened, tmp_path, 0.0)
    assert not values and "not closed" in note
