"""Frames as files: FITS with a world coordinate system, CSV and PNG.

The world coordinate system is a tangent plane with the lens as SIP polynomials (Shupe et al. 2005):
a pixel at (X, Y) from CRPIX is at CD (X + A(X, Y), Y + B(X, Y)) on the tangent plane, and AP and BP
lead back. Their degree is the smallest that is right to GOOD_PX at pixels that were held out.
"""

import csv
import gzip
import io
import math
import struct
import zlib
from dataclasses import dataclass, replace
from functools import lru_cache
from operator import itemgetter
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, Float32Array, FloatArray, IntArray
from hilstar.basics.files import as_text, whole_file
from hilstar.basics.rotation import to_matrix, to_radec_roll_deg
from hilstar.basics.version import __version__
from hilstar.display.response import Codes
from hilstar.optics.camera import Camera
from hilstar.server.bench.certificate_file import certificate_number
from hilstar.server.bench.frame import Bench, Frame

GOOD_PX = 0.01
MAX_SIP_PX = 0.1  # a polynomial with a larger error is not written
MAX_DEGREE = 9  # the convention's
# places along each side of the image; the latter have its edges among them
FITTED, HELD_OUT = 28, 25

Keywords = dict[str, str | float]
PNG_GREY, PNG_RGB = 0, 2  # colour types
PNG_LEVEL = 1  # 6 takes twelve times as long for a noisy frame and saves 5 %
PREVIEW_RADIUS_PX = 9  # the brightest star's
PREVIEW_BLUR_PX = 0.7
PREVIEW_POWER = 0.35
# Light as bright over a square of this side is a body's or a map's, which is drawn as it is: at its
# size. A star's
# brightest pixels are fewer.
BODY_SIDE_PX = 9
BODY_EDGE_PX = 3  # a round limb goes beyond the squares within it by so much
BODY_SHARE = 1.5  # to this multiple of the square's light


@dataclass(frozen=True, slots=True)
class Sip:
    """SIP of one degree, about `origin_px`: the linear part (2, 2), of pixels to those of an ideal
    image, and all other terms.

    `forward` and `back` (terms, 2) are A, B and AP, BP by `_powers`. `error_px` is their largest
    error over the image.
    """

    degree: int
    origin_px: tuple[float, float]
    linear: FloatArray
    forward: FloatArray
    back: FloatArray
    error_px: float


def world_coordinates(camera: Camera, q_icrs_to_cam: FloatArray) -> Keywords:
    """The FITS keywords of an image: TAN, exact for a pinhole; behind a lens with SIP, or TAN alone
    where no SIP fits.

    `LENSERR` is the largest distance, px, on the image between where they and the camera have a
    star.
    """
    tangent_plane = _tangent_plane(camera, q_icrs_to_cam, camera.principal_point_px, np.eye(2))
    if camera.lens is None:
        return tangent_plane
    sip = fit_sip(camera)
    if sip is None:
        tangent_plane["LENS"] = True
        tangent_plane["LENSERR"] = round(_pinhole_error_px(camera), 4)
        return tangent_plane
    keywords = _tangent_plane(camera, q_icrs_to_cam, sip.origin_px, sip.linear)
    keywords["CTYPE1"] = "RA---TAN-SIP"
    keywords["CTYPE2"] = "DEC--TAN-SIP"
    keywords["LENS"] = True
    keywords["LENSERR"] = round(sip.error_px, 6)
    a, b = sip.forward.T
    ap, bp = sip.back.T
    # A and B have no linear terms: those are in CD.
    for name, coefficients, first in (("A", a, 2), ("B", b, 2), ("AP", ap, 1), ("BP", bp, 1)):
        keywords[f"{name}_ORDER"] = sip.degree
        powers = _powers(sip.degree, first)
        for p, q, coefficient in zip(*powers, coefficients, strict=True):
            keywords[f"{name}_{p}_{q}"] = float(coefficient)
    return keywords


def _pinhole_error_px(camera: Camera) -> float:
    """How far at most a pinhole has stars from where the camera's lens has them, px."""
    x_px, y_px = camera.grid_px(HELD_OUT)
    tangents = camera.tangents(x_px, y_px)
    pinhole = replace(camera, lens=None)
    pinhole_x_px, pinhole_y_px = pinhole.places_px(*tangents)
    error_px = np.hypot(pinhole_x_px - x_px, pinhole_y_px - y_px)
    return float(np.nanmax(error_px))  # NaN where the lens knows no direction


