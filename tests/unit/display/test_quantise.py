"""From light to levels: what each method promises, on the CPU."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.basics.errors import InputError
from hilstar.display.panel import Panel
from hilstar.display.quantise import (
    MASK_TURNS,
    LitLight,
    RoundQuantiser,
    ThresholdCounter,
    blue_noise,
    dither_levels,
    mask_turn,
    round_levels,
    shown_light,
)
from hilstar.display.render.reference import linear_image
from hilstar.display.response import encode, gamma_response, srgb_response
from hilstar.optics.psf import GaussianPsf
from tests.support.stars import sprites_at
from tools.make_blue_noise import SEED, void_and_cluster

WHITE = 1e6
# The mask's thresholds are the middles of 4096 equal parts, so a mean over them is half a part off
# at most.
MASK_LIMIT = 0.5 / 4096
# A light in float32 against a step: the steps here are 1e-4 of their light at least, its rounding
# 6e-8.
ROUNDING_OF_A_STEP = 1e-3


def steps_of(light, response):
    """The step of light between the two levels about each light."""
    lower = np.searchsorted(response.light, light, side="right") - 1
    return response.light[lower + 1] - response.light[lower]


def test_the_mask_is_the_one_that_its_script_makes():
    ranks = void_and_cluster(np.random.default_rng(SEED))
    assert np.array_equal(((ranks + 0.5) / ranks.size).astype(np.float32), blue_noise())
    assert np.array_equal(np.sort(ranks.ravel()), np.arange(ranks.size))


def test_the_mask_has_no_low_frequencies(rng):
    """Waves longer than 8 px: of white noise they have the same power as others, of blue noise
    hardly any.
    """
    wave = np.hypot(*np.meshgrid(np.fft.fftfreq(64), np.fft.fftfreq(64)))

    def share(mask):
        power = np.abs(np.fft.fft2(mask - mask.mean())) ** 2
        return power[(wave > 0) & (wave < 1 / 8)].mean() / power[wave > 0].mean()

    assert share(blue_noise()) < 0.02
    assert share(rng.permutation(blue_noise().ravel()).reshape(64, 64)) > 0.5


@pytest.mark.parametrize(
    "response", [srgb_response(8), srgb_response(10), gamma_response(10)], ids=["8", "10", "gamma"]
)
def test_the_mean_of_dither_over_the_mask_is_the_light_wanted(response, rng):
    panel = Panel(response, WHITE)
    for light in [*rng.uniform(0, 1, 10), *rng.uniform(0, 0.01, 10), response.light[3], 1e-4]:
        image = np.full((64, 64), light * WHITE, dtype=np.float32)
        mean = shown_light(dither_levels(image, panel), panel).mean() / WHITE
        assert abs(mean - light) <= (MASK_LIMIT + ROUNDING_OF_A_STEP) * steps_of(light, response)


def test_round_misses_the_mean_that_dither_has():
    """The limit above is one that a method can fail."""
    response = srgb_response(8)
    panel = Panel(response, WHITE)
    light = 0.7 * response.light[10] + 0.3 * response.light[11]
    image = np.full((64, 64), light * WHITE, dtype=np.float32)
    assert abs(
        shown_light(round_levels(image, panel), panel).mean() / WHITE - light
    ) > 0.2 * steps_of(light, response)


def test_dither_shows_one_of_the_two_levels_about_the_light(rng):
    response = srgb_response(8)
    panel = Panel(response, WHITE)
    image = (WHITE * rng.uniform(0, 1.2, (100, 90)) ** 3).astype(np.float32)
    image[::7] = 0
    levels = dither_levels(image, panel)
    above = levels - (np.searchsorted(panel.light_e_per_s(), image, side="right") - 1)
    assert set(np.unique(above)) == {0, 1}
    assert (levels[image >= np.float32(WHITE)] == 255).all()
    assert (levels[image == 0] == 0).all()


def test_a_level_s_own_light_is_never_dithered():
    panel = Panel(srgb_response(10), WHITE)
    image = np.tile(panel.light_e_per_s(), (64, 1))
    assert np.array_equal(dither_levels(image, panel, 0.37), np.tile(np.arange(1024), (64, 1)))


@pytest.mark.parametrize("frames", [1, 2, 4, 8, 16, 32, 64])
@pytest.mark.parametrize("start", [0, 3])
def test_over_aligned_turns_of_the_mask_the_error_is_under_a_step_over_their_number(
    frames, start, rng
):
    response = srgb_response(8)
    panel = Panel(response, WHITE)
    light = rng.uniform(0, 0.9, (40, 50)) ** 2
    image = (WHITE * light).astype(np.float32)
    turns = [mask_turn(frame) for frame in range(frames * start, frames * (start + 1))]
    shown = [shown_light(dither_levels(image, panel, turn), panel) for turn in turns]
    error = np.abs(np.mean(shown, axis=0) / WHITE - light) / steps_of(light, response)
    assert error.max() < 1 / frames + ROUNDING_OF_A_STEP
    # and no method of so few equal frames does better for every light
    assert error.max() > 0.5 / frames


def test_the_mask_s_turns_begin_again():
    turns = [mask_turn(frame) for frame in range(MASK_TURNS)]
    assert sorted(turns) == [k / MASK_TURNS for k in range(MASK_TURNS)]
    assert sorted(turns[24:32]) == pytest.approx([k / 8 + min(turns[24:32]) for k in range(8)])
    assert mask_turn(MASK_TURNS + 5) == turns[5]


def test_the_uniformity_map_is_taken_out_of_the_light(rng):
    """A dim pixel asks for more: what the monitor then makes is within half a step of the light
    wanted.
    """
    response = srgb_response(8)
    uniformity = rng.uniform(0.7, 1.1, (60, 80)).astype(np.float32)
    panel = Panel(response, WHITE, uniformity)
    light = rng.uniform(0.01, 0.6, (60, 80))
    image = (WHITE * light).astype(np.float32)
    step = steps_of(light / uniformity, response) * uniformity
    error = np.abs(shown_light(round_levels(image, panel), panel) / WHITE - light) / step
    # sRGB's thresholds lie at half codes, not at half lights: a little over half a step.
    assert error.max() < 0.6
    flat = Panel(response, WHITE)
    unmended = np.abs(shown_light(round_levels(image, flat), panel) / WHITE - light) / step
    assert unmended.max() > 5


@pytest.mark.parametrize("worst", [0.0, -1.0, np.nan, np.inf])
def test_a_uniformity_that_is_not_positive_is_refused(worst):
    uniformity = np.ones((4, 4), dtype=np.float32)
    uniformity[2, 1] = worst
    with pytest.raises(InputError, match="uniformity"):
        Panel(srgb_response(8), WHITE, uniformity)


def test_round_without_a_map_is_the_encoder_s_oracle(rng):
    image = (WHITE * rng.uniform(0, 1.2, (50, 60))).astype(np.float32)
    response = srgb_response(10)
    assert np.array_equal(
        round_levels(image, Panel(response, WHITE)), encode(image, response, WHITE)
    )


@pytest.mark.parametrize(
    "response", [srgb_response(1), srgb_response(10), gamma_response(12)], ids=["1", "10", "gamma"]
)
def test_the_counter_counts_as_a_search_does(response, rng):
    thresholds = response.threshold.astype(np.float32)
    edges = np.concatenate(
        [
            thresholds,
            np.nextafter(thresholds, np.float32(0)),
            np.nextafter(thresholds, np.float32(2)),
        ]
    )
    light = np.concatenate(
        [edges, rng.uniform(0, 1, 1000).astype(np.float32) ** 4, np.zeros(1, np.float32)]
    )
    assert np.array_equal(
        ThresholdCounter(thresholds).count(light), np.searchsorted(thresholds, light, side="right")
    )


def test_a_part_of_an_image_s_light_is_that_of_some_lit_pixels():
    image = np.zeros((3, 4), dtype=np.float32)
    image[0, 2], image[1, 1], image[2, 0], image[2, 3] = 5.0, 6.0, 7.0, 8.0
    lit = LitLight.of(image)
    assert (lit.place.tolist(), lit.e_per_s.tolist()) == ([2, 5, 8, 11], [5.0, 6.0, 7.0, 8.0])
    part = lit.part(1, 3)
    assert (part.place.tolist(), part.e_per_s.tolist()) == ([5, 8], [6.0, 7.0])


@pytest.mark.parametrize(("share", "lit"), [(0.999, 0), (1.001, 1)])
def test_the_faintest_star_that_rounding_shows_lights_the_pixel_in_whose_middle_it_is(share, lit):
    psf = GaussianPsf((0.6, 0.9))
    panel = Panel(srgb_response(8), WHITE)
    rate = share * RoundQuantiser.faintest_e_per_s(panel, psf)
    star = sprites_at(np.array([[20.0, 15.0]]), np.array([rate]), psf.footprint_px)
    linear = linear_image(star, (40, 30), psf).astype(np.float32)
    assert np.count_nonzero(round_levels(linear, panel)) == lit
