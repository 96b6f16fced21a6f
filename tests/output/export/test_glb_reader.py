"""The animated file, opened by pygltflib and played at moments between its frames as the format
says: nodes, linear and spherical interpolation, skin."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pygltflib
import pytest
import torch
import trimesh
from scipy.spatial.transform import Rotation, Slerp

from intercap_core.body.parameters import BodyParameters
from intercap_core.output.export.motion import Motion, read_motion, rest_pose
from tests.helpers import exported
from tests.helpers import fitted_capture as fitted

TYPES = {5121: np.uint8, 5123: np.uint16, 5125: np.uint32, 5126: np.float32}
WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT4": 16}
YUP_FROM_ZUP = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])


@dataclass
class Player:
    """A file as pygltflib has it, evaluated at a time."""

    file: pygltflib.GLTF2

    def values(self, accessor: int) -> np.ndarray:
        entry = self.file.accessors[accessor]
        view = self.file.bufferViews[entry.bufferView]
        start = (view.byteOffset or 0) + (entry.byteOffset or 0)
        kind, width = TYPES[entry.componentType], WIDTHS[entry.type]
        values = np.frombuffer(self.file.binary_blob(), kind, entry.count * width, start)
        return values.reshape(entry.count, width)

    @cached_property
    def parents(self) -> dict[int, int]:
        return {c: n for n, node in enumerate(self.file.nodes) for c in node.children or ()}

    def node(self, name: str) -> int:
        return next(n for n, node in enumerate(self.file.nodes) if node.name == name)

    def places(self, time: float) -> list[np.ndarray]:
        """Pose (4, 4) of each node in the scene."""
        nodes = self.file.nodes
        turns = [Rotation.from_quat(node.rotation or [0, 0, 0, 1]) for node in nodes]
        shifts = [np.array(node.translation or [0.0, 0, 0]) for node in nodes]
        (animation,) = self.file.animations
        for channel in animation.channels:
            sampler = animation.samplers[channel.sampler]
            assert sampler.interpolation == "LINEAR"
            times, keys = self.values(sampler.input).ravel(), self.values(sampler.output)
            if channel.target.path == "rotation":
                # the shorter way, as players take it, where keys lie in one hemisphere
                assert (np.einsum("ti,ti->t", keys[1:], keys[:-1]) >= 0).all()
                turns[channel.target.node] = Slerp(times, Rotation.from_quat(keys))(time)
            else:
                shift = [np.interp(time, times, keys[:, i]) for i in range(3)]
                shifts[channel.target.node] = np.array(shift)
        local = []
        for turn, shift in zip(turns, shifts, strict=True):
            pose = np.eye(4)
            pose[:3, :3], pose[:3, 3] = turn.as_matrix(), shift
            local.append(pose)
        return [self._in_scene(n, local) for n in range(len(nodes))]

    def _in_scene(self, node: int, local: list[np.ndarray]) -> np.ndarray:
        up = self.parents.get(node)
        return local[node] if up is None else self._in_scene(up, local) @ local[node]

    def body(self, time: float) -> np.ndarray:
        (skin,) = self.file.skins
        node = self.file.nodes[self.node("body")]
        attributes = self.file.meshes[node.mesh].primitives[0].attributes
        rest = self.values(attributes.POSITION).astype(float)
        inverse = self.values(skin.inverseBindMatrices).reshape(-1, 4, 4).transpose(0, 2, 1)
        places = self.places(time)
        matrices = np.stack([places[joint] for joint in skin.joints]) @ inverse
        weights = self.values(attributes.WEIGHTS_0)
        blended = (matrices[self.values(attributes.JOINTS_0)] * weights[..., None, None]).sum(1)
        return np.einsum("vij,vj->vi", blended[:, :3, :3], rest) + blended[:, :3, 3]

    def object_(self, name: str, time: float) -> np.ndarray:
        node = self.node(name)
        attributes = self.file.meshes[self.file.nodes[node].mesh].primitives[0].attributes
        place = self.places(time)[node]
        return self.values(attributes.POSITION) @ place[:3, :3].T + place[:3, 3]


@pytest.fixture
def path(upright: Path) -> Path:
    return upright / "glb" / f"{exported.NAME}.glb"


@pytest.fixture(scope="module")
def motion(lively: fitted.Capture, zup_from_master: np.ndarray) -> Motion:
    read = read_motion(lively.paths["joint"], fitted.FPS, fitted.BODY_MODELS, "neutral")
    return read.moved(zup_from_master, "z-up")


def _between(motion: Motion, at: float) -> BodyParameters:
    """The body ``at`` so many frames: turns of joints the shorter way, the first face."""
    times, poses = np.arange(len(motion)), motion.parameters.full_pose().numpy()
    turns = [Slerp(times, Rotation.from_rotvec(poses[:, j]))(at).as_rotvec() for j in range(55)]
    shift = [np.interp(at, times, motion.parameters.transl.numpy()[:, i]) for i in range(3)]
    first = motion.parameters.frames(slice(0, 1))
    pose = torch.as_tensor(np.concatenate(turns))[None]
    return BodyParameters(
        betas=first.betas.float(),
        expression=first.expression.float(),
        global_orient=pose[:, :3].float(),
        body_pose=pose[:, 3:66].float(),
        jaw_pose=pose[:, 66:69].float(),
        leye_pose=pose[:, 69:72].float(),
        reye_pose=pose[:, 72:75].float(),
        left_hand_pose=pose[:, 75:120].float(),
        right_hand_pose=pose[:, 120:].float(),
        transl=torch.as_tensor(np.array(shift))[None].float(),
    )


def test_accessors_are_aligned_bounded_and_finite(path: Path) -> None:
    player = Player(pygltflib.GLTF2().load(str(path)))
    for index, entry in enumerate(player.file.accessors):
        view, values = player.file.bufferViews[entry.bufferView], player.values(index)
        assert view.byteOffset % 4 == 0 and values.nbytes == view.byteLength
        assert np.isfinite(values).all()
        if entry.min:
            assert (values.min(0).tolist(), values.max(0).tolist()) == (entry.min, entry.max)
    times = player.values(player.file.animations[0].samplers[0].input).ravel()
    assert times == pytest.approx(np.arange(4) / fitted.FPS)
    skinned = player.file.meshes[player.file.nodes[player.node("body")].mesh].primitives[0]
    assert player.values(skinned.attributes.WEIGHTS_0).sum(1) == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("at", [0.0, 1.25, 3.0])
def test_body_and_object_agree_at_any_time(
    at: float, path: Path, motion: Motion, lively: fitted.Capture
) -> None:
    player = Player(pygltflib.GLTF2().load(str(path)))
    time = at / fitted.FPS
    with torch.no_grad():
        expected = motion.model.forward(_between(motion, at)).vertices[0].double().numpy()
    body = player.body(time)
    error = np.linalg.norm(body - expected @ YUP_FROM_ZUP.T, axis=1)
    # where more than four joints pull, the format's four are not exact: 1 % of the vertices
    assert (error < 2e-5).mean() > 0.98 and error.max() < 0.03
    turn = Slerp(np.arange(len(motion)), Rotation.from_matrix(motion.rotation))(at).as_matrix()
    shift = [np.interp(at, np.arange(len(motion)), motion.translation[:, i]) for i in range(3)]
    cup = (lively.mesh.vertices @ turn.T + shift) @ YUP_FROM_ZUP.T
    assert np.abs(player.object_("cup", time) - cup).max() < 1e-5


def test_the_first_frame_has_its_face(path: Path, motion: Motion) -> None:
    """Expression is in the rest pose: without it the face would be off by millimetres."""
    player = Player(pygltflib.GLTF2().load(str(path)))
    attributes = player.file.meshes[0].primitives[0].attributes
    rest = player.values(attributes.POSITION)
    vertices, _ = rest_pose(motion.model, motion.parameters)
    assert np.abs(motion.parameters.expression[0].numpy()).max() > 0.1
    assert np.abs(rest - vertices).max() < 1e-6


def test_vertices_and_faces_are_in_the_order_of_the_body_file(
    path: Path, lively: fitted.Capture
) -> None:
    """So that numbers of vertices that touch mean the same, by trimesh as well."""
    scene = trimesh.load(path, process=False)
    body = scene.geometry["body"]
    np.testing.assert_array_equal(body.faces, lively.model.faces.numpy())
    assert scene.geometry["cup"].vertices == pytest.approx(lively.mesh.vertices, abs=1e-6)
