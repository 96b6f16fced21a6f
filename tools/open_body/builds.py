"""Six more subjects of other builds than the twelve: 1.50 to 1.95 m, slight and strong.

They have the mesh of the twelve. Its place on the source is derived from subjects.npz, so that this
file does not change and builds.npz only contains the differences between people.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from intercap_core.geometry.rigid.surfaces import vertex_normals

from . import retopology, shape_space
from .body_file import SAMPLES, write_npz
from .body_file import SEED as BODY_SEED
from .source import Source
from .subjects import clothing_of, residual_mm, used_changes, with_local_changes

SEED = 4712
ROUNDS = 3  # of stature and local changes in turn


class Build(NamedTuple):
    """The build of a subject."""

    female: bool
    height_m: float
    muscle: float
    """In [0, 1], as anny defines it."""
    weight: float
    """In [0, 1], as anny defines it."""
    outside_mm: float
    """RMS distance from the fitted model's shape space."""
    long_sleeves: bool


BUILDS = {
    "b01": Build(True, 1.50, 0.15, 0.15, 4.0, True),
    "b02": Build(True, 1.58, 0.90, 0.70, 6.0, False),
    "b03": Build(True, 1.80, 0.20, 0.12, 5.0, False),
    "b04": Build(False, 1.62, 0.95, 0.75, 5.5, False),
    "b05": Build(False, 1.88, 0.15, 0.15, 4.5, True),
    "b06": Build(False, 1.95, 0.95, 0.80, 6.5, False),
}


def bake(source: Source, subjects: Path, path: Path) -> None:
    """Write ``path`` for the people of BUILDS on the mesh of the file ``subjects``."""
    rng = np.random.default_rng(SEED)
    space = shape_space.build(source, SAMPLES, BODY_SEED)
    area = shape_space.vertex_areas(space.template, source.faces)
    with np.load(subjects) as have:
        mesh = {name: have[name] for name in have.files}
    faces, template = mesh["faces"].astype(int), mesh["template"].astype(float)
    weights = mesh["weights"].astype(float)
    weights /= weights.sum(1, keepdims=True)
    on_source = _on_source(source, mesh, template, faces, weights)
    rows: dict[str, list[np.ndarray]] = {
        "height_m": [], "identity_rms_mm": [], "offsets": [], "joints": [], "tips": [],
        "bulge_scale": [], "clothing": [],
    }  # fmt: skip
    for name, build in BUILDS.items():
        vertices, joints, tips = _person(source, space, area, build, rng)
        on_mesh = retopology.at(vertices, source.faces, *on_source)
        height = np.ptp(vertices[:, 1])
        outside = residual_mm(space, vertices, area)
        clothing = clothing_of(on_mesh, weights, joints, faces, build.long_sleeves, rng)
        print(f"  {name} {height:.3f} m, {outside:.1f} mm outside the shape space")
        found = (height, outside, on_mesh - template, joints, tips, 0.5 + build.muscle, clothing)
        for values, value in zip(rows.values(), found, strict=True):
            values.append(np.asarray(value))
    kinds = {"offsets": np.float16, "clothing": np.float16}
    write_npz(path, {
        "names": np.array(list(BUILDS)),
        "gender": np.array(["female" if b.female else "male" for b in BUILDS.values()]),
        **{key: np.stack(values).astype(kinds.get(key, np.float32))
           for key, values in rows.items()},
    })  # fmt: skip


def _on_source(
    source: Source,
    mesh: dict[str, np.ndarray],
    template: np.ndarray,
    faces: np.ndarray,
    weights: np.ndarray,
) -> tuple[np.ndarray, np.ndarray]:
    """Return the places of the mesh's vertices on the source: face (V,), barycentric (V, 3).

    The file contains the places of the source's vertices on the mesh. With the source's vertices
    there, its triangles are next to the vertices of the mesh that were made from them.
    """
    bary = mesh["fitted_bary"].astype(float)
    back = mesh["fitted_face"].astype(int), bary / bary.sum(1, keepdims=True)
    big = retopology.enlarged(template, weights, mesh["joints"].astype(float).mean(0))
    return retopology.closest(
        big, vertex_normals(big, faces), retopology.at(big, faces, *back), source.faces
    )


def _person(
    source: Source,
    space: shape_space.ShapeSpace,
    area: np.ndarray,
    build: Build,
    rng: np.random.Generator,
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return T-posed vertices, joints and tips of a person of this build, otherwise random."""
    race = rng.dirichlet(np.ones(3) * 0.5)
    person = {
        "gender": 0.95 if build.female else 0.05, "age": rng.uniform(0.64, 0.83),
        "muscle": build.muscle, "weight": build.weight, "height": 0.4,
        "proportions": rng.uniform(0.1, 0.9), "cupsize": rng.uniform(0.2, 0.8),
        "firmness": rng.uniform(0.2, 0.8),
        **dict(zip(("african", "asian", "caucasian"), race, strict=True)),
    }  # fmt: skip
    local = {n: np.clip(rng.normal(0, 0.25, 1), -0.8, 0.8) for n in used_changes(source)}
    for _ in range(ROUNDS):
        one = {key: np.array([value]) for key, value in person.items()}
        body, strength = with_local_changes(source, space, area, one, local, build.outside_mm)
        change = {k: np.clip(strength * v, -1, 1) for k, v in local.items()}
        low, high = 0.0, 1.0
        for _ in range(12):
            person["height"] = (low + high) / 2
            one["height"] = np.array([person["height"]])
            body = shape_space.t_posed(source, source.coefficients(one, change))
            shorter = np.ptp(body[0][0, :, 1]) < build.height_m
            low, high = (person["height"], high) if shorter else (low, person["height"])
    vertices, joints, tips = (part[0] for part in body)
    return vertices, joints, tips
