"""Read an SMPL-X-format npz and say in one sentence what is wrong with another file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from intercap_core.body.joints import NUM_JOINTS, PARENTS
from intercap_core.errors import UserError
from intercap_core.inputs.arrays import read_arrays
from intercap_core.inputs.files import Unreadable

OPEN_BODY = Path(__file__).parent / "data" / "open_body.npz"
GENDERS_FILE = OPEN_BODY.with_name("open_body_genders.npz")
# m. Stated heights exceed measured ones by 1 to 2 cm with a spread of 2 to 3 (Gorber et al. 2007,
# "A comparison of direct vs. self-report measures for assessing height, weight and body mass
# index", Obesity Reviews 8), and people fall by 1 to 2 cm over a day.
HEIGHT_SIGMA_M = 0.02
_REQUIRED = (
    "v_template", "f", "shapedirs", "J_regressor", "kintree_table", "weights", "hands_meanl",
    "hands_meanr", "hands_componentsl", "hands_componentsr", "lmk_faces_idx", "lmk_bary_coords",
    "dynamic_lmk_faces_idx", "dynamic_lmk_bary_coords",
)  # fmt: skip
_SMPLX_SHAPE_COLUMNS = 300  # a full file's expression starts here
_HAND_COMPONENTS = (6, 45)
_HEIGHT_M = (0.3, 3.0)  # from a newborn to more than the tallest person
_OTHER_MODELS = {5: "FLAME", 16: "MANO", 24: "SMPL", 52: "SMPL-H"}  # by their joints
_HINT = "name an SMPLX_NEUTRAL/MALE/FEMALE.npz as body model, or none for the open body"


@dataclass(frozen=True)
class BodyFile:
    """The arrays of the file in float64; posedirs is None if the file has no pose blend shapes.

    hand_mean (2,45), hand_components (2,H,45) and hand_deviation (2,H), None = not told, are those
    asked for.
    """

    path: Path
    template: np.ndarray
    faces: np.ndarray
    shape_directions: np.ndarray
    expression_directions: np.ndarray
    posedirs: np.ndarray | None
    joint_regressor: np.ndarray
    weights: np.ndarray
    hand_mean: np.ndarray
    hand_components: np.ndarray
    hand_deviation: np.ndarray | None
    landmark_faces: np.ndarray
    landmark_barycentric: np.ndarray
    contour_faces: np.ndarray
    contour_barycentric: np.ndarray


def load_body_file(
    path: Path | None,
    num_betas: int,
    num_expression: int,
    *,
    num_hand_components: int = 45,
    flat_hand_mean: bool = False,
) -> BodyFile:
    """Read and check; `UserError` for anything but a complete SMPL-X file.

    The first ``num_hand_components`` of each hand are kept; with ``flat_hand_mean`` they count from
    the flat hand (mean of zero).
    """
    path = OPEN_BODY if path is None else Path(path)
    arrays = _read(path)
    _check(path, arrays)
    shape, expression = _directions(path, arrays["shapedirs"], num_betas, num_expression)
    posedirs = arrays.get("posedirs")
    if posedirs is not None and posedirs.size and np.any(posedirs):
        posedirs = posedirs.astype(np.float64)
    else:
        posedirs = None
    hands = _hands(path, arrays, num_hand_components, flat_hand_mean)
    return BodyFile(
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
    if not path.is_file():
        raise UserError(f"Body file {path} does not exist: {_HINT}.")
    if path.suffix == ".pkl":
        raise UserError(
            f"Body file {path} is a pickle, which could run code: {_HINT} (npz of the same model)."
        )
    wanted = {*_REQUIRED, "posedirs", "hands_coeffsl", "hands_coeffsr", "hands_deviationl",
              "hands_deviationr"}  # fmt: skip
    try:
        return read_arrays(path, wanted)
    except Unreadable as error:
        raise UserError(
            f"Body file {path} is no readable npz ({error.reason}): {_HINT}."
        ) from error


def _check(path: Path, arrays: dict[str, np.ndarray]) -> None:
    for name, values in arrays.items():
        if values.dtype.kind not in "iuf":
            raise UserError(
                f"Body file {path} has {name} of type {values.dtype}; expected numbers: {_HINT}."
            )
    tree = arrays.get("kintree_table")
    joints = tree.shape[-1] if tree is not None and tree.ndim == 2 else None
    if joints in _OTHER_MODELS:
        raise UserError(
            f"Body file {path} is a {_OTHER_MODELS[joints]} model with {joints} joints; expected "
            f"SMPL-X with {NUM_JOINTS}: {_HINT}."
        )
    if joints is not None and joints != NUM_JOINTS:
        raise UserError(
            f"Body file {path} has {joints} joints; expected SMPL-X's {NUM_JOINTS}: {_HINT}."
        )
    missing = [name for name in _REQUIRED if name not in arrays]
    if missing:
        what = "the hands (" if missing[0].startswith("hands") else "("
        raise UserError(
            f"Body file {path} lacks {what}{', '.join(missing)}): expected a complete SMPL-X file; "
            f"{_HINT}."
        )
    vertices = len(arrays["v_template"]) if arrays["v_template"].ndim else 0
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
    }
    for name, shape in shapes.items():
        found = arrays[name].shape
        if len(found) != len(shape) or any(
            want is not None and want != have for want, have in zip(shape, found, strict=True)
        ):
            raise UserError(
                f"Body file {path} has {name} of shape {found}; expected "
                f"{tuple('any' if s is None else s for s in shape)}: {_HINT}."
            )
    posedirs = arrays.get("posedirs")
    if posedirs is not None and posedirs.size and posedirs.shape != (vertices, 3, 486):
        raise UserError(
            f"Body file {path} has posedirs of shape {posedirs.shape}; expected "
            f"({vertices}, 3, 486): {_HINT}."
        )
    for name, values in arrays.items():
        if not np.isfinite(values).all():
            raise UserError(f"Body file {path} has values in {name} that are not finite: {_HINT}.")
    # The root's parent is stored as -1, or as the same bits unsigned
    if tuple(int(p) for p in tree[0, 1:]) != PARENTS[1:]:  # type: ignore[index]
        raise UserError(
            f"Body file {path} has another joint tree than SMPL-X: its joints are in another "
            f"order; {_HINT}."
        )
    _check_values(path, arrays)


def _check_values(path: Path, arrays: dict[str, np.ndarray]) -> None:
    """What shapes do not tell: indices within their tables, weights that add up, metres."""
    vertices, faces = len(arrays["v_template"]), len(arrays["f"])
    if not vertices or not faces:
        raise UserError(
            f"Body file {path} has {vertices} vertices and {faces} faces; expected a body: {_HINT}."
        )
    for name, count, what in (
        ("f", vertices, "vertices"),
        ("lmk_faces_idx", faces, "faces"),
        ("dynamic_lmk_faces_idx", faces, "faces"),
    ):
        lowest, highest = arrays[name].min(), arrays[name].max()
        if lowest < 0 or highest >= count:
            raise UserError(
                f"Body file {path} names number {int(lowest if lowest < 0 else highest)} in "
                f"{name}; expected 0 to {count - 1}, as it has {count} {what}: {_HINT}."
            )
    if arrays["weights"].sum(1, dtype=np.float64).min() <= 0:
        raise UserError(
            f"Body file {path} has a vertex whose weights are zero or negative; expected a sum "
            f"of 1: {_HINT}."
        )
    height = float(np.ptp(arrays["v_template"][:, 1].astype(np.float64)))
    if not _HEIGHT_M[0] <= height <= _HEIGHT_M[1]:
        raise UserError(
            f"Body file {path} has a body {height:.4g} m tall; expected {_HEIGHT_M[0]} to "
            f"{_HEIGHT_M[1]} m with y up (is it in millimetres?): {_HINT}."
        )


def _directions(
    path: Path, table: np.ndarray, num_betas: int, num_expression: int
) -> tuple[np.ndarray, np.ndarray]:
    """Columns 0.. and 300.. of a full file, or the two halves of a 20-column one."""
    columns = table.shape[2]
    start = _SMPLX_SHAPE_COLUMNS if columns > _SMPLX_SHAPE_COLUMNS else columns // 2
    if num_betas > start or num_expression > columns - start:
        raise UserError(
            f"Body file {path} has {start} shape and {columns - start} expression components; "
            f"{num_betas} and {num_expression} were asked for: ask for fewer."
        )
    return table[:, :, :num_betas], table[:, :, start : start + num_expression]


def _hands(
    path: Path, arrays: dict[str, np.ndarray], count: int, flat: bool
) -> tuple[np.ndarray, np.ndarray, np.ndarray | None]:
    """Mean (2,45), first components (2,count,45) and their usual size (2,count) about that mean."""
    fewest, most = _HAND_COMPONENTS
    if not fewest <= count <= most:
        raise UserError(
            f"Body file {path}: {count} hand components were asked for; expected {fewest} to "
            f"{most}: ask for as many."
        )
    mean = np.stack([arrays["hands_meanl"], arrays["hands_meanr"]]).astype(np.float64)
    components = np.stack([arrays["hands_componentsl"], arrays["hands_componentsr"]])
    components = components[:, :count].astype(np.float64)
    deviation = _hand_deviation(arrays)
    if deviation is not None:
        deviation = deviation[:, :count]
    if flat:
        if deviation is not None:  # about zero, the mean is part of what is usual
            deviation = np.hypot(deviation, np.einsum("skj,sj->sk", components, mean))
        mean = np.zeros_like(mean)
    return mean, components, deviation


def _hand_deviation(arrays: dict[str, np.ndarray]) -> np.ndarray | None:
    """(2,45) standard deviations of the hand components: stored, or of the registered hands.

    SMPL-X files carry the coefficients of the scans that the hand space was learnt from.
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
    """betas = mean (S,) + root (S,S) z, with z standard normal."""

    mean: np.ndarray
    root: np.ndarray

    @classmethod
    def of(cls, file: BodyFile, gender: str, height_m: float | None = None) -> ShapePrior:
        """Of a subject of this gender, and height where it is known, for a body file."""
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

    def centred(self, file: BodyFile) -> BodyFile:
        """The same bodies with z in place of betas: shapes in units of this prior."""
        directions = file.shape_directions
        template = file.template + directions @ self.mean
        return replace(file, template=template, shape_directions=directions @ self.root)

    def betas(self, z: Tensor) -> Tensor:
        """The file's own betas (...,S) of shapes (...,S) in units of this prior."""
        mean, root = (torch.as_tensor(values).to(z) for values in (self.mean, self.root))
        return mean + z @ root.T


@cache
def _genders() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Mean (30,) and covariance (30,30) of the open body's betas, by gender."""
    with np.load(GENDERS_FILE, allow_pickle=False) as file:
        names, mean, covariance = (file[name] for name in ("genders", "mean", "covariance"))
    return {
        str(name): (mean[i].astype(float), covariance[i].astype(float))
        for i, name in enumerate(names)
    }
