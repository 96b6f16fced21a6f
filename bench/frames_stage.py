"""Speed and memory of the frames stage on recordings of realistic size.

    python bench/frames_stage.py RECORDING.mkv [--cameras 6] [--sets 100]

Repeats the images of one real recording as ``--cameras`` recordings of ``--sets`` images each, runs
the stage and prints milliseconds per frame set and peak memory.
"""

from __future__ import annotations

import argparse
import resource
import tempfile
import time
from pathlib import Path

import numpy as np

from intercap_core.config import FramesSettings, SequenceEntry
from intercap_core.formats.calibration.extrinsics import Extrinsics, write_rig_file
from intercap_core.formats.recordings.frames import Frames
from intercap_core.formats.recordings.k4a import KinectFile
from intercap_core.stages import frames as stage
from intercap_core.studio.mkv import MkvWriter

FPS = 30


def repeat_recording(source: Path, target: Path, sets: int) -> None:
    """Write a recording of ``sets`` colour and depth images that cycles through the source's."""
    with KinectFile(source) as recording:
        info = recording.info
        packets = list(recording.packets())
        colour = [p.content for p in packets if p.kind == "colour"]
        depth = [recording.depth_image(p.content) for p in packets if p.kind == "depth"]
    with MkvWriter(
        target,
        calibration_json=info.calibration,
        colour_mode=info.colour_mode,
        depth_mode=info.depth_mode,
        fps=FPS,
        serial=target.stem,
    ) as writer:
        for index in range(sets):
            time_us = index * 1_000_000 // FPS
            writer.write_colour(colour[index % len(colour)], time_us)
            writer.write_depth(depth[index % len(depth)], time_us)


def main() -> None:
    """Write the recordings, run the stage, read everything back."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("recording", type=Path)
    parser.add_argument("--cameras", type=int, default=6)
    parser.add_argument("--sets", type=int, default=100)
    arguments = parser.parse_args()
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        names = [f"k{index + 1}" for index in range(arguments.cameras)]
        for camera in names:
            repeat_recording(arguments.recording, folder / f"{camera}.mkv", arguments.sets)
        write_rig_file(folder / "rig.json", Extrinsics("k1", {n: np.eye(4) for n in names}))
        recorded = sum(path.stat().st_size for path in folder.glob("*.mkv"))
        entry = SequenceEntry(
            sequence="bench",
            subject="s",
            object="o",
            recordings=folder,
            calibration=folder / "rig.json",
        )
        output = folder / "frames.h5"
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        start = time.perf_counter()
        stage.run(sequence=entry, output=output, settings=FramesSettings())
        seconds = time.perf_counter() - start
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        print(f"{arguments.cameras} cameras, {arguments.sets} sets, {recorded / 1e6:.0f} MB")
        print(f"extraction: {seconds / arguments.sets * 1e3:.1f} ms a set, "
              f"{recorded / seconds / 1e6:.0f} MB/s, {recorded / output.stat().st_size:.2f}x "
              f"smaller, peak memory {peak / 1024:.0f} MB ({(peak - before) / 1024:.0f} MB more "
              "than before)")  # fmt: skip
        with Frames.open(output) as frames:
            for kind in ("depth", "colour_jpeg", "colour"):
                read = getattr(frames, kind)
                start = time.perf_counter()
                for t in range(frames.num_sets):
                    for c in range(len(names)):
                        read(t, c)
                seconds = time.perf_counter() - start
                print(f"reading {kind}: {seconds / frames.num_sets * 1e3:.1f} ms a set")


if __name__ == "__main__":
    main()
