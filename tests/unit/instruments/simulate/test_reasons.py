"""The reasons of a verdict name what is off, in the unit that they state."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

from hilstar.instruments.simulate import budget
from hilstar.instruments.verify.verdict import (
    CURE,
    _black,
    _floor,
    _geometry,
    _light,
    _lost,
)

LIMIT_PX = 0.1
RIGHT = {
    "left": 0.0,
    "scale_error": 0.0,
    "rotation_rad": 0.0,
    "offset_px": (0.0, 0.0),
    "tilt_px": 0.0,
    "distortion_px": 0.0,
    "left_px": 0.0,
}


def geometry_reasons(lens: str = "", **off: object) -> list[str]:
    measured = SimpleNamespace(
        config=SimpleNamespace(
            verify=SimpleNamespace(centroid_px=LIMIT_PX), collimator=SimpleNamespace(geometry=lens)
        ),
        camera=SimpleNamespace(resolution_px=(600, 800)),
    )
    return _geometry(measured, SimpleNamespace(geometry=SimpleNamespace(**RIGHT | off)))


def test_a_turned_field_is_told_in_degrees_from_where_a_corner_is_off_by_the_limit():
    """A corner is 500 px from the middle."""
    assert geometry_reasons(rotation_rad=0.99 * LIMIT_PX / 500) == []
    (turned,) = geometry_reasons(rotation_rad=math.radians(-0.25))
    assert "turned by -0.250 deg" in turned


def test_a_wrong_scale_is_told_in_per_cent_from_where_a_corner_is_off_by_the_limit():
    assert geometry_reasons(scale_error=0.99 * LIMIT_PX / 500) == []
    (scaled,) = geometry_reasons(scale_error=-0.0123)
    assert "scale is -1.23% off" in scaled


@pytest.mark.parametrize("seen", [4.0, 6.0])
def test_a_black_level_is_wrong_on_either_side(seen):
    glow = SimpleNamespace(seen_e_per_s_px=seen, assumed_e_per_s_px=5.0, limit_e_per_s_px=0.9)
    (reason,) = _black(SimpleNamespace(glow=glow))
    assert "calibrate the black level" in reason
    glow.limit_e_per_s_px = 1.1
    assert _black(SimpleNamespace(glow=glow)) == []


def test_a_budget_s_arcseconds_are_those_where_a_pixel_is_widest():
    """Of a lens that has 1000 to 1300 px to a radian: 0.01 px are up to 2.06 arcsec."""
    errors = SimpleNamespace(
        flux_rms_mag=0.0,
        flux_max_mag=0.0,
        max_px=lambda kind: 0.01,
        axis_rms_px=lambda kind: 0.005,
    )
    bench = SimpleNamespace(camera=SimpleNamespace(scales_px_rad=lambda: (1000.0, 1300.0)))
    row = budget._row(bench, 1.0, errors, "moment", 3.0)
    assert row.centroid_max_arcsec == pytest.approx(206264.8 * 0.01 / 1000, rel=1e-5)
    assert row.centroid_rms_px == pytest.approx(math.sqrt(2) * 0.005)
    assert row.v_mag == 4.0


def test_a_tilt_is_told_in_degrees_and_a_distortion_in_pixels():
    """From the limit on; a tilt of 0.5 deg about x, and of -1 deg about y."""
    tilt_rad = (math.radians(0.5), math.radians(-1.0))
    assert geometry_reasons(tilt_rad=tilt_rad, tilt_px=0.99 * LIMIT_PX) == []
    (tilted,) = geometry_reasons(tilt_rad=tilt_rad, tilt_px=0.37)
    assert "tilted by (+0.50, -1.00) deg" in tilted
    assert "0.37 px" in tilted
    (distorted,) = geometry_reasons(k1=-0.0123, distortion_px=2.5)
    assert "distorts by 2.50 px (k1 -0.0123)" in distorted
    (left,) = geometry_reasons(left_px=0.44)
    assert "leaves 0.44 px at 95 %" in left
    (shifted,) = geometry_reasons(offset_px=(-0.3, 0.5))
    assert "shifted by (-0.30, +0.50) px" in shifted


@pytest.mark.parametrize(
    ("floor_px", "floor_mag", "glass_px", "glass_mag", "is_glass"),
    [
        (0.3, 0.0, 0.2, 0.0, True),
        (0.3, 0.0, 0.1, 0.0, False),  # under half of it
        (0.3, 0.0, 0.0, 0.9, False),  # vignetting moves no star
        (0.0, 0.3, 0.0, 0.2, True),
        (0.0, 0.3, 0.9, 0.1, False),
    ],
)
def test_a_glass_is_named_where_it_makes_most_of_what_is_off(
    floor_px, floor_mag, glass_px, glass_mag, is_glass
):
    verify = SimpleNamespace(flux_mag=0.05, centroid_px=LIMIT_PX, centroider="window")
    glass = SimpleNamespace(px=glass_px, mag=glass_mag)
    measured = SimpleNamespace(config=SimpleNamespace(verify=verify), glass=glass)
    figures = {"floor_mag": np.full(9, -floor_mag), "floor_px": np.full(9, floor_px)}
    (reason,) = _floor(measured, SimpleNamespace(of=figures.__getitem__))
    assert ("beside their chief rays" in reason) is is_glass
    figures["floor_mag"] = np.full(9, 0.049)
    figures["floor_px"] = np.full(9, 0.99 * LIMIT_PX)
    assert _floor(measured, SimpleNamespace(of=figures.__getitem__)) == []


@pytest.mark.parametrize("centroider", ["window", "psf"])
def test_a_glass_is_cured_by_a_centroider_that_fits_it_where_there_is_another(centroider):
    verify = SimpleNamespace(flux_mag=0.05, centroid_px=LIMIT_PX, centroider=centroider)
    glass = SimpleNamespace(px=0.4, mag=0.0)
    measured = SimpleNamespace(config=SimpleNamespace(verify=verify), glass=glass)
    figures = {"floor_mag": np.zeros(9), "floor_px": np.full(9, 0.5)}
    (reason,) = _floor(measured, SimpleNamespace(of=figures.__getitem__))
    assert reason.endswith(CURE) == (centroider == "window")


@pytest.mark.parametrize(
    ("vanished", "mirrored", "words"),
    [
        (0, {}, "look at focal lengths"),
        (20, {}, "look at focal lengths"),
        (21, {}, "too faint to be seen"),
        # of 100 that were looked for, however many are lost
        (21, {"x": 50}, "too faint to be seen"),
        (21, {"x": 51}, "51 are where a mirrored screen with its columns reversed"),
        (0, {"x": 3, "swap": 60}, "60 are where a mirrored screen with its axes swapped"),
    ],
)
def test_lost_stars_have_the_cause_of_most_of_them(vanished, mirrored, words):
    tally = SimpleNamespace(vanished=vanished, mirrored=mirrored)
    config = SimpleNamespace(verify=SimpleNamespace(lost_share=0.4))
    measured = SimpleNamespace(tally=tally, config=config)
    (reason,) = _lost(measured, SimpleNamespace(lost=[None] * 41, looked_for=100))
    assert reason.startswith("41 of 100 stars are not where the sky has them (limit 40.0%): ")
    if vanished > 0 and not mirrored:
        assert (vanished > 0.5 * 41) == ("too faint" in reason)
    assert words in reason
    assert _lost(measured, SimpleNamespace(lost=[None] * 40, looked_for=100)) == []


@pytest.mark.parametrize(
    ("off", "cure"),
    [
        ({"scale_error": 0.01}, "look at focal_length_mm and pixel_pitch_um"),
        ({"rotation_rad": 0.01}, "look at q_cam_to_mon"),
        ({"offset_px": (0.2, 0.0)}, "look at q_cam_to_mon and principal_point_px"),
        ({"tilt_px": 0.2}, "hilstar calibrate geometric measures it"),
        ({"distortion_px": 0.2, "k1": 1.0}, "hilstar calibrate geometric measures it"),
    ],
)
def test_a_geometry_is_cured_by_its_keys_or_by_another_file(off, cure):
    if "tilt_px" in off:
        off = off | {"tilt_rad": (0.01, 0.0)}
    (reason,) = geometry_reasons(**off)
    assert reason.endswith(f": {cure}")
    (measured,) = geometry_reasons("lens.toml", **off)
    again = "its geometry file does not say so; run hilstar calibrate geometric again"
    assert measured.endswith(f": {again}")


@pytest.mark.parametrize(
    ("flux_mag", "codes_mag", "offset_mag", "codes_offset_mag", "true_white", "words"),
    [
        (0.04, 0.0, 0.04, 0.0, None, []),
        # by the codes alone: the root of 0.1^2 - 0.09^2 is 0.044
        (0.1, 0.09, 0.0, 0.0, None, ["flux is 0.100 mag off at 95 % (limit 0.05)"]),
        (0.1, 0.08, 0.0, 0.0, None, ["(limit 0.05): light does not follow the codes"]),
        (0.1, 0.0, -0.2, 0.0, None, ["light does not follow"]),
        (0.1, 0.0, -0.2, 0.0, 5.0, ["light does not follow", "look at flux_at_white_e_per_s"]),
        (0.0, 0.0, -0.2, 0.0, None, ["all stars are -0.200 mag off (limit 0.05): look at flux_at"]),
        (0.0, 0.0, 0.2, 0.0, None, ["all stars are +0.200 mag off (limit 0.05): look at flux_at"]),
        (0.0, 0.0, 0.2, -0.1, None, ["(limit 0.05): the codes alone make -0.100"]),
    ],
)
def test_light_is_off_from_star_to_star_and_in_common_beyond_what_codes_make(
    flux_mag, codes_mag, offset_mag, codes_offset_mag, true_white, words
):
    verify = SimpleNamespace(flux_mag=0.05, true_flux_at_white_e_per_s=true_white)
    measured = SimpleNamespace(config=SimpleNamespace(verify=verify))
    figures = {"flux_mag": np.full(9, -flux_mag), "codes_mag": np.full(9, codes_mag)}
    errors = SimpleNamespace(
        of=figures.__getitem__, zero_point_mag=offset_mag, codes_zero_point_mag=codes_offset_mag
    )
    reasons = _light(measured, errors)
    assert len(reasons) == len(words)
    for reason, expected in zip(reasons, words, strict=True):
        assert expected in reason
    if words == ["flux is 0.100 mag off at 95 % (limit 0.05)"]:
        assert reasons == words


def test_a_budget_s_reach_ends_before_the_first_magnitude_beyond_the_limit():
    rows = [SimpleNamespace(below_white_mag=mag) for mag in (0.0, 0.5, 1.0, 1.5)]
    for errors, within in (
        ([0.01, 0.02, 0.021, 0.001], 0.5),
        ([0.01, 0.01, 0.01, 0.02], 1.5),
        ([0.01, None, 0.01, 0.01], 0.0),
        ([0.03, 0.01, 0.01, 0.01], None),
        ([None, 0.01, 0.01, 0.01], None),
    ):
        assert budget._last_within(rows, errors, 0.02) == within


def test_stars_too_faint_to_be_drawn_have_their_share_of_all_light_but_a_body_s():
    """Of 900, 70, 20 and 10 e-/s, the second driven twice and the fourth three times as bright."""
    bench = SimpleNamespace(
        stars=SimpleNamespace(
            rates_e_per_s=np.array([900.0, 70.0, 20.0, 10.0]),
            electrons_per_s=np.array([900.0, 70.0, 20.0, 10.0, 1e9]),
        ),
        drive=np.array([1.0, 2.0, 1.0, 3.0, 1.0]),
        faintest_shown_e_per_s=30.0,
    )
    missing = budget.not_drawn(bench)
    assert (missing.stars, missing.flux_share) == (1, pytest.approx(0.02))


def test_the_zero_point_is_that_of_stars_of_the_sun_s_colour():
    """Of 1000 e-/s at V = 4 three are of B-V 0.56 to 0.74, and red ones are twice as bright."""
    stars = SimpleNamespace(
        rates_e_per_s=np.array([1000.0, 100.0, 10.0, 2000.0, 5.0]),
        v_mag=np.array([4.0, 6.5, 9.0, 4.0, 4.0]),
        bv_mag=np.array([0.56, 0.65, 0.74, 1.5, 0.5]),
    )
    assert budget.zero_point_mag(SimpleNamespace(stars=stars)) == pytest.approx(11.5)
    stars.bv_mag = np.array([1.4, 1.5, 1.9, 1.5, 1.2])
    # none is as near as a tenth: the nearest
    assert budget.zero_point_mag(SimpleNamespace(stars=stars)) == pytest.approx(
        4 + 2.5 * math.log10(5)
    )
