"""The noise of a tracker's stars by source, and the limits that it sets: detection, place, flux and
attitude.

Fisher's information of place, flux and background is the sum over pixels of slope times slope over
variance, with the noise of `DetectorSettings.noise` (thesis table 4.1, eq. 4.13, 4.14). Its inverse
is the Cramer-Rao bound, which no unbiased centroider beats (Winick 1986, JOSA A 3, 1809; of a whole
star sensor Fialho and Mortari 2019, Sensors 19, 5355). A star's noise is that of its flux under the
weights share / variance, which no other weights beat: its sources add up to n_TOT, and PSF
photometry reaches it. Pixels that clip tell nothing. Fixed patterns count as noise: all this holds
over places on the detector.
"""

import contextlib
import math
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import structs
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, ORANGE, chart, label_ends, two_digits, write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import normalise, random_attitudes, to_matrix
from hilstar.basics.units import ARCSEC_PER_RAD, flux_ratio
from hilstar.instruments.simulate.budget import SOLAR_BV, STEP_MAG, USUAL
from hilstar.instruments.simulate.simulator import TrackerBackground, full_e
from hilstar.optics.camera import Camera
from hilstar.optics.layers.truth import truth_table
from hilstar.optics.layers.view import STILL, View
from hilstar.optics.psf import Psf
from hilstar.server.bench.bench_file import BenchFile
from hilstar.server.bench.cameras import tracker_camera, tracker_psf
from hilstar.server.bench.star_light import bench_stars
from hilstar.server.bench.star_rates import star_flux, star_rates
from hilstar.sky.stars import Stars
from hilstar.tracker.centroiders import FAMILY, Centroider, star_places
from hilstar.tracker.centroids import CentroidSettings
from hilstar.tracker.detector import Detector
from hilstar.tracker.mosaic import (
    CHANNELS,
    SUPERPIXEL,
    in_pixels,
    of_colour,
    software_image,
    software_psf_px,
)
from hilstar.tracker.settings import DetectorSettings, PixelNoise

PHASES = 6  # along a side of a pixel
SLOPE_STEP_PX = 1e-3  # to either side of a place, for slopes
CHUNK = 64  # stars at once
UNSEEN = 0.01  # the probability of detection at which the table of magnitudes ends
MAX_ROWS, BETWEEN = 80, 5  # rows, and steps from one to the next by which stars are interpolated
# a star whose pixels all clip; a pixel without light
NO_INFORMATION = NO_NOISE_E2 = 1e-12
# simulated stars of a magnitude along a side of an image; found ones that give an error
TRIALS, MIN_FOUND = 20, 40
SKY_FIELDS = 100  # at random, of which medians are told
LIMIT_STEP_MAG = 0.25
TURN_RAD = 1e-6  # about each axis, for its slopes: 0.2 arcsec
NO_PLACE_PX = 1e3  # a star whose light never leaves one pixel, or is all clipped
MIN_STARS = 2  # for an attitude
# A pattern of four stars is what lost-in-space solvers look up (tetra3's and astrometry.net's).
IDENTIFIED = 4
HALF_FOUND = 0.5
ENOUGH_SHARE = 0.95  # of fields
SOURCES = ("shot", "background", "dark", "read", "reset", "quantisation", "prnu", "dsnu")
WHO = ("limit", *FAMILY)
NEA_COLUMNS = [f"{kind}_{way}_arcsec" for kind in WHO for way in ("across", "about")]
# V, B-V and V-I of one star of the Sun's colour, as `StarRates` takes them
SOLAR_STAR = np.array([[0.0], [SOLAR_BV], [np.nan]])
LISTED = ("hip", "name", "x_px", "y_px", "v_mag")  # columns of stars.csv before the noise

# Stars in noise, electrons of a whole star, rms over the places within a pixel. `detection` is the
# probability that the threshold finds it. `bound_px` is the Cramer-Rao bound of place along an axis
# (rms of x and y), flux unknown; `bound_flux_e` that of flux, place unknown, `bound_flux_sky_e`
# background unknown too. `effective_px` is how many pixels' read noise a star has, `clipped_px` how
# many pixels are left out because they clip.
BOUNDS_OF_PLACE = ("bound_x_px", "bound_y_px", "detection")
BOUND_COLUMNS = ("bound_px", "bound_x_px", "bound_y_px", "bound_flux_e", "bound_flux_sky_e")
NOISE_COLUMNS = (
    *(f"{source}_e" for source in SOURCES),
    *("total_e", "snr", "detection"),
    *BOUND_COLUMNS,
    *("star_e", "effective_px", "clipped_px"),
)
NOISE_DTYPE = np.dtype([(name, "f8") for name in NOISE_COLUMNS])
Table = npt.NDArray[np.void]


def in_mosaic(mosaic: FloatArray, bayer: str, shape: tuple[int, int]) -> FloatArray:
    """The shares of a star and of the background that a mosaic's pixels (2, h, w) collect, relative
    to the mean pixel, by the shares of red, green and blue (2, 3).
    """
    star, background = mosaic
    star_images = [np.full(shape, share) for share in star]
    background_images = [np.full(shape, share) for share in background]
    return np.stack([in_pixels(star_images, bayer), in_pixels(background_images, bayer)])


