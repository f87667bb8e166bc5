"""The twin on a small bench whose true monitor and lens are off in one way: what is found is that,
by closed forms, and nothing else is blamed.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from hilstar.instruments.simulate.twin import Twin
from hilstar.instruments.verify.measure import Comparison
from hilstar.instruments.verify.summary import summarise, verify
from hilstar.server.bench.bench_file import read_bench_file
from tests.support.benches import bench_text
from tests.support.closed_camera import BITS, CLOSED, RATIO, power_of

FOCAL_PX = 10e3 / 13
ARCSEC_PER_RAD = 206264.806
WHITE_E_PER_S = float(CLOSED["render"]["flux_at_white_e_per_s"])
STARS = {
    "monitor": {"calibration": "gamma2.2"},
    "sky": {"faintest_v_mag": 6.5},
    "tracker": {"exposure_s": 0.5},
}
# of 13 stars, by codes of 10 bits
PLACE_PX, LIGHT_MAG = 0.003, 0.002
SCALE, TURN_ARCSEC = 5e-4, 10.0
REASONS = {
    "white": "look at flux_at_white_e_per_s",
    "scale": "the plate scale is",
    "turn": "the field is turned by",
    "shift": "the field is shifted by",
    "mirror": "would show them",
    "black": "calibrate the black level",
}


def file_of(folder, *changes):
    path = folder / "bench.toml"
    path.write_text(bench_text(CLOSED, STARS, *changes))
    return read_bench_file(path)


def verified(folder, fields=3, **keys):
    verdict = verify(file_of(folder, {"verify": keys}), fields, np.random.default_rng(1))
    return verdict, summarise(verdict)


def blamed(verdict) -> set[str]:
    """What a verdict's reasons name; a centroid's or the light's own error is no cause."""
    text = "\n".join(verdict.reasons)
    return {name for name, words in REASONS.items() if words in text}


def test_a_bench_that_is_as_it_says_passes_with_errors_of_its_codes(tmp_path):
    verdict, summary = verified(tmp_path)
    assert verdict.passed
    assert summary["stars"] > 10 and summary["lost"] == 0
    assert summary["centroid_error_px"].max < PLACE_PX
    assert summary["flux_error_mag"].max < LIGHT_MAG
    assert summary["codes_alone"]["flux_mag"] == summary["flux_error_mag"]
    # 80 000 e-/s at white: photons and read noise leave a fifth of a percent to a few
    noisy = summary["noisy"]
    assert noisy["stars"] == summary["stars"]
    assert 0.003 < noisy["flux_mag"].rms < 0.03
    assert 0.003 < noisy["centroid_px"].rms < 0.03


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_full_scale_is_off_by_its_ratio(tmp_path, share):
    verdict, summary = verified(tmp_path, true_flux_at_white_e_per_s=share * WHITE_E_PER_S)
    assert summary["zero_point_mag"] == pytest.approx(-2.5 * math.log10(share), abs=LIGHT_MAG)
    assert summary["flux_error_mag"].max < LIGHT_MAG
    assert blamed(verdict) == {"white"}


@pytest.mark.parametrize(
    ("keys", "ratio"),
    [({"true_focal_length_mm": 40.4}, 40 / 40.4), ({"true_pixel_pitch_um": 58.2}, 58.2 / 57.65)],
)
def test_a_longer_lens_or_a_finer_pitch_shrinks_the_field(tmp_path, keys, ratio):
    verdict, summary = verified(tmp_path, **keys)
    assert summary["scale_error"] == pytest.approx(ratio - 1, abs=SCALE)
    assert np.hypot(*summary["offset_px"]) < PLACE_PX
    assert abs(summary["rotation_arcsec"]) < TURN_ARCSEC
    assert blamed(verdict) == {"scale"}


