"""Preview of a sequence: a short animation for its page, and a small picture for the overview."""

from __future__ import annotations

from dataclasses import dataclass

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
    """The same frame, small, cropped to body and object."""


def middle_of_contact(measured: SequenceMetrics) -> int:
    """Return the middle of the contact frames, or of the sequence if nothing is in contact."""
    frames = list(range(len(measured)))
    if measured.has_object and measured.values["contact_frame"].any():
        frames = np.flatnonzero(measured.values["contact_frame"]).tolist()
    return frames[len(frames) // 2]


def make_preview(
    images: Frames, rig: Rig, c: int, fit: PosedFit, measured: SequenceMetrics
) -> Preview | None:
    """Draw the preview; None if camera ``c`` has no image that shows the fit.

    The still shows :func:`middle_of_contact`.

    Args:
        images: images by the frame that they show (:meth:`Frames.showing`).
    """
    total, middle = len(measured), middle_of_contact(measured)
    spread = np.linspace(0, total - 1, min(_PICTURES, total)).round().astype(int)
    frames = sorted({middle, *spread.tolist()})
    pictures = draw_over(images, rig, c, {t: fit.at(t) for t in frames}, rows=_ROWS)
    if not pictures:
        return None
    nearest = min(pictures, key=lambda t: abs(t - middle))
    small = draw_over(images, rig, c, {nearest: fit.at(nearest)}, rows=_THUMBNAIL_ROWS)
    caption = f"Result over the images of camera {rig.names[c]}"
    return Preview(
        encode_animation(list(pictures.values()), total / measured.fps, caption),
        encode_jpeg(pictures[nearest]),
        encode_jpeg(small[nearest]),
    )
