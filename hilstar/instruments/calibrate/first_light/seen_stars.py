"""Stars on the screen as the tracker sees them: fields with the most readable stars, and each one's
place, light and noise.

A star is as wide as the PSF and the monitor's pixels make it, so window, margins and noise follow
its sigma: the light in the window is corrected for what lies outside, and the noise of place and
light is that of photons, background and PRNU.
"""

import dataclasses
import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree
from scipy.special import ndtr

from hilstar.basics.arrays import Float32Array, FloatArray, IntArray
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import from_matrix, random_attitudes, to_matrix
from hilstar.basics.units import MAG_PER_RELATIVE, magnitude
from hilstar.display.panel import Panel
from hilstar.display.quantise import shown_light
from hilstar.display.response import Levels
from hilstar.instruments.calibrate.first_light.context import (
    MAX_FILL,
    DarkSubtracted,
    StepContext,
)
from hilstar.instruments.calibrate.first_light.image_sources import CodeImage, Pattern
from hilstar.instruments.calibrate.scale import STAR_MAG
from hilstar.instruments.simulate.bench_geometry import BenchGeometry
from hilstar.optics.camera import Camera
from hilstar.server.bench.build import open_bench
from hilstar.server.bench.cameras import display_psf, tracker_camera
from hilstar.server.bench.frame import Bench, Frame
from hilstar.tracker.centroids import CentroidSettings, find_stars, noisiest_background
from hilstar.tracker.rounding import STEP_PHASES, before_adc_dn, rounded_light

# at random, and at bright stars: a narrow field has few others
RANDOM_ATTITUDES, POINTED_ATTITUDES, SEED = 40, 60, 3
# fields shown: more than three until so many stars can be read
FIELDS, MAX_FIELDS, ENOUGH_STARS = 3, 8, 20
MIN_STARS = 5
MIN_REACH_PX = 3.0  # tracker px, as in `verify`
MIN_EDGE_PX, MIN_RADIUS_PX, RADIUS_SIGMAS = 12.0, 4, 3.0
# stars within so many windows have together less than this share of a star's light
ALONE_RADII, BESIDE_SHARE = 2.0, 1e-3
THRESHOLD_SIGMA = 8.0
# noise of a star that can be read, and of one whose light is judged by itself
READ_MAG, SURE_MAG = 0.1, 0.01
SURE_STARS = 10  # the stars with the least noise that are judged where few are sure
MIN_PIXELS = 2  # over the threshold: a hot pixel is no star
# times the threshold: a star whose second pixel should be so bright and is not there is lost
LOST_MARGIN = 3.0
MOST = 0.5  # a share of the variance this large is named as its cause
FAR = 3.0  # times their errors: more scatter than this has another cause
ONE_SIDED = 1.645  # sigmas of 95 %
NOISE_POINTS = 200  # of a star's noise by its light, from 1 DN on


