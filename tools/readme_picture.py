"""The README's picture: overlays from the pages of the demo's sequences, side by side.

python tools/readme_picture.py results/demo/site docs/pictures/demo.jpg
"""

from __future__ import annotations

import base64
import re
import sys
from pathlib import Path

import cv2
import numpy as np

HEIGHT = 460
FRAMES_OF_EACH = (1, 2)  # of the overlays of a page's first camera
QUALITY = 82


def main(site: Path, output: Path) -> None:
    """Tile two overlays of every sequence, first camera, at one height."""
    tiles = []
    for page in sorted(site.glob("sequences/*/index.html")):
        text = page.read_text(encoding="utf-8")
        images = re.findall(r"data:image/jpeg;base64,([A-Za-z0-9+/=]+)", text)
        for index in FRAMES_OF_EACH:
            image = cv2.imdecode(np.frombuffer(base64.b64decode(images[index]), np.uint8), 1)
            width = round(image.shape[1] * HEIGHT / image.shape[0])
            tiles.append(cv2.resize(image, (width, HEIGHT), interpolation=cv2.INTER_AREA))
    cv2.imwrite(str(output), np.hstack(tiles), [cv2.IMWRITE_JPEG_QUALITY, QUALITY])


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
