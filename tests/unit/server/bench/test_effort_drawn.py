"""What auto says of its codes holds for stars drawn anywhere on a screen, for panels and
trackers of several kinds.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.display.quantise import shown_light
from hilstar.display.render.reference import linear_image
from hilstar.optics.psf import GaussianPsf
from hilstar.optics.sprites import pack_sprites
from hilstar.server.bench.build import load
from hilstar.tracker.star_errors import stamp_errors

SIZE = (960, 540)
STEP_PX, HALF_PX = 30, 12  # from star to star; of what is looked at about each
BENCH = """
[tracker]
aperture_mm = 30
focal_length_mm = 70
pixel_pitch_um = {pitch_um}
resolution_px = [512, 512]
quantum_efficiency = "ccd47-20"
[sky]
faintest_v_mag = 7
[monitor]
resolution_px = [960, 540]
pixel_pitch_um = 57.65
bits = {bits}
calibration = "{light}"
[collimator]
focal_length_mm = 350
[render]
tolerance_mag = {tolerance}
tolerance_px = {tolerance}
bit_stealing = {stealing}
[verify]
centroider = "{centroider}"
"""
# Bits, calibration, bit stealing, the tracker's pixel (11.5 um are as wide as the monitor's), its
# centroider, the tolerance, and what is taken.
KINDS = [
    (8, "srgb", "false", 13, "fit", 0.02, "exact"),
    (12, "srgb", "false", 13, "fit", 0.05, "round"),
    (12, "srgb", "false", 13, "moment", 0.02, "round"),
    (10, "gamma2.2", "false", 23, "wide", 0.02, "round"),
    (10, "gamma2.2", "false", 5.75, "box3", 0.02, "round"),
    (8, "lcd-example", "false", 13, "window", 0.05, "exact"),
    (8, "lcd-example", "true", 13, "box5", 0.02, "round"),
    (16, "srgb", "false", 13, "fit", 0.02, "round"),
]
# What is claimed of the worst star, against the largest of 500 at random: `exact` has its worst
# flux in one star of a thousand (tests/authority/test_effort.py looks at more of them).
MOST_MAG, MOST_PX = 6.0, 2.5


def drawn_errors(bench, rng):
    """The largest errors of stars at random, of any magnitude under white: flux, and place by
    the bench's centroider.
    """
    x, y = np.meshgrid(np.arange(20, SIZE[0] - 20, STEP_PX), np.arange(20, SIZE[1] - 20, STEP_PX))
    whole = x.ravel(), y.ravel()
    x_px, y_px = (place + rng.uniform(-0.5, 0.5, place.size) for place in whole)
    sigma_px, white = (
        bench.config.render.sprite_sigma_px,
        bench.flux_at_white_e_per_s * bench.darkest,
    )
    brightest = white / GaussianPsf(sigma_px).peak_share
    deepest = 2.5 * math.log10(brightest / bench.stars.electrons_per_s.min())
    rates = brightest * 10 ** (-0.4 * rng.uniform(0, deepest, x_px.size))
    sprites = pack_sprites(x_px, y_px, rates, np.arange(x_px.size), SIZE, bench.psf.footprint_px)
    bench.renderer.draw(sprites, 0)
    images = (
        shown_light(bench.renderer.levels(), bench.panel),
        linear_image(sprites, SIZE, GaussianPsf(sigma_px)),
    )
    near = np.arange(-HALF_PX, HALF_PX + 1)
    rows, columns = whole[1][:, None, None] + near[:, None], whole[0][:, None, None] + near
    shown, wanted = (image[rows, columns] for image in images)
    flux_mag = np.abs(2.5 * np.log10(shown.sum((1, 2)) / wanted.sum((1, 2)))).max()
    seen = bench.renderer.target.seen
    off_px = stamp_errors(shown, wanted, sigma_px, seen.blur_px, seen.pixel_px)[
        bench.config.verify.centroider
    ]
    return flux_mag, np.hypot(*off_px).max()


@pytest.mark.parametrize(
    ("bits", "light", "stealing", "pitch_um", "centroider", "tolerance", "taken"), KINDS
)
def test_what_is_said_of_codes_holds_for_what_is_drawn(
    bits, light, stealing, pitch_um, centroider, tolerance, taken, tmp_path, rng
):
    path = tmp_path / "bench.toml"
    path.write_text(
        BENCH.format(
            bits=bits,
            light=light,
            stealing=stealing,
            pitch_um=pitch_um,
            centroider=centroider,
            tolerance=tolerance,
        )
    )
    with load(path) as bench:
        claimed, method = bench.effort.codes, bench.effort.quantisation
        flux_mag, off_px = drawn_errors(bench, rng)
    assert (method, claimed.centroider) == (taken, centroider)
    assert flux_mag <= claimed.flux_mag <= MOST_MAG * flux_mag
    assert off_px <= claimed.place_px <= MOST_PX * off_px
