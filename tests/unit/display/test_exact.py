"""`exact`: a star's light and centroid in one frame, and what no method can show."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.balance import SUMS
from hilstar.display.exact import OFF, ExactQuantiser, Turn, _turn_one_more
from hilstar.display.footprints import LEAST_LIGHT, FootprintMap, PixelOrder, star_losses_mag
from hilstar.display.panel import Panel
from hilstar.display.quantise import round_levels, shown_light
from hilstar.display.render.reference import linear_image
from hilstar.display.response import Levels, gamma_response, srgb_response
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import FrameLight, pack_sprites
from tests.support.centroiders import family_errors_px

WHITE = 1e6
SIGMA = (0.85, 0.85)
FIELD = (160, 120)
# Bits, flux at its worst phase, the magnitudes under the brightest star (its peak is white) that it
# holds to, the plain moment.
AIMS = [(10, 0.02, 8.0, 0.05), (8, 0.05, 6.0, 0.03)]
# Light in float32 (6e-8 of it, summed over 100 pixels) and steps called equal within SAME_STEP.
EXCESS = 1 + 1e-3
# Of the error of `round`, by each centroider; measured 0.19 to 0.33 at 32 x 32 phases on sRGB, 0.11
# to 0.28 on a power law. The choice among many is chaotic: another order of float32 sums moves it
# by some hundredths.
OF_ROUND = 0.35
FLUX_MAG = 0.01


def sprites_at(x_px, y_px, electrons_per_s, resolution=FIELD, sigma=SIGMA) -> FrameLight:
    x, y = np.atleast_1d(np.asarray(x_px, float)), np.atleast_1d(np.asarray(y_px, float))
    flux = np.broadcast_to(np.asarray(electrons_per_s, float), x.shape)
    return pack_sprites(x, y, flux, np.arange(len(x)), resolution, GaussianPsf(sigma).footprint_px)


def flux_of(mag, sigma=SIGMA):
    """Electrons per second of a star so many magnitudes under the one whose peak is white."""
    return WHITE * 10 ** (-0.4 * np.asarray(mag)) / GaussianPsf(sigma).peak_share


def phases(count, mag, sigma=SIGMA):
    """count x count stars, one to a tile, at every phase; the tile's side and the resolution."""
    tile = GaussianPsf(sigma).footprint_px + 2
    place = (np.arange(count) + 0.5) * tile + (np.arange(count) + 0.5) / count - 0.5
    x, y = np.meshgrid(place, place)
    side = count * tile
    return sprites_at(x.ravel(), y.ravel(), flux_of(mag, sigma), (side, side), sigma), tile


def sums(image, tile):
    """Light and first moments (x, y) of each tile, in the order of `phases`."""
    count = image.shape[0] // tile
    tiles = (
        image.reshape(count, tile, count, tile)
        .transpose(0, 2, 1, 3)
        .reshape(count * count, tile, tile)
    )
    at = np.arange(tile)
    return tiles.sum(axis=(1, 2)), tiles.sum(axis=1) @ at, tiles.sum(axis=2) @ at


def errors(sprites, levels, panel, sigma, tile):
    """Each star's flux error, mag, and centroid errors along x and y, px."""
    wanted = linear_image(sprites, levels.shape[::-1], GaussianPsf(sigma))
    light, x, y = sums(wanted, tile)
    shown, shown_x, shown_y = sums(shown_light(levels, panel), tile)
    return -2.5 * np.log10(shown / light), shown_x / shown - x / light, shown_y / shown - y / light


def exact(sprites, panel, resolution=FIELD, sigma=SIGMA):
    return ExactQuantiser(panel, resolution, GaussianPsf(sigma)).levels(sprites).copy()


