"""The studio's true bodies: people whose shape, mesh, skinning and clothes the fit does not know.

Joint names, axes and the rest pose are SMPL-X's, so that a pose means the same for both. All else
differs from the fitted body:

- Shapes lie 3 to 8 mm outside its shape space, on another mesh with other skinning weights.
- Skinning is half linear, half by dual quaternions (Kavan et al. 2008, "Geometric skinning with
  approximate dual quaternion blending").
- Muscles bulge, and clothes are 5 to 20 mm thick.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numba
import numpy as np
from scipy.sparse import csr_matrix
from scipy.spatial.transform import Rotation

from intercap_core.body.joints import FIRST_FINGER, JOINT_INDEX, NUM_JOINTS, PARENTS
from intercap_core.geometry.camera.transforms import rotation_exp
from intercap_core.studio.skeleton import PuppetSkeleton

# The twelve standard people; people of other builds, whose file has only the arrays that differ.
SUBJECTS_FILE = Path(__file__).parent / "data" / "subjects.npz"
BUILDS_FILE = SUBJECTS_FILE.with_name("builds.npz")
# Drivers: joints whose flexion displaces the skin around them by `bulges`, stated for 90 degrees
_DRIVERS = tuple(
    JOINT_INDEX[f"{side}_{joint}"]
    for joint in ("elbow", "knee", "hip", "shoulder")
    for side in ("left", "right")
)
_TIP_JOINTS = [*range(FIRST_FINGER, NUM_JOINTS)][2::3]
_PARENTS = np.array(PARENTS)
_DUAL_QUATERNION_SHARE = 0.5


@dataclass(frozen=True)
class PosedSubject:
    """B poses, metres. Tips are left index, middle, pinky, ring, thumb, then right."""

    vertices: np.ndarray
    """(B,V,3) skin."""
    clothed: np.ndarray
    """(B,V,3) surface of the clothes."""
    joints: np.ndarray
    """(B,55,3)."""
    tips: np.ndarray
    """(B,10,3)."""


@dataclass(frozen=True)
class Subject:
    """One person in the T-pose, metres."""

    name: str
    gender: str
    height_m: float
    rest: np.ndarray
    """(V,3) vertices."""
    faces: np.ndarray
    """(F,3)."""
    rest_joints: np.ndarray
    """(55,3)."""
    rest_tips: np.ndarray
    """(10,3) fingertips in the order of :class:`PosedSubject`."""
    weights: csr_matrix
    """(V,55) skinning weights."""
    bulges: np.ndarray
    """(8,V,3) displacement of the skin at a right angle of each of ``_DRIVERS``."""
    clothing: np.ndarray
    """(V,) thickness of the clothes."""
    fitted_face: np.ndarray
    """(N,) face of this mesh below each vertex of the open body."""
    fitted_bary: np.ndarray
    """(N,3) barycentric coordinates in it."""
    sole_m: float = 0.0
    """Distance of the soles of shoes below the lowest skin."""

    @classmethod
    def load(cls, name: str) -> Subject:
        """Load a person of `subject_names()` or `build_names()`; another name raises KeyError."""
        names = (*subject_names(), *build_names())
        if name not in names:
            raise KeyError(f"no subject {name!r}; there are {', '.join(names)}")
        data = _file(SUBJECTS_FILE)
        if name in build_names():
            data = data | _file(BUILDS_FILE)
        i = data["names"].tolist().index(name)
        weights = data["weights"].astype(np.float64)
        bary = data["fitted_bary"].astype(np.float64)
        return cls(
            name=name,
            gender=str(data["gender"][i]),
            height_m=float(data["height_m"][i]),
            rest=data["template"] + data["offsets"][i].astype(np.float64),
            faces=data["faces"].astype(np.int64),
            rest_joints=data["joints"][i].astype(np.float64),
            rest_tips=data["tips"][i].astype(np.float64),
            weights=csr_matrix(weights / weights.sum(1, keepdims=True)),
            bulges=data["bulges"].astype(np.float64) * float(data["bulge_scale"][i]),
            clothing=data["clothing"][i].astype(np.float64),
            fitted_face=data["fitted_face"].astype(np.int64),
            fitted_bary=bary / bary.sum(1, keepdims=True),
        )

    def skin(self, pose: np.ndarray, transl: np.ndarray) -> PosedSubject:
        """Pose the person.

        Args:
            pose: local rotations (B,55,3,3), or axis-angle (B,165) or (B,55,3), in SMPL-X's order.
            transl: (B,3) metres, added to the rest position as in SMPL-X.
        """
        is_local = pose.shape[1:] == (NUM_JOINTS, 3, 3)
        local = pose if is_local else rotation_exp(pose.reshape(len(pose), NUM_JOINTS, 3))
        world = local.copy()
        for k in range(1, NUM_JOINTS):
            world[:, k] = world[:, PARENTS[k]] @ local[:, k]
        pelvis = self.rest_joints[0] + transl
        joints = PuppetSkeleton(self.rest_joints).forward(world, pelvis)
        offsets = joints - np.einsum("bkij,kj->bki", world, self.rest_joints)
        rest = self._flexed(local)
        vertices = self._blend(world, offsets, rest)
        clothed = vertices + self.normals(vertices) * self.clothing[:, None]
        tips = offsets[:, _TIP_JOINTS] + np.einsum(
            "bkij,kj->bki", world[:, _TIP_JOINTS], self.rest_tips
        )
        return PosedSubject(vertices, clothed, joints, tips)

    def on_fitted_topology(self, vertices: np.ndarray) -> np.ndarray:
        """(B,V,3) on this mesh -> (B,N,3) points at the open body's vertices."""
        corners = vertices[:, self.faces[self.fitted_face]]
        return np.einsum("nk,bnkc->bnc", self.fitted_bary, corners)

    def normals(self, vertices: np.ndarray) -> np.ndarray:
        """(B,V,3) -> unit normals (B,V,3), weighted by area."""
        return _normals(np.asarray(vertices, np.float64), self.faces)

    @property
    def rest_clothed(self) -> np.ndarray:
        """The clothed surface (V,3) in the T-pose."""
        return self.rest + self.normals(self.rest[None])[0] * self.clothing[:, None]

    def _flexed(self, local: np.ndarray) -> np.ndarray:
        """(B,V,3) rest vertices with the bulges of the bent joints."""
        trace = np.trace(local[:, _DRIVERS], axis1=-2, axis2=-1)
        # 1 - cos of the joint's angle, at most 1.6 times that of 90 degrees
        bend = np.clip(1 - (trace - 1) / 2, 0, 1.6)
        return self.rest + np.einsum("bd,dvc->bvc", bend, self.bulges)

    def _blend(self, world: np.ndarray, offsets: np.ndarray, rest: np.ndarray) -> np.ndarray:
        """Half linear, half dual-quaternion blend skinning, (B,V,3)."""
        batch = len(world)
        real = Rotation.from_matrix(world.reshape(-1, 3, 3)).as_quat().reshape(batch, -1, 4)
        _face_parents(real, _PARENTS)
        dual = 0.5 * _quaternion_product(offsets, real)
        out = np.empty_like(rest)
        for b in range(batch):
            rows = np.concatenate([world[b].reshape(-1, 9), offsets[b], real[b], dual[b]], 1)
            _blend_one(self.weights @ rows, rest[b], out[b])
        return out


