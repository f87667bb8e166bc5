"""The budget of a bench's light: which magnitudes its monitor, sprites and quantisation can show, and how accurately.

Every error is measured: single stars at a grid of sub-pixel phases through the bench's own method.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import get_args

import numpy as np

from hilstar.arrays import FloatArray
from hilstar.bench.frame import Bench
from hilstar.bench.white import clipping_hip
from hilstar.monitor.balance import Balance
from hilstar.monitor.phases import WHITE, fainter, phase_grid, shown_by, tiles_of
from hilstar.monitor.quantise import Panel
from hilstar.render.reference import linear_image
from hilstar.scene.psf import peak_share
from hilstar.tracker.centroiders import Centroider, brightest, star_places
from hilstar.units import ARCSEC_PER_RAD, flux_ratio, magnitude

PHASES = 16  # along a side of a pixel
STEP_MAG = 0.5
MAX_BELOW_WHITE_MAG = 15.0
SOLAR_BV, LIKE_SOLAR_BV = 0.65, 0.1
FLUX_LIMITS_MAG = (0.02, 0.05)
CENTROID_LIMIT_PX = 0.01
USUAL: Centroider = "fit"  # what most trackers do
COMPARED_MAG = 6.0
BLUR_SIGMAS = 5.0


@dataclass(frozen=True, slots=True)
class MagnitudeRow:
    """One magnitude: rms and maximum errors over phases, mag and monitor pixels; None where a star shows nothing."""

    v_mag: float
    below_white_mag: float
    flux_rms_mag: float | None
    flux_max_mag: float | None
    centroid_rms_px: float | None
    centroid_max_px: float | None
    centroid_max_arcsec: float | None


@dataclass(frozen=True, slots=True)
class NotDrawn:
    """The bench's stars that are too faint to be drawn: how many, and their share of all light."""

    stars: int
    flux_share: float


@dataclass(frozen=True, slots=True)
class Budget:
    """What a bench can show; its fields are the keys of the JSON object of `hilstar budget`.

    Magnitudes are those of a star of the Sun's colour: it clips in the middle of a pixel where the screen is darkest
    (`clips_v_mag`), on a corner of four pixels (`clips_v_mag_at_best`), and shows nothing from `nothing_v_mag` on. `within`
    has the magnitudes below full scale over which the worst star stays within each limit. Places in `rows` are as `centroider`
    finds them; `centroid_rms_px` has the error along an axis that each kind finds COMPARED_MAG below full scale.
    """

    method: str
    bits: int
    clips_v_mag: float
    clips_v_mag_at_best: float
    nothing_v_mag: float
    range_mag: float
    within: dict[str, float | None]
    clipped_hip: list[int | str]
    left_out: NotDrawn
    black_e_per_s_px: float
    rows: list[MagnitudeRow]
    centroider: Centroider
    centroid_rms_px: dict[str, float | None]


def budget(bench: Bench, centroider: Centroider = USUAL) -> Budget:
    """The budget of a bench, places as `centroider` finds them after the tracker's blur.

    Raises InputError for a bench without stars.
    """
    render, white = bench.config.render, bench.flux_at_white_e_per_s
    # A star of rate r has V = zero_mag + magnitude(r).
    zero_mag = zero_point_mag(bench)
    clips = zero_mag + magnitude(white * bench.darkest / peak_share(render.sprite_sigma_px))
    nothing = zero_mag + magnitude(nothing_below_e_per_s(bench))
    rows = [_row(bench, errors, clips) for errors in _errors(bench, centroider)]
    return Budget(
        method=render.quantisation + (" with bit stealing" if render.bit_stealing else ""),
        bits=bench.config.monitor.bits,
        clips_v_mag=clips,
        clips_v_mag_at_best=zero_mag + magnitude(white / corner_share(render.sprite_sigma_px)),
        nothing_v_mag=nothing,
        range_mag=nothing - clips,
        within=_within(rows),
        clipped_hip=clipping_hip(bench),
        left_out=not_drawn(bench),
        black_e_per_s_px=bench.calibration.response.black * white,
        rows=rows,
        centroider=centroider,
        centroid_rms_px=_by_each(bench),
    )


def zero_point_mag(bench: Bench) -> float:
    """V of a star of the Sun's colour that gives one electron a second, by the bench's own stars of about that colour.

    Raises InputError where it has none.
    """
    rates_e_per_s = bench.stars.rates_e_per_s
    bv_mag, v_mag = (column[: len(rates_e_per_s)] for column in (bench.stars.bv_mag, bench.stars.v_mag))
    # The stars of that colour, or else the nearest to it: where there are stars, none of these is far from it.
    distance = np.abs(bv_mag - SOLAR_BV)
    alike = distance <= max(LIKE_SOLAR_BV, float(distance.min()))
    return float(np.median(v_mag[alike] - magnitude(rates_e_per_s[alike])))


def corner_share(sigma_px: tuple[float, float]) -> float:
    """The share of a star's brightest pixel when it is on a corner of four: the minimum that a peak can be."""
    return math.prod(0.5 * math.erf(1.0 / (sigma * math.sqrt(2.0))) for sigma in sigma_px)


def nothing_below_e_per_s(bench: Bench) -> float:
    """The rate below which a star lights no pixel, wherever it is; for dithers, where it lights one in half of the frames."""
    drawn = bench.faintest_shown_e_per_s
    return drawn or bench.calibration.response.half_step * bench.flux_at_white_e_per_s


