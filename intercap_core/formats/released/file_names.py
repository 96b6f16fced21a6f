"""How releases name the files of their results, and which of them the workflow watches."""

from __future__ import annotations

from pathlib import Path

INTERCAP = ("res.pkl", "res.npz", "res_2.pkl", "res_1.pkl")  # the newest first
BEHAVE_PERSON, BEHAVE_OBJECT = "smpl_fit_all.npz", "object_fit_all.npz"  # parameters at 30 fps
PERSON_MESH = Path("person", "fit02", "person_fit.ply")  # in the folder of a frame of BEHAVE


def intercap_file(path: Path) -> Path:
    """The file of results in a folder, the folder itself where it has none; a file as it is."""
    return next((path / name for name in INTERCAP if (path / name).is_file()), path)


def files_of(path: Path) -> list[Path]:
    """What the workflow watches of results: a file, or BEHAVE's folder and what it holds itself.

    The folder stands for the thousands of files in its folders of frames: its time changes when a
    frame comes or goes, and looking at all of them would keep a run that has nothing to do busy.
    """
    own = intercap_file(path)
    inside = (path / name for name in (BEHAVE_PERSON, BEHAVE_OBJECT))
    return [own, *(file for file in inside if own == path and file.is_file())]
