"""What a file format of the export declares, and the content that its writer receives.

A module of this package with a tuple ``FORMATS`` adds these formats to the export: see
docs/extending.md.
"""

from __future__ import annotations

import importlib.util
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from intercap_core.config import ExportSettings
from intercap_core.entries import ObjectEntry
from intercap_core.errors import UserError
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.geometry.rigid.mesh import ObjectMesh
from intercap_core.output.export.about import About
from intercap_core.output.export.motion import Coordinates, Motion
from intercap_core.output.export.silhouettes import Scenes


@dataclass(frozen=True, eq=False)
class Content:
    """One sequence, as the writers of all formats receive it."""

    motion: Motion
    """The motion in the master camera's frame."""
    zup_from_master: np.ndarray
    """(4, 4) transform to the z-up frame."""
    z_up: Motion
    """The motion in the z-up frame."""
    settings: ExportSettings
    about: About
    """Facts that accompany the numbers: flags, contact, estimated errors."""
    scenes: Scenes
    """The motion in the images of the exported cameras. ``bodies`` is empty unless a requested
    format has ``draws_bodies``."""
    recorded: Rig
    """Cameras of the images as recorded."""
    object_: ObjectEntry | None
    """None if the object has a pose in no frame, or without an object."""
    frames: Frames | None = None
    """Recorded images; None unless a requested format has ``reads_images``."""
    image_names: Sequence[Mapping[int, str]] = ()
    """For each camera, the names of its images by number; empty without ``frames``."""

    @property
    def mesh(self) -> ObjectMesh | None:
        """Mesh of the object; None without an object."""
        return self.scenes.mesh

    @property
    def is_z_up(self) -> bool:
        """True if the settings ask for the z-up frame."""
        return self.settings.frame == "z-up"

    @property
    def viewed(self) -> Motion:
        """The motion in the frame of the settings."""
        return self.z_up if self.is_z_up else self.motion

    @property
    def viewed_from_master(self) -> np.ndarray:
        """(4, 4) transform to the frame of ``viewed``."""
        return self.zup_from_master if self.is_z_up else np.eye(4)


@dataclass(frozen=True)
class ExportFormat:
    """A file format of the export."""

    name: str
    """Name in the settings, and of its folder in an export."""
    content: str
    """What the files hold, in words, for the dataset's card."""
    includes: str
    """Glob of its files in a dataset's folder, for Croissant."""
    readme: str
    """Its section of README.txt, a Jinja template with the variables of :func:`.readme.readme`."""
    write: Callable[[Path, Content], Coordinates] = field(compare=False)
    """Writes the files into the format's own folder; returns the coordinates of the numbers."""
    path: str = ""
    """Its files in a dataset's folder, in words, for the card; "" = all in the folder ``name``."""
    media_type: str = "application/octet-stream"
    """Media type of the files that ``includes`` matches."""
    merged: str = ""
    """What the file or folder of all sequences holds that :mod:`.merged` writes; "" = none."""
    needs_object: bool = False
    """It describes an object, and is omitted without one."""
    reads_images: bool = False
    """It reads the recorded images."""
    draws_bodies: bool = False
    """It needs the body's vertices in each frame."""
    holds_parameters: bool = False
    """It holds body parameters, which need the body file."""
    library: str = ""
    """Module that it imports and that only an extra of this package installs; "" for none."""
    extra: str = ""
    """That extra."""

    @property
    def files(self) -> str:
        """Its files in a dataset's folder, in words."""
        return self.path or f"*/export/{self.name}"

    def require_library(self) -> None:
        """Raise UserError that names the extra if the library is not installed."""
        if self.library and importlib.util.find_spec(self.library) is None:
            raise UserError(
                f"export format {self.name!r} needs the package {self.library}: "
                f"pip install 'intercap-core[{self.extra}]', or remove {self.name!r} from "
                "export.formats"
            )
