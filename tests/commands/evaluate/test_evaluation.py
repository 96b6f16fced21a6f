"""Settings and figures of `intercap dev evaluate`."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np

from intercap_core.commands.evaluate.objects import lost_by_draw
from intercap_core.commands.evaluate.run import PARTS, QUICK_SETTINGS
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


def test_lost_shares_are_by_object_and_draw() -> None:
    def measured(dataset: str, shares: dict[str, float]) -> Any:
        errors = [
            SimpleNamespace(object_=name, lost=np.arange(100) < 100 * share)
            for name, share in shares.items()
        ]
        return SimpleNamespace(dataset=dataset, errors=errors)

    draws = [
        measured("object", {"cup": 0.3, "chair": 0.0}),
        measured("object_noise2", {"cup": 0.9}),
        measured("object_redrawn1", {"cup": 0.04, "chair": 0.0}),
        measured("object_redrawn2", {"cup": 0.1, "chair": 0.02}),
    ]
    assert lost_by_draw(draws) == {"cup": [0.3, 0.04, 0.1], "chair": [0.0, 0.0, 0.02]}
    assert lost_by_draw(draws[:2]) == {}
