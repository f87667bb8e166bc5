"""A tracker that is none of hilstar's, as a snapshot script: python plain_camera.py SCREEN OUTPUT.png [--reversed].

Points of light through a pinhole before the screen of the twin's small bench, with noise; `--reversed` turns the rows round.
SCREEN is a picture of 16 bits or the file of an X server's screen.
"""

from __future__ import annotations

import math
import sys
import zlib
from pathlib import Path

import numpy as np
from PIL import Image

SIGMA_PX, WHITE_DN, FLOOR_DN, NOISE_DN = 0.62, 20_000, 20, 1.5
RATIO = (25e3 / 13) / (120e3 / 57.65)  # a screen's pixel in the tracker's
EDGE_PX = 10


def signal(path: Path) -> np.ndarray:
    """What the screen shows, 0 to 1 (480, 640)."""
    if path.suffix == ".png":
        return np.asarray(Image.open(path)) / 65535
    data = path.read_bytes()
    head = np.frombuffer(data[:100], ">u4")
    begin, width, height, row_bytes, colours = (int(head[k]) for k in (0, 4, 5, 12, 19))
    pixels = np.frombuffer(data, np.uint8, count=row_bytes * height, offset=begin + 12 * colours)
    return pixels.reshape(height, row_bytes // 4, 4)[:, :width, 1] / 255


def shares(place: float) -> np.ndarray:
    """Of a point's light, what each of 17 pixels about it has."""
    edges = [(edge - 8.5 - place % 1) / SIGMA_PX / math.sqrt(2) for edge in range(18)]
    return np.diff([math.erf(edge) / 2 for edge in edges])


def photographed(shown: np.ndarray) -> np.ndarray:
    """The tracker's image (400, 400), DN of 12 bits, of an sRGB screen."""
    rng = np.random.default_rng(zlib.crc32(shown.tobytes()))
    image = rng.normal(FLOOR_DN, NOISE_DN, (400 + 2 * EDGE_PX, 400 + 2 * EDGE_PX))
    for row, column in np.argwhere(shown > 0):
        value = shown[row, column]
        light = ((value + 0.055) / 1.055) ** 2.4 if value > 0.04045 else value / 12.92
        x, y = (199.5 + EDGE_PX + RATIO * part for part in (column - 319.5, row - 239.5))
        if all(9 < part < 410 for part in (x, y)):
            square = slice(int(y) - 8, int(y) + 9), slice(int(x) - 8, int(x) + 9)
            image[square] += WHITE_DN * light * np.outer(shares(y), shares(x))
    return np.clip(np.rint(image[EDGE_PX:-EDGE_PX, EDGE_PX:-EDGE_PX]), 0, 4095).astype(np.uint16)


if __name__ == "__main__":
    screen = signal(Path(sys.argv[1]))
    Image.fromarray(photographed(screen[::-1] if "--reversed" in sys.argv else screen)).save(sys.argv[2])