@dataclass(frozen=True)
class StarSpot:
    """A star in the tracker's image: its sigma along x and y, tracker px, and what the detector
    adds.

    The image is the mean of `frames`; `electronics_dn` is the noise that the electronics add to a
    pixel of each.
    """

    sigma_px: tuple[float, float]
    gain_e_per_dn: float
    prnu: float
    electronics_dn: float
    frames: int = 1

    @classmethod
    def of(cls, context: StepContext) -> "StarSpot":
        """The spot of the bench file's sprite, with the PSF of the step `focus`. Raises
        InputError.
        """
        geometry = context.geometry()
        ratio = geometry.tracker.focal_length_px / geometry.monitor.focal_length_px
        sprite = display_psf(context.file.config, context.file.folder, geometry.monitor).width_px
        # A sprite's shares are those of whole pixels, and each pixel is a square of light: a
        # twelfth of its area each.
        squares_px2 = 2 / 12
        psf_px = context.tracker_psf.width_px
        psf_scale = context.psf_sigma_px / float(np.mean(psf_px))
        sigmas_px = []
        for psf_width_px, sprite_px in zip(psf_px, sprite, strict=True):
            drawn_px = ratio * math.sqrt(sprite_px**2 + squares_px2)
            sigmas_px.append(math.hypot(psf_scale * psf_width_px, drawn_px))
        x_px, y_px = sigmas_px
        detector = context.detector
        electronics_dn = detector.electronics_e / detector.gain_e_per_dn
        return cls((x_px, y_px), detector.gain_e_per_dn, detector.prnu, electronics_dn)

    @property
    def mean_sigma_px(self) -> float:
        """The geometric mean of both sigmas."""
        return math.sqrt(math.prod(self.sigma_px))

    @property
    def radius_px(self) -> int:
        """Half the side of the window, without its middle pixel."""
        return max(MIN_RADIUS_PX, math.ceil(RADIUS_SIGMAS * max(self.sigma_px)))

    @property
    def settings(self) -> CentroidSettings:
        """How stars are found and their places measured, in a window as wide as they are."""
        return CentroidSettings(
            THRESHOLD_SIGMA,
            MIN_PIXELS,
            window_sigma_px=max(1.0, self.mean_sigma_px),
            window_radius_px=self.radius_px,
            psf_sigma_px=self.sigma_px,
        )

    @property
    def window_share(self) -> float:
        """The share of a star's light that is in the window."""
        return self._share_within(self.radius_px + 0.5)

    @property
    def peak_share(self) -> float:
        """The share of a star's light in the pixel that it is in the middle of."""
        return self._share_within(0.5)

    def second_share(self, place_px: FloatArray) -> FloatArray:
        """The share (n,) of the light of stars at places (n, 2) in their second brightest pixel."""
        off_px = np.abs(place_px - np.rint(place_px))
        upper = ndtr((0.5 - off_px) / self.sigma_px)
        inside = upper - ndtr((-0.5 - off_px) / self.sigma_px)
        beside = ndtr((1.5 - off_px) / self.sigma_px) - upper
        in_next_column = beside[:, 0] * inside[:, 1]
        in_next_row = inside[:, 0] * beside[:, 1]
        return np.asarray(np.maximum(in_next_column, in_next_row))

    def reach_on_screen(self, geometry: BenchGeometry) -> int:
        """Half the side of the window on the screen, without its middle, monitor pixels."""
        ratio = geometry.monitor.focal_length_px / geometry.tracker.focal_length_px
        return math.ceil((self.radius_px + 0.5) * ratio)

    def _share_within(self, half_px: float) -> float:
        """The share of a star's light in a square about it."""
        shares = []
        for sigma in self.sigma_px:
            shares.append(float(ndtr(half_px / sigma) - ndtr(-half_px / sigma)))
        return math.prod(shares)

    @cached_property
    def _shares(self) -> tuple[FloatArray, FloatArray]:
        """Shares of a star's light in its window (k, k), and pixels' offsets along x (k,)."""
        offset = np.arange(-self.radius_px, self.radius_px + 1.0)
        axes = []
        for sigma in self.sigma_px:
            beyond = ndtr((offset + 0.5) / sigma)
            before = ndtr((offset - 0.5) / sigma)
            axes.append(beyond - before)
        across, down = axes
        return np.outer(down, across), offset

    def light_noise_mag(self, dn: FloatArray, noise_dn: float) -> FloatArray:
        """The noise (n,) of stars of `dn` (n,) in all, magnitudes, over a background of
        `noise_dn` in a pixel.
        """
        shares, _ = self._shares
        light = np.maximum(dn, 1e-9)
        window_dn = light * self.window_share
        photon_dn2 = window_dn / (self.gain_e_per_dn * self.frames)
        background_dn2 = shares.size * noise_dn**2
        response_dn2 = (self.prnu * light) ** 2 * float((shares**2).sum())
        rounding_dn2 = (self.rounded_dn(light, noise_dn) ** 2).mean(axis=1)
        variance = photon_dn2 + background_dn2 + response_dn2 + rounding_dn2
        return np.asarray(MAG_PER_RELATIVE * np.sqrt(variance) / window_dn)

    def tabled_noise_mag(self, dn: FloatArray, noise_dn: float, largest_dn: float) -> FloatArray:
        """`light_noise_mag` (n,) from a table: the rounding of each of 100 000 stars takes minutes.

        Stars of less than 1 DN are infinitely noisy, those over `largest_dn` have its noise.
        """
        points_dn = np.geomspace(1.0, max(largest_dn, 2.0), NOISE_POINTS)
        noise_mag = self.light_noise_mag(points_dn, noise_dn)
        return np.interp(dn, points_dn, noise_mag, left=np.inf)

    def rounded_dn(self, dn: FloatArray, noise_dn: float) -> FloatArray:
        """What the ADC's rounding adds to the windows of stars of `dn` (n,) in all, DN: (n,
        STEP_PHASES), by where the dark level lies between two codes (see `rounded_light`).

        `noise_dn` is that of a pixel above its dark frame, in the mean of the frames.
        """
        shares, _ = self._shares
        pixel_shares = shares.ravel()
        dark_dn = before_adc_dn(noise_dn**2 * self.frames / 2, self.electronics_dn)
        rounded = np.zeros((len(dn), STEP_PHASES))
        for star, light_dn in enumerate(dn.tolist()):
            pixels_dn = light_dn * pixel_shares
            rounded[star] = rounded_light(pixels_dn, dark_dn, 1 / self.gain_e_per_dn)
        return shares.size * rounded

    def place_noise_px(self, dn: FloatArray, noise_dn: float) -> FloatArray:
        """The noise (n,) of the places of such stars along one axis, px: that of the window's
        first moment.
        """
        shares, offset = self._shares
        sigma2 = self.settings.window_sigma_px**2
        distance2 = offset**2 + offset[:, None] ** 2
        window = np.exp(-0.5 * distance2 / sigma2)
        pull2 = (window * offset) ** 2
        slope = float((shares * window * (1 - offset**2 / sigma2)).sum())
        light = np.maximum(dn, 1e-9)
        photons = light / (self.gain_e_per_dn * self.frames)
        background = noise_dn**2 * float(pull2.sum())
        response = (self.prnu * light) ** 2 * float((pull2 * shares**2).sum())
        variance = background + photons * float((pull2 * shares).sum()) + response
        return np.asarray(np.sqrt(variance) / (light * slope))