def subject_names() -> tuple[str, ...]:
    """Names of the twelve standard people, in a fixed order."""
    return tuple(_file(SUBJECTS_FILE)["names"].tolist())


def build_names() -> tuple[str, ...]:
    """Names of the people of other builds: small and tall, slight and strong."""
    return tuple(_file(BUILDS_FILE)["names"].tolist())


@cache
def _file(path: Path) -> dict[str, np.ndarray]:
    with np.load(path, allow_pickle=False) as file:
        return {name: file[name] for name in file.files}


@numba.njit(cache=True)
def _normals(vertices, faces):
    """(B,V,3) and faces (F,3) -> unit normals (B,V,3), weighted by area."""
    normals = np.zeros_like(vertices)
    for b in range(len(vertices)):
        for f in range(len(faces)):
            i, j, k = faces[f, 0], faces[f, 1], faces[f, 2]
            p, q, r = vertices[b, i], vertices[b, j], vertices[b, k]
            ux, uy, uz = q[0] - p[0], q[1] - p[1], q[2] - p[2]
            vx, vy, vz = r[0] - p[0], r[1] - p[1], r[2] - p[2]
            x, y, z = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
            for corner in (i, j, k):
                normals[b, corner, 0] += x
                normals[b, corner, 1] += y
                normals[b, corner, 2] += z
        for v in range(vertices.shape[1]):
            x, y, z = normals[b, v]
            length = max(np.sqrt(x * x + y * y + z * z), 1e-12)
            for axis in range(3):
                normals[b, v, axis] /= length
    return normals