def not_drawn(bench: Bench) -> NotDrawn:
    """The bench's stars that are not drawn; bodies, whose light is that of all stars many times over, do not count."""
    rates = bench.stars.rates_e_per_s
    missing = rates[rates < bench.faintest_shown_e_per_s]
    return NotDrawn(len(missing), float(missing.sum() / rates.sum()))


@dataclass(frozen=True, slots=True)
class _Errors:
    """Flux errors, mag, and how far off each phase's star is along x and y, px, so many magnitudes below full scale."""

    mag: float
    flux_mag: FloatArray
    off_px: FloatArray


class _Phases:
    """Stars at every sub-pixel phase, through the bench's method and the tracker's blur."""

    def __init__(self, bench: Bench) -> None:
        render = bench.config.render
        self._bench, self._sigma_px = bench, render.sprite_sigma_px
        self._seen = bench.renderer.target.seen
        self._sprites, self._tile = phase_grid(PHASES, self._sigma_px)
        size = PHASES * self._tile
        self._bright = linear_image(self._sprites, (size, size), self._sigma_px)
        self._panel = Panel(bench.calibration.response, WHITE)

    def pair(self, mag: float) -> tuple[FloatArray, FloatArray]:
        """The stars as the sky has them and as they are shown, `mag` below full scale: tiles (n, side, side), blurred."""
        wanted, method = self._bright * flux_ratio(mag), self._bench.renderer.target.quantisation
        balance, cycle = Balance(self._sigma_px, self._seen), self._bench.config.render.cycle_frames
        shown = shown_by(method, cycle, self._panel, wanted.astype(np.float32), fainter(self._sprites, mag), balance)
        return self._blurred(wanted), self._blurred(shown)

    def _blurred(self, image: FloatArray) -> FloatArray:
        from scipy.ndimage import gaussian_filter1d

        blur_px = self._seen.blur_px
        edge = math.ceil(BLUR_SIGMAS * blur_px)
        side = self._tile + 2 * edge
        tiles = np.pad(tiles_of(image, self._tile), ((0, 0), (edge, edge + 1 - side % 2), (edge, edge + 1 - side % 2)))
        for axis in (1, 2):
            tiles = gaussian_filter1d(tiles, blur_px, axis=axis, mode="constant", truncate=BLUR_SIGMAS)
        return np.asarray(tiles)

    def off_px(self, wanted: FloatArray, shown: FloatArray, kind: Centroider) -> FloatArray:
        """How far off each star is found along x and y (2, n), px; infinite where nothing is shown."""
        x, y = self._sigma_px
        sigma_px = math.hypot(x, self._seen.blur_px), math.hypot(y, self._seen.blur_px)
        pixels = brightest(wanted)
        sky, seen = (np.stack(star_places(tiles, kind, sigma_px, pixels)) for tiles in (wanted, shown))
        return np.where(shown.sum(axis=(1, 2)) > 0, seen - sky, np.inf)


def _errors(bench: Bench, kind: Centroider) -> list[_Errors]:
    """The errors at each magnitude, down to the first at which a star shows nothing."""
    phases, found = _Phases(bench), []
    for mag in np.arange(0.0, MAX_BELOW_WHITE_MAG + STEP_MAG / 2, STEP_MAG).tolist():
        wanted, shown = phases.pair(mag)
        flux = magnitude(shown.sum(axis=(1, 2)) / wanted.sum(axis=(1, 2)))
        found.append(_Errors(mag, np.abs(flux), phases.off_px(wanted, shown, kind)))
        if not np.isfinite(flux).all():
            break
    return found


def _by_each(bench: Bench) -> dict[str, float | None]:
    phases = _Phases(bench)
    wanted, shown = phases.pair(COMPARED_MAG)
    return {kind: _finite(_rms(phases.off_px(wanted, shown, kind))) for kind in get_args(Centroider)}


def _rms(errors: FloatArray) -> float:
    return float(np.sqrt(np.mean(np.square(errors))))


def _finite(value: float) -> float | None:
    return value if math.isfinite(value) else None


def _row(bench: Bench, errors: _Errors, clips_v_mag: float) -> MagnitudeRow:
    arcsec_per_px = ARCSEC_PER_RAD / bench.camera.scales_px_rad()[0]  # where a pixel is widest
    off_px = np.hypot(*errors.off_px)
    return MagnitudeRow(
        v_mag=clips_v_mag + errors.mag,
        below_white_mag=errors.mag,
        flux_rms_mag=_finite(_rms(errors.flux_mag)),
        flux_max_mag=_finite(float(errors.flux_mag.max())),
        centroid_rms_px=_finite(_rms(off_px)),
        centroid_max_px=_finite(float(off_px.max())),
        centroid_max_arcsec=_finite(float(off_px.max()) * arcsec_per_px),
    )


def _within(rows: list[MagnitudeRow]) -> dict[str, float | None]:
    """The magnitudes below full scale over which the worst star stays within each limit."""

    def reach(values: list[float | None], limit: float) -> float | None:
        good = 0
        while good < len(rows) and (value := values[good]) is not None and value <= limit:
            good += 1
        return rows[good - 1].below_white_mag if good else None

    flux, centroid = [row.flux_max_mag for row in rows], [row.centroid_max_px for row in rows]
    limits = {f"{limit:g}_mag": reach(flux, limit) for limit in FLUX_LIMITS_MAG}
    return limits | {f"{CENTROID_LIMIT_PX:g}_px": reach(centroid, CENTROID_LIMIT_PX)}