class Beyond(NamedTuple):
    """The scatter of residuals beyond their noise: a standard deviation, and its 95 % bounds below
    and above.
    """

    sigma: float
    low: float
    high: float

    @classmethod
    def of(cls, residual: FloatArray, noise: FloatArray) -> "Beyond":
        """The scatter of residuals (n,) beyond their noise (n,): the square root of the weighted
        mean of residual^2 - noise^2.
        """
        noise2 = noise**2
        weight = 1 / (noise2 + float(np.median(noise)) ** 2) ** 2
        total = weight.sum()
        squares = residual**2 - noise2
        excess = float((weight * squares).sum() / total)
        variance = noise2 + max(excess, 0.0)
        error2 = 2 * float((weight**2 * variance**2).sum())
        error = math.sqrt(error2) / float(total)
        reach = ONE_SIDED * error
        return cls(_root(excess), _root(excess - reach), _root(excess + reach))


def _root(variance: float) -> float:
    """The root of a variance that noise may have made negative."""
    return math.sqrt(max(variance, 0.0))


@dataclass(frozen=True, slots=True)
class ExpectedStars:
    """Stars drawn whole and isolated: places (n, 2), tracker px, and light (n,), e-/s.

    `screen` (n, 2) is the place on the screen, -1 to 1 along each axis; `codes_mag` (n,) how much
    too faint the codes are.
    """

    hip: npt.NDArray[np.int32]
    place_px: FloatArray
    e_per_s: FloatArray
    screen: FloatArray
    codes_mag: FloatArray


