"""The tables of the bench's hardware: [tracker], [monitor], [collimator], [sync], and [verify],
their true state.
"""

import json
import re
from typing import Annotated, Literal

import msgspec
from msgspec import Meta

from hilstar.basics.errors import InputError, did_you_mean, shortened
from hilstar.basics.toml_tables import Table
from hilstar.server.bench.config.attitude import AttitudeSettings
from hilstar.server.bench.config.values import (
    MAX_NUMBER,
    Frequency,
    NotNegative,
    Point,
    Positive,
    Rotation,
    Sigma,
    Size,
)
from hilstar.tracker.settings import DetectorSettings, PixelPitch

MS_PER_S = 1000.0
NETWORK_PORT = "rfc2217://"
ROUNDING = 1e-6  # relative: 0.1 s at 10 Hz is one exposure after the other
QUANTUM_EFFICIENCY = "quantum_efficiency"
EFFICIENCIES_BY_COLOUR = tuple(f"{QUANTUM_EFFICIENCY}_{letter}" for letter in "rgb")


GAUSSIAN = "gaussian"
LENS_K = 293.0
DEFAULT_PSF_SIGMA_PX = (0.55, 0.55)
THIRD = 1 / 3
LAYOUTS: dict[str, tuple[tuple[float, float], ...]] = {
    "white": ((0.0, 0.0),) * 3,
    "rgb-stripe": ((-THIRD, 0.0), (0.0, 0.0), (THIRD, 0.0)),
    "bgr-stripe": ((THIRD, 0.0), (0.0, 0.0), (-THIRD, 0.0)),
    "vertical": ((0.0, -THIRD), (0.0, 0.0), (0.0, THIRD)),
}
WHITE_TOO = (
    "its white has a subpixel of its own, so red, green and blue do not add up; take a panel of"
    " three primaries"
)
SHARED = (
    "its pixels share subpixels, so a pixel's light depends on its neighbours' codes; take a panel"
    " whose pixels have all three"
)
REFUSED_LAYOUTS = dict.fromkeys(("rgbw", "wrgb", "rgwb", "woled"), WHITE_TOO)
REFUSED_LAYOUTS |= dict.fromkeys(("pentile", "rgbg", "diamond", "delta"), SHARED)
Chromaticity = Annotated[
    tuple[Annotated[float, Meta(ge=0, le=0.8)], Annotated[float, Meta(ge=1e-3, le=0.9)]],
    Meta(extra={"form": "[x, y]"}),
]
Offset = tuple[Annotated[float, Meta(ge=-1, le=1)], Annotated[float, Meta(ge=-1, le=1)]]


class TrackerOptics(Table, frozen=True):
    """How the tracker's lens spreads a star over the detector."""

    #: `"gaussian"`, or a FITS file: that of [`hilstar optics`](optics.md#the-file), or one image
    #: with `OVERSAMP` (samples a pixel, 1) and `PIXINT` (is the pixel integrated? F).
    psf: str = GAUSSIAN
    #: Where the detector stands along the axis, as the file of `psf` counts it.
    focus_um: Annotated[float, Meta(ge=-1e6, le=1e6)] = 0.0
    temperature_k: Annotated[float, Meta(ge=50, le=500)] = LENS_K  #: Temperature of the lens.
    #: Temperature at which `focus_um` and `focal_length_mm` hold.
    reference_temperature_k: Annotated[float, Meta(ge=50, le=500)] = LENS_K
    #: What each kelvin above that adds to `focus_um`; needs a file of `psf`.
    focus_um_per_k: Annotated[float, Meta(ge=-1e4, le=1e4)] = 0.0
    #: What each kelvin above that adds to the focal length, in millionths.
    focal_length_ppm_per_k: Annotated[float, Meta(ge=-1e4, le=1e4)] = 0.0
    #: How far the lens stands to the right of its place: principal point and PSFs with it.
    decentre_x_um: Annotated[float, Meta(ge=-1e4, le=1e4)] = 0.0
    decentre_y_um: Annotated[float, Meta(ge=-1e4, le=1e4)] = 0.0  #: The same, down.

    @property
    def warmer_k(self) -> float:
        """Kelvin above the reference temperature."""
        return self.temperature_k - self.reference_temperature_k


