"""Read and check an SMPL-X-format npz, and the prior of a subject's shape, E_beta.

The open body is one model for women and men. ``open_body_genders.npz`` contains the mean and
covariance of its betas among women and among men. A licensed file is made for one gender: its betas
are standard normal by definition. A stated height narrows the Gaussian by a Kalman update. It is a
linear measurement of the betas: the difference in y between the highest vertex (crown) and the
lowest (sole) of the rest pose.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import NUM_JOINTS, PARENTS
from intercap_core.errors import UserError
from intercap_core.inputs.arrays import read_arrays
from intercap_core.inputs.files import UnreadableFile

OPEN_BODY = Path(__file__).parent / "data" / "open_body.npz"
GENDERS_FILE = OPEN_BODY.with_name("open_body_genders.npz")
# Standard deviation of a stated height, metres. Stated heights exceed measured ones by 1 to 2 cm,
# with a standard deviation of 2 to 3 (Gorber et al. 2007, "A comparison of direct vs. self-report
# measures for assessing height, weight and body mass index", Obesity Reviews 8). People lose 1 to 2
# cm over a day.
HEIGHT_SIGMA_M = 0.02
_REQUIRED = (
    "v_template", "f", "shapedirs", "J_regressor", "kintree_table", "weights", "hands_meanl",
    "hands_meanr", "hands_componentsl", "hands_componentsr", "lmk_faces_idx", "lmk_bary_coords",
    "dynamic_lmk_faces_idx", "dynamic_lmk_bary_coords",
)  # fmt: skip
_OTHER_MODELS = {5: "FLAME", 16: "MANO", 24: "SMPL", 52: "SMPL-H"}  # by number of joints
_HINT = "name an SMPLX_NEUTRAL/MALE/FEMALE.npz as body model, or none for the open body"


@dataclass(frozen=True)
class BodyArrays:
    """The arrays of a body file in float64, with V vertices and F faces."""

    path: Path
    template: np.ndarray
    """(V, 3) metres."""
    faces: np.ndarray
    """(F, 3)"""
    shape_directions: np.ndarray
    """(V, 3, S)"""
    expression_directions: np.ndarray
    """(V, 3, E)"""
    posedirs: np.ndarray | None
    """(V, 3, 486); None without pose blend shapes."""
    joint_regressor: np.ndarray
    """(55, V)"""
    weights: np.ndarray
    """(V, 55), rows sum to one."""
    hand_mean: np.ndarray
    """(2, 45)"""
    hand_components: np.ndarray
    """(2, H, 45)"""
    hand_deviation: np.ndarray | None
    """(2, H) standard deviations of the components; None = unknown."""
    landmark_faces: np.ndarray
    """(51,) face of each facial landmark, dlib 17 to 67."""
    landmark_barycentric: np.ndarray
    """(51, 3) its barycentric coordinates in that face."""
    contour_faces: np.ndarray
    """(79, 17) faces of the jaw line, for each of 79 turns of the head; 0 = frontal."""
    contour_barycentric: np.ndarray
    """(79, 17, 3) barycentric coordinates in these faces."""


def load_body_file(
    path: Path | None,
    num_betas: int,
    num_expression: int,
    *,
    num_hand_components: int = 45,
    flat_hand_mean: bool = False,
) -> BodyArrays:
    """Read and check a file. Raises UserError if it is no complete SMPL-X file.

    Args:
        path: the file; None = the open body.
        num_betas: number of shape components.
        num_expression: number of expression components.
        num_hand_components: number of components of each hand's pose space.
        flat_hand_mean: the components are relative to the flat hand, with a mean of zero.
    """
    path = OPEN_BODY if path is None else Path(path)
    arrays = _read(path)
    _check(path, arrays)
    shape, expression = _select_directions(path, arrays["shapedirs"], num_betas, num_expression)
    posedirs = arrays.get("posedirs")
    if posedirs is not None and posedirs.size and np.any(posedirs):
        posedirs = posedirs.astype(np.float64)
    else:
        posedirs = None
    hands = _select_hands(path, arrays, num_hand_components, flat_hand_mean)
    return BodyArrays(
        path=path,
        template=arrays["v_template"].astype(np.float64),
        faces=arrays["f"].astype(np.int64),
        shape_directions=shape.astype(np.float64),
        expression_directions=expression.astype(np.float64),
        posedirs=posedirs,
        joint_regressor=arrays["J_regressor"].astype(np.float64),
        weights=arrays["weights"] / arrays["weights"].sum(1, keepdims=True, dtype=np.float64),
        hand_mean=hands[0],
        hand_components=hands[1],
        hand_deviation=hands[2],
        landmark_faces=arrays["lmk_faces_idx"].astype(np.int64),
        landmark_barycentric=arrays["lmk_bary_coords"].astype(np.float64),
        contour_faces=arrays["dynamic_lmk_faces_idx"].astype(np.int64),
        contour_barycentric=arrays["dynamic_lmk_bary_coords"].astype(np.float64),
    )


def _read(path: Path) -> dict[str, np.ndarray]:
    """Return the arrays of a body file by name, as far as it contains them."""
    if path.suffix == ".pkl":
        raise UserError(
            f"Body file {path} is a pickle, which could run code: {_HINT} (npz of the same model)."
        )
    wanted = {*_REQUIRED, "posedirs", "hands_coeffsl", "hands_coeffsr", "hands_deviationl",
              "hands_deviationr"}  # fmt: skip
    try:
        return read_arrays(path, wanted)
    except UnreadableFile as error:
        raise UserError(f"Body file {path} {error.reason}, expected an npz: {_HINT}.") from error


def _check(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """Raise UserError that names the first fault, if there is one."""
    for faults in (_find_wrong_shapes(arrays), _find_wrong_values(arrays)):
        for fault in faults:
            raise UserError(f"Body file {path} {fault}: {_HINT}.")


def _find_wrong_shapes(arrays: dict[str, np.ndarray]) -> Iterator[str]:
    """Yield faults of types and shapes, to follow the name of the file."""
    for name, values in arrays.items():
        if values.dtype.kind not in "iuf":
            yield f"has {name} of type {values.dtype}; expected numbers"
    tree = arrays.get("kintree_table")
    joints = tree.shape[-1] if tree is not None and tree.ndim == 2 else NUM_JOINTS
    if joints in _OTHER_MODELS:
        yield (
            f"is a {_OTHER_MODELS[joints]} model with {joints} joints; expected SMPL-X with "
            f"{NUM_JOINTS}"
        )
    if joints != NUM_JOINTS:
        yield f"has {joints} joints; expected SMPL-X's {NUM_JOINTS}"
    missing = [name for name in _REQUIRED if name not in arrays]
    if missing:
        hands = "the hands " if missing[0].startswith("hands") else ""
        yield f"lacks {hands}({', '.join(missing)}); expected a complete SMPL-X file"
    vertices = len(arrays["v_template"]) if arrays["v_template"].ndim else 0
    posedirs = arrays.get("posedirs")
    shapes = {
        "v_template": (vertices, 3),
        "f": (None, 3),
        "shapedirs": (vertices, 3, None),
        "J_regressor": (NUM_JOINTS, vertices),
        "kintree_table": (2, NUM_JOINTS),
        "weights": (vertices, NUM_JOINTS),
        **{f"hands_mean{s}": (45,) for s in "lr"},
        **{f"hands_components{s}": (45, 45) for s in "lr"},
        "lmk_faces_idx": (51,),
        "lmk_bary_coords": (51, 3),
        "dynamic_lmk_faces_idx": (79, 17),
        "dynamic_lmk_bary_coords": (79, 17, 3),
        **({"posedirs": (vertices, 3, 486)} if posedirs is not None and posedirs.size else {}),
    }
    for name, shape in shapes.items():
        actual = arrays[name].shape
        if len(actual) != len(shape) or any(
            want is not None and want != have for want, have in zip(shape, actual, strict=True)
        ):
            expected = tuple("any" if size is None else size for size in shape)
            yield f"has {name} of shape {actual}; expected {expected}"


def _find_wrong_values(arrays: dict[str, np.ndarray]) -> Iterator[str]:
    """Yield faults of values: indices outside their tables, weights, metres."""
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            yield f"has values in {name} that are not finite"
    # the parent of the root is stored as -1, or as the same bits unsigned
    if tuple(int(p) for p in arrays["kintree_table"][0, 1:]) != PARENTS[1:]:
        yield "has another joint tree than SMPL-X: its joints are in another order"
    vertices, faces = len(arrays["v_template"]), len(arrays["f"])
    if not vertices or not faces:
        yield f"has {vertices} vertices and {faces} faces; expected a body"
    for name, count, what in (
        ("f", vertices, "vertices"),
        ("lmk_faces_idx", faces, "faces"),
        ("dynamic_lmk_faces_idx", faces, "faces"),
    ):
        lowest, highest = arrays[name].min(), arrays[name].max()
        if lowest < 0 or highest >= count:
            yield (
                f"names number {int(lowest if lowest < 0 else highest)} in {name}; expected 0 to "
                f"{count - 1}, as it has {count} {what}"
            )
    if arrays["weights"].sum(1, dtype=np.float64).min() <= 0:
        yield "has a vertex whose weights are zero or negative; expected a sum of 1"
    height = float(np.ptp(arrays["v_template"][:, 1].astype(np.float64)))
    if not 0.3 <= height <= 3.0:  # from a newborn to more than the tallest person
        yield (
            f"has a body {height:.4g} m tall; expected 0.3 to 3.0 m with y up (is it in "
            "millimetres?)"
        )


def _select_directions(
    path: Path, table: np.ndarray, num_betas: int, num_expression: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return the first columns of shape (V,3,num_betas) and of expression (V,3,num_expression).

    The expression starts at column 300 of a full file, else (10+10) at half of the columns.
    """
    columns = table.shape[2]
    start = 300 if columns > 300 else columns // 2  # where the expression starts
    if num_betas > start or num_expression > columns - start:
        raise UserError(
            f"Body file {path} has {start} shape and {columns - start} expression components; "
            f"{num_betas} and {num_expression} were requested: request fewer."
        )
    return table[:, :, :num_betas], table[:, :, start : start + num_expression]