@dataclass(frozen=True, slots=True)
class StarsSeen:
    """Isolated stars that the tracker sees: places by the sky (n, 2), tracker px, and the residuals
    of their images (n, 2).

    `place_noise_px` (n,) is the noise of a residual along one axis. `dn` is the whole light of each
    (n,), `e_per_s` the light asked for, `noise_mag` its error, infinite where the tracker
    saturated. `rounding_mag` (n, STEP_PHASES) is the part of it that the ADC's rounding does to all
    stars together. `screen` (n, 2) is the place on the screen, -1 to 1;
    `codes_mag` (n,) how much too faint the codes are. `frames` images of each field were averaged.
    """

    hip: npt.NDArray[np.int32]
    place_px: FloatArray
    residual_px: FloatArray
    place_noise_px: FloatArray
    dn: FloatArray
    e_per_s: FloatArray
    noise_mag: FloatArray
    rounding_mag: FloatArray
    screen: FloatArray
    codes_mag: FloatArray
    lost: int
    frames: int
    images: tuple[Path, ...]

    @property
    def sure(self) -> npt.NDArray[np.bool_]:
        """A mask of the stars whose light is known well enough (n,): those under SURE_MAG, or
        the few with the least noise.
        """
        few = np.sort(self.noise_mag)[min(SURE_STARS, len(self.noise_mag)) - 1]
        return np.asarray(self.noise_mag <= float(np.clip(few, SURE_MAG, READ_MAG)))

    @property
    def beyond_px(self) -> Beyond:
        """The scatter of the stars' places beyond their noise, along one axis, px."""
        return Beyond.of(self.residual_px.ravel(), np.repeat(self.place_noise_px, 2))

    def scatter(self, off_mag: FloatArray, used: npt.NDArray[np.bool_]) -> "Scatter":
        """The scatter of the used stars' light, `off_mag` (used,) fainter than asked for, and
        its errors.
        """
        centred_mag = off_mag - self.codes_mag[used]
        centred_mag = centred_mag - np.median(centred_mag)
        error = np.sqrt(self.noise_mag[used] ** 2 + STAR_MAG**2)
        x, y = self.screen[used].T
        log_light = np.log(self.e_per_s[used])
        rms_mag = float(np.sqrt((centred_mag**2).mean()))
        error_mag = float(np.sqrt((error**2).mean()))
        return Scatter(
            rms_mag=rms_mag,
            error_mag=error_mag,
            by_place=_explained(centred_mag, x, y, x**2 + y**2),
            by_light=_explained(centred_mag, log_light),
        )


@dataclass(frozen=True, slots=True)
class Scatter:
    """The rms scatter of stars' light and its expected error, without codes and common zero point.

    `by_place` and `by_light` are the shares of the variance that follow the place on the screen and
    the light asked for.
    """

    rms_mag: float
    error_mag: float
    by_place: float
    by_light: float

    @property
    def finding(self) -> str:
        """What is wrong and what to do where the scatter is far above its error; else ""."""
        if self.rms_mag <= FAR * self.error_mag:
            return ""
        scatter_text = (
            f"the light of stars scatters by {self.rms_mag:.3f} mag rms where they are known to"
            f" {self.error_mag:.3f}"
        )
        if max(self.by_place, self.by_light) < MOST:
            why = (
                "it follows neither place nor light: look at stray light, local dimming, and"
                " whether the light is steady"
            )
        elif self.by_place > self.by_light:
            why = (
                f"{self.by_place:.0%} of it follows the place on the screen: measure that (--again"
                " uniformity)"
            )
        else:
            why = (
                f"{self.by_light:.0%} of it follows the light asked for: measure the response"
                " (--again photometry, --patches N)"
            )
        return f"{scatter_text}; {why}"


