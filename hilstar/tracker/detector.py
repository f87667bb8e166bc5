"""The detector's noise (thesis section 4.3, tables 4.1 and 4.2, corrected): expected electrons in,
DN out.

Cosmic rays and false stars are new in every frame.

The physical order, which is the order of `Detector.expose`:

    light (+ frame-transfer smear, false stars) -> PRNU gain -> + dark -> Poisson
    -> + cosmic rays -> full well (and blooming) -> column pattern -> read noise -> ADC

Laws:
1. What belongs to the device (PRNU, DSNU, hot and dead pixels, rows, columns) comes from
   `device_seed`, each from its own stream, so that one map does not change when another is switched
   on. What belongs to the frame comes from the generator that is passed in. Same seeds and same
   numpy: same image, bit for bit.
2. Photon and dark shot noise are one Poisson draw: the sum of two independent Poisson counts is
   Poisson of the summed mean, exactly, and one draw costs half of two.
3. Quantisation noise is what rounding does. The thesis's added Gaussian (table 4.1) is off unless
   asked for.
"""

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import numpy.typing as npt

from hilstar.basics.arrays import BoolArray, Float32Array, FloatArray
from hilstar.basics.errors import InputError
from hilstar.tracker.frame_noise import Word64Array, draw_blocks, normal_pairs, poisson
from hilstar.tracker.settings import MAX_E, DetectorSettings, PixelPitch, check_value

DEFAULT_PITCH_UM = 13.0  # the CCD47-20's
MAX_HITS = 1e6  # cosmic rays in one frame; each is a track of pixels

# A particle at minimum ionisation in silicon (Particle Data Group): 388 eV/um on average, 3.66 eV a
# pair. The mean alone, without Landau's tail.
RAY_E_PER_UM = 388.0 / 3.66
RAY_DEPTH_UM = 20.0  # sensitive silicon of a back-illuminated CCD, of the order of its pixel
RAY_STEP_PX = 0.25  # along a track, so that no pixel that it crosses is passed over

FALSE_STAR_REACH_SIGMAS = 5.0  # beyond it lie 6e-7 of a Gaussian's light along an axis
CodeArray = npt.NDArray[np.uint16]
ChargeArray = npt.NDArray[Any]  # float64 in `noise_version = 1`, else float32


def cosmic_rays_e(
    settings: DetectorSettings,
    shape: tuple[int, int],
    exposure_s: float,
    rng: np.random.Generator,
    pixel_pitch_um: float,
) -> FloatArray:
    """Electrons of one frame's cosmic rays, shape `shape`: straight tracks through RAY_DEPTH_UM of
    silicon.

    The rate is that of hits on the sensor's face. Rays come isotropically, so a face sees cos^2 of
    the angle to its normal spread evenly from 0 to 1. Raises InputError where more than MAX_HITS
    are expected.
    """
    height, width = shape
    area_cm2 = width * height * (pixel_pitch_um * 1e-4) ** 2
    expected = settings.cosmic_rays_per_cm2_s * area_cm2 * exposure_s
    if expected > MAX_HITS:
        raise InputError(
            f"{expected:.3g} cosmic rays in a frame; lower cosmic_rays_per_cm2_s or the exposure"
        )
    hits = int(rng.poisson(expected))
    cosine = np.sqrt(1.0 - rng.random(hits))
    azimuth_rad = rng.uniform(0.0, 2 * np.pi, hits)
    start_px = rng.random((hits, 2)) * (width, height)
    # A grazing ray is longer than the sensor: only what the sensor can see of it is stepped
    # through.
    length_px = RAY_DEPTH_UM / pixel_pitch_um * np.sqrt(1 - cosine**2) / cosine
    charge_e = RAY_E_PER_UM * RAY_DEPTH_UM / cosine
    seen_px = np.minimum(length_px, width + height)
    charge_e *= np.divide(seen_px, length_px, out=np.ones(hits), where=length_px > 0)
    steps = np.ceil(seen_px / RAY_STEP_PX).astype(np.intp) + 1
    ray = np.repeat(np.arange(hits), steps)
    # each track's steps, evenly from its begin to its end
    first = np.cumsum(steps) - steps
    step = np.arange(len(ray)) - np.repeat(first, steps)
    along_px = (step + 0.5) / steps[ray] * seen_px[ray]
    x_px = start_px[ray, 0] + along_px * np.cos(azimuth_rad[ray])
    y_px = start_px[ray, 1] + along_px * np.sin(azimuth_rad[ray])
    column = np.floor(x_px).astype(np.intp)
    row = np.floor(y_px).astype(np.intp)
    inside = (column >= 0) & (column < width) & (row >= 0) & (row < height)
    charge_a_step_e = (charge_e / steps)[ray[inside]]
    image_e = np.zeros(shape)
    np.add.at(image_e, (row[inside], column[inside]), rng.poisson(charge_a_step_e))
    return image_e


