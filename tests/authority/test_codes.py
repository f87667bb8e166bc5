"""What the codes of a star six magnitudes under white leave of its light and its place, by
integrals that share nothing with hilstar.

A star is the exact integral of a Gaussian over pixels, codes become light by IEC 61966-2-1, and the
tracker's pixels are error functions, as in test_effort.py. A fit is to first order about the star
itself.
"""

from __future__ import annotations

import numpy as np
import pytest
from scipy.special import ndtr

from hilstar.display.render.renderer import Renderer
from hilstar.display.render.target import Target
from hilstar.display.response import Response, srgb_response, table_response
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import pack_sprites
from tests.authority.test_effort import (
    HALF_PX,
    centroids,
    light_of_codes,
    tracker_views,
    true_stamps,
)
from tests.support.claims import holds

SIGMA_PX, WHITE_E_PER_S, MAG_UNDER_WHITE = 0.85, 1e6, 6.0
PHASES, STEP_PX = 32, 2 * HALF_PX + 4
# a star whose middle pixel, centred, has the light of white has this much more in all
PEAK_SHARE = (2 * ndtr(0.5 / SIGMA_PX) - 1) ** 2
RATE_E_PER_S = WHITE_E_PER_S / PEAK_SHARE * 10 ** (-0.4 * MAG_UNDER_WHITE)
# the usual tracker: its optics spread a monitor's pixel by so much, and its pixels are as wide
BLUR_PX, TRACKER_PIXEL_PX = 0.62, 1.0
SEEN_SIGMA_PX = float(np.sqrt(SIGMA_PX**2 + 1 / 6 + BLUR_PX**2))
SRGB = srgb_response(8)
# equal steps of light: a star of 42 of them and a half lies between two that can be shown, and one
# of 42 and a third leaves most over six frames
LINEAR = table_response(8, np.linspace(0, 1, 256))
STEP_E_PER_S = WHITE_E_PER_S / 255
BETWEEN_STEPS, OVER_SIX_FRAMES = 42.5, 42.33
OF_A_STEP = 0.02  # what a logarithm above and below 1 and the wings' cut differ by
BEGINNINGS = 48  # of exposures, one frame after another: 49 152 of a field's stars
# for the slopes of a fit; a hundredth of it changes no digit
SLOPE_STEP_PX, FIT_ROUNDS = 1e-3, 3


def fit_errors(shown, x, y, views):
    """How far from the star itself a least-squares fit of light, x and y finds it (2, n), px."""

    def view(x_px, y_px):
        return views.of(true_stamps(x_px, y_px, SIGMA_PX)).reshape(len(x_px), -1)

    step, off = SLOPE_STEP_PX, np.zeros((2, len(shown)))
    flat = views.of(shown).reshape(len(shown), -1)
    for _ in range(FIT_ROUNDS):
        x_px, y_px = x + off[0], y + off[1]
        along_x = (view(x_px + step, y_px) - view(x_px - step, y_px)) / (2 * step)
        along_y = (view(x_px, y_px + step) - view(x_px, y_px - step)) / (2 * step)
        design = np.stack([view(x_px, y_px), along_x, along_y], axis=2)
        terms = [np.linalg.lstsq(a, b, rcond=None)[0] for a, b in zip(design, flat, strict=True)]
        light, x_light, y_light = np.transpose(terms)
        off += np.stack([x_light, y_light]) / light
    return off


@pytest.fixture(scope="module")
def field():
    """Columns and rows of the stars' pixels, and where in them they are, x and y, px (n,)."""
    middles = np.arange(PHASES) * STEP_PX + STEP_PX // 2
    phases = (np.arange(PHASES) + 0.5) / PHASES - 0.5
    columns, rows = (grid.ravel() for grid in np.meshgrid(middles, middles))
    x, y = (grid.ravel() for grid in np.meshgrid(phases, phases))
    return columns, rows, x, y


def drawn_frames(method, field, frames, response: Response = SRGB, rate_e_per_s=RATE_E_PER_S):
    """The light (n, side, side) of each star's square in frames of the real renderer."""
    columns, rows, x, y = field
    side = PHASES * STEP_PX
    psf = GaussianPsf((SIGMA_PX, SIGMA_PX))
    target = Target((side, side), psf, response, WHITE_E_PER_S, method)
    numbers, rates = np.arange(len(x)), np.full(len(x), rate_e_per_s)
    stars = pack_sprites(columns + x, rows + y, rates, numbers, (side, side), psf.footprint_px)
    near = np.arange(-HALF_PX, HALF_PX + 1)
    squares = rows[:, None, None] + near[:, None], columns[:, None, None] + near
    with Renderer(target) as renderer:
        for frame in range(frames):
            renderer.draw(stars, frame)
            levels = renderer.levels().astype(np.float64)
            light = levels / response.white
            if response is SRGB:
                light = light_of_codes(levels, 8, "srgb")
            yield WHITE_E_PER_S * light[squares]


