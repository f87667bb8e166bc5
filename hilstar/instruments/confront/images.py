"""Photographs as they were taken: FITS, TIFF, PNG and JPEG, mono or a raw Bayer mosaic by
planes, with their time if known.
"""

import math
import re
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError, one_line, shortened
from hilstar.basics.fits_headers import read_fits_image, utc_ns
from hilstar.basics.image_files import ImageSizeError, is_fits, opened_picture
from hilstar.basics.reading import read_bytes
from hilstar.basics.units import NS_PER_S

ADVICE = "give a raw frame as FITS, TIFF or PNG, 8 to 16 bits of grey"
MAX_BYTES = 500_000_000
MAP_KEYS = {"CENTAZ", "CENTEL"}  # in DASC's maps of azimuth and elevation
EXIF_IFD, EXIF_DATE, EXIF_OFFSET, EXIF_EXPOSURE = 0x8769, 0x9003, 0x9011, 0x829A
NAMED_TIME = re.compile(r"(\d{4}-\d\d-\d\d)[T_ ](\d\d)[-:_]?(\d\d)[-:_]?(\d\d)")
MIN_SIDE_PX = 64
# an RGB picture's brightest pixels, and how far channels of a grey one may differ there
BRIGHT_SHARE, GREY_SPREAD = 1e-3, 0.05
SATURATED_PIXELS = 3  # so many at the largest value, and none near below it, is a clipped level
MAX_SATURATED_SHARE = 0.05


@dataclass(frozen=True, slots=True)
class Photograph:
    """An image (height, width) in DN of its file, and what its file says of it.

    Levels are multiples of `step_dn`, and `full_dn` is the level of saturation. `t_ns` is the UTC
    of the middle of the exposure since 1970. `plane` names a colour of a mosaic.
    """

    path: Path
    dn: FloatArray
    step_dn: float
    full_dn: float
    t_ns: int | None = None
    exposure_s: float | None = None
    plane: str = ""
    notes: tuple[str, ...] = ()

    @property
    def name(self) -> str:
        """The file's name, and the plane."""
        if self.plane:
            return f"{self.path.name}[{self.plane}]"
        return self.path.name

    @property
    def size_px(self) -> tuple[int, int]:
        """Width and height."""
        return self.dn.shape[1], self.dn.shape[0]


def paged(array: FloatArray) -> FloatArray:
    """The array in a file without a name, of which the system keeps in memory what is used."""
    with TemporaryFile() as file:
        array.tofile(file)
        file.flush()
        return np.memmap(file, dtype=array.dtype, mode="r", shape=array.shape)


def read_photographs(
    path: Path, resolution_px: tuple[int, int] | None, at_ns: int | None = None
) -> list[Photograph]:
    """The image of a file, or the planes of a mosaic, of this (width, height). Raises
    InputError: what and what to do.
    """
    data = read_bytes(path, ADVICE, MAX_BYTES)
    if is_fits(data):
        pixels, facts = _fits(path, data, resolution_px)
    else:
        pixels, facts = _picture(path, data, resolution_px)
    dn = _grey(path, pixels, facts)
    height, width = dn.shape
    if min(width, height) < MIN_SIDE_PX:
        raise InputError(
            f"{path}: {width} x {height} px is too small to hold a field of stars; give a whole"
            " frame"
        )
    if resolution_px is not None and (width, height) != resolution_px:
        raise InputError(
            f"{path}: is {width} x {height} px, and [tracker] resolution_px is"
            f" {list(resolution_px)}; give whole frames as they were taken, or write resolution_px"
            f" = [{width}, {height}]"
        )
    step, full = _levels(path, dn)
    t_ns = at_ns
    if t_ns is None:
        t_ns = facts.t_ns
    notes = facts.notes
    if t_ns is None:
        t_ns = _named_ns(path)
        if t_ns is not None:
            notes = (*notes, "its time is read from its name, as UTC")
    photograph = Photograph(path, dn, step, full, t_ns, facts.exposure_s, "", notes)
    if facts.bayer:
        return list(_planes(photograph, facts.bayer))
    return [photograph]


