"""The body's fit on people whose parameters are known."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from copy import deepcopy
from dataclasses import replace
from pathlib import Path

import h5py
import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from intercap_core import artefacts
from intercap_core.body.joints import JOINT_INDEX
from intercap_core.body.keypoints import KEYPOINT_NAMES, LEFT_HAND
from intercap_core.body.kinematics import rotation_from_axis_angle, vertex_normals
from intercap_core.body.loading import load_body_file
from intercap_core.body.model import BodyModel
from intercap_core.body_fit import evidence, uncertainty
from intercap_core.body_fit.clouds import person_clouds
from intercap_core.body_fit.observations import read_observations
from intercap_core.body_fit.problem import BodyProblem, columns_of
from intercap_core.body_fit.schedule import Fitter
from intercap_core.body_fit.surface import COVERINGS, choose_samples
from intercap_core.body_fit.term_inputs import keypoint_set
from intercap_core.body_fit.uncertainty import fit_covariances
from intercap_core.config import BodyFitSettings, BodyModels
from intercap_core.entries import SubjectEntry
from intercap_core.errors import UserError
from intercap_core.geometry.camera.transforms import apply
from intercap_core.geometry.solve import levenberg_marquardt
from intercap_core.geometry.solve.levenberg_marquardt import minimise
from intercap_core.schemas import BODY_FIT, BODY_PARTS, PERSON
from intercap_core.stages import body_fit
from tests.helpers.bodies import open_body
from tests.helpers.body_capture import (
    Inputs,
    exact_views,
    master_from_room,
    ring,
    write_capture,
)

SUBJECT = SubjectEntry(subject="s01", gender="neutral")
SETTINGS = BodyFitSettings(points_per_frame=800)
BODY_ALONE = BodyFitSettings(points_per_frame=800, hands=False, face=False)


def motion(model: BodyModel, frames: int, seed: int = 0) -> torch.Tensor:
    """Parameter vectors (T,P): somebody turns and waves in the middle of the ring."""
    random = np.random.default_rng(seed)
    x = model.zeros(frames).vector().double().numpy()
    phase = np.linspace(0, np.pi / 2, frames)
    x[:, 75:120], x[:, 120:165] = model.hand_mean.numpy()
    for side in (0, 1):
        size = 0.6 * model.hand_deviation[side, :6].numpy()
        bent = (random.standard_normal(6) * size) @ model.hand_components[side, :6].numpy()
        x[:, 75 + 45 * side : 120 + 45 * side] += bent
    for joint in range(1, 22):
        swing = 0.06 * random.standard_normal(3) * np.sin(phase + joint)[:, None]
        x[:, 3 * joint : 3 * joint + 3] += 0.06 * random.standard_normal(3) + swing
    x[:, 3 * JOINT_INDEX["left_shoulder"] + 2] -= 1.0
    x[:, 3 * JOINT_INDEX["right_shoulder"] + 2] += 0.7
    x[:, 3 * JOINT_INDEX["left_elbow"] + 1] -= 0.5 + 0.3 * np.sin(phase)
    x[:, 3 * JOINT_INDEX["right_elbow"] + 1] += 0.6
    x[:, 168:178] = 0.7 * random.standard_normal(10)
    x[:, 178:188] = 0.5 * random.standard_normal(10)
    room = master_from_room()
    room_from_body = Rotation.from_matrix([[0, 0, 1.0], [1, 0, 0], [0, 1, 0]])
    turning = Rotation.from_rotvec(np.outer(0.5 + phase, [0, 0, 1.0]))
    x[:, :3] = (Rotation.from_matrix(room[:3, :3]) * turning * room_from_body).as_rotvec()
    still = model.forward(model.zeros(), vertex_ids=np.array([0])).joints[0, 0].double().numpy()
    x[:, 165:168] = apply(room, np.array([[0.0, 0.1, 0.95]])) - still
    return torch.as_tensor(x, dtype=torch.float32)


def fit(inputs: Inputs, output: Path, person: Path | None = None, **options) -> dict:
    """Attributes and datasets of the fit to a capture, with another person artefact if given."""
    given = {"subject": SUBJECT, "body_models": BodyModels(), "settings": SETTINGS} | options
    body_fit.run(
        frames=inputs.frames, scene=inputs.scene, person=person or inputs.person, output=output,
        **given,
    )  # fmt: skip
    with artefacts.read(output, BODY_FIT) as read:
        return dict(read.attributes) | {key: read[key] for key in read.keys("")}


class Capture:
    """True vectors, vertices and joints, and the artefacts of a virtual recording."""

    def __init__(self, model: BodyModel, folder: Path, frames: int, **options) -> None:
        cameras = options.pop("cameras", 5)
        self.vectors = motion(model, frames)
        output = model.forward(model.parameters(self.vectors))
        self.vertices, self.joints = output.vertices.numpy(), output.joints.numpy()
        keypoints = model.keypoints(output).double().numpy()
        clothing = options.pop("clothing", 0.0)
        surface = self.vertices.astype(float)
        if clothing:
            covered = ~np.isin(
                model.skinning_weights.argmax(1).numpy(), [12, 15, 20, 21, 22, *range(25, 55)]
            )
            normals = vertex_normals(output.vertices, model.faces).double().numpy()
            surface += clothing * covered[:, None] * normals
        self.inputs: Inputs = write_capture(
            folder, ring(cameras), surface, model.faces.numpy(), keypoints, **options
        )

    def fit(self, output: Path, **options) -> dict:
        return fit(self.inputs, output, **options)

    def errors_mm(self, model: BodyModel, found) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Per frame: vertices, 22 joints, finger joints."""
        vector = model.zeros(len(self.vectors))
        for name in vars(vector):
            setattr(vector, name, torch.as_tensor(found[name]))
        output = model.forward(vector)
        vertices = np.linalg.norm(output.vertices.numpy() - self.vertices, axis=2).mean(1)
        joints = np.linalg.norm(found["joints"] - self.joints, axis=2)
        return tuple(1000 * e for e in (vertices, joints[:, :22].mean(1), joints[:, 25:].mean(1)))


