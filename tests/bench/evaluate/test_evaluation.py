"""Settings of `intercap dev evaluate`."""

from __future__ import annotations

from pathlib import Path

from bench.evaluate.run import PARTS, QUICK_SETTINGS
from intercap_core.project import load_project

CONFIGS = sorted(Path("config/capture").glob("*.yaml"))


def test_no_two_recordings_share_a_seed() -> None:
    seeds: list[int] = []
    for path in CONFIGS:
        studio = load_project(path).config.studio
        assert studio is not None and studio.slips == "silent"
        rooms = [entry.room for entry in studio.captures.values()]
        assert {"furnished", "bare"} == set(rooms)
        seeds += [entry.seed for entry in studio.captures.values()]
    of_config = ("no_detector", "redrawn_1", "redrawn_2")
    objects = [path for path in PARTS["objects"].settings if path.stem not in of_config]
    others = [
        Path(f"config/{other}/config.yaml")
        for other in ("demo", "test", "bench", "evaluation", "annotate", "detector")
    ]
    others += [QUICK_SETTINGS, Path("config/evaluation/long.yaml")]
    others += sorted(Path("config/field").glob("*.yaml"))
    for path in [*others, *objects]:
        studio = load_project(path).config.studio
        assert studio is not None
        seeds += {entry.seed for entry in studio.captures.values()}
    assert len(CONFIGS) == 3 and len(seeds) == len(set(seeds))