def _named_ns(path: Path) -> int | None:
    """The UTC in a file's name; None without one."""
    match = NAMED_TIME.search(path.name)
    if match is None:
        return None
    date, hours, minutes, seconds = match.groups()
    return utc_ns(f"{date}T{hours}:{minutes}:{seconds}")


@dataclass(frozen=True, slots=True)
class _Facts:
    """What an image's file says of it."""

    t_ns: int | None = None
    exposure_s: float | None = None
    bayer: str = ""
    notes: tuple[str, ...] = ()


def _grey(path: Path, pixels: npt.NDArray[Any], facts: _Facts) -> FloatArray:
    """The one plane of an image. Raises InputError where there are several that differ."""
    if pixels.ndim == 3 and pixels.shape[2] in {2, 4}:
        pixels = pixels[..., :-1]  # without opacity
    if pixels.ndim == 3 and pixels.shape[2] == 3:
        mean = pixels.mean(axis=2)
        bright = mean >= np.quantile(mean, 1 - BRIGHT_SHARE)
        spread = np.ptp(pixels.astype(np.float64), axis=2)[bright]
        if np.median(spread) > GREY_SPREAD * np.median(mean[bright]):
            raise InputError(
                f"{path}: has three colours for each pixel, which a camera interpolated; give the"
                " raw frame, or one channel of it as a grey image"
            )
        pixels = mean
    if pixels.ndim == 3 and 1 in {pixels.shape[0], pixels.shape[2]}:
        pixels = pixels.squeeze()
    if pixels.ndim != 2 or pixels.dtype.kind not in "uif":
        raise InputError(
            f"{path}: is no grey image of one plane ({' x '.join(map(str, pixels.shape))});"
            f" {ADVICE}"
        )
    dn = pixels.astype(np.float64)
    is_finite = np.isfinite(dn)
    if not is_finite.all():
        raise InputError(
            f"{path}: {int((~is_finite).sum())} pixels are no finite numbers; {ADVICE}"
        )
    return dn


def _levels(path: Path, dn: FloatArray) -> tuple[float, float]:
    """The step between levels, and where they end. Raises InputError for an image without any
    structure, or full of light.
    """
    values = np.unique(dn)
    top = float(values[-1])
    at_top = dn >= top
    share = float(at_top.mean())
    if share > MAX_SATURATED_SHARE and top > 0:
        raise InputError(
            f"{path}: {share:.0%} of its pixels are saturated at {top:g}; expose shorter, or at a"
            " darker sky"
        )
    if len(values) < 3:
        raise InputError(
            f"{path}: every pixel is {' or '.join(f'{v:g}' for v in values)}; give a frame with"
            " stars"
        )
    # a saturated level may be one less than a multiple of the step, as 65535 is
    inner = values[:-1]
    step = float(np.diff(inner).min())
    bits = math.ceil(math.log2(max(top, 1) + 1))
    ceiling = float(2**bits - 1)
    is_clipped = int(at_top.sum()) >= SATURATED_PIXELS or top >= ceiling - step
    if is_clipped:
        return step, top
    return step, ceiling


def _planes(mosaic: Photograph, pattern: str) -> Iterator[Photograph]:
    """The planes of a mosaic, of half its size: r, g1, g2 and b by a pattern of rows such as
    RGGB.
    """
    greens = 0
    for number, colour in enumerate(pattern.lower()):
        name = colour
        if colour == "g":
            greens += 1
            name = f"g{greens}"
        row, column = divmod(number, 2)
        plane_dn = mosaic.dn[row::2, column::2].copy()
        yield replace(mosaic, dn=plane_dn, plane=name)


