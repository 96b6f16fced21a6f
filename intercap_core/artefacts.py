"""Artefacts: HDF5 files with a declared schema, written atomically and validated when read.

An artefact is the output of one stage for one sequence. It is written under a temporary name in
its folder, synced and renamed; the attribute ``complete`` is set last. Every dataset has a
fletcher32 checksum and units, and a coordinate frame if its values have one. Text attributes have a
fixed length, so that they are covered by the checksums of HDF5's headers; the heap of
variable-length texts has none. The same input gives the same bytes: no time, host or path is
stored.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import socket
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # registers the depth codec with HDF5 before any file is opened
import numpy as np

from intercap_core.artefact_schema import (
    Contradiction,
    Field,
    Schema,
    attribute_value,
    check_shape,
    check_size,
    validate,
)
from intercap_core.disk import PartFile
from intercap_core.errors import UserError

MADE_FROM = "made_from"  # attribute with the manifest of pipeline.provenance
PART = ".part"  # suffix of incomplete outputs
_LIBVER = ("v110", "v110")  # headers with checksums, attributes of any size
CHUNK_BYTES = 1 << 20  # one chunk fits into HDF5's default chunk cache
GROWING_CHUNK_BYTES = 1 << 16  # of datasets of unknown length, whose last chunk is partly empty
# Exceptions of h5py for damaged contents
_DAMAGE = (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError, MemoryError)


class Unreadable(UserError):
    """An artefact that is missing, damaged or of another schema."""


def _filters(declared: Field, dtype: np.dtype) -> dict[str, Any]:
    if declared.codec == "depth":
        return dict(hdf5plugin.Blosc2(cname="lz4", clevel=9, filters=hdf5plugin.Blosc2.BITSHUFFLE))
    if declared.codec == "gzip":
        return {"compression": "gzip", "compression_opts": 1, "shuffle": dtype.itemsize > 1}
    return {}


class Writer:
    """Writes the datasets of one artefact; obtained from :func:`write`."""

    def __init__(self, file: h5py.File, schema: Schema, raw: PartFile) -> None:
        self._file = file
        self._schema = schema
        self._raw = raw
        self._dims: dict[str, int] = {}
        self.attributes: dict[str, Any] = {}

    def put(self, key: str, values: Any) -> None:
        """Write a dataset; ``values`` are cast to the declared type.

        Raises KeyError if the schema does not declare the dataset, ValueError if the shape
        contradicts the schema or another dataset, OSError if the disk is full.
        """
        declared = self._schema.field_of(key)
        if declared.dtype == "str":
            array = np.array([str(v).encode() for v in values], dtype="S")
        else:
            array = np.asarray(values)
            target = np.dtype(declared.dtype)
            if target.kind in "iu" and array.dtype.kind == "f":
                raise ValueError(f"{key}: float values for an integer dataset")
            array = np.ascontiguousarray(array, dtype=target)
        dataset = self._create(key, array.shape, array.dtype)
        if array.size:
            dataset[...] = array
        self._raw.check()

    def stream(self, key: str, row_shape: tuple[int, ...] = ()) -> RowStream:
        """Open a dataset to which rows are appended along its first axis."""
        dtype = np.dtype(self._schema.field_of(key).dtype)
        dataset = self._create(key, (0, *row_shape), dtype, grows=True)
        return RowStream(dataset, self._raw)

    def _create(
        self, key: str, shape: tuple[int, ...], dtype: np.dtype, *, grows: bool = False
    ) -> h5py.Dataset:
        """Create a dataset; ``grows``: rows will be appended along the first axis."""
        declared = self._schema.field_of(key)
        group = key.rpartition("/")[0] if key not in self._schema.fields else ""
        check_shape(key, declared, shape, self._dims, group=group, grows=grows)
        row_shape = [max(1, n) for n in shape[1:]]
        row_bytes = dtype.itemsize * math.prod(row_shape)
        rows = min(max(1, shape[0]), CHUNK_BYTES // row_bytes)
        if declared.codec == "depth":
            rows = 1  # one image per chunk, because frames are read one by one
        elif shape == (0,):
            rows = CHUNK_BYTES // row_bytes
        elif grows:
            rows = GROWING_CHUNK_BYTES // row_bytes
        dataset = self._file.create_dataset(
            key,
            shape=shape,
            dtype=dtype,
            chunks=(max(1, rows), *row_shape),
            maxshape=tuple(None if n == 0 or i == 0 else n for i, n in enumerate(shape)),
            fletcher32=True,
            track_times=False,
            **_filters(declared, dtype),
        )
        _set(dataset, "units", declared.units)
        if declared.frame:
            _set(dataset, "frame", declared.frame)
        return dataset


class RowStream:
    """Appends rows to a dataset."""

    def __init__(self, dataset: h5py.Dataset, raw: PartFile) -> None:
        self._dataset = dataset
        self._raw = raw

    def append(self, rows: np.ndarray) -> None:
        """Append ``rows`` of shape (n, *row_shape); raises OSError if the disk is full."""
        start = self._dataset.shape[0]
        self._dataset.resize(start + len(rows), axis=0)
        self._dataset[start:] = rows
        self._raw.check()

    def __len__(self) -> int:
        return int(self._dataset.shape[0])


@contextlib.contextmanager
def write(
    path: Path, schema: Schema, *, settings_digest: str = "", **attributes: Any
) -> Iterator[Writer]:
    """Write an artefact atomically: after an error, ``path`` is unchanged.

    Raises ValueError if a required dataset or attribute is missing at the end of the block, and
    OSError if the disk is full or not writable.

    Args:
        settings_digest: digest of the stage's settings, stored as an attribute.
        attributes: root attributes (str, int, float or bool); more can be set in
            ``Writer.attributes`` within the block.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path if path.suffix == PART else part_of(path)
    try:
        with PartFile(temporary, "w+b") as raw:
            with h5py.File(raw, "w", libver=_LIBVER) as file:
                writer = Writer(file, schema, raw)
                writer.attributes.update(attributes)
                yield writer
                _finish(file, writer, schema, settings_digest)
            raw.check()
            os.fsync(raw.fileno())
        os.replace(temporary, path)
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


