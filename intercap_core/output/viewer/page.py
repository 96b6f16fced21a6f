"""The viewer's part of a page, and a page of its own."""

from __future__ import annotations

import html
from pathlib import Path

from intercap_core.output.viewer.content import gather
from intercap_core.output.viewer.package import DATA, script
from intercap_core.sequence_inputs import SequenceModels, SequencePaths

SCRIPT = "viewer.js"
# The file beside the page is of the same origin where a server gives it, and of none on a disk;
# pictures are made from the data.
POLICY = (
    "default-src 'none'; img-src data: blob:; style-src 'unsafe-inline'; "
    "script-src 'self' file: 'unsafe-inline'"
)


def style() -> str:
    """What stands in the page's style sheet."""
    return (DATA / "viewer.css").read_text(encoding="utf-8")


def element() -> str:
    """What stands where the viewer is to be; :func:`load` comes after it."""
    return (DATA / "viewer.html").read_text(encoding="utf-8")


def load() -> str:
    """What loads the file that lies beside the page, once the page stands."""
    return f'<script src="{SCRIPT}" async></script>'


def write_script(
    output: Path,
    paths: SequencePaths,
    models: SequenceModels,
    *,
    truth: Path | None = None,
) -> None:
    """Write the viewer with a sequence's data; see :func:`.content.gather` for the arguments."""
    found = gather(paths, models, truth=truth)
    output.write_text(script(found.header, found.arrays), encoding="utf-8")


def standalone(name: str) -> str:
    """A page that is nothing but the viewer of a sequence."""
    text = (DATA / "standalone.html").read_text(encoding="utf-8")
    parts = {"POLICY": POLICY, "NAME": html.escape(name), "STYLE": style(), "VIEWER": element(),
             "LOAD": load()}  # fmt: skip
    for key, value in parts.items():
        text = text.replace(f"@{key}@", value)
    return text
