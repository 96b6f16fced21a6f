"""The SMPL-X body model: poses vertices and joints, with exact derivatives.

Loper et al. 2015 (SMPL) and Pavlakos et al. 2019 (SMPL-X):
v = W(T + S [betas, expression] + P vec(R(theta) - I), J(T + S [betas, expression]), theta)
with the template T, shape directions S, pose blend shapes P, local joint rotations R(theta), joint
regressor J and linear blend skinning W. The argument of W, before skinning, is "at rest".
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.jacobian import Linearisation, linearise, shaped_points
from intercap_core.body.keypoints import KeypointMap
from intercap_core.body.kinematics import PosedJoints, pose_joints, rotation_from_axis_angle, skin
from intercap_core.body.loading import BodyArrays, load_body_file
from intercap_core.body.maps import find_regions, load_maps
from intercap_core.body.parameters import TRANSL, BodyParameters
from intercap_core.body.selection import Selection, select_points
from intercap_core.errors import UserError

_HINT = "take the file as published, or none for the open body"


@dataclass(frozen=True)
class BodyOutput:
    """Posed bodies, metres."""

    vertices: Tensor
    """(B, V, 3), or (B, N, 3) of N requested vertices."""
    joints: Tensor
    """(B, 55, 3)"""


class BodyModel:
    """A body of V vertices and 55 joints in SMPL-X's conventions (y up, facing +z, metres).

    Attributes:
        template: (V, 3) mean shape in the T-pose.
        skinning_weights: (V, 55), rows sum to one.
        faces: (F, 3) int64.
        num_vertices: V.
        num_parameters: length P of a parameter vector.
        hand_mean: (2, 45), left then right: axis-angle = mean + coefficients @ components.
        hand_components: (2, H, 45)
        hand_deviation: (2, H) standard deviation of each coefficient.
        keypoint_map: the 135 keypoints.
        regions: vertex ids of each contact region.
        markers: (81,) vertices of LEMO's markers, in the order of `maps.MARKER_NAMES`.
    """

    def __init__(self, file: BodyArrays, device: torch.device, dtype: torch.dtype) -> None:
        def tensor(array: np.ndarray) -> Tensor:
            return torch.as_tensor(array, dtype=dtype, device=device)

        self.path = file.path
        self.device, self.dtype = device, dtype
        self.num_betas = file.shape_directions.shape[2]
        self.num_expression = file.expression_directions.shape[2]
        self.num_vertices = len(file.template)
        self.num_parameters = TRANSL.stop + self.num_betas + self.num_expression
        self.faces = torch.as_tensor(file.faces, device=device)
        directions = np.concatenate([file.shape_directions, file.expression_directions], 2)
        rest_joints = file.joint_regressor @ file.template
        self.template = tensor(file.template)
        self._directions = tensor(directions)
        self._posedirs = None if file.posedirs is None else tensor(file.posedirs)
        self.skinning_weights = tensor(file.weights)
        self._rest_joints = tensor(rest_joints)
        self._joint_directions = tensor(np.einsum("jv,vcs->jcs", file.joint_regressor, directions))
        self.hand_mean = tensor(file.hand_mean)
        self.hand_components = tensor(file.hand_components)
        deviation = file.hand_deviation
        if deviation is None:
            # rad; typical of the open body, for files that state none
            deviation = np.full(file.hand_components.shape[:2], 0.35)
        self.hand_deviation = tensor(deviation)

        maps = load_maps(file.path, len(file.template))
        self.keypoint_map = KeypointMap.of(maps.points, file)
        self._keypoint_matrix = tensor(self.keypoint_map.matrix)
        self.markers = maps.markers
        self.regions = maps.regions or _regions(file, rest_joints)
        self._selections: OrderedDict[bytes, Selection] = OrderedDict()

    @classmethod
    def load(
        cls,
        path: Path | None = None,
        *,
        num_betas: int = 10,
        num_expression: int = 10,
        num_hand_components: int = 45,
        flat_hand_mean: bool = False,
        device: torch.device | str = "cpu",
        dtype: torch.dtype = torch.float32,
    ) -> BodyModel:
        """Load an SMPL-X npz (300+100 or 10+10 shape columns), or the open body without a path.

        Raises UserError if the file is missing, incomplete, of another model, or has fewer
        components.

        Args:
            path: body file; None = the open body.
            num_betas: number of shape components.
            num_expression: number of expression components.
            num_hand_components: number of components of each hand's pose space, 6 to 45. A fit
                needs all 45.
            flat_hand_mean: coefficients are relative to the flat hand, not to the mean hand.
            device: device of the model.
            dtype: floating type of the model.
        """
        file = load_body_file(
            path,
            num_betas,
            num_expression,
            num_hand_components=num_hand_components,
            flat_hand_mean=flat_hand_mean,
        )
        return cls(file, torch.device(device), dtype)

    def zeros(self, batch: int = 1) -> BodyParameters:
        """Return T-posed mean bodies with flat hands, at the origin."""
        vector = torch.zeros(batch, self.num_parameters, device=self.device, dtype=self.dtype)
        return self.parameters(vector)

    def parameters(self, vector: Tensor) -> BodyParameters:
        """Split parameter vectors (B,P)."""
        return BodyParameters.from_vector(vector, num_betas=self.num_betas)

    def forward(
        self, params: BodyParameters, *, vertex_ids: Tensor | np.ndarray | None = None
    ) -> BodyOutput:
        """Pose the joints and all vertices, or only ``vertex_ids`` (N,)."""
        selection = self.select(vertex_ids, joints=False)
        points, posed, _ = self._rest(selection, params)
        vertices = skin(points, posed.rotations, posed.offsets, selection.weights)
        return BodyOutput(vertices, posed.joints)

    __call__ = forward

    def linearise(
        self,
        params: BodyParameters,
        *,
        vertex_ids: Tensor | np.ndarray | None = None,
        joints: bool = False,
        by_shape: bool = True,
    ) -> Linearisation:
        """Pose points and prepare their derivatives; see `Linearisation`.

        The points are the vertices (all, or ``vertex_ids``), followed by the joints if ``joints``.
        Without ``by_shape`` the derivatives by betas and expression are left out.
        """
        with torch.no_grad():
            selection = self.select(vertex_ids, joints=joints)
            points, posed, axis_angle = self._rest(selection, params)
            directions = self._joint_directions if by_shape else None
            return linearise(selection, points, posed, axis_angle, directions)

    def keypoints(self, output: BodyOutput) -> Tensor:
        """Return keypoints (B,135,3) from all vertices, or those of `keypoint_map.vertex_ids`."""
        vertices, ids = output.vertices, self.keypoint_map.vertex_ids
        if vertices.shape[1] == self.num_vertices:
            vertices = vertices[:, torch.as_tensor(ids, device=vertices.device)]
        elif vertices.shape[1] != len(ids):
            raise ValueError(
                f"expected {self.num_vertices} vertices or the {len(ids)} of "
                f"keypoint_map.vertex_ids, got {vertices.shape[1]}"
            )
        return self._keypoint_matrix @ torch.cat([vertices, output.joints], 1)

    def keypoints_of(self, params: BodyParameters) -> Tensor:
        """Return keypoints (B,135,3), evaluating only the vertices that they use."""
        return self.keypoints(self.forward(params, vertex_ids=self.keypoint_map.vertex_ids))

    def select(self, vertex_ids: Tensor | np.ndarray | None, *, joints: bool = False) -> Selection:
        """Return template, blend shapes and skinning of ``vertex_ids`` (N,), None = all vertices.

        With ``joints``, those of the 55 joints follow. The last eight selections are cached.
        """
        if vertex_ids is None:
            ids, key = None, b"all"
        else:
            ids = torch.as_tensor(vertex_ids, dtype=torch.long, device=self.device)
            key = ids.cpu().numpy().tobytes()
        key += b"j" if joints else b"v"
        if key not in self._selections:
            at = slice(None) if ids is None else ids
            self._selections[key] = select_points(
                self.template[at],
                self._directions[at],
                None if self._posedirs is None else self._posedirs[at],
                self.skinning_weights[at],
                (self._rest_joints, self._joint_directions) if joints else None,
            )
            if len(self._selections) > 8:
                self._selections.popitem(last=False)
        self._selections.move_to_end(key)
        return self._selections[key]

    def _rest(
        self, selection: Selection, params: BodyParameters
    ) -> tuple[Tensor, PosedJoints, Tensor]:
        """Return points at rest (B,N,3), metres, posed joints, and axis-angles (B,55,3)."""
        batch = params.batch
        axis_angle = params.full_pose()
        shape = torch.cat([params.betas.expand(batch, -1), params.expression.expand(batch, -1)], 1)
        if shape.shape[1] != self.num_betas + self.num_expression:
            raise ValueError(
                f"expected {self.num_betas} betas and {self.num_expression} expression "
                f"coefficients, got {params.betas.shape[1]} and {params.expression.shape[1]}"
            )
        local = rotation_from_axis_angle(axis_angle)
        rest = self._rest_joints + (
            shape @ self._joint_directions.reshape(-1, shape.shape[1]).T
        ).reshape(batch, -1, 3)
        posed = pose_joints(rest, local, params.transl.expand(batch, -1))
        return shaped_points(selection, shape, local), posed, axis_angle


def _regions(file: BodyArrays, rest_joints: np.ndarray) -> dict[str, np.ndarray]:
    """Return the vertex ids of each contact region, found on the template."""
    corners = file.template[file.faces[file.landmark_faces]]
    landmarks = np.einsum("nk,nkc->nc", file.landmark_barycentric, corners)
    mouth_outline = landmarks[31:43]  # landmarks 48 to 59 of dlib's 68
    return find_regions(file.template, file.faces, file.weights, rest_joints, mouth_outline)


def with_hand_mean(model: BodyModel, params: BodyParameters) -> BodyParameters:
    """Return the parameters with both hands in the mean pose of the model."""
    return replace(params, left_hand_pose=model.hand_mean[:1], right_hand_pose=model.hand_mean[1:])


def check_body(model: BodyModel) -> None:
    """Raise UserError if the numbers of a body file cannot be those of a person."""
    template, joints = model.template, model.forward(model.zeros()).joints[0]
    low, high = template.amin(0), template.amax(0)
    width = float((high - low).amax())
    beyond = float(torch.maximum(low - joints, joints - high).amax())
    a, b, c = (template[model.faces[:, i]] for i in range(3))
    area = 0.5 * float(torch.linalg.cross(b - a, c - a).norm(dim=1).sum())
    # share of the skin's width (x) and height (y) that the joints span, the smaller one
    span = float(((joints.amax(0) - joints.amin(0)) / (high - low))[:2].amin())
    weight = float(model.skinning_weights.amin())
    lengths = model.hand_components.norm(dim=2)
    shortest, longest = float(lengths.amin()), float(lengths.amax())
    move = _largest_move(model)
    # sums of barycentric weights, of the keypoints on the mesh
    corners = model.keypoint_map.weights.sum(1)[model.keypoint_map.joint < 0]
    # limits are anatomy with a wide margin: arm span, skin of a newborn and of a clothed giant
    problems = (
        (width > 3.0, f"a body {width:.3g} m wide, expected at most 3 m"),
        (not 0.3 < area < 6.0, f"{area:.3g} m2 of skin, expected 0.3 to 6"),
        (beyond > 0.05, f"a joint {beyond:.3g} m outside of its skin (J_regressor)"),
        (not span > 0.5, f"joints over {span:.0%} of its skin's width or height, expected at least "
         "50% (J_regressor)"),
        (weight < -1e-3, f"a skinning weight of {weight:.3g}, expected none below 0 (weights)"),
        (not 1e-4 < move < 1.0, f"shape components that move the skin by up to {move:.3g} m a "
         "unit, expected 0.0001 to 1 m (shapedirs)"),
        (shortest < 0.5 or longest > 2, f"hand components of length {shortest:.3g} to "
         f"{longest:.3g}, expected 1 (hands_components)"),
        (model.hand_deviation.amin() <= 0,
         "a hand component that never varies (hands_deviation or hands_coeffs)"),
        (abs(corners - 1).max() > 0.01,
         "landmarks whose corners do not add up to 1 (lmk_bary_coords)"),
    )  # fmt: skip
    for wrong, words in problems:
        if wrong:
            raise UserError(f"Body file {model.path} has {words}: {_HINT}.")


def _largest_move(model: BodyModel) -> float:
    """Return the largest motion of a vertex by one unit of a shape or expression component."""
    components = model.num_betas + model.num_expression
    vector = model.zeros(components).vector()
    vector[:, -components:] = torch.eye(components, dtype=vector.dtype, device=vector.device)
    moved = model.forward(model.parameters(vector)).vertices - model.template
    return float(moved.norm(dim=2).amax())