@numba.njit(cache=True)
def _face_parents(quaternions, parents):
    """Flip signs of quaternions (B,55,4), so that blends with the parents' are short, in place."""
    for b in range(len(quaternions)):
        for k in range(1, quaternions.shape[1]):
            if (quaternions[b, k] * quaternions[b, parents[k]]).sum() < 0:
                quaternions[b, k] *= -1


@numba.njit(cache=True)
def _blend_one(mixed, rest, out):
    """Fill ``out`` (V,3) from rest (V,3) and each vertex's blend ``mixed`` (V,20): a matrix, a
    translation, and the real and dual part of a quaternion (x y z w)."""
    for v in range(len(rest)):
        x, y, z = rest[v]
        length = np.sqrt((mixed[v, 12:16] ** 2).sum())
        a, b, c, w = mixed[v, 12:16] / length
        ea, eb, ec, ew = mixed[v, 16:20] / length
        # turned = p + 2 q x (q x p + w p), shifted by 2 (w e - e_w q + q x e)
        tx, ty, tz = b * z - c * y + w * x, c * x - a * z + w * y, a * y - b * x + w * z
        dx = 2 * (b * tz - c * ty + w * ea - ew * a + b * ec - c * eb)
        dy = 2 * (c * tx - a * tz + w * eb - ew * b + c * ea - a * ec)
        dz = 2 * (a * ty - b * tx + w * ec - ew * c + a * eb - b * ea)
        moved = (x + dx, y + dy, z + dz)
        for axis in range(3):
            m = mixed[v, 3 * axis : 3 * axis + 3]
            linear = m[0] * x + m[1] * y + m[2] * z + mixed[v, 9 + axis]
            out[v, axis] = linear + _DUAL_QUATERNION_SHARE * (moved[axis] - linear)


def _quaternion_product(vector: np.ndarray, quaternion: np.ndarray) -> np.ndarray:
    """(vector, 0) * quaternion, both x y z w, (...,3) and (...,4)."""
    v, w = quaternion[..., :3], quaternion[..., 3:]
    imaginary = w * vector + np.cross(vector, v)
    return np.concatenate([imaginary, -(vector * v).sum(-1, keepdims=True)], -1)


# Work boots
SOLE_M = 0.022  # thickness of the sole below the lowest skin
LEATHER_M = (0.010, 0.015)  # thickness at the sides
SLOPING = 0.3  # downward component of the normals of skin above the sole
# Joints: ankle and ball of the left foot, of the right one.
FEET = [
    [JOINT_INDEX[f"{side}_{joint}"] for joint in ("ankle", "foot")] for side in ("left", "right")
]


def shoe_area(subject: Subject) -> np.ndarray:
    """Mask (V,) of the vertices inside the shoes."""
    share = np.asarray(subject.weights[:, [joint for foot in FEET for joint in foot]].sum(1))
    return (share.ravel() > 0.5) & (subject.rest[:, 1] < _top(subject))