def false_stars_e(
    settings: DetectorSettings, shape: tuple[int, int], exposure_s: float, rng: np.random.Generator
) -> FloatArray:
    """Expected electrons, shape `shape`, of `false_stars` equal point sources at random places,
    new in every frame.
    """
    from scipy.special import ndtr

    height, width = shape
    x_px, y_px = (rng.random((settings.false_stars, 2)) * (width, height) - 0.5).T
    sigma_px = settings.false_star_sigma_px
    reach = math.ceil(FALSE_STAR_REACH_SIGMAS * sigma_px) + 1
    steps = np.arange(-reach, reach + 1)
    column = np.rint(x_px).astype(np.intp)[:, None] + steps
    row = np.rint(y_px).astype(np.intp)[:, None] + steps
    across_px = column - x_px[:, None]
    down_px = row - y_px[:, None]
    share_x = ndtr((across_px + 0.5) / sigma_px) - ndtr((across_px - 0.5) / sigma_px)
    share_y = ndtr((down_px + 0.5) / sigma_px) - ndtr((down_px - 0.5) / sigma_px)
    share_x *= (column >= 0) & (column < width)
    share_y *= (row >= 0) & (row < height)
    light_e = settings.false_star_e_per_s * exposure_s * share_y[:, :, None] * share_x[:, None, :]
    image_e = np.zeros(shape)
    pixels = row.clip(0, height - 1)[:, :, None], column.clip(0, width - 1)[:, None, :]
    np.add.at(image_e, pixels, light_e)
    return image_e


def _alive(
    settings: DetectorSettings,
    shape: tuple[int, int],
    pixels: np.random.Generator,
    rows: np.random.Generator,
    columns: np.random.Generator,
) -> Iterator[BoolArray]:
    """Where pixels, rows and columns are not dead, each of shapes that go with `shape`."""
    height, width = shape
    if settings.dead_pixel_fraction:
        yield pixels.random(shape) >= settings.dead_pixel_fraction
    if settings.dead_row_fraction:
        yield rows.random((height, 1)) >= settings.dead_row_fraction
    if settings.dead_column_fraction:
        yield columns.random(width) >= settings.dead_column_fraction


