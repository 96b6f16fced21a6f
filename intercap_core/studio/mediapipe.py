"""Keypoints of a real detector on the studio's images: MediaPipe Holistic 0.10.21.

MediaPipe requires an older NumPy than this package. It therefore runs in an environment of its own,
which ``make mediapipe`` creates; its models (Apache-2.0) are in its wheel.
"""

from __future__ import annotations

import os
import subprocess
from pathlib import Path

from intercap_core.errors import UserError

VARIABLE = "INTERCAP_MEDIAPIPE"
"""Environment variable with the path of a Python interpreter that has MediaPipe."""
_ROOT = Path(__file__).resolve().parents[2]
DETECTOR_SCRIPT = _ROOT / "tools" / "mediapipe_keypoints.py"
"""Script that detects the keypoints; its checksum is part of the recordings' manifests."""
_OWN = _ROOT / ".venv-mediapipe"  # complete if it contains ".installed"


def mediapipe_python() -> Path | None:
    """Python of the environment with MediaPipe; None if there is none."""
    if not DETECTOR_SCRIPT.is_file():
        return None
    if VARIABLE in os.environ:
        python = Path(os.environ[VARIABLE])
        return python if os.access(python, os.X_OK) and python.is_file() else None
    return _OWN / "bin" / "python" if (_OWN / ".installed").is_file() else None


def detect_keypoints(images: Path, output: Path) -> None:
    """Write the keypoints of a folder of images as COCO-WholeBody JSON to ``output``.

    Raises UserError if MediaPipe is not installed or fails.
    """
    python = mediapipe_python()
    if python is None:
        raise UserError(
            f"studio: 'keypoints: mediapipe' needs MediaPipe ({VARIABLE} or {_OWN}) and "
            f"{DETECTOR_SCRIPT}, which are not there; run 'make mediapipe' in the repository, or "
            f"set {VARIABLE} to the Python of an environment with mediapipe 0.10.21"
        )
    command = [str(python), str(DETECTOR_SCRIPT), str(images), str(output)]
    # TensorFlow Lite writes its start-up messages to the standard error
    quiet = os.environ | {"GLOG_minloglevel": "3", "PYTHONPATH": ""}
    done = subprocess.run(command, env=quiet, capture_output=True, text=True, check=False)
    if done.returncode:
        reason = (done.stderr.strip().splitlines() or ["no message"])[-1]
        raise UserError(f"studio: MediaPipe failed ({reason}); the command was {' '.join(command)}")
