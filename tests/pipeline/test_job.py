"""Messages of a job on a stream that other processes write to."""

from __future__ import annotations

import io
import subprocess
import sys
from pathlib import Path

import pytest

from intercap_core.errors import UserError
from intercap_core.pipeline.job import job, last_failure


class Writes(io.StringIO):
    """A stream that remembers each write by itself."""

    def __init__(self) -> None:
        super().__init__()
        self.each: list[str] = []

    def write(self, text: str) -> int:
        self.each.append(text)
        return super().write(text)


@pytest.mark.parametrize(
    ("fault", "says"),
    [
        (UserError("person.h5: is cut off"), "one: scene failed: person.h5: is cut off"),
        (ValueError("two\nlines"), "one: scene failed: unexpected ValueError: two\nlines; "),
    ],
)
def test_fault_is_one_write_that_begins_a_line(
    fault: Exception, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stream = Writes()
    monkeypatch.setattr(sys, "stderr", stream)
    with pytest.raises(SystemExit) as left, job("one: scene", tmp_path / "logs" / "scene.log"):
        raise fault
    assert left.value.code == 1
    (text,) = stream.each
    # another process may just have written a line without its end
    assert text.startswith(f"\n{says}")
    assert text.endswith("\n")
    failure = last_failure(tmp_path / "logs")
    assert failure is not None
    assert says.splitlines()[0].partition("failed: ")[2] in failure


@pytest.mark.parametrize(
    "steps",
    [
        [
            (("frames",), {"scipy", "numba", "torch", "trimesh", "open3d.cpu.pybind"}),
            (("detections",), {"scipy.spatial", "torch", "trimesh", "open3d.cpu.pybind"}),
            (("scene", "person"), {"torch", "trimesh", "open3d.cpu.pybind"}),
            (("object_track",), {"torch"}),
        ],
        [
            (("body_fit",), {"trimesh", "open3d.cpu.pybind"}),
            (("joint", "metrics"), {"pandas", "scipy.stats", "matplotlib"}),
        ],
    ],
    ids=["before the fits", "fits"],
)
def test_stages_import_no_library_that_they_do_not_use(
    tmp_path: Path, steps: list[tuple[tuple[str, ...], set[str]]]
) -> None:
    words = f"""
import importlib, sys
from intercap_core.pipeline.job import job
with job("start", {str(tmp_path / "log")!r}):
    import intercap_core.pipeline.step
    for stages, libraries in {steps!r}:
        for stage in stages:
            importlib.import_module(f"intercap_core.stages.{{stage}}")
        print(*libraries & {{*sys.modules}})
"""
    done = subprocess.run([sys.executable, "-c", words], capture_output=True, text=True, check=True)
    assert not done.stdout.split()
