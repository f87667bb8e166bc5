"""Two images of one sky compared star by star, within the limits of a change of driver; and the
files they come from.

Stars are found in the golden image and fitted in both (see star_fit). Where rounding of the light
around a star limits the fit, that star's limits are wider.
"""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np

from hilstar.basics.arrays import FloatArray
from hilstar.basics.errors import InputError
from hilstar.basics.fits_headers import read_fits_image
from hilstar.basics.image_files import ImageSizeError, unpacked
from hilstar.basics.reading import read_bytes
from hilstar.basics.text_tables import finite_numbers, read_rows
from hilstar.basics.units import MAG_PER_RELATIVE, magnitude
from hilstar.instruments.compare import star_fit
from hilstar.instruments.compare.sky_comparison import (
    Limits,
    SkyComparison,
    StarDifference,
    common_change,
)
from hilstar.optics.layers.truth import TRUTH_DTYPE
from hilstar.optics.psf import Psf

# Error of float32 in any pixel that a star reaches, relative to its flux. Measured 7e-8 on llvmpipe
# against float64.
PIXEL_ERROR = 2e-7
# smallest share of a star's light on the image; the wing of a star off the image has no centroid
MIN_IN_VIEW = 0.01
# a star whose relative error by rounding of brighter light is larger is not compared
MAX_ERROR = 0.25
MISSING_SHARE = 0.01  # share of its flux: a star 5 mag fainter is gone
# a shift of this is first order within 1e-5 of the star's flux
MOVE_STEPS, SMALL_MOVE_PX = 4, 0.003
MAX_MOVE_SIGMAS = 3.0  # a star that moved farther is missing here and extra there
UNIT, CHANNELS = "electron/s", "rgb"
MAX_E_PER_S = 1e30  # whose square is still a number
TRUTH_COLUMNS = ("hip", "x_px", "y_px", "electrons_per_s")
MAX_TRUTH_BYTES = 50_000_000
MAX_FITS_BYTES = 600_000_000  # an 8K frame has 133 MB


def compare_skies(
    frame: FloatArray,
    golden: FloatArray,
    limits: Limits,
    truth: star_fit.Truth | None = None,
    frame_truth: star_fit.Truth | None = None,
) -> SkyComparison:
    """Compare two linear images (height, width) star by star, named by their tables (TRUTH_DTYPE),
    `truth` the golden one's.

    Of cubes (3, height, width) the sum of the channels, and then each. Raises InputError for images
    of different size or with a pixel that is not finite, for a golden one without a star, and for a
    `truth` of another sky.
    """
    check_skies(frame, golden)
    if frame.ndim == 3:
        tables = truth, frame_truth
        by_channel = {}
        for name, channel, golden_channel in zip(CHANNELS, frame, golden, strict=True):
            by_channel[name] = compare_skies(channel, golden_channel, limits, *tables)
        whole = compare_skies(frame.sum(axis=0), golden.sum(axis=0), limits, *tables)
        return replace(whole, channels=by_channel)
    psf = star_fit.star_psf(golden)
    listed = star_fit.find_seeds(golden, truth, psf)
    seeds, unmeasured = _measurable(golden, listed, psf)
    if not seeds.hip:
        raise InputError(
            "compare: no star of the golden image has enough light in view; give one that has"
        )
    fit = _SkyFit(golden, seeds.places_px, psf)
    moved = fit.follow(frame)
    stars = _differences(seeds, fit, moved, limits)
    more = moved.residual - fit.residual
    less = fit.residual - moved.residual
    if frame_truth is None:
        frame_truth = truth
    blend_px = star_fit.blend_distance_px(psf)
    # stars that only the golden image has, then those that only the frame has
    for light, table, error in ((less, truth, math.inf), (more, frame_truth, -math.inf)):
        places, flux = _unexplained(light, fit, moved)
        names = star_fit.names_at(places, table, blend_px)
        for hip, (x, y), star_flux in zip(names, places.tolist(), flux.tolist(), strict=True):
            stars.append(StarDifference(hip, x, y, star_flux, error, 0.0, 0.0, limits))
    height, width = golden.shape
    return SkyComparison(stars, limits, unmeasured, common_change(stars, (width, height)))


