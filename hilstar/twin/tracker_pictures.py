"""The virtual tracker's pictures for a simulation that asks for those of its camera."""

from __future__ import annotations

import io
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.attitude.wire.packet import AttitudeSample
from hilstar.bench.faults.desk import Now
from hilstar.bench.faults.kinds import Drop, Freeze
from hilstar.bench.faults.scenario import NO_SCENARIO, Scenario
from hilstar.bench.frame import Bench
from hilstar.scene.exposure_motion import Motion
from hilstar.twin.faulty_exposure import FaultyExposure, Piece
from hilstar.twin.simulator import FrameNoise, Simulator, simulator_view

PNG_BITS = 16


class TrackerPictures:
    """A PNG for each attitude, drawn in the bench's GL context and freed with the bench.

    The exposure is centred on the attitude; stars smear where the attitude has a rate. Noise is full, and that of the n-th
    picture of a run is always the same. `now` says which faults of a scenario are on.
    """

    def __init__(self, bench: Bench, scenario: Scenario = NO_SCENARIO, now: Callable[[], tuple[Now, ...]] = tuple) -> None:
        self._simulator = Simulator(bench.file, bench.renderer.context)
        self._noise, self._count = FrameNoise("full"), 0
        self._now = now
        self._stood: Motion | None = None
        self._view = simulator_view(self._simulator, scenario)

    def __call__(self, sample: AttitudeSample) -> bytes:
        """The picture of the tracker at an attitude."""
        rate = np.zeros(3) if sample.rate_cam_rad_s is None else sample.rate_cam_rad_s
        motion = self._simulator.motion(sample.q_icrs_to_cam, rate, sample.t_ns)
        faults = self._faults(motion)
        rng = self._noise.rng(self._count)
        exposure = self._simulator.expose(motion, rng, sample.velocity_km_s, sample.place_km, faults)
        self._count += 1
        return dn_png(exposure.dn, self._simulator.config.tracker.detector.bits)

    def _faults(self, motion: Motion) -> FaultyExposure | None:
        """The exposure with the faults of the display's frame; where that stands still, at the attitude at which it does."""
        now = self._now()
        if not any(isinstance(one.fault, Freeze | Drop) for one in now):
            self._stood = motion
        elif self._stood is not None:
            motion = replace(self._stood, rate_cam_rad_s=np.zeros(3))
        return FaultyExposure(self._view, (Piece(motion, now),)) if now else None


def dn_png(dn: npt.NDArray[np.uint16], bits: int) -> bytes:
    """DN (height, width) of so many bits as a greyscale PNG of 16, which its sBIT says: DN = value >> (16 - bits).

    The leading bits are the DN's, so that a reader that keeps 8 of them still sees a picture.
    """
    from PIL import Image, PngImagePlugin

    about: Any = PngImagePlugin.PngInfo()
    about.add(b"sBIT", bytes([bits]))
    image = Image.fromarray(np.left_shift(dn, PNG_BITS - bits, dtype=np.uint16))
    data = io.BytesIO()
    image.save(data, "PNG", compress_level=1, pnginfo=about)
    return data.getvalue()
