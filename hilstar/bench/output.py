"""Frames as files: FITS, CSV and PNG."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from PIL import Image

from hilstar.arrays import FloatArray
from hilstar.attitude.quaternion import to_matrix, to_radec_roll_deg
from hilstar.bench.assembly import Bench, Frame
from hilstar.bench.picture import exposure_picture
from hilstar.bench.simulation import Exposure, Simulator
from hilstar.errors import InputError
from hilstar.files import whole_file
from hilstar.monitor.photometry import Codes
from hilstar.scene.camera import Camera

PREVIEW_RADIUS_PX = 9  # of the brightest star
PREVIEW_BLUR_PX = 0.7
PREVIEW_POWER = 0.35


def write_frame_fits(path: Path, bench: Bench, frame: Frame) -> None:
    """The linear image (electron/s, float32) with attitude, epoch, bench hash and a TAN world coordinate system.

    The first row of the array is the top of the monitor.
    """
    from astropy.io import fits

    header = _header(bench.bench_hash, bench.config.sky.epoch_jyear, frame.q_icrs_to_cam, bench.camera)
    header["BUNIT"] = ("electron/s", "each pixel's share of the tracker's electrons")
    header["WHITE"] = (bench.flux_at_white_e_per_s, "[electron/s] one pixel at the white code")
    header["NSTARS"] = (len(frame.truth), "stars in view")
    header["CALNAME"] = (bench.calibration.name, "monitor calibration")
    header["CALSHA"] = bench.calibration.sha256
    _written(path, lambda part: fits.PrimaryHDU(frame.linear, header).writeto(part, overwrite=True))


def write_exposure_fits(path: Path, simulator: Simulator, exposure: Exposure, noise: str, seed: int) -> None:
    """The virtual tracker's DN (uint16) and, as second HDU, the truth table; the header says how both came about."""
    from astropy.io import fits

    tracker = simulator.config.tracker
    header = _header(simulator.bench_hash, simulator.config.sky.epoch_jyear, exposure.motion.q_icrs_to_cam, simulator.camera)
    header["BUNIT"] = ("adu", "digital numbers (DN)")
    header["EXPTIME"] = (tracker.exposure_s, "[s]")
    for name, rate in zip(("RATEX", "RATEY", "RATEZ"), np.degrees(exposure.motion.rate_cam_rad_s), strict=True):
        header[name] = (float(rate), "[deg/s] of cam in icrs, cam components")
    header["NOISE"] = (noise, "full, or none: the mean signal through the ADC")
    header["SEED"] = (seed, "of the frame's noise")
    header["DEVSEED"] = (tracker.detector.device_seed, "of the device's fixed patterns")
    header["GAIN"] = (tracker.detector.gain_e_per_dn, "[electron/adu]")
    header["OFFSET"] = (tracker.detector.offset_dn, "[adu]")
    header["FULLWELL"] = (tracker.detector.full_well_e, "[electron]")
    header["BITS"] = (tracker.detector.bits, "of the ADC")
    header["NSTARS"] = (len(exposure.truth), "stars in view")
    hdus = fits.HDUList([fits.PrimaryHDU(exposure.dn, header), fits.BinTableHDU(exposure.truth, name="TRUTH")])
    _written(path, lambda part: hdus.writeto(part, overwrite=True))


def _header(bench_hash: str, epoch_jyear: float, q_icrs_to_cam: FloatArray, camera: Camera) -> Any:
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
    header["CREATOR"] = "hilstar"
    header.update(world_coordinates(camera, q_icrs_to_cam))
    return header


def world_coordinates(camera: Camera, q_icrs_to_cam: FloatArray) -> dict[str, str | float]:
    """FITS TAN keywords of an image: exact, for it is a tangent plane."""
    right, down, normal = camera.cam_to_image @ to_matrix(q_icrs_to_cam)
    ra, dec = np.arctan2(normal[1], normal[0]), np.arctan2(normal[2], np.hypot(normal[0], normal[1]))
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    north = np.array([-np.sin(dec) * np.cos(ra), -np.sin(dec) * np.sin(ra), np.cos(dec)])
    deg_per_px = np.degrees(1.0 / camera.focal_length_px)
    return {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "RADESYS": "ICRS",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "LONPOLE": 180.0,
        "CRVAL1": float(np.degrees(ra) % 360),
        "CRVAL2": float(np.degrees(dec)),
        "CRPIX1": camera.principal_point_px[0] + 1.0,
        "CRPIX2": camera.principal_point_px[1] + 1.0,
        "CD1_1": float(right @ east * deg_per_px),
        "CD1_2": float(down @ east * deg_per_px),
        "CD2_1": float(right @ north * deg_per_px),
        "CD2_2": float(down @ north * deg_per_px),
    }


