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
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import structs
from scipy.special import ndtr

from hilstar.basics.arrays import FloatArray
from hilstar.basics.charts import BLUE, ORANGE, chart, label_ends, two_digits, write_csv
from hilstar.basics.errors import InputError
from hilstar.basics.rotation import normalise, to_matrix
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
SLOPE_STEP_PX = 1e-3
CHUNK = 64  # stars at once
UNSEEN = 0.01  # the probability of detection at which the table of magnitudes ends
MAX_ROWS, BETWEEN = 80, 5  # rows, and steps from one to the next by which stars are interpolated
NO_INFORMATION = NO_NOISE_E2 = 1e-12  # a star whose pixels all clip; a pixel without light
# simulated stars of a magnitude along a side of an image; found ones that give an error
TRIALS, MIN_FOUND = 20, 40
SKY_FIELDS = 100
LIMIT_STEP_MAG = 0.25
TURN_RAD = 1e-6
NO_PLACE_PX = 1e3  # a star whose light never leaves one pixel, or is all clipped
MIN_STARS = 2  # for an attitude
# A pattern of four stars is what lost-in-space solvers look up (tetra3's and astrometry.net's).
IDENTIFIED = 4
HALF_FOUND = 0.5
ENOUGH_SHARE = 0.95  # of fields
SOURCES = ("shot", "background", "dark", "read", "reset", "quantisation", "prnu", "dsnu")
WHO = ("limit", *FAMILY)
NEA_COLUMNS = [f"{kind}_{way}_arcsec" for kind in WHO for way in ("across", "about")]

