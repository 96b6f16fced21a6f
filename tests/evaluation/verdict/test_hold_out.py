"""Held-out evaluation of a small capture whose joint result is 10 mm too low."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.body.joints import FIRST_FINGER, NUM_JOINTS
from intercap_core.config import JointSettings
from intercap_core.evaluation.verdict.hold_out import (
    HeldOut,
    JudgedPart,
    JudgedPoints,
    hold_out,
)
from intercap_core.evaluation.verdict.judge import reach_verdict
from intercap_core.joint.assembly import assemble
from intercap_core.joint.equations import BandedEquations
from intercap_core.joint.inputs import JointInputs, open_inputs
from intercap_core.joint.minimise import limited
from intercap_core.joint.result import OBJECT_INSIDE, JointResult
from intercap_core.joint.state import BODY, OBJECT, State
from intercap_core.schemas import SCENE
from tests.helpers import fitted_capture as fitted

STAGES = ("frames", "scene", "detections", "person", "object_track", "body_fit")


@pytest.fixture(scope="module")
def capture(tmp_path_factory: pytest.TempPathFactory) -> fitted.Capture:
    return fitted.shared_capture(tmp_path_factory, total=6)


@contextmanager
def _opened(
    capture: fitted.Capture,
) -> Iterator[tuple[JointInputs, JointSettings, JointResult]]:
    with artefacts.read(capture.paths["scene"], SCENE) as scene:
        result = JointResult.read(capture.paths["joint"], scene)
    with open_inputs(capture.inputs(*STAGES), capture.models, fitted.FIT_SETTINGS) as inputs:
        yield inputs, fitted.FIT_SETTINGS.joint, result


def _held(capture: fitted.Capture) -> HeldOut:
    with _opened(capture) as opened:
        held = hold_out(*opened)
    assert held is not None
    return held


@pytest.fixture(scope="module")
def held(capture: fitted.Capture) -> HeldOut:
    return _held(capture)


def test_every_camera_is_held_out_in_turn(held: HeldOut) -> None:
    np.testing.assert_array_equal(held.cameras, [0, 1, 2])
    # 0.2 s at 15 frames a second
    np.testing.assert_array_equal(held.camera_index, [0, 0, 0, 1, 1, 1])
    for part in JudgedPart:
        assert held.shift[part].shape == (3, 6)
        assert np.isfinite(held.shift[part]).all()
        assert np.isfinite(held.repeated[part]).all()


def test_only_the_held_out_camera_judges_a_frame(held: HeldOut) -> None:
    for name, without in vars(held.held_out).items():
        judged = np.isfinite(without)
        assert not judged[np.arange(3) != held.camera_index[:, None]].any(), name
    assert np.isfinite(held.held_out.keypoint_px).sum() == 6


def test_errors_of_the_result_in_all_cameras(held: HeldOut) -> None:
    # the result stands 10 mm below the true keypoints, 2.4 m from cameras of 230 px
    expected = fitted.BODY_OFFSET_M * 230 / 2.4
    assert np.median(held.all_cameras.keypoint_px) == pytest.approx(expected, rel=0.1)
    assert held.all_cameras.overlap[1:].min() > 0.9  # the first frame's object is lost
    assert np.isnan(held.all_cameras.overlap[0]).all()


def test_wrong_camera_has_a_large_held_out_error(
    capture: fitted.Capture, held: HeldOut, tmp_path: Path
) -> None:
    lying = capture.copied(tmp_path, "person")
    with lying.edit("person") as file:
        file["keypoints"][:, 1, :, 0] += 3.0  # px, to the side
    lie = _held(lying)
    before, after = (np.mean(h.shift[JudgedPart.BODY], axis=1) for h in (held, lie))
    # of what the lie is worth at the person's distance
    assert ((after - before) > 0.05 * 3.0 * 2.4 / 230).all()
    mine = lie.camera_index == 1
    seen = lie.held_out.keypoint_px[mine, 1], lie.all_cameras.keypoint_px[mine, 1]
    assert np.median(seen[0]) > np.median(seen[1])  # a fit without it does not follow the lie


def test_windows_give_the_values_of_the_whole_recording(
    capture: fitted.Capture, held: HeldOut, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("intercap_core.evaluation.verdict.hold_out.MARGIN", 2)
    with _opened(capture) as (inputs, settings, result):
        joined = hold_out(inputs, settings, result, window=3)
    assert joined is not None
    np.testing.assert_array_equal(joined.camera_index, held.camera_index)
    for name, errors in vars(held.all_cameras).items():
        np.testing.assert_allclose(getattr(joined.all_cameras, name), errors, rtol=1e-4)
    for name, errors in vars(held.held_out).items():
        np.testing.assert_allclose(getattr(joined.held_out, name), errors, rtol=0.05)
    for part in (JudgedPart.BODY, JudgedPart.HANDS):
        # ``repeated`` follows from the noise of the poses, which five frames do not tell
        for name in ("shift", "surface", "common"):
            found, expected = (getattr(one, name)[part] for one in (joined, held))
            np.testing.assert_allclose(found, expected, rtol=0.1, atol=1e-4, err_msg=name)


def test_a_window_of_the_inputs_has_the_data_of_its_frames(capture: fitted.Capture) -> None:
    def compared(inputs: JointInputs, state: State) -> list[np.ndarray]:
        assembly = assemble(inputs, fitted.FIT_SETTINGS.joint)
        assembly.body.refresh(state)
        assembly.object_.refresh(state)
        reports = sorted((t, c, r.overlap) for t, c, r in assembly.object_.reports())
        everything = np.ones((len(state), 3, 2), bool)
        hessian, gradient, _ = assembly.body.linearise_views(everything, state)
        # priors of the hands count once in half a second, or once in fewer frames
        fingers = slice(3 * FIRST_FINGER, 3 * NUM_JOINTS)
        return [
            np.delete(np.delete(hessian, fingers, 1), fingers, 2),
            np.delete(gradient, fingers, 1),
            assembly.body.residuals().keypoint_px,
            assembly.body.person_by_view(),
            np.array([overlap for _, _, overlap in reports]).reshape(-1, 3),
        ]

    frames = slice(2, 5)
    with _opened(capture) as (inputs, _, result):
        whole = compared(inputs, result.state)
        part = compared(inputs.window(frames), result.state.window(frames))
    whole[-1] = np.vstack([np.full((1, 3), np.nan), whole[-1]])  # the first frame's object is lost
    for of_all, of_some in zip(whole, part, strict=True):
        tolerance = 1e-6 * np.nanmax(np.abs(of_all))  # single precision
        np.testing.assert_allclose(of_some, of_all[frames], rtol=1e-5, atol=tolerance)


def test_one_step_agrees_with_an_iterated_refit(capture: fitted.Capture, held: HeldOut) -> None:
    """Compare with Gauss-Newton steps that search the correspondences again."""
    with _opened(capture) as (inputs, settings, result):
        assembly = assemble(inputs, settings)
        assembly.contact.take_contact(result.probability, result.annotated)

        def descended(used: np.ndarray) -> State:
            state = result.state
            for _ in range(3):
                assembly.problem.refresh(state)
                equations = BandedEquations(len(state))
                for term in assembly.problem.terms:
                    if term is not assembly.body and term is not assembly.object_:
                        term.add(state, equations)
                for columns, data in ((BODY, assembly.body), (OBJECT, assembly.object_)):
                    equations.add_blocks(data.name, columns, *data.linearise_views(used, state))
                step = equations.step(np.full(len(state), 1e-6))
                assert step is not None
                state = state.moved(limited(step))
            return state

        used = np.ones((6, 3, 2), bool)
        every = descended(used)
        used[:, 1] = False
        without = descended(used)
        points = JudgedPoints(inputs)
        apart = points.apart(points.at(every), points.at(without))[JudgedPart.BODY]
    moved = np.sqrt((apart**2).mean())
    found = np.sqrt((held.shift[JudgedPart.BODY][1] ** 2).mean())
    assert found == pytest.approx(moved, rel=0.35, abs=2e-4)


def test_common_error_is_the_displacement_that_moved_cameras_cause(
    capture: fitted.Capture,
) -> None:
    """The response of the fit to a shift of all cameras, against Gauss-Newton steps."""
    with _opened(capture) as (inputs, settings, result):
        assembly = assemble(inputs, settings)
        assembly.contact.take_contact(result.probability, result.annotated)
        shift = np.zeros((len(result.camera_covariance), 7))
        shift[:, 3] = 0.002  # 2 mm along the master's x axis
        covariance = np.multiply.outer(shift, shift)
        held = hold_out(inputs, settings, replace(result, camera_covariance=covariance))
        assert held is not None
        # all data move by 2 mm, and no term holds the body back
        np.testing.assert_allclose(held.common[JudgedPart.BODY], 0.002, rtol=0.1)
        np.testing.assert_allclose(held.common[JudgedPart.HANDS], 0.002, rtol=0.1)
        np.testing.assert_allclose(held.common[JudgedPart.OBJECT][1:], 0.002, rtol=0.1)


def test_displacements_along_steps_agree_with_finite_differences(capture: fitted.Capture) -> None:
    with _opened(capture) as (inputs, _, result):
        points, state = JudgedPoints(inputs), result.state
        step = np.random.default_rng(3).normal(0, 1e-5, (len(state), 174))
        along = points.along(state, step[..., None])
        apart = points.apart(points.at(state), points.at(state.moved(step)))
    for part, value in along.items():
        np.testing.assert_allclose(value, apart[part], rtol=0.02, err_msg=str(part))


def test_without_surface_points_only_keypoints_hold_the_body(
    capture: fitted.Capture, held: HeldOut, tmp_path: Path
) -> None:
    """Keypoints that all views displace alike do not show in any held-out camera."""
    lying = capture.copied(tmp_path, "person")
    with lying.edit("person") as file:
        file["keypoints"][..., 1] += 4.0  # px, downwards in all views
    lie = _held(lying)
    more = lie.surface[JudgedPart.BODY].mean() - held.surface[JudgedPart.BODY].mean()
    cameras = [h.shift[JudgedPart.BODY].mean() for h in (held, lie)]
    assert more > 0.2 * 4.0 * 2.4 / 230  # of what the lie is worth at the person's distance
    assert more > 2 * abs(cameras[1] - cameras[0])


def test_single_camera_has_no_verdict(capture: fitted.Capture, tmp_path: Path) -> None:
    single = capture.copied(tmp_path, "person")
    with single.edit("person") as file:
        file["keypoints"][:, 1:, :, 2] = 0  # no other camera sees a keypoint
    paths = single.inputs(*STAGES, "joint")
    values = reach_verdict(paths, capture.models, fitted.FIT_SETTINGS)
    assert np.isnan(values["error"]).all()
    assert all("fewer than two cameras" in reason for reason in values["silent"])
    assert "shift" not in values


def test_no_error_is_stated_if_body_and_object_are_inside_each_other(
    capture: fitted.Capture, tmp_path: Path
) -> None:
    wrong = capture.copied(tmp_path, "joint")
    with wrong.edit("joint") as file:
        del file["flag_reason"]
        file["flag_reason"] = np.array([OBJECT_INSIDE.encode()] * 4 + [b""] * 2)
    values = reach_verdict(wrong.inputs(*STAGES, "joint"), capture.models, fitted.FIT_SETTINGS)
    assert list(values["part_names"]) == ["body", "hands", "object"]
    assert np.isnan(values["error"]).all()
    assert all("not contradicted" in reason for reason in values["silent"])