def write_truth_csv(path: Path, frame: Frame) -> None:
    """One row per star: the columns of TRUTH_DTYPE, brightest first; drawn and clipped are 1 or 0."""

    def write(part: Path) -> None:
        with part.open("w", encoding="ascii", newline="") as file:
            writer = csv.writer(file, lineterminator="\n")
            writer.writerow(frame.truth.dtype.names or ())
            for row in frame.truth.tolist():
                writer.writerow([int(v) if isinstance(v, bool) else repr(v) for v in row])

    _written(path, write)


def write_codes_png(path: Path, codes: Codes, bits: int) -> None:
    """The code values: 8 bit, or 16 bit for deeper monitors, left-aligned. Shallower ones stay as they are.

    Codes of three channels (height, width, 3) become an RGB picture.
    """
    image = (
        np.asarray(codes, dtype=np.uint8) if bits <= 8 else np.asarray(codes.astype(np.uint16) << (16 - bits), dtype=np.uint16)
    )
    _written(path, lambda part: _save_png(part, image))


def _save_png(path: Path, image: npt.NDArray[Any]) -> None:
    if image.ndim == 2 or image.dtype == np.uint8:
        Image.fromarray(image).save(path, "PNG", compress_level=1)
        return
    # Pillow has no RGB of 16 bits.
    import png

    height, width, _ = image.shape
    with path.open("wb") as file:
        png.Writer(width, height, bitdepth=16, greyscale=False, compression=1).write(file, image.reshape(height, -1))


def write_preview_png(path: Path, codes: Codes) -> None:
    """A picture for a person: each star a disc that grows with its code, as star charts have it.

    It is stretched to the brightest pixel of its own frame.
    """
    from scipy.ndimage import gaussian_filter, maximum_filter

    signal = codes.astype(np.float32) / max(int(codes.max()), 1)
    picture = np.zeros_like(signal)
    reach = np.arange(-PREVIEW_RADIUS_PX, PREVIEW_RADIUS_PX + 1)
    for radius in range(1, PREVIEW_RADIUS_PX + 1):
        bright = np.where(signal >= ((radius - 1) / PREVIEW_RADIUS_PX) ** 2, signal, 0)
        disc = np.hypot(*np.meshgrid(reach, reach)) <= radius
        picture = np.maximum(picture, maximum_filter(bright, footprint=disc))
    smooth = gaussian_filter(picture**PREVIEW_POWER, PREVIEW_BLUR_PX)
    _written(path, lambda part: Image.fromarray((255 * np.clip(smooth, 0, 1)).astype(np.uint8)).save(part, "PNG"))


def write_exposure_png(path: Path, dn: npt.NDArray[np.uint16]) -> None:
    """A picture of a tracker's frame for a person (see `bench.picture`)."""
    _written(path, lambda part: Image.fromarray(exposure_picture(dn)).save(part, "PNG"))


def write_dn_picture(path: Path, dn: npt.NDArray[np.uint16]) -> None:
    """The DN themselves, unscaled, as greyscale of 16 bits: TIFF where the name ends in .tif or .tiff, else PNG."""
    form = "TIFF" if path.suffix.lower() in {".tif", ".tiff"} else "PNG"
    _written(path, lambda part: Image.fromarray(dn).save(part, form))


def make_directory(path: Path) -> Path:
    """`path`, made if it is not there. Raises InputError where it cannot be made or written."""
    try:
        path.mkdir(parents=True, exist_ok=True)
    except (OSError, ValueError) as error:
        raise InputError(
            f"{path}: cannot be written ({getattr(error, 'strerror', None) or error}); choose another place"
        ) from error
    return path


def _written(path: Path, write: Callable[[Path], object]) -> None:
    """Whole or not at all; an older file stays until the new one is there."""
    with whole_file(path) as part:
        write(part)
