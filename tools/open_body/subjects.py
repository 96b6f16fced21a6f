"""The studio's subjects: bodies that the fitted model cannot reproduce.

They are sampled from anny's whole phenotype space with local, asymmetric changes. They have another
mesh with other skinning weights, muscles that bulge, and clothes.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.geometry.rigid.surfaces import vertex_normals

from . import retopology, shape_space
from .body_file import SAMPLES, write_npz
from .body_file import SEED as BODY_SEED
from .source import Source

SEED = 4711
_FACES = 17_000
_COUNT = 12
_IDENTITY_MM = (3.0, 8.0)  # RMS distance from the fitted model's shape space
# Names of local changes that are not used
_SKIPPED = ("trans", "nipple", "breast", "pregnant", "penis", "testicle", "valgus", "angle-out",
            "bulge", "navel", "cup", "genital")  # fmt: skip
DRIVERS = ("left_elbow", "right_elbow", "left_knee", "right_knee", "left_hip", "right_hip",
           "left_shoulder", "right_shoulder")  # fmt: skip


def _phenotypes(rng: np.random.Generator) -> dict[str, np.ndarray]:
    """Draw twelve people, half of them women, 20 to 60 years old, of all builds and heights."""

    def spread(low: float, high: float) -> np.ndarray:
        return rng.permutation(low + (high - low) * (np.arange(_COUNT) + rng.random(_COUNT))
                               / _COUNT)  # fmt: skip

    female = np.arange(_COUNT) % 2 == 0
    race = rng.dirichlet(np.ones(3) * 0.5, _COUNT)
    return {
        "gender": np.where(female, spread(0.85, 1.0), spread(0.0, 0.15)),
        "age": spread(0.64, 0.83),
        "muscle": spread(0.2, 0.85),
        "weight": spread(0.15, 0.85),
        "height": spread(0.24, 0.5),
        "proportions": spread(0.1, 0.9),
        "cupsize": spread(0.2, 0.8),
        "firmness": spread(0.2, 0.8),
        **{name: race[:, i] for i, name in enumerate(("african", "asian", "caucasian"))},
    }


def used_changes(source: Source) -> list[str]:
    """Return the names of the local changes in use."""
    labels = source.model.local_change_labels  # type: ignore[attr-defined]
    return [n for n in labels if not any(s in n for s in _SKIPPED)]


def _local_changes(source: Source, rng: np.random.Generator) -> dict[str, np.ndarray]:
    return {n: np.clip(rng.normal(0, 0.25, _COUNT), -0.8, 0.8) for n in used_changes(source)}


def with_local_changes(
    source: Source,
    space: shape_space.ShapeSpace,
    area: np.ndarray,
    person: dict[str, np.ndarray],
    local: dict[str, np.ndarray],
    wanted_mm: float,
) -> tuple[tuple[np.ndarray, ...], float]:
    """Return a T-posed body that is ``wanted_mm`` outside the fitted model's shape space, and the
    strength of its local changes, found by bisection. ``person`` and ``local`` have values (1,)."""
    low, high = 0.0, 3.0
    for _ in range(9):
        strength = (low + high) / 2
        change = {k: np.clip(strength * v, -1, 1) for k, v in local.items()}
        body = shape_space.t_posed(source, source.coefficients(person, change))
        rms = residual_mm(space, body[0][0], area)
        low, high = (strength, high) if rms < wanted_mm else (low, strength)
    return body, strength


def residual_mm(space: shape_space.ShapeSpace, vertices: np.ndarray, area: np.ndarray) -> float:
    """Return the RMS distance (mm) of a body from the fitted model's ten shape directions."""
    basis = space.directions[:, :, :10].reshape(-1, 10)
    weight = np.repeat(area, 3)
    offset = (vertices - space.template).reshape(-1)
    betas = np.linalg.solve((basis * weight[:, None]).T @ basis, (basis * weight[:, None]).T
                            @ offset)  # fmt: skip
    rest = (offset - basis @ betas).reshape(-1, 3)
    return float(1e3 * np.sqrt((area * (rest**2).sum(1)).sum() / area.sum()))


def _identities(source: Source, space: shape_space.ShapeSpace, rng: np.random.Generator):
    """T-posed vertices (12,V,3), joints, tips, phenotypes; local changes scaled into the range."""
    people, local = _phenotypes(rng), _local_changes(source, rng)
    area = shape_space.vertex_areas(space.template, source.faces)
    wanted = rng.permutation(np.linspace(*_IDENTITY_MM, _COUNT + 2)[1:-1])
    bodies, measured = [], []
    for i in range(_COUNT):
        person = {k: v[i : i + 1] for k, v in people.items()}
        own = {k: v[i : i + 1] for k, v in local.items()}
        body, _ = with_local_changes(source, space, area, person, own, wanted[i])
        bodies.append(tuple(x[0] for x in body))
        measured.append(residual_mm(space, body[0][0], area))
    vertices, joints, tips = (np.stack(x) for x in zip(*bodies, strict=True))
    return vertices, joints, tips, people, np.array(measured)


