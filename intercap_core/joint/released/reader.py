"""Whose release results are of."""

from __future__ import annotations

from pathlib import Path

from intercap_core.errors import UserError
from intercap_core.formats.released.file_names import (
    BEHAVE_OBJECT,
    BEHAVE_PERSON,
    INTERCAP,
    intercap_file,
)
from intercap_core.formats.released.results import Recording, Results
from intercap_core.joint.released import behave as release_behave
from intercap_core.joint.released import intercap as release_intercap


def read_results(path: Path, recording: Recording) -> Results:
    """Results of a sequence, whoever's they are.

    A file, and a folder that holds one of InterCap's names, is InterCap's; a folder of frame
    folders ``t<seconds>``, or with BEHAVE's parameters at 30 fps, is BEHAVE's. Raises UserError
    where it is neither, and as the readers do.
    """
    file = intercap_file(Path(path))
    if not file.is_dir():
        return release_intercap.read_results(file)
    at_30_fps = (BEHAVE_PERSON, BEHAVE_OBJECT)
    if any((file / name).is_file() for name in at_30_fps) or any(file.glob("t[0-9]*/")):
        return release_behave.read_results(file, recording)
    raise UserError(
        f"{file}: holds none of {', '.join(INTERCAP)} (InterCap's), no frame's folder t<seconds> "
        f"and none of {' and '.join(at_30_fps)} (BEHAVE's); name the file or folder of results"
    )