OFFSET = np.array([0.0, 0.008, -0.008, 0.008, -0.006])


def walking(model: BodyModel, times: np.ndarray) -> torch.Tensor:
    """Parameter vectors (T,P) at any times: at 1.5 m/s, an arm swinging at up to 4 rad/s."""
    x = motion(model, 2)[:1].double().numpy().repeat(len(times), 0)
    x[:, 165:168] += np.outer(times - 0.2, master_from_room()[:3, :3] @ [1.0, 1.1, 0.0])
    x[:, 3 * JOINT_INDEX["right_shoulder"] + 1] += np.sin(4 * times)
    return torch.as_tensor(x, dtype=torch.float32)


def test_known_time_offsets_improve_a_moving_body(model, tmp_path):
    """Eight milliseconds at 1.5 m/s are 12 mm."""
    times = np.arange(5) / 15
    truth = model.forward(model.parameters(walking(model, times)))
    exposed = [model.forward(model.parameters(walking(model, times + late))) for late in OFFSET]
    errors = []
    for name, offset in (("given", OFFSET), ("not", np.zeros(5))):
        inputs = write_capture(
            tmp_path / name, ring(5), np.stack([o.vertices.double().numpy() for o in exposed], 1),
            model.faces.numpy(),
            np.stack([model.keypoints(o).double().numpy() for o in exposed], 1),
            time_offset=offset, depth=False,
        )  # fmt: skip
        found = fit(inputs, tmp_path / f"{name}.h5", settings=BODY_ALONE)
        apart = np.linalg.norm(found["joints"] - truth.joints.numpy(), axis=2)
        errors += [1000 * apart[:, :22].mean(), np.nanmedian(found["keypoint_residual"])]
    with_offsets, px, without, px_without = errors
    assert with_offsets < 0.7 * without and px < 0.3 * px_without