def _explained(off: FloatArray, *shapes: FloatArray) -> float:
    """The share of the variance of `off` (n,) that a linear fit of `shapes` (n,) explains,
    corrected for chance.
    """
    design = np.stack([np.ones_like(off), *shapes], axis=1)
    free = len(off) - design.shape[1]
    total = float(((off - off.mean()) ** 2).sum())
    if free < 1 or not total:
        return 0.0
    coefficients = np.linalg.lstsq(design, off, rcond=None)[0]
    residual = off - design @ coefficients
    residual_variance = (residual**2).sum() / free
    return float(1 - residual_variance / (total / (len(off) - 1)))


class _ShownField(NamedTuple):
    """A field of stars: codes of each frame of an exposure, and the stars that should be seen."""

    codes: tuple[CodeImage, ...]
    expected: ExpectedStars


def see_stars(context: StepContext, frames: int = 1) -> StarsSeen:
    """Show the fields with the most readable stars, `frames` images of each, and measure them.

    Raises InputError where too few stars can be compared.
    """
    spot = StarSpot.of(context)
    dark, dark_paths = _mean_dark(context, frames)
    shown = _shown_fields(context, spot, difference_noise_dn(dark))
    fields = []
    for number, field in enumerate(shown):
        patterns = []
        for again in range(frames):
            name = f"stars_{number:03}"
            if again:
                name += f"_{again:02}"
            patterns.append(Pattern(name, field.codes[0], field.codes[1:]))
        looked = (context.look(pattern, dark) for pattern in patterns)
        limits = ImageLimits(context.exposure_s, context.full_dn)
        fields.append(compared(looked, field.expected, spot, limits))
    columns: dict[str, Any] = {}
    for column in dataclasses.fields(StarsSeen):
        if column.name not in {"lost", "frames", "images"}:
            parts = [getattr(field_stars, column.name) for field_stars in fields]
            columns[column.name] = np.concatenate(parts)
    images = list(dark_paths)
    for field_stars in fields:
        images.extend(field_stars.images)
    lost = sum(field_stars.lost for field_stars in fields)
    stars_seen = StarsSeen(**columns, lost=lost, frames=frames, images=tuple(images))
    if len(stars_seen.dn) < MIN_STARS:
        raise InputError(_why_few(stars_seen, spot, len(shown)))
    return stars_seen


def difference_noise_dn(dark: FloatArray) -> float:
    """The noise of a pixel of an image less a dark one (h, w) that is as noisy, DN."""
    return math.sqrt(2) * noisiest_background(dark).noise


def _shown_fields(context: StepContext, spot: StarSpot, noise_dn: float) -> list[_ShownField]:
    """The fields with the most readable stars, over a background of `noise_dn` in a pixel."""
    shown = []
    with open_bench(context.file) as bench:
        # with `temporal` the frames of an exposure
        exposed = bench.quantiser.exposure(0, bench.config.exposure_frames)
        for q_icrs_to_cam in _fields(bench, context, spot, noise_dn):
            frame = bench.frame(q_icrs_to_cam)
            levels = [frame.levels]
            if len(exposed) > 1:
                levels.clear()
                for number in exposed:
                    drawn = bench.draw(frame.q_icrs_to_cam, number)
                    levels.append(Levels(drawn.levels.copy()))
            codes = [bench.code_values(of_frame).astype(np.uint16) for of_frame in levels]
            expected = _alone(bench, context, frame, levels, spot)
            shown.append(_ShownField(tuple(codes), expected))
    return shown