def _tangent_plane(
    camera: Camera, q_icrs_to_cam: FloatArray, origin_px: tuple[float, float], linear: FloatArray
) -> Keywords:
    right, down, normal = camera.cam_to_image @ to_matrix(q_icrs_to_cam)
    ra = np.arctan2(normal[1], normal[0])
    dec = np.arctan2(normal[2], np.hypot(normal[0], normal[1]))
    sin_ra, cos_ra = np.sin(ra), np.cos(ra)
    sin_dec, cos_dec = np.sin(dec), np.cos(dec)
    east = np.array([-sin_ra, cos_ra, 0.0])
    north = np.array([-sin_dec * cos_ra, -sin_dec * sin_ra, cos_dec])
    axes = np.array([[right @ east, down @ east], [right @ north, down @ north]])
    deg_per_px = np.degrees(1.0 / camera.focal_length_px)
    cd = axes @ linear * deg_per_px
    keywords: Keywords = {}
    keywords["CTYPE1"] = "RA---TAN"
    keywords["CTYPE2"] = "DEC--TAN"
    keywords["RADESYS"] = "ICRS"
    keywords["CUNIT1"] = "deg"
    keywords["CUNIT2"] = "deg"
    keywords["LONPOLE"] = 180.0
    keywords["CRVAL1"] = float(np.degrees(ra) % 360)
    keywords["CRVAL2"] = float(np.degrees(dec))
    keywords["CRPIX1"] = origin_px[0] + 1.0  # FITS counts from 1
    keywords["CRPIX2"] = origin_px[1] + 1.0
    keywords["CD1_1"] = float(cd[0, 0])
    keywords["CD1_2"] = float(cd[0, 1])
    keywords["CD2_1"] = float(cd[1, 0])
    keywords["CD2_2"] = float(cd[1, 1])
    return keywords


@lru_cache(maxsize=4)
def fit_sip(camera: Camera) -> Sip | None:
    """The SIP of a camera with a lens, by least squares over its image; None where no degree is
    within MAX_SIP_PX.
    """
    x_px, y_px = camera.places_px(np.zeros(1), np.zeros(1))
    origin_px = float(x_px[0]), float(y_px[0])
    pixel, ideal = _pairs(camera, origin_px, FITTED)
    test_pixel, test_ideal = _pairs(camera, origin_px, HELD_OUT)
    polynomials = []  # from pixels to the ideal image
    for degree in range(2, MAX_DEGREE + 1):
        whole = _solved(pixel, ideal, degree)
        error_px = _largest_px(_terms(test_pixel, degree, 1) @ whole - test_ideal)
        polynomials.append((error_px, degree, whole))
        if error_px <= GOOD_PX:
            break
    # The one that is good, or else the best: a higher degree may fit the held-out pixels worse.
    _, degree, whole = min(polynomials, key=itemgetter(0))
    p, q = _powers(degree, 1)
    by_x = whole[(p == 1) & (q == 0)]
    by_y = whole[(p == 0) & (q == 1)]
    linear = np.concatenate([by_x, by_y]).T
    of_pixels = np.linalg.inv(linear).T  # rows of ideal places to pixels
    forward = whole[p + q >= 2] @ of_pixels
    flat = ideal @ of_pixels
    back = _solved(flat, pixel - flat, degree)
    flat = test_ideal @ of_pixels
    there = test_pixel + _terms(test_pixel, degree, 2) @ forward - flat
    again = flat + _terms(flat, degree, 1) @ back - test_pixel
    error_px = max(_largest_px(there), _largest_px(again))
    if error_px <= MAX_SIP_PX:
        return Sip(degree, origin_px, linear, forward, back, error_px)
    return None


def _largest_px(off_px: FloatArray) -> float:
    """The largest length of offsets (n, 2)."""
    return float(np.hypot(off_px[:, 0], off_px[:, 1]).max())


def _pairs(
    camera: Camera, origin_px: tuple[float, float], count: int
) -> tuple[FloatArray, FloatArray]:
    """Pixels and their places on the ideal image, both (n, 2) px from the origin; those that the
    lens knows.
    """
    x, y = camera.grid_px(count)
    u, v = camera.tangents(x, y)
    is_visible = np.isfinite(u)
    pixel = np.column_stack([x - origin_px[0], y - origin_px[1]])
    tangent = np.column_stack([u, v])[is_visible]
    return pixel[is_visible], camera.focal_length_px * tangent


