"""Read pickles that hold numpy arrays and Python's plain values, and nothing else.

The InterCap release stores results and contact lists as pickles. A pickle is a program: this
reader calls nothing that one names. What numpy's pickles name are stand-ins here, which build an
array only of plain numbers and only where its type, shape and bytes agree; numpy's own believe what
they are told, and crash.
"""

from __future__ import annotations

import codecs
import io
import math
import pickle
import pickletools
import re
from collections import OrderedDict
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np

from intercap_core.inputs.arrays import check_text
from intercap_core.inputs.files import MAX_PICKLE_BYTES, Unreadable, read_bytes
from intercap_core.inputs.quotes import printable
from intercap_core.inputs.structure import check_structure

MAX_VALUES = 1 << 24  # as met on the way through, what is shared at every place
_PLAIN = re.compile(r"[<>=|]?(?:[biuf](?:1|2|4|8)|c(?:8|16)|S\d{1,4}|U\d{1,4}|\?|O8?)")
_OBJECT = np.dtype(object)
# What unpickling raises for damaged programs, beside its own error. It is none of a reader's.
PICKLE_ERRORS = (
    pickle.UnpicklingError, ValueError, TypeError, KeyError, IndexError, AttributeError, EOFError,
    OverflowError, RecursionError, ImportError, AssertionError,
)  # fmt: skip


class _Dtype:
    """Stands for a dtype until its byte order is told."""

    def __init__(self, code: object = None, *_: object) -> None:
        code = code.decode("ascii") if isinstance(code, bytes) else code
        if not isinstance(code, str) or not _PLAIN.fullmatch(code):
            raise pickle.UnpicklingError(f"it holds an array of {printable(f'{code!r:.40}')}")
        self.dtype = np.dtype(code)

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple) or len(state) < 5 or any(x is not None for x in state[2:5]):
            raise pickle.UnpicklingError("it holds an array with fields")
        order = state[1].decode("latin1") if isinstance(state[1], bytes) else state[1]
        if order not in ("<", ">", "|", "="):
            raise pickle.UnpicklingError("it holds an array of no byte order")
        if order in ("<", ">"):
            self.dtype = self.dtype.newbyteorder(order)  # type: ignore[arg-type]


class _Array(np.ndarray):
    """An array that numpy's pickles fill; :func:`_plain` makes numpy's own of it."""

    def __new__(cls, *_: object) -> _Array:
        return super().__new__(cls, 0, np.uint8)

    def __setstate__(self, state: object) -> None:
        if not isinstance(state, tuple) or len(state) not in (4, 5):
            raise pickle.UnpicklingError("it holds an array without shape and values")
        shape, dtype, fortran, values = state[-4:]
        if not isinstance(dtype, _Dtype):
            raise pickle.UnpicklingError("it holds an array of no type")
        checked = _checked(shape, dtype.dtype, values)
        filled: Any = (1, checked, dtype.dtype, bool(fortran), values)
        super().__setstate__(filled)
        check_text(self)


def _checked(shape: object, dtype: np.dtype, values: object) -> tuple[int, ...]:
    """The shape, where the values fill it."""
    if isinstance(shape, int) and not isinstance(shape, bool):
        shape = (shape,)
    if not isinstance(shape, tuple) or not all(type(n) is int and 0 <= n < 1 << 40 for n in shape):
        raise pickle.UnpicklingError("it holds an array of no shape")
    needed, kind = (
        (math.prod(shape), list) if dtype == _OBJECT
        else (math.prod(shape) * dtype.itemsize, bytes)
    )  # fmt: skip
    if isinstance(values, str) and kind is bytes:
        values = values.encode("latin1")
    if len(shape) > 32 or not isinstance(values, kind) or len(values) != needed:
        raise pickle.UnpicklingError("it holds an array whose shape and values differ")
    return shape


_NDARRAY = "numpy.ndarray"  # only ever an argument: called, it would allocate any size


def _reconstruct(kind: object, *_: object) -> np.ndarray:
    if kind is not _NDARRAY:
        raise pickle.UnpicklingError("it asks for another kind of array")
    return _Array()