class Detector:
    """One device: its settings, and its fixed maps, shape (height, width), made once."""

    def __init__(
        self,
        settings: DetectorSettings,
        resolution_px: tuple[int, int],
        pixel_pitch_um: float = DEFAULT_PITCH_UM,
    ) -> None:
        """`resolution_px` is (width, height). Raises InputError where it is not positive, or the
        pitch is not a sensor's.
        """
        check_value("pixel_pitch_um", pixel_pitch_um, PixelPitch)
        width, height = resolution_px
        if width < 1 or height < 1:
            raise InputError(
                f"resolution {width} x {height} px; write a width and a height of 1 or more"
            )
        self.settings = settings
        self.pixel_pitch_um = pixel_pitch_um
        self.shape = (height, width)
        # a new map takes a new stream at the end: those of before stay as they were
        seeds = np.random.SeedSequence(settings.device_seed).spawn(9)
        streams = [np.random.default_rng(seed) for seed in seeds]
        prnu, dsnu, hot, dead, column, column_dark, offset, dead_rows, dead_columns = streams
        gain_map: ChargeArray = np.ones(self.shape)
        if settings.prnu:  # a map of ones needs no million draws
            gain_map = np.maximum(1.0 + settings.prnu * prnu.standard_normal(self.shape), 0.0)
        dark_map_e_per_s = _dark_map_e_per_s(settings, self.shape, dsnu, hot, column_dark)
        for is_alive in _alive(settings, self.shape, dead, dead_rows, dead_columns):
            gain_map *= is_alive
            dark_map_e_per_s *= is_alive
        kind = np.float64 if settings.noise_version == 1 else np.float32
        self.gain_map: ChargeArray = gain_map.astype(kind, copy=False)
        self.dark_map_e_per_s: ChargeArray = dark_map_e_per_s.astype(kind, copy=False)
        column_e = settings.column_noise_e * column.standard_normal(width)
        self.column_e: ChargeArray = column_e.astype(kind)
        offset_shape = self.shape if settings.dsnu_e else 0
        offset_map_e = settings.dsnu_e * offset.standard_normal(offset_shape)
        self.offset_map_e: ChargeArray = offset_map_e.astype(kind)

    def expose(
        self, mean_e: npt.ArrayLike, exposure_s: float, rng: np.random.Generator
    ) -> CodeArray:
        """One frame, DN, of `mean_e` (height, width): the electrons that the light makes on average
        in the exposure.

        Raises InputError for a wrong shape, and for electrons or an exposure that are negative, not
        finite or beyond MAX_E.
        """
        settings = self.settings
        light_e = self.collected_e(mean_e, exposure_s)
        if settings.false_stars and exposure_s > 0:
            light_e = light_e + false_stars_e(settings, self.shape, exposure_s, rng)
        if settings.noise_version == 1:
            return self._expose_by_generator(light_e, exposure_s, rng)
        rays_e = None
        if settings.cosmic_rays_per_cm2_s:
            rays_e = cosmic_rays_e(settings, self.shape, exposure_s, rng, self.pixel_pitch_um)
        codes = np.empty(self.shape, dtype=np.uint16)
        # charge spills over the whole frame: without blooming, parts need none of the others
        spilt_shape = self.shape if settings.blooming else 0
        spilt_e = np.empty(spilt_shape, dtype=np.float32)
        normal = np.empty(spilt_shape, dtype=np.float32)

        def draw(part: slice, words: Word64Array) -> None:
            expected_e: Float32Array = light_e[part].astype(np.float32)
            self._check_light(expected_e)
            expected_e *= self.gain_map[part]
            expected_e += self.dark_map_e_per_s[part] * np.float32(exposure_s)
            self._check_largest(expected_e)
            bright = expected_e != 0  # whose places are found in a quarter of those of floats' time
            if settings.electronics_e or np.count_nonzero(bright) > bright.size / 2:
                shot, read = (number.reshape(expected_e.shape) for number in normal_pairs(words))
                charge_e = poisson(expected_e, shot)
            else:  # without read noise a dark pixel needs no number
                charge_e = read = np.zeros_like(expected_e)
                lit = np.flatnonzero(bright)
                shot, _ = normal_pairs(words, lit)
                charge_e.ravel()[lit] = poisson(expected_e.ravel()[lit], shot, 0.0)
            if rays_e is not None:
                charge_e += rays_e[part]
            if settings.blooming:
                spilt_e[part] = charge_e
                normal[part] = read
            else:
                well_e = np.minimum(charge_e, np.float32(settings.full_well_e))
                codes[part] = self._read_out(well_e, read, part)

        draw_blocks(self.shape, rng, draw)
        if settings.blooming:
            return self._read_out(bloom(spilt_e, settings.full_well_e), normal)
        return codes

    def _expose_by_generator(
        self, light_e: FloatArray, exposure_s: float, rng: np.random.Generator
    ) -> CodeArray:
        """`noise_version = 1`: NumPy's own draws of the whole frame."""
        settings = self.settings
        self._check_light(light_e)
        expected_e = light_e * self.gain_map
        expected_e += self.dark_map_e_per_s * exposure_s
        self._check_largest(expected_e)
        collected_e = rng.poisson(expected_e).astype(np.float64)
        if settings.cosmic_rays_per_cm2_s:
            collected_e += cosmic_rays_e(settings, self.shape, exposure_s, rng, self.pixel_pitch_um)
        well_e = self._fill_wells(collected_e)
        normal = None
        if settings.electronics_e:
            normal = rng.standard_normal(self.shape, dtype=np.float32)
        return self._read_out(well_e, normal)

    def _read_out(
        self, charge_e: ChargeArray, normal: Float32Array | None, part: slice = slice(None)
    ) -> CodeArray:
        """DN of the charge in the wells, the rows `part`, with the noise of the electronics;
        `charge_e` is changed.
        """
        if self.settings.column_noise_e:
            charge_e += self.column_e
        if self.settings.dsnu_e:
            charge_e += self.offset_map_e[part]
        if self.settings.electronics_e and normal is not None:
            charge_e += self.settings.electronics_e * normal
        return self._convert(charge_e)

    def expose_noiseless(self, mean_e: npt.ArrayLike, exposure_s: float) -> CodeArray:
        """The DN of the mean signal, light and mean dark, through full well and ADC; refuses what
        `expose` refuses.

        No fixed pattern, no strays. The mean of noisy frames differs where a well or the ADC clips
        the noise.
        """
        settings = self.settings
        light_e = self.collected_e(mean_e, exposure_s)
        self._check_light(light_e)
        dark_e_per_s = settings.dark_e_per_s * settings.dark_factor
        expected_e = light_e.astype(np.float64) + dark_e_per_s * exposure_s
        self._check_largest(expected_e)
        return self._convert(self._fill_wells(expected_e))

    def collected_e(self, mean_e: npt.ArrayLike, exposure_s: float) -> FloatArray:
        """The same electrons with the smear of a frame transfer. Refuses what `expose` refuses
        of shape and exposure.
        """
        light_e = np.asarray(mean_e)
        if light_e.dtype.kind not in "fiu" or light_e.shape != self.shape:
            raise InputError(
                f"electrons of type {light_e.dtype}, shape {light_e.shape}; give numbers,"
                f" {self.shape}"
            )
        if not 0 <= exposure_s <= MAX_E:
            raise InputError(f"exposure {exposure_s} s; write 0 or more seconds")
        shift_s = self.settings.row_shift_us * 1e-6
        # clearing and readout together shift each charge through the light of all rows once
        if shift_s and exposure_s:
            light_e = light_e + light_e.sum(axis=0, dtype=np.float64) * (shift_s / exposure_s)
        return light_e

    def _check_light(self, light_e: npt.NDArray[Any]) -> None:
        """Raise InputError for electrons that are negative, not a number, or too many."""
        if not light_e.min() >= 0:  # NaN propagates through min
            raise InputError(
                "a pixel's electrons are negative or NaN; give expected electrons, 0 or more"
            )
        self._check_largest(light_e)

    def _check_largest(self, expected_e: npt.NDArray[Any]) -> None:
        """Raise InputError for more electrons in a pixel than can be drawn."""
        largest_e = expected_e.max()
        if not largest_e <= MAX_E:
            raise InputError(
                f"{largest_e:.3g} electrons in one pixel, at most {MAX_E:g} can be simulated;"
                " shorten the exposure"
            )

    def _fill_wells(self, collected_e: FloatArray) -> ChargeArray:
        """The charge that the wells hold, what exceeds them cut off or spilt along columns."""
        full_e = self.settings.full_well_e
        if self.settings.blooming:
            return bloom(collected_e, full_e)
        return np.minimum(collected_e, full_e)

    def _convert(self, charge_e: ChargeArray) -> CodeArray:
        """The ADC: electrons to the nearest code (a half goes to the even one), clipped to the
        bits; same shape.
        """
        codes = charge_e
        codes /= self.settings.gain_e_per_dn
        codes += self.settings.offset_dn
        np.rint(codes, out=codes)
        np.minimum(codes, 2**self.settings.bits - 1, out=codes)
        np.maximum(codes, 0, out=codes)
        return codes.astype(np.uint16)