@pytest.mark.parametrize(("bits", "aim_mag", "range_mag", "aim_px"), AIMS)
@pytest.mark.parametrize("make", [srgb_response, gamma_response])
def test_flux_and_moments_are_right_at_every_phase_down_to_the_aim_s_magnitude(
    bits, aim_mag, range_mag, aim_px, make
):
    panel = Panel(make(bits), WHITE)
    for mag in np.linspace(0, range_mag, 9):
        sprites, tile = phases(12, mag)
        side = 12 * tile
        # At most phases of mag = 0 nothing is clipped; one of the pixels may be over white by a
        # rounding.
        flux, x, y = errors(sprites, exact(sprites, panel, (side, side)), panel, SIGMA, tile)
        assert np.abs(flux).max() <= aim_mag
        assert max(np.abs(x).max(), np.abs(y).max()) <= aim_px


def test_rounding_alone_misses_the_aim():
    """The aims above are ones that a method can fail."""
    panel = Panel(srgb_response(10), WHITE)
    sprites, tile = phases(12, 8.0)
    side = 12 * tile
    linear = linear_image(sprites, (side, side), GaussianPsf(SIGMA)).astype(np.float32)
    flux, x, _ = errors(sprites, round_levels(linear, panel), panel, SIGMA, tile)
    assert np.abs(flux).max() > 0.05
    assert np.abs(x).max() > 1.5 * 0.03


def cut(image, tile):
    """The middle 17 x 17 px of each tile, (n, 17, 17)."""
    count = image.shape[0] // tile
    tiles = image.reshape(count, tile, count, tile).transpose(0, 2, 1, 3).reshape(-1, tile, tile)
    return np.asarray(tiles[:, 2 : 2 + 17, 2 : 2 + 17], dtype=float)


@pytest.mark.parametrize("response", [srgb_response(8), gamma_response(8)], ids=["srgb8", "gamma8"])
def test_whatever_centroider_a_tracker_has_finds_the_star_a_third_as_far_off_as_rounded(response):
    """Six magnitudes under white: 66 steps of light on sRGB."""
    panel = Panel(response, WHITE)
    tile, count = 21, 32
    place = (np.arange(count) + 0.5) * tile - 0.5 + (np.arange(count) + 0.5) / count - 0.5
    x, y = (axis.ravel() for axis in np.meshgrid(place, place))
    size = (count * tile, count * tile)
    sprites = sprites_at(x, y, flux_of(6.0), size)
    wanted = linear_image(sprites, size, GaussianPsf(SIGMA))
    rounded, chosen = (
        cut(shown_light(levels, panel), tile)
        for levels in (round_levels(wanted.astype(np.float32), panel), exact(sprites, panel, size))
    )
    sky = cut(wanted, tile)
    before, after = (family_errors_px(shown, sky, SIGMA[0]) for shown in (rounded, chosen))
    assert {
        name: after[name] / before[name] for name in after if after[name] > OF_ROUND * before[name]
    } == {}
    flux = 2.5 * np.log10(chosen.sum((1, 2)) / sky.sum((1, 2)))
    assert np.abs(flux).max() <= FLUX_MAG


@pytest.mark.parametrize("sigma", [(0.6, 0.6), (0.85, 0.85), (1.5, 1.5), (1.4, 0.7)])
@pytest.mark.parametrize("steps", [0.8, 3.3, 17.6, 41.4, 59.2])
def test_on_equal_steps_no_light_could_be_nearer(sigma, steps):
    """Shown light is a whole number of steps: half of one is the limit. Wide stars of few steps
    may miss it by one.
    """
    response = srgb_response(10)
    panel = Panel(response, WHITE)
    step = response.light[1] * WHITE
    sprites, tile = phases(8, 0.0, sigma)
    sprites.data["electrons_per_s"] = np.float32(steps * step)
    side = 8 * tile
    levels = exact(sprites, panel, (side, side), sigma)
    light, _, _ = sums(linear_image(sprites, (side, side), GaussianPsf(sigma)), tile)
    shown, _, _ = sums(shown_light(levels, panel), tile)
    wide = min(sigma) > 1.4
    assert np.abs(shown - light).max() <= (0.5 + wide) * step * EXCESS
    assert np.allclose(shown / step, np.rint(steps)) or wide


