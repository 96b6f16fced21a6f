"""Videos of given images, with or without sound."""

from __future__ import annotations

from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np

SOUND_HZ = 16_000


def write_video(
    path: Path,
    images: Iterable[np.ndarray],
    codec: str = "mpeg4",
    *,
    fps: float | Fraction = 10,
    sound: np.ndarray | None = None,
    sound_codec: str = "aac",
    sound_from_s: float = 0.0,
    **options: Any,
) -> None:
    """Encode images (H, W, 3) BGR.

    Args:
        sound: samples at SOUND_HZ, for both channels; they begin so long after the first image.
        options: of the stream of images.
    """
    images = list(images)
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=Fraction(fps), **options)
        stream.height, stream.width = images[0].shape[:2]
        stream.pix_fmt = "yuvj420p" if codec == "mjpeg" else "yuv420p"
        if sound is not None:  # streams are declared before the first image is written
            audio = container.add_stream(sound_codec, rate=SOUND_HZ, layout="stereo")
        for number, image in enumerate(images):
            frame = av.VideoFrame.from_ndarray(image, format="bgr24")
            frame.pts = number
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
        if sound is not None:
            both = np.stack([sound, sound]).astype(np.float32)
            heard = av.AudioFrame.from_ndarray(both, format="fltp", layout="stereo")
            heard.sample_rate, heard.time_base = SOUND_HZ, Fraction(1, SOUND_HZ)
            heard.pts = round(sound_from_s * SOUND_HZ)
            resampler = av.AudioResampler(format=audio.codec_context.format)
            for part in [*resampler.resample(heard), None]:
                container.mux(audio.encode(part))