class TrackerCamera(Table, frozen=True):
    """How `--grab genicam:` sets the tracker's camera before it takes images. The exposure is the
    session's own.
    """

    #: GenICam's name of grey or Bayer, such as `"Mono12"`. Default: the camera's format that holds
    #: `[tracker.detector] bits`
    pixel_format: str | None = None
    gain: float | None = None  #: In the camera's own unit. Default: as the camera has it
    #: `"software"`: each image is triggered. `"off"`: it is the first after its exposure is set.
    trigger: Literal["off", "software"] = "off"
    #: Other features by their GenICam names, such as `{ BlackLevel = 10.0 }`. Default: none
    features: Annotated[
        dict[str, bool | int | float | str], Meta(extra={"form": "{ NAME = VALUE, ... }"})
    ] = msgspec.field(default_factory=dict)

    def settings(self) -> dict[str, bool | int | float | str]:
        """The features to set, by GenICam's names; the pixel format is not among them."""
        features = dict(self.features)
        if self.gain is not None:
            features["Gain"] = self.gain
        if self.trigger == "software":
            features["TriggerSelector"] = "FrameStart"
            features["TriggerSource"] = "Software"
            features["TriggerMode"] = "On"
        return features


class Tracker(Table, frozen=True):
    """The star tracker under test."""

    aperture_mm: Positive  #: Diameter of the entrance pupil.
    focal_length_mm: Positive  #: Focal length of the tracker's lens.
    pixel_pitch_um: PixelPitch  #: Distance between the centres of adjacent pixels.
    resolution_px: Size  #: Size of the detector.
    #: A sensor by its name, such as `"imx250"` ([which, and what is known of
    #: them](twin.md#a-sensor-by-its-name)). Its figures stand for `pixel_pitch_um`,
    #: `resolution_px`, `quantum_efficiency` and those of `[tracker.detector]` that are not written.
    #: What its sheet lacks has to be written. Default: none
    sensor: str | None = None
    #: `"ccd47-20"` (back-illuminated, as measured), `"kai-4021"` (approximate), `"icx285"`,
    #: `"imx249"`, `"imx250"` or `"imx252"` (makers' curves, digitised), the path of a CSV file with
    #: the header `wavelength_nm,value`, or one number for all wavelengths. Default: **required**,
    #: or the next three
    quantum_efficiency: str | float | None = None
    #: The same of the red channel alone. Default: one channel
    quantum_efficiency_r: str | float | None = None
    quantum_efficiency_g: str | float | None = None  #: The green channel's. Default: one channel
    quantum_efficiency_b: str | float | None = None  #: The blue channel's. Default: one channel
    #: Of the tracker's optics: `"n-bk7-10mm"` (10 mm of uncoated glass), the path of a CSV file as
    #: above, or one number.
    transmission: str | float = 1.0
    exposure_s: NotNegative = 0.1  #: Exposure time.
    #: How many exposures the tracker takes in a second: with `refresh_hz` it makes the period of
    #: their beat (see [sync](#sync)). Default: one exposure after the other
    frame_hz: Frequency | None = None
    #: `"free"`: the tracker exposes by its own clock. `"external"`: each exposure begins with a
    #: frame of the monitor (see [sync](#sync)): nothing beats.
    trigger: Literal["free", "external"] = "free"
    #: Gaussian sigma of the tracker's own point spread function, in tracker pixels; not used where
    #: `[tracker.optics] psf` names a file. It never widens the stars on the monitor.
    psf_sigma_px: Sigma = DEFAULT_PSF_SIGMA_PX
    #: Where the boresight meets the detector, in tracker pixels. Default: the middle of the
    #: detector
    principal_point_px: Point | None = None
    #: The tracker's flight model: a TOML file with `k1`, `k2`, `k3`, `p1` and `p2` (Brown-Conrady),
    #: from direction to pixel. Default: an ideal lens
    distortion: str | None = None
    #: Turns body components into camera components, for each source whose attitude is the body's
    #: ([attitude in](attitude-in.md#a-bodys-attitude)). Default: the body's axes, with a notice
    q_body_to_cam: Rotation | None = None
    #: `"auto"`: the simplest PSF that keeps a star's flux and centroid within the next two.
    #: `"full"`: all of the file.
    effort: Literal["full", "auto"] = "full"
    tolerance_mag: Positive = 0.02  #: Flux error that a star may then have, for `effort = "auto"`.
    tolerance_px: Positive = 0.02  #: Centroid error that it may have, in tracker pixels.
    optics: TrackerOptics = msgspec.field(default_factory=TrackerOptics)
    camera: TrackerCamera = msgspec.field(default_factory=TrackerCamera)
    detector: DetectorSettings = msgspec.field(default_factory=DetectorSettings)

    @property
    def quantum_efficiencies(self) -> dict[str, str | float]:
        """The quantum efficiency of each channel by its key: one, or those of red, green and
        blue.
        """
        efficiencies = {}
        for key in (QUANTUM_EFFICIENCY, *EFFICIENCIES_BY_COLOUR):
            value = getattr(self, key)
            if value is not None:
                efficiencies[key] = value
        return efficiencies


