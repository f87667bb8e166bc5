"""The verdict of a bench: the display's errors without their common zero point, the limits
exceeded, and the likely causes.
"""

import math
from dataclasses import dataclass, field, replace

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.error_spread import error_spread
from hilstar.display.quantisers import BY_COST
from hilstar.instruments.verify.faulty_fields import FaultSeen
from hilstar.instruments.verify.measure import GeometryFit, Measured, Star, fit_geometry

# A fit that leaves more of the residuals' squares than this explains nothing: chance matches leave
# nearly all.
MAX_LEFT = 0.5
# A cause is named where it accounts for more than this share of the stars.
MIN_SHARE = 0.5
# stars over all fields: with fewer, that none can be measured is chance or an empty sky
MIN_EXPECTED = 10.0
CURE = '; [verify] centroider = "psf" fits it, hilstar assess says which correction takes how much'
MIRROR_WORDS = {"x": "its columns reversed", "y": "its rows reversed", "swap": "its axes swapped"}


@dataclass(frozen=True, slots=True)
class DisplayErrors:
    """The stars with their common zero point subtracted; `codes_zero_point_mag` is the one that the
    codes alone would have.

    `lost` stars have NaN for errors; `geometry` is None with too few stars.
    """

    stars: list[Star]
    lost: list[Star]
    zero_point_mag: float
    codes_zero_point_mag: float
    geometry: GeometryFit | None

    @property
    def looked_for(self) -> int:
        """How many stars should have been found."""
        return len(self.stars) + len(self.lost)

    def of(self, name: str) -> FloatArray:
        """One of the stars' figures (n,), by the name of `Star`'s field; NaN where the codes alone
        lose the star.
        """
        return np.array([getattr(star, name) for star in self.stars])

    def centroid_px(self) -> FloatArray:
        """Centroid errors (n,), tracker pixels."""
        return np.asarray(np.hypot(self.of("dx_px"), self.of("dy_px")))


def display_errors(measured: Measured) -> DisplayErrors:
    """The errors of all fields' stars."""
    stars = measured.tally.stars
    zero_point = median([star.flux_mag for star in stars])
    codes_zero_point = median([star.codes_mag for star in stars])
    relative = []
    for star in stars:
        flux_mag = star.flux_mag - zero_point
        codes_mag = star.codes_mag - codes_zero_point
        relative.append(replace(star, flux_mag=flux_mag, codes_mag=codes_mag))
    displaced = np.concatenate([np.empty((0, 4)), *measured.tally.displaced])
    geometry = fit_geometry(displaced, measured.camera, measured.config.verify.centroid_px)
    lost = measured.tally.lost
    return DisplayErrors(relative, lost, zero_point, codes_zero_point, geometry)


def median(values: list[float]) -> float:
    """The median of the finite values, 0 without any."""
    finite_values = [value for value in values if math.isfinite(value)]
    if finite_values:
        return float(np.median(finite_values))
    return 0.0


def p95(errors: FloatArray) -> float:
    """The 95th percentile of some errors (n,), 0 without any."""
    return error_spread(errors).p95 or 0.0


def reasons(measured: Measured, errors: DisplayErrors) -> list[str]:
    """Every reason against a bench, in words; none where it passes."""
    too_wide = _too_wide(measured)
    if not errors.looked_for:
        return [_none(measured), *too_wide]
    lost = _lost(measured, errors)
    centroid = _centroids(measured, errors)
    against = [*lost, *centroid]
    if against:
        against += _geometry(measured, errors)
    # A few stars found by chance, or far from the middle of their windows, say nothing about light.
    mostly_lost = len(errors.lost) > MIN_SHARE * errors.looked_for
    if not mostly_lost:
        against += _light(measured, errors)
        against += _codes(measured, errors)
    return [*against, *_black(measured), *_floor(measured, errors), *too_wide]


def _none(measured: Measured) -> str:
    """Why no star could be measured: too few in view, or none that can be."""
    few = measured.stars_a_field
    fields = measured.field_count
    faintest = measured.config.sky.faintest_v_mag
    text = (
        f"no star could be measured: none of {fields} fields has one that is shown, unclipped and"
        " alone"
    )
    if few * fields > MIN_EXPECTED:
        return text
    return (
        f"{text}; {few:.2g} stars to V = {faintest:g} are in the tracker's field on average: write"
        " a larger [sky] faintest_v_mag, or a [sky] catalogue with fainter stars, or let `hilstar"
        " verify` look at more --fields"
    )