# Stars in noise, electrons of a whole star, rms over the places within a pixel. `detection` is the
# probability that the threshold finds it. `bound_px` is the Cramer-Rao bound of place along an axis
# (rms of x and y), flux unknown; `bound_flux_e` that of flux, place unknown, `bound_flux_sky_e`
# background unknown too. `effective_px` is how many pixels' read noise a star has, `clipped_px` how
# many pixels are left out because they clip.
NOISE_DTYPE = np.dtype(
    [(f"{source}_e", "f8") for source in SOURCES]
    + [
        (name, "f8")
        for name in ("total_e", "snr", "detection", "bound_px", "bound_x_px", "bound_y_px")
    ]
    + [
        (name, "f8")
        for name in ("bound_flux_e", "bound_flux_sky_e", "star_e", "effective_px", "clipped_px")
    ]
)
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
        y_px, x_px = (grid.ravel() for grid in np.meshgrid(phase, phase))
        step = SLOPE_STEP_PX
        star_pattern, sky = self._patterns()
        stamps = self.stamps(x_px, y_px)
        slope_x = (self.stamps(x_px + step, y_px) - self.stamps(x_px - step, y_px)) / (2 * step)
        slope_y = (self.stamps(x_px, y_px + step) - self.stamps(x_px, y_px - step)) / (2 * step)
        count = phases**2 * len(star_pattern)
        self.shares = (star_pattern[:, None] * stamps).reshape(count, -1)
        by_x = (star_pattern[:, None] * slope_x).reshape(count, -1)
        by_y = (star_pattern[:, None] * slope_y).reshape(count, -1)
        by_sky = (sky[:, None] * np.ones_like(stamps)).reshape(count, -1)
        self._sky = by_sky if mosaic is not None else np.ones((1, 1))
        # by x, y, flux, background; of one electron
        by = np.stack([by_x, by_y, self.shares, by_sky])
        self._pairs = np.einsum("ifp,jfp->fpij", by, by).reshape(count, -1, 16)

    def _patterns(self) -> FloatArray:
        """The shares of star and background of the pixels in a window, (2, n, side, side), for a
        star on each of the n pixels of a mosaic's pattern.
        """
        if self.mosaic is None or self.detector.bayer is None:
            return np.ones((2, 1, 1, 1))
        side = self.side_px
        whole = in_mosaic(self.mosaic, self.detector.bayer, (side + 1, side + 1))
        return np.stack(
            [whole[:, y : y + side, x : x + side] for y in (0, 1) for x in (0, 1)], axis=1
        )

    def _windows(self, values: FloatArray, shape: tuple[int, ...]) -> FloatArray:
        """Values of pixels, broadcast to (n, phases, pixels), as windows (m, side, side)."""
        return np.broadcast_to(values, shape).reshape(-1, self.side_px, self.side_px)

    def stamps(self, x_px: FloatArray, y_px: FloatArray) -> FloatArray:
        """Shares (n, side, side) of stars so far (n,) from the middle of their square."""
        at = np.arange(self.side_px) - self.side_px // 2
        return np.asarray(
            self.psf.shares((at - x_px[:, None])[:, None, :], (at - y_px[:, None])[:, :, None])
        )

    def noise(
        self, star_e: FloatArray, background_e: FloatArray, finder: CentroidSettings
    ) -> Table:
        """Rows of NOISE_DTYPE of stars of `star_e` (n,) electrons before `background_e` (n,) in
        a pixel, in one exposure.
        """
        noise_rows = np.empty(len(star_e), NOISE_DTYPE)
        for at in range(0, len(star_e), CHUNK):
            part = slice(at, at + CHUNK)
            self._fill(
                noise_rows[part], star_e[part, None, None], background_e[part, None, None], finder
            )
        return noise_rows

    def fisher(self, weight: FloatArray, star_e: FloatArray) -> FloatArray:
        """Information (n, phases, 4, 4) of x, y [px], flux and background [e-], of stars (n,
        1, 1) by 1 / pixels' variance.
        """
        unit = (
            (weight.transpose(1, 0, 2) @ self._pairs)
            .transpose(1, 0, 2)
            .reshape(*weight.shape[:2], 4, 4)
        )
        scale = np.concatenate(
            [star_e, star_e, np.ones_like(star_e), np.ones_like(star_e)], axis=-1
        )
        return np.asarray(unit * scale.transpose(0, 2, 1)[:, None] * scale[:, None])

    def _fill(
        self, found: Table, star_e: FloatArray, background_e: FloatArray, finder: CentroidSettings
    ) -> None:
        shares = self.shares
        under_e = background_e * self._sky
        light_e = star_e * shares + under_e
        noise, sky = (self.detector.noise(light, self.exposure_s) for light in (light_e, under_e))
        unclipped = light_e + noise.dark_e2 <= full_e(self.detector)
        weight = unclipped / noise.total_e2
        by_flux = weight * shares
        by_flux /= np.maximum((by_flux * shares).sum(axis=-1, keepdims=True), NO_INFORMATION)
        squared = by_flux**2
        effective_px = squared.sum(axis=-1, keepdims=True)
        even = (sky.dark_e2, sky.read_e2, sky.reset_e2, sky.quantisation_e2)
        shot, background, prnu = (
            (squared * e2).sum(axis=-1, keepdims=True)
            for e2 in (star_e * shares, under_e, noise.prnu_e2)
        )
        variances = (
            shot,
            background,
            *(effective_px * e2 for e2 in even),
            prnu,
            effective_px * sky.dsnu_e2,
        )
        for source, e2 in zip(SOURCES, variances, strict=True):
            found[f"{source}_e"] = np.sqrt(e2.mean(axis=(1, 2)))
        found["total_e"] = np.sqrt(
            np.sum([found[f"{source}_e"] ** 2 for source in SOURCES], axis=0)
        )
        # Where one pixel is left, it cannot tell place from flux: a bound is then large, and not an
        # error.
        information = self.fisher(weight, star_e) * (
            1 + NO_INFORMATION * np.eye(4)
        ) + NO_INFORMATION * np.eye(4)
        known, free = (
            np.sqrt(
                np.linalg.inv(information[..., :size, :size])
                .diagonal(axis1=-2, axis2=-1)
                .mean(axis=1)
            )
            for size in (3, 4)
        )
        for name, light in zip(
            ("x_px", "y_px", "flux_e", "flux_sky_e"), (*known.T, free[:, 2]), strict=True
        ):
            found[f"bound_{name}"] = light
        found["bound_px"] = np.sqrt((found["bound_x_px"] ** 2 + found["bound_y_px"] ** 2) / 2)
        found["effective_px"] = effective_px.mean(axis=(1, 2))
        # somewhere within a pixel nothing is left of them
        found[~unclipped.any(axis=-1).all(axis=-1)] = np.nan
        found["star_e"], found["clipped_px"] = (
            star_e[:, 0, 0],
            (~unclipped).sum(axis=-1).mean(axis=-1),
        )
        found["snr"] = found["star_e"] / found["total_e"]
        found["detection"] = found_share(
            self._above(star_e, under_e, (noise, sky), finder), finder.minimum_pixels
        )

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
            shape = noise.total_e2.shape
            light = superpixels(self._windows(star_e * self.shares, shape))
            variance = superpixels(self._windows(noise.total_e2, shape), squared=True)
            dark = superpixels(self._windows(sky.total_e2, shape), squared=True)
            limit_e = finder.threshold_sigma * np.sqrt(dark.mean(axis=(1, 2), keepdims=True))
            above = np.pad(ndtr((light - limit_e) / np.sqrt(variance)), ((0, 0), (0, 1), (0, 1)))
            by_place = np.stack(
                [above[:, y::2, x::2].reshape(len(above), -1) for y in (0, 1) for x in (0, 1)],
                axis=1,
            )
            best = by_place[np.arange(len(by_place)), np.prod(1 - by_place, axis=2).argmin(axis=1)]
            return np.asarray(best.reshape(*noise.total_e2.shape[:2], -1))
        # The first code over the threshold begins half a step below it, and rounding is no noise of
        # its own.
        step_e = self.detector.gain_e_per_dn
        level_dn = (under_e + sky.dark_e2) / step_e + self.detector.offset_dn
        first_dn = (
            np.floor(level_dn + finder.threshold_sigma * np.sqrt(sky.total_e2) / step_e) + 0.5
        )
        sigma_e = np.sqrt(np.maximum(noise.total_e2 - step_e**2 / 12, NO_NOISE_E2))
        return np.asarray(ndtr((star_e * self.shares - (first_dn - level_dn) * step_e) / sigma_e))


