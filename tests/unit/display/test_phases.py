"""A grid of stars at every phase, and the errors that are measured over it."""

from __future__ import annotations

import numpy as np
import pytest

from hilstar.display.balance import Balance
from hilstar.display.panel import Panel
from hilstar.display.phases import (
    FRAMES_BEFORE,
    MARGIN_PX,
    UNLIKE,
    fainter,
    measure,
    phase_grid,
    phase_image,
    shown_by,
)
from hilstar.display.quantise import RoundQuantiser, round_levels, shown_light
from hilstar.display.render.reference import linear_image
from hilstar.display.response import gamma_response
from hilstar.display.temporal import TemporalQuantiser
from hilstar.optics.psf import GaussianPsf

PSF = GaussianPsf((0.6, 0.9))
COUNT = 4


def test_each_star_is_in_the_middle_of_its_tile_and_at_its_own_phase_from_it():
    """A quarter of a pixel from phase to phase, of which the first is another along y than along
    x; each is as bright as white where it is in the middle of a pixel.
    """
    sprites, tile = phase_grid(COUNT, PSF, UNLIKE)
    assert tile == PSF.footprint_px + MARGIN_PX
    numbers = np.arange(COUNT)
    x_px, y_px = ((numbers + 0.5) * tile - 0.5 + (numbers + first) / COUNT for first in UNLIKE)
    assert sprites.x_px == pytest.approx(np.tile(x_px, COUNT))
    assert sprites.y_px == pytest.approx(np.repeat(y_px, COUNT))
    lights = sprites.data["electrons_per_s"]
    assert lights == pytest.approx(1 / PSF.peak_share)
    assert fainter(sprites, 2.5).data["electrons_per_s"] == pytest.approx(lights / 10)
    size = (COUNT * tile, COUNT * tile)
    image = phase_image(sprites, PSF)
    assert image == pytest.approx(linear_image(sprites, size, PSF), abs=1e-7)


def test_errors_are_root_mean_squares_and_maxima_of_light_and_of_place():
    """Of four tiles: right; half of the light; 3 px right and 4 down; all light lost in none."""
    wanted = np.zeros((20, 20))
    wanted[[5, 5, 15, 15], [5, 15, 5, 15]] = 8.0
    shown = np.zeros((20, 20))
    shown[5, 5] = 8.0
    shown[5, 15] = 4.0
    shown[19, 8] = 8.0
    shown[15, 15] = 8.0
    errors = measure(wanted, shown, 10)
    half_mag = 2.5 * np.log10(2)
    assert (errors.flux_rms_mag, errors.flux_max_mag) == pytest.approx((half_mag / 2, half_mag))
    assert (errors.centroid_rms_px, errors.centroid_max_px) == pytest.approx((2.5, 5.0))
    shown[15, 15] = 0.0
    lost = measure(wanted, shown, 10)
    assert lost.centroid_max_px == lost.flux_max_mag == np.inf


def test_an_exposure_of_several_frames_is_their_mean_and_one_of_a_still_method_is_its_frame():
    """`temporal` after the frames before it: its mean is within a step's part of the light."""
    panel = Panel(gamma_response(8, 2.2), 1.0)
    sprites, _ = phase_grid(2, PSF)
    linear = phase_image(sprites, PSF).astype(np.float32)
    balance = Balance(PSF)
    still = shown_by(RoundQuantiser, 6, panel, linear, sprites, balance)
    assert np.array_equal(still, shown_light(round_levels(linear, panel), panel))
    moving = shown_by(TemporalQuantiser, 6, panel, linear, sprites, balance)
    assert moving.sum() == pytest.approx(linear.sum(), rel=1e-3)
    frames = TemporalQuantiser.exposure(FRAMES_BEFORE, 6)
    assert (frames.start, len(frames)) == (2, 6)
