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
import os
import socket
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import h5py
import hdf5plugin  # registers the depth codec with HDF5 before any file is opened
import numpy as np

from intercap_core.disk import PartFile
from intercap_core.errors import UserError

MADE_FROM = "made_from"  # attribute with the manifest of pipeline.provenance
PART = ".part"  # suffix of incomplete outputs
_LIBVER = ("v110", "v110")  # headers with checksums, attributes of any size
CHUNK_BYTES = 1 << 20  # one chunk fits into HDF5's default chunk cache
GROWING_CHUNK_BYTES = 1 << 16  # of datasets of unknown length, whose last chunk is partly empty
_CHECKED_BYTES = 1 << 30  # the ratio is not checked for smaller datasets
_MAX_RATIO = 1 << 16  # bytes unpacked per byte stored; Blosc2 packs a chunk of zeros into 32 bytes


class Unreadable(UserError):
    """An artefact that is missing, damaged or of another schema."""


class _Contradiction(ValueError):
    """A file or dataset contradicts its schema; the message lacks the file's name."""


@dataclass(frozen=True)
class Field:
    """Declaration of one dataset."""

    dims: tuple[str, ...]
    """Name of each axis. Axes of one name have the same length in a file, or in the group of a
    camera unless the name is in ``_SHARED_DIMS``; digits are a length."""
    dtype: str
    """Numpy type, or "str"."""
    doc: str
    """Description for the generated documentation."""
    units: str = "1"
    """Unit of the values."""
    frame: str = ""
    """Coordinate frame of the values; "" if they have none."""
    optional: bool = False
    """Whether a file may lack the dataset."""
    codec: str = "gzip"
    """"gzip", "depth" (Blosc2, lossless) or "none" (for compressed values)."""


@dataclass(frozen=True)
class Schema:
    """Declaration of a stage's artefact."""

    name: str
    """Name of the schema, stored in the file."""
    version: int
    """Version of the schema; files with another version are rejected."""
    stage: str
    """Stage that writes it."""
    fields: Mapping[str, Field]
    """Datasets by key; a key with ``{camera}`` declares one dataset per camera."""
    attributes: Mapping[str, str] = field(default_factory=dict)
    """Descriptions of the root attributes."""
    optional_attributes: Mapping[str, str] = field(default_factory=dict)
    """Descriptions of root attributes that a file may lack."""
    frame: str = "master colour camera: x right, y down, z forward"
    """Default coordinate frame."""
    units: str = "metres, seconds, radians unless a dataset says otherwise"
    """Default units."""

    def field_of(self, key: str) -> Field:
        """Declaration of the dataset ``key``; raises KeyError if there is none."""
        if key in self.fields:
            return self.fields[key]
        for template, declared in self.fields.items():
            head, _, tail = template.partition("{camera}")
            if tail and key.startswith(head) and key.endswith(tail):
                middle = key[len(head) : len(key) - len(tail)]
                if middle and "/" not in middle:
                    return declared
        raise KeyError(f"schema {self.name!r} declares no dataset {key!r}")


def _filters(declared: Field, dtype: np.dtype) -> dict[str, Any]:
    if declared.codec == "depth":
        return dict(hdf5plugin.Blosc2(cname="lz4", clevel=9, filters=hdf5plugin.Blosc2.BITSHUFFLE))
    if declared.codec == "gzip":
        return {"compression": "gzip", "compression_opts": 1, "shuffle": dtype.itemsize > 1}
    return {}