def _why_few(seen: StarsSeen, spot: StarSpot, fields: int) -> str:
    """What is wrong where too few stars can be compared, and what to do."""
    few = (
        f"{len(seen.dn)} stars can be seen where the sky has them, in {fields} fields, and"
        f" {MIN_STARS} are needed"
    )
    if seen.lost:
        return (
            f"{few}; {seen.lost} that should be bright enough are not there: measure the response"
            " (--again photometry), look at [render] flux_at_white_e_per_s, or run the geometry"
            " again (--again geometry)"
        )
    if spot.mean_sigma_px > 2:
        wide = f"a star's sigma is {spot.mean_sigma_px:.1f} px"
    else:
        wide = "the field has few bright stars"
    return (
        f"{few}; {wide}: write a longer [tracker] exposure_s, a larger [render] brightest_v_mag,"
        " so that faint stars are shown brighter, or a larger [sky] faintest_v_mag"
    )


def _mean_dark(context: StepContext, frames: int) -> tuple[FloatArray, tuple[Path, ...]]:
    """The mean of `frames` images of a black screen (h, w), and their files."""
    paths = [context.dark(number) for number in range(frames)]
    # One image at a time: twenty of 2048 x 2048 pixels take 0.7 GB.
    total = context.read(paths[0])
    for path in paths[1:]:
        total = total + context.read(path)
    return total / frames, tuple(paths)


def _fields(
    bench: Bench, context: StepContext, spot: StarSpot, noise_dn: float
) -> list[FloatArray]:
    """Attitudes (4,) of the fields with the most stars that can be read, of random ones and of
    those at bright stars.
    """
    stars = bench.stars
    rng = np.random.default_rng(SEED)
    per_e = context.exposure_s / spot.gain_e_per_dn
    dn = stars.electrons_per_s * per_e
    largest_dn = MAX_FILL * context.full_dn / spot.peak_share
    readable = (stars.row >= 0) & (dn < largest_dn)
    readable &= stars.electrons_per_s * bench.psf.peak_share <= bench.flux_at_white_e_per_s
    readable &= spot.tabled_noise_mag(dn, noise_dn, largest_dn) < READ_MAG
    readable_stars = np.flatnonzero(readable)
    attitudes = list(random_attitudes(RANDOM_ATTITUDES, rng))
    by_brightness = np.argsort(-dn[readable_stars], kind="stable")
    brightest = readable_stars[by_brightness][:POINTED_ATTITUDES]
    others = rng.normal(size=(len(brightest), 3))
    for boresight, other in zip(stars.directions(brightest), others, strict=True):
        right = np.cross(other, boresight)
        right /= np.linalg.norm(right)
        down = np.cross(boresight, right)
        attitudes.append(from_matrix(np.stack([right, down, boresight])))
    camera = tracker_camera(context.file.config.tracker, context.file.folder)
    margin = spot.radius_px + MIN_EDGE_PX
    vectors = stars.directions(readable_stars)
    counts = []
    for q in attitudes:
        in_cam = vectors @ to_matrix(q).T
        inside = _is_in_image(camera, in_cam, margin)
        inside &= _is_in_image(bench.camera, in_cam, MIN_EDGE_PX)
        counts.append(int(inside.sum()))
    fields: list[FloatArray] = []
    stars_shown = 0
    for k in np.argsort(-np.array(counts), kind="stable")[:MAX_FIELDS].tolist():
        if len(fields) < FIELDS or stars_shown < ENOUGH_STARS:
            fields.append(attitudes[k])
        stars_shown += counts[k]
    return fields


def _is_in_image(camera: Camera, in_cam: FloatArray, margin_px: float) -> npt.NDArray[np.bool_]:
    """Which directions (n, 3) in cam are in a camera's image, farther than a margin from its
    edge.
    """
    width, height = camera.resolution_px
    with np.errstate(invalid="ignore", over="ignore"):
        x, y = camera.project(in_cam @ camera.cam_to_image.T)
        across = (x > margin_px) & (x < width - margin_px)
        down = (y > margin_px) & (y < height - margin_px)
    return np.asarray(across & down)