def _select_hands(
    path: Path, arrays: dict[str, np.ndarray], count: int, flat: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Return mean (2,45), the first components (2,count,45) and their deviations (2,count).

    The deviations are None if the file does not state them. ``flat``: the mean becomes zero.
    """
    if not 6 <= count <= 45:
        raise UserError(
            f"Body file {path}: {count} hand components were requested; expected 6 to 45."
        )
    mean = np.stack([arrays["hands_meanl"], arrays["hands_meanr"]]).astype(np.float64)
    components = np.stack([arrays["hands_componentsl"], arrays["hands_componentsr"]])
    components = components[:, :count].astype(np.float64)
    deviation = _hand_deviation(arrays)
    if deviation is not None:
        deviation = deviation[:, :count]
    if flat:
        if deviation is not None:  # about zero, the mean adds to the deviation
            deviation = np.hypot(deviation, np.einsum("skj,sj->sk", components, mean))
        mean = np.zeros_like(mean)
    return mean, components, deviation


def _hand_deviation(arrays: dict[str, np.ndarray]) -> np.ndarray | None:
    """Return the standard deviations (2,45) of the hand components; None if the file has none.

    They are stored, or computed from the coefficients of the scans that the hand space was learnt
    from, which SMPL-X files contain.
    """
    stored = [arrays.get(f"hands_deviation{s}") for s in "lr"]
    if all(x is not None and x.shape == (45,) for x in stored):
        return np.stack([np.asarray(x, np.float64) for x in stored])
    scans = [arrays.get(f"hands_coeffs{s}") for s in "lr"]
    if all(x is not None and x.ndim == 2 and x.shape[1] == 45 and len(x) > 45 for x in scans):
        return np.stack([np.asarray(x, np.float64).std(0) for x in scans])
    return None


@dataclass(frozen=True, eq=False)
class ShapePrior:
    """Gaussian prior of the betas: betas = mean + root z, with z standard normal."""

    mean: np.ndarray
    """(S,)"""
    root: np.ndarray
    """(S, S) Cholesky factor of the covariance."""

    @classmethod
    def of(cls, file: BodyArrays, gender: str, height_m: float | None = None) -> ShapePrior:
        """Return the prior of a subject of this gender and height, if it is known."""
        count = file.shape_directions.shape[2]
        mean, covariance = np.zeros(count), np.eye(count)
        if file.path == OPEN_BODY and gender in _genders():
            mean, covariance = (values[..., :count] for values in _genders()[gender])
            covariance = covariance[:count]
        if height_m is not None:
            crown, sole = file.template[:, 1].argmax(), file.template[:, 1].argmin()
            by_shape = file.shape_directions[crown, 1] - file.shape_directions[sole, 1]
            expected = np.ptp(file.template[:, 1]) + by_shape @ mean
            gain = covariance @ by_shape / (by_shape @ covariance @ by_shape + HEIGHT_SIGMA_M**2)
            mean = mean + gain * (height_m - expected)
            covariance = covariance - np.outer(gain, by_shape @ covariance)
        return cls(mean, np.linalg.cholesky((covariance + covariance.T) / 2))

    def centred(self, file: BodyArrays) -> BodyArrays:
        """Return the body whose shape parameters are z, which is standard normal."""
        directions = file.shape_directions
        template = file.template + directions @ self.mean
        return replace(file, template=template, shape_directions=directions @ self.root)

    def betas(self, z: Tensor) -> Tensor:
        """Return the file's betas (...,S) of shape parameters z (...,S)."""
        mean, root = (torch.as_tensor(values).to(z) for values in (self.mean, self.root))
        return mean + z @ root.T


@cache
def _genders() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return mean (30,) and covariance (30,30) of the open body's betas, by gender."""
    with np.load(GENDERS_FILE, allow_pickle=False) as file:
        names, mean, covariance = (file[name] for name in ("genders", "mean", "covariance"))
    return {
        str(name): (mean[i].astype(float), covariance[i].astype(float))
        for i, name in enumerate(names)
    }
