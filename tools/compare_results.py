"""Compare two results folders: bytes of files, and differences between artefacts.

    python tools/compare_results.py BEFORE AFTER [--tolerance 1e-6]

Use it for changes that must not change results: run the same settings before and after, on the same
machine and with the same threads. Lists files with different bytes. For an artefact (.h5), lists
each dataset that differs, with the largest difference relative to the largest absolute value, and
the number of different integers, flags and texts.

Exits with status 1 if a file exists on one side only, if a file that is no artefact differs, or if
a dataset differs by more than the tolerance (default 0) or in a discrete value.
"""

from __future__ import annotations

import argparse
import hashlib
import sys
from pathlib import Path
from typing import NamedTuple

import h5py
import hdf5plugin  # noqa: F401  registers the depth images' codec
import numpy as np


class Difference(NamedTuple):
    """Difference between two datasets."""

    relative: float
    """Largest difference relative to the largest absolute value."""
    discrete: int
    """Number of different integers, flags and texts."""


def digests(folder: Path) -> dict[str, str]:
    """SHA-256 of every file below ``folder``, by relative path."""
    found = {}
    for path in sorted(folder.rglob("*")):
        if path.is_file():
            with open(path, "rb") as file:
                found[path.relative_to(folder).as_posix()] = hashlib.file_digest(
                    file, "sha256"
                ).hexdigest()
    return found


def differences(before: Path, after: Path) -> dict[str, Difference]:
    """Datasets and attributes that differ between two artefacts."""
    with h5py.File(before) as one, h5py.File(after) as two:
        found = {
            f"attribute {name}": Difference(0.0, 1)
            for name in sorted({*one.attrs, *two.attrs})
            if name not in one.attrs
            or name not in two.attrs
            or not np.array_equal(one.attrs[name], two.attrs[name])
        }
        names: set[str] = set()
        for file in (one, two):
            file.visititems(lambda name, item: names.add(name) if hasattr(item, "shape") else None)
        for name in sorted(names):
            if name not in one or name not in two or one[name].shape != two[name].shape:
                found[name] = Difference(np.inf, 1)
                continue
            difference = _difference(one[name][()], two[name][()])
            if difference != Difference(0.0, 0):
                found[name] = difference
    return found


def _difference(before: np.ndarray, after: np.ndarray) -> Difference:
    before, after = np.asarray(before), np.asarray(after)
    if before.dtype.kind != "f":
        return Difference(0.0, int(np.count_nonzero(before != after)))
    unknown = ~np.isfinite(before)
    discrete = int(np.count_nonzero(unknown != ~np.isfinite(after)))
    both = ~unknown & np.isfinite(after)
    if not both.any():
        return Difference(0.0, discrete)
    largest = np.abs(before[both]).max()
    apart = np.abs(after[both].astype(float) - before[both]).max()
    return Difference(float(apart / largest) if largest else float(apart), discrete)


def main() -> int:
    """Print the comparison; returns the exit status."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("before", type=Path)
    parser.add_argument("after", type=Path)
    parser.add_argument("--tolerance", type=float, default=0.0, help="relative, of a dataset")
    arguments = parser.parse_args()
    for folder in (arguments.before, arguments.after):
        if not folder.is_dir():
            parser.error(f"{folder} is no folder")
    one, two = digests(arguments.before), digests(arguments.after)
    other = [name for name in one if name in two and one[name] != two[name]]
    bad = sorted({*one} ^ {*two})
    for name in bad:
        print(f"{name}: only in {arguments.before if name in one else arguments.after}")
    for name in other:
        if not name.endswith(".h5"):
            print(f"{name}: other bytes")
            bad.append(name)
            continue
        found = differences(arguments.before / name, arguments.after / name)
        print(f"{name}: {len(found)} datasets differ" if found else f"{name}: other bytes alone")
        for dataset, (relative, discrete) in found.items():
            print(f"  {dataset}: relative {relative:.1e}, discrete {discrete}")
            if relative > arguments.tolerance or discrete:
                bad.append(f"{name}:{dataset}")
    same = len({*one} & {*two}) - len(other)
    print(f"{same} of {len(one)} files have the same bytes, {len(other)} differ")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