def _neighbour_mean(faces: np.ndarray, count: int):
    from scipy.sparse import coo_matrix, diags

    i = np.concatenate([faces[:, [0, 1, 2]].ravel(), faces[:, [1, 2, 0]].ravel()])
    j = np.concatenate([faces[:, [1, 2, 0]].ravel(), faces[:, [0, 1, 2]].ravel()])
    graph = coo_matrix((np.ones(len(i)), (i, j)), shape=(count, count)).tocsr()
    graph.data[:] = 1
    return diags(1 / np.maximum(np.asarray(graph.sum(1)).ravel(), 1)) @ graph


def _smoothed_weights(weights: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return weights smoothed by diffusion over the surface, with at most six bones."""
    mean = _neighbour_mean(faces, len(weights))
    rigid = weights[:, [22, 23, 24]].sum(1) > 0.02
    hand = weights[:, [20, 21, *range(25, 55)]].sum(1) > 0.5  # small triangles: fewer steps
    soft = weights.copy()
    for step in range(12):
        step_on = 0.5 * soft + 0.5 * (mean @ soft)
        soft = step_on if step < 3 else np.where(hand[:, None], soft, step_on)
    soft[rigid] = weights[rigid]
    sixth = np.sort(soft, axis=1)[:, -6:-5]
    soft = np.where((soft < sixth) | (soft < 0.01), 0, soft)
    return soft / soft.sum(1, keepdims=True)


def _blob(vertices: np.ndarray, centre: np.ndarray, width: float) -> np.ndarray:
    return np.exp(-((vertices - centre) ** 2).sum(1) / (2 * width**2))


def _bulges(vertices: np.ndarray, joints: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """Return displacements (8, V, 3), metres, rest frame, of each driver at a right angle.

    Flexed muscles thicken, stretched sides thin out, creases are pushed outward (linear skinning
    loses volume there).
    """
    normals = vertex_normals(vertices, faces)
    out = np.zeros((len(DRIVERS), *vertices.shape))
    front, back = np.array([0.0, 0, 1]), np.array([0.0, 0, -1])
    at = {n: joints[i] for n, i in JOINT_INDEX.items()}

    def add(driver: str, centre: np.ndarray, side: np.ndarray, width: float, amount: float) -> None:
        facing = np.clip(normals @ side, 0, 1)
        size = amount * facing * _blob(vertices, centre, width)
        out[DRIVERS.index(driver)] += size[:, None] * normals

    for side, sign in (("left", 1.0), ("right", -1.0)):
        up, down = np.array([0.0, 1, 0]), np.array([0.0, -1, 0])
        shoulder, elbow, wrist = (at[f"{side}_{n}"] for n in ("shoulder", "elbow", "wrist"))
        hip, knee, ankle = (at[f"{side}_{n}"] for n in ("hip", "knee", "ankle"))
        name = f"{side}_elbow"
        add(name, shoulder + 0.6 * (elbow - shoulder), front, 0.05, 0.010)
        add(name, shoulder + 0.6 * (elbow - shoulder), back, 0.06, -0.004)
        add(name, elbow + 0.2 * (wrist - elbow), front, 0.04, 0.006)
        add(name, elbow, back, 0.03, 0.005)
        name = f"{side}_knee"
        add(name, knee + 0.3 * (ankle - knee), back, 0.07, 0.009)
        add(name, hip + 0.75 * (knee - hip), back, 0.08, 0.007)
        add(name, knee, front, 0.05, 0.006)
        name = f"{side}_hip"
        add(name, hip + np.array([0, -0.05, 0]), back, 0.10, -0.007)
        add(name, hip + 0.2 * (knee - hip), front, 0.07, 0.009)
        add(name, hip + np.array([0, 0.12, 0.08]), front, 0.08, 0.007)
        name = f"{side}_shoulder"
        add(name, shoulder + np.array([0.03 * sign, 0.03, 0]), up, 0.05, 0.008)
        add(name, shoulder + np.array([-0.08 * sign, -0.06, 0.06]), front, 0.06, 0.007)
        add(name, shoulder + np.array([-0.04 * sign, -0.08, 0]), down, 0.06, -0.006)
    return out


def clothing_of(vertices: np.ndarray, weights: np.ndarray, joints: np.ndarray, faces: np.ndarray,
              long_sleeves: bool, rng: np.random.Generator,) -> np.ndarray:  # fmt: skip
    """Return the thickness (V,), metres: 5 to 20 mm with folds; 0 on hands, face and feet."""
    mean = _neighbour_mean(faces, len(vertices))

    def share(*names: str) -> np.ndarray:
        return weights[:, [JOINT_INDEX[n] for n in names]].sum(1)

    trunk = share("pelvis", "spine1", "spine2", "spine3", "left_collar", "right_collar")
    sleeves = ["left_shoulder", "right_shoulder"]
    if long_sleeves:
        sleeves += ["left_elbow", "right_elbow"]
    legs = share("left_hip", "right_hip", "left_knee", "right_knee")
    covered = np.clip(trunk + share(*sleeves) + legs, 0, 1)
    above_ankles = vertices[:, 1] - joints[[7, 8], 1].mean()
    covered *= np.clip(above_ankles / 0.05 - 0.5, 0, 1)
    neckline = joints[JOINT_INDEX["neck"], 1] - 0.02
    covered *= np.clip((neckline - vertices[:, 1]) / 0.02 + 1, 0, 1)
    folds = rng.normal(size=len(vertices))
    for _ in range(25):
        folds = mean @ folds
    folds = np.clip(folds / folds.std(), -2, 2)
    loose = 0.010 + 0.003 * (legs > 0.5) + 0.0025 * rng.normal()
    thickness = np.clip(loose + 0.0035 * folds, 0.005, 0.020)
    edge = (covered > 0.5).astype(float)
    for _ in range(2):
        edge = mean @ edge
    return np.where(covered > 0.5, thickness * np.clip(edge, 0.3, 1), 0.0)


def bake(source: Source, path: Path) -> None:
    rng = np.random.default_rng(SEED)
    space = shape_space.build(source, SAMPLES, BODY_SEED)
    mesh = retopology.remesh(source, space.template, space.joints, _FACES)
    vertices, joints, tips, people, residual = _identities(source, space, rng)
    on_mesh = np.stack([retopology.at(v, source.faces, mesh.source_face, mesh.source_bary)
                        for v in vertices])  # fmt: skip
    weights = np.einsum("nk,nkj->nj", mesh.source_bary,
                        source.weights[source.faces[mesh.source_face]])  # fmt: skip
    weights = _smoothed_weights(weights, mesh.faces)
    template, mean_joints = on_mesh.mean(0), joints.mean(0)
    clothing = np.stack([
        clothing_of(on_mesh[i], weights, joints[i], mesh.faces, i % 3 != 1, rng)
        for i in range(_COUNT)
    ])  # fmt: skip
    back = np.stack([retopology.at(on_mesh[i], mesh.faces, mesh.back_face, mesh.back_bary)
                     for i in range(_COUNT)])  # fmt: skip
    gap = 1e3 * np.linalg.norm(back - vertices, axis=2)
    print(
        f"subjects: {len(template)} vertices, {len(mesh.faces)} faces; mapped back to the fitted "
        f"topology within {gap.mean():.2f} mm (p99 {np.percentile(gap, 99):.2f})"
    )
    height = np.ptp(vertices[:, :, 1], axis=1)
    for i in range(_COUNT):
        print(f"  s{i + 1:02d} {'female' if people['gender'][i] > 0.5 else 'male':6s} "
              f"{height[i]:.2f} m, {residual[i]:.1f} mm outside the shape space")  # fmt: skip
    write_npz(path, {
        "names": np.array([f"s{i + 1:02d}" for i in range(_COUNT)]),
        "gender": np.array(["female" if g > 0.5 else "male" for g in people["gender"]]),
        "height_m": height.astype(np.float32),
        "identity_rms_mm": residual.astype(np.float32),
        "template": template.astype(np.float32),
        "offsets": (on_mesh - template).astype(np.float16),
        "joints": joints.astype(np.float32),
        "tips": tips.astype(np.float32),
        "faces": mesh.faces.astype(np.uint16),
        "weights": weights.astype(np.float16),
        "bulges": _bulges(template, mean_joints, mesh.faces).astype(np.float16),
        "bulge_scale": (0.5 + people["muscle"]).astype(np.float32),
        "clothing": clothing.astype(np.float16),
        "fitted_face": mesh.back_face.astype(np.uint16),
        "fitted_bary": mesh.back_bary.astype(np.float16),
    })  # fmt: skip
