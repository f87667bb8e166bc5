"""The virtual tracker's exposures as files: FITS, and pictures."""

from __future__ import annotations

from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hilstar.bench.bench_file import BenchFile
from hilstar.bench.config import BenchConfig
from hilstar.bench.frame_files import sky_header, write_fits
from hilstar.files import written
from hilstar.scene.camera import Camera
from hilstar.twin.picture import exposure_picture
from hilstar.twin.simulator import Exposure, FrameNoise

MAX_CARD = 60  # characters of text on a card of FITS


class Imager(Protocol):
    """What makes exposures: a bench file, and the tracker's camera."""

    file: BenchFile
    config: BenchConfig
    camera: Camera


def write_exposure_fits(path: Path, simulator: Imager, exposure: Exposure, noise: FrameNoise) -> None:
    """The virtual tracker's DN (uint16) and, as second HDU, the truth table; the header says how both were made."""
    from astropy.io import fits

    tracker = simulator.config.tracker
    epoch_jyear, q = simulator.config.sky.epoch_jyear, exposure.motion.q_icrs_to_cam
    header = sky_header(simulator.file.sha256, epoch_jyear, q, simulator.camera)
    header["BUNIT"] = ("adu", "digital numbers (DN)")
    header["EXPTIME"] = (tracker.exposure_s, "[s]")
    for name, rate in zip(("RATEX", "RATEY", "RATEZ"), np.degrees(exposure.motion.rate_cam_rad_s), strict=True):
        header[name] = (float(rate), "[deg/s] of cam in icrs, cam components")
    header["NOISE"] = (noise.kind, "full, or none: the mean signal through the ADC")
    header["SEED"] = (noise.seed, "of the frame's noise")
    header["DEVSEED"] = (tracker.detector.device_seed, "of the device's fixed patterns")
    header["GAIN"] = (tracker.detector.gain_e_per_dn, "[electron/adu]")
    header["OFFSET"] = (tracker.detector.offset_dn, "[adu]")
    header["FULLWELL"] = (tracker.detector.full_well_e, "[electron]")
    header["BITS"] = (tracker.detector.bits, "of the ADC")
    if exposure.faults:
        header["FAULTS"] = ", ".join(exposure.faults)[:MAX_CARD]
    header["NSTARS"] = (len(exposure.truth), "stars in view")
    hdus = fits.HDUList([fits.PrimaryHDU(exposure.dn, header), fits.BinTableHDU(exposure.truth, name="TRUTH")])
    write_fits(path, hdus)


def write_exposure_png(path: Path, dn: npt.NDArray[np.uint16]) -> None:
    """A picture of a tracker's frame for a person (see `twin.picture`)."""
    from PIL import Image

    written(path, lambda file: Image.fromarray(exposure_picture(dn)).save(file, "PNG"))


def write_dn_picture(path: Path, dn: npt.NDArray[np.uint16]) -> None:
    """The DN themselves, unscaled, as 16-bit greyscale: TIFF where the name ends in .tif or .tiff, else PNG."""
    from PIL import Image

    form = "TIFF" if path.suffix.lower() in {".tif", ".tiff"} else "PNG"
    written(path, lambda file: Image.fromarray(dn).save(file, form))
