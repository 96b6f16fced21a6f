"""Video containers, opened as the local file that they are and nothing else."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import av

from intercap_core.inputs.files import check_file

# By content a file may also be a list of other files or addresses, which FFmpeg would follow.
FORMATS = "matroska,webm,mov,mp4,m4a,3gp,3g2,mj2,avi,mpeg,mpegts,mpegvideo"
LATEST_US = 10**15  # of a device's clock: some thirty years; later ones are damage
MAX_SIDE = 16_384  # px of an image that is decoded


def open_container(path: Path, **options: str) -> Any:
    """Open a regular file; raises Unreadable where it is none, and what PyAV raises where it is no
    container of :data:`FORMATS`."""
    check_file(path, None)
    return av.open(
        f"file:{path}",
        options={"format_whitelist": FORMATS, "protocol_whitelist": "file", **options},
        metadata_errors="replace",
    )