def check_skies(frame: FloatArray, golden: FloatArray) -> None:
    """Raise InputError where two images cannot be compared, as `compare_skies` does."""
    for name, image in (("frame", frame), ("golden", golden)):
        is_linear = image.ndim == 2 or image.shape[:-2] == (len(CHANNELS),)
        if not is_linear or min(image.shape) < 2:
            raise InputError(
                f"compare: the {name} image has the shape {image.shape}; give a linear image"
                " (height, width)"
            )
        if not np.isfinite(image).all():
            raise InputError(
                f"compare: the {name} image has a pixel that is NaN or infinite; give finite"
                " numbers"
            )
    if frame.shape != golden.shape:
        height, width = frame.shape[-2:]
        golden_height, golden_width = golden.shape[-2:]
        raise InputError(
            f"compare: {width} x {height} px against {golden_width} x {golden_height} px; give"
            " images of one monitor"
        )
    if not (golden > 0).any():
        raise InputError("compare: the golden image has no star; give one that has")


def _measurable(golden: FloatArray, seeds: star_fit.Seeds, psf: Psf) -> tuple[star_fit.Seeds, int]:
    """The seeds, refined, whose light exceeds the rounding of their neighbours'; and how many
    stars do not.
    """
    count = seeds.stars
    shape = (golden.shape[0], golden.shape[1])
    seeds = _in_view(seeds, psf, shape)
    seeds = star_fit.Seeds(star_fit.refined(golden, seeds.places_px, psf), seeds.hip)
    seeds = _in_view(seeds, psf, shape)
    templates = star_fit.StarTemplates(seeds.places_px, psf, shape)
    flux = templates.fit(golden)[:, 0]
    flux_error, _ = templates.errors(flux, PIXEL_ERROR)
    seeds = seeds.only(flux > flux_error / MAX_ERROR)
    return seeds, count - seeds.stars


def _in_view(seeds: star_fit.Seeds, psf: Psf, shape: tuple[int, int]) -> star_fit.Seeds:
    """The seeds with enough light on an image of a shape (height, width)."""
    templates = star_fit.StarTemplates(seeds.places_px, psf, shape)
    return seeds.only(templates.in_view >= MIN_IN_VIEW)


class _SkyFit:
    """All stars of one image, fitted at `places_px`: fluxes, places, and the light (height,
    width) that they do not explain.
    """

    def __init__(self, image: FloatArray, places_px: FloatArray, psf: Psf) -> None:
        self.light = image
        self.psf = psf
        height, width = image.shape
        self.templates = star_fit.StarTemplates(places_px, psf, (height, width))
        fitted = self.templates.fit(image)
        self.flux = fitted[:, 0]
        self.places_px = places_px + star_fit.shifts_px(fitted)
        self.model = self.templates.image(fitted)
        self.residual = image - self.model

    def follow(self, frame: FloatArray) -> "_SkyFit":
        """The same stars in another image: the same templates, except for those that moved."""
        start = self.templates.places_px
        fit = _SkyFit(frame, start, self.psf)
        max_move_px = MAX_MOVE_SIGMAS * max(self.psf.width_px)
        for _ in range(MOVE_STEPS):
            move = fit.places_px - self.places_px
            shift_px = np.hypot(*move.T)
            is_there = fit.flux > MISSING_SHARE * self.flux
            is_move = (shift_px > SMALL_MOVE_PX) & (shift_px <= max_move_px)
            moved = is_there & is_move
            if not moved.any():
                break
            places_px = start + np.where(moved[:, None], move, 0.0)
            fit = _SkyFit(frame, places_px, self.psf)
        return fit


def _differences(
    seeds: star_fit.Seeds, fit: _SkyFit, moved: _SkyFit, limits: Limits
) -> list[StarDifference]:
    """Each star of an image against itself in another, a missing one where it is too faint or too
    far.
    """
    flux_error, place_error_px = fit.templates.errors(fit.flux, PIXEL_ERROR)
    limit_mag = np.maximum(MAG_PER_RELATIVE * flux_error / fit.flux, limits.flux_mag)
    limit_px = np.maximum(place_error_px, limits.centroid_px)
    shift = moved.places_px - fit.places_px
    max_move_px = MAX_MOVE_SIGMAS * max(fit.psf.width_px)
    gone = moved.flux <= MISSING_SHARE * fit.flux
    gone |= np.hypot(*shift.T) > max_move_px
    ratio = np.where(gone, 1.0, moved.flux / fit.flux)
    error_mag = np.where(gone, np.inf, magnitude(ratio))
    shift_px = np.where(gone, 0.0, shift.T)
    columns = (*fit.places_px.T, fit.flux, error_mag, *shift_px, limit_mag, limit_px)
    rows = np.column_stack(columns).tolist()
    differences: list[StarDifference] = []
    for hip, row in zip(seeds.hip, rows, strict=True):
        x_px, y_px, flux, mag, dx_px, dy_px, star_limit_mag, star_limit_px = row
        star_limits = Limits(star_limit_mag, star_limit_px)
        differences.append(StarDifference(hip, x_px, y_px, flux, mag, dx_px, dy_px, star_limits))
    return differences