def superpixels(images: npt.NDArray[np.floating[Any]], *, squared: bool = False) -> FloatArray:
    """The luminance of images (n, h, w), or its variance by theirs."""
    from scipy.ndimage import correlate1d

    weights = SUPERPIXEL**2 if squared else SUPERPIXEL
    return np.asarray(correlate1d(correlate1d(images, weights, axis=1), weights, axis=2))


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
    plain = {
        "hot_pixel_fraction": 0.0,
        "dead_pixel_fraction": 0.0,
        "false_stars": 0,
        "cosmic_rays_per_cm2_s": 0.0,
    }
    device = Detector(structs.replace(star.detector, blooming=False, **plain), shape)
    place_px = rng.uniform(-0.5, 0.5, (2, TRIALS**2))
    light_e = (
        (star_e * star.stamps(*place_px))
        .reshape(TRIALS, TRIALS, side, side)
        .swapaxes(1, 2)
        .reshape(shape)
    )
    under_e = sky_e
    bayer = star.detector.bayer
    superpixel = star.detector.takes_superpixels
    if star.mosaic is not None and bayer is not None:
        star_pattern, sky = in_mosaic(star.mosaic, bayer, shape)
        light_e = light_e * star_pattern
        under_e = sky_e * sky
    dn = device.expose(light_e + under_e, star.exposure_s, rng)
    noise = star.detector.noise(sky_e, star.exposure_s)
    seen_e = (dn - star.detector.offset_dn) * star.detector.gain_e_per_dn - under_e - noise.dark_e2
    stamps = seen_e.reshape(TRIALS, side, TRIALS, side).swapaxes(1, 2).reshape(-1, side, side)
    stamps = superpixels(stamps) if superpixel else stamps
    threshold_e = (
        finder.threshold_sigma
        * math.sqrt(noise.total_e2)
        * (float(np.sum(SUPERPIXEL**2)) if superpixel else 1.0)
    )
    above = stamps > threshold_e
    is_detected = above.sum(axis=(1, 2)) >= finder.minimum_pixels
    if is_detected.sum() < MIN_FOUND:
        return np.full(len(FAMILY), np.nan)
    width_px = software_psf_px(star.psf.width_px, star.detector)
    off = []
    for kind in FAMILY:
        off.append(
            np.stack(star_places(stamps[is_detected], kind, width_px)) - place_px[:, is_detected]
        )
    # an offset of all, as by coma, is the calibration's
    return np.asarray(np.sqrt(np.var(off, axis=2).mean(axis=1)))


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
        there, back = (
            np.stack(camera.project((rays + way * moved) @ camera.cam_to_image.T))
            for way in (1, -1)
        )
        turns[:, :, k] = ((there - back) / (2 * TURN_RAD)).T
    return turns


