"""Read the tensors of a PyTorch checkpoint without running anything that the file names.

Training frameworks store their callbacks and settings beside the weights as objects of their own
classes, which PyTorch's restricted reader refuses. Here such objects become :class:`_Inert`.
"""

from __future__ import annotations

import pickle
import warnings
from pathlib import Path
from typing import Any

import torch

# What makes tensors out of a file's storages; each only builds values
_ALLOWED = {
    ("collections", "OrderedDict"),
    ("torch", "Size"),
    ("torch._utils", "_rebuild_parameter"),
    ("torch._utils", "_rebuild_tensor"),
    ("torch._utils", "_rebuild_tensor_v2"),
}


class _Inert:
    """Stands for a class or function that a checkpoint names: whatever is asked, nothing is done.

    Methods are those that pickle calls on the objects that it builds.
    """

    def __new__(cls, *_: object, **__: object) -> _Inert:
        return super().__new__(cls)

    def __init__(self, *_: object, **__: object) -> None: ...
    def __call__(self, *_: object, **__: object) -> _Inert:
        return self

    def __setstate__(self, _: object) -> None: ...
    def __setitem__(self, _: object, __: object) -> None: ...
    def append(self, _: object) -> None: ...
    def extend(self, _: object) -> None: ...
    def add(self, _: object) -> None: ...


class Unpickler(pickle.Unpickler):
    """Knows tensors and plain values; every other name means :class:`_Inert`."""

    def find_class(self, module: str, name: str) -> Any:
        return super().find_class(module, name) if (module, name) in _ALLOWED else _Inert


class _InertPickle:
    """What `torch.load` wants of a pickle module."""

    Unpickler = Unpickler

    @staticmethod
    def load(file: Any, **arguments: Any) -> Any:
        return Unpickler(file, **arguments).load()


def read_checkpoint(path: Path) -> Any:
    """What `torch.save` wrote, on the CPU. A damaged file can raise any exception."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # what they say of the file is no matter of its user's
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:
            return torch.load(
                path, map_location="cpu", weights_only=False, pickle_module=_InertPickle
            )