def _unexplained(light: FloatArray, fit: _SkyFit, moved: _SkyFit) -> tuple[FloatArray, FloatArray]:
    """Places (n, 2), px, and fluxes of stars in light that no star of either fit explains.

    A changed star is not exactly a Gaussian: its residual is under half of its change. A star off
    the image may be as bright as any on it, and its wing wrong by that star's rounding.
    """
    change = np.maximum(np.abs(moved.model - fit.model), np.abs(light))
    brighter = np.maximum(fit.light, moved.light)
    floor = star_fit.RIPPLE_SHARE * brighter + 0.5 * change
    largest_flux = max(fit.flux.max(initial=0.0), moved.flux.max(initial=0.0))
    rounding = PIXEL_ERROR * largest_flux
    limit = star_fit.around(floor, fit.psf) + rounding
    bright = star_fit.bright_pixels(light, limit)
    seeds = star_fit.nameless_seeds(bright, fit.psf).places_px
    places = star_fit.refined(light, seeds, fit.psf)
    height, width = light.shape
    templates = star_fit.StarTemplates(places, fit.psf, (height, width))
    flux = templates.fit(light)[:, 0]
    column, row = seeds.astype(np.intp).T
    # Two stars at one place: the fit may give one too much and the other less than 0.
    return places, np.maximum(flux, light[row, column])


def read_frame_fits(path: Path) -> FloatArray:
    """The linear image (height, width), or of three channels (3, height, width), electrons/s, of a
    FITS of `hilstar frame`.

    Raises InputError for another file.
    """
    wanted = "give the FITS that `hilstar frame -o OUT.fits` writes"
    data = read_bytes(path, wanted, MAX_FITS_BYTES)
    try:
        fits_image = read_fits_image(unpacked(data, MAX_FITS_BYTES))
        image = fits_image.pixels
        header = fits_image.header
    except (InputError, ImageSizeError) as error:
        raise InputError(f"{path}: {error}; {wanted}") from error
    except Exception as error:  # astropy raises whatever a broken header causes in its layers
        raise InputError(f"{path}: not a FITS image; {wanted}") from error
    if header.get("BUNIT") != UNIT or image.ndim not in (2, 3) or image.dtype.kind != "f":
        raise InputError(
            f"{path}: not a linear image in {UNIT} (BUNIT is {header.get('BUNIT')!r}); {wanted}"
        )
    light = np.asarray(image, dtype=np.float64)
    finite = light[np.isfinite(light)]
    if (np.abs(finite) > MAX_E_PER_S).any():
        raise InputError(f"{path}: a pixel has more than {MAX_E_PER_S:g} {UNIT}; {wanted}")
    return light


def read_truth_csv(path: Path) -> star_fit.Truth:
    """The stars of a CSV of `hilstar frame --truth`, TRUTH_DTYPE, only `name` and the columns of
    TRUTH_COLUMNS filled.
    """
    wanted = "give the CSV that `hilstar frame --truth OUT.csv` writes"
    rows = []
    names = []
    # A table of stars alone may have no names.
    for line, (*cells, name) in read_rows(path, TRUTH_COLUMNS, wanted, MAX_TRUTH_BYTES, ("name",)):
        rows.append(tuple(finite_numbers(path, line, TRUTH_COLUMNS, cells, wanted)))
        names.append(name)
    truth = np.zeros(len(rows), dtype=TRUTH_DTYPE)
    truth["name"] = names
    columns = np.array(rows).reshape(-1, len(TRUTH_COLUMNS)).T
    for name, column in zip(TRUTH_COLUMNS, columns, strict=True):
        truth[name] = column
    return truth
