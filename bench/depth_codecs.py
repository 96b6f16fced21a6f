"""Size and speed of lossless codecs for depth images, one image per chunk, with fletcher32.

    python bench/depth_codecs.py RECORDING.mkv [--repeat 40]

Prints a Markdown table: compression ratio, and the median time to write and to read one image
through HDF5 on one thread. The output of every codec is compared with its input.
"""

from __future__ import annotations

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

os.environ.setdefault("BLOSC_NTHREADS", "1")

import h5py
import hdf5plugin
import numpy as np

from intercap_core.formats.recordings.k4a import KinectFile

Blosc, Blosc2, Bitshuffle = hdf5plugin.Blosc, hdf5plugin.Blosc2, hdf5plugin.Bitshuffle
CODECS: dict[str, Mapping[str, Any]] = {
    "none": {},
    "lzf + shuffle": {"compression": "lzf", "shuffle": True},
    "gzip 1 + shuffle": {"compression": "gzip", "compression_opts": 1, "shuffle": True},
    "gzip 4 + shuffle": {"compression": "gzip", "compression_opts": 4, "shuffle": True},
    "zstd 3 + shuffle": {**hdf5plugin.Zstd(clevel=3), "shuffle": True},
    "bitshuffle-lz4": Bitshuffle(cname="lz4"),
    "bitshuffle-zstd 1": Bitshuffle(cname="zstd", clevel=1),
    "bitshuffle-zstd 3": Bitshuffle(cname="zstd", clevel=3),
    "bitshuffle-zstd 9": Bitshuffle(cname="zstd", clevel=9),
    "blosc-zstd 1 shuffle": Blosc(cname="zstd", clevel=1, shuffle=Blosc.SHUFFLE),
    "blosc-zstd 3 bitshuffle": Blosc(cname="zstd", clevel=3, shuffle=Blosc.BITSHUFFLE),
    "blosc2-zstd 1 bitshuffle": Blosc2(cname="zstd", clevel=1, filters=Blosc2.BITSHUFFLE),
    "blosc2-zstd 3 bitshuffle": Blosc2(cname="zstd", clevel=3, filters=Blosc2.BITSHUFFLE),
    "blosc2-zstd 5 bitshuffle": Blosc2(cname="zstd", clevel=5, filters=Blosc2.BITSHUFFLE),
    "blosc2-lz4 5 bitshuffle": Blosc2(cname="lz4", clevel=5, filters=Blosc2.BITSHUFFLE),
}


def measure(images: np.ndarray, options: Mapping[str, Any], folder: Path) -> tuple[float, ...]:
    """Return compression ratio, write and read time of one image in milliseconds."""
    path = folder / "depth.h5"
    writes, reads = [], []
    with h5py.File(path, "w") as file:
        dataset = file.create_dataset(
            "depth", images.shape, np.uint16, chunks=(1, *images.shape[1:]), fletcher32=True,
            **options,
        )  # fmt: skip
        for index, image in enumerate(images):
            start = time.perf_counter()
            dataset[index] = image
            dataset.flush()
            writes.append(time.perf_counter() - start)
        stored = dataset.id.get_storage_size()
    with h5py.File(path, "r", rdcc_nbytes=0) as file:
        dataset = file["depth"]
        for index, image in enumerate(images):
            start = time.perf_counter()
            again = dataset[index]
            reads.append(time.perf_counter() - start)
            if not np.array_equal(again, image):
                raise SystemExit(f"image {index} came back changed")
    return images.nbytes / stored, statistics.median(writes) * 1e3, statistics.median(reads) * 1e3


def main() -> None:
    """Measure every codec on the depth images of one recording."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--repeat", type=int, default=40, help="images to write, at least")
    arguments = parser.parse_args()
    with KinectFile(arguments.recording) as recording:
        packets = [p for p in recording.packets() if p.kind == "depth"]
        images = np.stack([recording.depth_image(p.content) for p in packets])
    images = np.concatenate([images] * -(-arguments.repeat // len(images)))
    print("| codec | ratio | write ms | read ms |\n|---|---|---|---|")
    with tempfile.TemporaryDirectory() as folder:
        for name, options in CODECS.items():
            ratio, write_ms, read_ms = measure(images, options, Path(folder))
            print(f"| {name} | {ratio:.2f} | {write_ms:.1f} | {read_ms:.1f} |")


if __name__ == "__main__":
    main()