def _solved(at: FloatArray, wanted: FloatArray, degree: int) -> FloatArray:
    """The coefficients (terms, 2), without a constant, by least squares; scaled, because powers
    of pixels are large.
    """
    terms = _terms(at, degree, 1)
    scale = np.abs(terms).max(axis=0)
    coefficients, *_ = np.linalg.lstsq(terms / scale, wanted, rcond=None)
    return np.asarray(coefficients / scale[:, None])


def _powers(degree: int, first: int) -> tuple[IntArray, IntArray]:
    """The powers p and q of all terms of total degree `first` to `degree`."""
    p, q = np.indices((degree + 1, degree + 1)).reshape(2, -1)
    is_wanted = (p + q >= first) & (p + q <= degree)
    return p[is_wanted], q[is_wanted]


def _terms(at: FloatArray, degree: int, first: int) -> FloatArray:
    """The powers X^p Y^q at places (n, 2): (n, terms)."""
    p, q = _powers(degree, first)
    return np.asarray(at[:, :1] ** p * at[:, 1:] ** q)


def write_frame_fits(path: Path, bench: Bench, frame: Frame) -> None:
    """The linear image (electron/s, float32) with attitude, epoch, bench hash and a world
    coordinate system.

    The first row of the array is the top of the monitor. Light of several channels is a cube, whose
    third axis is CHANNEL.
    """
    from astropy.io import fits

    epoch_jyear = bench.config.sky.epoch_jyear
    header = sky_header(bench.file.sha256, epoch_jyear, frame.q_icrs_to_cam, bench.camera)
    header["BUNIT"] = ("electron/s", "each pixel's share of the tracker's electrons")
    header["WHITE"] = (bench.flux_at_white_e_per_s, "[electron/s] one pixel at the white code")
    header["NSTARS"] = (len(frame.rows), "stars in view")
    header["CALNAME"] = (bench.calibration.name, "monitor calibration")
    header["CALSHA"] = bench.calibration.sha256
    number = certificate_number(bench.file)
    if number:
        header["CERTIF"] = (number, "certificate of the bench")
    image = frame.linear
    if len(frame.light) > 1:
        image = frame.light
        header["CTYPE3"] = "CHANNEL"
        header["CRPIX3"] = 1.0
        header["CRVAL3"] = 1.0
        header["CD3_3"] = 1.0
        for channel, key in enumerate(bench.config.tracker.quantum_efficiencies, 1):
            header[f"CHANNEL{channel}"] = key
    write_fits(path, fits.PrimaryHDU(image, header))


def write_fits(path: Path, hdus: Any) -> None:
    """A FITS file of Astropy's HDU or list of them, packed where the name ends in .gz."""
    with whole_file(path) as file:
        if path.suffix != ".gz":
            hdus.writeto(file)
            return
        data = io.BytesIO()
        hdus.writeto(data)
        file.write(gzip.compress(data.getbuffer()))


def sky_header(
    bench_hash: str, epoch_jyear: float, q_icrs_to_cam: FloatArray, camera: Camera
) -> Any:
    """A FITS header with the attitude, the epoch, the bench's hash and a world coordinate
    system.
    """
    from astropy.io import fits

    header = fits.Header()
    ra_deg, dec_deg, roll_deg = to_radec_roll_deg(q_icrs_to_cam)
    for name, value in zip(("QW", "QX", "QY", "QZ"), q_icrs_to_cam, strict=True):
        header[name] = (float(value), "q_icrs_to_cam, Hamilton, scalar first")
    header["RA_PNT"] = (ra_deg, "[deg] boresight right ascension, ICRS")
    header["DEC_PNT"] = (dec_deg, "[deg] boresight declination, ICRS")
    header["ROLL_PNT"] = (roll_deg, "[deg] camera roll")
    header["EPOCHJYR"] = (epoch_jyear, "[yr] Julian year of the star positions")
    header["BENCHSHA"] = bench_hash  # no room on the card for a comment
    header["CREATOR"] = f"hilstar {__version__}"
    header.update(world_coordinates(camera, q_icrs_to_cam))
    if camera.lens is not None:
        header.comments["LENS"] = "stars are bent by a lens"
        header.comments["LENSERR"] = "[px] the largest distance of a star from CTYPE"
    return header


def write_truth_csv(path: Path, frame: Frame) -> None:
    """One row per star: the columns of TRUTH_DTYPE, brightest first; drawn and clipped are 1 or 0,
    an unknown figure is nan.
    """
    truth = frame.truth
    with whole_file(path) as whole, as_text(whole) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(truth.dtype.names or ())
        for row in truth.tolist():
            values = [int(value) if isinstance(value, bool) else value for value in row]
            writer.writerow(values)


