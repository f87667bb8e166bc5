"""`temporal`: a star's light and place over any exposure of several frames, and where that ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from hilstar.display.calibration import load_calibration
from hilstar.display.panel import Panel
from hilstar.display.quantise import shown_light
from hilstar.display.render.reference import linear_image
from hilstar.display.response import gamma_response, srgb_response, table_response
from hilstar.display.temporal import (
    MAX_CARRIED_STEPS,
    NONE_BEFORE,
    TemporalQuantiser,
    first_phases,
    places_before,
)
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import join_sprites
from tests.support.centroiders import family_errors_px, moment
from tests.support.star_tiles import SIDE, SIGMA, SIZE, TILE, WHITE, flux_of, places, stars, tiles

FRAMES = 6
# The aims, rms over all phases, for any six frames; on 24 x 24 phases the worst are off by 0.0013
# mag and 0.0035 px (5 x 5).
AIM_MAG, AIM_PX = 0.003, 0.004
# Of 144 stars the worst of some exposures is a tenth above all: a pixel lit once in six frames is
# at the threshold of 5 x 5.
OF_FEW = 1.15
PARTS = (0.0, 0.37, 0.8)  # of its first frame that an exposure misses; it ends as much later
# A whole number of steps is within half a step of the light, two such remainders within one; a
# hundredth for float32.
ONE_STEP = 1.01


def linear(bits):
    return table_response(bits, np.linspace(0, 1, 2**bits))


def shown(panel, frames):
    """The light of frames of sprites, one after another, (frames, tiles, h, w)."""
    quantiser = TemporalQuantiser(panel, SIZE, GaussianPsf(SIGMA))
    return np.stack([tiles(shown_light(quantiser.levels(sprites), panel)) for sprites in frames])


def exposures(frames, count=FRAMES, every=1):
    """The means over exposures of `count` frames: each beginning of a frame, and parts of one
    later.
    """
    for first in range(0, len(frames) - count, every):
        for part in PARTS:
            weight = np.ones(count + 1)
            weight[0], weight[-1] = 1 - part, part
            yield np.tensordot(weight, frames[first : first + count + 1], 1) / count


def worst(frames, wanted, every=1):
    """Flux, mag, and each centroider, px: rms over phases and exposures, or over the phases of
    the worst exposure / OF_FEW.
    """
    errors = []
    for mean, sky in zip(
        exposures(frames, every=every), exposures(wanted, every=every), strict=True
    ):
        flux = 2.5 * np.log10(mean.sum((1, 2)) / sky.sum((1, 2)))
        errors.append([np.sqrt(np.mean(flux**2)), *family_errors_px(mean, sky, SIGMA[0]).values()])
    return np.maximum(np.sqrt(np.mean(np.square(errors), axis=0)), np.max(errors, axis=0) / OF_FEW)


def skies(frames):
    return np.stack([tiles(linear_image(sprites, SIZE, GaussianPsf(SIGMA))) for sprites in frames])


@pytest.mark.parametrize("name", ["srgb", "lcd-example"])  # gamma 2.2: the slow star below
def test_over_any_six_frames_every_centroider_finds_the_light_and_the_place(name):
    """Six magnitudes under white on 8 bits; `lcd-example` has a black level of a thousandth."""
    panel = Panel(load_calibration(name, 8).response, WHITE)
    sprites = stars(*places(), flux_of(6.0))
    frames = shown(panel, [sprites] * 14)
    flux_mag, *off_px = worst(frames, skies([sprites] * 14), every=3)
    assert flux_mag < AIM_MAG
    assert max(off_px) < AIM_PX
    # no bias, tails of a footprint aside
    assert abs(frames.mean(axis=0).sum() / (len(sprites) * flux_of(6.0)) - 1) < 1e-3
    one = worst(np.repeat(frames[3:4], 7, axis=0), skies([sprites] * 7))
    # frames differ: no single one is as right
    assert one[0] > 2 * flux_mag and max(one[1:]) > 2 * max(off_px)


@pytest.mark.parametrize("make", [srgb_response, gamma_response])
def test_a_slow_star_is_as_right_as_a_still_one(make):
    """0.1 px a frame, each star another way."""
    way = np.arange(SIDE**2) * 2.4
    frames = [
        stars(*places(0.1 * (n - 6) * np.cos(way), 0.1 * (n - 6) * np.sin(way)), flux_of(6.0))
        for n in range(13)
    ]
    flux_mag, *off_px = worst(shown(Panel(make(8), WHITE), frames), skies(frames), every=3)
    assert flux_mag < AIM_MAG
    assert max(off_px) < AIM_PX


def test_a_fast_star_has_its_light_and_its_middle():
    """1.8 px a frame, 1 deg/s on the demo's bench, as a path of two sprites: its ends are a step
    of light or less.
    """
    panel, way = Panel(srgb_response(8), WHITE), np.arange(SIDE**2) * 2.4
    frames = []
    for n in range(9):
        at = np.repeat((n - 4) * 1.2, 2 * SIDE**2) + np.tile([-0.3, 0.3], SIDE**2)
        x, y = (
            np.repeat(place, 2) + at * turn(np.repeat(way, 2))
            for place, turn in zip(places(), (np.cos, np.sin), strict=True)
        )
        frames.append(
            replace(stars(x, y, flux_of(6.0) / 2, np.repeat(np.arange(SIDE**2), 2)), per_star=2)
        )
    lit, sky = shown(panel, frames), skies(frames)
    for mean, wanted in zip(exposures(lit), exposures(sky), strict=True):
        flux = 2.5 * np.log10(mean.sum((1, 2)) / wanted.sum((1, 2)))
        assert np.sqrt(np.mean(flux**2)) < AIM_MAG
        # Half a step of light at 3.6 px from the middle, of 6 x 66 steps: 0.0026 px rms along the
        # path beside the aim.
        assert (
            np.sqrt(np.mean(np.square(np.subtract(moment(mean), moment(wanted))))) < AIM_PX + 0.0026
        )


@pytest.mark.parametrize(("bits", "steps"), [(8, 30.3), (2, 12.2), (1, 0.43), (1, 0.031)])
def test_on_few_equal_levels_the_light_of_any_exposure_is_within_a_step(bits, steps):
    """No panel could do better; and its place is then right with the number of frames."""
    panel = Panel(linear(bits), WHITE)
    step = panel.response.light[1] * WHITE
    sprites = stars(*places(), steps * step)
    frames = shown(panel, [sprites] * (60 if steps > 1 else 120))
    light = np.cumsum(
        np.concatenate([np.zeros((1, SIDE**2)), frames.sum((2, 3)) / step - steps]), axis=0
    )
    assert np.ptp(light, axis=0).max() <= ONE_STEP
    asked = steps * len(frames)
    if asked > 50:
        off = np.subtract(moment(frames.mean(axis=0)), moment(skies([sprites])[0]))
        # steps times px, over the steps of all frames; measured 2.7
        assert np.abs(off).max() < 4 / asked


def test_alike_faint_stars_do_not_blink_in_step():
    panel = Panel(linear(1), WHITE)
    frames = shown(panel, [stars(*places(), 0.1 * WHITE)] * 60)
    lit = (frames.sum((2, 3)) > 0).sum(axis=1)
    assert lit.sum() == pytest.approx(0.1 * 60 * SIDE**2, abs=SIDE**2)
    assert lit.max() < 2 * 0.1 * SIDE**2  # in step they would be 144 in one frame and none in nine


@pytest.mark.parametrize("over", [3.0, 0.4])
def test_a_clipped_star_is_right_again_after_it_clips(over):
    """What a star over white cannot show is lost, not saved up."""
    panel = Panel(srgb_response(8), WHITE)
    step = np.diff(panel.response.light).max() / panel.response.light[1]
    bright, fine = (stars(*places(), flux_of(mag)) for mag in (-over, 4.0))
    quantiser = TemporalQuantiser(panel, SIZE, GaussianPsf(SIGMA))
    for _ in range(60):
        quantiser.levels(bright)
    assert np.abs(quantiser.left.error).max() < 4 * MAX_CARRIED_STEPS * step
    quantiser.levels(fine)
    after = np.stack(
        [tiles(shown_light(quantiser.levels(fine), panel)) for _ in range(FRAMES)]
    ).mean(axis=0)
    flux = 2.5 * np.log10(
        after.sum((1, 2)) / tiles(linear_image(fine, SIZE, GaussianPsf(SIGMA))).sum((1, 2))
    )
    assert np.abs(flux).max() < AIM_MAG


def test_a_star_that_comes_back_begins_anew_and_the_others_go_on():
    panel = Panel(srgb_response(8), WHITE)
    x, y = places()
    both = stars(x[:2], y[:2], flux_of([6.0, 6.3]))
    first = replace(
        both, data=both.data[:1], star=both.star[:1], x_px=both.x_px[:1], y_px=both.y_px[:1]
    )
    gone, stays = (
        TemporalQuantiser(panel, SIZE, GaussianPsf(SIGMA)),
        TemporalQuantiser(panel, SIZE, GaussianPsf(SIGMA)),
    )
    seen = [gone.levels(sprites).copy() for sprites in (both, both, first, both, both)]
    alone = [stays.levels(first).copy() for _ in range(5)]
    left, right = np.s_[:TILE, :TILE], np.s_[:TILE, TILE : 2 * TILE]
    assert [np.array_equal(a[left], b[left]) for a, b in zip(seen, alone, strict=True)] == [
        True
    ] * 5
    assert np.array_equal(seen[3][right], seen[0][right]) and np.array_equal(
        seen[4][right], seen[1][right]
    )
    assert not np.array_equal(seen[1][right], seen[0][right])
    assert gone.levels(None).max() == 0
    assert np.array_equal(gone.levels(both), seen[0])


def test_a_star_is_known_by_its_number_in_whatever_order_they_come(rng):
    """Also light that a fault adds, whose numbers are negative."""
    panel = Panel(srgb_response(8), WHITE)
    sprites = stars(*places(), flux_of(6.0), np.arange(SIDE**2) - 5)
    straight, mixed = (
        TemporalQuantiser(panel, SIZE, GaussianPsf(SIGMA)),
        TemporalQuantiser(panel, SIZE, GaussianPsf(SIGMA)),
    )
    for _ in range(4):
        order = rng.permutation(len(sprites))
        other = replace(
            sprites,
            data=sprites.data[order],
            star=sprites.star[order],
            x_px=sprites.x_px[order],
            y_px=sprites.y_px[order],
        )
        assert np.array_equal(straight.levels(sprites), mixed.levels(other))
    assert places_before(np.array([7, -2, 7]), np.array([-2, 3, 7, 900])).tolist() == [
        1,
        NONE_BEFORE,
        2,
        NONE_BEFORE,
    ]


def test_each_star_has_its_last_place_of_the_frame_before(rng):
    for count in (1, 5, 200):
        before, star = rng.integers(-20, 300, count), rng.integers(-25, 310, 150)
        places = {number: place for place, number in enumerate(before.tolist())}
        assert places_before(before, star).tolist() == [
            places.get(number, NONE_BEFORE) for number in star.tolist()
        ]
    assert places_before(before[:0], star).max() == places_before(None, star).max() == NONE_BEFORE


def test_stars_over_each_other_are_right_together(rng):
    """600 stars, several to a tile: light that is right in each tile of 22 px but for its edges."""
    panel = Panel(srgb_response(8), WHITE)
    x, y = rng.uniform(5, TILE - 6, (2, 600))
    at = rng.integers(0, SIDE, (2, 600)) * TILE
    sprites = stars(x + at[0], y + at[1], flux_of(rng.uniform(4, 6.5, 600)))
    frames, sky = shown(panel, [sprites] * 8), skies([sprites])[0]
    for mean in exposures(frames):
        lit = sky.sum((1, 2)) > 0
        flux = 2.5 * np.log10(mean.sum((1, 2))[lit] / sky.sum((1, 2))[lit])
        assert np.sqrt(np.mean(flux**2)) < AIM_MAG


def test_each_star_carries_over_so_many_of_its_own_largest_step():
    """Of a dim pixel beside a bright one, and of a faint star's panel steps beside a bright one's."""
    quantiser = TemporalQuantiser(Panel(linear(8), WHITE), SIZE, GaussianPsf(SIGMA))
    steps = np.array([[1.0, 10.0, 0.5], [2.0, 5.0, 0.0]], dtype=np.float32)
    error = np.array([[1e6, 1e6, 1e6], [-1e6, -1e6, -1e6], [3.0, 3.0, 3.0]], dtype=np.float32)
    most = MAX_CARRIED_STEPS * np.array([2.0, 10.0, 0.5])
    kept = quantiser._bounded(error, steps)
    np.testing.assert_allclose(kept, [most, -most, np.minimum(3.0, most)], rtol=1e-6)


def test_a_frame_without_stars_ends_a_sequence_and_new_stars_begin_between_half_steps():
    """With sprites of no star as without any sprites; a star's part of a step is by its number."""
    panel = Panel(srgb_response(8), WHITE)
    size = (50, 40)
    first = stars(np.array([12.3, 36.1]), np.array([20.2, 18.9]), flux_of(5.0), size=size)
    for nothing in (None, join_sprites([], first.footprint_px)):
        quantiser = TemporalQuantiser(panel, size, GaussianPsf(SIGMA))
        begun = quantiser.levels(first).copy()
        goes_on = quantiser.levels(first).copy()
        assert (goes_on != begun).any()
        quantiser.levels(nothing)
        assert np.array_equal(quantiser.levels(first), begun)
    phases = first_phases(np.arange(1000), np.full(1000, NONE_BEFORE))
    assert -0.5 <= phases.min() < -0.49 < 0.49 < phases.max() < 0.5
    assert phases[0] == -0.5
    known = np.array([3, NONE_BEFORE])
    assert first_phases(np.array([5, 5]), known).tolist() == [0.0, pytest.approx(phases[5])]