def test_along_a_path_the_light_is_handed_on():
    """A streak of 15 px in 26 sprites of 6 steps each: its light and its middle are as right as
    a point's of 167 steps.
    """
    response = srgb_response(8)
    panel = Panel(response, WHITE)
    count, nodes, size = 5, 26, (200, 200)
    rng = np.random.default_rng(3)
    angle, middle = (
        rng.uniform(0, 2 * np.pi, count**2),
        np.stack(np.meshgrid(*[np.arange(count) * 40 + 20] * 2)).reshape(2, -1),
    )
    middle = middle + rng.uniform(-0.5, 0.5, middle.shape)
    along = 15 * ((np.arange(nodes) + 0.5) / nodes - 0.5)
    x, y = (
        m[:, None] + turn[:, None] * along
        for m, turn in zip(middle, (np.cos(angle), np.sin(angle)), strict=True)
    )
    data = sprites_at(x.ravel(), y.ravel(), np.full(x.size, flux_of(5.0) / nodes), size)
    sprites = replace(data, star=np.repeat(np.arange(count**2), nodes), per_star=nodes)
    wanted = linear_image(sprites, size, GaussianPsf(SIGMA))
    rounded = errors_of_tiles(round_levels(wanted.astype(np.float32), panel), wanted, panel, 40)
    chosen = errors_of_tiles(exact(sprites, panel, size), wanted, panel, 40)
    alone = errors_of_tiles(exact(data, panel, size), wanted, panel, 40)
    rms = [np.sqrt(np.mean(np.square(found), axis=1)) for found in (rounded, chosen, alone)]
    assert (rms[1] < 0.3 * rms[0]).all()
    assert rms[1][0] < 0.3 * rms[2][0]
    assert np.abs(chosen[0]).max() < 0.01


GAP_PX = 8.3


def path_of(rates, down: bool) -> tuple[FrameLight, tuple[int, int]]:
    """Paths side by side, of sprites with these rates (paths, sprites) GAP_PX apart, whose
    footprints do not touch; and the image that holds them.
    """
    paths, count = rates.shape
    along = np.tile(10 + GAP_PX * np.arange(count), paths)
    across = np.repeat(12.3 + 20.17 * np.arange(paths), count)
    wide, long = 20 * paths + 12, math.ceil(GAP_PX * count) + 20
    size = (wide, long) if down else (long, wide)
    x, y = (across, along) if down else (along, across)
    star = np.repeat(np.arange(paths), count)
    return replace(sprites_at(x, y, rates.ravel(), size), star=star, per_star=count), size


@pytest.mark.parametrize("down", [False, True])
def test_what_a_path_s_sprites_leave_does_not_add_up_along_it(down, rng):
    """Six paths of 30 faint sprites: all light but half a step, and its first moment about the
    path's end, of which one sprite leaves half a step times the way to the next, and some of its
    own pixels' moments.
    """
    panel = Panel(srgb_response(8), WHITE)
    step = panel.response.light[1] * WHITE
    rates = rng.uniform(3, 9, (6, 30)) * step
    sprites, size = path_of(rates, down)
    wanted = linear_image(sprites, size, GaussianPsf(SIGMA))
    off = (shown_light(exact(sprites, panel, size), panel) - wanted) / step
    if down:
        off = off.T
    to_end_px = np.arange(off.shape[1]) - (10 + GAP_PX * 29)
    by_path = [off[20 * k + 2 : 20 * k + 22] for k in range(6)]
    assert max(abs(part.sum()) for part in by_path) <= 0.5 * EXCESS
    assert max(abs((part @ to_end_px).sum()) for part in by_path) < GAP_PX