def test_exact_keypoints_alone_give_the_parameters_back() -> None:
    """With next to no noise assumed, E_J alone returns body, hands and face to under 1 mm."""
    model = open_body(torch.float64)
    truth = motion(open_body(), 1).double()
    points = model.keypoints_of(model.parameters(truth))
    start = truth + 0.03 * torch.randn(
        truth.shape, dtype=torch.float64, generator=torch.Generator().manual_seed(0)
    )
    start[:, 168:178] = 0
    start[:, 69:75] = truth[:, 69:75] = 0
    views = exact_views(points, ring(4), sigma=30.0)
    problem = BodyProblem(
        model=model, keypoints=keypoint_set(model, range(135)), samples=choose_samples(model),
        base=start, columns=columns_of(model, hands=True, face=True, betas=False), one_shape=True,
        offsets=start.new_zeros(25, 3), u=start.new_zeros(len(COVERINGS)), views=views,
    )  # fmt: skip
    # far from the minimum every residual would count as an outlier: widen, then narrow
    for sigma in (30.0, 3.0, 0.3, 0.003):
        views.sigma = torch.full_like(views.sigma, sigma)
        found = minimise(problem, problem.own_start(), problem.shared_start(), max_trials=20)
        problem.accept(found.own, found.shared)
    ours = model.forward(model.parameters(problem.base))
    true = model.forward(model.parameters(truth))
    # no keypoint determines how a bend of the back is distributed over the spine and the collars
    seen = np.unique(model.keypoint_map.joint[model.keypoint_map.joint >= 0])
    assert (ours.joints - true.joints)[:, seen].norm(dim=2).max() < 1e-3
    fitted = model.keypoints_of(model.parameters(problem.base))
    assert (fitted - points).norm(dim=2).max() < 1e-3


@pytest.fixture(scope="module")
def clothed(model: BodyModel, tmp_path_factory) -> tuple[Capture, dict, Path]:
    """Six frames in 10 mm of clothing, frame 3 empty; noise of 1.5 px and 3 mm."""
    folder = tmp_path_factory.mktemp("clothed")
    capture = Capture(
        model, folder, 6, missing=(3,), clothing=0.010, pixel_noise=1.5, depth_noise_mm=3.0
    )
    return capture, capture.fit(folder / "body_fit.h5"), folder


def test_a_clothed_person_is_fitted(model: BodyModel, clothed) -> None:
    capture, found, _ = clothed
    vertices, joints, hands = capture.errors_mm(model, found)
    seen = ~found["failed"]
    assert vertices[seen].mean() < 7 and joints[seen].mean() < 7 and hands[seen].mean() < 7
    assert np.ptp(found["betas"], axis=0).max() < 1e-6  # one shape
    assert found["gender"] == "neutral"
    assert np.nanmedian(found["keypoint_residual"]) < 4
    assert 0.002 < np.nanmedian(found["cloud_residual"]) < 0.015


def test_an_empty_frame_is_bridged_and_flagged(model: BodyModel, clothed) -> None:
    capture, found, _ = clothed
    assert found["failed"].tolist() == found["bridged"].tolist() == [t == 3 for t in range(6)]
    assert np.isnan(found["keypoint_residual"][3]).all() and np.isnan(found["cloud_residual"][3])
    _, joints, _ = capture.errors_mm(model, found)
    assert joints[3] < 40
    assert found["joint_sigma"][3].min() > 2 * np.median(found["joint_sigma"][2])
    steps = np.linalg.norm(np.diff(found["global_orient"], axis=0), axis=1)
    assert steps.max() < 1.0  # no jump by a full turn


def test_stated_uncertainty_has_the_size_of_the_error(clothed) -> None:
    capture, found, _ = clothed
    seen = ~found["failed"]
    error = np.linalg.norm(found["joints"] - capture.joints, axis=2)[seen][:, :22]
    normalised = error / (1.538 * found["joint_sigma"][seen][:, :22])
    assert 0.2 < np.median(normalised) < 2.5


def test_the_same_input_gives_the_same_bytes(clothed) -> None:
    capture, _, folder = clothed
    capture.fit(folder / "again.h5")
    assert (folder / "again.h5").read_bytes() == (folder / "body_fit.h5").read_bytes()


def test_blocks_change_neither_observations_nor_covariances(model, clothed, monkeypatch) -> None:
    """`tests/geometry/solve/test_levenberg_marquardt.py` has the same of the solver."""
    inputs = clothed[0].inputs
    seen = read_observations(inputs.scene, inputs.person)
    clouds = list(person_clouds(inputs.frames, inputs.person, seen, 800))
    fitter = Fitter(model, seen, clouds, SETTINGS)
    found = fitter.run()

    def observed() -> dict[str, torch.Tensor]:
        problem = fitter.resume(found.vectors, deepcopy(found.settled))
        fitter.observe(problem)
        pixels = fitter.evidence.pixel_residuals(problem)
        fitter.evidence.refine_cloud_noise(problem)
        return problem.rows._asdict() | {
            "pixels": pixels, "cloud noise": fitter.evidence.cloud_noise.clone(),
            "covariances": fit_covariances(model, found).joints,
        }  # fmt: skip

    whole = observed()
    monkeypatch.setattr(uncertainty, "CHUNK_FRAMES", 1)
    for module in (levenberg_marquardt, evidence, uncertainty):
        monkeypatch.setattr(module, "BLOCK_FRAMES", 2)
    for name, values in observed().items():
        expected = whole[name].numpy()
        # Single precision. Normals are of edges of 1 mm between vertices rounded to 0.2 um.
        atol = 5e-4 if name == "normal" else 1e-5 * np.nanmax(np.abs(expected))
        np.testing.assert_allclose(values.numpy(), expected, rtol=1e-4, atol=atol, err_msg=name)