def part_of(path: Path) -> Path:
    """Path of an incomplete output: in the same folder, with host, job and process in its name."""
    job = os.environ.get("SLURM_JOB_ID")
    writer = f"{socket.gethostname()}.{f'job{job}.' if job else ''}{os.getpid()}"
    return path.with_name(f".{path.name}.{writer}{PART}")


def put_made_from(path: Path, text: str) -> None:
    """Store the manifest of a complete artefact."""
    with PartFile(path, "r+b") as raw:
        with h5py.File(raw, "r+", libver=_LIBVER) as file:
            _set(file, MADE_FROM, text)
        raw.check()
        os.fsync(raw.fileno())


def made_from(path: Path) -> str:
    """Text of an artefact's manifest, "" if it has none; raises Unreadable if it is no artefact."""
    with (
        _reporting(path, "cannot be read", "re-run its stage"),
        h5py.File(path, "r", locking="best-effort") as file,
    ):
        return attribute_value(file.attrs.get(MADE_FROM, ""))


def _set(owner: h5py.File | h5py.Dataset, name: str, value: Any) -> None:
    """Set an attribute; texts have a fixed length."""
    if isinstance(value, str):
        value = np.array(value.encode(), dtype="S")
    owner.attrs[name] = value


def _finish(file: h5py.File, writer: Writer, schema: Schema, settings_digest: str) -> None:
    """Check that the artefact is complete, and write its attributes, ``complete`` last."""
    missing = [
        key
        for key, declared in schema.fields.items()
        if not declared.optional and "{camera}" not in key and key not in file
    ]
    set_here = set(writer.attributes) - set(schema.optional_attributes)
    unset = sorted(set(schema.attributes) ^ set_here)  # missing or not declared
    if missing or unset:
        raise ValueError(f"artefact {schema.name!r}: missing {missing}, attributes off: {unset}")
    attributes = {
        "schema": schema.name, "schema_version": schema.version, "frame": schema.frame,
        "units": schema.units, "settings_digest": settings_digest,
        **dict(sorted(writer.attributes.items())), "complete": True,
    }  # fmt: skip
    for name, value in attributes.items():
        _set(file, name, value)


@contextlib.contextmanager
def _reporting(path: Path, fault: str, again: str) -> Iterator[None]:
    """Raise Unreadable for exceptions inside the block.

    Args:
        path: file that is read.
        fault: message on damaged contents; a Contradiction has its own.
        again: advice to make the file again.
    """
    try:
        yield
    except Contradiction as contradiction:
        raise Unreadable(f"{path}: {contradiction}; {again}") from None
    except _DAMAGE as error:
        raise Unreadable(f"{path}: {fault}; delete it and {again}") from error


