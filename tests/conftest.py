"""Fixtures that several parts of the tests share."""

from __future__ import annotations

import os
from functools import cache
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


# Folders whose tests share a long run: all their tests stay on one worker.
TOGETHER = ("workflow", "slurm")
# Folders in the order in which they start; the others follow. The workflow takes longest. Meanwhile
# the other worker compiles the kernels of the fits, which the last stages of the workflow then use.
FIRST = ("workflow", "body_fit", "joint", "slurm")
# Not in `make test-fast`: folders and files that start processes, render captures or fit sequences,
# and files that take more than some 3 s (`--durations`, warm kernels).
SLOW = (
    "annotate/browser",
    "annotate/test_rerun.py",
    "annotate/test_server.py",
    "body/test_jacobian.py",
    "body/test_lemo.py",
    "body/test_model.py",
    "body_fit/test_terms.py",
    "commands/test_cli.py",
    "commands/test_extending.py",
    "evaluation/test_stage.py",
    "evaluation/verdict/test_hold_out.py",
    "formats/recordings/test_bad_recordings.py",
    "fuzz",
    "geometry/rigid/test_distance.py",
    "joint/released",
    "joint/test_bad_inputs.py",
    "joint/test_behaviour.py",
    "joint/test_cameras.py",
    "joint/test_extending.py",
    "joint/test_terms.py",
    "object_track/test_bridges.py",
    "object_track/test_given_poses.py",
    "object_track/test_motion.py",
    "object_track/test_places.py",
    "object_track/test_tracker.py",
    "output",
    "person/segmentation/test_image_segmentation.py",
    "person/test_subject.py",
    "pipeline/test_checksums.py",
    "pipeline/test_lease.py",
    "pipeline/test_outcome.py",
    "pipeline/test_person_alone.py",
    "scene/test_lens_exchange.py",
    "scene/test_registration.py",
    "scene/test_slips.py",
    "scene/test_start_times.py",
    "slurm",
    "stages",
    "studio/test_capture.py",
    "studio/test_devices.py",
    "studio/test_interactions.py",
    "studio/test_layouts.py",
    "studio/test_passer_by.py",
    "test_kernel_cache.py",
    "workflow",
)


# Folders and files of the second tier, `make test-all`.
FULL = (
    "annotate/browser",
    "joint/test_extending.py",
    "output/site/test_site_in_a_browser.py",
    "output/viewer/test_browser.py",
    "slurm/test_faults.py",
    "slurm/test_short.py",
    "workflow/test_extending.py",
    "workflow/test_identity.py",
    "workflow/test_outputs.py",
)
# One test of each that `make test` runs as well.
SMOKE = frozenset(
    {
        "test_requests_are_repeated_after_a_lost_connection",
        "test_pages_print_no_errors_and_ask_for_nothing",
        "test_loads_plays_and_seeks_without_an_error",
        "test_a_user_error_is_submitted_once",
    }
)


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> object:
    """Return a scheduler that keeps the tests of one file, or of a folder of TOGETHER, on one
    worker.

    ``--dist loadgroup`` would need marks that xdist 3.8 does not pass on under pytest 9.2.
    """
    from xdist.scheduler import LoadFileScheduling

    class Scheduling(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            path = nodeid.partition("::")[0]
            folder = path.split("/")[1]
            return folder if folder in TOGETHER else path

    return Scheduling(config, log)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests and tests of the second tier; put the folders of FIRST first."""
    places = {item: item.path.relative_to(PROJECT_ROOT / "tests") for item in items}
    for item, place in places.items():
        if _is_in(place, SLOW):
            item.add_marker(pytest.mark.slow)
        smoke = getattr(item, "originalname", item.name) in SMOKE
        if not smoke and _is_in(place, FULL):
            item.add_marker(pytest.mark.full)
    order = {folder: rank for rank, folder in enumerate(FIRST)}
    items.sort(key=lambda item: order.get(places[item].parts[0], len(FIRST)))


@cache
def _is_in(place: Path, folders: tuple[str, ...]) -> bool:
    return any(place.is_relative_to(folder) for folder in folders)


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