def test_unseen_and_contradicted_parts_are_undetermined(model, clothed, tmp_path) -> None:
    """The left hand unseen in frame 1, the right leg guessed apart in frame 4."""
    capture, found, _ = clothed
    names = list(found["part_names"].astype(str))
    assert names == list(BODY_PARTS)
    seen = ~found["failed"]
    assert not found["undetermined"][seen].any() and found["undetermined"][~seen].all()
    assert not found["uncertain"].any()

    def guess(keypoints: np.ndarray) -> None:
        keypoints[1, :, LEFT_HAND] = 0
        shift = 60 * np.array([[1, 0], [0, 1], [-1, 0], [0, -1], [0.7, 0.7]])
        leg = [KEYPOINT_NAMES.index(f"right_{name}") for name in ("knee", "ankle", "heel")]
        keypoints[4][:, leg, :2] += shift[:, None]

    changed = with_keypoints(capture.inputs.person, tmp_path / "person.h5", guess)
    found = capture.fit(tmp_path / "body_fit.h5", person=changed)
    open_parts, failed = found["undetermined"], found["failed"]
    expected = np.zeros_like(open_parts)
    expected[3] = True
    expected[1, names.index("left_hand")] = expected[4, names.index("right_leg")] = True
    np.testing.assert_array_equal(open_parts, expected)
    assert failed.tolist() == [t == 3 for t in range(6)]


def with_keypoints(source: Path, target: Path, change: Callable[[np.ndarray], None]) -> Path:
    """A copy of a person artefact with its keypoints (T,C,135,3) changed in place."""
    with (
        artefacts.read(source, PERSON) as read,
        artefacts.write(
            target,
            PERSON,
            **{name: read.attributes[name] for name in ("sequence", *PERSON.attributes)},
        ) as writer,
    ):
        for key in read.keys(""):
            values = read.text(key) if key == "camera_names" else read[key]
            if key == "keypoints":
                change(values)
            writer.put(key, values)
    return target


def test_two_cameras_without_depth_are_enough(model: BodyModel, tmp_path: Path) -> None:
    capture = Capture(model, tmp_path, 3, cameras=5, depth=False, seen_by=(0, 1))
    found = capture.fit(tmp_path / "body_fit.h5")
    vertices, joints, hands = capture.errors_mm(model, found)
    assert not found["failed"].any()
    assert np.isnan(found["cloud_residual"]).all()
    assert vertices.max() < 25 and joints.max() < 25 and hands.max() < 30


def test_a_poor_recording_gets_the_shape_of_another(model: BodyModel, clothed, tmp_path) -> None:
    """Keypoints of two views, with noise. The other sequence is also named with a false shape."""
    _, known, folder = clothed
    poor = Capture(
        model, tmp_path, 3, cameras=5, depth=False, seen_by=(0, 1), clothing=0.01, pixel_noise=3.0
    )
    alone = poor.fit(tmp_path / "alone.h5")
    reused = poor.fit(tmp_path / "reused.h5", shape_from=folder / "body_fit.h5")
    truth = poor.vectors[0, 168:178].numpy()
    directions = load_body_file(None, 10, 10).shape_directions

    def off(found: dict) -> float:
        apart = directions @ (found["betas"][0] - truth)
        return float(np.linalg.norm(apart, axis=1).mean())

    assert off(reused) < 0.7 * off(alone)
    assert "shape_note" not in reused
    first, both = (np.diag(read["shared_covariance"]) for read in (known, reused))
    assert (both <= 1.001 * first).all()
    wrong = shutil.copy(folder / "body_fit.h5", tmp_path / "wrong.h5")
    with h5py.File(wrong, "r+") as file:
        file["betas"][:] += 3.0
    refused = poor.fit(tmp_path / "refused.h5", shape_from=wrong)
    assert "contradict the shape of sequence" in refused["shape_note"]
    np.testing.assert_array_equal(refused["joints"], alone["joints"])