def _fits(
    path: Path, data: bytes, resolution_px: tuple[int, int] | None
) -> tuple[npt.NDArray[Any], _Facts]:
    """The pixels of a FITS image, and what its header says. Raises InputError."""
    try:
        fits_image = read_fits_image(data, resolution_px)
    except (InputError, ImageSizeError) as error:
        raise InputError(f"{path}: {error}") from error
    except Exception as error:  # whatever a damaged file makes astropy raise
        raise InputError(
            f"{path}: cannot be read as FITS ({one_line(str(error))}); {ADVICE}"
        ) from error
    if set(fits_image.header) >= MAP_KEYS:
        raise InputError(
            f"{path}: has the direction of each pixel of an all-sky camera"
            f" ({', '.join(sorted(MAP_KEYS))}), and is no photograph; leave it out"
        )
    # An exposure of 0 s is that of a bias, or was never filled in.
    exposure_s = fits_image.exposure_s or None
    facts = _Facts(fits_image.t_ns, exposure_s, fits_image.bayer, fits_image.notes)
    return fits_image.pixels, facts


def _picture(
    path: Path, data: bytes, resolution_px: tuple[int, int] | None
) -> tuple[npt.NDArray[Any], _Facts]:
    """The pixels of a picture, and what its EXIF says. Raises InputError."""
    from PIL import UnidentifiedImageError

    try:
        with opened_picture(data, resolution_px) as picture:
            notes: tuple[str, ...] = ()
            if picture.format in {"JPEG", "MPO", "WEBP"}:
                notes = (
                    (
                        "a JPEG: its tone curve is not known, and compression moves faint stars; a"
                        " raw frame is better"
                    ),
                )
            if picture.mode in {"P", "1", "CMYK"}:
                raise InputError(
                    f"{path}: holds colours of a palette or of print ({picture.mode}); {ADVICE}"
                )
            begin_ns, exposure_s = _exif(picture.getexif())
            t_ns = None
            if begin_ns is not None:
                # the middle of the exposure
                t_ns = begin_ns + round((exposure_s or 0.0) / 2 * NS_PER_S)
            return np.asarray(picture), _Facts(t_ns, exposure_s, "", notes)
    except InputError:
        raise
    except ImageSizeError as error:
        raise InputError(f"{path}: {error}") from error
    except UnidentifiedImageError as error:
        raise InputError(f"{path}: is no image; {ADVICE}") from error
    except Exception as error:  # whatever a damaged file makes Pillow raise
        raise InputError(
            f"{path}: cannot be read as an image ({one_line(str(error))}); {ADVICE}"
        ) from error


def _exif(exif: Any) -> tuple[int | None, float | None]:
    """UTC of the start, where EXIF has the offset from it, and the exposure."""
    exif_table = exif.get_ifd(EXIF_IFD) if exif else {}
    exposure_s = None
    if exif_table.get(EXIF_EXPOSURE):
        exposure_s = float(exif_table[EXIF_EXPOSURE])
    date = str(exif_table.get(EXIF_DATE, ""))
    offset = str(exif_table.get(EXIF_OFFSET, ""))
    match = re.fullmatch(r"([+-])(\d\d):(\d\d)", offset)
    if match is None:
        return None, exposure_s
    # EXIF writes colons in the date, too
    day = date[:10].replace(":", "-")
    begin_ns = utc_ns(f"{day}T{date[11:19]}")
    if begin_ns is None:
        return None, exposure_s
    sign, hours, minutes = match.groups()
    ahead_s = (int(hours) * 60 + int(minutes)) * 60
    if sign == "-":
        ahead_s = -ahead_s
    return begin_ns - ahead_s * NS_PER_S, exposure_s


def parse_utc(text: str) -> int:
    """The UTC of `--taken`. Raises InputError."""
    t_ns = utc_ns(text)
    if t_ns is None:
        raise InputError(
            f"--taken {shortened(text)}: is no UTC; write one such as --taken 2019-07-29T20:47:26"
        )
    return t_ns