def _too_wide(measured: Measured) -> list[str]:
    """A star of the display that is too wide for a tracker that knows the sky's."""
    fault = measured.star.fault()
    return [] if fault is None else [fault]


def _lost(measured: Measured, errors: DisplayErrors) -> list[str]:
    lost = len(errors.lost)
    looked_for = errors.looked_for
    tally = measured.tally
    limit = measured.config.verify.lost_share
    if lost <= limit * looked_for:
        return []
    cause = "look at focal lengths, pixel pitches and q_cam_to_mon"
    if tally.vanished > MIN_SHARE * lost:
        cause = (
            "they are too faint to be seen: look at the monitor's response, and at what the codes"
            " leave of faint stars"
        )
    for mirror, count in tally.mirrored.items():
        if count > MIN_SHARE * looked_for:
            cause = (
                f"{count} are where a mirrored screen with {MIRROR_WORDS[mirror]} would show them:"
                " look at how it is mounted"
            )
    return [
        f"{lost} of {looked_for} stars are not where the sky has them (limit {limit:.1%}): {cause}"
    ]


def _centroids(measured: Measured, errors: DisplayErrors) -> list[str]:
    limit = measured.config.verify.centroid_px
    p95_px = p95(errors.centroid_px())
    if p95_px > limit:
        return [f"centroids are {p95_px:.3f} px off at 95 % (limit {limit:g})"]
    return []


def _geometry(measured: Measured, errors: DisplayErrors) -> list[str]:
    """The parts of the geometry that are off by more than the centroid limit somewhere in the
    field.
    """
    fit = errors.geometry
    limit = measured.config.verify.centroid_px
    if fit is None or fit.left > MAX_LEFT:
        return []
    reach_px = math.hypot(*measured.camera.resolution_px) / 2
    geometry_fit = []
    measured_lens = measured.config.collimator.geometry
    again = "its geometry file does not say so; run hilstar calibrate geometric again"
    if abs(fit.scale_error) * reach_px > limit:
        if measured_lens:
            cure = again
        else:
            cure = "look at focal_length_mm and pixel_pitch_um"
        geometry_fit.append(f"the plate scale is {fit.scale_error:+.2%} off: {cure}")
    if abs(fit.rotation_rad) * reach_px > limit:
        cure = again if measured_lens else "look at q_cam_to_mon"
        geometry_fit.append(
            f"the field is turned by {math.degrees(fit.rotation_rad):+.3f} deg: {cure}"
        )
    if math.hypot(*fit.offset_px) > limit:
        right, down = fit.offset_px
        if measured_lens:
            cure = again
        else:
            cure = "look at q_cam_to_mon and principal_point_px"
        geometry_fit.append(f"the field is shifted by ({right:+.2f}, {down:+.2f}) px: {cure}")
    cure = again if measured_lens else "hilstar calibrate geometric measures it"
    return [*geometry_fit, *_lens(fit, limit, cure)]


def _lens(fit: GeometryFit, limit_px: float, cure: str) -> list[str]:
    """Errors that only the key `geometry` can describe."""
    reasons = []
    if fit.tilt_px > limit_px:
        a, b = (math.degrees(angle) for angle in fit.tilt_rad)
        reasons.append(
            f"the screen is tilted by ({a:+.2f}, {b:+.2f}) deg about its x and y axes,"
            f" {fit.tilt_px:.2f} px: {cure}"
        )
    if fit.distortion_px > limit_px:
        reasons.append(
            f"the lens distorts by {fit.distortion_px:.2f} px (k1 {fit.k1:+.3g}): {cure}"
        )
    if fit.left_px > limit_px:
        reasons.append(
            f"that leaves {fit.left_px:.2f} px at 95 %, which is neither alignment, tilt nor"
            " distortion"
        )
    return reasons


def _light(measured: Measured, errors: DisplayErrors) -> list[str]:
    """Errors of the field's stars relative to each other, then the error that all have in
    common.
    """
    verify = measured.config.verify
    reasons = []
    limit = verify.flux_mag
    p95_mag = p95(np.abs(errors.of("flux_mag")))
    alone = p95(np.abs(errors.of("codes_mag")))
    if p95_mag > limit:
        text = f"flux is {p95_mag:.3f} mag off at 95 % (limit {limit:g})"
        beside_codes_mag = math.sqrt(max(p95_mag**2 - alone**2, 0.0))
        if beside_codes_mag > limit:
            text += (
                ": light does not follow the codes as assumed, look at the monitor's response and"
                " uniformity"
            )
        reasons.append(text)
    offset = errors.zero_point_mag
    of_codes = errors.codes_zero_point_mag
    if abs(offset) > limit:
        if abs(of_codes) > limit:
            cause = f"the codes alone make {of_codes:+.3f}"
        else:
            cause = "look at flux_at_white_e_per_s"
        # A wrong response moves the median star too: then white may well be right.
        if not (reasons and abs(of_codes) <= limit and verify.true_flux_at_white_e_per_s is None):
            reasons.append(f"all stars are {offset:+.3f} mag off (limit {limit:g}): {cause}")
    return reasons