def check_channels(tracker: Tracker) -> None:
    """Refuse (InputError) a tracker with neither one quantum efficiency nor three."""
    given = tracker.quantum_efficiencies
    missing = [key for key in EFFICIENCIES_BY_COLOUR if key not in given]
    if QUANTUM_EFFICIENCY in given and len(given) > 1:
        raise InputError(
            f"[tracker] has {QUANTUM_EFFICIENCY} and {list(given)[1]}; write one for all light, or"
            " _r, _g and _b"
        )
    if tracker.detector.bayer is not None and QUANTUM_EFFICIENCY in given:
        raise InputError(
            f'[tracker.detector] bayer = "{tracker.detector.bayer}" has three colours of pixels,'
            f" and [tracker] one {QUANTUM_EFFICIENCY}; write {', '.join(EFFICIENCIES_BY_COLOUR)} in"
            " its place, or leave bayer out"
        )
    if missing and QUANTUM_EFFICIENCY not in given:
        key = missing[0] if given else QUANTUM_EFFICIENCY
        raise InputError(f"[tracker] the key {key} is missing; add it (see configs/README.md)")


class PrimariesSettings(Table, frozen=True):
    """The light of the monitor's red, green and blue, and where it lies within a pixel."""

    #: A CSV `wavelength_nm,r,g,b`: relative spectral power per nm of each primary at full drive; or
    #: an ArgyllCMS `.ccss` of this display. Default: not known
    file: str | None = None
    #: In place of `file`, with the next two: CIE 1931 x and y of each primary, as Gaussians that
    #: add up to D65: approximate. Default: by `file`
    xy_r: Chromaticity | None = None
    xy_g: Chromaticity | None = None  #: For green. Default: by `file`
    xy_b: Chromaticity | None = None  #: For blue. Default: by `file`
    #: Full width at half maximum of each primary that is given by `xy_`.
    width_nm: Annotated[float, Meta(ge=1, le=200)] = 30.0
    #: Where a pixel has its primaries' light: `"white"`, the middle; `"rgb-stripe"`,
    #: `"bgr-stripe"`, a third of a pixel apart; `"vertical"`.
    layout: str = "white"
    #: In place of `layout`: where the light of red, green and blue lies, in pixels from the middle,
    #: right and down on the screen. Default: by `layout`
    offsets_px: Annotated[
        tuple[Offset, Offset, Offset] | None, Meta(extra={"form": "[[x, y], [x, y], [x, y]]"})
    ] = None

    @property
    def known(self) -> bool:
        """Whether the primaries' light is known."""
        return self.file is not None or self.xy_r is not None

    @property
    def places_px(self) -> tuple[tuple[float, float], ...]:
        """Where each primary's light lies within a pixel, right and down on the screen."""
        return self.offsets_px or LAYOUTS[self.layout]


def check_primaries(primaries: PrimariesSettings) -> None:
    """Refuse (InputError) primaries that are given twice or in part, and layouts that three
    primaries of a pixel have not.
    """
    given = [key for key in ("xy_r", "xy_g", "xy_b") if getattr(primaries, key) is not None]
    if primaries.file is not None and given:
        raise InputError(f"[monitor.primaries] has file and {given[0]}; write one of them")
    if given and len(given) < len(LAYOUTS["white"]):
        missing = next(key for key in ("xy_r", "xy_g", "xy_b") if key not in given)
        raise InputError(
            f"[monitor.primaries] has {given[0]} and no {missing}; write xy_r, xy_g and xy_b"
        )
    if primaries.layout in REFUSED_LAYOUTS:
        raise InputError(
            f'[monitor.primaries] layout = "{primaries.layout}":'
            f" {REFUSED_LAYOUTS[primaries.layout]}"
        )
    if primaries.layout not in LAYOUTS:
        names = ", ".join(f'"{name}"' for name in LAYOUTS)
        meant = did_you_mean(primaries.layout, tuple(LAYOUTS))
        raise InputError(
            f"[monitor.primaries] layout = {shortened(json.dumps(primaries.layout))}: {meant}write"
            f" {names}, or offsets_px"
        )
    if primaries.offsets_px is not None and primaries.layout != "white":
        raise InputError("[monitor.primaries] has layout and offsets_px; write one of them")


