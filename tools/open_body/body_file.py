"""Write the open body as an SMPL-X-format npz, measure it on other adults, and write the mean and
covariance of its shape among women and among men."""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import numpy as np

from intercap_core.body.joints import JOINT_NAMES, PARENTS

from . import face, hands, points, shape_space
from .source import Source

SAMPLES = 1500
SEED = 20
_TIP_PARENTS = [*range(27, 40, 3), *range(42, 55, 3)]
_EPOCH = (1980, 1, 1, 0, 0, 0)
_ADULTS = 3000  # of whom the shapes of women and men are measured, half of each gender
_GENDERS = ("female", "male")


def write_npz(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Write a compressed npz without time stamps: the same arrays give the same bytes."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=9) as archive:
        for name, array in sorted(arrays.items()):
            buffer = io.BytesIO()
            np.lib.format.write_array(buffer, np.ascontiguousarray(array), allow_pickle=False)
            archive.writestr(zipfile.ZipInfo(f"{name}.npy", _EPOCH), buffer.getvalue(),
                             zipfile.ZIP_DEFLATED, 9)  # fmt: skip


def _held_out(source: Source) -> dict[str, np.ndarray]:
    """Return some skin vertices and the joints of ten adults outside the training set."""
    others = shape_space.sample_adults(10, np.random.default_rng(SEED + 2))
    vertices, joints, _ = shape_space.t_posed(source, source.coefficients(others))
    ids = np.arange(0, len(source.template), 31)
    return {
        "vertex_ids": ids.astype(np.int32),
        "vertices": vertices[:, ids].astype(np.float32),
        "joints": joints.astype(np.float32),
    }


def bake(source: Source, folder: Path, held_out: Path) -> None:
    """Write open_body.npz and its maps to ``folder``, and a few other adults for the tests."""
    space = shape_space.build(source, SAMPLES, SEED)
    directions = space.directions.astype(np.float16)
    template = space.template.astype(np.float32)
    stored = shape_space.ShapeSpace(template.astype(float), directions.astype(float),
                                    space.joints, space.joint_directions)  # fmt: skip
    regressor = shape_space.joint_regressor(stored, source.weights).astype(np.float32)
    _, joints, tips = shape_space.t_posed(
        source, source.coefficients(shape_space.sample_adults(200, np.random.default_rng(SEED)))
    )
    tips = space.joints[_TIP_PARENTS] + (tips - joints[:, _TIP_PARENTS]).mean(0)
    mean, components, deviation = hands.pose_space(space.joints, tips, 4000, SEED)
    right = hands.mirrored(components)
    landmarks = face.landmarks(source, template.astype(float))
    write_npz(folder / "open_body.npz", {
        "v_template": template,
        "f": source.faces.astype(np.uint32),
        "shapedirs": directions,
        "posedirs": np.zeros((len(template), 3, 0), np.float32),
        "J_regressor": regressor,
        "kintree_table": np.stack([np.array(PARENTS), np.arange(55)]).astype(np.int64),
        "weights": source.weights.astype(np.float32),
        "hands_meanl": mean.astype(np.float32),
        "hands_meanr": hands.mirrored(mean).astype(np.float32),
        "hands_componentsl": components.astype(np.float32),
        "hands_componentsr": right.astype(np.float32),
        "hands_deviationl": deviation.astype(np.float32),
        "hands_deviationr": deviation.astype(np.float32),
        "joint2num": np.array([f"{name}={i}" for i, name in enumerate(JOINT_NAMES)]),
        **landmarks,
    })  # fmt: skip
    corners = stored.template[source.faces[landmarks["lmk_faces_idx"][31:43]]]
    mouth = np.einsum("nk,nkc->nc", landmarks["lmk_bary_coords"][31:43], corners)
    points.write_maps(folder / "open_body_maps.json", stored.template, source.faces,
                      source.weights, space.joints, tips, mouth)  # fmt: skip
    report(source, stored, regressor)
    write_npz(held_out, _held_out(source))


def report(source: Source, space: shape_space.ShapeSpace, regressor: np.ndarray) -> None:
    """Print the errors of ten and of all components for 300 other adults: skin and joints, mm."""
    others = shape_space.sample_adults(300, np.random.default_rng(SEED + 1))
    vertices, joints, _ = shape_space.t_posed(source, source.coefficients(others))
    area = np.repeat(shape_space.vertex_areas(space.template, source.faces), 3)
    errors = []
    for count in (10, shape_space.NUM_SHAPE):
        basis = space.directions[:, :, :count].reshape(-1, count)
        weighted = (basis * area[:, None]).T
        offset = (vertices - space.template).reshape(len(vertices), -1)
        betas = np.linalg.solve(weighted @ basis, weighted @ offset.T)
        fitted = space.template + (basis @ betas).T.reshape(vertices.shape)
        skin = 1e3 * np.linalg.norm(fitted - vertices, axis=2)
        landed = np.einsum("jv,bvc->bjc", regressor, fitted)
        moved = np.einsum("jck,kb->bjc", space.joint_directions[:, :, :count], betas)
        gap = 1e3 * np.linalg.norm(landed - space.joints - moved, axis=2).max()
        errors.append(1e3 * np.linalg.norm(landed - joints, axis=2))
        print(f"{count} components: skin of held-out adults {skin.mean():.2f} mm, p99 "
              f"{np.percentile(skin, 99):.2f}; regressor against the rig over the shape space, "
              f"worst {gap:.4f} mm")  # fmt: skip
    print("joints of held-out adults, mm: name; mean, p95, worst of ten components; of all")
    for joint, name in enumerate(JOINT_NAMES):
        texts = (f"{e.mean():6.2f} {np.percentile(e, 95):5.2f} {e.max():5.2f}"
                for e in (found[:, joint] for found in errors))  # fmt: skip
        print(f"  {name:18s} {' '.join(texts)}")


def bake_genders(source: Source, body: Path, path: Path) -> None:
    """Write mean and covariance of the shapes of adults by gender, for the file ``body``.

    The adults are drawn as those of whom the directions were made.
    """
    with np.load(body) as file:
        directions = file["shapedirs"].astype(float)[:, :, : shape_space.NUM_SHAPE]
        template = file["v_template"].astype(float)
    area = np.repeat(shape_space.vertex_areas(template, source.faces), 3)
    basis = directions.reshape(-1, shape_space.NUM_SHAPE)
    weighted = (basis * area[:, None]).T
    drawn = shape_space.sample_adults(_ADULTS, np.random.default_rng(SEED + 3))
    vertices, _, _ = shape_space.t_posed(source, source.coefficients(drawn))
    offset = (vertices - template).reshape(_ADULTS, -1)
    betas = np.linalg.solve(weighted @ basis, weighted @ offset.T).T
    female = drawn["gender"] > 0.5
    height = np.ptp(vertices[:, :, 1], axis=1)
    groups = [betas[female], betas[~female]]
    for name, some, tall in zip(_GENDERS, groups, (height[female], height[~female]), strict=True):
        first, spread = some.mean(0)[:4].round(2), some.std(0)[:4].round(2)
        print(f"{name}: {tall.mean():.3f} +- {tall.std():.3f} m; components {first} +- {spread}")
    write_npz(path, {
        "genders": np.array(_GENDERS),
        "mean": np.stack([some.mean(0) for some in groups]).astype(np.float32),
        "covariance": np.stack([np.cov(some.T) for some in groups]).astype(np.float32),
    })  # fmt: skip
