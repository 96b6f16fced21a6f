"""Close-ups of hands that hold: which moments, from where, and what each column shows."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from intercap_core.commands.pictures import draw_closeups
from intercap_core.errors import UserError
from intercap_core.output.site import closeups, drawing
from intercap_core.output.site.closeups import Handling, Hold
from intercap_core.schemas import CONTACT_REGIONS
from tests.helpers import fitted_capture as fitted

NAME = "s01_o03"
RIGHT = CONTACT_REGIONS.index("right_hand")
PAGE_BYTES = 60_000  # of a picture: the report stays light


@pytest.fixture(scope="module")
def capture(
    captures: dict[str, fitted.Capture], tmp_path_factory: pytest.TempPathFactory
) -> fitted.Capture:
    """The right hand touches a football in frames 1 to 3."""
    made = captures[NAME].copied(tmp_path_factory.mktemp("capture"), "joint")
    with made.edit("joint") as file:
        file["contact_probability"][...] = 0.1
        file["contact_probability"][1:, RIGHT] = 0.9
    return made


def read(capture: fitted.Capture, truth: Path | None) -> Handling:
    return closeups.read_handling(
        capture.inputs("scene", "body_fit", "object_track", "joint"), capture.models, truth=truth
    )


@pytest.fixture(scope="module")
def handling(capture: fitted.Capture) -> Handling:
    return read(capture, capture.paths["truth"])


def cells(picture: drawing.EncodedImage, columns: int) -> np.ndarray:
    """(rows, columns, 200, 200, 3) RGB of the picture's cells."""
    image = cv2.imdecode(np.frombuffer(picture.content, np.uint8), 1)[..., ::-1].astype(int)
    assert image.shape == (picture.height, picture.width, 3)
    return np.array(
        [
            [image[18 + r * 204 : 218 + r * 204, c * 204 : 200 + c * 204] for c in range(columns)]
            for r in range(2)
        ]
    )


def test_holds_are_runs_over_a_half_longest_first() -> None:
    left = [0.0, 0.9, 0.5, 0.8, 0.9, 0.0]
    right = [0.6, 0.6, 0.6, 0.0, 0.0, 1.0]
    found = closeups.holds(np.array([left, right]).T)
    assert found == [
        Hold("right", 0, 2),
        Hold("left", 3, 4),
        Hold("left", 1, 1),
        Hold("right", 5, 5),
    ]
    assert found[0].frame == 1 and found[0].caption == "right hand, frames 0–2, drawn at 1"


def test_columns_are_sequential_joint_and_truth(
    capture: fitted.Capture, handling: Handling
) -> None:
    assert [column.name for column in handling.columns] == ["per-stage", "joint", "truth"]
    assert [column.name for column in read(capture, None).columns] == ["per-stage", "joint"]
    sequential, joint, truth = (column.at(2) for column in handling.columns)
    down = [0, fitted.OBJECT_OFFSET_M, 0]
    np.testing.assert_allclose(sequential.vertices - truth.vertices, [down] * len(truth.vertices))
    np.testing.assert_allclose(joint.vertices, truth.vertices + np.array(down) / 2)
    body = [0, fitted.BODY_OFFSET_M, 0]
    np.testing.assert_allclose(joint.body - truth.body, [body] * len(truth.body), atol=1e-5)


def test_every_cell_shows_skin_and_object(handling: Handling) -> None:
    (hold,) = closeups.holds(handling.probability)
    assert hold == Hold("right", 1, 3)
    picture = closeups.closeup(handling, hold)
    assert len(picture.content) < PAGE_BYTES
    shown = cells(picture, 3)
    red, green, blue = np.moveaxis(shown, -1, 0)
    skin = ((blue - red > 40) & (blue > 60)).sum((2, 3))
    ball = ((red - blue > 60) & (green - blue > 20)).sum((2, 3))
    assert (skin > 500).all() and (ball > 500).all()
    touching = ((red - green > 60) & (np.abs(green - blue) < 40)).sum((2, 3))
    # the palm is 1 mm inside the true ball; skin that faces away from the ball is not red
    assert touching[:, 2].max() > 5
    assert picture.content == closeups.closeup(handling, hold).content
    # the fits differ by what was put in, so that their cells do as well
    assert np.abs(shown[:, 1] - shown[:, 2]).max() > 100


def test_the_same_fit_looks_the_same_in_each_column(handling: Handling) -> None:
    joint = handling.columns[1]
    same = replace(handling, columns=(joint, joint), has_truth=False)
    shown = cells(closeups.closeup(same, Hold("right", 1, 3)), 2)
    assert np.abs(shown[:, 0] - shown[:, 1])[:, :190, :190].max() < 60  # JPEG at the rim
    assert np.abs(shown[0, 0] - shown[1, 0]).mean() > 5  # two sides


def test_both_viewpoints_look_at_the_hand_from_different_sides(handling: Handling) -> None:
    hand = np.asarray(handling.model.regions["right_hand"])
    moment = handling.columns[1].at(2)
    arms = closeups._forearm_faces(handling.model)
    first, second = closeups._viewpoints(moment, hand, arms, handling.up)
    for pose in (first, second):
        np.testing.assert_allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-12)
        middle = pose[:3, :3] @ moment.body[hand].mean(0) + pose[:3, 3]
        np.testing.assert_allclose(middle, [0, 0, closeups._DISTANCE_M], atol=1e-9)
    assert first[2, :3] @ second[2, :3] < np.cos(np.radians(59))


@pytest.fixture
def project(capture: fitted.Capture, tmp_path: Path) -> Path:
    """A project of which this sequence was taken to the joint fit."""
    return fitted.write_project(tmp_path, capture, NAME)


def test_the_command_writes_a_picture_for_each_hold(project: Path, tmp_path: Path) -> None:
    written, empty = draw_closeups(project, [])
    folder = tmp_path / "results" / "trial" / "closeups"
    assert written == [folder / f"{NAME}_right_0001-0003.jpg"] and not empty
    assert cv2.imread(str(written[0])).shape == (422, 608, 3)
    with h5py.File(tmp_path / "results" / "trial" / NAME / "joint.h5", "r+") as file:
        file["contact_probability"][...] = 0.0
    assert draw_closeups(project, [NAME], tmp_path / "none") == ([], [NAME])
    assert not (tmp_path / "none").exists()


def test_missing_inputs_are_reported(project: Path, tmp_path: Path) -> None:
    with pytest.raises(UserError, match=r"sequence 'nobody' is not in the table; it lists s01_o03"):
        draw_closeups(project, ["nobody"])
    with pytest.raises(UserError, match=r"config.yaml: is a file, expected a folder"):
        draw_closeups(project, [NAME], project)
    (tmp_path / "results" / "trial" / NAME / "joint.h5").unlink()
    with pytest.raises(UserError, match=r"joint\.h5"):
        draw_closeups(project, [NAME])
