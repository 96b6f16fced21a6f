"""Read the tensors of a PyTorch checkpoint without executing code that the file names.

Training frameworks also store callbacks and settings as objects of their own classes. PyTorch's
restricted reader rejects such files. Here these objects become :class:`_Inert` placeholders.
"""

from __future__ import annotations

import pickle
import struct
import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from intercap_core.inputs.arrays import PICKLE_ERRORS
from intercap_core.inputs.files import MAX_FILE_BYTES, UnreadableFile, check_file

# Functions that build tensors from the storages of a file
_ALLOWED = {
    ("collections", "OrderedDict"),
    ("torch", "Size"),
    ("torch._utils", "_rebuild_parameter"),
    ("torch._utils", "_rebuild_tensor"),
    ("torch._utils", "_rebuild_tensor_v2"),
}


class _Inert:
    """Placeholder of a class or function that a checkpoint names. It does nothing.

    The methods are those that pickle calls on the objects that it builds.
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
    """Builds tensors and plain values; all other names become :class:`_Inert`."""

    def find_class(self, module: str, name: str) -> Any:
        return super().find_class(module, name) if (module, name) in _ALLOWED else _Inert


class _InertPickle:
    """The part of a pickle module that `torch.load` uses."""

    Unpickler = Unpickler

    @staticmethod
    def load(file: Any, **arguments: Any) -> Any:
        return Unpickler(file, **arguments).load()


# Exceptions of PyTorch's reader for damaged files, in addition to those of unpickling
_ERRORS = (*PICKLE_ERRORS, RuntimeError, OSError, struct.error, zipfile.BadZipFile)


def read_tensors(path: Path, *, advice: str) -> dict[str, Tensor]:
    """Return the tensors by name, on the CPU, of a dictionary or its `state_dict`.

    Raises UnreadableFile if the file is missing, too large or damaged, or contains no dictionary.
    """
    size = check_file(path, MAX_FILE_BYTES, advice=advice)
    try:
        unpacked = 0  # of the format before PyTorch 1.6, which is no zip
        if zipfile.is_zipfile(path):
            with zipfile.ZipFile(path) as archive:
                unpacked = sum(entry.file_size for entry in archive.infolist())
        if unpacked > size:  # torch.save does not compress
            words = f"unpacks from {size / 1e6:.1f} MB to {unpacked / 1e6:.0f} MB, expected no more"
            raise UnreadableFile(path, words, advice)
        read = _read(path)
    except _ERRORS as error:
        raise UnreadableFile(
            path, f"is damaged or was not written by torch.save ({type(error).__name__})", advice
        ) from error
    if not isinstance(read, dict):
        raise UnreadableFile(
            path, f"contains a {type(read).__name__}, expected tensors by name", advice
        )
    state = read.get("state_dict", read)
    if not isinstance(state, dict):
        return {}
    return {str(name)[:200]: value for name, value in state.items() if isinstance(value, Tensor)}


def tensor_fault(value: Tensor, shape: tuple[int, ...], largest: float) -> str | None:
    """Return the reason why a tensor cannot be weights of ``shape``, or None.

    The reason continues a message "NAME has ...". The shape is checked first: a damaged file may
    state one that does not fit in memory.

    Args:
        value: the tensor.
        shape: expected shape.
        largest: largest absolute value that is accepted.
    """
    if tuple(value.shape) != shape:
        return f"{tuple(value.shape)}, expected {shape}"
    if value.device.type != "cpu" or value.layout is not torch.strided:
        return f"no numbers ({value.device.type}, {value.layout})"
    if not value.is_floating_point():
        return f"{value.dtype}, expected floating-point numbers"
    if not bool(value.isfinite().all()):
        return "values that are not finite"
    if float(value.abs().max()) > largest:
        return f"weights up to {float(value.abs().max()):.3g}, expected at most {largest:g}"
    return None


def _read(path: Path) -> Any:
    """Return the content of a checkpoint, by PyTorch's restricted reader if it accepts the file."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # deprecations of PyTorch, which the user cannot act on
        try:
            return torch.load(path, map_location="cpu", weights_only=True)
        except pickle.UnpicklingError:
            return torch.load(
                path, map_location="cpu", weights_only=False, pickle_module=_InertPickle
            )