def test_a_long_path_is_begun_anew_after_32_sprites():
    """As two paths, of 32 and of 3: each long enough that all near pixels are chosen."""
    panel = Panel(srgb_response(8), WHITE)
    rates = flux_of(2.0) * np.linspace(0.5, 1.0, 35)[None]
    whole, size = path_of(rates, down=False)
    parted = replace(whole, star=np.arange(35) // 32, per_star=32)
    levels = exact(whole, panel, size)
    assert np.array_equal(levels, exact(parted, panel, size))
    sooner = replace(whole, star=np.arange(35) // 31, per_star=31)
    assert not np.array_equal(levels, exact(sooner, panel, size))


def test_a_path_is_drawn_as_by_itself_whatever_is_drawn_beside_it_and_in_panels_before():
    """Of 24 sprites and of 3, whose reach is that of the light of their own path. What a panel
    before left of a path is no star's.
    """
    panel = Panel(srgb_response(8), WHITE)
    counts, steps = np.array([24, 3]), np.array([5.0, 2.3])
    star = np.repeat([0, 1], counts)
    along_px = 10 + 3.3 * np.concatenate([np.arange(count) for count in counts])
    rates = steps[star] * panel.response.light[1] * WHITE
    both = replace(sprites_at(along_px, 12.3 + 40 * star, rates), star=star, per_star=24)
    short = replace(both, data=both.data[24:], star=star[24:], per_star=3)
    levels = exact(both, panel)
    np.testing.assert_array_equal(levels[40:], exact(short, panel)[40:])
    assert levels[40:].any()
    before, after = (ExactQuantiser(panel, FIELD, GaussianPsf(SIGMA)) for _ in range(2))
    before.levels(both)
    after.turn, after.before = Turn((1.0,)), [before]
    np.testing.assert_array_equal(after.levels(both), levels)


def test_no_floor_remains_of_the_frame_before():
    """Light of 3 levels all over the image, with a star; then the star alone, then nothing."""
    panel = Panel(srgb_response(8), WHITE)
    quantiser = ExactQuantiser(panel, FIELD, GaussianPsf(SIGMA))
    star = sprites_at([30.3], [40.4], flux_of(2.0))
    alone = exact(star, panel)
    floor = Levels(np.full(FIELD[::-1], 3, np.uint8))
    assert (quantiser.levels(star, floor) >= 3).all()
    assert np.array_equal(quantiser.levels(star), alone)
    quantiser.levels(star, floor)
    assert quantiser.levels(None).max() == 0


def errors_of_tiles(levels, wanted, panel, tile):
    light, x, y = sums(wanted, tile)
    shown, shown_x, shown_y = sums(shown_light(levels, panel), tile)
    return np.stack(
        [2.5 * np.log10(shown / light), shown_x / shown - x / light, shown_y / shown - y / light]
    )


def test_every_pixel_shows_one_of_the_two_levels_about_its_light(rng):
    response = srgb_response(10)
    panel = Panel(response, WHITE)
    sprites = sprites_at(
        rng.uniform(5, 150, 60), rng.uniform(5, 110, 60), flux_of(rng.uniform(0, 8, 60))
    )
    light = np.minimum(linear_image(sprites, FIELD, GaussianPsf(SIGMA)) / WHITE, 1)
    levels = exact(sprites, panel)
    lower = np.searchsorted(response.light, light * (1 + 1e-6), side="right") - 1
    assert (levels >= np.searchsorted(response.light, light * (1 - 1e-6), side="right") - 1).all()
    assert (levels <= lower + 1).all()


def test_no_light_is_put_where_the_star_has_none(rng):
    """Beyond 3 sigma (of Gaussian and pixel together) and a pixel's diagonal only light of its
    own lights a pixel.
    """
    response = srgb_response(10)
    panel = Panel(response, WHITE)
    sprites, tile = phases(10, 7.3)
    side = 10 * tile
    levels = exact(sprites, panel, (side, side))
    light = linear_image(sprites, (side, side), GaussianPsf(SIGMA)) / WHITE
    y, x = np.nonzero((levels > 0) & (light < response.threshold[0]))
    far = np.hypot(x[:, None] - sprites.x_px, y[:, None] - sprites.y_px).min(axis=1)
    assert len(far) > 100
    assert far.max() < 3 * np.hypot(0.85, 12**-0.5) + 2**-0.5


def test_a_star_under_half_a_step_shows_nothing_and_one_of_a_step_one_code():
    response = srgb_response(8)
    panel = Panel(response, WHITE)
    step = response.light[1] * WHITE
    sprites = sprites_at(
        [20.2, 60.3, 100.4], [30.1, 60.6, 80.4], np.array([0.49, 0.51, 1.4]) * step
    )
    levels = exact(sprites, panel)
    assert levels.sum() == 2
    assert levels[61, 60] == levels[80, 100] == 1
    # half of the first of unlike steps, too, whatever the PSF
    power_law = Panel(gamma_response(8), WHITE)
    for of_panel in (panel, power_law):
        first_step = float(of_panel.response.light[1]) * WHITE
        faintest = ExactQuantiser.faintest_e_per_s(of_panel, GaussianPsf(SIGMA))
        assert faintest == pytest.approx(first_step / 2)


def test_a_star_over_white_stays_white_and_its_neighbours_bring_no_more():
    response = srgb_response(8)
    panel = Panel(response, WHITE)
    sprites = sprites_at([50.2], [40.4], flux_of(-2.0))
    levels = exact(sprites, panel)
    light = linear_image(sprites, FIELD, GaussianPsf(SIGMA)) / WHITE
    assert (levels[light >= 1] == 255).all()
    kept = np.minimum(light, 1)
    shown = shown_light(levels, panel) / WHITE
    assert shown.sum() == pytest.approx(kept.sum(), rel=1e-3)
    assert (shown - kept).max() < np.diff(response.light).max()


def test_overlapping_stars_keep_the_light_of_both():
    response = srgb_response(10)
    panel = Panel(response, WHITE)
    x, y = np.array([50.2, 52.9, 51.0, 100.0, 100.0]), np.array([40.4, 41.1, 44.0, 60.0, 60.0])
    sprites = sprites_at(x, y, flux_of(np.array([2.0, 3.0, 5.5, 6.0, 6.0])))
    levels = exact(sprites, panel)
    wanted = linear_image(sprites, FIELD, GaussianPsf(SIGMA))
    shown = shown_light(levels, panel)
    left, right = np.s_[30:55, 38:64], np.s_[50:70, 90:110]
    # Three groups and one: each within half of the smallest step, or far within where steps differ.
    assert abs(shown[left].sum() - wanted[left].sum()) < 3 * response.light[1] * WHITE
    assert abs(shown[right].sum() - wanted[right].sum()) < 0.6 * response.light[1] * WHITE
    at = np.arange(FIELD[0])
    centroid = [
        image[left].sum(axis=0) @ at[38:64] / image[left].sum() for image in (shown, wanted)
    ]
    assert abs(centroid[0] - centroid[1]) < 1e-3


def test_stars_cut_by_the_edge_show_their_part_of_the_light():
    response = srgb_response(10)
    panel = Panel(response, WHITE)
    sprites = sprites_at(
        [-0.5, 159.4, 60.2, 100.7], [50.0, 80.3, -1.0, 120.0], flux_of(np.full(4, 3.0))
    )
    levels = exact(sprites, panel)
    wanted = linear_image(sprites, FIELD, GaussianPsf(SIGMA))
    shown = shown_light(levels, panel)
    for box in (np.s_[40:60, :10], np.s_[70:90, 150:], np.s_[:10, 50:70], np.s_[110:, 90:112]):
        assert wanted[box].sum() > 100 * response.light[1] * WHITE
        assert abs(shown[box].sum() - wanted[box].sum()) < 1e-3 * wanted[box].sum()


def test_nothing_remains_of_the_image_before(rng):
    panel = Panel(srgb_response(8), WHITE)
    quantiser = ExactQuantiser(panel, FIELD, GaussianPsf(SIGMA))
    many = sprites_at(
        rng.uniform(-5, 165, 200), rng.uniform(-5, 125, 200), flux_of(rng.uniform(-1, 6, 200))
    )
    few = sprites_at([30.3], [40.4], flux_of(2.0))
    alone = quantiser.levels(few).copy()
    assert quantiser.levels(many).astype(bool).sum() > 1000
    assert np.array_equal(quantiser.levels(few), alone)
    assert quantiser.levels(None).max() == 0


def test_stars_in_several_chunks_are_those_of_one(rng, monkeypatch):
    panel = Panel(srgb_response(8), WHITE)
    sprites = sprites_at(
        rng.uniform(-5, 165, 50), rng.uniform(-5, 125, 50), flux_of(rng.uniform(-1, 6, 50))
    )
    at_once = exact(sprites, panel)
    monkeypatch.setattr("hilstar.display.exact.CHUNK", 7)
    assert np.array_equal(exact(sprites, panel), at_once)


def test_a_uniformity_map_is_made_up_for(rng):
    """Pixels 5 % apart and a fall of 14 % to the corners; measured 0.0012 mag and 0.003 px at
    the worst of 100 stars.
    """
    response = srgb_response(10)
    sprites, tile = phases(10, 5.0)
    side = 10 * tile
    y, x = np.mgrid[:side, :side]
    uniformity = (
        1 - 0.2 * np.hypot(x - side / 2, y - side / 2) / side + rng.normal(0, 0.05, (side, side))
    )
    panel = Panel(response, WHITE, uniformity.astype(np.float32))
    flux, x_px, y_px = errors(sprites, exact(sprites, panel, (side, side)), panel, SIGMA, tile)
    assert np.abs(flux).max() < 0.002
    assert max(np.abs(x_px).max(), np.abs(y_px).max()) < 0.0035


def test_under_an_uneven_map_a_faint_star_takes_the_pixel_whose_step_is_nearest_its_light(rng):
    uniformity = np.full(FIELD[::-1], 1.2, dtype=np.float32)
    uniformity[:, ::2] = 0.7
    response = srgb_response(8)
    panel = Panel(response, WHITE, uniformity)
    step = response.light[1] * WHITE
    # The stars' own pixels make 1.2 steps of light of a code, those beside them 0.7.
    sprites = sprites_at(
        [21.0, 61.0, 101.0], [30.0, 60.0, 90.0], np.array([0.25, 0.65, 1.1]) * step
    )
    levels = exact(sprites, panel)
    assert levels[:45].max() == 0
    assert levels[45:75, 60].sum() + levels[45:75, 62].sum() == levels[45:75].sum() == 1
    assert levels[90, 101] == levels[75:].sum() == 1


def test_what_cannot_be_shown_is_named_with_its_loss():
    response = srgb_response(8)
    panel = Panel(response, WHITE)
    step = response.light[1] * WHITE
    flux = np.array([flux_of(-2.0), flux_of(1.0), 0.4 * step, flux_of(4.0)])
    sprites = sprites_at([30.0, 60.3, 100.4, 130.0], [30.0, 60.6, 80.4, 30.0], flux)
    footprints = FootprintMap(FIELD, GaussianPsf(SIGMA))
    light = linear_image(sprites, FIELD, GaussianPsf(SIGMA))[:50, :50]
    shown_mag = star_losses_mag(sprites, panel, footprints, exact(sprites, panel))
    assert shown_mag[0] == pytest.approx(
        -2.5 * np.log10(np.minimum(light, WHITE).sum() / light.sum()), abs=1e-3
    )
    assert np.abs(shown_mag[[1, 3]]).max() < 0.01
    assert np.isinf(shown_mag[2])
    assert np.isinf(
        star_losses_mag(sprites, panel, footprints, np.zeros(FIELD[::-1], dtype=np.uint8))
    ).all()


def test_a_star_loses_the_share_of_the_primaries_that_do_not_show_it():
    panel = Panel(srgb_response(8), WHITE)
    shares = np.array([0.25, 0.75])
    primaries = tuple(Panel(panel.response, share * WHITE) for share in shares)
    sprites = sprites_at(60.3, 30.6, flux_of(1.0))
    levels = exact(sprites, panel)
    dark = np.zeros_like(levels)
    for is_lit in ([True, True], [True, False], [False, True]):
        shown = np.stack([levels if lit else dark for lit in is_lit], axis=-1)
        loss_mag = star_losses_mag(
            sprites,
            replace(panel, primaries=primaries),
            FootprintMap(FIELD, GaussianPsf(SIGMA)),
            shown,
        )
        assert loss_mag == pytest.approx(-2.5 * np.log10(shares[is_lit].sum()), abs=FLUX_MAG)


def test_a_star_in_a_dark_part_of_the_panel_loses_what_is_not_made_up_for():
    panel = Panel(srgb_response(8), WHITE)
    uneven = np.ones(FIELD[::-1], np.float32)
    uneven[:, FIELD[0] // 2 :] = 0.8
    sprites = sprites_at([40.3, 120.3], [30.6, 30.6], flux_of(1.0))
    footprints = FootprintMap(FIELD, GaussianPsf(SIGMA))
    seen = replace(panel, uniformity=uneven)
    loss_mag = star_losses_mag(sprites, seen, footprints, exact(sprites, panel))
    assert loss_mag == pytest.approx([0.0, -2.5 * np.log10(0.8)], abs=FLUX_MAG)


def test_a_star_within_a_brighter_one_loses_what_that_one_does():
    panel = Panel(srgb_response(8), WHITE)
    # As alpha Centauri B within A: every pixel of its own is A's.
    sprites = sprites_at([30.0, 30.02], [30.0, 30.01], np.array([flux_of(-2.0), flux_of(-0.6)]))
    footprints = FootprintMap(FIELD, GaussianPsf(SIGMA))
    shown_mag = star_losses_mag(sprites, panel, footprints, exact(sprites, panel))
    assert shown_mag[0] > 0.1
    assert shown_mag[1] == pytest.approx(shown_mag[0], abs=0.02)  # a fiftieth of a pixel apart


@pytest.mark.parametrize("sigma", [(0.85, 0.85), (0.5, 1.3)])
def test_a_star_s_choice_is_among_nine_pixels_at_least_and_all_near_ones_at_most(sigma):
    """A Gaussian's k-th nearest pixel has exp(-k / area) of its peak; the wider axis is not the
    nearer.
    """
    order = PixelOrder(GaussianPsf(sigma))
    variance_px2 = np.square(sigma) + 1 / 12
    area_px2 = 2 * np.pi * np.sqrt(variance_px2.prod())
    assert order.area_px2 == pytest.approx(area_px2)
    steps = np.array([1e-6, 1.0, 50.0, 1e9], dtype=np.float32)
    reach = order.reach(steps)
    assert reach[[0, 1, 3]].tolist() == [9, 9, order.near]
    pixels = area_px2 * np.log(50.0 / (area_px2 * LEAST_LIGHT))
    assert abs(reach[2] - pixels) < 1
    assert order.near_sigmas(0.6) - order.near_sigmas() == pytest.approx(
        0.6 / np.sqrt(variance_px2.min())
    )


@pytest.mark.parametrize(("off", "turned"), [(-OFF - 0.01, 1), (OFF + 0.01, 0), (OFF - 0.01, None)])
def test_a_star_that_is_a_step_off_has_one_pixel_turned_that_can_be(off, turned):
    """Of three pixels of equal steps the first is up, the second is not, and the last has no step:
    light that is missing is added by the second, and light that is too much taken from the first,
    though turning another would change the other sums less.
    """
    step = np.array([[1.0], [1.0], [0.0]], dtype=np.float32)
    arm = np.ones((SUMS, 3, 1), dtype=np.float32)
    arm[1:, turned or 0] = 3.0  # the one that is wanted costs more
    up = np.array([[True], [False], [False]])
    error = np.zeros((SUMS, 1), dtype=np.float32)
    error[0] = off
    _turn_one_more(step, arm, up, error, np.ones(1, dtype=np.float32))
    wanted = np.array([True, False, False])
    if turned is not None:
        wanted[turned] ^= True
        assert error[0] == pytest.approx(off - np.sign(off), abs=1e-6)
    assert up[:, 0].tolist() == wanted.tolist()
