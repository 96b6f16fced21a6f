"""Shape and expression directions, and the joint regressor that is exact over them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from intercap_core.body.joints import PARENTS

from .source import Source
from .t_pose import to_t_pose

# As many of each, since a file of less than 301 columns is read as two halves. The first ten are
# those of a file of ten; with thirty every joint of an unseen adult is within 3 mm.
NUM_SHAPE = 30
NUM_EXPRESSION = 30
_RACES = ("african", "asian", "caucasian")


def sample_adults(count: int, rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Phenotypes of adults of both genders, each (count,), in anny's [0, 1].

    anny's age runs 2/3 at 25 years to 1 at 90. Its height of 0.5 is a 1.91 m man: 0.37 +- 0.065
    gives adult statures (about 1.76 +- 0.08 m and 1.64 +- 0.08 m).
    """
    race = rng.dirichlet(np.ones(3), count)
    female = rng.random(count) < 0.5
    return {
        "gender": np.where(female, rng.uniform(0.8, 1, count), rng.uniform(0, 0.2, count)),
        "age": rng.uniform(0.62, 0.88, count),
        "muscle": np.clip(rng.normal(0.5, 0.17, count), 0.02, 0.98),
        "weight": np.clip(rng.normal(0.5, 0.17, count), 0.02, 0.98),
        "height": np.clip(rng.normal(0.37, 0.065, count), 0.02, 0.98),
        "proportions": np.clip(rng.normal(0.5, 0.2, count), 0.02, 0.98),
        "cupsize": np.clip(rng.normal(0.5, 0.12, count), 0.02, 0.98),
        "firmness": np.clip(rng.normal(0.5, 0.12, count), 0.02, 0.98),
        **{name: race[:, i] for i, name in enumerate(_RACES)},
    }


def t_posed(source: Source, coefficients: np.ndarray, chunk: int = 64) -> tuple[np.ndarray, ...]:
    """(B,K) blend weights -> T-posed vertices (B,V,3), joints (B,55,3), finger tips (B,10,3)."""
    bodies = []
    for start in range(0, len(coefficients), chunk):
        v, j, t = source.rest(coefficients[start : start + chunk])
        bodies += [to_t_pose(*one, source.weights) for one in zip(v, j, t, strict=True)]
    return tuple(np.stack(x) for x in zip(*bodies, strict=True))


@dataclass(frozen=True)
class ShapeSpace:
    """template (V,3), directions (V,3,S), shape then expression, joints (55,3), joint_directions
    (55,3,S).
    """

    template: np.ndarray
    directions: np.ndarray
    joints: np.ndarray
    joint_directions: np.ndarray


def vertex_areas(vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    cross = np.cross(vertices[faces[:, 1]] - vertices[faces[:, 0]],
                     vertices[faces[:, 2]] - vertices[faces[:, 0]])  # fmt: skip
    area = np.zeros(len(vertices))
    np.add.at(area, faces, (np.linalg.norm(cross, axis=1) / 6)[:, None])
    return area


def build(source: Source, count: int, seed: int) -> ShapeSpace:
    """Principal components of `count` adults, weighted by area, scaled to unit variance."""
    adults = source.coefficients(sample_adults(count, np.random.default_rng(seed)))
    vertices, joints, _ = t_posed(source, adults)
    template, rest_joints = vertices.mean(0), joints.mean(0)
    offset = (vertices - template).reshape(count, -1)
    moved = (joints - rest_joints).reshape(count, -1)
    # Equal weight for equal area: vertices crowd on the face and on the fingers. The joints
    # together count as much as the skin, since poses turn about them.
    area = vertex_areas(template, source.faces)
    gram = (offset * np.repeat(area, 3)) @ offset.T + moved @ moved.T * (area.sum() / 55)
    values, vectors = np.linalg.eigh(gram)
    order = np.argsort(values)[::-1][:NUM_SHAPE]
    scores = vectors[:, order] * np.sqrt(count)
    shape = (offset.T @ scores / count).reshape(-1, 3, NUM_SHAPE)
    joint_shape = (moved.T @ scores / count).reshape(55, 3, NUM_SHAPE)
    # A fixed sign, so that the file does not depend on the eigen solver: positive is taller, else
    # larger in the first coordinate that differs
    sign = np.sign(np.ptp(template[:, 1]) * (shape[template[:, 1].argmax(), 1]
                                             - shape[template[:, 1].argmin(), 1]))  # fmt: skip
    sign[sign == 0] = 1
    expression = _expression(source)
    return ShapeSpace(
        template=template,
        directions=np.concatenate([shape * sign, expression], 2),
        joints=rest_joints,
        joint_directions=np.concatenate([joint_shape * sign, np.zeros((55, 3, NUM_EXPRESSION))], 2),
    )


def _expression(source: Source) -> np.ndarray:
    """(V,3,E): components of the facial actions, each taken at random with its usual strength.

    Jaw opening and gaze are left out: they are joints.
    """
    labels = source.model.facial_action_labels  # type: ignore[attr-defined]
    blend_labels = source.model.blendshape_labels  # type: ignore[attr-defined]
    used = [name for name in labels if name != "jawOpen" and not name.startswith("eyeLook")]
    rows = [blend_labels.index(f"facial_action:{name}") for name in used]
    strength = np.array([0.5 if "Blink" in n or "Smile" in n else 0.3 for n in used])
    moves = source.blend[rows].reshape(len(rows), -1) * strength[:, None]
    _, size, right = np.linalg.svd(moves, full_matrices=False)
    directions = size[:NUM_EXPRESSION, None] * right[:NUM_EXPRESSION]
    peak = np.abs(directions).argmax(1)
    directions *= np.sign(directions[np.arange(NUM_EXPRESSION), peak])[:, None]
    directions = directions.reshape(NUM_EXPRESSION, -1, 3)
    # the neck does not move: the eyes must stay in place in the skull
    return directions.transpose(1, 2, 0)


def joint_regressor(space: ShapeSpace, weights: np.ndarray, neighbours: int = 600) -> np.ndarray:
    """(55,V) rows that sum to one and give the joints exactly for every shape and expression.

    Each joint asks for 1 + 3 + 3xS linear conditions on the weights of the `neighbours` closest
    vertices that its bone or the parent's moves; the least-norm solution has small weights, some
    negative.
    """
    count = len(space.template)
    regressor = np.zeros((55, count))
    skin = weights[:, [23, 24]].sum(1) < 0.5
    for joint in range(55):
        family = [joint, max(PARENTS[joint], 0)]
        near = np.linalg.norm(space.template - space.joints[joint], axis=1)
        eye = joint in (23, 24)
        allowed = (weights[:, joint] > 0.5) if eye else skin & (weights[:, family].sum(1) > 0.1)
        near = np.where(allowed, near, np.inf)
        ids = np.sort(np.argsort(near, kind="stable")[: min(neighbours, int(allowed.sum()))])
        rows = np.concatenate([
            np.ones((1, len(ids))),
            (space.template[ids] - space.joints[joint]).T,
            space.directions[ids].transpose(2, 1, 0).reshape(-1, len(ids)),
        ])  # fmt: skip
        target = np.concatenate([[1], np.zeros(3), space.joint_directions[joint].T.reshape(-1)])
        solution, *_ = np.linalg.lstsq(rows, target, rcond=1e-9)
        regressor[joint, ids] = solution
    return regressor
