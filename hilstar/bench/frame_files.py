"""Frames as files: FITS, CSV and PNG."""

from __future__ import annotations

import csv
import gzip
import io
import math
from pathlib import Path
from typing import IO, Any

import numpy as np
import numpy.typing as npt

from hilstar import __version__
from hilstar.arrays import Float32Array, FloatArray
from hilstar.bench.frame import Bench, Frame
from hilstar.bench.world_coordinates import world_coordinates
from hilstar.files import as_text, whole_file, written
from hilstar.monitor.response import Codes
from hilstar.rotation import to_radec_roll_deg
from hilstar.scene.camera import Camera

PREVIEW_RADIUS_PX = 9  # of the brightest star
PREVIEW_BLUR_PX = 0.7
PREVIEW_POWER = 0.35


def write_frame_fits(path: Path, bench: Bench, frame: Frame) -> None:
    """The linear image (electron/s, float32) with attitude, epoch, bench hash and a world coordinate system.

    The first row of the array is the top of the monitor.
    """
    from astropy.io import fits

    header = sky_header(bench.file.sha256, bench.config.sky.epoch_jyear, frame.q_icrs_to_cam, bench.camera)
    header["BUNIT"] = ("electron/s", "each pixel's share of the tracker's electrons")
    header["WHITE"] = (bench.flux_at_white_e_per_s, "[electron/s] one pixel at the white code")
    header["NSTARS"] = (len(frame.truth), "stars in view")
    header["CALNAME"] = (bench.calibration.name, "monitor calibration")
    header["CALSHA"] = bench.calibration.sha256
    write_fits(path, fits.PrimaryHDU(frame.linear, header))


def write_fits(path: Path, hdus: Any) -> None:
    """A FITS file of Astropy's HDU or list of them, packed where the name ends in .gz."""
    with whole_file(path) as file:
        if path.suffix != ".gz":
            hdus.writeto(file)
            return
        data = io.BytesIO()
        hdus.writeto(data)
        file.write(gzip.compress(data.getbuffer()))


def sky_header(bench_hash: str, epoch_jyear: float, q_icrs_to_cam: FloatArray, camera: Camera) -> Any:
    """A FITS header with the attitude, the epoch, the bench's hash and a world coordinate system."""
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
    """One row per star: the columns of TRUTH_DTYPE, brightest first; drawn and clipped are 1 or 0, an unknown figure is nan."""
    with whole_file(path) as whole, as_text(whole) as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(frame.truth.dtype.names or ())
        for row in frame.truth.tolist():
            writer.writerow([int(v) if isinstance(v, bool) else v for v in row])


def write_codes_png(path: Path, codes: Codes, bits: int) -> None:
    """The code values: 8 bit, or 16 bit for deeper monitors, left-aligned. Shallower ones stay as they are.

    Codes of three channels (height, width, 3) become an RGB picture.
    """
    image = (
        np.asarray(codes, dtype=np.uint8) if bits <= 8 else np.asarray(codes.astype(np.uint16) << (16 - bits), dtype=np.uint16)
    )
    written(path, lambda file: _save_png(file, image))


def _save_png(file: IO[bytes], image: npt.NDArray[Any]) -> None:
    if image.ndim == 2 or image.dtype == np.uint8:
        from PIL import Image

        Image.fromarray(image).save(file, "PNG", compress_level=1)
        return
    # Pillow has no RGB of 16 bits.
    import png

    height, width, _ = image.shape
    png.Writer(width, height, bitdepth=16, greyscale=False, compression=1).write(file, image.reshape(height, -1))


def write_preview_png(path: Path, codes: Codes) -> None:
    """A preview for the eye: each star a disc that grows with its code, as on a star chart.

    It is stretched to the brightest pixel of the frame.
    """
    from PIL import Image
    from scipy.ndimage import gaussian_filter

    signal = codes.astype(np.float32) / np.float32(max(int(codes.max()), 1))
    smooth = gaussian_filter(_discs(signal) ** PREVIEW_POWER, PREVIEW_BLUR_PX)
    written(path, lambda file: Image.fromarray((255 * np.clip(smooth, 0, 1)).astype(np.uint8)).save(file, "PNG"))


def _discs(signal: Float32Array) -> Float32Array:
    """Each pixel of (height, width), 0 to 1, as a disc of its value; the brightest of those that overlap.

    Only lit pixels are looked at, of which a frame of stars has few.
    """
    edge, reach = PREVIEW_RADIUS_PX, range(-PREVIEW_RADIUS_PX, PREVIEW_RADIUS_PX + 1)
    picture = np.zeros_like(signal, shape=(signal.shape[0] + 2 * edge, signal.shape[1] + 2 * edge))
    row, column = np.nonzero(signal)
    value = signal[row, column]
    for down in reach:
        for right in reach:
            radius = max(1, math.ceil(math.hypot(down, right)))
            if radius <= PREVIEW_RADIUS_PX:
                seen = value >= ((radius - 1) / PREVIEW_RADIUS_PX) ** 2
                np.maximum.at(picture, (row[seen] + edge + down, column[seen] + edge + right), value[seen])
    return picture[edge:-edge, edge:-edge]
