"""The bytes of an image as a camera sends them, as DN: GenICam's names of pixel formats
(PFNC 2.4, and GigE Vision's own packed ones).
"""

import re

import numpy as np
import numpy.typing as npt

from hilstar.basics.errors import InputError

FORMAT = re.compile(r"(Mono|Bayer(?:RG|GR|GB|BG))(8|10|12|14|16)(Packed|p)?")
BAYER = "Bayer"
# The name has the first row alone; the second has the other two of R, G, G and B.
MOSAICS = {"RG": "RGGB", "GR": "GRBG", "GB": "GBRG", "BG": "BGGR"}
Dn = npt.NDArray[np.uint16]


def mosaic_of(pixel_format: str) -> str:
    """The colours of two rows of pixels from the top left, such as "RGGB"; "" for grey."""
    if not pixel_format.startswith(BAYER):
        return ""
    return MOSAICS.get(pixel_format[len(BAYER) :][:2], "")


def unpacked(data: bytes, pixel_format: str, width_px: int, height_px: int) -> Dn:
    """The DN (height, width) of an image. Raises InputError for a format that is none of grey or
    Bayer, and where bytes are missing.
    """
    match = FORMAT.fullmatch(pixel_format)
    if match is None:
        raise InputError(
            f"the camera sends {pixel_format}; write a pixel_format of grey or Bayer, such as"
            ' "Mono12"'
        )
    bits = int(match[2])
    packing = match[3]
    count = width_px * height_px
    if packing == "p":
        values = _from_bit_stream(data, bits, count)
    elif packing == "Packed":
        values = _from_threes(data, bits, count)
    else:
        kind = np.dtype(np.uint8 if bits == 8 else "<u2")
        values = np.frombuffer(data[: len(data) // kind.itemsize * kind.itemsize], kind)
    if len(values) < count:
        raise InputError(
            f"an image of {width_px} x {height_px} pixels in {pixel_format} came with"
            f" {len(data)} bytes"
        )
    return values[:count].astype(np.uint16).reshape(height_px, width_px)


def _from_threes(data: bytes, bits: int, count: int) -> npt.NDArray[np.unsignedinteger]:
    """GigE Vision: the upper 8 bits of two pixels, and the lower ones of both between them."""
    padded = data + bytes(len(data) % 3 == 2)  # the last one of an odd count has two bytes
    triples = (
        np.frombuffer(padded[: len(padded) // 3 * 3], np.uint8).reshape(-1, 3).astype(np.uint16)
    )
    low_bits = bits - 8
    mask = (1 << low_bits) - 1
    pairs = np.empty((len(triples), 2), np.uint16)
    pairs[:, 0] = triples[:, 0] << low_bits | triples[:, 1] & mask
    pairs[:, 1] = triples[:, 2] << low_bits | triples[:, 1] >> 4 & mask
    return pairs.ravel()[:count]


def _from_bit_stream(data: bytes, bits: int, count: int) -> npt.NDArray[np.unsignedinteger]:
    """PFNC: pixels one after another without gaps, lowest bit first."""
    stream = np.unpackbits(np.frombuffer(data, np.uint8), bitorder="little")
    whole = min(len(stream) // bits, count)
    each_bit = stream[: whole * bits].reshape(whole, bits).astype(np.uint16)
    weights = (1 << np.arange(bits)).astype(np.uint16)
    return each_bit @ weights
