"""Clouds of the person in the artefact of the body fit."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from intercap_core import artefacts
from intercap_core.body_fit.clouds import PersonCloud, person_clouds, put_clouds, read_clouds
from intercap_core.body_fit.observations import read_observations
from intercap_core.schemas import BODY_FIT
from tests.helpers import fitted_capture as fitted
from tests.helpers.synthetic_capture import fill


def _assert_equal(found: PersonCloud, expected: PersonCloud) -> None:
    for name in ("points", "normals", "trust", "view"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name))
    for one, other in (
        *zip(found.windows, expected.windows, strict=True),
        *zip(found.outlines, expected.outlines, strict=True),
    ):
        for name, value in vars(other).items():
            np.testing.assert_array_equal(getattr(one, name), value)


def test_clouds_of_some_frames_are_read_as_they_were_written(tmp_path_factory) -> None:
    capture = fitted.shared_capture(tmp_path_factory, total=6)
    frames, seen = (
        capture.paths["frames"],
        read_observations(capture.paths["scene"], capture.paths["person"]),
    )
    clouds = list(person_clouds(frames, capture.paths["person"], seen, 500))
    assert clouds[2].windows and clouds[2].outlines
    clouds[3] = None
    path = Path(tmp_path_factory.mktemp("clouds")) / "body_fit.h5"
    with artefacts.write(path, BODY_FIT) as writer:
        put_clouds(writer, clouds, len(seen.rig))
        fill(writer, BODY_FIT, T=6, C=len(seen.rig))
    found = read_clouds(path, frames, seen.image_of, slice(2, 5))
    assert found[1] is None
    _assert_equal(found[0], clouds[2])
    _assert_equal(found[2], clouds[4])