def nea_arcsec(turns: FloatArray, sigma_px: FloatArray, detection: FloatArray) -> FloatArray:
    """NEA across (rms of both axes) and about the boresight (2, n) by the first 1, 2, ... n stars;
    infinite for too few.

    `turns` are as by `turns_of`, `sigma_px` (2, n) errors of places along x and y (NaN: not used),
    `detection` (n,) the share of exposures that has them.
    """
    weight = np.where(sigma_px < NO_PLACE_PX, detection / np.square(sigma_px), 0.0).T
    information = np.einsum("na,nai,naj->nij", weight, turns, turns).cumsum(axis=0)
    usable = weight.all(axis=1).cumsum() >= MIN_STARS
    # Two stars in one place leave the turn about them open: it comes out as large, and not as an
    # error.
    information += (
        NO_INFORMATION * np.trace(information, axis1=1, axis2=2)[:, None, None] * np.eye(3)
    )
    nea = np.full((2, len(usable)), np.inf)
    x, y, z = np.linalg.inv(information[usable]).diagonal(axis1=1, axis2=2).T
    nea[:, usable] = ARCSEC_PER_RAD * np.sqrt([(x + y) / 2, z])
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
    mosaic = None
    bayer = file.config.tracker.detector.bayer
    if bayer is not None:
        of_star = star_flux(file.config, file.folder)(*np.array([[0.0], [SOLAR_BV], [np.nan]]))[0]
        levels = []
        for one in CHANNELS:
            levels.append(np.mean([sky_e[part].mean() for part in of_colour(bayer, one)]))
        mosaic = np.array([of_star / of_star.sum(), np.array(levels) / (sky_e.mean() or 1.0)])
        mosaic[0, [k for k in range(len(CHANNELS)) if channel not in (None, k)]] = 0.0
    return NoisyStar(
        tracker_psf(tracker, file.folder), tracker.detector, tracker.exposure_s, mosaic=mosaic
    )