class Monitor(Table, frozen=True):
    """The screen behind the collimator."""

    resolution_px: Size  #: Size of the screen.
    pixel_pitch_um: Positive  #: Distance between the centres of adjacent pixels.
    #: Refresh rate; headless, the frame rate.
    refresh_hz: Annotated[float, Meta(ge=0.01, le=1000)] = 60.0
    bits: Annotated[int, Meta(ge=1, le=16)] = 8  #: Bits of a code value.
    #: Light as a function of the code value: `"srgb"`, `"gamma2.2"`, `"lcd-example"` (invented,
    #: with a black level and vignetting), or the path of a file that `hilstar calibrate
    #: photometric` wrote (see [CALIBRATION.md](../configs/CALIBRATION.md)).
    calibration: str = "srgb"
    #: How long the files of `calibration` and `[collimator] geometry` hold: with older ones a
    #: screen is refused.
    calibration_valid_days: Annotated[float, Meta(gt=0, le=36500)] = 180
    #: Which display the window fills: its index, or a part of its name. `hilstar doctor` lists
    #: them.
    display: int | str = 0
    #: The optics mirror left and right: the columns of the screen are reversed.
    flip_x: bool = False
    flip_y: bool = False  #: The optics mirror up and down: the rows of the screen are reversed.
    rotate_deg: Literal[0, 90, 180, 270] = 0  #: Turns the image clockwise on the screen.
    #: From the buffer swap to the light of the first row. `hilstar latency` measures it.
    panel_delay_ms: NotNegative = 0.0
    #: How long the panel takes to light its rows, first to last; 0 where all rows light at once.
    #: Default: one refresh period
    scanout_ms: NotNegative | None = None
    #: How long a row stays lit; 0 for a panel that flashes. Default: one refresh period
    hold_ms: NotNegative | None = None
    #: Side of a square for a photodiode in the lower left corner; 0 for none.
    photodiode_px: Annotated[int, Meta(ge=0, le=1000)] = 0
    #: `"toggle"`: the square is white in every other frame. `"code"`: it follows a sequence in
    #: which any 7 consecutive frames identify themselves.
    photodiode: Literal["toggle", "code"] = "toggle"
    primaries: PrimariesSettings = msgspec.field(default_factory=PrimariesSettings)

    @property
    def period_ms(self) -> float:
        """One refresh period, in milliseconds."""
        return MS_PER_S / self.refresh_hz

    @property
    def panel_scanout_ms(self) -> float:
        """`scanout_ms`, or its default."""
        if self.scanout_ms is None:
            return self.period_ms
        return self.scanout_ms

    @property
    def panel_hold_ms(self) -> float:
        """`hold_ms`, or its default."""
        if self.hold_ms is None:
            return self.period_ms
        return self.hold_ms


class Collimator(Table, frozen=True):
    """The lens between monitor and tracker, and the tracker's alignment with it."""

    focal_length_mm: Positive  #: Focal length of the collimating lens.
    #: Misalignment: the unit quaternion that turns cam components into mon components.
    q_cam_to_mon: Rotation = (1.0, 0.0, 0.0, 0.0)
    #: Where the optical axis of the collimator meets the monitor, in monitor pixels. Default: the
    #: middle of the screen
    principal_point_px: Point | None = None
    #: Gaussian sigma of the collimator's or relay's own blur, in monitor pixels, as the twin sees
    #: it.
    psf_sigma_px: NotNegative = 0.0
    #: The file of `hilstar calibrate geometric` or `alignment`: lens and real alignment, in place
    #: of the other keys but `psf_sigma_px`. Default: an ideal lens
    geometry: str | None = None


class SyncSettings(Table, frozen=True):
    """The tracker's exposures and the monitor's refresh: how they beat, and a pulse for a
    tracker that takes a trigger.
    """

    #: The serial port whose RTS is pulsed, such as `"/dev/ttyUSB0"`, or `"rfc2217://HOST:PORT"`.
    #: Not the attitude's. Default: none
    port: str | None = None
    pulse_ms: Positive = 1.0  #: Width of the pulse, at least.
    #: `"high"`: RTS is set (positive on RS-232) in the pulse and cleared between. `"low"`: the
    #: other way round. Adapters with TTL levels have their lines inverted: set is 0 V.
    active: Literal["high", "low"] = "high"
    every_frames: Annotated[int, Meta(ge=1, le=1_000_000)] = 1  #: A pulse at every so many frames.
    #: Rate of turn at which `serve` and `first-light` judge what a beat costs.
    turn_deg_s: Positive = 1.0