def _scalar(dtype: object, value: object = None) -> Any:
    content = value.encode("latin1") if isinstance(value, str) else value
    if not isinstance(dtype, _Dtype) or dtype.dtype == _OBJECT or not isinstance(content, bytes):
        raise pickle.UnpicklingError("it holds a number of no type")
    _checked((), dtype.dtype, content)
    if not dtype.dtype.itemsize:
        return dtype.dtype.type()
    made = np.frombuffer(content, dtype.dtype)
    check_text(made)
    return made[0]


def _frombuffer(values: object, dtype: object, shape: object, order: object = "C") -> np.ndarray:
    if not isinstance(dtype, _Dtype) or dtype.dtype == _OBJECT or order not in ("C", "F"):
        raise pickle.UnpicklingError("it holds an array of no type")
    content = bytes(values) if isinstance(values, bytes | bytearray) else b""
    checked = _checked(shape, dtype.dtype, content)
    made = np.frombuffer(content, dtype.dtype) if content else np.zeros(0, dtype.dtype)
    check_text(made)
    return made.reshape(checked, order=order)


def _encode(text: object, name: object = "latin1", *_: object) -> bytes:
    """How protocol 2 pickles written by Python 3 carry bytes."""
    if not isinstance(text, str) or name not in ("latin1", "latin-1"):
        raise pickle.UnpicklingError("it encodes something else than latin-1 text")
    return codecs.encode(text, "latin1")


def _no_bytes() -> bytes:
    """How protocol 2 carries no bytes at all."""
    return b""


# numpy moved these from ``core`` to ``_core`` in 2.0.
_STANDS = {
    (f"numpy.{package}.{module}", name): stand
    for package in ("core", "_core")
    for module, name, stand in (
        ("multiarray", "_reconstruct", _reconstruct),
        ("multiarray", "scalar", _scalar),
        ("numeric", "_frombuffer", _frombuffer),
    )
} | {
    ("numpy", "ndarray"): _NDARRAY,
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _encode,
    ("collections", "OrderedDict"): OrderedDict,
    **{(module, "bytes"): _no_bytes for module in ("builtins", "__builtin__")},
    **{
        (module, kind.__name__): kind
        for module in ("builtins", "__builtin__")
        for kind in (set, frozenset)  # protocols before 4 have no opcode for them
    },
}


class _Unpickler(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        if (module, name) not in _STANDS:
            raise pickle.UnpicklingError(f"it asks for {module:.40}.{name:.40}")
        return _STANDS[module, name]


def check_program(file: BinaryIO) -> None:
    """Read a pickle's program up to its end, running nothing, and go back to its start.

    Raises ValueError where an instruction is unknown, cut off, or asks for memory without using it:
    the unpickler's table of what it remembers is as long as the largest number in the program.
    """
    start = file.tell()
    for count, (instruction, argument, _) in enumerate(pickletools.genops(file), 1):
        remembers = instruction.name in ("PUT", "BINPUT", "LONG_BINPUT")
        if remembers and not (isinstance(argument, int) and 0 <= argument <= count):
            raise ValueError("it remembers more values than it has")
    file.seek(start)


def load(path: Path) -> Any:
    """Load a pickle of numpy arrays and plain Python values.

    Python 2 pickles are read as latin-1, as numpy advises. Raises UserError naming the file where
    it is missing, damaged or asks for anything else.
    """
    path = Path(path)
    file = io.BytesIO(read_bytes(path, MAX_PICKLE_BYTES))
    try:
        check_program(file)
        value = _Unpickler(file, encoding="latin1").load()
        check_structure(value, values=MAX_VALUES)
    except PICKLE_ERRORS as error:
        raise Unreadable(
            path,
            f"not a pickle of numpy arrays and plain values ({str(error)[:200]})",
            "convert it to .npz or .json, or get the file again",
        ) from None
    return _plain(value, {})


def _plain(value: Any, known: dict[int, Any]) -> Any:
    """The value with numpy's own arrays; what is shared stays shared."""
    if isinstance(value, _Array):
        return value.view(np.ndarray)
    if type(value) in (list, tuple, dict, OrderedDict) and id(value) not in known:
        made: Any
        if isinstance(value, dict):
            made = type(value)((key, _plain(inner, known)) for key, inner in value.items())
        else:
            made = type(value)([_plain(inner, known) for inner in value])
        known[id(value)] = made
    return known.get(id(value), value)