def shown_light(method, field, frames=1, first=0, **panel):
    """The mean light (n, side, side) of each star's square over frames of the real renderer."""
    drawn = drawn_frames(method, field, first + frames, **panel)
    shown = sum(light for number, light in enumerate(drawn) if number >= first)
    return shown / frames


def places_off(shown, field, rng):
    """By centroider, how far from the stars themselves it finds them (2, n), px."""
    _, _, x, y = field
    wanted = RATE_E_PER_S * true_stamps(x, y, SIGMA_PX)
    at = rng.uniform(-0.5, 0.5, (2, len(x)))  # in the tracker's pixels
    views = tracker_views(at, TRACKER_PIXEL_PX, BLUR_PX)
    there, boxes = centroids(wanted, views, SEEN_SIGMA_PX, None)
    here, _ = centroids(shown, views, SEEN_SIGMA_PX, boxes)
    off_px = {kind: place - there[kind] for kind, place in here.items()}
    return off_px | {"fit": fit_errors(shown, x, y, views)}


def rms(values):
    return float(np.sqrt(np.mean(np.square(values))))


@pytest.mark.parametrize("method", ["round", "exact"])
def test_a_star_six_magnitudes_under_white_keeps_its_light_and_its_place(method, field, rng):
    """Every one of 32 x 32 phases, on eight bits of sRGB: the worst light, the rms of a
    centroider's place along an axis, and the worst place of the moment.
    """
    holds("mag-under-white", MAG_UNDER_WHITE)
    shown = shown_light(method, field)
    holds(f"codes-{method}-light", np.abs(magnitudes_off(shown)).max())
    holds(f"codes-{method}-ripple", np.ptp(magnitudes_off(shown)))
    off_px = places_off(shown, field, rng)
    holds(f"codes-{method}-fit", rms(off_px["fit"]))
    holds(f"codes-{method}-moment", np.hypot(*off_px["moment"]).max())
    if method == "exact":
        holds("codes-exact-others", max(rms(off) for off in off_px.values()))


def magnitudes_off(shown, rate_e_per_s=RATE_E_PER_S):
    """How far each star's light is off, mag (n,)."""
    return 2.5 * np.log10(shown.sum(axis=(1, 2)) / rate_e_per_s)


def test_six_frames_of_temporal_make_up_for_each_other(field, rng):
    """Their mean, from the third frame on: the first of a sequence are no special case."""
    shown = shown_light("temporal", field, frames=6, first=2)
    holds("codes-temporal-light", rms(magnitudes_off(shown)))
    for off in places_off(shown, field, rng).values():
        holds("codes-temporal-places", rms(off))


def test_a_star_between_two_steps_is_half_a_step_off(field):
    """No codes of equal steps could do better."""
    panel = {"response": LINEAR, "rate_e_per_s": BETWEEN_STEPS * STEP_E_PER_S}
    off_mag = magnitudes_off(shown_light("exact", field, **panel), panel["rate_e_per_s"])
    half_mag = 2.5 * np.log10(1 + 0.5 / BETWEEN_STEPS)
    assert np.abs(off_mag) == pytest.approx(half_mag, rel=OF_A_STEP)
    holds("half-a-step", np.abs(off_mag).max())


def test_over_six_frames_steps_are_shared(field):
    """A step over all frames of an exposure, wherever it begins."""
    panel = {"response": LINEAR, "rate_e_per_s": OVER_SIX_FRAMES * STEP_E_PER_S}
    off_mag = np.abs(exposures_mag(field, **panel)).max()
    step_mag = 2.5 * np.log10(1 + 1 / (6 * OVER_SIX_FRAMES))
    assert off_mag < (1 + OF_A_STEP) * step_mag
    holds("step-of-six-frames", off_mag)


def test_the_worst_exposure_of_six_frames(field):
    """At every phase, whichever frame it begins with."""
    holds("temporal-worst-light", np.abs(exposures_mag(field)).max())


def exposures_mag(field, rate_e_per_s=RATE_E_PER_S, response=SRGB):
    """How far the light of exposures of six frames of `temporal` is off, mag (beginnings, n)."""
    drawn = drawn_frames("temporal", field, BEGINNINGS + 5, response, rate_e_per_s)
    of_frames = np.cumsum([light.sum(axis=(1, 2)) for light in drawn], axis=0)
    whole = np.concatenate([np.zeros((1, of_frames.shape[1])), of_frames])
    return 2.5 * np.log10((whole[6:] - whole[:-6]) / 6 / rate_e_per_s)
