"""Read pickles that hold numpy arrays and Python's plain values, and nothing else.

The InterCap release stores results and contact lists as pickles. A pickle is a program: this
reader refuses to call anything but numpy's own array reconstruction.
"""

from __future__ import annotations

import io
import pickle
from pathlib import Path
from typing import Any

import numpy as np

from intercap_core.errors import UserError

# numpy moved these from ``core`` to ``_core`` in 2.0; ``_codecs.encode`` is how protocol 2 pickles
# written by Python 3 carry bytes.
_NUMPY = {
    (f"numpy.{package}.{module}", name)
    for package in ("core", "_core")
    for module, name in (
        ("multiarray", "_reconstruct"),
        ("multiarray", "scalar"),
        ("numeric", "_frombuffer"),
    )
}
_ALLOWED = _NUMPY | {
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),
    ("collections", "OrderedDict"),
    *{
        (module, name)
        for module in ("builtins", "__builtin__")
        for name in ("set", "frozenset")  # protocols before 4 have no opcode for them
    },
}


_NDARRAY = "numpy.ndarray"  # only ever an argument: called, it would allocate any size


def _empty_array(kind: object, *_: object) -> np.ndarray:
    """The array that numpy's pickles fill afterwards; its shape comes with the values."""
    if kind is not _NDARRAY:
        raise pickle.UnpicklingError("it asks for another kind of array")
    return np.zeros(0, np.uint8)


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _ALLOWED:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}")
        if name == "_reconstruct":
            return _empty_array
        if name == "ndarray":
            return _NDARRAY
        return super().find_class(module, name)


def load(path: Path) -> Any:
    """Load a pickle of numpy arrays and plain Python values.

    Python 2 pickles are read as latin-1, as numpy advises. Raises UserError naming the file where
    it is missing, damaged or asks for anything else.
    """
    path = Path(path)
    try:
        data = path.read_bytes()
    except OSError as error:
        raise UserError(f"{path}: cannot be read ({error.strerror}); check the path") from None
    try:
        return _Unpickler(io.BytesIO(data), encoding="latin1").load()
    except Exception as error:  # a damaged pickle can raise nearly anything
        raise UserError(
            f"{path}: not a pickle of numpy arrays and plain values ({error}); convert it to .npz "
            "or .json, or get the file again"
        ) from None