def _alone(
    bench: Bench, context: StepContext, frame: Frame, levels: Sequence[Levels], spot: StarSpot
) -> ExpectedStars:
    """The isolated stars of a frame that are drawn whole, with their expected places in the
    tracker's image.
    """
    camera = tracker_camera(context.file.config.tracker, context.file.folder)
    truth = frame.rows
    vectors = bench.stars.directions(frame.star)
    in_cam = vectors @ to_matrix(frame.q_icrs_to_cam).T
    place = np.stack(camera.project(in_cam), axis=1)
    sizes_px = (camera.resolution_px, context.resolution_px)
    is_usable = stars_alone(truth, bench.stars.row[frame.star], place, sizes_px, spot)
    screen = np.stack([truth["x_px"], truth["y_px"]], axis=1)[is_usable]
    reach = spot.reach_on_screen(context.geometry())
    return ExpectedStars(
        hip=truth["hip"][is_usable],
        place_px=place[is_usable],
        e_per_s=np.asarray(truth["electrons_per_s"][is_usable], dtype=np.float64),
        screen=from_middle(screen, context.resolution_px),
        codes_mag=codes_mag(frame.linear, levels, bench.panel, screen, reach),
    )


def from_middle(screen_px: FloatArray, resolution_px: tuple[int, int]) -> FloatArray:
    """Places on the screen (n, 2) from its middle, -1 to 1 along each axis."""
    middle = (np.array(resolution_px) - 1) / 2
    return np.asarray((screen_px - middle) / middle)


def stars_alone(
    truth: npt.NDArray[np.void],
    catalogue_row: IntArray,
    place: FloatArray,
    sizes_px: tuple[tuple[int, int], tuple[int, int]],
    spot: StarSpot,
) -> npt.NDArray[np.bool_]:
    """Which stars of a frame (n,), of TRUTH_DTYPE, at places in the tracker's image (n, 2) are
    drawn whole, within the edges of tracker and screen, of these sizes, and beside no others.

    Planets have a row of -1 in the catalogue.
    """
    tracker_px, screen_px = sizes_px
    screen = np.stack([truth["x_px"], truth["y_px"]], axis=1)
    light = np.asarray(truth["electrons_per_s"], dtype=np.float64)
    edge_px = max(MIN_EDGE_PX, spot.radius_px + 2.0)
    is_usable = truth["drawn"] & ~truth["clipped"] & np.isfinite(place).all(axis=1)
    # No planets: their light is known to 0.05 mag only, and a disc may be wide.
    is_usable &= catalogue_row >= 0
    is_usable &= _is_inside(place, tracker_px, edge_px)
    is_usable &= _is_inside(screen, screen_px, MIN_EDGE_PX)
    finite = np.where(np.isfinite(place), place, -1e6)
    near = cKDTree(finite).query_ball_point(finite, ALONE_RADII * spot.radius_px + 2)
    beside = light.copy()
    for k in range(len(light)):
        beside[k] = light[near[k]].sum() - light[k]
    return np.asarray(is_usable & (beside < BESIDE_SHARE * light))


def _is_inside(
    places_px: FloatArray, resolution_px: tuple[int, int], margin_px: float
) -> npt.NDArray[np.bool_]:
    """Which places (n, 2) are over a margin within an image's outermost pixels."""
    last_px = np.array(resolution_px) - 1 - margin_px
    is_inside = (places_px > margin_px) & (places_px < last_px)
    return np.asarray(is_inside.all(axis=1))


def codes_mag(
    linear: Float32Array,
    levels: Sequence[Levels],
    panel: Panel,
    screen_px: FloatArray,
    reach: int,
) -> FloatArray:
    """How much fainter a panel's levels, in the mean of frames, are than the light asked for (h, w)
    about places on the screen (n, 2), magnitudes (n,): in windows that reach so many pixels to
    each side.
    """
    off_mag = []
    for x, y in np.rint(screen_px).astype(np.intp):
        rows = slice(max(y - reach, 0), y + reach + 1)
        columns = slice(max(x - reach, 0), x + reach + 1)
        part = (rows, columns)
        wanted = float(linear[part].sum(dtype=np.float64))
        # In the window alone: light of a whole 8K screen is 0.3 GB, and here were three of them.
        shown = np.mean([_light_in(of_frame, panel, part) for of_frame in levels])
        if wanted > 0:
            off_mag.append(magnitude(float(shown) / wanted))
        else:
            off_mag.append(0.0)
    # such a star is not shown, and will not be found
    return np.asarray(np.nan_to_num(np.array(off_mag), posinf=0.0))


