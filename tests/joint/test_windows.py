"""Windows of frames: they cover a recording once, and their fits join to that of the recording."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from intercap_core.annotation import ContactInterval
from intercap_core.joint import fit
from intercap_core.joint.windows import join, split_frames
from tests.helpers.fitted_capture import shared_capture
from tests.joint.test_bad_inputs import FRAMES, HeldBall


@pytest.mark.parametrize("count", [1, 399, 400, 401, 3001])
def test_windows_keep_each_frame_once(count: int):
    windows = split_frames(count, size=400, overlap=30)
    frames = [np.arange(count)[window.used] for window in windows]
    np.testing.assert_array_equal(join(windows, frames), np.arange(count))
    assert max(window.kept.stop - window.kept.start for window in windows) <= 400
    for window, used in zip(windows, frames, strict=True):
        assert used[0] == max(0, window.kept.start - 30)
        assert used[-1] == min(count, window.kept.stop + 30) - 1
    assert len(windows) == -(-count // 400)


def test_windows_join_to_the_fit_of_the_recording(tmp_path, tmp_path_factory, monkeypatch):
    """Both windows see all frames, so that each result is that of the recording."""
    ball = HeldBall.copied(shared_capture(tmp_path_factory, FRAMES), tmp_path)
    held = [ContactInterval(part="right_hand", start=1, end=FRAMES - 1)]
    fitted = partial(ball.run, held, look_again=True)
    whole = fitted()
    halves = partial(split_frames, size=FRAMES // 2, overlap=FRAMES)
    monkeypatch.setattr(fit, "split_frames", halves)
    joined = fitted()
    assert whole.keys() == joined.keys()
    for name, values in whole.items():
        if values.dtype.kind == "f":
            np.testing.assert_allclose(joined[name], values, rtol=1e-5, atol=1e-6, err_msg=name)
        else:
            np.testing.assert_array_equal(joined[name], values, err_msg=name)
