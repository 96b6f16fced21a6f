"""Fixtures that several parts of the tests share."""

from __future__ import annotations

import os
from pathlib import Path

from intercap_core.pipeline.job import THREAD_VARIABLES

if "PYTEST_XDIST_WORKER" in os.environ:  # the workers fill the cores; before numpy is imported
    for variable in THREAD_VARIABLES:
        os.environ.setdefault(variable, "1")

import pytest
import torch

from intercap_core.body.model import BodyModel
from tests.helpers.bodies import open_body

PROJECT_ROOT = Path(__file__).resolve().parents[1]


# Folders whose tests share a result that takes minutes: they stay with one worker.
TOGETHER = ("workflow", "slurm")
# Folders and files that start processes, render whole captures or fit whole sequences;
# `make test-fast` leaves them out, and what is marked `slow` elsewhere.
SLOW = (
    "annotate/browser",
    "bench",
    "body/test_jacobian.py",
    "body_fit/test_recover.py",
    "body_fit/test_terms.py",
    "commands",
    "energy/test_body_self.py",
    "object_track",
    "output/site",
    "geometry/rigid/test_open3d_core.py",
    "scene",
    "slurm",
    "stages",
    "studio/test_capture.py",
    "studio/test_interactions.py",
    "studio/test_layouts.py",
    "test_kernel_cache.py",
    "workflow",
)


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Tests of one file stay with one worker, for their fixtures, those of ``TOGETHER`` by folder.

    ``--dist loadgroup`` would need marks that xdist 3.8 no longer hands on under pytest 9.2.
    """
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            path = nodeid.partition("::")[0]
            folder = path.split("/")[1]
            return folder if folder in TOGETHER else path

    return Scheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests are marked, and what shares a long run comes first: a worker is busy with it."""
    places = {item: item.path.relative_to(PROJECT_ROOT / "tests") for item in items}
    for item, place in places.items():
        if any(place.is_relative_to(one) for one in SLOW):
            item.add_marker(pytest.mark.slow)
    items.sort(key=lambda item: places[item].parts[0] not in TOGETHER)


@pytest.fixture(scope="session")
def body() -> BodyModel:
    """The open body; tests must not change it."""
    return open_body()


@pytest.fixture(scope="session")
def body64() -> BodyModel:
    """The open body in double precision."""
    return open_body(torch.float64)


@pytest.fixture(scope="session")
def model(body: BodyModel) -> BodyModel:
    """The open body by the name that the fit gives it."""
    return body


def _sample(name: str) -> Path:
    """A file of the sample data that lies beside the project; skips the test where it does not."""
    folder = Path(os.environ.get("INTERCAP_SAMPLE_DATA", PROJECT_ROOT.parent / "shared" / "data"))
    path = folder / name
    if not path.is_file():
        pytest.skip(f"{path} is not here; set INTERCAP_SAMPLE_DATA to the folder that holds {name}")
    return path


@pytest.fixture
def real_recording() -> Path:
    """A real Azure Kinect recording: 720P MJPG, NFOV_UNBINNED depth and IR, IMU."""
    return _sample("k4a-720p-nfov-imu.mkv")


@pytest.fixture
def real_calibration() -> bytes:
    """A real Azure Kinect calibration JSON."""
    return _sample("k4a-calibration.json").read_bytes()
