"""What surfaces look like: the subject's skin and clothes, an object of one colour or printed."""

from __future__ import annotations

import numpy as np

from intercap_core.body.joints import JOINT_INDEX
from intercap_core.studio.shoes import shoe_area
from intercap_core.studio.subjects import Subject

SKIN = ((0.87, 0.68, 0.56), (0.72, 0.52, 0.40), (0.50, 0.34, 0.25), (0.93, 0.76, 0.66))
HAIR = ((0.10, 0.07, 0.05), (0.28, 0.18, 0.10), (0.16, 0.15, 0.15), (0.45, 0.32, 0.18))
SHIRTS = ((0.25, 0.38, 0.62), (0.60, 0.62, 0.64), (0.55, 0.22, 0.20), (0.20, 0.42, 0.30),
          (0.80, 0.72, 0.45))  # fmt: skip
TROUSERS = ((0.13, 0.15, 0.24), (0.30, 0.28, 0.25), (0.10, 0.10, 0.11), (0.42, 0.40, 0.36))
SHOES = ((0.12, 0.12, 0.13), (0.75, 0.75, 0.74), (0.35, 0.20, 0.12))

PAINTS = ((0.92, 0.91, 0.88), (0.13, 0.13, 0.14), (0.70, 0.12, 0.13), (0.11, 0.28, 0.60),
          (0.84, 0.42, 0.17), (0.16, 0.46, 0.31), (0.88, 0.76, 0.24),
          (0.50, 0.51, 0.53))  # fmt: skip
PRINTS = (3, 7)  # spots of another colour on a printed object, at least and below
PRINT_RADIUS = (0.15, 0.45)  # of a spot, in parts of the object's radius


def object_colours(
    look: str, vertices: np.ndarray, colours: np.ndarray, rng: np.random.Generator
) -> np.ndarray:
    """Colours (V, 3) RGB in [0, 1] of a true object whose mesh has ``colours`` (V, 3): those
    ('mesh'), one for all ('plain') or one with spots of others that no scan knows ('printed')."""
    if look == "mesh":
        return colours
    first, *others = np.array(PAINTS)[rng.permutation(len(PAINTS))]
    found = np.tile(first, (len(vertices), 1))
    if look == "printed":
        radius = np.linalg.norm(vertices - vertices.mean(0), axis=1).max()
        for paint in others[: rng.integers(*PRINTS)]:
            middle = vertices[rng.integers(len(vertices))]
            reach = radius * rng.uniform(*PRINT_RADIUS)
            found[np.linalg.norm(vertices - middle, axis=1) < reach] = paint
    return found


def body_colours(subject: Subject, rng: np.random.Generator) -> np.ndarray:
    """Colours (V, 3) RGB in [0, 1] of the clothed surface."""
    share = np.asarray(subject.weights.todense())
    rest, joints = subject.rest, subject.rest_joints

    def of(*names: str) -> np.ndarray:
        return share[:, [JOINT_INDEX[n] for n in names]].sum(1)

    def pick(palette: tuple[tuple[float, float, float], ...]) -> np.ndarray:
        return np.array(palette[rng.integers(len(palette))]) * rng.uniform(0.92, 1.06)

    colours = np.tile(pick(SKIN), (len(rest), 1))
    dressed = subject.clothing > 0.001
    legs = of("left_hip", "right_hip", "left_knee", "right_knee") + of("pelvis")
    colours[dressed] = pick(SHIRTS)
    colours[dressed & (legs > 0.5)] = pick(TROUSERS)
    colours[shoe_area(subject)] = pick(SHOES)
    eyes = joints[[JOINT_INDEX["left_eye_smplhf"], JOINT_INDEX["right_eye_smplhf"]]].mean(0)
    head = of("head") > 0.5
    scalp = rest[:, 1] > eyes[1] + 0.045
    nape = (rest[:, 2] < eyes[2] - 0.095) & (rest[:, 1] > eyes[1] - 0.07)
    colours[head & (scalp | nape)] = pick(HAIR)
    is_eye = of("left_eye_smplhf", "right_eye_smplhf") > 0.5
    colours[is_eye] = (0.92, 0.92, 0.92)
    pupil = is_eye & (rest[:, 2] > rest[is_eye, 2].max() - 0.003) if is_eye.any() else is_eye
    colours[pupil] = (0.12, 0.09, 0.07)
    lips = (of("jaw") > 0.2) & (np.abs(rest[:, 0]) < 0.02)
    colours[lips & head & (rest[:, 2] > eyes[2])] *= (1.0, 0.82, 0.84)
    weave = rng.normal(1, 0.035, (len(rest), 1))
    return np.clip(colours * weave, 0, 1)
