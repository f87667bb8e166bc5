"""Pictures and FITS images that a user gives: opened by one function each, and measured before
anything is decoded.

A picture of 170 kB may unpack to gigabytes, and Pillow knows formats that other programs decode
(EPS is given to Ghostscript, whatever its name ends with). So a picture is opened in FORMATS alone,
and its size is compared first.
"""

import gzip
import io
import math
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.errors import size_text

if TYPE_CHECKING:
    from astropy.io import fits
    from PIL import Image

# several pictures in one JPEG (MPO) are opened as JPEG
FORMATS = ("PNG", "TIFF", "JPEG", "WEBP", "BMP", "PPM")
MAX_PIXELS = 1 << 26  # where no size is known: 8192 x 8192, half a GB as float64
MAX_UNPACKED_BYTES = 8 * MAX_PIXELS
FITS_MAGIC, GZIP_MAGIC = b"SIMPLE", b"\x1f\x8b"
NPY_HEADERS = {
    (1, 0): np.lib.format.read_array_header_1_0,
    (2, 0): np.lib.format.read_array_header_2_0,
}


class ImageSizeError(Exception):
    """An image that is not decoded, because of its size or of what it is; the message says
    which.
    """


def _check_size(size_px: tuple[int, int], wanted_px: tuple[int, int] | None) -> None:
    if wanted_px is not None and size_px != tuple(wanted_px):
        size, wanted = (f"{width} x {height} px" for width, height in (size_px, wanted_px))
        key = f"resolution_px = [{size_px[0]}, {size_px[1]}]"
        raise ImageSizeError(
            f"is {size}, and [tracker] resolution_px is {wanted}; give whole images, or write {key}"
        )
    if wanted_px is None and math.prod(size_px) > MAX_PIXELS:
        raise ImageSizeError(
            f"is {size_px[0]} x {size_px[1]} px, and at most {MAX_PIXELS} pixels are decoded"
        )


@contextmanager
def opened_picture(
    data: bytes, size_px: tuple[int, int] | None = None, formats: Sequence[str] = FORMATS
) -> Iterator["Image.Image"]:
    """A picture, not decoded yet, of this (width, height) if any is wanted. Raises
    ImageSizeError, also for several of one size in a file, and whatever Pillow does.
    """
    from PIL import Image

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Pillow's about large ones, which are refused here
        try:
            opened = Image.open(io.BytesIO(data), formats=tuple(formats))
        except Image.DecompressionBombError as error:
            raise ImageSizeError("has more pixels than any image that is decoded") from error
        with opened as picture:
            _check_size(picture.size, size_px)
            _check_single(picture)
            yield picture


def _check_single(picture: "Image.Image") -> None:
    """Refuse a stack of exposures, of which only the first would be taken; a smaller second image
    is a preview.
    """
    count = getattr(picture, "n_frames", 1)
    if count == 1:
        return
    size_px = picture.size
    picture.seek(1)
    if picture.size == size_px:
        raise ImageSizeError(f"holds {count} images of one size; write one image a file")
    picture.seek(0)


def unpacked(data: bytes, limit_bytes: int = MAX_UNPACKED_BYTES) -> bytes:
    """A file's bytes, without gzip around them. Raises ImageSizeError for more than
    `limit_bytes`, or a damaged file.
    """
    if not data.startswith(GZIP_MAGIC):
        return data
    try:
        with gzip.open(io.BytesIO(data)) as file:
            plain = file.read(limit_bytes + 1)
    except (OSError, EOFError, zlib.error) as error:
        raise ImageSizeError("is a damaged gzip file") from error
    if len(plain) > limit_bytes:
        raise ImageSizeError(f"unpacks to more than {size_text(limit_bytes)}")
    return plain


def is_fits(data: bytes) -> bool:
    """Whether a file's bytes are FITS, packed by gzip or not."""
    if not data.startswith(GZIP_MAGIC):
        return data.startswith(FITS_MAGIC)
    try:
        with gzip.open(io.BytesIO(data)) as file:
            return file.read(len(FITS_MAGIC)) == FITS_MAGIC
    except (OSError, EOFError, zlib.error):
        return False


@contextmanager
def opened_fits(data: bytes, size_px: tuple[int, int] | None = None) -> Iterator["fits.HDUList"]:
    """A FITS file, whose images are not decoded yet; the first has this (width, height) if any is
    wanted.

    It may be packed by gzip. Raises ImageSizeError, also for a file of another compression, and
    whatever astropy does.
    """
    from astropy.io import fits

    data = unpacked(data)
    if not data.startswith(FITS_MAGIC):
        raise ImageSizeError(
            "is not a FITS image: it does not begin as FITS does; unpack it first, if it is a"
            " compressed one"
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # astropy's about a cut file or keywords of older standards
        with fits.open(io.BytesIO(data), memmap=False) as hdus:
            wanted_px = size_px
            for hdu in hdus:
                shape = _image_shape(hdu)
                unpacked_bytes = math.prod(shape) * abs(int(hdu.header.get("BITPIX", 8))) // 8
                if unpacked_bytes > max(len(data), MAX_UNPACKED_BYTES):
                    raise ImageSizeError(
                        f"unpacks to {unpacked_bytes / 1e9:.3g} GB, and at most 0.5 GB are unpacked"
                    )
                if shape and wanted_px is not None and len(shape) == 2:
                    _check_size((shape[0], shape[1]), wanted_px)
                    wanted_px = None
            yield hdus


def _image_shape(hdu: Any) -> tuple[int, ...]:
    """The axes of an image, the fastest first; () for what is none."""
    if not hdu.is_image:
        return ()
    return tuple(int(hdu.header[f"NAXIS{k + 1}"]) for k in range(int(hdu.header.get("NAXIS", 0))))


def npy_array(data: bytes) -> npt.NDArray[Any]:
    """The array of a .npy file. Raises ValueError for one whose header promises more than there
    is, or that holds objects.
    """
    file = io.BytesIO(data)
    version = np.lib.format.read_magic(file)
    if version not in NPY_HEADERS:
        raise ValueError(f"version {version} of npy")
    shape, _, dtype = NPY_HEADERS[version](file)
    if math.prod(shape) * dtype.itemsize > len(data):
        raise ValueError(f"{shape} values of {dtype} in {len(data)} bytes")
    return np.asarray(np.load(io.BytesIO(data), allow_pickle=False))