def _chunks(shape: tuple[int, ...], itemsize: int) -> tuple[int, ...]:
    """Shape of a chunk: complete rows of the first axis, up to ``CHUNK_BYTES``."""
    row = itemsize * int(np.prod([max(1, n) for n in shape[1:]], dtype=np.int64))
    rows = max(1, min(max(1, shape[0]), CHUNK_BYTES // row))
    return (rows, *(max(1, n) for n in shape[1:]))


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
            encoded = [str(v).encode() for v in values]
            width = max([len(e) for e in encoded] + [1])
            array = np.array(encoded, dtype=f"S{width}")
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
        _check_shape(key, declared, shape, self._dims, group=group, grows=grows)
        chunks = _chunks(shape, dtype.itemsize)
        if declared.codec == "depth":
            chunks = (1, *shape[1:])  # one image per chunk, because frames are read one by one
        elif shape[0] == 0 and len(shape) == 1:
            chunks = (CHUNK_BYTES // dtype.itemsize,)
        elif grows:
            row = dtype.itemsize * int(np.prod(shape[1:]))
            chunks = (max(1, GROWING_CHUNK_BYTES // row), *shape[1:])
        dataset = self._file.create_dataset(
            key,
            shape=shape,
            dtype=dtype,
            chunks=chunks,
            maxshape=tuple(None if n == 0 or i == 0 else n for i, n in enumerate(shape)),
            fletcher32=True,
            track_times=False,
            **_filters(declared, dtype),
        )
        _set(dataset, "units", declared.units)
        if declared.frame:
            _set(dataset, "frame", declared.frame)
        return dataset


# Axes with one length in the whole file, also inside a camera's group.
_SHARED_DIMS = frozenset({"T", "T+1", "C"})


def _check_shape(
    key: str,
    declared: Field,
    shape: tuple[int, ...],
    lengths: dict[str, int],
    *,
    group: str = "",
    grows: bool = False,
) -> None:
    """Raise _Contradiction unless a dataset's shape is the declared one.

    Args:
        lengths: lengths found so far by the name of the axis; those of this dataset are added.
        group: group of a camera's datasets, within which other axes have their own lengths.
        grows: the first axis may have any length.
    """
    if len(shape) != len(declared.dims):
        raise _Contradiction(f"dataset {key!r} has shape {shape}, expected {declared.dims}")
    for axis, (dim, length) in enumerate(zip(declared.dims, shape, strict=True)):
        if grows and axis == 0:
            continue
        name = dim if dim in _SHARED_DIMS or not group else f"{group}:{dim}"
        expected = int(dim) if dim.isdigit() else lengths.setdefault(name, length)
        if length != expected:
            raise _Contradiction(
                f"dataset {key!r} has {length} entries along {dim}, expected {expected}"
            )


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
    path = Path(path)
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
    try:
        with h5py.File(path, "r", locking="best-effort") as file:
            return _value(file.attrs.get(MADE_FROM, ""))
    except (OSError, RuntimeError, KeyError, ValueError, TypeError):
        raise Unreadable(f"{path}: cannot be read; delete it and re-run its stage") from None


def _set(owner: h5py.File | h5py.Dataset, name: str, value: Any) -> None:
    """Set an attribute; texts have a fixed length."""
    if isinstance(value, str):
        encoded = value.encode()
        value = np.array(encoded, dtype=f"S{max(1, len(encoded))}")
    owner.attrs[name] = value


def _value(stored: Any) -> Any:
    """Value of an attribute as a Python object."""
    if isinstance(stored, bytes):
        return stored.decode()
    return stored.item() if isinstance(stored, np.generic) else stored


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
    _set(file, "schema", schema.name)
    _set(file, "schema_version", schema.version)
    _set(file, "frame", schema.frame)
    _set(file, "units", schema.units)
    _set(file, "settings_digest", settings_digest)
    for key in sorted(writer.attributes):
        _set(file, key, writer.attributes[key])
    _set(file, "complete", True)


class Artefact:
    """A validated artefact, open for reading; obtained from :func:`read`."""

    def __init__(
        self, file: h5py.File, path: Path, schema: Schema, datasets: Mapping[str, h5py.Dataset]
    ) -> None:
        self._file = file
        self._schema = schema
        self._datasets = dict(datasets)  # open ones; a lookup takes longer than a short read
        self.path = path
        self.attributes = {k: _value(v) for k, v in file.attrs.items() if k != MADE_FROM}

    def __contains__(self, key: str) -> bool:
        if key in self._datasets or key not in self._file:
            return key in self._datasets
        try:
            return isinstance(self._file[key], h5py.Dataset)
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise self._damaged(f"dataset {key!r} is damaged") from error

    def keys(self, prefix: str = "") -> list[str]:
        """Sorted names of the datasets that begin with ``prefix``."""
        names: list[str] = []
        try:
            self._file.visit(names.append)
            return sorted(name for name in names if name.startswith(prefix) and name in self)
        except (OSError, RuntimeError, KeyError, ValueError) as error:
            raise self._damaged("its list of datasets is damaged") from error

    def __getitem__(self, key: str) -> np.ndarray:
        """Read a dataset; texts are returned as an object array of ``str``."""
        return self.rows(key, slice(None))

    def rows(self, key: str, selection: Any) -> np.ndarray:
        """Read a part of a dataset, such as one image: ``rows("cameras/k1/depth", 7)``."""
        if key not in self:
            raise Unreadable(
                f"{self.path}: dataset {key!r} is missing; re-run stage "
                f"'{self._schema.stage}' for this sequence"
            )
        try:
            if key not in self._datasets:
                self._datasets[key] = self._file[key]
                self._check_size(key)
            values = self._datasets[key][selection]
        except (OSError, RuntimeError, TypeError, AttributeError, MemoryError) as error:
            # damaged, or a group
            raise self._damaged(
                f"dataset {key!r} is damaged (its checksum does not match)"
            ) from error
        if isinstance(values, np.ndarray) and values.dtype.kind == "S":
            return np.array([v.decode() for v in values.ravel()], dtype=object).reshape(
                values.shape
            )
        return values

    def blocks(self, key: str, size: int = 64) -> Iterator[np.ndarray]:
        """Read a dataset ``size`` rows at a time, which bounds the memory."""
        start = 0
        while len(part := self.rows(key, slice(start, start + size))):
            yield part
            start += size

    def describe(self, key: str) -> tuple[tuple[int, ...], str, str, str]:
        """Shape, type, units and frame of a dataset."""
        try:
            self._check_size(key)
            dataset = self._file[key]
            return (
                dataset.shape,
                "text" if dataset.dtype.kind == "S" else str(dataset.dtype),
                str(_value(dataset.attrs.get("units", ""))),
                str(_value(dataset.attrs.get("frame", ""))),
            )
        except (OSError, RuntimeError, ValueError, TypeError, AttributeError) as error:
            raise self._damaged(f"dataset {key!r} is damaged") from error

    def _check_size(self, key: str) -> None:
        """Raise Unreadable if a dataset declares more than its stored bytes can hold."""
        if _declares_too_much(self._file[key]):
            raise self._damaged(
                f"dataset {key!r} has shape {self._file[key].shape}, but too few bytes"
            )

    def _damaged(self, what: str) -> Unreadable:
        return Unreadable(
            f"{self.path}: {what}; delete the file and re-run stage '{self._schema.stage}' for "
            "this sequence"
        )

    def text(self, key: str) -> list[str]:
        """Read a dataset of texts as a list."""
        return [str(v) for v in self[key]]


def schema_name(path: Path) -> str:
    """Name of an artefact's schema; raises Unreadable if the file is no artefact."""
    _check_is_file(path, "name an .h5 file that a stage wrote")
    try:
        with h5py.File(path, "r", locking="best-effort") as file:
            name = _value(file.attrs["schema"])
    except (OSError, RuntimeError, KeyError, ValueError, TypeError):
        raise Unreadable(
            f"{path}: not an artefact of this program, or cut or damaged; name an .h5 file that a "
            "stage wrote, or delete this one and re-run its stage"
        ) from None
    return str(name)


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
    path = Path(path)
    again = f"re-run stage '{schema.stage}' for this sequence"
    _check_is_file(path, again)
    try:
        file = h5py.File(path, "r", locking="best-effort")
    except OSError as error:
        raise Unreadable(
            f"{path}: not a readable HDF5 file (damaged or half-written); delete it and {again}"
        ) from error
    with file:
        try:
            artefact = Artefact(file, path, schema, _validate(file, schema))
        except _Contradiction as fault:
            raise Unreadable(f"{path}: {fault}; {again}") from None
        except (OSError, RuntimeError, KeyError, ValueError, TypeError, AttributeError) as error:
            raise Unreadable(f"{path}: its contents are damaged; delete it and {again}") from error
        yield artefact


def _validate(file: h5py.File, schema: Schema) -> dict[str, h5py.Dataset]:
    """Check the file against the schema; returns its declared datasets by key.

    Raises _Contradiction.
    """
    found = str(_value(file.attrs.get("schema", "none")))
    if found != schema.name:
        raise _Contradiction(f"holds schema {found!r}, expected {schema.name!r}")
    version = file.attrs.get("schema_version", 0)
    if not isinstance(version, int | np.integer):
        raise _Contradiction(f"attribute 'schema_version' is {version!r}, expected a whole number")
    if version != schema.version:
        raise _Contradiction(
            f"schema {schema.name!r} has version {version}, this program reads version "
            f"{schema.version}"
        )
    complete = file.attrs.get("complete", False)
    if not isinstance(complete, bool | np.bool_) or not complete:
        raise _Contradiction("was never finished (no 'complete' mark)")
    for name in schema.attributes:
        if name not in file.attrs:
            raise _Contradiction(f"attribute {name!r} is missing")
    lengths: dict[str, int] = {}
    datasets = {}
    for key, declared in schema.fields.items():
        dataset = None if "{camera}" in key else file.get(key)
        if dataset is not None:
            _check_dataset(dataset, key, declared, lengths)
            datasets[key] = dataset
        elif "{camera}" not in key and not declared.optional:
            raise _Contradiction(f"dataset {key!r} is missing")
    return datasets


def _check_dataset(
    dataset: h5py.Dataset, key: str, declared: Field, lengths: dict[str, int]
) -> None:
    """Raise _Contradiction unless a dataset has the declared type and shape."""
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
        raise _Contradiction(f"{key!r} holds no values, expected a dataset")
    text = declared.dtype == "str"
    if (text and dataset.dtype.kind != "S") or (
        not text and dataset.dtype != np.dtype(declared.dtype)
    ):
        raise _Contradiction(f"dataset {key!r} has type {dataset.dtype}, expected {declared.dtype}")
    if _declares_too_much(dataset):
        raise _Contradiction(f"dataset {key!r} has shape {dataset.shape}, but too few bytes")
    _check_shape(key, declared, dataset.shape, lengths)


def _declares_too_much(dataset: h5py.Dataset) -> bool:
    """Whether a dataset's size exceeds what its stored bytes can unpack to.

    The rest would be fill values, which take unbounded memory or time to read.
    """
    size = dataset.nbytes
    return bool(size > _CHECKED_BYTES and size > _MAX_RATIO * dataset.id.get_storage_size())


def pack_ragged(items: Sequence[bytes]) -> tuple[np.ndarray, np.ndarray]:
    """Concatenate byte strings: returns offsets (N+1,) int64 and bytes (B,) uint8."""
    offsets = np.zeros(len(items) + 1, np.int64)
    np.cumsum([len(item) for item in items], out=offsets[1:])
    return offsets, np.frombuffer(b"".join(items), np.uint8)


def unpack_ragged(offsets: np.ndarray, values: np.ndarray) -> list[bytes]:
    """Invert :func:`pack_ragged`."""
    data = values.tobytes()
    return [data[a:b] for a, b in itertools.pairwise(offsets)]
