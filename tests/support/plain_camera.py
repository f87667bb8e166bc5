"""A tracker that is none of hilstar's, with a snapshot command: ... SCREEN OUTPUT.png [--reversed]
[--exposure S].

Points of light through a pinhole before the screen of the twin's small bench, with noise;
`--reversed` turns the rows round. SCREEN is a picture of 16 bits or the file of an X server's
screen.
"""

from __future__ import annotations

import functools
import math
import socketserver
import threading
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from PIL import Image
from scipy import sparse

SIGMA_PX, WHITE_DN_PER_S, FLOOR_DN, NOISE_DN = 0.62, 200_000, 20, 1.5
RATIO = (25e3 / 13) / (120e3 / 57.65)  # a screen's pixel in the tracker's
TABLE = np.linspace(-5, 5, 4001)  # between its places the error function is right to 1e-6


def signal(path: Path) -> np.ndarray:
    """What the screen shows, 0 to 1 (480, 640)."""
    if path.suffix == ".png":
        return np.asarray(Image.open(path)) / 65535
    data = path.read_bytes()
    head = np.frombuffer(data[:100], ">u4")
    begin, width, height, row_bytes, colours = (int(head[k]) for k in (0, 4, 5, 12, 19))
    pixels = np.frombuffer(data, np.uint8, count=row_bytes * height, offset=begin + 12 * colours)
    return pixels.reshape(height, row_bytes // 4, 4)[:, :width, 1] / 255


@functools.cache
def profiles(middle: float, lit: int) -> sparse.csr_array:
    """Of each of the screen's rows or columns, what each of the image's has, (400, lit): a dozen
    pixels.
    """
    place = 199.5 + RATIO * (np.arange(lit) - middle)
    edges = (np.arange(401)[:, None] - 0.5 - place) / SIGMA_PX / math.sqrt(2)
    shares = np.interp(edges, TABLE, [math.erf(at) / 2 for at in TABLE])
    return sparse.csr_array(np.diff(shares, axis=0))


def photographed(shown: np.ndarray, exposure_s: float) -> np.ndarray:
    """The tracker's image (400, 400), DN of 12 bits, of an sRGB screen."""
    rng = np.random.default_rng(zlib.crc32(shown.tobytes()))
    light = shown / 12.92
    bright = shown > 0.04045
    light[bright] = ((shown[bright] + 0.055) / 1.055) ** 2.4
    rows = profiles(239.5, 480) @ (light * WHITE_DN_PER_S * exposure_s)
    seen = (profiles(319.5, 640) @ rows.T).T
    image = rng.normal(FLOOR_DN, NOISE_DN, (400, 400)) + seen
    return np.clip(np.rint(image), 0, 4095).astype(np.uint16)


def take(words: list[str]) -> None:
    """One image, as the command line says."""
    screen, flags = signal(Path(words[0])), words[2:]
    seconds = float(flags[flags.index("--exposure") + 1]) if "--exposure" in flags else 0.1
    Image.fromarray(photographed(screen[::-1] if "--reversed" in flags else screen, seconds)).save(
        words[1], compress_level=1
    )


class _Request(socketserver.StreamRequestHandler):
    def handle(self) -> None:
        try:
            take(self.rfile.readline().decode().removesuffix("\0\n").split("\0"))
        except Exception as error:
            self.wfile.write(repr(error).encode())
        else:
            self.wfile.write(b"ok")


@contextmanager
def on_duty() -> Iterator[str]:
    """A camera that need not be started for each image: the command that asks it, to be followed
    by SCREEN OUTPUT.png.
    """
    with socketserver.TCPServer(("127.0.0.1", 0), _Request) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        try:
            yield f"bash {Path(__file__).with_name('snapshot.sh')} {server.server_address[1]}"
        finally:
            server.shutdown()
            thread.join()
