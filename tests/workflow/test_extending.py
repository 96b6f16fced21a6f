"""The example of a new stage in docs/extending.md runs in the workflow."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.artefact_schema import Field, Schema
from tests.helpers.extending import apply_chapter
from tests.helpers.flow import ONE, Flow

TOUCH_TIME = Schema(
    name="touch_time",
    version=1,
    stage="touch_time",
    fields={"region_names": Field(("R",), "str", ""), "longest": Field(("R",), "float64", "")},
)


def test_a_new_stage_takes_four_files(flow: Flow, tmp_path: Path) -> None:
    other = Flow.copy(tmp_path)
    files = apply_chapter("A new stage", other.folder)
    assert len([path for path in files if "tests" not in path.parts]) == 4
    for name in ("frames", "joint"):
        (other.results / ONE).mkdir(parents=True, exist_ok=True)
        shutil.copy2(flow.artefact(ONE, name), other.artefact(ONE, name))
    done = other.intercap("touch-time", other.settings, ONE)
    assert done.returncode == 0, done.stderr
    with artefacts.read(other.artefact(ONE, "touch_time"), TOUCH_TIME) as source:
        assert np.isfinite(source["longest"]).all() and source["longest"].max() > 0.0
    planned = other.run("--dry-run", str(other.artefact(ONE, "touch_time").relative_to(tmp_path)))
    assert planned.returncode == 0, planned.stderr
    tested = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", str(files[-1])],
        cwd=other.folder, env={**os.environ, **other.environment}, capture_output=True, text=True,
    )  # fmt: skip
    assert tested.returncode == 0, tested.stdout
