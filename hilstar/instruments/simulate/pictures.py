"""Exposures of the virtual tracker as files (FITS, 16-bit greyscale, PNG for people), and as
pictures for a simulation.
"""

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.basics.files import written
from hilstar.instruments.simulate.eye_picture import exposure_picture
from hilstar.instruments.simulate.simulator import (
    Exposure,
    ExposurePiece,
    FaultyExposure,
    FrameNoise,
    Simulator,
    full_e,
    simulator_view,
)
from hilstar.optics.camera import Camera
from hilstar.optics.layers.fault_kinds import Drop, Freeze, Now
from hilstar.optics.layers.view import STILL, View
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.config import BenchConfig
from hilstar.server.bench.frame import Bench
from hilstar.server.bench.frame_files import png_of, sky_header, write_fits
from hilstar.server.bench.scenario import NO_SCENARIO, Scenario
from hilstar.sky.stars import Stars
from hilstar.tracker.settings import DetectorSettings

MAX_CARD = 60  # characters of text on a card of FITS
READOUT_SIGMAS = 4.0  # by so much the readout takes a full pixel below the level of full ones


class Imager(Protocol):
    """A maker of exposures, as the header of a FITS file needs it."""

    file: BenchFile
    config: BenchConfig
    camera: Camera
    stars: Stars


def write_exposure_fits(
    path: Path, simulator: Imager, exposure: Exposure, noise: FrameNoise
) -> None:
    """The virtual tracker's DN (uint16) and, as second HDU, the truth table; the header says how
    both were made.
    """
    from astropy.io import fits

    tracker = simulator.config.tracker
    epoch_jyear = simulator.config.sky.epoch_jyear
    q = exposure.view.q_icrs_to_cam
    header = sky_header(simulator.file.sha256, epoch_jyear, q, simulator.camera)
    header["BUNIT"] = ("adu", "digital numbers (DN)")
    header["EXPTIME"] = (tracker.exposure_s, "[s]")
    for name, rate in zip(
        ("RATEX", "RATEY", "RATEZ"), np.degrees(exposure.view.turn.rate_cam_rad_s), strict=True
    ):
        header[name] = (float(rate), "[deg/s] of cam in icrs, cam components")
    header["NOISE"] = (noise.kind, "full, or none: the mean signal through the ADC")
    header["SEED"] = (noise.seed, "of the frame's noise")
    header["DEVSEED"] = (tracker.detector.device_seed, "of the device's fixed patterns")
    header["GAIN"] = (tracker.detector.gain_e_per_dn, "[electron/adu]")
    header["OFFSET"] = (tracker.detector.offset_dn, "[adu]")
    header["FULLWELL"] = (tracker.detector.full_well_e, "[electron]")
    header["BITS"] = (tracker.detector.bits, "of the ADC")
    if tracker.detector.bayer is not None:
        header["BAYERPAT"] = (
            tracker.detector.bayer.upper(),
            "colours, from the first pixel of the file",
        )
        header["XBAYROFF"] = header["YBAYROFF"] = 0
        header["ROWORDER"] = ("TOP-DOWN", "the first row of the file is the top")
    if exposure.faults:
        header["FAULTS"] = ", ".join(exposure.faults)[:MAX_CARD]
    header["NSTARS"] = (len(exposure.truth), "stars in view")
    hdus = fits.HDUList(
        [fits.PrimaryHDU(exposure.dn, header), fits.BinTableHDU(exposure.truth, name="TRUTH")]
    )
    write_fits(path, hdus)


def write_exposure_png(path: Path, dn: npt.NDArray[np.uint16], detector: DetectorSettings) -> None:
    """A picture of a tracker's frame for a person (see `twin.eye_picture`)."""
    readout_e = math.hypot(detector.electronics_e, detector.column_noise_e)
    low_e = full_e(detector) - READOUT_SIGMAS * readout_e
    full_dn = math.floor(low_e / detector.gain_e_per_dn + detector.offset_dn)
    picture = exposure_picture(dn, full_dn)
    written(path, lambda file: file.write(png_of(picture)))


def write_dn_picture(path: Path, dn: npt.NDArray[np.uint16]) -> None:
    """The DN themselves, unscaled, as 16-bit greyscale: TIFF where the name ends in .tif or
    .tiff, else PNG.
    """
    from PIL import Image

    tiff = path.suffix.lower() in {".tif", ".tiff"}
    written(
        path,
        lambda file: Image.fromarray(dn).save(file, "TIFF") if tiff else file.write(png_of(dn)),
    )


class TrackerPictures:
    """A greyscale PNG of 16 bits for each attitude, drawn in the bench's GL context and freed with
    the bench.

    Its leading bits are the DN's, so that a reader that keeps 8 of them still sees a picture; sBIT
    says how many they are. The exposure is centred on the attitude; stars smear where the attitude
    has a rate. Noise is full, and that of the n-th picture of a run is always the same. `now` says
    which faults of a scenario are on.
    """

    def __init__(
        self,
        bench: Bench,
        scenario: Scenario = NO_SCENARIO,
        now: Callable[[], tuple[Now, ...]] = tuple,
    ) -> None:
        self._simulator = Simulator(bench.file, bench.renderer.context, refuse=False)
        self._noise = FrameNoise("full")
        self._count = 0
        self._now = now
        self._stood: View | None = None
        self._view = simulator_view(self._simulator, scenario)

    def __call__(self, sample: AttitudeSample) -> bytes:
        """The picture of the tracker at an attitude."""
        if sample.rate_cam_rad_s is None:
            rate = STILL
        else:
            rate = sample.rate_cam_rad_s
        view = self._simulator.view(
            sample.q_icrs_to_cam, rate, sample.t_ns, sample.velocity_km_s, sample.place_km
        )
        exposure = self._simulator.expose(view, self._noise.rng(self._count), self._faults(view))
        self._count += 1
        bits = self._simulator.config.tracker.detector.bits
        return png_of(np.left_shift(exposure.dn, 16 - bits, dtype=np.uint16), bits)

    def _faults(self, view: View) -> FaultyExposure | None:
        """The exposure with the faults of the display's frame; where that stands still, at the
        attitude at which it does.
        """
        now = self._now()
        if not any(isinstance(active.fault, Freeze | Drop) for active in now):
            self._stood = view
        elif self._stood is not None:
            stood = self._stood
            view = replace(
                view, q_icrs_to_cam=stood.q_icrs_to_cam, rate_cam_rad_s=STILL, t_ns=stood.t_ns
            )
        if now:
            return FaultyExposure(self._view, (ExposurePiece(view, now),))
        return None
