"""Writes frames as files: FITS with a world coordinate system, CSV and PNG.

The world coordinate system is a tangent plane with the lens as SIP polynomials (Shupe et al. 2005):
a pixel at (X, Y) from CRPIX is at CD (X + A(X, Y), Y + B(X, Y)) on the tangent plane; AP and BP are
the inverse. Their degree is the smallest with an error of at most GOOD_PX at pixels that were not
used in the fit.
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
MAX_DEGREE = 9  # the largest degree that the SIP convention allows
# Grid points along each side of the image for the fit, and for its test.
FITTED, HELD_OUT = 28, 25

Keywords = dict[str, str | float]
PNG_GREY, PNG_RGB = 0, 2  # colour types
PREVIEW_RADIUS_PX = 9  # of the brightest star's disc
PREVIEW_BLUR_PX = 0.7
PREVIEW_POWER = 0.35
# Where a square of this side is lit throughout, the light is a body's or a map's, which is drawn at
# its own size. A star has fewer bright pixels.
BODY_SIDE_PX = 9
BODY_EDGE_PX = 3  # so far a round limb reaches beyond the squares within the body
BODY_SHARE = 1.5  # and so many times the square's light a pixel of the body may have


@dataclass(frozen=True, slots=True)
class Sip:
    """SIP polynomials of one degree about `origin_px`: `linear` (2, 2) turns pixels into those of
    an ideal (pinhole) image, to first order.

    `forward` (terms, 2) are the coefficients of A and B, `back` (terms, 2) those of AP and BP, in
    the order of `_powers`. `error_px` is the largest error of either over the image.
    """

    degree: int
    origin_px: tuple[float, float]
    linear: FloatArray
    forward: FloatArray
    back: FloatArray
    error_px: float


def world_coordinates(camera: Camera, q_icrs_to_cam: FloatArray) -> Keywords:
    """The FITS keywords of an image's world coordinate system: TAN for a pinhole camera, where it
    is exact; TAN-SIP for one with a lens, or TAN alone where no SIP fits.

    `LENSERR` is the largest distance, px, between a star's place by these keywords and by the
    camera.
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
    # A and B have no linear terms, as CD contains them.
    for name, coefficients, first in (("A", a, 2), ("B", b, 2), ("AP", ap, 1), ("BP", bp, 1)):
        keywords[f"{name}_ORDER"] = sip.degree
        powers = _powers(sip.degree, first)
        for p, q, coefficient in zip(*powers, coefficients, strict=True):
            keywords[f"{name}_{p}_{q}"] = float(coefficient)
    return keywords


def _pinhole_error_px(camera: Camera) -> float:
    """The largest distance, px, between a star's place by a pinhole and by the camera's lens."""
    x_px, y_px = camera.grid_px(HELD_OUT)
    tangents = camera.tangents(x_px, y_px)
    pinhole = replace(camera, lens=None)
    pinhole_x_px, pinhole_y_px = pinhole.places_px(*tangents)
    error_px = np.hypot(pinhole_x_px - x_px, pinhole_y_px - y_px)
    return float(np.nanmax(error_px))  # NaN at pixels for which the lens has no direction


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
    """The SIP polynomials of a camera with a lens, by least squares over its image; None where the
    best have an error over MAX_SIP_PX.
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
    # The first within GOOD_PX, or else the best: a higher degree may be worse at pixels that were
    # not fitted.
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
    """The largest length of offsets (n, 2), px."""
    return float(np.hypot(off_px[:, 0], off_px[:, 1]).max())


def _pairs(
    camera: Camera, origin_px: tuple[float, float], count: int
) -> tuple[FloatArray, FloatArray]:
    """A grid of `count` by `count` pixels, without those for which the lens has no direction, and
    their places on the ideal image, both (n, 2), px from the origin.
    """
    x, y = camera.grid_px(count)
    u, v = camera.tangents(x, y)
    is_visible = np.isfinite(u)
    pixel = np.column_stack([x - origin_px[0], y - origin_px[1]])
    tangent = np.column_stack([u, v])[is_visible]
    return pixel[is_visible], camera.focal_length_px * tangent


def _solved(at: FloatArray, wanted: FloatArray, degree: int) -> FloatArray:
    """The coefficients (terms, 2) of polynomials without a constant, by least squares, from places
    `at` (n, 2) and their values `wanted` (n, 2).
    """
    # Powers of pixels are large and unlike: scaled, the problem is well conditioned.
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
    """Write the linear image (electron/s, float32) as FITS, with attitude, epoch, bench hash and a
    world coordinate system.

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
    """Write one of Astropy's HDUs, or a list of them, as a FITS file, compressed where its name
    ends in .gz.
    """
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
    """Write a frame's stars as CSV, one row per star, brightest first, with the columns of
    TRUTH_DTYPE; drawn and clipped are 1 or 0, an unknown figure is nan.
    """
    truth = frame.truth
    with whole_file(path) as whole, as_text(whole) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(truth.dtype.names or ())
        for row in truth.tolist():
            values = [int(value) if isinstance(value, bool) else value for value in row]
            writer.writerow(values)