def _light_in(levels: Levels, panel: Panel, part: tuple[slice, slice]) -> float:
    """The light of a part of an image's levels, electrons per second."""
    return float(shown_light(Levels(levels[part]), panel.in_part(part)).sum())


class ImageLimits(NamedTuple):
    """The exposure of an image, and the level at which the tracker saturates."""

    exposure_s: float
    full_dn: float


def compared(
    looked: Iterator[DarkSubtracted], wanted: ExpectedStars, spot: StarSpot, limits: ImageLimits
) -> StarsSeen:
    """The stars found in the mean of a field's images, against those that should be there."""
    first = next(looked)
    paths = [first.path]
    total = first.image
    for another in looked:
        paths.append(another.path)
        total = total + another.image
    images = len(paths)
    image = total / images
    background = noisiest_background(image, 1 / images)
    stars = find_stars(image, spot.settings, background)
    noise_dn = background.noise
    places_px = np.stack([stars.x_px, stars.y_px], axis=1)
    count = len(wanted.e_per_s)
    distance_px = np.full(count, np.inf)
    nearest = np.zeros(count, dtype=np.intp)
    if len(places_px) and count:
        distances, rows = cKDTree(places_px).query(wanted.place_px)
        distance_px = np.asarray(distances)
        nearest = np.asarray(rows)
    near = distance_px < max(MIN_REACH_PX, spot.mean_sigma_px)
    near_dn = stars.flux[nearest[near]] / spot.window_share
    expected_dn = wanted.e_per_s * limits.exposure_s / spot.gain_e_per_dn
    brighter = 1.0
    if near.sum() >= MIN_STARS:  # the screen may give more or less light than the bench file says
        brighter = float(np.median(near_dn / expected_dn[near]))
    matched = near.copy()
    matched[near] = spot.light_noise_mag(near_dn, noise_dn) < READ_MAG
    # A star is found by MIN_PIXELS: one of sigma 0.4 px in the middle of a pixel has a seventh of
    # that one's light in the next.
    second_dn = brighter * expected_dn * spot.second_share(wanted.place_px)
    is_lost = ~near & (second_dn > LOST_MARGIN * THRESHOLD_SIGMA * noise_dn)
    chosen = nearest[matched]
    dn = stars.flux[chosen] / spot.window_share
    shared = dataclasses.replace(spot, frames=images)
    noise_mag = shared.light_noise_mag(dn, noise_dn)
    window_dn = np.maximum(dn * spot.window_share, 1e-9)
    rounded = shared.rounded_dn(dn, noise_dn) / window_dn[:, None]
    residual_px = places_px[chosen] - wanted.place_px[matched]
    saturated = stars.peak[chosen] > MAX_FILL * limits.full_dn - first.floor_dn
    noise_mag = np.where(saturated, np.inf, noise_mag)
    return StarsSeen(
        hip=wanted.hip[matched],
        place_px=wanted.place_px[matched],
        residual_px=residual_px,
        place_noise_px=shared.place_noise_px(dn, noise_dn),
        dn=dn,
        e_per_s=wanted.e_per_s[matched],
        noise_mag=noise_mag,
        rounding_mag=MAG_PER_RELATIVE * rounded,
        screen=wanted.screen[matched],
        codes_mag=wanted.codes_mag[matched],
        lost=int(is_lost.sum()),
        frames=images,
        images=tuple(paths),
    )
