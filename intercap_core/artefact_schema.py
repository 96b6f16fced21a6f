"""Declarations of what an artefact holds, and the check of a file against them."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

import h5py
import numpy as np

_CHECKED_BYTES = 1 << 30  # the ratio is not checked for smaller datasets
_MAX_RATIO = 1 << 16  # bytes unpacked per byte stored; Blosc2 packs a chunk of zeros into 32 bytes
# Axes with one length in the whole file, also inside a camera's group.
_SHARED_DIMS = frozenset({"T", "T+1", "C"})


class Contradiction(ValueError):
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
    """Datasets by key; a key ``cameras/{camera}/...`` declares one dataset per camera."""
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
        of_camera = re.sub("^cameras/[^/]+/", "cameras/{camera}/", key)
        declared = self.fields.get(key) or self.fields.get(of_camera)
        if declared is None:
            raise KeyError(f"schema {self.name!r} declares no dataset {key!r}")
        return declared


def validate(file: h5py.File, schema: Schema) -> dict[str, h5py.Dataset]:
    """Check the file against the schema; returns its declared datasets by key.

    Raises Contradiction.
    """
    found = str(attribute_value(file.attrs.get("schema", "none")))
    if found != schema.name:
        raise Contradiction(f"holds schema {found!r}, expected {schema.name!r}")
    version = file.attrs.get("schema_version", 0)
    if not isinstance(version, int | np.integer):
        raise Contradiction(f"attribute 'schema_version' is {version!r}, expected a whole number")
    if version != schema.version:
        raise Contradiction(
            f"schema {schema.name!r} has version {version}, this program reads version "
            f"{schema.version}"
        )
    complete = file.attrs.get("complete", False)
    if not isinstance(complete, bool | np.bool_) or not complete:
        raise Contradiction("was never finished (no 'complete' mark)")
    for name in schema.attributes:
        if name not in file.attrs:
            raise Contradiction(f"attribute {name!r} is missing")
    lengths: dict[str, int] = {}
    datasets = {}
    for key, declared in schema.fields.items():
        dataset = None if "{camera}" in key else file.get(key)
        if dataset is not None:
            _check_dataset(dataset, key, declared, lengths)
            datasets[key] = dataset
        elif "{camera}" not in key and not declared.optional:
            raise Contradiction(f"dataset {key!r} is missing")
    return datasets


def attribute_value(stored: Any) -> Any:
    """Value of an attribute as a Python object."""
    if isinstance(stored, bytes):
        return stored.decode()
    return stored.item() if isinstance(stored, np.generic) else stored


def _check_dataset(
    dataset: h5py.Dataset, key: str, declared: Field, lengths: dict[str, int]
) -> None:
    """Raise Contradiction unless a dataset has the declared type and shape."""
    if not isinstance(dataset, h5py.Dataset) or dataset.shape is None:
        raise Contradiction(f"{key!r} holds no values, expected a dataset")
    kind = dataset.dtype
    if kind.kind != "S" if declared.dtype == "str" else kind != np.dtype(declared.dtype):
        raise Contradiction(f"dataset {key!r} has type {kind}, expected {declared.dtype}")
    check_size(dataset, key)
    check_shape(key, declared, dataset.shape, lengths)


def check_size(dataset: h5py.Dataset, key: str) -> None:
    """Raise Contradiction if a dataset's size exceeds what its stored bytes can unpack to.

    The rest would be fill values, which take unbounded memory or time to read.
    """
    size = dataset.nbytes
    if size > _CHECKED_BYTES and size > _MAX_RATIO * dataset.id.get_storage_size():
        raise Contradiction(f"dataset {key!r} has shape {dataset.shape}, but too few bytes")


def check_shape(
    key: str,
    declared: Field,
    shape: tuple[int, ...],
    lengths: dict[str, int],
    *,
    group: str = "",
    grows: bool = False,
) -> None:
    """Raise Contradiction unless a dataset's shape is the declared one.

    Args:
        lengths: lengths found so far by the name of the axis; those of this dataset are added.
        group: group of a camera's datasets, within which other axes have their own lengths.
        grows: the first axis may have any length.
    """
    if len(shape) != len(declared.dims):
        raise Contradiction(f"dataset {key!r} has shape {shape}, expected {declared.dims}")
    for axis, (dim, length) in enumerate(zip(declared.dims, shape, strict=True)):
        if grows and axis == 0:
            continue
        name = dim if dim in _SHARED_DIMS or not group else f"{group}:{dim}"
        expected = int(dim) if dim.isdigit() else lengths.setdefault(name, length)
        if length != expected:
            raise Contradiction(
                f"dataset {key!r} has {length} entries along {dim}, expected {expected}"
            )