def _check_light(file: BenchFile, stars: Stars) -> None:
    """Raise InputError where no star gives the tracker light."""
    if not file.config.tracker.exposure_s:
        raise InputError("[tracker] exposure_s = 0: no light is collected; write a longer exposure")
    if not len(stars):
        raise InputError(
            f"[sky] faintest_v_mag = {file.config.sky.faintest_v_mag:g} leaves no star; write a"
            " larger magnitude"
        )


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
    background = TrackerBackground(config, file.folder, camera)
    sights = []
    levels_e = []
    for q in rng.standard_normal((SKY_FIELDS, 4)) if q_icrs_to_cam is None else q_icrs_to_cam[None]:
        try:
            sky_e = background.of_view_e(View.exposure(normalise(q), STILL, tracker.exposure_s))
        except InputError:  # too near the Sun: nobody looks there
            if q_icrs_to_cam is not None:
                raise
            continue
        levels_e.append(float(sky_e.mean()))
        sights.append(field_stars(stars, camera, normalise(q)))
    middle_e = float(np.median(levels_e))
    star = noisy_star(file, sky_e)
    brightest = float(
        (stars.v_mag if q_icrs_to_cam is None or not len(sights[0]) else sights[0]["v_mag"]).min()
    )
    zero_e = (
        float(star_rates(config, file.folder)(*np.array([[0.0], [SOLAR_BV], [np.nan]]))[0])
        * tracker.exposure_s
    )
    v_mag: FloatArray = math.floor(
        brightest / STEP_MAG
    ) * STEP_MAG + STEP_MAG / BETWEEN * np.arange(MAX_ROWS * BETWEEN + 1.0)
    all_e = zero_e * flux_ratio(v_mag)
    under_e = np.full(len(v_mag), middle_e)
    noise = star.noise(all_e, under_e, finder)
    shown = slice(0, int((noise["detection"][::BETWEEN] >= UNSEEN).sum()) * BETWEEN + 1, BETWEEN)
    measured = np.array(
        [measured_px(star, one, middle_e, finder, rng) for one in noise["star_e"][shown].tolist()]
    ).T
    reached = {f"{kind}_px": one for kind, one in zip(FAMILY, measured, strict=True)}
    channels = {}
    if star.mosaic is not None:
        for number, (name, share, sky) in enumerate(zip(CHANNELS, *star.mosaic, strict=True)):
            alone = noisy_star(file, sky_e, number).noise(all_e[shown], under_e[shown], finder)
            reached[f"snr_{name}"] = alone["snr"]
            channels[name] = {
                "star_share": float(share),
                "background_e_per_px": float(sky * middle_e),
            }
    listed = None
    counts: list[float] = []  # stars that are found in a field, on average
    curves: list[FloatArray] = []  # NEA of each field by who finds its stars: (WHO, 2, n)
    for field in sights:
        star_e = field["electrons_per_s"] * tracker.exposure_s
        bounds = between(noise, star_e)
        if q_icrs_to_cam is not None:
            pixels = np.ceil(np.stack([field["y_px"], field["x_px"]]) - 0.5).astype(np.intp)
            own_noise = star.noise(
                star_e, software_image(sky_e, tracker.detector)[tuple(pixels)], finder
            )
            bounds = np.stack(
                [own_noise["bound_x_px"], own_noise["bound_y_px"], own_noise["detection"]]
            )
            listed = _rows(
                {name: field[name] for name in ("hip", "name", "x_px", "y_px", "v_mag")},
                own_noise,
                {},
            )
        counts.append(float(bounds[2].sum()))
        turns = turns_of(camera, field["x_px"], field["y_px"])
        # by who finds the stars: the bounds, then what centroiders reach, the same on both axes
        reached_px = [_at_rates(star_e, noise[shown], sigma_px) for sigma_px in measured]
        sigmas_px = [bounds[:2], *(np.stack([sigma, sigma]) for sigma in reached_px)]
        curves.append(np.stack([nea_arcsec(turns, sigma, bounds[2]) for sigma in sigmas_px]))
    faintest = min(
        config.sky.faintest_v_mag, math.ceil(stars.v_mag.max() / LIMIT_STEP_MAG) * LIMIT_STEP_MAG
    )
    nea = _nea_rows(sights, curves, faintest)
    return NoiseBudget(
        threshold_sigma=finder.threshold_sigma,
        minimum_pixels=finder.minimum_pixels,
        background_e_per_px=middle_e,
        centroider=config.verify.judge or USUAL,
        fields=len(sights),
        rows=_rows({"v_mag": v_mag[shown]}, noise[shown], reached),
        stars=listed,
        nea=nea,
        nea_arcsec=_by_way(nea[-1]),
        channels=channels,
        found_v_mag=float(np.interp(-HALF_FOUND, -noise["detection"], v_mag)),
        found_stars=float(np.median(counts)),
        identified_share=float(np.mean(np.array(counts) >= IDENTIFIED)),
    )