def _dark_map_e_per_s(
    settings: DetectorSettings,
    shape: tuple[int, int],
    dsnu: np.random.Generator,
    hot: np.random.Generator,
    column: np.random.Generator,
) -> FloatArray:
    """Dark rates at the sensor's temperature: the pixels' and the columns', never negative, plus
    the hot pixels' extra.

    Where DSNU is not small beside dark, the normal law's cut at 0 lifts the mean: 1e-4 of it for
    table 4.2 (203 and 60 e-/s).
    """
    mean = settings.dark_e_per_s
    sigma = settings.dsnu_e_per_s
    rate_e_per_s = np.full(shape, mean)
    if sigma and settings.dark_distribution == "gamma":
        rate_e_per_s = dsnu.gamma((mean / sigma) ** 2, sigma**2 / mean, shape)
    elif sigma and settings.dark_distribution == "log-normal":
        spread2 = math.log1p((sigma / mean) ** 2)
        rate_e_per_s = dsnu.lognormal(math.log(mean) - spread2 / 2, math.sqrt(spread2), shape)
    elif sigma:
        rate_e_per_s = np.maximum(rate_e_per_s + sigma * dsnu.standard_normal(shape), 0.0)
    if settings.column_dark_e_per_s:
        columns_e_per_s = settings.column_dark_e_per_s * column.standard_normal(shape[1])
        rate_e_per_s = np.maximum(rate_e_per_s + columns_e_per_s, 0.0)
    if settings.hot_pixel_fraction:
        is_hot = hot.random(shape) < settings.hot_pixel_fraction
        hot_factor = settings.hot_factor / settings.dark_factor
        rate_e_per_s += is_hot * hot.exponential(settings.hot_pixel_e_per_s, shape) * hot_factor
    return np.asarray(rate_e_per_s * settings.dark_factor)


def bloom(charge_e: ChargeArray, full_well_e: float) -> ChargeArray:
    """`charge_e` with what exceeds the full well spilt along its columns, half up and half down;
    same shape.

    Only the charge that leaves a column at its ends is lost.
    """
    wells_e = np.minimum(charge_e, full_well_e)
    columns = np.flatnonzero((charge_e > full_well_e).any(axis=0))
    column_wells_e = wells_e[:, columns]
    half_excess_e = (charge_e[:, columns] - column_wells_e) / 2
    downwards = range(len(wells_e))
    for rows in (downwards, reversed(downwards)):
        carried_e = np.zeros(len(columns))
        for row in rows:
            offered_e = column_wells_e[row] + carried_e + half_excess_e[row]
            column_wells_e[row] = np.minimum(offered_e, full_well_e)
            carried_e = offered_e - column_wells_e[row]
    wells_e[:, columns] = column_wells_e
    return wells_e
