"""[tracker]."""

from __future__ import annotations

from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from hilstar.bench.config.values import Frequency, NotNegative, Point, Positive, Rotation, Sigma, Size
from hilstar.toml_tables import Table
from hilstar.tracker.settings import DetectorSettings, PixelPitch


class Tracker(Table, frozen=True):
    """The star tracker under test.

    Its aperture, quantum efficiency and transmission turn a star's light into electrons. Focal length, pixels, exposure,
    point spread function and detector describe the *virtual* tracker of `simulate` and `verify`; the display adds nothing of
    them, because the real tracker brings its own.

    A curve (`quantum_efficiency`, `transmission`) is interpolated linearly between its points and is zero outside them. Where
    both curves are plain numbers, light from 300 to 1100 nm counts.
    """

    aperture_mm: Annotated[Positive, Meta(description="Diameter of the entrance pupil.")]
    focal_length_mm: Annotated[Positive, Meta(description="Focal length of the tracker's lens.")]
    pixel_pitch_um: Annotated[PixelPitch, Meta(description="Distance between the centres of adjacent pixels.")]
    resolution_px: Annotated[Size, Meta(description="Size of the detector.")]
    quantum_efficiency: Annotated[
        str | float,
        Meta(
            description='`"ccd47-20"` (back-illuminated, as measured), `"kai-4021"` (approximate), the path of a CSV file with '
            "the header `wavelength_nm,value`, or one number for all wavelengths."
        ),
    ]
    transmission: Annotated[
        str | float,
        Meta(
            description='Of the tracker\'s optics: `"n-bk7-10mm"` (10 mm of uncoated glass), the path of a CSV file as above, '
            "or one number."
        ),
    ] = 1.0
    exposure_s: Annotated[NotNegative, Meta(description="Exposure time.")] = 0.1
    frame_hz: Annotated[
        Frequency | None,
        Meta(
            description="How many exposures the tracker takes in a second: with `refresh_hz` it makes the period of their beat "
            "(see [sync](#sync)).",
            extra={"default": "one exposure after the other"},
        ),
    ] = None
    trigger: Annotated[
        Literal["free", "external"],
        Meta(
            description='`"free"`: the tracker exposes by its own clock. `"external"`: each exposure begins with a frame of '
            "the monitor (see [sync](#sync)): nothing beats."
        ),
    ] = "free"
    psf_sigma_px: Annotated[
        Sigma,
        Meta(
            description="Gaussian sigma of the tracker's own point spread function, in tracker pixels. It never widens the "
            "stars on the monitor."
        ),
    ] = (0.55, 0.55)
    principal_point_px: Annotated[
        Point | None,
        Meta(
            description="Where the boresight meets the detector, in tracker pixels.",
            extra={"default": "the middle of the detector"},
        ),
    ] = None
    distortion: Annotated[
        str | None,
        Meta(
            description="The path of the tracker's flight model: a TOML file with the Brown-Conrady coefficients `k1`, `k2`, "
            "`k3`, `p1` and `p2` of tangents of field angles, from direction to pixel; those not given are 0.",
            extra={"default": "an ideal lens"},
        ),
    ] = None
    q_body_to_cam: Annotated[
        Rotation | None,
        Meta(
            description="How the tracker sits in the spacecraft: turns body components into camera components. Applied to each "
            "source whose attitude is the body's (see [attitude in](attitude-in.md)); packets, JSON and CSV hold the camera's.",
            extra={"default": "the body's axes, with a notice"},
        ),
    ] = None
    detector: Annotated[DetectorSettings, Meta(description="See below.")] = msgspec.field(default_factory=DetectorSettings)
