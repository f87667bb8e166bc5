"""The tracker that judges codes, against one put together from fine samples and centroiders that
share no code with it.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from hilstar.display.balance import Balance, Seen
from hilstar.display.panel import Panel
from hilstar.display.phases import (
    MARGIN_PX,
    WHITE,
    fainter,
    line_places,
    phase_grid,
    phase_image,
    shown_by,
)
from hilstar.display.quantisers import QUANTISERS
from hilstar.display.render.reference import linear_image
from hilstar.display.response import srgb_response
from hilstar.optics.psf import GaussianPsf
from hilstar.tracker.centroiders import FAMILY
from hilstar.tracker.star_errors import (
    GOLDEN,
    Judge,
    StarErrors,
    spread_phases,
    stamp_errors,
)
from tests.support import centroiders as outside

SIGMA = (0.85, 0.85)
COUNT, FINE, FAR_PX = 5, 40, 8
SHIFT_PX = 1e-6  # an iteration ends at 1e-7 px or so
# Samples of 1/40 px: their light is within 1e-4 of the integral, and a place within 1e-4 px.
SAMPLED_PX = 2e-4
WINGS = 1e-6  # of a star's light are cut by its footprint
# A shift along x moves nothing along y, but where it takes a pixel over a box's threshold, 2 % of
# the brightest.
ACROSS_PX = {"moment": 1e-9, "window": 1e-4, "wide": 1e-4, "fit": 1e-4, "box3": 0.02, "box5": 0.02}
FIT_PX = 0.02  # a tenth of a pixel aside widens a star, which a fit of fixed width sees askew


def codes(method, mag, seen, sigma_px=SIGMA):
    sprites, tile = phase_grid(COUNT, GaussianPsf(sigma_px))
    wanted = phase_image(sprites, GaussianPsf(sigma_px)) * 10 ** (-0.4 * mag)
    panel = Panel(srgb_response(8), WHITE)
    return (
        wanted,
        shown_by(
            QUANTISERS[method],
            1,
            panel,
            wanted.astype(np.float32),
            fainter(sprites, mag),
            Balance(GaussianPsf(sigma_px), seen),
        ),
        tile,
    )


def tiles_of(image, tile):
    """The tiles of a square image, (tiles, tile, tile), row by row."""
    count = len(image) // tile
    return image.reshape(count, tile, count, tile).transpose(0, 2, 1, 3).reshape(-1, tile, tile)


def along(stars, axis, star_px, seen):
    """What the tracker's pixels about each star collect along an axis of fine samples, (n, ...)."""
    fine = (
        np.repeat(
            np.pad(stars, [(0, 0)] + [(FAR_PX, FAR_PX) if k == axis else (0, 0) for k in (1, 2)]),
            FINE,
            axis,
        )
        / FINE
    )
    fine = np.moveaxis(
        gaussian_filter1d(fine, seen.blur_px * FINE, axis=axis, truncate=6), axis, -1
    )
    sums = np.concatenate([np.zeros((*fine.shape[:-1], 1)), np.cumsum(fine, axis=-1)], axis=-1)
    half = int(np.ceil(6.5 / seen.pixel_px))
    found = []
    for k in range(len(stars)):
        phase = (k % COUNT if axis == 2 else k // COUNT) * GOLDEN % 1 - 0.5
        edges = star_px[k] + seen.pixel_px * (np.arange(-half, half + 2) - 0.5 + phase)
        at = (edges + 0.5 + FAR_PX) * FINE
        found.append(
            np.diff([np.interp(at, np.arange(sums.shape[-1]), line) for line in sums[k]], axis=-1)
        )
    return np.moveaxis(np.array(found), -1, axis)


def looked_at(image, tile, seen):
    index = np.arange(COUNT**2)
    x_px, y_px = ((tile - 1) / 2 + (part + 0.5) / COUNT for part in (index % COUNT, index // COUNT))
    return along(along(tiles_of(image, tile), 2, x_px, seen), 1, y_px, seen)


@pytest.mark.parametrize("method", ["round", "exact"])
@pytest.mark.parametrize("seen", [Seen(0.62, 1.0), Seen(0.4, 0.55), Seen(1.1, 2.3)])
def test_errors_are_those_of_fine_samples_and_other_centroiders(method, seen):
    wanted, shown, tile = codes(method, 5.0, seen)
    places = line_places(phase_grid(COUNT, GaussianPsf(SIGMA))[0])
    found = Judge(wanted, places, SIGMA, seen.blur_px, seen.pixel_px).errors(shown)
    sky, lit = (looked_at(image, tile, seen) for image in (wanted, shown))
    sigma = np.sqrt(SIGMA[0] ** 2 + 1 / 6 + seen.blur_px**2) / seen.pixel_px
    ways = {
        "window": lambda stars: outside.windowed(stars, max(1, sigma)),
        "wide": lambda stars: outside.windowed(stars, 1.5 * max(1, sigma)),
        "fit": lambda stars: outside.fitted(stars, sigma)[:2],
        "box3": lambda stars: outside.box_mean(stars, 1, sky),
        "box5": lambda stars: outside.box_mean(stars, 2, sky),
    }
    for kind, way in ways.items():
        off_px = seen.pixel_px * np.subtract(way(lit), way(sky))
        assert np.abs(found.off_px[kind] - off_px).max() < SAMPLED_PX, kind
    plain = np.subtract(
        outside.moment(tiles_of(shown, tile)), outside.moment(tiles_of(wanted, tile))
    )
    assert found.off_px["moment"] == pytest.approx(plain, abs=1e-12)
    flux = -2.5 * np.log10(tiles_of(shown, tile).sum((1, 2)) / tiles_of(wanted, tile).sum((1, 2)))
    assert found.flux_mag == pytest.approx(flux, abs=1e-12)


def test_an_image_turned_over_its_diagonal_has_its_errors_the_other_way_round():
    """Stars of another width, and at other places in the tracker's pixels, along x than along y."""
    sigma, seen, evenly = (0.85, 0.6), Seen(0.62, 1.3), spread_phases(COUNT)
    phases = (evenly, 0.4 * evenly + 0.1)
    wanted, shown, _ = codes("round", 5.0, seen, sigma)
    places = line_places(phase_grid(COUNT, GaussianPsf(sigma))[0])
    tracker = (seen.blur_px, seen.pixel_px)
    upright = Judge(wanted, places, sigma, *tracker, phases=phases).errors(shown)
    turned = Judge(wanted.T, places[::-1], sigma[::-1], *tracker, phases=phases[::-1])
    for kind, off_px in turned.errors(shown.T).off_px.items():
        back_px = off_px[::-1].reshape(2, COUNT, COUNT).transpose(0, 2, 1).reshape(2, -1)
        assert np.abs(back_px - upright.off_px[kind]).max() < SHIFT_PX, kind


@pytest.mark.parametrize("seen", [Seen(0.62, 1.0), Seen(0.3, 0.2), Seen(1.1, 2.3)])
def test_a_grid_s_stars_and_the_same_as_squares_are_as_far_off(seen):
    """They meet the tracker's pixels at other phases: what differs is an S-curve's, a fifth of
    the error; a moment has none.
    """
    wanted, shown, tile = codes("round", 5.0, seen)
    places = line_places(phase_grid(COUNT, GaussianPsf(SIGMA))[0])
    grid = Judge(wanted, places, SIGMA, seen.blur_px, seen.pixel_px).errors(shown)
    pad = ((0, 0), (8, 9), (8, 9))
    squares = (np.pad(tiles_of(image, tile), pad) for image in (shown, wanted))
    alone = stamp_errors(*squares, SIGMA, seen.blur_px, seen.pixel_px)
    for kind in ("window", "wide", "fit"):
        rms = np.sqrt(np.mean(np.square(alone[kind])))
        assert rms == pytest.approx(grid.axis_rms_px(kind), rel=0.2), kind
    for kind in FAMILY:
        assert 0 < np.abs(alone[kind]).max() < 4 * grid.max_px(kind)


@pytest.mark.parametrize("seen", [Seen(0.62, 1.0), Seen(0.3, 0.2), Seen(2.5, 5.0), Seen(0.0, 1.0)])
def test_a_star_a_tenth_of_a_pixel_aside_is_found_there_and_a_dark_one_nowhere(seen):
    """A tenth of each star's light is a pixel aside."""
    sprites, _ = phase_grid(COUNT, GaussianPsf(SIGMA))
    wanted = phase_image(sprites, GaussianPsf(SIGMA))
    moved = wanted + 0.1 * (np.roll(wanted, 1, axis=1) - wanted)
    judge = Judge(wanted, line_places(sprites), SIGMA, seen.blur_px, seen.pixel_px)
    found = judge.errors(0.5 * moved, 0.5)
    assert found.flux_mag == pytest.approx(0, abs=WINGS)
    for kind in FAMILY:
        assert np.isfinite(found.off_px[kind]).all()
        assert np.abs(found.off_px[kind][1]).max() < ACROSS_PX[kind] * max(1.0, seen.pixel_px), kind
    assert found.off_px["moment"][0] == pytest.approx(0.1, abs=6 * WINGS)  # cut 6 px away
    assert found.off_px["fit"][0] == pytest.approx(0.1, abs=FIT_PX)
    dark = judge.errors(np.zeros_like(wanted))
    assert np.isinf(dark.flux_mag).all() and np.isinf(dark.off_px["fit"]).all()


def test_the_grid_s_image_is_the_oracle_s():
    for sigma_px in (SIGMA, (0.4, 1.9)):
        sprites, tile = phase_grid(COUNT, GaussianPsf(sigma_px))
        assert tile == GaussianPsf(sigma_px).footprint_px + MARGIN_PX
        oracle = linear_image(sprites, (COUNT * tile, COUNT * tile), GaussianPsf(sigma_px))
        assert phase_image(sprites, GaussianPsf(sigma_px)) == pytest.approx(oracle, abs=1e-14)


def test_errors_are_the_same_wherever_stars_lie_in_their_squares_and_turn_with_them():
    """Moved 5 rows up and 4 columns right in the square; and with rows for columns."""
    seen = Seen(0.62, 1.0)
    wanted, shown, tile = codes("round", 5.0, seen)
    shown_tiles, wanted_tiles = tiles_of(shown, tile), tiles_of(wanted, tile)

    def errors(rows: tuple[int, int], columns: tuple[int, int], turned: bool = False) -> dict:
        pad = ((0, 0), rows, columns)
        squares = [np.pad(tiles, pad) for tiles in (shown_tiles, wanted_tiles)]
        if turned:
            squares = [square.transpose(0, 2, 1) for square in squares]
        sigma_px = SIGMA[::-1] if turned else SIGMA
        return stamp_errors(*squares, sigma_px, seen.blur_px, seen.pixel_px)

    middle = errors((8, 9), (8, 9))
    moved = errors((3, 14), (12, 5))
    turned = errors((8, 9), (8, 9), turned=True)
    for kind in FAMILY:
        assert moved[kind] == pytest.approx(middle[kind], abs=SHIFT_PX), kind
        assert turned[kind][::-1] == pytest.approx(middle[kind], abs=SHIFT_PX), kind


@pytest.mark.parametrize("sign", [1, -1], ids=["too faint", "too bright"])
def test_the_largest_flux_error_is_the_largest_either_way(sign):
    errors = StarErrors(np.array([0.02, -0.01, 0.3 * sign]), {})
    assert errors.flux_max_mag == pytest.approx(0.3)


def test_the_largest_distance_is_over_both_axes_and_the_rms_along_one():
    """3 and 4 px off are 5, which no axis alone is."""
    off_px = {
        "window": np.array([[3.0, 0.0, -4.5], [-4.0, 1.0, 0.0]]),
        "moment": np.zeros((2, 3)),
    }
    errors = StarErrors(np.zeros(3), off_px)
    assert errors.max_px("window") == pytest.approx(5.0)
    assert errors.axis_rms_px("window") == pytest.approx(np.sqrt((9 + 16 + 1 + 4.5**2) / 6))
    assert errors.worst() == "window"
