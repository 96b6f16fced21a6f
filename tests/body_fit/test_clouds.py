"""Clouds of the person in the artefact of the body fit."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from intercap_core import artefacts
from intercap_core.body_fit.clouds import PersonCloud, person_clouds, put_clouds, read_clouds
from intercap_core.body_fit.evidence import share_of_precision
from intercap_core.body_fit.observations import read_observations
from intercap_core.geometry.camera.intrinsics import Intrinsics
from intercap_core.geometry.camera.rig import Camera, Rig, stereo_depth_noise
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


def test_stereo_depth_weighs_less_with_distance() -> None:
    lens = Intrinsics(848, 480, 420.0, 420.0, 424.0, 240.0)
    growth = stereo_depth_noise(lens, 0.050)  # a RealSense D435
    flight = Camera("k1", lens, lens, np.eye(4), np.eye(4))
    colour = replace(flight, name="k2", depth=None, colour_from_depth=None)
    cameras = [flight, colour, replace(flight, name="k3", depth_noise=growth)]
    noise = torch.tensor([0.010, 0.005])
    where = torch.tensor([[[0.3, 0.1, 1.0], [0.0, 0.0, 3.0]]])
    shares = share_of_precision(Rig(tuple(cameras)), where, noise)
    # sigma = 0.08 px z^2 / (420 px 0.05 m): 3.8 mm at 1 m, 34 mm at 3 m
    sigma = 0.08 / (420 * 0.05) * np.array([1.0, 9.0])
    expected = [[1, 1], [1, 1], noise.numpy() ** 2 / (noise.numpy() ** 2 + sigma**2)]
    np.testing.assert_allclose(shares[0].numpy(), np.array(expected), rtol=1e-5)