# Half angles about x, y and z: what turns the screen by a (right-handed, y down) moves a star of
# the sky by -a: about x down by a, about y left, about z against the clock's opposite.
@pytest.mark.parametrize(
    ("half_rad", "offset_rad", "turn_rad", "causes"),
    [
        ((2e-4, 0.0, 0.0), (0.0, 4e-4), 0.0, {"shift"}),
        ((0.0, 3e-4, 0.0), (-6e-4, 0.0), 0.0, {"shift"}),
        ((0.0, 0.0, 2e-3), (0.0, 0.0), -4e-3, {"turn"}),
        ((2e-4, -3e-4, -2e-3), (6e-4, 4e-4), 4e-3, {"shift", "turn"}),
    ],
)
def test_a_misalignment_shifts_and_turns_the_field(
    tmp_path, half_rad, offset_rad, turn_rad, causes
):
    verdict, summary = verified(tmp_path, true_q_cam_to_mon=[1.0, *half_rad])
    # to second order in the turn
    wanted_px = np.array(offset_rad) * FOCAL_PX
    np.testing.assert_allclose(summary["offset_px"], wanted_px, atol=PLACE_PX)
    turn_arcsec = turn_rad * ARCSEC_PER_RAD
    assert summary["rotation_arcsec"] == pytest.approx(turn_arcsec, abs=TURN_ARCSEC)
    assert summary["scale_error"] == pytest.approx(0.0, abs=SCALE)
    assert blamed(verdict) == causes


@pytest.mark.parametrize(
    ("mirror", "words"),
    [("x", "its columns reversed"), ("y", "its rows reversed")],
)
def test_a_mirrored_screen_is_named(tmp_path, mirror, words):
    verdict, summary = verified(tmp_path, true_mirror=mirror)
    assert summary["lost"] > 0.8 * (summary["lost"] + summary["stars"])
    assert words in verdict.reasons[0]
    assert blamed(verdict) == {"mirror"}


@pytest.mark.parametrize("limit", [None, 1.05, 0.95])
def test_a_black_that_is_not_assumed_glows_by_the_pixels_that_are_seen(tmp_path, limit):
    """Black of 1e-4 of white: 8 electrons per second from each of the 0.81 monitor pixels that a
    tracker pixel sees.
    """
    black = 1e-4
    head = (
        'kind = "photometric"\nwho = ""\nwhen = ""\ninstrument = ""\nunit = ""\n'
        f'bits = {BITS}\nresponse = "true.csv"\n'
    )
    light = power_of(2.2) + black
    rows = [f"{code},{float(value)!r}" for code, value in enumerate(light)]
    (tmp_path / "true.csv").write_text("\n".join(["code,w", *rows]))
    (tmp_path / "true.toml").write_text(f"[calibration]\n{head}")
    keys = {"true_calibration": "true.toml"}
    glow_e_per_s = black / (1 + black) * WHITE_E_PER_S / RATIO**2
    if limit is not None:
        keys["black_e_per_s_px"] = limit * glow_e_per_s
    verdict, summary = verified(tmp_path, fields=1, **keys)
    assert summary["black_e_per_s_px"]["assumed"] == 0.0
    assert summary["black_e_per_s_px"]["seen"] == pytest.approx(glow_e_per_s, rel=2e-3)
    assert ("black" in blamed(verdict)) == (limit == 0.95)


def test_a_glow_is_judged_by_the_faintest_star_over_its_disc(tmp_path):
    """A PSF that is wider along one axis than the other."""
    wide = {"tracker": {"psf_sigma_px": [0.6, 1.1]}}
    with Twin(file_of(tmp_path, wide)) as twin:
        comparison = Comparison(twin)
        found = comparison.measured()
        shown = twin.bench.shown_stars.electrons_per_s
        faintest = shown[shown >= twin.bench.faintest_shown_e_per_s].min()
        sigma_x, sigma_y = comparison.finder.psf.width_px
    assert sigma_y > sigma_x
    disc_px = 4 * math.pi * sigma_x * sigma_y
    assert found.glow.limit_e_per_s_px == pytest.approx(0.1 * faintest / disc_px)
    # 124 x 92 px of 13 um behind 10 mm, of a sky with so many stars
    width, height = 124 / 2 / FOCAL_PX, 92 / 2 / FOCAL_PX
    corner = math.sqrt((1 + width**2) * (1 + height**2))
    field_sr = 4 * math.asin(width * height / corner)
    stars = len(twin.bench.stars) * field_sr / (4 * math.pi)
    assert found.stars_a_field == pytest.approx(stars, rel=1e-9)