class NoisyStar:
    """A tracker's star at a grid of places within a pixel: its shares of light, their slopes, and
    the detector's noise.

    Of a `mosaic` (see `in_mosaic`) within its four pixels, of light of one colour.
    """

    def __init__(
        self,
        psf: Psf,
        detector: DetectorSettings,
        exposure_s: float,
        phases: int = PHASES,
        mosaic: FloatArray | None = None,
    ) -> None:
        self.psf = psf
        self.detector = detector
        self.exposure_s = exposure_s
        self.mosaic = mosaic
        self.side_px = max(psf.footprint_px | 1, 7)
        phase = (np.arange(phases) + 0.5) / phases - 0.5
        columns, rows = np.meshgrid(phase, phase)
        y_px = columns.ravel()
        x_px = rows.ravel()
        step = SLOPE_STEP_PX
        star_pattern, sky_pattern = self._patterns()
        stamps = self.stamps(x_px, y_px)
        change_x = self.stamps(x_px + step, y_px) - self.stamps(x_px - step, y_px)
        change_y = self.stamps(x_px, y_px + step) - self.stamps(x_px, y_px - step)
        slope_x = change_x / (2 * step)
        slope_y = change_y / (2 * step)
        count = phases**2 * len(star_pattern)
        star_pattern = star_pattern[:, None]
        self.shares = (star_pattern * stamps).reshape(count, -1)
        by_x = (star_pattern * slope_x).reshape(count, -1)
        by_y = (star_pattern * slope_y).reshape(count, -1)
        by_sky = sky_pattern[:, None] * np.ones_like(stamps)
        by_sky = by_sky.reshape(count, -1)
        self._sky = by_sky if mosaic is not None else np.ones((1, 1))
        # by x, y, flux, background; of one electron
        slopes = np.stack([by_x, by_y, self.shares, by_sky])
        pairs = np.einsum("ifp,jfp->fpij", slopes, slopes)
        self._pairs = pairs.reshape(count, -1, 16)

    def _patterns(self) -> FloatArray:
        """The shares of star and background of the pixels in a window, (2, n, side, side), for a
        star on each of the n pixels of a mosaic's pattern.
        """
        if self.mosaic is None or self.detector.bayer is None:
            return np.ones((2, 1, 1, 1))
        side = self.side_px
        whole = in_mosaic(self.mosaic, self.detector.bayer, (side + 1, side + 1))
        windows = []
        for y in (0, 1):
            for x in (0, 1):
                windows.append(whole[:, y : y + side, x : x + side])
        return np.stack(windows, axis=1)

    def _windows(self, values: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Values of pixels, broadcast to (n, phases, pixels), as windows (m, side, side)."""
        return np.broadcast_to(values, shape).reshape(-1, self.side_px, self.side_px)

    def stamps(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Shares (n, side, side) of stars so far (n,) from the middle of their square."""
        pixel = np.arange(self.side_px) - self.side_px // 2
        across_px = (pixel - x_px[:, None])[:, None, :]
        down_px = (pixel - y_px[:, None])[:, :, None]
        return np.asarray(self.psf.shares(across_px, down_px))

    def noise(
        self, star_e: FloatArray, background_e: FloatArray, finder: CentroidSettings
    ) -> Table:
        """Rows of NOISE_DTYPE of stars of `star_e` (n,) electrons before `background_e` (n,) in
        a pixel, in one exposure.
        """
        noise_rows = np.empty(len(star_e), NOISE_DTYPE)
        for begin in range(0, len(star_e), CHUNK):
            chunk = slice(begin, begin + CHUNK)
            star_chunk_e = star_e[chunk, None, None]
            background_chunk_e = background_e[chunk, None, None]
            self._fill(noise_rows[chunk], star_chunk_e, background_chunk_e, finder)
        return noise_rows

    def fisher(self, weight: FloatArray, star_e: FloatArray) -> FloatArray:
        """Information (n, phases, 4, 4) of x, y [px], flux and background [e-], of stars (n,
        1, 1) by 1 / pixels' variance.
        """
        by_phase = weight.transpose(1, 0, 2) @ self._pairs
        unit = by_phase.transpose(1, 0, 2).reshape(*weight.shape[:2], 4, 4)
        # slopes by place and not those by flux and background grow with the star
        per_e = np.ones_like(star_e)
        scale = np.concatenate([star_e, star_e, per_e, per_e], axis=-1)
        return np.asarray(unit * scale.transpose(0, 2, 1)[:, None] * scale[:, None])

    def _fill(
        self, rows: Table, star_e: FloatArray, background_e: FloatArray, finder: CentroidSettings
    ) -> None:
        """Fill rows (n,) of NOISE_DTYPE, of stars and backgrounds (n, 1, 1)."""
        shares = self.shares
        under_e = background_e * self._sky
        pixel_star_e = star_e * shares
        light_e = pixel_star_e + under_e
        noise = self.detector.noise(light_e, self.exposure_s)
        sky = self.detector.noise(under_e, self.exposure_s)
        unclipped = light_e + noise.dark_e2 <= full_e(self.detector)
        weight = unclipped / noise.total_e2
        by_flux = weight * shares
        by_flux /= np.maximum((by_flux * shares).sum(axis=-1, keepdims=True), NO_INFORMATION)
        squared = by_flux**2
        effective_px = squared.sum(axis=-1, keepdims=True)
        variances_e2 = {
            "shot": (squared * pixel_star_e).sum(axis=-1, keepdims=True),
            "background": (squared * under_e).sum(axis=-1, keepdims=True),
            "dark": effective_px * sky.dark_e2,
            "read": effective_px * sky.read_e2,
            "reset": effective_px * sky.reset_e2,
            "quantisation": effective_px * sky.quantisation_e2,
            "prnu": (squared * noise.prnu_e2).sum(axis=-1, keepdims=True),
            "dsnu": effective_px * sky.dsnu_e2,
        }
        for source, variance_e2 in variances_e2.items():
            rows[f"{source}_e"] = np.sqrt(variance_e2.mean(axis=(1, 2)))
        squares_e2 = [rows[f"{source}_e"] ** 2 for source in SOURCES]
        rows["total_e"] = np.sqrt(np.sum(squares_e2, axis=0))
        # Where one pixel is left, it cannot tell place from flux: a bound is then large, and not an
        # error.
        regular = NO_INFORMATION * np.eye(4)
        information = self.fisher(weight, star_e) * (1 + regular) + regular
        background_known = _bounds(information[..., :3, :3])
        background_free = _bounds(information)
        rows["bound_x_px"] = background_known[:, 0]
        rows["bound_y_px"] = background_known[:, 1]
        rows["bound_flux_e"] = background_known[:, 2]
        rows["bound_flux_sky_e"] = background_free[:, 2]
        both_px2 = rows["bound_x_px"] ** 2 + rows["bound_y_px"] ** 2
        rows["bound_px"] = np.sqrt(both_px2 / 2)
        rows["effective_px"] = effective_px.mean(axis=(1, 2))
        # somewhere within a pixel all pixels of them clip
        has_place = unclipped.any(axis=-1).all(axis=-1)
        rows[~has_place] = np.nan
        rows["star_e"] = star_e[:, 0, 0]
        rows["clipped_px"] = (~unclipped).sum(axis=-1).mean(axis=-1)
        total_e: FloatArray = rows["total_e"]
        rows["snr"] = star_e[:, 0, 0] / total_e
        above = self._above(star_e, under_e, (noise, sky), finder)
        rows["detection"] = found_share(above, finder.minimum_pixels)

    def _above(
        self,
        star_e: FloatArray,
        under_e: FloatArray,
        noises: "tuple[PixelNoise, PixelNoise]",
        finder: CentroidSettings,
    ) -> FloatArray:
        """The probability (n, phases, pixels) that a pixel is above the threshold, by its noise
        with a star and without.

        Noise of superpixels is that of their neighbours: of every second one along both axes, which
        tells the most.
        """
        noise, sky = noises
        if self.detector.takes_superpixels:
            return self._superpixels_above(star_e, noises, finder.threshold_sigma)
        # The first code over the threshold begins half a step below it, and rounding is no noise of
        # its own.
        step_e = self.detector.gain_e_per_dn
        level_dn = (under_e + sky.dark_e2) / step_e + self.detector.offset_dn
        threshold_dn = finder.threshold_sigma * np.sqrt(sky.total_e2) / step_e
        first_dn = np.floor(level_dn + threshold_dn) + 0.5
        sigma_e = np.sqrt(np.maximum(noise.total_e2 - step_e**2 / 12, NO_NOISE_E2))
        limit_e = (first_dn - level_dn) * step_e
        return np.asarray(ndtr((star_e * self.shares - limit_e) / sigma_e))

    def _superpixels_above(
        self,
        star_e: FloatArray,
        noises: "tuple[PixelNoise, PixelNoise]",
        threshold_sigma: float,
    ) -> FloatArray:
        """As `_above`, of superpixels: every second one along both axes, at whichever of the four
        places most probably finds the star.
        """
        noise, sky = noises
        shape = noise.total_e2.shape
        light_e = superpixels(self._windows(star_e * self.shares, shape))
        variance_e2 = superpixels(self._windows(noise.total_e2, shape), squared=True)
        dark_e2 = superpixels(self._windows(sky.total_e2, shape), squared=True)
        limit_e = threshold_sigma * np.sqrt(dark_e2.mean(axis=(1, 2), keepdims=True))
        above = ndtr((light_e - limit_e) / np.sqrt(variance_e2))
        above = np.pad(above, ((0, 0), (0, 1), (0, 1)))
        places = []
        for y in (0, 1):
            for x in (0, 1):
                places.append(above[:, y::2, x::2].reshape(len(above), -1))
        by_place = np.stack(places, axis=1)
        nothing_above = np.prod(1 - by_place, axis=2)
        best = by_place[np.arange(len(by_place)), nothing_above.argmin(axis=1)]
        return np.asarray(best.reshape(*shape[:2], -1))


def _bounds(information: FloatArray) -> FloatArray:
    """Cramer-Rao bounds (n, k) of k parameters, rms over phases, by information (n, phases, k,
    k).
    """
    variances = np.linalg.inv(information).diagonal(axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(variances.mean(axis=1)))


def superpixels(images: npt.NDArray[np.floating[Any]], *, squared: bool = False) -> FloatArray:
    """The luminance of images (n, h, w), or its variance by theirs."""
    from scipy.ndimage import correlate1d

    weights = SUPERPIXEL**2 if squared else SUPERPIXEL
    smooth = correlate1d(images, weights, axis=1)
    return np.asarray(correlate1d(smooth, weights, axis=2))


def found_share(above: FloatArray, minimum_pixels: int) -> FloatArray:
    """The probability (n,) that at least so many pixels of a star are above the threshold, mean
    over its phases.

    `above` (n, phases, pixels) are those of each pixel, whose noise is independent of the others'.
    """
    # the probabilities of 0, 1, ... pixels so far
    fewer = np.zeros((minimum_pixels, *above.shape[:2]))
    fewer[0] = 1.0
    for pixel in np.moveaxis(above, -1, 0):
        fewer[1:] = fewer[1:] * (1 - pixel) + fewer[:-1] * pixel
        fewer[0] *= 1 - pixel
    return np.asarray(1 - fewer.sum(axis=0).mean(axis=-1))


def measured_px(
    star: NoisyStar, star_e: float, sky_e: float, finder: CentroidSettings, rng: np.random.Generator
) -> FloatArray:
    """The rms error along an axis, px, that each kind of FAMILY has with simulated stars that the
    threshold finds; NaN for few.

    TRIALS^2 stars at random places within a pixel, through the detector with all its noise but hot
    and dead pixels. What all are off by in common is no error.
    """
    side = star.side_px
    shape = (TRIALS * star.side_px,) * 2
    plain = structs.replace(
        star.detector,
        blooming=False,
        hot_pixel_fraction=0.0,
        dead_pixel_fraction=0.0,
        dead_row_fraction=0.0,
        dead_column_fraction=0.0,
        false_stars=0,
        cosmic_rays_per_cm2_s=0.0,
    )
    device = Detector(plain, shape)
    place_px = rng.uniform(-0.5, 0.5, (2, TRIALS**2))
    stamps_e = star_e * star.stamps(*place_px)
    tiles_e = stamps_e.reshape(TRIALS, TRIALS, side, side)
    light_e = tiles_e.swapaxes(1, 2).reshape(shape)
    under_e = sky_e
    bayer = star.detector.bayer
    if star.mosaic is not None and bayer is not None:
        star_pattern, sky_pattern = in_mosaic(star.mosaic, bayer, shape)
        light_e = light_e * star_pattern
        under_e = sky_e * sky_pattern
    dn = device.expose(light_e + under_e, star.exposure_s, rng)
    noise = star.detector.noise(sky_e, star.exposure_s)
    exposed_e = (dn - star.detector.offset_dn) * star.detector.gain_e_per_dn
    measured_e = exposed_e - under_e - noise.dark_e2
    measured_tiles_e = measured_e.reshape(TRIALS, side, TRIALS, side).swapaxes(1, 2)
    stamps = measured_tiles_e.reshape(-1, side, side)
    threshold_e = finder.threshold_sigma * math.sqrt(noise.total_e2)
    if star.detector.takes_superpixels:
        stamps = superpixels(stamps)
        threshold_e *= float(np.sum(SUPERPIXEL**2))
    above = stamps > threshold_e
    is_detected = above.sum(axis=(1, 2)) >= finder.minimum_pixels
    if is_detected.sum() < MIN_FOUND:
        return np.full(len(FAMILY), np.nan)
    width_px = software_psf_px(star.psf.width_px, star.detector)
    errors_px = []
    for kind in FAMILY:
        centroids_px = np.stack(star_places(stamps[is_detected], kind, width_px))
        errors_px.append(centroids_px - place_px[:, is_detected])
    # an offset of all, as by coma, is the calibration's
    variance_px2 = np.var(errors_px, axis=2)
    return np.asarray(np.sqrt(variance_px2.mean(axis=1)))


def field_stars(stars: Stars, camera: Camera, q_icrs_to_cam: FloatArray) -> Table:
    """Rows of TRUTH_DTYPE of the stars on a detector, brightest first."""
    to_image = camera.cam_to_image @ to_matrix(q_icrs_to_cam)
    near = stars.near(to_image[2], camera.field_radius_rad(0.0))
    x_px, y_px = camera.project(stars.directions(near) @ to_image.T)
    inside = camera.contains_px(x_px, y_px)
    truth = truth_table(stars, near[inside], x_px[inside], y_px[inside])
    return truth[np.argsort(truth["v_mag"], kind="stable")]


def turns_of(camera: Camera, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
    """What turns about cam's x, y and z do to places (n,): (n, 2, 3), px/rad."""
    rays = normalise(camera.rays(x_px, y_px))
    turns = np.empty((len(x_px), 2, 3))
    for k, axis in enumerate(np.eye(3)):
        moved = TURN_RAD * np.cross(axis, rays)
        there_px = np.stack(camera.project((rays + moved) @ camera.cam_to_image.T))
        back_px = np.stack(camera.project((rays - moved) @ camera.cam_to_image.T))
        turns[:, :, k] = ((there_px - back_px) / (2 * TURN_RAD)).T
    return turns


def nea_arcsec(turns: FloatArray, sigma_px: FloatArray, detection: FloatArray) -> FloatArray:
    """NEA across (rms of both axes) and about the boresight (2, n) by the first 1, 2, ... n stars;
    infinite for too few.

    `turns` are as by `turns_of`, `sigma_px` (2, n) errors of places along x and y (NaN: not used),
    `detection` (n,) the share of exposures that has them.
    """
    weight = np.where(sigma_px < NO_PLACE_PX, detection / np.square(sigma_px), 0.0).T
    by_star = np.einsum("na,nai,naj->nij", weight, turns, turns)
    information = by_star.cumsum(axis=0)
    usable = weight.all(axis=1).cumsum() >= MIN_STARS
    # Two stars in one place leave the turn about them open: it comes out as large, and not as an
    # error.
    trace = np.trace(information, axis1=1, axis2=2)[:, None, None]
    information += NO_INFORMATION * trace * np.eye(3)
    nea = np.full((2, len(usable)), np.inf)
    covariance = np.linalg.inv(information[usable])
    x, y, z = covariance.diagonal(axis1=1, axis2=2).T
    across_and_about = np.sqrt([(x + y) / 2, z])
    nea[:, usable] = ARCSEC_PER_RAD * across_and_about
    return nea


@dataclass(frozen=True, slots=True)
class NoiseBudget:
    """The noise of a tracker's stars and its limits; the fields are the keys of the JSON object of
    `hilstar budget --noise`.

    `rows`, `stars` and `nea` are those of noise.csv, stars.csv and nea.csv, the last of one field
    or medians of several. `nea_arcsec` has its last row by who finds the stars: NEA across and
    about the boresight in one exposure. Half of the stars of `found_v_mag` are found; `found_stars`
    is how many a field has on average, the median over fields, and `identified_share` is the share
    of fields that have IDENTIFIED or more.
    """

    threshold_sigma: float
    minimum_pixels: int
    background_e_per_px: float
    centroider: Centroider
    fields: int
    rows: list[dict[str, Any]]
    stars: list[dict[str, Any]] | None
    nea: list[dict[str, Any]]
    nea_arcsec: dict[str, dict[str, float]]
    channels: dict[str, dict[str, float]]
    found_v_mag: float
    found_stars: float
    identified_share: float


def noisy_star(file: BenchFile, sky_e: FloatArray, channel: int | None = None) -> NoisyStar:
    """A star on a bench's tracker, of a mosaic one of the Sun's colour before a sky (h, w),
    whole or as a channel sees it.
    """
    tracker = file.config.tracker
    bayer = tracker.detector.bayer
    psf = tracker_psf(tracker, file.folder)
    if bayer is None:
        return NoisyStar(psf, tracker.detector, tracker.exposure_s)
    flux_e_per_s = star_flux(file.config, file.folder)(*SOLAR_STAR)[0]
    star_shares = flux_e_per_s / flux_e_per_s.sum()
    levels_e = []
    for name in CHANNELS:
        means_e = [sky_e[pixels].mean() for pixels in of_colour(bayer, name)]
        levels_e.append(np.mean(means_e))
    mosaic = np.array([star_shares, np.array(levels_e) / (sky_e.mean() or 1.0)])
    if channel is not None:
        others = np.arange(len(CHANNELS)) != channel
        mosaic[0, others] = 0.0
    return NoisyStar(psf, tracker.detector, tracker.exposure_s, mosaic=mosaic)


@dataclass(frozen=True, slots=True)
class _Fields:
    """Fields of the sky as a tracker at rest sees them: the `stars` of each, rows of TRUTH_DTYPE;
    its mean background, e- in a pixel; and the last one's background (h, w).
    """

    stars: list[Table]
    background_e: list[float]
    last_background_e: FloatArray


def _all_over_the_sky(
    file: BenchFile, stars: Stars, camera: Camera, rng: np.random.Generator
) -> _Fields:
    """SKY_FIELDS fields at random, less those that are too near the Sun: nobody looks there."""
    background = TrackerBackground(file.config, file.folder, camera)
    exposure_s = file.config.tracker.exposure_s
    sky_e = np.zeros((1, 1))
    fields = _Fields([], [], sky_e)
    for q in random_attitudes(SKY_FIELDS, rng):
        try:
            sky_e = background.of_view_e(View.exposure(q, STILL, exposure_s))
        except InputError:
            continue
        fields.background_e.append(float(sky_e.mean()))
        fields.stars.append(field_stars(stars, camera, q))
    return replace(fields, last_background_e=sky_e)


def _one_field(file: BenchFile, stars: Stars, camera: Camera, q_icrs_to_cam: FloatArray) -> _Fields:
    """The field at one attitude. Raises InputError near the Sun."""
    background = TrackerBackground(file.config, file.folder, camera)
    q = normalise(q_icrs_to_cam)
    sky_e = background.of_view_e(View.exposure(q, STILL, file.config.tracker.exposure_s))
    return _Fields([field_stars(stars, camera, q)], [float(sky_e.mean())], sky_e)


def _check_light(file: BenchFile, stars: Stars) -> None:
    """Raise InputError where no star gives the tracker light."""
    if not file.config.tracker.exposure_s:
        raise InputError("[tracker] exposure_s = 0: no light is collected; write a longer exposure")
    if not len(stars):
        raise InputError(
            f"[sky] faintest_v_mag = {file.config.sky.faintest_v_mag:g} leaves no star; write a"
            " larger magnitude"
        )


@dataclass(frozen=True, slots=True)
class _ByMagnitude:
    """Stars of the Sun's colour, from bright to faint, in one background: electrons of each,
    their noise, and the errors that centroiders reach.

    `shown` picks the rows of noise.csv, which end where detection does. `reached_px` (FAMILY, n)
    has errors along an axis of those rows.
    """

    star: NoisyStar
    v_mag: FloatArray
    star_e: FloatArray
    background_e: FloatArray
    noise: Table
    shown: slice
    reached_px: FloatArray

    def nea_curves_arcsec(
        self, turns: FloatArray, star_e: FloatArray, bounds: FloatArray
    ) -> FloatArray:
        """NEA (WHO, 2, n), arcsec, of a field's first 1, 2, ... n stars, by who finds them.

        `bounds` (3, n) are those of `between`.
        """
        detection = bounds[2]
        nea_by_finder = [nea_arcsec(turns, bounds[:2], detection)]
        for kind_px in self.reached_px:
            # what a centroider reaches is the same on both axes
            sigma_px = _at_rates(star_e, self.noise[self.shown], kind_px)
            nea_by_finder.append(nea_arcsec(turns, np.stack([sigma_px, sigma_px]), detection))
        return np.stack(nea_by_finder)


def _by_magnitude(
    file: BenchFile,
    fields: _Fields,
    brightest_v_mag: float,
    finder: CentroidSettings,
    rng: np.random.Generator,
) -> _ByMagnitude:
    """The table of magnitudes, from the brightest star on, in the fields' median background."""
    background_e = float(np.median(fields.background_e))
    star = noisy_star(file, fields.last_background_e)
    first_mag = math.floor(brightest_v_mag / STEP_MAG) * STEP_MAG
    v_mag = first_mag + STEP_MAG / BETWEEN * np.arange(MAX_ROWS * BETWEEN + 1.0)
    zero_e_per_s = float(star_rates(file.config, file.folder)(*SOLAR_STAR)[0])
    star_e = zero_e_per_s * file.config.tracker.exposure_s * flux_ratio(v_mag)
    under_e = np.full(len(v_mag), background_e)
    noise = star.noise(star_e, under_e, finder)
    shown = _until_unseen(noise["detection"])
    reached_px = _measured_by_rate(star, noise["star_e"][shown], background_e, finder, rng)
    return _ByMagnitude(star, v_mag, star_e, under_e, noise, shown, reached_px)


def _until_unseen(detection: FloatArray) -> slice:
    """The stars of a table's rows, of all by their falling probability (n,): to the first row that
    is hardly detected.
    """
    detectable = detection[::BETWEEN] >= UNSEEN
    return slice(0, int(detectable.sum()) * BETWEEN + 1, BETWEEN)


def _by_channel(
    file: BenchFile, sky_e: FloatArray, table: _ByMagnitude, finder: CentroidSettings
) -> tuple[dict[str, FloatArray], dict[str, dict[str, float]]]:
    """The S/N of the shown stars in each channel of a mosaic, by column of noise.csv, and each
    channel's share of a star and background; both empty without a mosaic.
    """
    snr_columns: dict[str, FloatArray] = {}
    channels: dict[str, dict[str, float]] = {}
    mosaic = table.star.mosaic
    if mosaic is None:
        return snr_columns, channels
    star_e = table.star_e[table.shown]
    background_e = table.background_e[table.shown]
    for number, (name, share, sky) in enumerate(zip(CHANNELS, *mosaic, strict=True)):
        alone = noisy_star(file, sky_e, number).noise(star_e, background_e, finder)
        snr_columns[f"snr_{name}"] = alone["snr"]
        channels[name] = {
            "star_share": float(share),
            "background_e_per_px": float(sky * background_e[0]),
        }
    return snr_columns, channels


def noise_budget(
    file: BenchFile,
    q_icrs_to_cam: FloatArray | None,
    finder: CentroidSettings,
    rng: np.random.Generator,
) -> NoiseBudget:
    """The noise of a bench's tracker at rest and its limits, in one field or, without an attitude,
    all over the sky.

    Magnitudes are those of stars of the Sun's colour; simulated stars and fields come from `rng`.
    Raises InputError.
    """
    config = file.config
    tracker = file.config.tracker
    camera = tracker_camera(tracker, file.folder)
    stars = bench_stars(config, file.folder)
    _check_light(file, stars)
    brightest_v_mag = float(stars.v_mag.min())
    if q_icrs_to_cam is None:
        fields = _all_over_the_sky(file, stars, camera, rng)
    else:
        fields = _one_field(file, stars, camera, q_icrs_to_cam)
        if len(fields.stars[0]):
            brightest_v_mag = float(fields.stars[0]["v_mag"].min())
    sky_e = fields.last_background_e
    table = _by_magnitude(file, fields, brightest_v_mag, finder, rng)
    noise = table.noise
    snr_columns, channels = _by_channel(file, sky_e, table, finder)
    reached = {
        f"{kind}_px": sigma_px for kind, sigma_px in zip(FAMILY, table.reached_px, strict=True)
    }
    listed = None
    counts: list[float] = []  # stars that are found in a field, on average
    curves: list[FloatArray] = []  # NEA of each field by who finds its stars: (WHO, 2, n)
    for field in fields.stars:
        star_e = field["electrons_per_s"] * tracker.exposure_s
        bounds = between(noise, star_e)
        if q_icrs_to_cam is not None:
            image_e = software_image(sky_e, tracker.detector)
            field_noise = table.star.noise(star_e, _at_stars(image_e, field), finder)
            bounds = np.stack([field_noise[name] for name in BOUNDS_OF_PLACE])
            listed = _rows({name: field[name] for name in LISTED}, field_noise, {})
        counts.append(float(bounds[2].sum()))
        turns = turns_of(camera, field["x_px"], field["y_px"])
        curves.append(table.nea_curves_arcsec(turns, star_e, bounds))
    faintest_star_mag = math.ceil(stars.v_mag.max() / LIMIT_STEP_MAG) * LIMIT_STEP_MAG
    nea = _nea_rows(fields.stars, curves, min(config.sky.faintest_v_mag, faintest_star_mag))
    return NoiseBudget(
        threshold_sigma=finder.threshold_sigma,
        minimum_pixels=finder.minimum_pixels,
        background_e_per_px=float(table.background_e[0]),
        centroider=config.verify.judge or USUAL,
        fields=len(fields.stars),
        rows=_rows({"v_mag": table.v_mag[table.shown]}, noise[table.shown], reached | snr_columns),
        stars=listed,
        nea=nea,
        nea_arcsec=_by_way(nea[-1]),
        channels=channels,
        found_v_mag=float(np.interp(-HALF_FOUND, -noise["detection"], table.v_mag)),
        found_stars=float(np.median(counts)),
        identified_share=float(np.mean(np.array(counts) >= IDENTIFIED)),
    )


def _measured_by_rate(
    star: NoisyStar,
    stars_e: FloatArray,
    sky_e: float,
    finder: CentroidSettings,
    rng: np.random.Generator,
) -> FloatArray:
    """The errors of `measured_px` (FAMILY, n), px, of stars of `stars_e` (n,) electrons."""
    trials_px = []
    for star_e in stars_e.tolist():
        trials_px.append(measured_px(star, star_e, sky_e, finder, rng))
    return np.array(trials_px).T


def _at_stars(image: FloatArray, field: Table) -> FloatArray:
    """The pixels (n,) of an image that stars of a field lie in."""
    places_px = np.stack([field["y_px"], field["x_px"]])
    rows, columns = np.ceil(places_px - 0.5).astype(np.intp)
    return np.asarray(image[rows, columns])


def _at_rates(star_e: FloatArray, noise: Table, values: FloatArray) -> FloatArray:
    """A figure of the rows of a table at other stars' electrons (n,)."""
    at = -np.log(star_e)
    return np.interp(at, -np.log(noise["star_e"]), values)


def _by_way(nea_row: Mapping[str, Any]) -> dict[str, dict[str, float]]:
    """The NEA of a row across and about the boresight, arcsec, by WHO finds the stars."""
    by_way = {}
    for kind in WHO:
        across, about = nea_row[f"{kind}_across_arcsec"], nea_row[f"{kind}_about_arcsec"]
        by_way[kind] = {"across": across, "about": about}
    return by_way


def attitude_limits_arcsec(file: BenchFile, q_icrs_to_cam: FloatArray) -> FloatArray:
    """NEA across and about the boresight (n, 2) that a bench's tracker at rest allows at attitudes
    (n, 4), by all its stars.

    Infinite with too few stars, and nearer to the Sun than its zodiacal light is known. Raises
    InputError.
    """
    tracker = file.config.tracker
    camera = tracker_camera(tracker, file.folder)
    stars = bench_stars(file.config, file.folder)
    background = TrackerBackground(file.config, file.folder, camera)
    star = None
    limits_arcsec = np.full((len(q_icrs_to_cam), 2), np.inf)
    for k, q in enumerate(q_icrs_to_cam):
        field = field_stars(stars, camera, q)
        with contextlib.suppress(InputError):
            sky_e = background.of_view_e(View.exposure(q, STILL, tracker.exposure_s))
            star = star or noisy_star(file, sky_e)
            star_e = field["electrons_per_s"] * tracker.exposure_s
            under_e = np.full(len(field), float(sky_e.mean()))
            noise = star.noise(star_e, under_e, CentroidSettings())
            bounds_px = np.stack([noise["bound_x_px"], noise["bound_y_px"]])
            turns = turns_of(camera, field["x_px"], field["y_px"])
            nea = nea_arcsec(turns, bounds_px, noise["detection"])
            if nea.size:
                limits_arcsec[k] = nea[:, -1]
    return limits_arcsec


def between(noise: Table, star_e: FloatArray) -> FloatArray:
    """Bounds of x and y [px] and the probability of detection of other stars (n,), (3, n),
    between those of a table.
    """
    grid: FloatArray = -np.log(noise["star_e"])
    at = -np.log(star_e)
    bounds = []
    for name in ("bound_x_px", "bound_y_px"):
        bound_px: FloatArray = noise[name]
        bounds.append(np.exp(np.interp(at, grid, np.log(bound_px))))
    detection: FloatArray = noise["detection"]
    return np.stack([*bounds, np.interp(at, grid, detection)])


def _rows(before: dict[str, Any], noise: Table, after: dict[str, Any]) -> list[dict[str, Any]]:
    """Rows of a table: columns `before`, those of the noise, and columns `after`."""
    columns = dict(before)
    for name in NOISE_COLUMNS:
        columns[name] = noise[name]
    columns |= after
    lists = [column.tolist() for column in columns.values()]
    rows = []
    for values in zip(*lists, strict=True):
        rows.append(dict(zip(columns, values, strict=True)))
    return rows


def _nea_rows(
    fields: list[Table], curves: list[FloatArray], faintest_v_mag: float
) -> list[dict[str, Any]]:
    """Medians over fields by the faintest star used, from the first limit at which half of the
    fields have an attitude.
    """
    brightest = min(field["v_mag"].min(initial=faintest_v_mag) for field in fields)
    first = math.ceil(brightest / LIMIT_STEP_MAG) * LIMIT_STEP_MAG
    limits = np.arange(first, faintest_v_mag, LIMIT_STEP_MAG)
    none = np.full((len(WHO), 2), np.inf)
    rows = []
    for limit in [*limits.tolist(), faintest_v_mag]:
        counts = []
        at_limit = []
        for field, curve in zip(fields, curves, strict=True):
            v_mag: FloatArray = field["v_mag"]
            count = int(np.searchsorted(v_mag, limit, side="right"))
            counts.append(count)
            at_limit.append(curve[..., count - 1] if count else none)
        median = np.median(at_limit, axis=0).ravel().tolist()
        row = {"v_mag": limit, "stars": float(np.median(counts))}
        rows.append(row | dict(zip(NEA_COLUMNS, median, strict=True)))
    for first_row, row in enumerate(rows):
        if math.isfinite(row["limit_about_arcsec"]):
            return rows[first_row:]
    return rows[-1:]


def write_noise(directory: Path, budget: NoiseBudget) -> None:
    """noise.csv, nea.csv and their charts, and stars.csv of a field. Raises InputError where one
    cannot be written.
    """
    for name, rows in (("noise", budget.rows), ("nea", budget.nea), ("stars", budget.stars)):
        if rows:
            cells = [list(map(_cell, row.values())) for row in rows]
            write_csv(directory / f"{name}.csv", list(rows[0]), cells)
    if math.isfinite(budget.nea_arcsec["limit"]["about"]):
        _draw(directory / "nea", budget)


def _cell(value: object) -> object:
    """A value of a table, "" for a number that is not finite."""
    if isinstance(value, float) and not math.isfinite(value):
        return ""
    return value


def _draw(path: Path, budget: NoiseBudget) -> None:
    centroider = budget.centroider
    limit = " and ".join(map(two_digits, budget.nea_arcsec["limit"].values()))
    reached = " and ".join(map(two_digits, budget.nea_arcsec[centroider].values()))
    finding = (
        f"Stars to V = {budget.nea[-1]['v_mag']:g} allow {limit} arcsec across and about the"
        f" boresight; {centroider} reaches {reached}"
    )
    if budget.fields == 1:
        where = "the field"
    else:
        where = f"{budget.fields} fields all over the sky, median"
    note = (
        f"One exposure at rest, with all noise; {where}. Lines: Cramer-Rao bound; dashes: simulated"
        f" {centroider}."
    )
    with chart(path, finding, 1, 2, note=note, share_x=False, share_y=True) as panels:
        by_magnitude, by_stars = panels
        for axes, key in ((by_magnitude, "v_mag"), (by_stars, "stars")):
            # the last one of a number of stars
            rows = list({row[key]: row for row in budget.nea}.values())
            places = [row[key] for row in rows]
            for way, colour in (("about", ORANGE), ("across", BLUE)):
                for kind, style in ((centroider, "--"), ("limit", "-")):
                    values = [row[f"{kind}_{way}_arcsec"] for row in rows]
                    name = f"{way}, {kind}" if key == "stars" else "_"
                    axes.semilogy(places, values, style, color=colour, label=name)
        by_magnitude.set_xlabel("faintest V [mag]")
        by_magnitude.set_ylabel("NEA [arcsec]")
        by_stars.set_xlabel("stars")
        by_stars.set_xscale("log")
        label_ends(by_stars)


def sensitivity_line(budget: NoiseBudget) -> str:
    """Whether the tracker is sensitive enough: what it finds, and how often it can identify it."""
    enough = "sensitive enough" if budget.identified_share >= ENOUGH_SHARE else "not enough"
    field = "the field" if budget.fields == 1 else f"a field (median of {budget.fields})"
    fields = f"{IDENTIFIED} or more in {budget.identified_share:.0%} of fields"
    return (
        f"{enough}: half of the stars of V = {budget.found_v_mag:.1f} are found,"
        f" {budget.found_stars:.3g} stars in {field}, {fields}"
    )


def noise_lines(budget: NoiseBudget) -> Iterator[str]:
    """The budget for a person."""
    centroider = budget.centroider
    threshold = f"{budget.minimum_pixels} px above {budget.threshold_sigma:g} sigma"
    yield (
        f"{'found':22}{threshold} of a background of {budget.background_e_per_px:.4g} e- in a pixel"
    )
    for name, channel_noise in budget.channels.items():
        figures = (
            f"{channel_noise['star_share']:.1%} of a star of the Sun's colour, background"
            f" {channel_noise['background_e_per_px']:.4g} e-"
        )
        yield f"{'pixels of ' + name:22}{figures}"
    for kind, nea in budget.nea_arcsec.items():
        nea_text = f"{nea['across']:.3g} arcsec across, {nea['about']:.3g} about the boresight"
        if not math.isfinite(nea["about"]):
            nea_text = f"none: fewer than {MIN_STARS} stars with a place"
        yield f"{'NEA, ' + kind:22}{nea_text}"
    yield ""
    channel_titles = "".join(f"{'SNR ' + name:>8}" for name in budget.channels)
    sums = f"{'V':>6}{'star e-':>12}{'noise e-':>11}{'SNR':>8}"
    yield f"{sums}{channel_titles}{'detection':>11}{'bound px':>10}{centroider + ' px':>12}"
    for row in budget.rows:
        line = f"{row['v_mag']:6.1f}{row['star_e']:12.4g}{row['total_e']:11.4g}{row['snr']:8.1f}"
        for name in budget.channels:
            line += f"{row[f'snr_{name}']:8.1f}"
        line += f"{row['detection']:11.4f}{row['bound_px']:10.4g}"
        reached_px = row[f"{centroider}_px"]
        reached_text = "-" if math.isnan(reached_px) else f"{reached_px:.4f}"
        yield f"{line}{reached_text:>12}"