def test_a_shape_of_another_kind_is_refused(clothed, tmp_path: Path) -> None:
    capture, _, folder = clothed
    for change, message in (
        ({"settings": SETTINGS.model_copy(update={"betas": 8})}, "number of betas .* 10, expected"),
        (
            {"subject": SUBJECT.model_copy(update={"subject": "s02"})},
            "subject .* expected s02",
        ),
    ):
        with pytest.raises(UserError, match=message):
            capture.fit(tmp_path / "out.h5", shape_from=folder / "body_fit.h5", **change)


def test_a_named_vposer_draws_the_fit_to_its_pose(model, tmp_path: Path) -> None:
    """The decoder of this file has one pose: spine1 bent by 0.4 rad about x."""
    names = [f"vp_model.decoder_net.{layer}" for layer in (0, 3, 5)]
    shapes = ((64, 32), (64, 64), (126, 64))
    state = {f"{n}.weight": torch.full(s, 1e-9) for n, s in zip(names, shapes, strict=True)}
    state |= {f"{n}.bias": torch.zeros(s[0]) for n, s in zip(names, shapes, strict=True)}
    pose = torch.zeros(21, 3)
    pose[2, 0] = 0.4
    state[f"{names[2]}.bias"] = rotation_from_axis_angle(pose)[..., :2].reshape(126)
    weights = tmp_path / "weights.pt"
    torch.save({"state_dict": state}, weights)
    capture = Capture(model, tmp_path, 1, cameras=3, depth=False)
    found = {}
    for name, models in (("open", BodyModels()), ("learned", BodyModels(vposer=weights))):
        read = capture.fit(tmp_path / f"{name}.h5", settings=BODY_ALONE, body_models=models)
        found[name] = np.abs(read["body_pose"] - pose.reshape(63).numpy()).mean()
    assert found["learned"] < 0.8 * found["open"]


def test_free_shape_in_every_frame(model: BodyModel, tmp_path: Path) -> None:
    capture = Capture(model, tmp_path, 2)
    settings = BODY_ALONE.model_copy(update={"shape": "per_frame"})
    found = capture.fit(tmp_path / "body_fit.h5", settings=settings)
    _, joints, _ = capture.errors_mm(model, found)
    assert joints.max() < 20
    assert np.ptp(found["betas"], axis=0).max() > 1e-6
    np.testing.assert_allclose(found["left_hand_pose"][0], model.hand_mean[0], atol=1e-6)


def test_a_recording_without_a_person_is_reported(model: BodyModel, tmp_path: Path) -> None:
    capture = Capture(model, tmp_path, 2, missing=(0, 1), cameras=2)
    with pytest.raises(UserError, match="in none of its 2 frames"):
        capture.fit(tmp_path / "body_fit.h5")


def test_artefacts_of_another_recording_are_refused(model, clothed, tmp_path: Path) -> None:
    capture, _, _ = clothed
    other = Capture(model, tmp_path, 2, cameras=2, depth=False)
    with pytest.raises(UserError, match="re-run stage"):
        other.fit(tmp_path / "out.h5", person=capture.inputs.person)


def test_a_body_with_strong_blend_shapes_is_fitted(tmp_path):
    """A bend moves the skin around its joint by a centimetre and more."""
    file = load_body_file(None, 10, 10)
    joints = (file.joint_regressor @ file.template)[1:]
    size = np.where(np.arange(1, 55) < 22, 0.012, 0.002)
    away = np.linalg.norm(file.template[:, None] - joints, axis=2) / np.where(
        size > 0.01, 0.08, 0.02
    )
    near = (size * np.exp(-(away**2) / 2)).repeat(9, 1)
    moves = near[:, None] * np.random.default_rng(5).standard_normal((3, 486))
    model = BodyModel(replace(file, posedirs=moves), torch.device("cpu"), torch.float32)
    capture = Capture(model, tmp_path, 2, cameras=4, pixel_noise=1.0, depth_noise_mm=3.0)
    seen = read_observations(capture.inputs.scene, capture.inputs.person)
    clouds = list(person_clouds(capture.inputs.frames, capture.inputs.person, seen, 800))
    vectors = Fitter(model, seen, clouds, SETTINGS).run().vectors
    found = model.forward(model.parameters(vectors)).joints.numpy()
    assert 1000 * np.linalg.norm(found - capture.joints, axis=2)[:, :22].mean() < 6