class Artefact:
    """A validated artefact, open for reading; obtained from :func:`read`."""

    def __init__(self, file: h5py.File, path: Path, schema: Schema) -> None:
        self.path = path
        self._file = file
        self._schema = schema
        # open datasets, because a lookup takes longer than a short read
        self._datasets = validate(file, schema)
        self.attributes = {k: attribute_value(v) for k, v in file.attrs.items() if k != MADE_FROM}

    def __contains__(self, key: str) -> bool:
        if key in self._datasets or key not in self._file:
            return key in self._datasets
        with self._reporting(f"dataset {key!r} is damaged"):
            return isinstance(self._file[key], h5py.Dataset)

    def keys(self, prefix: str = "") -> list[str]:
        """Sorted names of the datasets that begin with ``prefix``."""
        names: list[str] = []
        with self._reporting("its list of datasets is damaged"):
            self._file.visit(names.append)
            return sorted(name for name in names if name.startswith(prefix) and name in self)

    def __getitem__(self, key: str) -> np.ndarray:
        """Read a dataset; texts are returned as an object array of ``str``."""
        return self.rows(key, slice(None))

    def rows(self, key: str, selection: Any) -> np.ndarray:
        """Read a part of a dataset, such as one image: ``rows("cameras/k1/depth", 7)``."""
        with self._reporting(f"dataset {key!r} is damaged (its checksum does not match)"):
            if key not in self:
                raise Contradiction(f"dataset {key!r} is missing")
            if key not in self._datasets:
                check_size(self._file[key], key)
                self._datasets[key] = self._file[key]
            values = self._datasets[key][selection]
        if isinstance(values, np.ndarray) and values.dtype.kind == "S":
            return np.char.decode(values, "utf-8").astype(object)
        return values

    def blocks(self, key: str, size: int = 64) -> Iterator[np.ndarray]:
        """Read a dataset ``size`` rows at a time, which bounds the memory."""
        start = 0
        while len(part := self.rows(key, slice(start, start + size))):
            yield part
            start += size

    def describe(self, key: str) -> tuple[tuple[int, ...], str, str, str]:
        """Shape, type, units and frame of a dataset."""
        with self._reporting(f"dataset {key!r} is damaged"):
            dataset = self._file[key]
            check_size(dataset, key)
            return (
                dataset.shape,
                "text" if dataset.dtype.kind == "S" else str(dataset.dtype),
                str(attribute_value(dataset.attrs.get("units", ""))),
                str(attribute_value(dataset.attrs.get("frame", ""))),
            )

    def _reporting(self, fault: str) -> AbstractContextManager[None]:
        return _reporting(self.path, fault, _again(self._schema))

    def text(self, key: str) -> list[str]:
        """Read a dataset of texts as a list."""
        return [str(v) for v in self[key]]


def _again(schema: Schema) -> str:
    return f"re-run stage '{schema.stage}' for this sequence"


def schema_name(path: Path) -> str:
    """Name of an artefact's schema; raises Unreadable if the file is no artefact."""
    _check_is_file(path, "name an .h5 file that a stage wrote")
    try:
        with h5py.File(path, "r", locking="best-effort") as file:
            return str(attribute_value(file.attrs["schema"]))
    except _DAMAGE:
        raise Unreadable(
            f"{path}: not an artefact of this program, or cut or damaged; name an .h5 file that a "
            "stage wrote, or delete this one and re-run its stage"
        ) from None


def _check_is_file(path: Path, advice: str) -> None:
    if path.is_dir():
        raise Unreadable(f"{path}: is a folder, expected an .h5 file; {advice}")
    if not path.is_file():
        raise Unreadable(f"{path}: there is no such file; {advice}")


@contextlib.contextmanager
def read(path: Path, schema: Schema) -> Iterator[Artefact]:
    """Validate an artefact against ``schema`` and open it for reading.

    Datasets of single cameras are not validated before they are read.

    Raises :class:`Unreadable`, which names the file, its fault and the stage to re-run.
    """
    again = _again(schema)
    _check_is_file(path, again)
    with _reporting(path, "not a readable HDF5 file (damaged or half-written)", again):
        file = h5py.File(path, "r", locking="best-effort")
    with file:
        with _reporting(path, "its contents are damaged", again):
            artefact = Artefact(file, path, schema)
        yield artefact


def pack_ragged(items: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """Concatenate byte strings: returns offsets (N+1,) int64 and bytes (B,) uint8."""
    offsets = np.zeros(len(items) + 1, np.int64)
    np.cumsum([len(item) for item in items], out=offsets[1:])
    return offsets, np.frombuffer(b"".join(items), np.uint8)


def unpack_ragged(offsets: np.ndarray, values: np.ndarray) -> list[bytes]:
    """Invert :func:`pack_ragged`."""
    data = values.tobytes()
    return [data[a:b] for a, b in itertools.pairwise(offsets)]
