"""The unknowns of the joint fit: the body's pose and the object's pose in every frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from intercap_core.body.model import BodyModel
from intercap_core.body.parameters import TRANSL, BodyParameters

# Columns of one frame's unknowns.
BODY = slice(0, TRANSL.stop)  # 55 rotation vectors and the translation
BODY_TURNS = slice(0, TRANSL.start)
OBJECT = slice(BODY.stop, BODY.stop + 6)  # turn about the object's origin (left), then shift
OBJECT_TURN = slice(OBJECT.start, OBJECT.start + 3)
OBJECT_SHIFT = slice(OBJECT.start + 3, OBJECT.stop)
ALL = slice(0, OBJECT.stop)


def frame_chunks(count: int) -> list[slice]:
    """Divide frames into chunks of 32, to bound the memory."""
    return [slice(start, start + 32) for start in range(0, count, 32)]


@dataclass(frozen=True)
class State:
    """Body and object in T frames. A state is never changed in place."""

    body: np.ndarray  # (T, 168) pose and translation in the order of ``BodyParameters``
    betas: np.ndarray  # (S,) shape, not an unknown
    expression: np.ndarray  # (T, X) expression, not an unknown
    rotation: np.ndarray  # (T, 3, 3) of master_from_object; NaN without an object
    translation: np.ndarray  # (T, 3) of master_from_object, metres; NaN without an object

    def __len__(self) -> int:
        return len(self.body)

    def window(self, frames: slice) -> State:
        """The state in some frames."""
        return replace(
            self,
            body=self.body[frames],
            expression=self.expression[frames],
            rotation=self.rotation[frames],
            translation=self.translation[frames],
        )

    def joined(self, windows: Sequence[State]) -> State:
        """The states of consecutive windows as one, with the shape of this state."""
        names = ("body", "expression", "rotation", "translation")
        values = ([getattr(window, name) for window in windows] for name in names)
        return replace(self, **dict(zip(names, map(np.concatenate, values), strict=True)))

    def without_object(self) -> State:
        """The same state with NaN poses of the object."""
        nowhere = np.full_like(self.rotation, np.nan), np.full_like(self.translation, np.nan)
        return State(self.body, self.betas, self.expression, *nowhere)

    def parameters(self, model: BodyModel) -> BodyParameters:
        """The body's parameters in the precision of ``model``."""
        vector = np.concatenate(
            [self.body, np.tile(self.betas, (len(self), 1)), self.expression], axis=1
        )
        return model.parameters(torch.as_tensor(vector, dtype=model.dtype))

    def moved(self, step: np.ndarray) -> State:
        """The state after ``step`` (T, 174)."""
        turn = Rotation.from_rotvec(step[:, OBJECT_TURN]).as_matrix()
        return State(
            self.body + step[:, BODY],
            self.betas,
            self.expression,
            turn @ self.rotation,
            self.translation + step[:, OBJECT_SHIFT],
        )