def write_codes_png(path: Path, codes: Codes, bits: int) -> None:
    """The code values: 8 bit, or 16 bit for deeper monitors, left-aligned. Shallower ones stay as
    they are.

    Codes of three channels (height, width, 3) become an RGB picture.
    """
    if bits <= 8:
        image = np.asarray(codes, dtype=np.uint8)
    else:
        image = np.asarray(codes.astype(np.uint16) << (16 - bits), dtype=np.uint16)
    with whole_file(path) as file:
        file.write(png_of(image))


def png_of(image: npt.NDArray[Any], meant_bits: int | None = None) -> bytes:
    """A PNG of values (height, width) or (height, width, 3), uint8 or uint16, of which `meant_bits`
    mean something (sBIT).

    Its rows are not filtered, and are compressed at once: a tracker's frame, which is noise, takes
    a third of the time that `png.Writer` takes row by row.
    """
    import png

    height, width = image.shape[:2]
    values = np.ascontiguousarray(image, f">u{image.itemsize}")  # PNG is big-endian
    rows = values.view(np.uint8).reshape(height, -1)
    scanlines = np.zeros((height, 1 + rows.shape[1]), np.uint8)  # each begins with its filter: none
    scanlines[:, 1:] = rows
    if image.ndim == 2:
        colour_type, channels = PNG_GREY, 1
    else:
        colour_type, channels = PNG_RGB, 3
    header = struct.pack(">IIBBBBB", width, height, 8 * image.itemsize, colour_type, 0, 0, 0)
    chunks = [(b"IHDR", header)]
    if meant_bits is not None:
        chunks.append((b"sBIT", bytes([meant_bits] * channels)))
    chunks.append((b"IDAT", zlib.compress(scanlines.data, PNG_LEVEL)))
    chunks.append((b"IEND", b""))
    file = io.BytesIO()
    png.write_chunks(file, chunks)
    return file.getvalue()


def write_preview_png(path: Path, codes: Codes) -> None:
    """A preview for the eye as a file (see `preview_png`)."""
    preview = preview_png(codes)
    with whole_file(path) as file:
        file.write(preview)


def preview_png(codes: Codes) -> bytes:
    """A preview for the eye: each star a disc that grows with its code, as on a star chart; a body
    has its own size.

    It is stretched to the brightest pixel of the frame.
    """
    from scipy.ndimage import gaussian_filter

    if codes.ndim == 3:
        codes = codes.max(axis=2)
    brightest = max(int(codes.max()), 1)
    signal = codes.astype(np.float32) / np.float32(brightest)
    smooth = gaussian_filter(_discs(signal) ** PREVIEW_POWER, PREVIEW_BLUR_PX)
    grey = 255 * np.clip(smooth, 0, 1)
    return png_of(grey.astype(np.uint8))


def _bodies(signal: Float32Array) -> BoolArray:
    """Which pixels of (height, width) are of light wider than a star's."""
    from scipy.ndimage import grey_opening, maximum_filter

    wide = grey_opening(signal, (BODY_SIDE_PX, BODY_SIDE_PX), mode="constant")
    reached = maximum_filter(wide, 2 * BODY_EDGE_PX + 1)
    return np.asarray((signal > 0) & (signal <= BODY_SHARE * reached))


def _discs(signal: Float32Array) -> Float32Array:
    """Each pixel of (height, width), 0 to 1, as a disc of its value; the brightest of those that
    overlap.

    Only lit pixels are looked at, of which a frame of stars has few.
    """
    edge = PREVIEW_RADIUS_PX
    height, width = signal.shape
    picture = np.zeros_like(signal, shape=(height + 2 * edge, width + 2 * edge))
    body = _bodies(signal)
    picture[edge:-edge, edge:-edge] = np.where(body, signal, 0)
    row, column = np.nonzero(np.where(body, 0, signal))
    value = signal[row, column]
    reach = range(-PREVIEW_RADIUS_PX, PREVIEW_RADIUS_PX + 1)
    for down in reach:
        for right in reach:
            radius = max(1, math.ceil(math.hypot(down, right)))
            if radius > PREVIEW_RADIUS_PX:
                continue
            # The area of a star's disc goes with its value.
            min_value = ((radius - 1) / PREVIEW_RADIUS_PX) ** 2
            is_inside = value >= min_value
            place = row[is_inside] + edge + down, column[is_inside] + edge + right
            np.maximum.at(picture, place, value[is_inside])
    return picture[edge:-edge, edge:-edge]