def _black(measured: Measured) -> list[str]:
    """What the screen's black gives more or less than is assumed."""
    glow = measured.glow
    if abs(glow.seen_e_per_s_px - glow.assumed_e_per_s_px) <= glow.limit_e_per_s_px:
        return []
    return [
        f"the screen's black gives {glow.seen_e_per_s_px:.4g} e-/s in a tracker pixel where"
        f" {glow.assumed_e_per_s_px:.4g} are assumed (limit {glow.limit_e_per_s_px:.3g}): calibrate"
        " the black level"
    ]


def _floor(measured: Measured, errors: DisplayErrors) -> list[str]:
    """The linear image against the catalogue: where that exceeds the limits, the differences
    above say nothing.
    """
    limits = measured.config.verify
    mag = p95(np.abs(errors.of("floor_mag")))
    px = p95(errors.of("floor_px"))
    if mag <= limits.flux_mag and px <= limits.centroid_px:
        return []
    glass = measured.glass
    text = (
        f"the linear image itself is measured {mag:.3f} mag and {px:.3f} px off the catalogue at 95"
        " %: "
    )
    if glass is not None:
        by_place = px > limits.centroid_px and glass.px > MIN_SHARE * px
        by_light = mag > limits.flux_mag and glass.mag > MIN_SHARE * mag
        if by_place or by_light:
            cure = CURE if limits.centroider != "psf" else ""
            return [
                f"{text}the glass of [tracker.optics] psf has centroids {glass.px:.3f} px beside"
                f" their chief rays and light {glass.mag:.3f} mag under the axis's at 95 %{cure}"
            ]
    return [
        f"{text}the tracker's PSF is too narrow or too wide for its pixels, or lies beside its"
        " chief ray, so that nothing can be said about the display"
    ]


def _codes(measured: Measured, errors: DisplayErrors) -> list[str]:
    """The errors of the codes alone, with all else as assumed, and the keys that make codes
    finer.
    """
    limits = measured.config.verify
    render = measured.config.render
    mag = p95(np.abs(errors.of("codes_mag")))
    px = p95(errors.of("codes_px"))
    if mag <= limits.flux_mag and px <= limits.centroid_px:
        return []
    # What is proposed has to suit the monitor as it is, too.
    calibrations = [measured.calibration]
    if measured.true_calibration is not None:
        calibrations.append(measured.true_calibration)
    ways = []
    if render.quantisation != BY_COST[-1]:
        ways.append(f'quantisation = "{BY_COST[-1]}"')
    if not render.bit_stealing and all(c.can_steal_bits for c in calibrations):
        ways.append("bit_stealing = true")
    if all(c.is_formula for c in calibrations):
        ways.append("more bits")
    else:
        ways.append("a monitor calibrated on more bits")
    ways += ["a larger brightest_v_mag", "a smaller faintest_v_mag"]
    return [
        f"the codes alone cost {mag:.3f} mag and {px:.3f} px at 95 %; try {', '.join(ways[:-1])} or"
        f" {ways[-1]}"
    ]


@dataclass(frozen=True, slots=True)
class Verdict:
    """The measurement, its errors, every reason against the bench, and the scenario's faults as
    they were seen.
    """

    measured: Measured
    errors: DisplayErrors
    reasons: list[str]
    faults: list[FaultSeen] = field(default_factory=list)

    @property
    def passed(self) -> bool:
        """True without any reason against it."""
        return not self.reasons

    def __bool__(self) -> bool:
        return self.passed

    def __repr__(self) -> str:
        words = "passed" if self.passed else "not passed"
        counts = f"stars: {self.errors.looked_for}, reasons against it: {len(self.reasons)}"
        return f"<hilstar verdict: {words}, {counts}>"


def judge(measured: Measured) -> Verdict:
    """The verdict over all fields."""
    errors = display_errors(measured)
    return Verdict(measured, errors, reasons(measured, errors))
