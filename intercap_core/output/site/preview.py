"""Preview of a sequence: a short animation for its page, and a small picture for the overview."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from intercap_core.evaluation.figures import SequenceMetrics
from intercap_core.formats.recordings.frames import Frames
from intercap_core.geometry.camera.rig import Rig
from intercap_core.output.site.drawing import EncodedImage, encode_animation, encode_jpeg
from intercap_core.output.site.overlays import PosedFit, draw_over

PREVIEW = "preview.jpg"  # file name in the folder of the sequence's page
_PICTURES = 24  # of the animation
_ROWS, _THUMBNAIL_ROWS = 340, 144  # largest heights, pixels


@dataclass(frozen=True, eq=False)
class Preview:
    """Pictures of a sequence: the result over the images of one camera."""

    animation: EncodedImage
    """The whole sequence in ``_PICTURES`` evenly spread frames, in real time."""
    still: EncodedImage
    """A frame of it, for readers who prefer no motion."""
    thumbnail: EncodedImage
    """The same frame, small."""
    camera: str
    """Name of the camera."""


def make_preview(
    images: Frames, rig: Rig, c: int, fit: PosedFit, measured: SequenceMetrics
) -> Preview | None:
    """Draw the preview; None if camera ``c`` has no image that shows the fit.

    The still shows the middle of the contact frames, or of the sequence without contact.

    Args:
        images: images by the frame that they show (:meth:`Frames.showing`).
    """
    total = len(measured)
    touching = np.flatnonzero(measured.values.get("contact_frame", np.zeros(total)))
    middle = int(touching[len(touching) // 2]) if len(touching) else total // 2
    spread = np.linspace(0, total - 1, min(_PICTURES, total)).round().astype(int)
    frames = sorted({middle, *spread.tolist()})
    pictures = draw_over(images, rig, c, {t: fit.at(t) for t in frames}, rows=_ROWS)
    if not pictures:
        return None
    still = pictures[min(pictures, key=lambda t: abs(t - middle))]
    scale = min(1.0, _THUMBNAIL_ROWS / len(still))
    small = cv2.resize(still, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    return Preview(
        encode_animation(list(pictures.values()), total / measured.fps),
        encode_jpeg(still),
        encode_jpeg(small),
        rig.names[c],
    )