def write_codes_png(path: Path, codes: Codes, bits: int) -> None:
    """Write code values (height, width) as a PNG: codes of up to 8 bits unchanged in 8 bits, deeper
    ones in 16 bits, left-aligned.

    Codes of three channels (height, width, 3) become an RGB image.
    """
    if bits <= 8:
        image = np.asarray(codes, dtype=np.uint8)
    else:
        image = np.asarray(codes.astype(np.uint16) << (16 - bits), dtype=np.uint16)
    with whole_file(path) as file:
        file.write(png_of(image))


def png_of(image: npt.NDArray[Any], meant_bits: int | None = None) -> bytes:
    """A PNG's bytes, from values (height, width) or (height, width, 3), uint8 or uint16, of which
    `meant_bits` are significant (sBIT; None: not stated).

    Rows are not filtered, and all are compressed in one call. For a tracker's frame, which is
    noise, this takes a third of the time that `png.Writer` takes row by row.
    """
    import png

    height, width = image.shape[:2]
    values = np.ascontiguousarray(image, f">u{image.itemsize}")  # PNG is big-endian
    rows = values.view(np.uint8).reshape(height, -1)
    # a scanline begins with the number of its filter, 0 for none
    scanlines = np.zeros((height, 1 + rows.shape[1]), np.uint8)
    scanlines[:, 1:] = rows
    if image.ndim == 2:
        colour_type, channels = PNG_GREY, 1
    else:
        colour_type, channels = PNG_RGB, 3
    header = struct.pack(">IIBBBBB", width, height, 8 * image.itemsize, colour_type, 0, 0, 0)
    chunks = [(b"IHDR", header)]
    if meant_bits is not None:
        chunks.append((b"sBIT", bytes([meant_bits] * channels)))
    # Noise repeats nothing but by chance: to look for runs of one byte alone takes a third to nine
    # tenths of the time of zlib's quickest level, by the noise, and at most 7 % more bytes.
    deflate = zlib.compressobj(strategy=zlib.Z_RLE)
    chunks.append((b"IDAT", deflate.compress(scanlines.data) + deflate.flush()))
    chunks.append((b"IEND", b""))
    file = io.BytesIO()
    png.write_chunks(file, chunks)
    return file.getvalue()


def write_preview_png(path: Path, codes: Codes) -> None:
    """Write a frame's preview for the eye as a PNG file; see `preview_png`."""
    preview = preview_png(codes)
    with whole_file(path) as file:
        file.write(preview)


def preview_png(codes: Codes) -> bytes:
    """A preview for the eye, as a PNG's bytes: each star is a disc that grows with its code, as on
    a star chart; a body has its own size.

    It is scaled so that the brightest pixel of the frame is white.
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
    """Whether each pixel (height, width) belongs to light that is wider than a star, as a body's
    is.
    """
    from scipy.ndimage import grey_opening, maximum_filter

    wide = grey_opening(signal, (BODY_SIDE_PX, BODY_SIDE_PX), mode="constant")
    reached = maximum_filter(wide, 2 * BODY_EDGE_PX + 1)
    return np.asarray((signal > 0) & (signal <= BODY_SHARE * reached))


def _discs(signal: Float32Array) -> Float32Array:
    """An image (height, width) in which each pixel of `signal`, 0 to 1, is a disc of its value, and
    pixels of bodies are unchanged; where discs overlap, the brightest counts.

    Only lit pixels are drawn, of which a frame of stars has few.
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
            # The area of a star's disc is in proportion to its value.
            min_value = ((radius - 1) / PREVIEW_RADIUS_PX) ** 2
            is_inside = value >= min_value
            place = row[is_inside] + edge + down, column[is_inside] + edge + right
            np.maximum.at(picture, place, value[is_inside])
    return picture[edge:-edge, edge:-edge]