def _at_rates(star_e: FloatArray, noise: Table, values: FloatArray) -> FloatArray:
    """A figure of the rows of a table at other stars' electrons (n,)."""
    return np.interp(-np.log(star_e), -np.log(noise["star_e"]), values)


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
            under_e = np.full(len(field), float(sky_e.mean()))
            own_noise = star.noise(
                field["electrons_per_s"] * tracker.exposure_s, under_e, CentroidSettings()
            )
            bounds = np.stack([own_noise["bound_x_px"], own_noise["bound_y_px"]])
            nea = nea_arcsec(
                turns_of(camera, field["x_px"], field["y_px"]), bounds, own_noise["detection"]
            )
            limits_arcsec[k] = nea[:, -1:].ravel() if nea.size else np.inf
    return limits_arcsec


def between(noise: Table, star_e: FloatArray) -> FloatArray:
    """Bounds of x and y [px] and the probability of detection of other stars (n,), (3, n),
    between those of a table.
    """
    grid = -np.log(noise["star_e"])
    at = -np.log(star_e)
    bounds = []
    for name in ("bound_x_px", "bound_y_px"):
        bounds.append(np.exp(np.interp(at, grid, np.log(noise[name]))))
    return np.stack([*bounds, np.interp(at, grid, noise["detection"])])


def _rows(before: dict[str, Any], noise: Table, after: dict[str, Any]) -> list[dict[str, Any]]:
    columns = before | {name: noise[name] for name in NOISE_DTYPE.names or ()} | after
    lists = [column.tolist() for column in columns.values()]
    return [dict(zip(columns, row, strict=True)) for row in zip(*lists, strict=True)]


def _nea_rows(
    sights: list[Table], curves: list[FloatArray], faintest_v_mag: float
) -> list[dict[str, Any]]:
    """Medians over fields by the faintest star used, from the first limit at which half of the
    fields have an attitude.
    """
    first = min(sight["v_mag"].min(initial=faintest_v_mag) for sight in sights)
    limits = np.arange(
        math.ceil(first / LIMIT_STEP_MAG) * LIMIT_STEP_MAG, faintest_v_mag, LIMIT_STEP_MAG
    )
    none = np.full((len(WHO), 2), np.inf)
    rows = []
    for limit in [*limits.tolist(), faintest_v_mag]:
        counts = [int(np.searchsorted(field["v_mag"], limit, side="right")) for field in sights]
        at_limit = []
        for curve, count in zip(curves, counts, strict=True):
            at_limit.append(curve[..., count - 1] if count else none)
        median = np.median(at_limit, axis=0)
        row = {"v_mag": limit, "stars": float(np.median(counts))}
        rows.append(row | dict(zip(NEA_COLUMNS, median.ravel().tolist(), strict=True)))
    is_limited = [math.isfinite(row["limit_about_arcsec"]) for row in rows]
    return rows[is_limited.index(True) if any(is_limited) else -1 :]


def write_noise(directory: Path, found: NoiseBudget) -> None:
    """noise.csv, nea.csv and their charts, and stars.csv of a field. Raises InputError where one
    cannot be written.
    """
    for name, rows in (("noise", found.rows), ("nea", found.nea), ("stars", found.stars)):
        if rows:
            cells = [list(map(_cell, row.values())) for row in rows]
            write_csv(directory / f"{name}.csv", list(rows[0]), cells)
    if math.isfinite(found.nea_arcsec["limit"]["about"]):
        _draw(directory / "nea", found)


def _cell(value: object) -> object:
    """A value of a table, "" for a number that is not finite."""
    if isinstance(value, float) and not math.isfinite(value):
        return ""
    return value


