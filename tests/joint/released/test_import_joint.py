"""Our own export, read back as another program's results: the same bodies, metrics, pages."""

from __future__ import annotations

import logging
import pickle
from pathlib import Path

import numpy as np
import pytest

from intercap_core import artefacts
from intercap_core.config import ExportSettings, PageSettings
from intercap_core.errors import UserError
from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.pipeline.outcome import line
from intercap_core.schemas import JOINT, SCENE
from intercap_core.stage_list import STAGES
from intercap_core.stages import export, joint
from tests.helpers import fitted_capture as fitted
from tests.helpers.shared_folder import shared_folder
from tests.helpers.site import make_two_captures, open_two_captures, write_site

NAME = "s01_o03"
MEASURED = ("frames", "scene", "detections", "person", "object_track", "body_fit", "joint")


@pytest.fixture(scope="module")
def capture(tmp_path_factory) -> fitted.Capture:
    folder = shared_folder(tmp_path_factory, "two_captures", make_two_captures)
    return open_two_captures(folder)[NAME]


@pytest.fixture(scope="module")
def results(capture, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("export") / "files"
    export.run(
        paths=capture.inputs(*STAGES["export"].reads),
        models=capture.models,
        settings=ExportSettings(formats=("intercap",)),
        output=folder,
    )
    return folder / "intercap"


def _import(capture: fitted.Capture, results: Path, folder: Path) -> fitted.Capture:
    """The capture with a joint artefact that is made of ``results``."""
    paths = capture.paths | {"joint": folder / "joint.h5", "metrics": folder / "metrics.h5"}
    joint.run(
        paths=capture.inputs(*MEASURED[:-1]),
        output=paths["joint"],
        results=results,
        models=capture.models,
        fit_settings=fitted.FIT_SETTINGS,
    )
    return fitted.Capture(**{**capture.__dict__, "paths": paths})


@pytest.fixture(scope="module")
def imported(capture, results, tmp_path_factory) -> fitted.Capture:
    made = _import(capture, results, tmp_path_factory.mktemp("theirs"))
    made.measure(truth=True)
    return made


def test_bodies_and_objects_equal_those_of_the_file(capture, imported):
    with (
        artefacts.read(capture.paths["joint"], JOINT) as ours,
        artefacts.read(imported.paths["joint"], JOINT) as theirs,
        artefacts.read(capture.paths["scene"], SCENE) as scene,
    ):
        for key in ("betas", "expression", "global_orient", "transl", "body_pose", "jaw_pose",
                    "left_hand_pose", "joints", "rotation", "translation"):  # fmt: skip
            assert theirs[key] == pytest.approx(ours[key], abs=2e-6), key
        # the results belong to the cameras that were given
        assert np.array_equal(theirs["master_from_colour"], scene["master_from_colour_start"])
        assert np.isnan(theirs["contact_probability"]).all() and not theirs["flagged"].any()
        seen = np.isfinite(theirs["keypoint_residual"])
        assert seen.any() and np.nanmedian(theirs["keypoint_residual"]) < 3
        assert theirs.attributes["made_by"] == "another program: res.pkl"
    assert line("joint", imported.paths["joint"]).startswith("made by another program")


def test_metrics_are_those_of_our_fit_without_a_verdict(capture, imported):
    ours, theirs = (SequenceMetrics.read(c.paths["metrics"]) for c in (capture, imported))
    assert (ours.made_by, theirs.made_by) == ("", "another program: res.pkl")
    assert not any(key.startswith("verdict/") for key in theirs.values)
    for key in ("truth/joint/body_pve", "truth/joint/object_translation", "penetration_mean"):
        assert theirs.values[key] == pytest.approx(ours.values[key], abs=1e-5), key


def test_report_names_the_other_program(imported, tmp_path):
    small = PageSettings(cameras=1, frames=1)
    out = write_site({NAME: imported}, tmp_path / "site", settings=small)
    overview = (out / "site" / "index.html").read_text()
    page = (out / "site" / "sequences" / NAME / "index.html").read_text()
    assert "1 with imported results" in overview
    assert "made by another program: res.pkl" in page and "energy of each term" not in page
    assert "1 sequences have imported results" in (out / "README.md").read_text()


def test_gaps_are_filled_and_flagged(capture, results, tmp_path, caplog):
    values = pickle.loads((results / "res.pkl").read_bytes())
    del values["about"], values["left_hand_pose_axis_angle"], values["right_hand_pose_axis_angle"]
    values["transl"][1] = np.nan
    values["betas"][3] += 3.0
    (tmp_path / "theirs.pkl").write_bytes(pickle.dumps(values))
    with caplog.at_level(logging.WARNING):
        made = _import(capture, tmp_path / "theirs.pkl", tmp_path)
    assert "varies by frame" in caplog.text
    with artefacts.read(made.paths["joint"], JOINT) as theirs:
        assert theirs["flagged"].tolist() == [[t == 1] * 4 for t in range(4)]
        assert theirs.text("flag_reason")[1] == (
            "body, hands, object, contact: no result in the imported file"
        )
        assert np.isfinite(theirs["joints"]).all()
        ours = _left_hand(capture)
        # twelve components are not the whole pose, but near it
        assert np.abs(theirs["left_hand_pose"] - ours).max() < 0.5


def _left_hand(capture: fitted.Capture) -> np.ndarray:
    with artefacts.read(capture.paths["joint"], JOINT) as ours:
        return ours["left_hand_pose"]


def test_results_of_another_recording_are_refused(capture, results, tmp_path):
    values = pickle.loads((results / "res.pkl").read_bytes())
    short = {
        key: value[:3] if len(value) == 4 else value for key, value in values.items()
        if key != "about"
    } | {"body_pose": values["body_pose"][:, : 63 * 3]}  # fmt: skip
    (tmp_path / "res.pkl").write_bytes(pickle.dumps(short))
    with pytest.raises(UserError, match="holds 3 frames, sequence 's01_o03' has 4"):
        _import(capture, tmp_path, tmp_path)
    many = values | {"betas": np.zeros((4, 600))}
    (tmp_path / "res.pkl").write_bytes(pickle.dumps(many))
    with pytest.raises(UserError, match="600"):
        _import(capture, tmp_path, tmp_path)