def in_heavy_shoes(subject: Subject, rng: np.random.Generator) -> Subject:
    """The same person in heavy shoes, which are part of the clothing.

    The bare feet stay the true body; the soles stand on the floor. ``rng`` draws the leather.
    """
    leather = rng.uniform(*LEATHER_M)
    down = -subject.normals(subject.rest[None])[0, :, 1]
    clothing, height = subject.clothing.copy(), subject.rest[:, 1]
    worn = shoe_area(subject)
    for foot in FEET:
        share = np.asarray(subject.weights[:, foot].sum(1)).ravel()
        own = np.flatnonzero(worn & (share > 0.5))
        ground = height[own].min() - SOLE_M
        # along the normal down to the sole, but not farther to the side than leather may be thick
        across = np.sqrt(np.maximum(1 - down[own] ** 2, 1e-6))
        deep = (height[own] - ground) / np.maximum(down[own], SLOPING)
        sole = np.minimum(deep, LEATHER_M[1] / across)
        # leather becomes thinner in the upper 2 cm; a sole is at most 45 mm thick
        sides = leather * np.clip((_top(subject) - height[own]) / 0.02, 0.3, 1)
        below = np.maximum(sides, np.minimum(sole, 0.045))
        clothing[own] = np.where(down[own] > SLOPING, below, sides)
    return replace(subject, clothing=clothing, sole_m=SOLE_M)


def _top(subject: Subject) -> float:
    """Height in the T-pose at which shoes end, metres."""
    return float(subject.rest_joints[[7, 8], 1].mean()) + 0.01


# Colours, RGB in [0, 1], from which :func:`body_colours` draws.
PALETTES = {
    "skin": ((0.87, 0.68, 0.56), (0.72, 0.52, 0.40), (0.50, 0.34, 0.25), (0.93, 0.76, 0.66)),
    "hair": ((0.10, 0.07, 0.05), (0.28, 0.18, 0.10), (0.16, 0.15, 0.15), (0.45, 0.32, 0.18)),
    "shirt": (
        (0.25, 0.38, 0.62),
        (0.60, 0.62, 0.64),
        (0.55, 0.22, 0.20),
        (0.20, 0.42, 0.30),
        (0.80, 0.72, 0.45),
    ),
    "trousers": ((0.13, 0.15, 0.24), (0.30, 0.28, 0.25), (0.10, 0.10, 0.11), (0.42, 0.40, 0.36)),
    "shoes": ((0.12, 0.12, 0.13), (0.75, 0.75, 0.74), (0.35, 0.20, 0.12)),
}


def body_colours(subject: Subject, rng: np.random.Generator) -> np.ndarray:
    """Colours (V, 3) RGB in [0, 1] of the clothed surface: skin, clothes, shoes, hair, eyes, lips.

    Areas follow from the skinning weights and from places relative to the eyes, metres.
    """
    share = np.asarray(subject.weights.todense())
    rest, joints = subject.rest, subject.rest_joints

    def of(*names: str) -> np.ndarray:
        return share[:, [JOINT_INDEX[n] for n in names]].sum(1)

    def pick(name: str) -> np.ndarray:
        palette = PALETTES[name]
        return np.array(palette[rng.integers(len(palette))]) * rng.uniform(0.92, 1.06)

    colours = np.tile(pick("skin"), (len(rest), 1))
    dressed = subject.clothing > 0.001
    legs = of("left_hip", "right_hip", "left_knee", "right_knee") + of("pelvis")
    colours[dressed] = pick("shirt")
    colours[dressed & (legs > 0.5)] = pick("trousers")
    colours[shoe_area(subject)] = pick("shoes")
    eyes = joints[[JOINT_INDEX["left_eye_smplhf"], JOINT_INDEX["right_eye_smplhf"]]].mean(0)
    head = of("head") > 0.5
    scalp = rest[:, 1] > eyes[1] + 0.045
    nape = (rest[:, 2] < eyes[2] - 0.095) & (rest[:, 1] > eyes[1] - 0.07)
    colours[head & (scalp | nape)] = pick("hair")
    is_eye = of("left_eye_smplhf", "right_eye_smplhf") > 0.5
    colours[is_eye] = (0.92, 0.92, 0.92)
    pupil = is_eye & (rest[:, 2] > rest[is_eye, 2].max() - 0.003) if is_eye.any() else is_eye
    colours[pupil] = (0.12, 0.09, 0.07)
    lips = (of("jaw") > 0.2) & (np.abs(rest[:, 0]) < 0.02)
    colours[lips & head & (rest[:, 2] > eyes[2])] *= (1.0, 0.82, 0.84)
    weave = rng.normal(1, 0.035, (len(rest), 1))
    return np.clip(colours * weave, 0, 1)