def _draw(path: Path, found: NoiseBudget) -> None:
    last = found.nea_arcsec
    centroider = found.centroider
    limit, reached = (
        " and ".join(map(two_digits, last[kind].values())) for kind in ("limit", centroider)
    )
    finding = (
        f"Stars to V = {found.nea[-1]['v_mag']:g} allow {limit} arcsec across and about the"
        " boresight;"
    )
    finding += f" {centroider} reaches {reached}"
    if found.fields == 1:
        where = "the field"
    else:
        where = f"{found.fields} fields all over the sky, median"
    note = (
        f"One exposure at rest, with all noise; {where}. Lines: Cramer-Rao bound; dashes: simulated"
        f" {centroider}."
    )
    with chart(path, finding, 1, 2, note=note, share_x=False, share_y=True) as panels:
        for axes, key, label in zip(
            panels, ("v_mag", "stars"), ("faintest V [mag]", "stars"), strict=True
        ):
            # the last one of a number of stars
            rows = list({row[key]: row for row in found.nea}.values())
            for way, colour in (("about", ORANGE), ("across", BLUE)):
                for kind, style in ((centroider, "--"), ("limit", "-")):
                    values = [row[f"{kind}_{way}_arcsec"] for row in rows]
                    name = f"{way}, {kind}" if key == "stars" else "_"
                    axes.semilogy(
                        [row[key] for row in rows], values, style, color=colour, label=name
                    )
            axes.set_xlabel(label)
        panels[0].set_ylabel("NEA [arcsec]")
        panels[1].set_xscale("log")
        label_ends(panels[1])


def sensitivity_line(found: NoiseBudget) -> str:
    """Whether the tracker is sensitive enough: what it finds, and how often it can identify it."""
    enough = "sensitive enough" if found.identified_share >= ENOUGH_SHARE else "not enough"
    field = "the field" if found.fields == 1 else f"a field (median of {found.fields})"
    fields = f"{IDENTIFIED} or more in {found.identified_share:.0%} of fields"
    return (
        f"{enough}: half of the stars of V = {found.found_v_mag:.1f} are found,"
        f" {found.found_stars:.3g} stars in {field}, {fields}"
    )


def noise_lines(found: NoiseBudget) -> Iterator[str]:
    """The budget for a person."""
    centroider = found.centroider
    threshold = f"{found.minimum_pixels} px above {found.threshold_sigma:g} sigma"
    yield (
        f"{'found':22}{threshold} of a background of {found.background_e_per_px:.4g} e- in a pixel"
    )
    for name, channel_noise in found.channels.items():
        figures = (
            f"{channel_noise['star_share']:.1%} of a star of the Sun's colour, background"
            f" {channel_noise['background_e_per_px']:.4g} e-"
        )
        yield f"{'pixels of ' + name:22}{figures}"
    for kind, nea in found.nea_arcsec.items():
        nea_text = f"{nea['across']:.3g} arcsec across, {nea['about']:.3g} about the boresight"
        if not math.isfinite(nea["about"]):
            nea_text = f"none: fewer than {MIN_STARS} stars with a place"
        yield f"{'NEA, ' + kind:22}{nea_text}"
    yield ""
    snr = [f"snr_{name}" for name in found.channels]
    titles = "".join(f"{'SNR ' + name:>8}" for name in found.channels)
    sums = f"{'V':>6}{'star e-':>12}{'noise e-':>11}{'SNR':>8}"
    yield f"{sums}{titles}{'detection':>11}{'bound px':>10}{centroider + ' px':>12}"
    for row in found.rows:
        reached = row[f"{centroider}_px"]
        yield (
            f"{row['v_mag']:6.1f}{row['star_e']:12.4g}{row['total_e']:11.4g}"
            f"{''.join(f'{row[name]:8.1f}' for name in ('snr', *snr))}{row['detection']:11.4f}"
            f"{row['bound_px']:10.4g}{'-' if math.isnan(reached) else f'{reached:.4f}':>12}"
        )