def check_sync(
    sync: SyncSettings, tracker: Tracker, monitor: Monitor, attitude: AttitudeSettings
) -> None:
    """Refuse (InputError) exposures that overlap, a pulse that lasts until the next, and a port
    that is the attitude's.
    """
    if tracker.frame_hz is not None and tracker.frame_hz * tracker.exposure_s > 1 + ROUNDING:
        most = f"{1 / tracker.exposure_s:.6g} or less"
        raise InputError(
            f"[tracker] frame_hz = {tracker.frame_hz:g}: exposures of {tracker.exposure_s:g} s"
            f" overlap; write {most}"
        )
    if sync.port is None:
        return
    if not (sync.port.strip() and sync.port.isprintable()) or (
        "://" in sync.port
        and not re.fullmatch(NETWORK_PORT + r"[^/?]+:\d{1,5}([/?].*)?", sync.port)
    ):
        advice = (
            f'write "/dev/ttyUSB0" or the like, or "{NETWORK_PORT}HOST:PORT"; leave it out for no'
            " pulse"
        )
        raise InputError(f"[sync] port = {sync.port!r}: {advice}")
    between_ms = sync.every_frames * monitor.period_ms
    if sync.pulse_ms >= between_ms:
        what = (
            f"[sync] pulse_ms = {sync.pulse_ms:g}: the next pulse is due after {between_ms:.4g} ms"
        )
        raise InputError(f"{what}; write a shorter pulse, or a larger every_frames")
    if attitude.source == "serial" and sync.port == attitude.port:
        raise InputError(
            f"[sync] port = {sync.port}: the attitude comes over it; write another port"
        )


class Verify(Table, frozen=True):
    """The digital twin: what `hilstar verify` takes as true where the bench assumes otherwise, and
    the limits within which the bench passes.
    """

    #: The monitor's true light: a built-in name or a calibration file. Default: as the bench
    #: assumes
    true_calibration: str | None = None
    #: The true full scale. Default: as the bench assumes
    true_flux_at_white_e_per_s: Positive | None = None
    #: The collimator's true focal length. Default: as the bench assumes
    true_focal_length_mm: Positive | None = None
    #: The monitor's true pixel pitch. Default: as the bench assumes
    true_pixel_pitch_um: Positive | None = None
    #: The true misalignment. Default: as the bench assumes
    true_q_cam_to_mon: Rotation | None = None
    #: The true lens and the true alignment: a file as `hilstar calibrate geometric` writes it. Not
    #: beside `true_focal_length_mm`, `true_pixel_pitch_um` or `true_q_cam_to_mon`, which are of an
    #: ideal lens. Default: as the bench assumes
    true_geometry: str | None = None
    #: What the screen truly does: `"none"`, reverses columns (`"x"`), reverses rows (`"y"`), or
    #: swaps its axes (`"swap"`).
    true_mirror: Literal["none", "x", "y", "swap"] = "none"
    #: What the tracker finds its stars by, also to judge codes: a Gaussian `"window"` as wide as
    #: the star, `"wide"` half as wide again, the plain `"moment"`, a Gaussian `"fit"`, a fit of the
    #: `"psf"`, or the centre of mass of 3 x 3 or 5 x 5 pixels. Default: `"window"`; to judge codes,
    #: all of them
    centroider: Literal["window", "wide", "moment", "fit", "psf", "box3", "box5"] | None = None
    #: Limit for the flux error of 95 % of stars, with their common zero point taken out; also the
    #: limit of that zero point.
    flux_mag: Positive = 0.05
    #: Limit for the centroid error of 95 % of stars, in tracker pixels.
    centroid_px: Positive = 0.1
    #: Limit for the share of lost stars among those that stand alone, are shown, and are not
    #: clipped.
    lost_share: NotNegative = 0.02
    #: Limit for the sigma of a star on the display to that of a star of the sky, the tracker's
    #: pixel in both ([how wide a star is](twin.md#how-wide-a-star-is)).
    star_sigma_ratio: Annotated[float, Meta(ge=1, le=MAX_NUMBER)] = 2.0
    #: Limit for the screen's black level in a tracker pixel, seen minus assumed. Default: a tenth
    #: of the faintest star's light over its disc (4 pi sigma^2)
    black_e_per_s_px: NotNegative | None = None

    @property
    def judge(self) -> Literal["window", "wide", "moment", "fit", "box3", "box5"] | None:
        """`centroider` where a star is a Gaussian."""
        if self.centroider == "psf":
            return "fit"
        return self.centroider
